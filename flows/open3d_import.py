"""Open3D, which is large and not needed for most of the work: imported where it is used."""

from __future__ import annotations

from types import ModuleType

from flows.errors import InputError


def import_open3d(what: str) -> ModuleType:
    """Open3D, or InputError with the line to type where it or its system library is missing. what: that needs it."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        if "libusb" in str(error):
            raise InputError(
                f"{what} need Open3D, which needs the system library libusb; type  sudo apt-get install -y libusb-1.0-0"
            ) from None
        raise InputError(f"{what} need Open3D ({error}); type  pip install open3d-cpu") from None
    return open3d
