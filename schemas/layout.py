"""The layout of a scene store: every array it may hold, what it means, how it is stored and which stage writes it.

    scene.zarr/  captured/  latents/  stages/<stage>/
                 runs/<run>/  plan/  generated/  field/  renders/<kind>/  stages/<stage>/

V captured views, N planned views in G groups of up to S, R rendered views, M conditioning views, P points,
C latent channels.
Cameras are OpenCV (x right, y down, z forward); K in pixels of the stored image; pixel centres at integer + 0.5.
"""

from __future__ import annotations

from dataclasses import dataclass
from fnmatch import fnmatchcase

FORMAT = "cat3d-scene"
SCHEMA_VERSION = 1

#: Stages in the order they run, each with the stages whose results it reads.
STAGES: dict[str, tuple[str, ...]] = {
    "ingest": (),
    "poses": ("ingest",),
    "plan": ("poses",),
    "encode": ("poses",),
    "sample": ("plan", "encode"),
    "decode": ("sample",),
    "reconstruct": ("poses", "decode"),
    "render": ("reconstruct",),
    "evaluate": ("render",),
}
#: Stages done once for a scene; the others are done once for each run.
SCENE_STAGES = ("ingest", "poses", "encode")

Dim = str | int


@dataclass(frozen=True)
class ArraySpec:
    """One array of the layout. `done` names the array of 32-byte content keys that says which views are there."""

    path: str
    kind: str
    dtype: str
    dims: tuple[Dim, ...] | None
    stage: str | None
    meaning: str
    done: str | None = None

    def fits(self, shape: tuple[int, ...]) -> bool:
        """Whether an array of this shape has the dimensions of the layout."""
        if self.dims is None:
            return True
        return len(shape) == len(self.dims) and all(isinstance(d, str) or d == n for d, n in zip(self.dims, shape))


