"""The layout of a scene store: every array it may hold, what it means, how it is stored and which stage writes it.

    scene.zarr/  captured/  latents/  stages/<stage>/
                 runs/<run>/  plan/  hints/  generated/  field/  renders/<kind>/  stages/<stage>/

Every array carries the names of its dimensions, its unit and its meaning, so that xarray opens each section as a
dataset and the whole store as a tree.
Cameras are OpenCV (x right, y down, z forward); K in pixels of the stored image; pixel centres at integer + 0.5.
"""

from __future__ import annotations

from dataclasses import dataclass
from fnmatch import fnmatchcase

FORMAT = "cat3d-scene"
SCHEMA_VERSION = 2
#: Stores from this version on are read as they are; opening one for writing brings it up to date.
OLDEST_READABLE = 1


@dataclass(frozen=True)
class Dim:
    """One dimension: its name as xarray shows it, and its size where the layout fixes it."""

    name: str
    size: int | None = None


# Dimensions that are counted. Each has a name of its own, so that a section and the sections below it can be opened
# together (xarray wants equal sizes for equal names).
VIEW, PLANNED, RENDERED = Dim("view"), Dim("planned_view"), Dim("rendered_view")
CONDITION, GROUP, SLOT, POINT = Dim("condition"), Dim("group"), Dim("slot"), Dim("point")
Y, X, CHANNEL, LATENT_Y, LATENT_X = Dim("y"), Dim("x"), Dim("latent_channel"), Dim("latent_y"), Dim("latent_x")
# Dimensions of a fixed size: what each index means stands in the meaning of the array.
RGB, XYZ, WH, WINDOW = Dim("rgb", 3), Dim("xyz", 3), Dim("wh", 2), Dim("xywh", 4)
BOUND, BYTE = Dim("bound", 2), Dim("byte", 32)
K_ROW, K_COLUMN, ROW, COLUMN = Dim("k_row", 3), Dim("k_column", 3), Dim("row", 4), Dim("column", 4)


@dataclass(frozen=True)
class ArraySpec:
    """One array of the layout.

    kind: how it is stored (`schemas/arrays.py`). dims: None where the shape is free. unit: "1" for plain numbers, ""
    for text. done: the array of 32-byte content keys that says which views are there. coordinate: the array labels the
    entries of its section, and xarray lists it among the coordinates.
    """

    path: str
    kind: str
    dtype: str
    dims: tuple[Dim, ...] | None
    stage: str | None
    unit: str
    meaning: str
    done: str | None = None
    coordinate: bool = False

    def fits(self, shape: tuple[int, ...]) -> bool:
        """Whether an array of this shape has the dimensions of the layout."""
        if self.dims is None:
            return True
        return len(shape) == len(self.dims) and all(d.size in (None, n) for d, n in zip(self.dims, shape))

    @property
    def section(self) -> str:
        """Path pattern of the section it is in."""
        return self.path.rpartition("/")[0]


def _marker(path: str, view: Dim, stage: str, note: str = "") -> ArraySpec:
    return ArraySpec(path, "key", "uint8", (view, BYTE), stage, "1", f"content key of each view, 0 = not done{note}")


def _cameras(section: str, view: Dim, stage: str, first: str | None = None) -> tuple[ArraySpec, ...]:
    """The arrays that hold the cameras of a section's views, but for their sizes. first: the stage that writes K before
    `stage` does, where it is given: that one has to be done again for a damaged K."""
    return (
        ArraySpec(f"{section}/intrinsics", "small", "float64", (view, K_ROW, K_COLUMN), first or stage, "px", "K"),
        ArraySpec(
            f"{section}/world_from_camera",
            "small",
            "float64",
            (view, ROW, COLUMN),
            stage,
            "scene unit",
            "camera to scene frame; the similarity to the data set's world is an attribute of captured",
        ),
    )


_LATENT = (CHANNEL, LATENT_Y, LATENT_X)
_PLAN, _HINTS, _GENERATED, _RENDERS = "runs/*/plan", "runs/*/hints", "runs/*/generated", "runs/*/renders/*"
_DONE_RENDER = f"{_RENDERS}/done"

