"""The configuration of a run: what is asked for, as YAML or JSON, checked before anything starts.

Defaults are the small size that runs on two CPU cores; paper values are in the descriptions.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import (
    BaseModel,
    Field,
    FiniteFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    ValidationError,
    model_validator,
)

from schemas.errors import ConfigError
from schemas.execution import ExecutionConfig
from schemas.hints import HintsConfig
from schemas.settings import merged, shortened, spelled_out
from schemas.skip import SkipConfig
from schemas.strict import StrictModel as _Model

NonNegativeFloat = Annotated[FiniteFloat, Field(ge=0)]


class IngestConfig(_Model):
    """Reading the photos."""

    downscale: Annotated[FiniteFloat, Field(ge=1)] | None = None
    """Divide width and height by this; None: as the preset and the device's memory suggest, small photos by 1."""
    max_pixels: PositiveInt = 100_000_000
    """Refuse larger source images, in pixels."""
    frames: Annotated[int, Field(ge=2)] = 60
    """Frames taken of a video: the sharpest of each of as many equal stretches."""
    check_cameras: bool = True
    """Compare given cameras with matches between the photos, and warn of views that they do not fit."""


class PosesConfig(_Model):
    """Estimating cameras, where the source has none."""

    estimate: Literal["missing", "always"] = "missing"
    """`missing`: skipped where the source has cameras; `always`: also there."""
    max_features: PositiveInt = 4000
    """Image features extracted per photo at most."""
    camera_model: Literal["SIMPLE_RADIAL", "OPENCV", "SIMPLE_PINHOLE", "PINHOLE"] = "SIMPLE_RADIAL"
    """COLMAP's camera model. Photos of equal size share one camera."""
    min_registered: Annotated[float, Field(gt=0, le=1)] = 0.5
    """Fail if a smaller share of the photos could be placed."""
    normalize: bool = True
    """Move and scale the scene so that what the cameras look at is at the origin, at mean distance about 1."""


class PlanConfig(_Model):
    """The cameras to generate (paper, section 3.2 and appendix). None: as the paper does for this number of photos."""

    trajectory: str = "auto"
    """`auto`, or the name of a recipe: single_spiral, single_orbit, realestate10k, llff, dtu, co3d, mipnerf360."""
    views: PositiveInt | None = None
    """Number of generated views; None is the recipe's own (paper: 80 to 960)."""
    scales: tuple[PositiveFloat, ...] | None = None
    """Scales of the paths instead of the recipe's; one path for each combination with the shifts."""
    sides: tuple[FiniteFloat, ...] | None = None
    """Shifts of the paths to the right, in units of the scene's distance."""
    heights: tuple[FiniteFloat, ...] | None = None
    """Shifts upwards."""
    forwards: tuple[FiniteFloat, ...] | None = None
    """Shifts ahead."""
    group_size: PositiveInt | None = None
    """Views sampled together; None: the model's views (8) less condition_views, and 7 for the anchors of one photo."""
    condition_views: PositiveInt | None = None
    """Conditioning views per group; None: 3."""
    anchors: NonNegativeInt | None = None
    """Anchor views sampled first; None: 7 with a single photo, else none."""
    always_captured: bool = False
    """Captured views take conditioning slots before anchors do."""
    image_size: PositiveInt | None = None
    """Side of the planned views in pixels; None: the generator's. SEVA takes multiples of 64, other programs any."""
    window: Annotated[int, Field(ge=4)] | None = None
    """Views that SEVA makes and is given at once; None: as many as it was trained on, 21. Fewer need less memory."""
    wide: bool = False
    """Add the wide samples from padded squares for photos that aren't square."""


