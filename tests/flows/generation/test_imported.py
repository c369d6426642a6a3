"""Views made by another program: the plan goes out, pictures come back, and the rest of the run goes on with them."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch

from flows.commands.export import export_command
from flows.commands.import_views import import_views_command
from flows.errors import InputError
from flows.generation.imported import imported, view_name
from flows.jobs.access import read_cameras, read_similarity
from flows.jobs.job import Job
from flows.jobs.request import make_request
from flows.media.images import read_image, write_png
from flows.pipeline.keys import expected_steps, pending
from flows.pipeline.runner import opened, run_missing
from flows.readers.parsing import from_opengl
from schemas.scene_store import SceneStore
from tests.flows.conftest import SCENE, TINY

SIDE, COUNT = 48, 6
SETTINGS = [
    f"plan={{views: {COUNT}, image_size: {SIDE}}}", "skip={covered_path: false, coverage: false}",
    "render.path_views=2", TINY[-1],
]  # fmt: skip


def job_in(out: Path, *settings: str) -> Job:
    (job,) = make_request(SCENE, out, "3", {"method": "cat3d"}, settings=[*SETTINGS, *settings]).jobs()
    return job


def run(job: Job, until: str | None = None) -> list[str]:
    with opened(job):
        return [record.stage for record in run_missing(job, until)]


@pytest.fixture(scope="module")
def planned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a scene's plan, and the plan exported."""
    out = tmp_path_factory.mktemp("planned")
    job = job_in(out)
    run(job, "plan")
    export_command(job.store_path, None, "plan", out / "export")
    return out


@pytest.fixture
def scene(planned: Path, tmp_path: Path) -> Path:
    shutil.copytree(planned, tmp_path / "out")
    return tmp_path / "out"


def pictures(folder: Path, count: int = COUNT, side: int = SIDE, seed: int = 0) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(seed)
    for view in range(count):
        write_png(folder / view_name(view), random.integers(0, 256, (side, side, 3), np.uint8))
    return folder


