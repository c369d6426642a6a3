"""The same store whoever does the work, in which order, in how many pieces; only what is missing is done."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from flows.errors import WorkerError
from flows.generation.groups import StoredPlan
from flows.generation.open import open_generator
from flows.jobs.job import Job
from flows.pipeline.keys import Step, downstream, expected_steps
from flows.stages import sample as sample_stage
from flows.stages.sample import sample_work
from flows.workers.executors import open_executor
from flows.workers.fan_out import fan_out
from flows.workers.sharing import batch_size
from flows.workers.work import Answer, Batch, run_batch
from schemas.errors import StoreError
from schemas.execution import ExecutionConfig
from schemas.scene_store import SceneStore
from tests.flows.workers.scene import chunk_times, run_of, run_stages


def steps_of(job: Job) -> dict[str, Step]:
    return expected_steps(job)


@pytest.mark.parametrize("split", ["3", "1"])
def test_two_workers_leave_the_store_that_one_leaves(scene, expected, split: str) -> None:
    job = scene(split, workers=2)
    record = run_stages(job, "sample")["sample"]
    assert record.work["workers"] == 2
    assert record.work["views"] == 24
    assert np.array_equal(run_of(job).generated.read("latent"), expected[split])
    assert np.isfinite(expected[split].astype(np.float32)).all()
    assert expected[split].astype(np.float32).std() > 0.1


def test_a_dask_cluster_leaves_the_same_store_for_both_at_once(scene, expected, prefect_url: str) -> None:
    settings = {"executor": "dask", "workers": 2, "dask_resources": "{GPU: 1}"}
    jobs = [scene(split, **settings) for split in ("3", "1")]
    store = SceneStore.open(jobs[0].store_path, "r+")
    works = [sample_work(job, store, steps_of(job)["sample"].key) for job in jobs]
    assert fan_out(works, jobs[0].config.execution, "both").workers == 2
    for job, split in zip(jobs, ("3", "1")):
        assert np.array_equal(run_of(job).generated.read("latent"), expected[split])


def test_dask_listens_on_loopback_only(scene, prefect_url: str) -> None:
    import psutil

    executor = open_executor(scene(executor="dask", workers=1).config.execution, None)
    try:
        here = psutil.Process()
        listening = {
            c.laddr.ip
            for process in (here, *here.children(recursive=True))
            for c in process.net_connections("inet")
            if c.status == "LISTEN"
        }
        assert listening
        assert all(ip.startswith("127.") or ip == "::1" for ip in listening), listening
    finally:
        executor.close()


def test_any_order_and_partition_gives_the_same_bits(scene, expected) -> None:
    job = scene()
    store = SceneStore.open(job.store_path, "r+")
    key = steps_of(job)["sample"].key
    work = sample_work(job, store, key)
    for items in ([4, 1], [0], [3, 2]):
        sample_stage.work(job, store, key, items)
    assert work.missing(range(5)) == []
    assert np.array_equal(run_of(job).generated.read("latent"), expected["3"])


def test_only_missing_views_are_sampled(scene, expected) -> None:
    job = scene()
    store = SceneStore.open(job.store_path, "r+")
    key = steps_of(job)["sample"].key
    sample_work(job, store, key)
    sample_stage.work(job, store, key, [0, 3])
    before = chunk_times(job)
    assert len(before) == 10
    record = run_stages(job, "sample")["sample"]
    assert record.work["groups"] == 3
    after = chunk_times(job)
    assert len(after) == 24
    assert {view: after[view] for view in before} == before
    assert np.array_equal(run_of(job).generated.read("latent"), expected["3"])


def test_a_group_that_was_cut_short_is_completed_without_touching_what_it_has(scene, expected) -> None:
    job = scene()
    store = SceneStore.open(job.store_path, "r+")
    key = steps_of(job)["sample"].key
    work = sample_work(job, store, key)
    sample_stage.work(job, store, key, [0, 1])
    view = work.views[1][2]
    (run_of(job).generated.folder / "done_latent" / f"c.{view}.0").unlink()
    before = chunk_times(job)
    sample_stage.work(job, store, key, [0, 1])
    after = chunk_times(job)
    assert {v: after[v] for v in before} == before
    assert work.missing([0, 1]) == []


def test_a_corrupted_latent_is_found_and_made_again(scene, expected) -> None:
    job = scene()
    run_stages(job, "sample")
    before = chunk_times(job)
    chunk = run_of(job).generated.folder / "latent" / "c.7.0.0.0"
    data = bytearray(chunk.read_bytes())
    data[100] ^= 4
    chunk.write_bytes(bytes(data))
    store = SceneStore.open(job.store_path, "r+")
    store.invalidate(downstream("sample"), job.run)
    record = run_stages(job, "sample")["sample"]
    assert record.work["groups"] == 1
    after = chunk_times(job)
    assert {v for v in before if after[v] != before[v]} == {7}
    assert np.array_equal(run_of(job).generated.read("latent"), expected["3"])


def test_anchors_are_sampled_before_the_views_that_need_them(scene) -> None:
    job = scene("1")
    store = SceneStore.open(job.store_path)
    plan = StoredPlan(store, store.run(job.run), job.config.seed)
    first, second = plan.passes()
    anchors = {v for g in first for v in plan.groups[g].targets}
    assert len(anchors) == 7
    assert all(plan.groups[g].conditions == plan.groups[first[0]].conditions for g in first)
    photo = plan.groups[first[0]].conditions[0]
    for g in second:
        conditions = plan.groups[g].conditions
        assert conditions[0] == photo
        assert {c - plan.captured_count for c in conditions[1:]} <= anchors


def test_conditions_are_training_views_of_the_store(scene) -> None:
    job = scene("3")
    train = set(job.split["train"])
    store = SceneStore.open(job.store_path)
    plan = StoredPlan(store, store.run(job.run), 0)
    assert {c for group in plan.groups for c in group.conditions} == train
    assert train != {0, 1, 2}, "else the test shows nothing"


def test_decoding_is_a_stage_of_its_own_and_does_what_is_missing(scene) -> None:
    job = scene()
    records = run_stages(job, "sample", "decode")
    assert records["decode"].work["views"] == 24
    generated = run_of(job).generated
    images = generated.read("image")
    assert images.shape == (24, 64, 64, 3)
    assert images.std() > 1
    (generated.folder / "done_image" / "c.3.0").unlink()
    SceneStore.open(job.store_path, "r+").invalidate(downstream("decode"), job.run)
    assert run_stages(job, "decode")["decode"].work["views"] == 1
    assert np.array_equal(generated.read("image"), images)


def test_several_scenes_share_the_workers(scene, expected) -> None:
    jobs = [scene("3", workers=2), scene("1", workers=2)]
    store = SceneStore.open(jobs[0].store_path, "r+")
    works = [sample_work(job, store, steps_of(job)["sample"].key) for job in jobs]
    totals = fan_out(works, jobs[0].config.execution, "both")
    assert totals.workers == 2
    for job, split in zip(jobs, ("3", "1")):
        assert np.array_equal(run_of(job).generated.read("latent"), expected[split])
    assert fan_out([sample_work(jobs[0], store, works[0].key)], jobs[0].config.execution, "again").batches == 0


def test_a_lack_of_memory_is_a_sentence_about_the_group(scene, monkeypatch) -> None:
    """The allocator's error is raised by hand; halving itself is tested in tests/core/generation."""

    def none_left(*arguments):  # type: ignore[no-untyped-def]
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")

    job = scene()
    store = SceneStore.open(job.store_path, "r+")
    key = steps_of(job)["sample"].key
    sample_work(job, store, key)
    monkeypatch.setattr("cat3d_core.generation.cat3d.sample", none_left)
    with pytest.raises(WorkerError, match="Memory doesn't hold one group of 8 views on cpu"):
        sample_stage.work(job, store, key, [0])


