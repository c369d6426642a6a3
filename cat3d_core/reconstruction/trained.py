"""The half of a reconstructor that its trainer answers, for those that have one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Generic, Protocol, TypeVar

from torch import Tensor


class _Config(Protocol):
    @property
    def iterations(self) -> int: ...


class Trainer(Protocol):
    """What trains one scene, from `Reconstructor.start` on; see there for the members of the same name."""

    @property
    def config(self) -> _Config: ...

    @property
    def iteration(self) -> int: ...

    @property
    def finished(self) -> bool: ...

    def step(self) -> dict[str, float]: ...

    def state(self) -> dict[str, Tensor]: ...

    def load_state(self, state: Mapping[str, Tensor]) -> None: ...


T = TypeVar("T", bound=Trainer)


class Trained(Generic[T]):
    """`start` sets `_trainer`; the rest of a training is asked of that."""

    _trainer: T | None = None

    @property
    def trainer(self) -> T:
        """The training under way. Raises ValueError before `start`."""
        if self._trainer is None:
            raise ValueError("This reconstruction has not been started.")
        return self._trainer

    @property
    def iteration(self) -> int:
        return self.trainer.iteration

    @property
    def iterations(self) -> int:
        return self.trainer.config.iterations

    @property
    def finished(self) -> bool:
        return self.trainer.finished

    def step(self) -> dict[str, float]:
        return self.trainer.step()

    def state(self) -> dict[str, Tensor]:
        return self.trainer.state()

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        self.trainer.load_state(state)
