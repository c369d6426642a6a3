"""Names that a file system allows, shown as they are and stored under names that everything takes."""

from __future__ import annotations

import json
import os
from pathlib import Path

from hypothesis import given
from hypothesis import strategies as st

from flows.names import safe_name, shown, shown_names, source_path, source_text
from schemas.documents import checked_name

# Any name that Linux allows: bytes but / and NUL, as Python shows them.
file_names = (
    st.binary(min_size=1, max_size=255)
    .map(lambda b: os.fsdecode(b.replace(b"/", b"_").replace(b"\0", b"_")))
    .filter(lambda n: n not in (".", ".."))
)


@given(file_names)
def test_a_safe_name_is_taken_by_stores_files_and_json(name):
    safe = safe_name(name)
    assert checked_name(safe) == safe
    assert safe.isascii()
    assert safe_name(safe) == safe
    assert len(safe) <= 80
    assert json.loads(json.dumps(safe)) == safe


@given(st.lists(file_names, unique=True, max_size=8))
def test_different_names_stay_different(names):
    assert len({safe_name(n) for n in names}) == len(names)
    texts = shown_names(names)
    assert len(set(texts)) == len(names)
    for text in texts:
        text.encode("utf-8")


@given(file_names)
def test_a_source_survives_json(name):
    text = source_text(f"/data/{name}")
    text.encode("utf-8")
    assert source_path(json.loads(json.dumps(text))) == f"/data/{name}"


@given(st.text(max_size=40))
def test_names_that_are_text_are_shown_as_they_are(name):
    if not any(0xD800 <= ord(c) <= 0xDFFF for c in name):
        assert shown(name) == name


def test_plain_names_are_their_own_and_others_keep_their_readable_part():
    for name in ("fern", "dtu_scan24", "procedural_llff_3", "a.b-c"):
        assert safe_name(name) == name
    assert safe_name("my scene").startswith("my_scene-")
    assert safe_name("Küche [2]").startswith("Kuche_2-")
    assert safe_name("con") != "con"
    assert safe_name("日本").startswith("scene-")
    assert shown(os.fsdecode(b"K\xfcche")) == "Küche"
    assert Path(safe_name("..")).name != ".."
