"""Results on object storage, on a real S3 server on loopback (moto): equal tables, claims, lost machines, sentences."""

from __future__ import annotations

import json
import logging
import platform
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import boto3
import obstore
import pytest
from moto.server import ThreadedMotoServer
from typer.testing import CliRunner

from flows.cli import app
from flows.errors import InputError, WorkerError
from flows.jobs.metric_table import metric_table
from flows.object_storage import address_of, claim, mirror, results_at
from flows.object_storage.address import Address
from flows.object_storage.claim import NAME, read_state
from flows.object_storage.mirror import Mirror
from flows.pipeline.sweep import run_sweep
from schemas.scene_store import SceneStore
from schemas.tables import read_rows
from schemas.verify import verify
from tests.flows.pipeline.test_side_by_side import SOURCE, swept
from tests.flows.pipeline.test_sweep import sweep_of

HERE = platform.node()


@pytest.fixture
def bucket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A client of a server with the bucket `results`; this machine's working copies are in tmp_path/work."""
    monkeypatch.setattr(logging.getLogger("werkzeug"), "disabled", True)
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    given = {
        "ACCESS_KEY_ID": "a",
        "SECRET_ACCESS_KEY": "b",
        "REGION": "us-east-1",
        "ENDPOINT_URL": f"http://{host}:{port}",
    }
    for name, value in given.items():
        monkeypatch.setenv(f"AWS_{name}", value)
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    monkeypatch.setenv("CAT3D_WORK", str(tmp_path / "work"))
    client = boto3.client("s3", endpoint_url=given["ENDPOINT_URL"])
    client.create_bucket(Bucket="results")
    yield client
    urllib.request.urlopen(f"{given['ENDPOINT_URL']}/moto-api/reset", data=b"")  # servers of one process share buckets
    server.stop()


ADDRESS = Path("s3://results/team/first")


def keys(client: Any) -> set[str]:
    pages = client.get_paginator("list_objects_v2").paginate(Bucket="results", Prefix="team/first/")
    return {o["Key"].removeprefix("team/first/") for page in pages for o in page.get("Contents", [])}


def other_machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, name: str) -> None:
    monkeypatch.setenv("CAT3D_WORK", str(tmp_path / name))


