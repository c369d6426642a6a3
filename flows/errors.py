"""Which errors are the user's to act on, and the sentence for each."""

from __future__ import annotations

from schemas.errors import ConfigError, StoreError


class InputError(ValueError):
    """Something the user gave cannot be used; the message names the file or view and says what to do."""


class ServerError(RuntimeError):
    """The Prefect server could not be started or reached."""


class WorkerError(RuntimeError):
    """Work that can't be finished: the message says which, and what happened to the workers that tried."""


def describe(error: BaseException) -> str | None:
    """The sentence a user sees, or None for a fault of ours, which deserves its traceback."""
    from cat3d_core.reconstruction import NonFiniteError

    if isinstance(error, (InputError, StoreError, ConfigError, ServerError, NonFiniteError, WorkerError)):
        return str(error)
    if isinstance(error, OSError) and error.errno is not None:
        where = f" ({error.filename})" if error.filename else ""
        return f"The system refused: {error.strerror}{where}. Free space or permissions may be missing."
    if type(error).__name__ in ("PrefectHTTPStatusError", "PrefectHTTPServerError"):  # Prefect is not imported for this
        return (
            f"The Prefect server failed ({str(error).splitlines()[0]}). Most often the disk under --out is full or "
            "cannot be written; where PREFECT_API_URL is not set, OUT/.prefect/server.log says more. Free space and "
            "run again: what is stored is kept."
        )
    return None