class SampleConfig(_Model):
    """Sampling views from the diffusion model (paper, section 3.1).

    solver, nodes, steps, guidance: None takes what the model's file recommends, else the point on the measured front:
    unipc, log_snr, 10 steps, guidance 3."""

    generator: str | None = None
    """Generator: "cat3d", "seva", or that of an installed package; None: the one that recognises the checkpoint."""
    checkpoint: Path | None = None
    """File or folder with the generator's weights; None: the ones shipped."""
    solver: str | None = None
    """Solver of the probability-flow ODE (paper: ddim): ddim, dpm++, unipc, or a further one of the core's SOLVERS."""
    nodes: Literal["trailing", "linspace", "log_snr", "karras"] | None = None
    """Spacing of the noise levels (paper: trailing)."""
    steps: Annotated[int, Field(ge=1)] | None = None
    """Sampler steps (paper: 50)."""
    guidance: NonNegativeFloat | None = None
    """Classifier-free guidance weight."""
    guidance_log_snr: tuple[FiniteFloat | None, FiniteFloat | None] | None = None
    """Lowest and highest log-SNR with guidance, under `skip.guidance`; a bound of None: none. None: up to 2."""
    start: Literal["noise", "hint"] = "noise"
    """From noise (paper) or, for models that take hints, later, from what the photos show of the view."""
    precision: Literal["float32", "bfloat16", "float16"] = "float32"
    """Of the network; the sampler's state is float32 always. bfloat16 and float16 are for GPUs."""


class ReconstructConfig(_Model):
    """Fitting the field (paper, section 3.3)."""

    method: str = "zipnerf"
    """Name of the reconstructor: zipnerf, splats, or that of an installed package."""
    preset: str = "fast"
    """Point on the measured front of quality against time; zipnerf and splats have tiny, fast, balanced and paper."""
    overrides: dict[str, Any] = Field(default_factory=dict)
    """Settings of the trainer that replace the preset's."""


class RenderConfig(_Model):
    """What is rendered."""

    test_views: bool = True
    """Render the held-out captured views."""
    path: Literal["none", "auto"] = "auto"
    """Camera path of the video; auto: the curve of the recipe that suits the training views."""
    path_views: PositiveInt = 60
    """Frames of the video."""
    fps: PositiveFloat = 30.0
    """Frames per second of the video."""


class EvaluateConfig(_Model):
    """How renders are compared with held-out photos."""

    protocols: tuple[str, ...] = ("google",)
    """Metric protocols: google, regnerf, freenerf, 3dgs, nerfbaselines."""
    lpips: bool = True
    """Compute LPIPS, where weights are there."""