LAYOUT: tuple[ArraySpec, ...] = (
    ArraySpec(
        "captured/image",
        "image",
        "uint8",
        ("V", "H", "W", 3),
        "ingest",
        "sRGB, undistorted, padded with zeros on the right and below to the largest view; see size",
    ),
    ArraySpec("captured/mask", "mask", "uint8", ("V", "H", "W"), "ingest", "255 where the pixel counts, padded with 0"),
    ArraySpec("captured/size", "small", "int32", ("V", 2), "ingest", "[width, height] of each view in pixels"),
    ArraySpec("captured/name", "small", "str", ("V",), "ingest", "source name, unique in the scene"),
    ArraySpec("captured/source_sha256", "small", "str", ("V",), "ingest", "sha256 of the source file, hexadecimal"),
    ArraySpec("captured/intrinsics", "small", "float64", ("V", 3, 3), "poses", "K in pixels"),
    ArraySpec("captured/world_from_camera", "small", "float64", ("V", 4, 4), "poses", "scene frame, after similarity"),
    ArraySpec("captured/points", "parameter", "float32", ("P", 3), "poses", "sparse points, scene frame"),
    ArraySpec("captured/depth_bounds", "small", "float64", ("V", 2), "poses", "[near, far] along z, scene units"),
    ArraySpec(
        "latents/captured",
        "latent",
        "float16",
        ("V", "C", "h", "w"),
        "encode",
        "encoded captured views",
        done="latents/done_captured",
    ),
    ArraySpec("latents/done_captured", "key", "uint8", ("V", 32), "encode", "content key of each latent, 0 = not done"),
    ArraySpec(
        "latents/captured_wide",
        "latent",
        "float16",
        ("V", "C", "h", "w"),
        "encode",
        "the same of the views padded to squares, where wide samples are asked for",
        done="latents/done_captured_wide",
    ),
    ArraySpec("latents/done_captured_wide", "key", "uint8", ("V", 32), "encode", "content key, 0 = not done"),
    ArraySpec("runs/*/role", "small", "uint8", ("V",), None, "role of each captured view, see ROLES"),
    ArraySpec("runs/*/plan/world_from_camera", "small", "float64", ("N", 4, 4), "plan", "scene frame"),
    ArraySpec("runs/*/plan/intrinsics", "small", "float64", ("N", 3, 3), "plan", "K in pixels"),
    ArraySpec("runs/*/plan/size", "small", "int32", ("N", 2), "plan", "[width, height] in pixels"),
    ArraySpec("runs/*/plan/group", "small", "int32", ("N",), "plan", "group in which the view is sampled"),
    ArraySpec("runs/*/plan/order", "small", "int32", ("N",), "plan", "place in its group"),
    ArraySpec("runs/*/plan/anchor", "small", "bool", ("N",), "plan", "sampled first and conditioned upon"),
    ArraySpec(
        "runs/*/plan/condition",
        "small",
        "int32",
        ("N", "M"),
        "plan",
        "conditioning views: -1 none, below V captured view, V + n the planned view n (an anchor)",
    ),
    ArraySpec("runs/*/plan/path", "small", "int32", ("N",), "plan", "path of the trajectory the view is on"),
    ArraySpec(
        "runs/*/plan/pose",
        "small",
        "int32",
        ("N",),
        "plan",
        "pose of the trajectory: equal for the square and the wide sample of one pose",
    ),
    ArraySpec("runs/*/plan/sample_kind", "small", "uint8", ("N",), "plan", "0 square, 1 wide (padded to a square)"),
    ArraySpec(
        "runs/*/plan/window",
        "small",
        "int32",
        ("N", 4),
        "plan",
        "[x0, y0, width, height] of the sample that shows the scene and not its padding",
    ),
    ArraySpec(
        "runs/*/plan/group_views",
        "small",
        "int32",
        ("G", "S"),
        "plan",
        "views of each group in order, short groups filled with repeats; -1 beyond group_targets",
    ),
    ArraySpec("runs/*/plan/group_valid", "small", "bool", ("G", "S"), "plan", "False for repeats and beyond"),
    ArraySpec("runs/*/plan/group_targets", "small", "int32", ("G",), "plan", "target views the network is given"),
    ArraySpec(
        "runs/*/generated/latent",
        "latent",
        "float16",
        ("N", "C", "h", "w"),
        "sample",
        "sampled latents",
        done="runs/*/generated/done_latent",
    ),
    ArraySpec("runs/*/generated/done_latent", "key", "uint8", ("N", 32), "sample", "content key, 0 = not done"),
    ArraySpec(
        "runs/*/generated/image",
        "image",
        "uint8",
        ("N", "H", "W", 3),
        "decode",
        "decoded latents, sRGB",
        done="runs/*/generated/done_image",
    ),
    ArraySpec(
        "runs/*/generated/done_image",
        "key",
        "uint8",
        ("N", 32),
        "decode",
        "content key, 0 = not done; a view that is left out on purpose is written as 0",
    ),
    ArraySpec("runs/*/field/*", "parameter", "float32", None, "reconstruct", "field parameters and training record"),
    ArraySpec(
        "runs/*/renders/*/image",
        "image",
        "uint8",
        ("R", "H", "W", 3),
        "render",
        "sRGB, padded; see size",
        done="runs/*/renders/*/done",
    ),
    ArraySpec(
        "runs/*/renders/*/depth",
        "depth",
        "float32",
        ("R", "H", "W"),
        "render",
        "z depth, scene units, padded",
        done="runs/*/renders/*/done",
    ),
    ArraySpec(
        "runs/*/renders/*/opacity",
        "depth",
        "float32",
        ("R", "H", "W"),
        "render",
        "0 to 1, padded",
        done="runs/*/renders/*/done",
    ),
    ArraySpec("runs/*/renders/*/done", "key", "uint8", ("R", 32), "render", "content key of each render, 0 = not done"),
    ArraySpec("runs/*/renders/*/size", "small", "int32", ("R", 2), "render", "[width, height] in pixels"),
    ArraySpec("runs/*/renders/*/view", "small", "int32", ("R",), "render", "captured view, or index along the path"),
    ArraySpec("runs/*/renders/*/intrinsics", "small", "float64", ("R", 3, 3), "render", "K in pixels"),
    ArraySpec("runs/*/renders/*/world_from_camera", "small", "float64", ("R", 4, 4), "render", "scene frame"),
)

#: Meaning of `runs/<run>/role`.
ROLES = {"unused": 0, "train": 1, "test": 2}


def array_spec(path: str) -> ArraySpec | None:
    """The entry for the array at `path` (relative to the store), or None if the layout doesn't know it."""
    parts = path.split("/")
    for spec in LAYOUT:
        pattern = spec.path.split("/")
        if len(pattern) == len(parts) and all(map(fnmatchcase, parts, pattern)):
            return spec
    return None


def done_path(path: str) -> str | None:
    """Path of the array of content keys that goes with the array at `path`, if it has one."""
    spec = array_spec(path)
    if spec is None or spec.done is None:
        return None
    return "/".join((*path.split("/")[:-1], spec.done.split("/")[-1]))


def downstream(stage: str) -> tuple[str, ...]:
    """`stage` and every stage that reads its results, directly or not, in the order they run."""
    check_stage(stage)
    affected: set[str] = {stage}
    for name, inputs in STAGES.items():
        if affected.intersection(inputs):
            affected.add(name)
    return tuple(name for name in STAGES if name in affected)


def check_stage(stage: str) -> None:
    """Raises ValueError for a name that is no stage."""
    if stage not in STAGES:
        raise ValueError(f"{stage!r} is not a stage; the stages are {', '.join(STAGES)}.")
