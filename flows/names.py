"""Names of scenes and photos: shown as they are, stored under names that every file system and text format takes.

A file system allows any bytes but / and NUL in a name; Python holds bytes that are no UTF-8 as lone surrogates, which
neither JSON, Parquet nor a terminal can take. `shown` makes text of any name, `safe_name` a name for files and folders,
`source_text` and `source_path` carry a path through JSON and back.
"""

from __future__ import annotations

import hashlib
import os
import re
import unicodedata
from collections.abc import Sequence
from urllib.parse import quote_from_bytes, unquote_to_bytes

#: What `schemas.documents.checked_name` and every shell take without quoting.
PLAIN = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,79}")
LONGEST = 60
BYTES_PREFIX = "bytes:"
# Device names that Windows reserves, with any extension.
RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)


def decoded(name: str) -> str:
    """A name whose bytes are UTF-8 as those say it, though Python read them otherwise, as it does in the locale C."""
    if name.isprintable() or not _from_bytes(name):
        return name
    try:
        return name.encode("utf-8", "surrogateescape").decode("utf-8")
    except UnicodeDecodeError:
        return name


def shown(name: str) -> str:
    """The name as text without lone surrogates: bytes that are no UTF-8 are read as Latin-1, as they mostly are."""
    name = decoded(name)
    try:
        name.encode("utf-8")
    except UnicodeEncodeError:
        return name.encode("utf-8", "surrogateescape").decode("latin-1") if _from_bytes(name) else _escaped(name)
    return name


def shown_names(names: Sequence[str]) -> list[str]:
    """`shown` of each; names that differ stay different, a number behind the later one where they would not."""
    texts = {name: name for name in names if shown(name) == name}
    taken = set(texts)
    for name in names:
        text, count = texts.get(name) or shown(name), 1
        while name not in texts and text in taken:
            count += 1
            text = f"{shown(name)} ({count})"
        texts[name] = text
        taken.add(text)
    return [texts[name] for name in names]


def safe_name(name: str) -> str:
    """A name for files, folders and stores: letters, digits and ._- of ASCII, at most 80 characters, never hidden.

    A plain name is its own. Any other keeps its readable part, with the first 8 hexadecimal digits of the sha256 of its
    bytes behind it, so that different names stay different.
    """
    name = decoded(name)
    if PLAIN.fullmatch(name) and not RESERVED.fullmatch(name) and not name.endswith("."):
        return name
    ascii_part = unicodedata.normalize("NFKD", shown(name)).encode("ascii", "ignore").decode("ascii")
    readable = re.sub(r"[^A-Za-z0-9._-]+", "_", ascii_part)[:LONGEST].strip("._-") or "scene"
    digest = hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()[:8]
    return f"{readable}-{digest}"


def source_text(path: str) -> str:
    """A path as text that JSON takes: itself, or percent-encoded bytes behind `bytes:` where it is no UTF-8."""
    try:
        path.encode("utf-8")
    except UnicodeEncodeError:
        return BYTES_PREFIX + quote_from_bytes(os.fsencode(path))
    return path


def source_path(text: str) -> str:
    """The path that `source_text` made text of."""
    return os.fsdecode(unquote_to_bytes(text[len(BYTES_PREFIX) :])) if text.startswith(BYTES_PREFIX) else text


def _from_bytes(name: str) -> bool:
    return all(not 0xD800 <= ord(c) <= 0xDFFF or 0xDC80 <= ord(c) <= 0xDCFF for c in name)


def _escaped(name: str) -> str:
    return name.encode("utf-8", "backslashreplace").decode("utf-8")
