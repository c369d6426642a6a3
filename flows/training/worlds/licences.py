"""Licences of the package's files, from its own `copyright` file (Debian's machine-readable format, DEP-5)."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from flows.errors import InputError

# Licences that allow rendering training pictures from the work, with credit and under the same terms where they ask
# for it. What has none of these is left out.
FREE = re.compile(r"(CC0|CC-BY|CC-BY-SA|GPL|public-domain|MIT|zlib|BSD|Apache)(?![\w]*-N[CD])[-\w.+]*", re.IGNORECASE)
_CHOICE = re.compile(r"\s+(?:and|or)\s+|,\s*", re.IGNORECASE)
MAX_BYTES = 8 * 2**20


@dataclass(frozen=True)
class Licence:
    """name: short name as the package writes it; holders: who made the work."""

    name: str
    holders: tuple[str, ...]

    @property
    def free(self) -> bool:
        """Whether every licence in the name is one of FREE."""
        return all(FREE.fullmatch(part) for part in _CHOICE.split(self.name))


class Licences:
    """Licence of any file of the package; the last paragraph that matches a path counts."""

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise InputError(f"{path} is not there, and it says which files may be used; fetch the package again.")
        if path.stat().st_size > MAX_BYTES:
            raise InputError(f"{path} is larger than {MAX_BYTES >> 20} MiB; is the file damaged?")
        self._exact: dict[str, tuple[int, Licence]] = {}
        self._patterns: list[tuple[int, re.Pattern[str], Licence]] = []
        for order, paragraph in enumerate(re.split(r"\n[ \t]*\n", path.read_text("utf-8", "replace"))):
            fields = _fields(paragraph)
            if "Files" not in fields or not fields.get("License"):
                continue
            holders = tuple(line.strip() for line in fields.get("Copyright", "").splitlines() if line.strip())
            licence = Licence(fields["License"].strip().splitlines()[0].strip(), holders)
            for pattern in fields["Files"].split():
                if re.search(r"[*?]", pattern):
                    self._patterns.append((order, _regex(pattern), licence))
                else:
                    self._exact[pattern] = (order, licence)
        if not self._patterns:
            raise InputError(f"{path} lists no licences; fetch the package again.")

    def of(self, path: str) -> Licence:
        """Licence of a path such as data/tracks/mines/rock.png; one of no name where none is given."""
        found = [(order, licence) for order, pattern, licence in self._patterns if pattern.fullmatch(path)]
        if path in self._exact:
            found.append(self._exact[path])
        return max(found, key=lambda entry: entry[0])[1] if found else Licence("none given", ())


def _fields(paragraph: str) -> dict[str, str]:
    fields = re.split(r"^([A-Za-z-]+):", paragraph, flags=re.MULTILINE)
    return dict(zip(fields[1::2], fields[2::2], strict=True))


def _regex(pattern: str) -> re.Pattern[str]:
    """DEP-5 globs: * is any text, slashes too; ? one character."""
    return re.compile("".join({"*": ".*", "?": "."}.get(c, re.escape(c)) for c in pattern))


def table(licences: Licences, files: Iterable[str]) -> str:
    """Markdown rows: licence, number of files, who made them."""
    count: dict[str, int] = defaultdict(int)
    holders: dict[str, set[str]] = defaultdict(set)
    for path in files:
        licence = licences.of(path)
        count[licence.name] += 1
        holders[licence.name].update(_person(line) for line in licence.holders)
    lines = ["| licence | files | by |", "|---|---|---|"]
    for name in sorted(count, key=lambda n: (-count[n], n)):
        lines.append(f"| {name} | {count[name]} | {', '.join(sorted(holders[name] - {''}, key=str.lower))} |")
    return "\n".join(lines) + "\n"


def _person(line: str) -> str:
    """A name without years and address."""
    line = re.sub(r"<[^>]*>", "", line)
    return re.sub(r"^[\s©(c)]*\d[\d\s,;-]*", "", line).strip(" ,.")
