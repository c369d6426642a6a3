"""The Debian package supertuxkart-data: where it lies, which tracks are for training, which for evaluation."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from pathlib import Path

from flows.errors import InputError

PACKAGE = "supertuxkart-data"
DATA, COPYRIGHT = "usr/share/games/supertuxkart/data", f"usr/share/doc/{PACKAGE}/copyright"

# Never trained on: a jungle temple, a harbour at the sea, a classroom, a mansion's halls and park, a snow village,
# a Japanese garden. None of them shares its ground or buildings with a track to train on.
HELD_OUT = ("cocoa_temple", "lighthouse", "olivermath", "ravenbridge_mansion", "snowtuxpeak", "zengarden")
TRAINING = (
    "abyss", "alien_signal", "ancient_colosseum_labyrinth", "arena_candela_city", "battleisland", "black_forest",
    "candela_city", "cave", "cornfield_crossing", "fortmagma", "gran_paradiso_island", "hacienda", "icy_soccer_field",
    "lasdunasarena", "lasdunassoccer", "mines", "minigolf", "overworld", "pumpkin_park", "sandtrack", "scotland",
    "snowmountain", "soccer_field", "stadium", "stk_enterprise", "temple", "tutorial", "volcano_island", "xr591",
)  # fmt: skip


def data_folder(folder: Path) -> Path:
    """The game's data folder below `folder`, into which the package was unpacked. Raises InputError if it is not
    there."""
    found = folder / DATA
    if not (found / "tracks").is_dir():
        raise InputError(
            f"{folder} holds no {PACKAGE} ({DATA}/tracks is not there); fetch it with 'cat3d worlds {folder}'."
        )
    return found


def copyright_file(folder: Path) -> Path:
    """The package's own list of licences."""
    return folder / COPYRIGHT


def fetch(folder: Path) -> None:
    """Download the package with the ordinary Debian client and unpack it into `folder`; nothing is installed.

    Raises InputError where this is no Debian (then somebody who has one can do it), or the client refuses."""
    by_hand = f"apt-get download {PACKAGE} && dpkg -x {PACKAGE}_*.deb {folder}"
    if shutil.which("apt-get") is None or shutil.which("dpkg") is None:
        raise InputError(f"This machine has no apt-get and dpkg; on a Debian or Ubuntu one, run: {by_hand}")
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder) as place:
        # Unpacked beside its place first: an interrupted fetch leaves nothing that looks complete.
        for command in (["apt-get", "download", PACKAGE], ["dpkg", "-x", None, "unpacked"]):
            archive = next((str(path) for path in Path(place).glob("*.deb")), "")
            done = subprocess.run(
                [part or archive for part in command], cwd=place, capture_output=True, text=True, check=False
            )
            if done.returncode:
                raise InputError(f"{' '.join(p or archive for p in command)} failed: {done.stderr.strip()[-300:]}")
        (Path(place) / "unpacked" / "usr").rename(folder / "usr")
