"""The README's strip of pictures: photos, plan, generated views, render and depth, mesh of one finished run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image

from cat3d_core.reconstruction import surface_depth
from flows.exports.mesh import Mesh, fuse, import_open3d, without_crumbs
from flows.exports.source import Source, open_source, render_views, surface_cameras
from flows.jobs.access import read_cameras, views_with_role
from flows.media.images import to_uint8
from flows.media.pictures import depth_picture

SIDE, GAP = 192, 6
MOST_BYTES = 300_000
#: Cube around what the cameras look at that the mesh covers (units of the mean distance), and voxels along it.
RADIUS, VOXELS = 1.0, 160


def write_strip(store: Path, run: str, folder: Path) -> list[Path]:
    """Write strip_1_photos.png to strip_5_mesh.png of the run into the folder; returns them.

    Raises InputError for a run that is not finished, StoreError for a damaged store.
    """
    source = open_source(store, run, "scene")
    pictures = {
        "1_photos": _photos(source),
        "2_plan": _plan(store, run),
        "3_generated": _generated(source),
        "4_render": _render(source),
        "5_mesh": _mesh(source),
    }
    out = []
    for name, picture in pictures.items():
        out.append(folder / f"strip_{name}.png")
        save(picture, out[-1])
    return out


def save(picture: np.ndarray, path: Path) -> None:
    """Write a PNG (uint8 RGB), with 256 colours where it would be larger than a page should load."""
    image = Image.fromarray(picture)
    image.save(path, optimize=True)
    if path.stat().st_size > MOST_BYTES:
        image.quantize(256, dither=Image.Dither.NONE, kmeans=3).save(path, optimize=True)


def tile(images: list[np.ndarray], columns: int, side: int = SIDE) -> np.ndarray:
    """Images (uint8 RGB) brought to squares of `side` pixels, in rows of `columns`, white between."""
    rows = -(-len(images) // columns)
    sheet = np.full((rows * side + (rows - 1) * GAP, columns * side + (columns - 1) * GAP, 3), 255, np.uint8)
    for i, image in enumerate(images):
        y, x = i // columns * (side + GAP), i % columns * (side + GAP)
        sheet[y : y + side, x : x + side] = np.asarray(
            Image.fromarray(image).resize((side, side), Image.Resampling.LANCZOS)
        )
    return sheet


def _photos(source: Source) -> np.ndarray:
    views = views_with_role(source.store, source.run, "train")[:3]
    return tile([source.store.captured.read_image("image", int(v)) for v in views], 3)


def _plan(store: Path, run: str) -> np.ndarray:
    """The left half of plan.png: the cameras from above."""
    picture = Image.open(store.parent / store.stem / run / "plan.png").convert("RGB")
    picture = picture.crop((0, round(0.1 * picture.height), round(0.46 * picture.width), picture.height))
    width = 2 * SIDE
    return np.asarray(picture.resize((width, round(picture.height * width / picture.width)), Image.Resampling.LANCZOS))


def _generated(source: Source) -> np.ndarray:
    section = source.run.generated
    count = len(section.read("done_image"))
    views = np.linspace(0, count - 1, 6).round().astype(int)
    return tile(list(section.read("image")[views]), 3)


def _render(source: Source) -> np.ndarray:
    """Two held-out views: the photo that was held out, the render, the depth."""
    section = source.run.renders("test")
    shown = []
    views = section.read("view")
    for i in np.linspace(0, len(views) - 1, 2).round().astype(int).tolist():
        truth = source.store.captured.read_image("image", int(views[i]))
        shown += [truth, section.read_image("image", i), depth_picture(section.read_image("depth", i))]
    return tile(shown, 3)


def _mesh(source: Source) -> np.ndarray:
    """The mesh in its colours and in grey, seen by a camera of the run's test views."""
    cameras = surface_cameras(source, 40)
    renders = render_views(source, cameras, 0.5)
    shown = {"max_depth": float("inf"), "max_radius": RADIUS}
    surfaces = ((surface_depth(r, cameras, i, **shown), r.image) for i, r in enumerate(renders))
    mesh = without_crumbs(fuse(surfaces, cameras, 2 * RADIUS / VOXELS))
    camera = read_cameras(source.run.renders("test"))[:1].to(dtype=torch.float64).resize(2 * SIDE, 2 * SIDE)
    colour, grey = (picture_of(mesh, camera, coloured) for coloured in (True, False))
    return tile([colour, grey], 2, int(1.5 * SIDE))


def picture_of(mesh: Mesh, camera, coloured: bool) -> np.ndarray:  # type: ignore[no-untyped-def]
    """(H, W, 3) uint8 of the mesh, by casting one ray a pixel; a lamp stands at the camera."""
    from cat3d_core.rays import image_rays

    o3d = import_open3d("a picture of the mesh")
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
    rays = image_rays(camera, 0)
    both = torch.cat([rays.origins, rays.directions], -1).float().numpy()
    hit = {name: value.numpy() for name, value in scene.cast_rays(o3d.core.Tensor(both)).items()}
    seen = np.isfinite(hit["t_hit"])
    toward = both[:, 3:] / np.linalg.norm(both[:, 3:], axis=-1, keepdims=True)
    light = np.abs((hit["primitive_normals"] * toward).sum(-1, keepdims=True))
    faces = mesh.faces[np.where(seen, hit["primitive_ids"], 0)]
    u, v = hit["primitive_uvs"][:, :1], hit["primitive_uvs"][:, 1:]
    corners = mesh.colours[faces].astype(np.float32) / 255
    colour = corners[:, 0] * (1 - u - v) + corners[:, 1] * u + corners[:, 2] * v
    shade = colour if coloured else 0.25 + 0.7 * np.repeat(light, 3, -1)
    width, height = camera.size[0].tolist()
    return to_uint8(torch.from_numpy(np.where(seen[:, None], shade, 1.0)).reshape(height, width, 3))
