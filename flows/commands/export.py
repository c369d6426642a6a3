"""`cat3d export`: a finished run as a mesh, points, splats, a data set for other trainers, renders along a path."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch

from cat3d_core.random import generator
from cat3d_core.reconstruction import PointCloud, point_cloud, surface_depth
from cat3d_core.splats import REFINE
from cat3d_core.splats.viewpoints import between
from flows.errors import InputError
from flows.exports.dataset import write_dataset
from flows.exports.mesh import fuse, without_crumbs, write_mesh_glb, write_mesh_ply
from flows.exports.path import read_path, write_renders
from flows.exports.plan import open_plan, write_plan_folder
from flows.exports.ply import write_ply
from flows.exports.source import Source, open_source, render_views, surface_cameras, training_images
from flows.exports.splats import MOST, splats_of, write_splats
from flows.media.images import to_uint8
from flows.open3d_import import import_open3d
from flows.progress import console

KINDS = ("mesh", "points", "splats", "dataset", "renders", "plan")
#: Points from which splats start: nerfstudio's and INRIA's trainers split and prune from there.
DATASET_POINTS = 50_000


@dataclass(frozen=True)
class SurfaceSettings:
    """resolution: voxels along the mesh's cube of side 2 radius; radius: what counts as the scene, in units of the mean
    distance from the cameras to what they look at; opacity: least opacity of a surface pixel; views: cameras to render
    at most; scale: their size relative to the photos; splats: so many at most; refine: steps in which splats learn to
    look like the renders."""

    resolution: int = 512
    radius: float = 3.0
    opacity: float = 0.5
    views: int = 120
    scale: float = 1.0
    splats: int = MOST
    refine: int = REFINE.iterations

    def __post_init__(self) -> None:
        limits: dict[str, tuple[float, float]] = {
            "resolution": (8, 8192), "radius": (0.01, 1e4), "opacity": (0.0, 1.0), "views": (1, 100_000),
            "scale": (0.01, 16.0), "splats": (1, 10_000_000), "refine": (0, 100_000),
        }  # fmt: skip
        for name, (low, high) in limits.items():
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(f"--{name} is {value:g}; it must lie between {low:g} and {high:g}.")


def export_command(
    path: Path,
    run_name: str | None,
    what: str,
    out: Path,
    frame: str = "world",
    settings: SurfaceSettings | None = None,
    path_file: Path | None = None,
) -> list[Path]:
    """Write to `out` what is asked for (comma-separated KINDS; mesh, points, splats and dataset if empty); the files.

    Raises InputError for everything a user can correct.
    """
    settings = settings or SurfaceSettings()
    kinds = _kinds(what, path_file)
    if "mesh" in kinds:
        import_open3d("Meshes")  # before minutes of rendering
    if "plan" in kinds:
        _export_plan(path, run_name, frame, out)
    if kinds == {"plan"}:
        return [out / "plan"]
    source = open_source(path, run_name, frame)
    first = source.store.captured.read("size")[0].tolist()
    camera_path = read_path(path_file, *first) if path_file is not None else None
    out.mkdir(parents=True, exist_ok=True)
    made: list[Path] = []
    if kinds & {"mesh", "points", "splats", "dataset"}:
        made += _surface_exports(source, kinds, out, settings)
    if camera_path is not None and "renders" in kinds:
        count = write_renders(source, camera_path, out / "renders")
        console.print(f"renders: {count} frames along {path_file}")
        made.append(out / "renders")
    for file in made:
        console.print(f"  {file}")
    return made


def _export_plan(path: Path, run_name: str | None, frame: str, out: Path) -> None:
    plan = open_plan(path, run_name, frame)
    count = write_plan_folder(plan, out / "plan", path)
    hints = "with hints from a reconstruction" if plan.scene else "without hints: no run reconstructed these photos yet"
    console.print(f"plan: {count} planned views, {hints}")
    console.print(f"  {out / 'plan'}")


def _kinds(what: str, path_file: Path | None) -> set[str]:
    kinds = {kind.strip() for kind in what.split(",") if kind.strip()}
    unknown = sorted(kinds - set(KINDS))
    if unknown:
        raise InputError(f'"{unknown[0]}" cannot be exported; choose among {", ".join(KINDS)}.')
    if "renders" in kinds and path_file is None:
        raise InputError("Renders need a camera path: give its file as --path FILE.json.")
    if path_file is not None:
        return kinds | {"renders"}
    return kinds or {"mesh", "points", "splats", "dataset"}


def _surface_exports(source: Source, kinds: set[str], out: Path, settings: SurfaceSettings) -> list[Path]:
    cameras = surface_cameras(source, settings.views)
    if kinds == {"splats"}:
        cameras = between(cameras, settings.views)
    renders = list(render_views(source, cameras, settings.scale))
    shown = {"min_opacity": settings.opacity, "max_depth": float("inf"), "max_radius": settings.radius}
    made = []
    if "mesh" in kinds:
        views = ((surface_depth(r, cameras, i, **shown), r.image) for i, r in enumerate(renders))
        mesh = without_crumbs(fuse(views, cameras, 2 * settings.radius / settings.resolution))
        mesh = mesh.mapped(source.frame_from_scene)
        write_mesh_ply(out / "mesh.ply", mesh)
        write_mesh_glb(out / "mesh.glb", mesh)
        console.print(f"mesh: {len(mesh.vertices)} vertices, {len(mesh.faces)} faces from {len(cameras)} views")
        made += [out / "mesh.ply", out / "mesh.glb"]
    if "splats" in kinds:
        splats = splats_of(source.scene, renders, cameras, settings.splats, settings.refine)
        files, lacking = write_splats(out, splats, source.frame_from_scene)
        console.print(f"splats: {len(splats)} from {len(cameras)} views", *lacking)
        made += files
    if kinds & {"points", "dataset"}:
        cloud = _mapped(point_cloud(renders, cameras, **shown), source)
        if not len(cloud.points):
            raise InputError(
                "There is no surface to take points from: no rendered pixel is opaque within the radius. Train longer, "
                "or lower --opacity or raise --radius."
            )
    if "points" in kinds:
        write_ply(out / "points.ply", *_arrays(cloud))
        console.print(f"points: {len(cloud.points)} from {len(cameras)} views")
        made.append(out / "points.ply")
    if "dataset" in kinds:
        made.append(_export_dataset(source, cloud, out / "dataset"))
    return made


def _export_dataset(source: Source, cloud: PointCloud, folder: Path) -> Path:
    views = training_images(source)
    drawn = torch.randperm(len(cloud.points), generator=generator(0, "export", "points"))[:DATASET_POINTS]
    some = PointCloud(*(part[drawn] for part in cloud))
    cameras = source.frame_from_scene.cameras(views.cameras)
    points, normals, colours = _arrays(some)
    images = (image.numpy() for image in views.images)
    names = write_dataset(folder, cameras, images, views.captured_name, points, normals, colours)
    generated = sum(name is None for name in views.captured_name)
    console.print(f"dataset: {len(names) - generated} captured and {generated} generated views, {len(points)} points")
    return folder


def _mapped(cloud: PointCloud, source: Source) -> PointCloud:
    """The cloud in the export frame, float64."""
    similarity = source.frame_from_scene
    normals = cloud.normals.double() @ similarity.rotation.T
    return PointCloud(similarity.points(cloud.points.double()), cloud.colours, normals)


def _arrays(cloud: PointCloud) -> tuple:
    """points, normals, colours (uint8) as arrays, in the order of `write_ply`."""
    return cloud.points.numpy(), cloud.normals.numpy(), to_uint8(cloud.colours)
