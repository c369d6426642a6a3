"""What the store keeps of a reconstruction, and the state of one under way."""

from __future__ import annotations

import os
from pathlib import Path

import torch
from safetensors import safe_open
from safetensors.torch import save_file

from cat3d_core.reconstruction import Reconstructor
from flows.errors import InputError
from flows.jobs.device import exact_device
from flows.jobs.job import Job
from flows.reconstruction.open import reconstructor_class
from schemas.errors import ConfigError
from schemas.scene_store import Run, SceneStore

RECORD_COLUMNS = ["iteration", "seconds", "loss", "psnr_db"]


def write_reconstruction(run: Run, method: str, result: Reconstructor, record: list[list[float]]) -> None:
    """Write `field/`: the tensors, the method and settings that they belong to, and the training record, rows of
    RECORD_COLUMNS."""
    run.remove("field")
    section = run.section("field", create=True)
    tensors = result.tensors()
    for name, value in tensors.items():
        section.write(name, value.detach().cpu().numpy())
    section.write("record", torch.tensor(record, dtype=torch.float32).reshape(-1, len(RECORD_COLUMNS)).numpy())
    section.set_attrs(
        method=method, settings=result.settings, parameters=sorted(tensors), record_columns=RECORD_COLUMNS
    )


def read_reconstruction(store: SceneStore, run: Run) -> Reconstructor:
    """The finished reconstruction of a run on this machine's device, with the settings it was made with, which need not
    be those of today's presets.

    Raises InputError where there is none or this version cannot read it, StoreError for a damaged store.
    """
    record = store.record("reconstruct", run.name)
    if record is None:
        raise InputError(
            f"The run {run.name} of {store.folder} has no finished field; finish it with `cat3d run` first."
        )
    section = run.field
    attrs = section.attrs
    # Older stores name neither: all their fields are Zip-NeRFs, whose settings are among what the stage depends on.
    method, settings = attrs.get("method", "zipnerf"), attrs.get("settings", record.inputs)
    tensors = {name: torch.from_numpy(section.read(name)) for name in attrs["parameters"]}
    try:
        return reconstructor_class(method).from_tensors(settings, tensors, exact_device())
    except ConfigError as error:
        raise InputError(f"The field of {run.name} in {store.folder} cannot be read: {error}") from None
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"The field of {run.name} in {store.folder} was trained by another version of {method} and cannot be read "
            f"({error}); reconstruct it again with `cat3d reprocess`."
        ) from None


def checkpoint_path(out: Path, scene_id: str, run: str) -> Path:
    """Where the state of a run's reconstruction is while it is under way."""
    return out / ".work" / f"{scene_id}-{run}.safetensors"


class Checkpoint:
    """The state of a reconstruction on disk while the stage runs, beside the store, replaced atomically."""

    def __init__(self, job: Job, key: str) -> None:
        self.path = checkpoint_path(job.out, job.scene_id, job.run)
        self.key = key  # only a step with the same inputs and settings may go on from it

    def save(self, state: dict[str, torch.Tensor]) -> None:
        """Write the state; a kill at any moment leaves the old or the new one."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        part = self.path.with_suffix(f".{os.getpid()}.part")
        save_file(state, part, metadata={"key": self.key})
        os.replace(part, self.path)

    def load(self) -> dict[str, torch.Tensor] | None:
        """The state, if there is one of this very step."""
        if not self.path.exists():
            return None
        with safe_open(self.path, "pt") as file:
            if (file.metadata() or {}).get("key") != self.key:
                return None
            return {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118

    def remove(self) -> None:
        """The stage is complete; the state is no longer needed."""
        self.path.unlink(missing_ok=True)