def test_the_exported_cameras_are_the_plans_in_both_formats(planned: Path) -> None:
    """Points of the scene fall on the same pixels; the world is the data set's own."""
    folder, job = planned / "export" / "plan", job_in(planned)
    store = SceneStore.open(job.store_path)
    document = json.loads((folder / "transforms.json").read_text())
    frames = [frame for frame in document["frames"] if frame["kind"] == "planned"]
    assert [frame["file_path"] for frame in frames] == [f"views/{view_name(view)}" for view in range(COUNT)]
    assert all((frame["w"], frame["h"]) == (SIDE, SIDE) for frame in frames)
    cameras = read_cameras(store.run(job.run).plan)
    points = torch.randn(20, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 0.2
    world = read_similarity(store).inverse().points(points)
    expected, _ = cameras.project(points)
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    by_name = {image.name: image for image in model.images.values()}
    for view, frame in enumerate(frames):
        pose = from_opengl(torch.tensor([frame["transform_matrix"]], dtype=torch.float64))[0]
        local = (world - pose[:3, 3]) @ pose[:3, :3]
        u = frame["fl_x"] * local[:, 0] / local[:, 2] + frame["cx"]
        torch.testing.assert_close(u, expected[view, :, 0], rtol=0, atol=1e-6)
        image = by_name[frame["file_path"]]
        seen = np.array([image.project_point(point) for point in world.numpy()])
        np.testing.assert_allclose(seen, expected[view].numpy(), rtol=0, atol=1e-4)
    given = [frame for frame in document["frames"] if frame["kind"] == "captured"]
    assert len(given) == 3
    photo, _ = read_image(folder / given[0]["file_path"])
    assert photo.shape == (24, 32, 3)
    text = (folder / "README.txt").read_text()
    assert f"{SIDE} x {SIDE} pixels" in text
    assert not (folder / "hints").exists()


def test_imported_views_are_the_runs_and_the_rest_goes_on(scene: Path, prefect_url: str) -> None:
    job = job_in(scene)
    folder = pictures(scene / "views")
    import_views_command(job.store_path, folder, None, "a video model", False)
    assert [step.stage for step in pending(job)] == ["decode", "reconstruct", "render", "evaluate"]
    assert run(job) == ["decode", "reconstruct", "render", "evaluate"]
    store = SceneStore.open(job.store_path)
    made = store.run(job.run).generated
    for view in range(COUNT):
        assert np.array_equal(made.read("image", [view])[0], read_image(folder / view_name(view))[0])
    record = store.record("decode", job.run)
    assert record is not None
    text = f"{COUNT} generated views were imported from {folder}, made by a video model."
    assert [d.text for d in record.decisions] == [text]
    assert pending(job) == []
    # Other pictures make what follows stale, and so does another plan, which they are not of.
    import_views_command(job.store_path, pictures(scene / "others", seed=1), None, "", False)
    assert run(job) == ["decode", "reconstruct", "render", "evaluate"]
    with pytest.raises(InputError, match="The plan of v3-cat3d has changed since views were imported for it"):
        run(job_in(scene, "plan.scales=[0.8]"))


def test_a_reconstruction_gives_hints(scene: Path) -> None:
    """Depth and the photos warped by it, from a run of the photos alone."""
    (job,) = make_request(SCENE, scene, "3", {"method": "zipnerf"}, settings=SETTINGS).jobs()
    run(job, "reconstruct")
    export_command(job.store_path, "v3-cat3d", "plan", scene / "again")
    hints = scene / "again" / "plan" / "hints"
    assert len(list(hints.iterdir())) == 2 * COUNT
    depth = np.load(hints / "view_0002_depth.npy")
    assert depth.shape == (SIDE, SIDE)
    assert (depth > 0).all()
    image, alpha = read_image(hints / "view_0002.png", background=None)
    assert image.shape == (SIDE, SIDE, 3)
    assert alpha is not None
    assert set(np.unique(alpha)) <= {0, 255}


def test_some_views_may_be_missing_where_that_is_said(scene: Path) -> None:
    job = job_in(scene)
    folder = pictures(scene / "views")
    (folder / view_name(4)).unlink()
    with pytest.raises(InputError, match=r"lacks 1 of 6 planned views, the first is view_0004.png: .* --partial"):
        import_views_command(job.store_path, folder, None, "", False)
    import_views_command(job.store_path, folder, None, "", True)
    run(job, "decode")
    done = SceneStore.open(job.store_path).run(job.run).generated.read("done_image").any(-1)
    assert done.tolist() == [True, True, True, True, False, True]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda f: pictures(f, 1, SIDE + 1), "view_0000.png is 49 x 49 pixels, but the plan's views are 48 x 48"),
        (lambda f: shutil.copy(f / view_name(0), f / view_name(6)), "view_0006.png is no planned view: .* view_0005"),
        (lambda f: shutil.copy(f / view_name(0), f / "frame.png"), "frame.png is no planned view"),
        (
            lambda f: shutil.copy(f / view_name(0), f / "view_00.png"),
            "Planned view 0 is there twice: view_00.*Keep one",
        ),
        (lambda f: (f / view_name(3)).write_bytes(b"no picture"), "view_0003.png"),
        (lambda f: shutil.rmtree(f), "is no folder"),
    ],
)
def test_wrong_pictures_are_refused_before_anything_changes(scene: Path, change, sentence: str) -> None:
    job = job_in(scene)
    folder = pictures(scene / "views")
    change(folder)
    with pytest.raises(InputError, match=sentence):
        import_views_command(job.store_path, folder, None, "", False)
    assert imported(job) is None
    assert set(expected_steps(job)) >= {"encode", "sample", "decode"}


def test_they_are_forgotten_when_asked(scene: Path) -> None:
    job = job_in(scene)
    with pytest.raises(InputError, match="nothing to forget"):
        import_views_command(job.store_path, None, None, "", False)
    import_views_command(job.store_path, pictures(scene / "views"), None, "", False)
    assert "sample" not in expected_steps(job)
    import_views_command(job.store_path, None, None, "", False)
    assert imported(job) is None
    assert {"encode", "sample"} <= {step.stage for step in pending(job)}


def test_stores_without_a_plan_say_so(tmp_path: Path) -> None:
    (job,) = make_request(SCENE, tmp_path, "3", {"method": "zipnerf"}).jobs()
    run(job, "poses")
    with pytest.raises(InputError, match="no run has a plan"):
        export_command(job.store_path, None, "plan", tmp_path / "export")
    with pytest.raises(InputError, match="has no plan; make it with `cat3d plan`"):
        import_views_command(job.store_path, pictures(tmp_path / "views"), job.run, "", False)


def test_another_size_than_the_generators_is_for_imports_alone(scene: Path, cat3d) -> None:
    done = cat3d("run", SCENE, "--out", str(scene), "--method", "cat3d", "--views", "3",
                 *(argument for text in SETTINGS for argument in ("--set", text)), check=False)  # fmt: skip
    assert done.returncode == 1
    assert "plan.image_size is 48, but the generator makes views of" in " ".join(done.stderr.split())