# fmt: off
LAYOUT: tuple[ArraySpec, ...] = (
    ArraySpec("captured/image", "image", "uint8", (VIEW, Y, X, RGB), "ingest", "sRGB, 0 to 255",
              "undistorted, padded with zeros on the right and below to the largest view; see size"),
    ArraySpec("captured/mask", "mask", "uint8", (VIEW, Y, X), "ingest", "1",
              "255 where the pixel counts, padded with 0"),
    ArraySpec("captured/size", "small", "int32", (VIEW, WH), "ingest", "px", "[width, height] of each view"),
    ArraySpec("captured/name", "small", "str", (VIEW,), "ingest", "", "source name, unique in the scene",
              coordinate=True),
    ArraySpec("captured/source_sha256", "small", "str", (VIEW,), "ingest", "",
              "sha256 of the source file, hexadecimal"),
    *_cameras("captured", VIEW, "poses", "ingest"),
    ArraySpec("captured/registered", "small", "bool", (VIEW,), "poses", "1", "whether the view's pose is known"),
    ArraySpec("captured/points", "parameter", "float32", (POINT, XYZ), "poses", "scene unit",
              "sparse points, scene frame"),
    ArraySpec("captured/depth_bounds", "small", "float64", (VIEW, BOUND), "poses", "scene unit", "[near, far] along z"),
    ArraySpec("latents/captured", "latent", "float16", (VIEW, *_LATENT), "encode", "1", "encoded captured views",
              done="latents/done_captured"),
    _marker("latents/done_captured", VIEW, "encode"),
    ArraySpec("latents/captured_wide", "latent", "float16", (VIEW, *_LATENT), "encode", "1",
              "the same of the views padded to squares, where wide samples are asked for",
              done="latents/done_captured_wide"),
    _marker("latents/done_captured_wide", VIEW, "encode"),
    ArraySpec("runs/*/role", "small", "uint8", (VIEW,), None, "1", "role of each captured view, see ROLES",
              coordinate=True),
    *_cameras(_PLAN, PLANNED, "plan"),
    ArraySpec(f"{_PLAN}/size", "small", "int32", (PLANNED, WH), "plan", "px", "[width, height]"),
    ArraySpec(f"{_PLAN}/anchor", "small", "bool", (PLANNED,), "plan", "1", "sampled first and conditioned upon",
              coordinate=True),
    ArraySpec(f"{_PLAN}/condition", "small", "int32", (PLANNED, CONDITION), "plan", "1",
              "conditioning views: -1 none, below V captured view, V + n the planned view n (an anchor)"),
    ArraySpec(f"{_PLAN}/path", "small", "int32", (PLANNED,), "plan", "1", "path of the trajectory the view is on"),
    ArraySpec(f"{_PLAN}/sample_kind", "small", "uint8", (PLANNED,), "plan", "1",
              "0 square, 1 wide (padded to a square)"),
    ArraySpec(f"{_PLAN}/window", "small", "int32", (PLANNED, WINDOW), "plan", "px",
              "[x0, y0, width, height] of the sample that shows the scene and not its padding"),
    ArraySpec(f"{_PLAN}/group_views", "small", "int32", (GROUP, SLOT), "plan", "1",
              "views of each group in order, -1 beyond them; repeats where an older plan has group_valid"),
    ArraySpec(f"{_HINTS}/colour", "image", "uint8", (PLANNED, Y, X, RGB), "match", "sRGB, 0 to 255",
              "what the photos show of the planned view, mended where they show nothing", done=f"{_HINTS}/done"),
    ArraySpec(f"{_HINTS}/confidence", "depth", "float16", (PLANNED, Y, X), "match", "1",
              "trust in the colour, 0 to 1", done=f"{_HINTS}/done"),
    ArraySpec(f"{_HINTS}/inverse_depth", "depth", "float16", (PLANNED, Y, X), "match", "1 / scene unit",
              "expected inverse z depth, 0 = infinitely far", done=f"{_HINTS}/done"),
    ArraySpec(f"{_HINTS}/spread", "depth", "float16", (PLANNED, Y, X), "match", "1 / scene unit",
              "standard deviation of the inverse depth", done=f"{_HINTS}/done"),
    ArraySpec(f"{_HINTS}/seen", "depth", "float16", (PLANNED, Y, X), "match", "1",
              "probability that the place lies inside some photo", done=f"{_HINTS}/done"),
    _marker(f"{_HINTS}/done", PLANNED, "match"),
    ArraySpec(f"{_HINTS}/explained", "small", "bool", (PLANNED,), "match", "1",
              "the photos show the whole view, so that it need not be sampled"),
    ArraySpec(f"{_GENERATED}/latent", "latent", "float16", (PLANNED, *_LATENT), "sample", "1", "sampled latents",
              done=f"{_GENERATED}/done_latent"),
    _marker(f"{_GENERATED}/done_latent", PLANNED, "sample"),
    ArraySpec(f"{_GENERATED}/image", "image", "uint8", (PLANNED, Y, X, RGB), "decode", "sRGB, 0 to 255",
              "decoded latents", done=f"{_GENERATED}/done_image"),
    ArraySpec(f"{_GENERATED}/confidence", "depth", "float16", (PLANNED, Y, X), "decode", "1",
              "trust in the image, 0 to 1: the weight of its pixels in the reconstruction",
              done=f"{_GENERATED}/done_image"),
    _marker(f"{_GENERATED}/done_image", PLANNED, "decode", "; a view that is left out on purpose is written as 0"),
    ArraySpec("runs/*/field/*", "parameter", "float32", None, "reconstruct", "1", "field parameters, training record"),
    ArraySpec(f"{_RENDERS}/image", "image", "uint8", (RENDERED, Y, X, RGB), "render", "sRGB, 0 to 255",
              "padded; see size", done=_DONE_RENDER),
    ArraySpec(f"{_RENDERS}/depth", "depth", "float32", (RENDERED, Y, X), "render", "scene unit", "z depth, padded",
              done=_DONE_RENDER),
    ArraySpec(f"{_RENDERS}/opacity", "depth", "float32", (RENDERED, Y, X), "render", "1", "0 to 1, padded",
              done=_DONE_RENDER),
    _marker(_DONE_RENDER, RENDERED, "render"),
    ArraySpec(f"{_RENDERS}/size", "small", "int32", (RENDERED, WH), "render", "px", "[width, height]"),
    ArraySpec(f"{_RENDERS}/view", "small", "int32", (RENDERED,), "render", "1",
              "captured view, or index along the path", coordinate=True),
    *_cameras(_RENDERS, RENDERED, "render"),
)
# fmt: on