def write(folder: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def texts(folder: Path) -> dict[str, str]:
    return {p: (folder / p).read_text() for p, _ in mirror._files(folder)}


def test_a_sweep_there_gives_the_table_of_one_here_and_another_machine_has_nothing_to_do(
    bucket: Any, tmp_path: Path, prefect_url: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    here = swept(tmp_path / "here", SOURCE, methods={"zipnerf": {"method": "zipnerf"}}, workers=1)
    config = sweep_of(SOURCE, base={"execution": {"workers": 1}})
    with results_at(ADDRESS) as folder:
        assert run_sweep(config, folder) == []
    assert "procedural_llff_2.zarr/zarr.json" in keys(bucket)
    assert not [key for key in keys(bucket) if "/." in f"/{key}" and key != NAME], "locks and databases stay here"
    other_machine(monkeypatch, tmp_path, "elsewhere")
    capsys.readouterr()
    with results_at(ADDRESS) as folder:
        assert run_sweep(config, folder) == []
    assert "of which 0 are to do" in capsys.readouterr().out
    assert read_rows(tmp_path / "elsewhere/results/team/first/metrics", metric_table()).to_pylist() == here
    with results_at(ADDRESS / "procedural_llff_2.zarr", writes=False) as store:
        assert list(verify(SceneStore.open(store))) == []
    for arguments in (["results", str(ADDRESS)], ["inspect", f"{ADDRESS}/procedural_llff_2.zarr", "--verify"]):
        assert CliRunner().invoke(app, arguments).exit_code == 0


def test_what_changed_is_copied_and_what_is_gone_is_removed(
    bucket: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with results_at(ADDRESS) as folder:
        write(folder, {"a.zarr/stages/plan.json": "1", "a.zarr/c/0": "x", "b.zarr/c/0": "y", ".work/z": "secret"})
    assert keys(bucket) == {NAME, "a.zarr/stages/plan.json", "a.zarr/c/0", "b.zarr/c/0"}
    with results_at(ADDRESS) as folder:
        write(folder, {"a.zarr/c/0": "longer", "a.zarr/c/1": "new"})
        (folder / "b.zarr/c/0").unlink()
    other_machine(monkeypatch, tmp_path, "elsewhere")
    with results_at(ADDRESS, writes=False) as folder:
        assert texts(folder) == {"a.zarr/stages/plan.json": "1", "a.zarr/c/0": "longer", "a.zarr/c/1": "new"}
    with results_at(ADDRESS) as folder:
        (folder / "a.zarr/c/1").unlink()
    monkeypatch.setenv("CAT3D_WORK", str(tmp_path / "work"))
    with results_at(ADDRESS, writes=False) as folder:
        assert texts(folder) == {"a.zarr/stages/plan.json": "1", "a.zarr/c/0": "longer"}


def test_records_are_copied_after_what_they_speak_of(bucket: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    order: list[str] = []
    put = obstore.put
    monkeypatch.setattr(obstore, "put", lambda store, path, *a, **k: (order.append(path), put(store, path, *a, **k))[1])
    with results_at(ADDRESS) as folder:
        write(folder, {"a.zarr/stages/plan.json": "1", "a.zarr/z/0": "x", "a.zarr/b": "y"})
    order = [path for path in order if path != NAME]
    assert order[-1] == "a.zarr/stages/plan.json"
    assert sorted(order[:2]) == ["a.zarr/b", "a.zarr/z/0"]


def test_a_killed_commands_work_is_copied_by_the_next_on_this_machine(
    bucket: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with results_at(ADDRESS) as folder:
        write(folder, {"a.zarr/x": "1"})
    lost = Mirror(address_of(ADDRESS))  # type: ignore[arg-type]
    lost.claim.me = f"process 999999999 of {HERE}"
    lost.claim.take()
    lost.claim.over.set()
    write(folder, {"b.zarr/x": "2"})
    with results_at(ADDRESS) as folder:
        pass
    assert {"a.zarr/x", "b.zarr/x"} <= keys(bucket)


def test_copying_that_was_not_completed_is_not_trusted_elsewhere(
    bucket: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with results_at(ADDRESS) as folder:
        write(folder, {"a.zarr/x": "1", "b.zarr/x": "1", "metrics/a.v3.parquet": "1", "metrics/b.v3.parquet": "1"})
    put = obstore.put

    def breaks(store: Any, path: str, *rest: Any, **options: Any) -> Any:
        if path == "a.zarr/y":
            raise ConnectionError("the machine is lost")
        return put(store, path, *rest, **options)

    monkeypatch.setattr(obstore, "put", breaks)
    with pytest.raises(ConnectionError), results_at(ADDRESS) as folder:
        write(folder, {"a.zarr/x": "changed", "a.zarr/y": "2", "metrics/a.v3.parquet": "2"})
    monkeypatch.setattr(obstore, "put", put)
    other_machine(monkeypatch, tmp_path, "elsewhere")
    with results_at(ADDRESS) as folder:
        assert texts(folder) == {"b.zarr/x": "1", "metrics/b.v3.parquet": "1"}
        assert not (folder / "a.zarr").exists()
        write(folder, {"a.zarr/x": "again"})
    said = " ".join(capsys.readouterr().out.split())
    assert "copying was not completed there (a.zarr, metrics/a.v3.parquet): this is done again" in said
    assert keys(bucket) == {NAME, "a.zarr/x", "b.zarr/x", "metrics/b.v3.parquet"}
    monkeypatch.setenv("CAT3D_WORK", str(tmp_path / "work"))
    with results_at(ADDRESS) as folder:  # the first machine comes back with what it had not copied
        assert texts(folder) == {"a.zarr/x": "again", "b.zarr/x": "1", "metrics/b.v3.parquet": "1"}
    [kept] = folder.parent.glob("first.kept-*")
    assert (kept / "a.zarr/y").read_text() == "2", "nothing is lost"


def test_one_command_writes_at_a_time_and_a_dead_ones_claim_ends(
    bucket: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(claim, "BEAT_S", 0.2)
    with results_at(ADDRESS) as folder:
        write(folder, {"a.zarr/x": "1"})
        with pytest.raises(
            InputError, match=r"Another cat3d command \(process \d+ of .* is writing s3://results/team/first"
        ):
            Mirror(address_of(ADDRESS)).claim.take()  # type: ignore[arg-type]
    far = Mirror(Address("results", address_of(ADDRESS).folder))  # type: ignore[union-attr]
    far.claim.me = "process 1 of another"
    far.claim.take()
    with pytest.raises(InputError, match="process 1 of another"), results_at(ADDRESS):
        pass
    far.claim.over.set()  # it shows no sign of life from here on
    with results_at(ADDRESS) as folder, pytest.raises(WorkerError, match="has taken s3://results/team/first over"):
        far.claim.change(beat=7)
    assert read_state(far.store)[0].holder == ""


@pytest.mark.parametrize(
    ("address", "sentence"),
    [
        ("gs://bucket/x", "only s3:// is supported"),
        ("s3://bucket", "not of the form s3://BUCKET/FOLDER"),
        ("s3://bucket/../x", "not of the form"),
        ("s3://nowhere-at-all/x", "s3://nowhere-at-all/x cannot be used"),
    ],
)
def test_addresses_that_cannot_be_used_are_refused(bucket: Any, address: str, sentence: str) -> None:
    with pytest.raises((InputError, WorkerError), match=sentence), results_at(Path(address)):
        pass


def test_a_folder_where_nothing_is_and_a_damaged_state_are_sentences(bucket: Any) -> None:
    with pytest.raises(InputError, match="holds no results"), results_at(ADDRESS, writes=False):
        pass
    bucket.put_object(Bucket="results", Key=f"team/first/{NAME}", Body=json.dumps({"writer": 1}))
    with pytest.raises(InputError, match="is damaged"), results_at(ADDRESS, writes=False):
        pass


def test_plain_folders_are_themselves(tmp_path: Path) -> None:
    with results_at(tmp_path) as folder:
        assert folder == tmp_path


def test_every_call_to_the_storage_fails_once_in_turn(
    bucket: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sentence each time; the next command finishes, and another machine finds what an undisturbed one leaves."""
    before = {"a.zarr/stages/x": "1", "a.zarr/c/0": "1", "b.zarr/c/0": "1"}
    after = {"a.zarr/stages/x": "2", "a.zarr/c/0": "22", "b.zarr/c/1": "2"}
    calls = {name: getattr(obstore, name) for name in ("get", "put", "list", "delete")}
    count, fails_at = 0, -1

    def counted(name: str) -> Any:
        def call(*arguments: Any, **options: Any) -> Any:
            nonlocal count
            count += 1
            if count == fails_at:
                raise obstore.exceptions.GenericError("Generic S3 error: connection reset")
            return calls[name](*arguments, **options)

        return call

    for name in calls:
        monkeypatch.setattr(obstore, name, counted(name))
    monkeypatch.setattr(claim, "lives", lambda pid: False)  # each command was a process of its own
    monkeypatch.setattr(mirror, "THREADS", 1)

    def command(address: Path) -> None:
        with results_at(address) as folder:
            write(folder, after)
            (folder / "b.zarr/c/0").unlink(missing_ok=True)

    number, told = 0, list[str]()
    while len(told) == number:
        number += 1
        address = Path(f"s3://results/team/{number}")
        fails_at = -1
        with results_at(address) as folder:
            write(folder, before)
        count, fails_at = 0, number
        try:
            command(address)
        except WorkerError as error:
            told.append(str(error))
        fails_at = -1
        command(address)
        other_machine(monkeypatch, tmp_path, f"elsewhere{number}")
        with results_at(address, writes=False) as folder:
            assert texts(folder) == after, f"call {number}"
        monkeypatch.setenv("CAT3D_WORK", str(tmp_path / "work"))
    assert len(told) >= 9, "calls of a command that changes three files and removes one"
    assert all("cannot be used: Generic S3 error: connection reset" in sentence for sentence in told)


def test_a_record_written_after_its_data_were_listed_is_for_the_next_copying(
    bucket: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = mirror._files

    def listed(folder: Path) -> Any:
        found = list(files(folder))
        if (folder / "a.zarr").exists():
            write(folder, {"a.zarr/c/0": "newer", "a.zarr/stages/plan.json": "of the newer"})
        return found

    with results_at(ADDRESS) as folder:
        write(folder, {"a.zarr/c/0": "1", "a.zarr/stages/plan.json": "of 1"})
        monkeypatch.setattr(mirror, "_files", listed)
    assert "a.zarr/stages/plan.json" not in keys(bucket)
    monkeypatch.setattr(mirror, "_files", files)
    with results_at(ADDRESS):
        pass
    record = bucket.get_object(Bucket="results", Key="team/first/a.zarr/stages/plan.json")
    assert record["Body"].read() == b"of the newer"
