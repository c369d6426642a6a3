"""What a stage chose, skipped or warns of: said to people, and counted by the report without reading the sentence."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator


class Decision(BaseModel):
    """One decision of a stage, stored in its record.

    kind: `skipped` is work that was not done, `chosen` a choice made for this scene, `warning` what the user should
    know. switch: the field of `SkipConfig` that is responsible, where one is. text: the sentence for people.
    saved: what was not spent, by unit, such as {"evaluations": 120, "views": 8}.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["skipped", "chosen", "warning"]
    text: str
    switch: str | None = None
    saved: dict[str, float] = Field(default_factory=dict)

    @model_validator(mode="before")
    @classmethod
    def _plain_sentence(cls, value: Any) -> Any:
        """Records of earlier versions hold sentences alone; what kind they are of is not guessed."""
        return {"kind": "chosen", "text": value} if isinstance(value, str) else value


def skipped(text: str, switch: str | None = None, **saved: float) -> Decision:
    """Work that was not done."""
    return Decision(kind="skipped", text=text, switch=switch, saved=saved)


def chosen(text: str, switch: str | None = None) -> Decision:
    """A choice made for this scene."""
    return Decision(kind="chosen", text=text, switch=switch)


def warning(text: str) -> Decision:
    """What the user should know about the result."""
    return Decision(kind="warning", text=text)
