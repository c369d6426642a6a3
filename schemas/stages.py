"""Records of completed stages: one Zarr group per stage, whose attributes are the record, written after the data."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from schemas.decisions import Decision
from schemas.documents import discard, plain, read_group, write_group
from schemas.errors import MissingError, StoreError


class StageRecord(BaseModel):
    """What a completed stage did. Times are ISO 8601 in UTC; `work` counts what was done (views, rays, …)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    stage: str
    key: str = Field(description="content key of (inputs, config, code version): equal key, nothing to do")
    inputs: dict[str, Any] = Field(default_factory=dict, description="digests or keys of what was read")
    config: dict[str, Any] = Field(default_factory=dict)
    code_version: str = ""
    started_at: str
    finished_at: str
    seconds: float = Field(ge=0)
    work: dict[str, float] = Field(default_factory=dict)
    decisions: list[Decision] = Field(default_factory=list, description="what was chosen or skipped, and why")


def now() -> str:
    """The time as stored in records: ISO 8601, UTC, microseconds."""
    return datetime.now(UTC).isoformat(timespec="microseconds")


def read_record(stages: Path, stage: str) -> StageRecord | None:
    """The record of `stage` in the group `stages`, or None if it isn't complete. Raises StoreError if it is damaged."""
    try:
        attributes = read_group(stages / stage)
    except MissingError:
        return None
    try:
        record = StageRecord.model_validate(attributes)
    except ValidationError as error:
        raise StoreError(
            f"The record {stages / stage} is damaged ({error.error_count()} bad fields, the first: "
            f"{error.errors()[0]['msg']}): remove it and run the stage again."
        ) from None
    if record.stage != stage:
        raise StoreError(f"The record {stages / stage} is of the stage {record.stage!r}: remove it and run again.")
    return record


def write_record(stages: Path, record: StageRecord) -> None:
    """Write or replace a record, atomically and durably."""
    write_group(stages / record.stage, plain(record, f"record of {record.stage}"))


def remove_record(stages: Path, stage: str) -> bool:
    """Take a record away; returns whether there was one."""
    return discard(stages / stage)
