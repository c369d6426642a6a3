"""What was decided on the way to a result: chosen, skipped, or worth a warning."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class Decision:
    """kind: "chosen" among alternatives, "skipped" work, or a "warning". text: one sentence that says what and why.

    switch: the name in the configuration's section `skip` that allowed it, where there is one. saved: how much work was
    saved, by its name, such as {"steps": 300}.
    """

    kind: Literal["chosen", "skipped", "warning"]
    text: str
    switch: str | None = None
    saved: Mapping[str, float] = field(default_factory=dict)
