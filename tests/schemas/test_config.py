"""Configuration: defaults, files, and a sentence naming file and field for everything that is wrong."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from schemas.config import RunConfig, json_schema, load_config, parse_config
from schemas.content_key import content_key
from schemas.errors import ConfigError
from schemas.settings import merged


def test_yaml_and_json_say_the_same(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("split: 3\nseed: 7\nplan: {views: 80}\nreconstruct:\n  overrides: {steps: 100}\n")
    document = {"split": "3", "seed": 7, "plan": {"views": 80}, "reconstruct": {"overrides": {"steps": 100}}}
    (tmp_path / "a.json").write_text(json.dumps(document))
    a, b = load_config(tmp_path / "a.yaml"), load_config(tmp_path / "a.json")
    assert a == b
    assert (a.split, a.plan.views, a.plan.trajectory) == ("3", 80, "auto")
    assert content_key(config=a) == content_key(config=b) != content_key(config=RunConfig())
    (tmp_path / "empty.yaml").write_text("# nothing\n")
    assert load_config(tmp_path / "empty.yaml") == RunConfig()


def test_a_config_goes_through_json_and_back() -> None:
    config = RunConfig(generate="always", seed=3)
    assert parse_config(json.loads(config.model_dump_json()), "x") == config


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("plan: {viewz: 3}", "plan.viewz is not a setting; the settings here are trajectory, views"),
        ("viewz: 3", "viewz is not a setting; the settings here are generate, label, split, seed"),
        ("seed: -1", "seed is -1, but input should be greater than or equal to 0"),
        ("seed: 1.5", "seed is 1.5, but input should be a valid integer"),
        ("ingest: {downscale: 0}", "ingest.downscale is 0, but input should be greater than or equal to 1"),
        ("sample: {guidance: .nan}", "sample.guidance is nan, but input should be a finite number"),
        ("render: {path: slow}", "render.path is 'slow', but input should be 'none' or 'auto'"),
        ("plan: 3", "plan is 3, but input should be"),
        ("- 1", "should hold fields and values, not list"),
        ("seed: [1", "is not valid YAML"),
        ("seed: 1\nseed: 2", "the key 'seed' is given twice"),
        ("seed: !!python/object/apply:os.getcwd []", "is not valid YAML"),
        ("[" * 1000, "is not valid YAML"),
    ],
)
def test_what_is_wrong_is_said_with_file_and_field(tmp_path: Path, text: str, sentence: str) -> None:
    path = tmp_path / "run.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as error:
        load_config(path)
    assert str(error.value).startswith(str(path))
    assert sentence in str(error.value)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="run.yaml can't be read: No such file"):
        load_config(tmp_path / "run.yaml")
    (tmp_path / "b.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="not text in UTF-8"):
        load_config(tmp_path / "b.yaml")
    (tmp_path / "c.json").write_text("{'a': 1}")
    with pytest.raises(ConfigError, match="c.json is not valid JSON"):
        load_config(tmp_path / "c.json")


def test_several_errors_are_all_named() -> None:
    with pytest.raises(ConfigError, match="seed is -1.*render.path is 'x'"):
        parse_config({"seed": -1, "render": {"path": "x"}}, "a")


def test_the_json_schema_describes_every_field() -> None:
    schema = json_schema()
    models = [schema, *schema["$defs"].values()]
    assert len(models) == 11
    for model in models:
        assert model["additionalProperties"] is False
        for name, field in model["properties"].items():
            assert "description" in field or "$ref" in field, name


def test_a_short_name_of_earlier_versions_stands_for_what_is_generated() -> None:
    assert RunConfig().generate == "auto"
    assert parse_config({"method": "cat3d"}, "test").generate == "always"
    assert parse_config({"method": "zipnerf"}, "test").generate == "never"
    assert merged({"generate": "never"}, {"method": "cat3d"})["generate"] == "always", "later settings win"
    with pytest.raises(ConfigError, match="run.yaml: method cat3d stands for generate always, but generate is never"):
        parse_config({"method": "cat3d", "generate": "never"}, "run.yaml")
    with pytest.raises(ConfigError, match="run.yaml: method is 'nerf'; it may be auto, zipnerf, cat3d"):
        parse_config({"method": "nerf"}, "run.yaml")