#: Stages done once for a scene: they write outside of runs. The others are done once for each run.
SCENE_STAGES = {spec.stage for spec in LAYOUT if spec.stage and not spec.path.startswith("runs/")}

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


def describe(path: str, shape: tuple[int, ...]) -> tuple[list[str], dict[str, str]]:
    """(dimension names, attributes) that are stored with the array at `path`, known to the layout or not.

    The attributes follow the CF conventions, which xarray reads: `units`, `long_name`, `coordinates`.
    """
    spec = array_spec(path)
    if spec is None:
        return _free_names(path, shape), {}
    attributes = {"long_name": spec.meaning} | ({"units": spec.unit} if spec.unit else {})
    labels = [other.path.rpartition("/")[2] for other in LAYOUT if other.coordinate and other.section == spec.section]
    if labels:
        attributes["coordinates"] = " ".join(labels)
    fixed = spec.dims is not None and spec.fits(shape)
    return [d.name for d in spec.dims or ()] if fixed else _free_names(path, shape), attributes


def _free_names(path: str, shape: tuple[int, ...]) -> list[str]:
    """Names for the dimensions of an array of free shape, equal to no other array's."""
    return [f"{path.rpartition('/')[2]}_{axis}" for axis in range(len(shape))]


def done_path(path: str) -> str | None:
    """Path of the array of content keys that goes with the array at `path`, if it has one."""
    spec = array_spec(path)
    if spec is None or spec.done is None:
        return None
    return "/".join((*path.split("/")[:-1], spec.done.split("/")[-1]))


def markers(stage: str) -> list[str]:
    """Paths, as in the layout, of the arrays of content keys that say which views of a stage are done."""
    return [spec.path for spec in LAYOUT if spec.stage == stage and spec.kind == "key"]
