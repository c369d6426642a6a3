"""Finding the files that a data file names, and the rows that numbered files belong to.

Lists are written on other machines: Windows separators, absolute paths of another home, another spelling of umlauts,
other case, another extension after conversion. A name is looked for as it is written first, then in these ways, and
always inside the scene's folder.
"""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Iterable, Sequence
from pathlib import Path

from flows.errors import InputError
from flows.media.files import is_image, list_images

# Where a name has no extension or another one, the first of these that is there.
PREFERRED = ("png", "jpg", "jpeg")
DRIVE = re.compile(r"[A-Za-z]:[\\/]")


class OutsideError(InputError):
    """A data file names a file outside the scene's folder."""


class Finder:
    """Files below `root` by the names in the data file `source`.

    respelled: names that were found in another spelling than written; moved: absolute ones that were found by their
    last parts.
    """

    def __init__(self, root: Path, source: Path | str) -> None:
        self.root, self.source = root, source
        self.respelled: dict[str, str] = {}
        self.moved: dict[str, str] = {}
        self._resolved = root.resolve()
        self._listings: dict[Path, dict[str, list[Path]]] = {}
        self._stems: dict[Path, dict[str, list[Path]]] = {}

    def find(self, name: str, folder: str | None = None) -> Path | None:
        """The file of this name, None where there is none.

        folder: an image folder to take in place of the one in the name (images_4 for images). Raises OutsideError for a
        path that leaves the scene's folder and has no counterpart in it; InputError for no name at all, and for a
        symbolic link out of the folder.
        """
        if not isinstance(name, str) or not name or "\0" in name:
            raise InputError(f"{self.source} has {name!r} where the name of a file is expected.")
        if folder:
            return self._by_tail(split_name(name), Path(folder))
        found = None if _is_absolute(name) else self._literal(name)
        if found is not None:
            return found
        parts = split_name(name)
        if not _is_absolute(name) and parts and parts[0] != "..":
            found = self._at(self.root, parts)
            known = None if found is None else str(found.relative_to(self.root))
            if known is not None and os.path.join(*parts) not in (known, str(Path(known).with_suffix(""))):
                self.respelled[name] = known
            return found
        found = self._inside(name) or self._by_tail(parts)
        if found is None:
            raise OutsideError(
                f'{self.source} names the file "{name}", which is outside the scene\'s folder; '
                "use a path relative to the folder and without .. in it."
            )
        return found

    def find_all(self, names: Sequence[str], folder: str | None = None) -> list[Path | None]:
        """`find` of each. A path outside counts as missing where another one has its counterpart in the folder."""
        out: list[Path | None] = []
        outside: OutsideError | None = None
        for name in names:
            try:
                out.append(self.find(name, folder))
            except OutsideError as error:
                outside = outside or error
                out.append(None)
        if outside is not None and not self.moved:
            raise outside
        return out

    def notes(self) -> list[str]:
        """What was found otherwise than written."""
        out = []
        for what, found in (("in another spelling", self.respelled), ("by the last parts of their paths", self.moved)):
            if found:
                name, to = next(iter(found.items()))
                out.append(f"{len(found)} files were found {what} ({to} for {name}).")
        return out

    def _literal(self, name: str) -> Path | None:
        target = self.root / name
        try:
            return self._checked(target, name) if ".." not in target.parts and target.is_file() else None
        except (OSError, ValueError):  # a name that this file system cannot hold: too long, or not encodable
            return None

    def _inside(self, name: str) -> Path | None:
        """An absolute path that lies inside the folder."""
        target = Path(name)
        if target.is_absolute() and ".." not in target.parts and target.is_file():
            for root in (self.root.absolute(), self._resolved):
                if target.is_relative_to(root):
                    return self._checked(self.root / target.relative_to(root), name)
        return None

    def _by_tail(self, parts: list[str], below: Path = Path()) -> Path | None:
        """The file with the most last parts of a path in common, below a folder of the scene."""
        for first in range(len(parts)):
            if ".." not in parts[first:]:
                found = self._at(self.root / below, parts[first:])
                if found is not None:
                    if below == Path():
                        self.moved["/".join(parts)] = str(found.relative_to(self.root))
                    return found
        return None

    def _at(self, folder: Path, parts: list[str]) -> Path | None:
        """Each part in its own or an equivalent spelling."""
        for part in parts[:-1]:
            entries = [p for p in self._listing(folder).get(_key(part), []) if p.is_dir()]
            exact = [p for p in entries if p.name == part]
            if not entries:
                return None
            folder = (exact or entries)[0]
        if not parts:
            return None
        listing, last = self._listing(folder), parts[-1]
        same = [p for p in listing.get(_key(last), []) if p.is_file()]
        exact = [p for p in same if p.name == last]
        found = next(iter(exact or same), None) or self._with_extension(folder, last)
        return None if found is None else self._checked(found, last)

    def _with_extension(self, folder: Path, name: str) -> Path | None:
        stems = {_key(name)} | ({_key(Path(name).stem)} if _is_extension(Path(name).suffix) else set())
        files = [p for stem in stems for p in self._stems[folder].get(stem, []) if p.is_file()]
        images = sorted(p for p in files if is_image(p))
        ranked = sorted(images, key=lambda p: (*(p.suffix[1:].lower() != e for e in PREFERRED), p.name))
        return ranked[0] if ranked else None

    def _listing(self, folder: Path) -> dict[str, list[Path]]:
        if folder not in self._listings:
            listing: dict[str, list[Path]] = {}
            stems = self._stems[folder] = {}
            for path in sorted(folder.iterdir()) if folder.is_dir() else []:
                listing.setdefault(_key(path.name), []).append(path)
                stems.setdefault(_key(path.stem), []).append(path)
            self._listings[folder] = listing
        return self._listings[folder]

    def _checked(self, target: Path, name: str) -> Path:
        if not target.resolve().is_relative_to(self._resolved):
            raise InputError(
                f"{self.source} names the file '{name}', which a symbolic link leads out of {self.root}; "
                "copy the file into the folder."
            )
        return target


