"""The Debian package supertuxkart-data: where it lies, which tracks are for training, which for evaluation."""

from __future__ import annotations

from pathlib import Path

from flows.readers.base import InputError

PACKAGE = "supertuxkart-data"
_DATA, _COPYRIGHT = "usr/share/games/supertuxkart/data", f"usr/share/doc/{PACKAGE}/copyright"

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
    found = folder / _DATA
    if not (found / "tracks").is_dir():
        raise InputError(
            f"{folder} holds no {PACKAGE} ({_DATA}/tracks is not there). Fetch it with "
            f"'cat3d train worlds --fetch {folder}', or by hand: apt-get download {PACKAGE} && dpkg -x "
            f"{PACKAGE}_*.deb {folder}"
        )
    return found


def copyright_file(folder: Path) -> Path:
    """The package's own list of licences."""
    return folder / _COPYRIGHT
