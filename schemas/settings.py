"""Settings as nested documents: from the command line, joined, read and written by path."""

from __future__ import annotations

from collections.abc import Sequence
from reprlib import Repr
from typing import Any

import yaml

from schemas.errors import ConfigError

#: What the short names `method: NAME` and `--method NAME` say about `generate`.
METHODS = {"auto": "auto", "zipnerf": "never", "cat3d": "always"}


def spelled_out(document: dict[str, Any]) -> dict[str, Any]:
    """Settings with the short name `method`, as files and stores of earlier versions have it, replaced by `generate`.

    Raises ConfigError for an unknown name, and for one that contradicts `generate`.
    """
    if "method" not in document:
        return document
    rest = {name: value for name, value in document.items() if name != "method"}
    name, own = document["method"], document.get("generate")
    if not isinstance(name, str) or name not in METHODS:
        raise ConfigError(f"method is {shortened(name)}; it may be {', '.join(METHODS)}.")
    if own not in (None, METHODS[name]):
        raise ConfigError(
            f"method {name} stands for generate {METHODS[name]}, but generate is {own}: give one of them."
        )
    return rest | {"generate": METHODS[name]}


def shortened(value: Any) -> str:
    """The value as it is written, cut short: a few lines of YAML can stand for any number of them."""
    form = Repr()
    form.maxstring = form.maxother = form.maxlong = 200
    form.maxlevel = 3
    return form.repr(value)


def merged(*documents: dict[str, Any]) -> dict[str, Any]:
    """Nested settings of a run, later documents over earlier ones; `method` is spelled out in each."""
    return _merged(*map(spelled_out, documents))


def _merged(*documents: dict[str, Any]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for document in documents:
        for name, value in document.items():
            both = isinstance(value, dict) and isinstance(out.get(name), dict)
            out[name] = _merged(out[name], value) if both else value
    return out


def settings_document(settings: Sequence[str]) -> dict[str, Any]:
    """--set NAME=VALUE options as nested settings. Raises ConfigError for one that can't be read."""
    document: dict[str, Any] = {}
    for text in settings:
        name, equals, value = text.partition("=")
        if not equals:
            raise ConfigError(f"--set {text}: write it as NAME=VALUE, e.g. --set render.path_views=30.")
        try:
            parsed = yaml.safe_load(value)
        except yaml.YAMLError:
            raise ConfigError(f"--set {text}: the value is not valid YAML.") from None
        set_at(document, tuple(name.split(".")), parsed)
    return document


def value_at(document: dict[str, Any], path: tuple[str, ...]) -> Any:
    """The setting at a path of names."""
    for part in path:
        document = document[part]
    return document


def set_at(document: dict[str, Any], path: tuple[str, ...], value: Any) -> None:
    """Put a setting at a path of names. Raises ConfigError where a value is in the way."""
    for part in path[:-1]:
        document = document.setdefault(part, {})
        if not isinstance(document, dict):
            raise ConfigError(f"--set {'.'.join(path)}: {part} is a value, not a group of settings.")
    document[path[-1]] = value