def test_groups_evaluated_together_are_those_evaluated_alone(scene, expected) -> None:
    """Groups of 1 + 7 and of 3 + 5 views, three at a time: only rounding differs, amplified by guidance."""
    job = scene("1", groups_at_once=3)
    store = SceneStore.open(job.store_path, "r+")
    key = steps_of(job)["sample"].key
    work = sample_work(job, store, key)
    for items in work.passes:
        sample_stage.work(job, store, key, items)
    together = run_of(job).generated.read("latent").astype(np.float32)
    assert np.abs(together - expected["1"].astype(np.float32)).max() < 5e-3  # float16 latents up to 4


def test_noise_depends_on_scene_seed_and_view_alone(scene) -> None:
    job = scene()
    store = SceneStore.open(job.store_path)
    plan = StoredPlan(store, store.run(job.run), 1)
    other = StoredPlan(store, store.run(job.run), 2)
    a, b = plan.groups[0], plan.groups[1]
    assert torch.equal(plan.noise(a, (8, 8, 8)), plan.noise(a, (8, 8, 8)))
    assert not torch.equal(plan.noise(a, (8, 8, 8))[0], plan.noise(b, (8, 8, 8))[0])
    assert not torch.equal(plan.noise(a, (8, 8, 8)), other.noise(a, (8, 8, 8)))


def test_batches_last_about_as_long_as_asked_and_shrink_towards_the_end() -> None:
    settings = ExecutionConfig(batch_seconds=10)
    assert batch_size(settings, None, 1000, 4) == 1, "the first ones measure"
    assert batch_size(settings, 2.0, 1000, 4) == 5
    assert batch_size(settings, 2.0, 16, 4) == 2
    assert batch_size(settings, 2.0, 3, 4) == 1
    assert batch_size(settings, 60.0, 1000, 4) == 1


def test_a_workers_error_keeps_its_type_and_names_its_cause(scene) -> None:
    batch = Batch(
        number=7, job=scene(), stage="sample", key="0" * 64, items=(0,), load=open_generator, share=sample_stage.work
    )  # nobody has made room for the latents
    assert Batch.model_validate_json(batch.model_dump_json()) == batch
    answer = run_batch(batch)
    assert answer.number == 7
    assert Answer.model_validate_json(answer.model_dump_json()) == answer
    with pytest.raises(StoreError, match="generated.latent.*does not exist"):
        answer.raise_error()
