"""The configuration of a run: what is asked for, as YAML or JSON, checked before anything starts.

Defaults are the small size that runs on two CPU cores; paper values are in the descriptions.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, PositiveFloat, PositiveInt, ValidationError

from schemas.errors import ConfigError

NonNegativeFloat = Annotated[FiniteFloat, Field(ge=0)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)


class IngestConfig(_Model):
    """Reading the photos."""

    downscale: Annotated[FiniteFloat, Field(ge=1)] = 1
    """Divide width and height by this."""
    max_pixels: PositiveInt = 100_000_000
    """Refuse larger source images, in pixels."""


class PosesConfig(_Model):
    """Estimating cameras, where the source has none."""

    max_features: PositiveInt = 4000
    """Image features extracted per photo at most."""
    camera_model: Literal["SIMPLE_RADIAL", "OPENCV", "SIMPLE_PINHOLE", "PINHOLE"] = "SIMPLE_RADIAL"
    """COLMAP's camera model. Photos of equal size share one camera."""
    min_registered: Annotated[float, Field(gt=0, le=1)] = 0.5
    """Fail if a smaller share of the photos could be placed."""
    normalize: bool = True
    """Move and scale the scene so that what the cameras look at is at the origin, at mean distance about 1."""


class PlanConfig(_Model):
    """The cameras to generate (paper, section 3.2 and appendix)."""

    trajectory: str = "auto"
    """`auto`, or the name of a recipe: spiral, orbit, realestate10k, llff, dtu, co3d, mipnerf360."""
    views: PositiveInt | None = None
    """Number of generated views; None is the recipe's own (paper: 80 to 960)."""
    group_size: PositiveInt | None = None
    """Views sampled together; None: 5 with several captures, 7 with one, as in the paper."""
    condition_views: PositiveInt | None = None
    """Conditioning views per group; None: 3 with several captures, 1 with one."""
    anchors: PositiveInt = 7
    """Anchor views sampled first when there is a single capture."""
    always_captured: bool = False
    """Keep every captured view among the conditioning views of each group."""
    wide: bool = False
    """Add the wide samples from padded squares for photos that aren't square."""


class SampleConfig(_Model):
    """Sampling views from the diffusion model (paper, section 3.1)."""

    checkpoint: Path | None = None
    """Weights of the model; None: the ones shipped."""
    steps: PositiveInt = 50
    """Sampler steps (paper: 50, DDIM)."""
    solver: str = "ddim"
    """Name of the solver."""
    guidance: NonNegativeFloat = 3.0
    """Classifier-free guidance weight."""
    guidance_interval: tuple[NonNegativeFloat, NonNegativeFloat] = (0.0, 1.0)
    """Part of the diffusion time in which guidance is on, from 0 (data) to 1 (noise)."""
    batch_groups: PositiveInt | None = None
    """Groups sampled at once; None: as many as memory holds. Never changes the result."""


class ReconstructConfig(_Model):
    """Fitting the field (paper, section 3.3)."""

    preset: Literal["tiny", "fast", "balanced", "paper"] = "fast"
    """Point on the measured front of quality against time."""
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

    method: Literal["zipnerf", "cat3d"] = "zipnerf"
    """`zipnerf` fits the captured views alone; `cat3d` generates views first."""
    split: Annotated[str, Field(coerce_numbers_to_str=True)] = "all"
    """Captured views to train on: a count (1, 3, 6, 9), `all`, or the name of a split of the data set."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """All randomness follows from this, the scene and the view."""
    ingest: IngestConfig = Field(default_factory=IngestConfig)
    poses: PosesConfig = Field(default_factory=PosesConfig)
    plan: PlanConfig = Field(default_factory=PlanConfig)
    sample: SampleConfig = Field(default_factory=SampleConfig)
    reconstruct: ReconstructConfig = Field(default_factory=ReconstructConfig)
    render: RenderConfig = Field(default_factory=RenderConfig)
    evaluate: EvaluateConfig = Field(default_factory=EvaluateConfig)


class SceneSource(_Model):
    """One scene of a sweep."""

    source: str
    """Folder of the scene or a procedural spec; $VARIABLES are replaced from the environment."""
    reader: str = "auto"
    image_folder: str | None = None
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
    workers: PositiveInt = 1
    """Scenes worked on at the same time."""


def merged(*documents: dict[str, Any]) -> dict[str, Any]:
    """Nested settings, later documents over earlier ones."""
    out: dict[str, Any] = {}
    for document in documents:
        for name, value in document.items():
            both = isinstance(value, dict) and isinstance(out.get(name), dict)
            out[name] = merged(out[name], value) if both else value
    return out


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
        document = json.loads(text) if path.suffix == ".json" else yaml.load(text, _UniqueKeys)
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
    message = error["msg"][0].lower() + error["msg"][1:]
    return f"{source}: {field} is {error['input']!r}, but {message}."


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