def check_link(path: Path, scene: Path) -> None:
    """Raise InputError where a symbolic link leads out of the scene's folder."""
    if not path.resolve().is_relative_to(scene.resolve()):
        raise InputError(f"{path} is a symbolic link out of {scene}; copy it into the folder.")


def split_name(name: str) -> list[str]:
    """The parts of a path as either system writes it, without drive, root and single dots; .. taken back."""
    text = name.replace("\\", "/")
    parts: list[str] = []
    for part in text[2:].split("/") if DRIVE.match(name) else text.split("/"):
        if part == ".." and parts and parts[-1] != "..":
            parts.pop()
        elif part not in ("", "."):
            parts.append(part)
    return parts


def left_out(folder: Path, used: Iterable[Path], scene: Path) -> list[str]:
    """Names (relative to the folder) of images in a folder and below that are not among the used files."""
    taken = {p.resolve() for p in used}
    root = scene.resolve()
    found = [p for p in images_below(folder) if p.resolve() not in taken and p.resolve().is_relative_to(root)]
    return [str(p.relative_to(folder)) for p in found]


def images_below(folder: Path, depth: int = 4) -> list[Path]:
    """Images in a folder and so many levels of subfolders (hidden ones and links to folders left out), sorted."""
    out = list(list_images(folder))
    for below in sorted(p for p in folder.iterdir() if p.is_dir() and not p.name.startswith(".")):
        if depth and not below.is_symlink():
            out += images_below(below, depth - 1)
    return out


def numbers_in(stems: Sequence[str]) -> list[int] | None:
    """The number in each name that tells the files apart (7 of frame_000007), None where no number does.

    Of several numbers in a name it is the one that differs in all of them, of several such the last.
    """
    groups = [[int(n) for n in re.findall(r"\d+", stem)] for stem in stems]
    if not groups or not groups[0] or len({len(g) for g in groups}) != 1:
        return None
    columns = [list(column) for column in zip(*groups, strict=True)]
    return next((c for c in reversed(columns) if len(set(c)) == len(c)), None)


def rows_by_number(stems: Sequence[str], rows: Sequence[int], from_zero: bool = False) -> list[int | None] | None:
    """Which of the numbered rows each file belongs to, by the number in its name; None: it can't be told.

    Numbers count from 0 as the rows do, or from 1 where one is the last row's plus 1 and none is 0. A file whose number
    is no row's has None. Where both would fit the answer is None, or from 0 if `from_zero`.
    """
    numbers = numbers_in(stems)
    if numbers is None or not rows:
        return None
    known, least, most = set(rows), min(numbers), max(numbers)
    from_one = least > 0 and most == max(known) + 1
    if not from_one and least > 0 and most < max(known) and not from_zero:
        return None  # 1 to 8 of ten rows: are the first and the last missing, or the last two?
    return [(n - from_one) if (n - from_one) in known else None for n in numbers]


def _is_absolute(name: str) -> bool:
    return name.startswith(("/", "\\")) or bool(DRIVE.match(name))


def _is_extension(suffix: str) -> bool:
    return bool(re.fullmatch(r"\.[A-Za-z][A-Za-z0-9]{1,4}", suffix))


def _key(name: str) -> str:
    """A spelling in which equal names are equal: UTF-8 or else Latin-1, composed, without case."""
    try:
        raw = os.fsencode(name)
    except UnicodeEncodeError:  # a name from a text file that the locale's encoding lacks
        raw = name.encode("utf-8", "surrogatepass")
    try:
        text = raw.decode("utf-8")
    except UnicodeDecodeError:
        text = raw.decode("latin-1")
    return unicodedata.normalize("NFC", text).casefold()
