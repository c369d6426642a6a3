"""Content keys: the same everywhere for the same content, different for different content."""

from __future__ import annotations

import dataclasses
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel

from schemas.content_key import array_digest, content_key

LEAVES = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(allow_nan=False, allow_infinity=False), st.text(), st.binary()
)
VALUES = st.recursive(LEAVES, lambda v: st.lists(v, max_size=4) | st.dictionaries(st.text(), v, max_size=4))


class Model(BaseModel):
    steps: int = 3
    rate: float = 0.1


@dataclasses.dataclass
class Data:
    steps: int = 3
    rate: float = 0.1


def _same(a: Any, b: Any) -> bool:
    """Equal values of equal types, all the way down; floats by their bits."""
    if type(a) is not type(b):
        return False
    if isinstance(a, list):
        return len(a) == len(b) and all(map(_same, a, b))
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(_same(a[k], b[k]) for k in a)
    return a.hex() == b.hex() if isinstance(a, float) else a == b


@given(VALUES, VALUES)
def test_keys_are_equal_exactly_when_values_are(a: Any, b: Any) -> None:
    assert (content_key(x=a) == content_key(x=b)) == _same(a, b)


@given(st.dictionaries(st.text(), VALUES, min_size=2, max_size=5))
def test_the_order_of_a_mapping_does_not_count(value: dict[str, Any]) -> None:
    assert content_key(x=value) == content_key(x=dict(reversed(value.items())))


@given(st.lists(st.integers() | st.text()))
def test_tuples_are_lists_and_sets_have_no_order(value: list[Any]) -> None:
    assert content_key(x=value) == content_key(x=tuple(value))
    assert content_key(x=set(value)) == content_key(x=frozenset(reversed(value)))


@given(st.lists(st.floats(width=32, allow_nan=False), min_size=1, max_size=20), st.data())
def test_one_bit_of_an_array_changes_its_digest(values: list[float], data: st.DataObject) -> None:
    array = np.array(values, np.float32)
    other = array.copy()
    bit = data.draw(st.integers(0, array.nbytes * 8 - 1))
    other.view(np.uint8)[bit // 8] ^= 1 << (bit % 8)
    assert array_digest(array) != array_digest(other)


def test_a_key_is_the_same_in_another_process_and_for_ever() -> None:
    code = "from schemas.content_key import content_key as k; print(k(a={'x', 'y', 1}, b=0.1, c=[True, None, b'z']))"
    root = Path(__file__).resolve().parents[2]
    keys = {
        subprocess.run(
            [sys.executable, "-c", code],
            cwd=root,
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            check=True,
        ).stdout.strip()
        for seed in ("1", "2")
    }
    assert keys == {content_key(c=(True, None, b"z"), b=0.1, a={"y", 1, "x"})}
    # Changing the rule makes every store of every user stale: don't do it by accident.
    assert content_key(a=1) == "456b80e41a9c30abfb5bb72b316dda7552b86edef09cac2ab87be2bdd9edec4e"


def test_types_and_signs_count() -> None:
    values = (1, 1.0, True, "1", None, 0.0, -0.0, b"1", Path("1"), [1], {1}, {"1": 1}, 0, False)
    keys = [content_key(x=x) for x in values]
    assert len(set(keys)) == len(keys)
    assert content_key(x=1) != content_key(y=1)


def test_numpy_scalars_models_and_dataclasses_are_their_values() -> None:
    assert content_key(x=np.int32(3)) == content_key(x=3)
    assert content_key(x=np.float64(0.1)) == content_key(x=0.1)
    assert content_key(x=np.float32(0.1)) != content_key(x=0.1)
    assert content_key(x=Model()) == content_key(x=Data()) == content_key(x={"steps": 3, "rate": 0.1})
    assert content_key(x=Model(steps=4)) != content_key(x=Model())


def test_arrays_count_by_type_shape_and_values_but_not_by_layout() -> None:
    a = np.arange(12, dtype=np.float32).reshape(3, 4)
    assert array_digest(a) == array_digest(np.asfortranarray(a)) == array_digest(a.astype(">f4"))
    assert array_digest(a) == array_digest(np.repeat(a, 2, axis=1)[:, ::2])
    assert len({array_digest(x) for x in (a, a.T, a.ravel(), a.astype(np.float64), a.view(np.int32))}) == 5
    assert content_key(x=np.array(["a", "b"])) == content_key(x=["a", "b"])


@pytest.mark.parametrize(
    ("value", "sentence"),
    [
        ({"rate": float("nan")}, "x.rate is nan"),
        ([1.0, float("inf")], r"x\[1\] is inf"),
        ({"a": {3: 1}}, "x.a has the key 3"),
        (object(), "x is a object"),
        (np.array([object()]), r"x\[0\] is a object"),
    ],
)
def test_what_has_no_key_is_refused_by_name(value: Any, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        content_key(x=value)