class RunConfig(_Model):
    """One run of one scene."""

    generate: Literal["auto", "always", "never"] = "auto"
    """Whether views are generated before the reconstruction; `auto`: for a single photo. `method: zipnerf` is short for
    never, `method: cat3d` for always."""
    label: Annotated[str, Field(pattern=r"^[A-Za-z0-9._-]{1,40}$")] | None = None
    """Name of the variant in run names and tables; None: cat3d where views are generated, else the reconstructor's."""
    split: Annotated[str, Field(coerce_numbers_to_str=True)] = "all"
    """Captured views to train on: a count (1, 3, 6, 9), `all`, or the name of a split of the data set."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """All randomness follows from this, the scene and the view."""
    ingest: IngestConfig = Field(default_factory=IngestConfig)
    poses: PosesConfig = Field(default_factory=PosesConfig)
    plan: PlanConfig = Field(default_factory=PlanConfig)
    hints: HintsConfig = Field(default_factory=HintsConfig)
    sample: SampleConfig = Field(default_factory=SampleConfig)
    reconstruct: ReconstructConfig = Field(default_factory=ReconstructConfig)
    render: RenderConfig = Field(default_factory=RenderConfig)
    evaluate: EvaluateConfig = Field(default_factory=EvaluateConfig)
    skip: SkipConfig = Field(default_factory=SkipConfig)
    execution: ExecutionConfig = Field(default_factory=ExecutionConfig)

    @model_validator(mode="before")
    @classmethod
    def _short_name(cls, value: Any) -> Any:
        return spelled_out(value) if isinstance(value, dict) else value


class SceneSource(_Model):
    """One scene of a sweep."""

    source: str
    """Folder of the scene, a pattern of such folders (data/*), or a procedural spec; $VARIABLES are replaced from the
    environment."""
    reader: str = "auto"
    image_folder: str | None = None
    obtain: str = ""
    """A sentence on where the data can be had, said where it is missing."""
    settings: dict[str, Any] = Field(default_factory=dict)
    """Settings of RunConfig for this scene alone, such as {ingest: {downscale: 8}}."""


class SweepConfig(_Model):
    """A benchmark sweep: scenes x splits x methods x seeds."""

    name: str
    note: str = ""
    """What the numbers stand for, printed in the report."""
    scenes: tuple[SceneSource, ...]
    splits: tuple[str, ...] = ("3", "6", "9")
    """Training views: counts, `all`, or names of splits. A scene without one of them leaves it out."""
    methods: dict[str, dict[str, Any]] = Field(default_factory=lambda: {"zipnerf": {"method": "zipnerf"}})
    """Label -> settings of RunConfig that make the method or the ablation."""
    seeds: tuple[Annotated[int, Field(ge=0)], ...] = (0,)
    base: dict[str, Any] = Field(default_factory=dict)
    """Settings of RunConfig for all runs."""

    @model_validator(mode="before")
    @classmethod
    def _workers(cls, value: Any) -> Any:
        """`workers: N` is short for `base: {execution: {workers: N}}`."""
        if not isinstance(value, dict) or "workers" not in value:
            return value
        rest = {name: given for name, given in value.items() if name != "workers"}
        base = rest.get("base") or {}
        return rest | {"base": merged({"execution": {"workers": value["workers"]}}, base)}


def load_config(path: str | Path, model: type[BaseModel] = RunConfig) -> Any:
    """The configuration in a YAML or JSON file. Raises ConfigError naming the file and the fields."""
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise ConfigError(f"{path} is not text in UTF-8.") from None
    except OSError as error:
        raise ConfigError(f"{path} can't be read: {error.strerror}.") from None
    try:
        document = json.loads(text) if path.suffix == ".json" else yaml.load(text, _UniqueKeys)  # nosec B506
    except (ValueError, yaml.YAMLError, RecursionError) as error:
        kind = "JSON" if path.suffix == ".json" else "YAML"
        raise ConfigError(f"{path} is not valid {kind}: {' '.join(str(error).split())}.") from None
    return parse_config({} if document is None else document, str(path), model)


def parse_config(document: Any, source: str, model: type[BaseModel] = RunConfig) -> Any:
    """`document` as a configuration; `source` is named in the ConfigError that lists every bad field."""
    if not isinstance(document, dict):
        raise ConfigError(f"{source} should hold fields and values, not {type(document).__name__}.")
    try:
        return model.model_validate(document)
    except ValidationError as error:
        raise ConfigError(" ".join(_sentence(source, dict(one), model) for one in error.errors())) from None


def json_schema(model: type[BaseModel] = RunConfig) -> dict[str, Any]:
    """JSON Schema of a configuration, for editors and for other programs."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **model.model_json_schema()}


def _sentence(source: str, error: dict[str, Any], model: type[BaseModel]) -> str:
    field = ".".join(str(part) for part in error["loc"])
    if error["type"] == "extra_forbidden":
        return f"{source}: {field} is not a setting; {_known(error['loc'], model)}."
    if error["type"] == "missing":
        return f"{source}: {field} is missing."
    if isinstance(cause := error.get("ctx", {}).get("error"), ConfigError):
        return f"{source}: {cause}"
    message = error["msg"][0].lower() + error["msg"][1:]
    return f"{source}: {field} is {shortened(error['input'])}, but {message}."


def _known(location: tuple[Any, ...], model: type[BaseModel]) -> str:
    for part in location[:-1]:
        inner = model.model_fields[part].annotation if part in model.model_fields else None
        if not (isinstance(inner, type) and issubclass(inner, BaseModel)):
            return "remove it"
        model = inner
    return f"the settings here are {', '.join(model.model_fields)}"


class _UniqueKeys(yaml.SafeLoader):
    """YAML without pickles and without a key given twice, of which plain YAML silently keeps the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]  # type: ignore[no-untyped-call]
        for key in keys:
            if keys.count(key) > 1:
                raise yaml.constructor.ConstructorError(None, None, f"the key {key!r} is given twice", node.start_mark)
        return super().construct_mapping(node, deep)
