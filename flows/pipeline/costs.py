"""What stages will take, by earlier timings: which run is longest, and when all is done."""

from __future__ import annotations

import statistics
import threading
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from flows.jobs.job import Job
from flows.pipeline.keys import Step
from flows.reporting.summary import timing_rows
from schemas.layout import SCENE_STAGES


class Costs:
    """Seconds of stages: of the same stage of the same run as it last took, else the median of its method's runs, else
    of all runs; None where there is no timing yet."""

    def __init__(self, out: Path) -> None:
        self.own: dict[tuple[str, str, str], float] = {}
        self.alike: dict[tuple[str, str], list[float]] = defaultdict(list)
        for row in timing_rows(out):
            for stage, seconds in row["stages"].items():
                self.learn(row["scene_id"], row["run"], row["method"], stage, seconds)

    def learn(self, scene: str, run: str, method: str, stage: str, seconds: float) -> None:
        """Take in a timing."""
        self.own[scene, run, stage] = seconds
        for key in ((method, stage), ("", stage)):
            self.alike[key].append(seconds)

    def seconds(self, job: Job, stage: str) -> float | None:
        """Those of a stage of a job."""
        own = self.own.get((job.scene_id, job.run, stage))
        if own is not None:
            return own
        found = self.alike.get((job.label, stage)) or self.alike.get(("", stage))
        return statistics.median(found) if found else None


class Outlook:
    """What is left of jobs that are under way; safe to use from many threads."""

    def __init__(self, jobs: Sequence[Job], steps: Sequence[Sequence[Step]], costs: Costs) -> None:
        self.lock, self.costs = threading.Lock(), costs
        self.left = {_name(job): (job, [step.stage for step in own]) for job, own in zip(jobs, steps, strict=True)}
        self.ranks: dict[str, float] = {}

    def steps_left(self) -> int:
        """Stages that are to be done; one that is done once a scene counts once."""
        with self.lock:
            shared = {(job.store_path, s) for job, left in self.left.values() for s in left if s in SCENE_STAGES}
            return len(shared) + sum(s not in SCENE_STAGES for _, left in self.left.values() for s in left)

    def done(self, job: Job, stage: str, seconds: float) -> None:
        """A stage of a job is complete."""
        with self.lock:
            self.costs.learn(job.scene_id, job.run, job.label, stage, seconds)
            own = [_name(job)] if stage not in SCENE_STAGES else [
                name for name, (other, _) in self.left.items() if other.store_path == job.store_path
            ]  # fmt: skip
            for name in own:
                if stage in self.left[name][1]:
                    self.left[name][1].remove(stage)
            self.ranks.clear()

    def over(self, job: Job) -> None:
        """Nothing more of the job will be done."""
        with self.lock:
            self.left[_name(job)][1].clear()

    def seconds_of(self, job: Job) -> float:
        """What is left of one run; the longer, the earlier its stages are begun. Stages without a timing count as a
        second each, so that runs with more of them come first."""
        name = _name(job)
        with self.lock:
            if name not in self.ranks:
                left = self.left[name][1] if name in self.left else []
                self.ranks[name] = sum(self.costs.seconds(job, stage) or 1.0 for stage in left)
            return self.ranks[name]

    def seconds_left(self, workers: int) -> float | None:
        """Until all is done, on so many workers; None while there is a stage that was never timed."""
        with self.lock:
            chains, shared = [], dict[tuple[Path, str], float]()
            for job, left in self.left.values():
                known = {stage: self.costs.seconds(job, stage) for stage in left}
                if None in known.values():
                    return None
                found = {stage: seconds or 0.0 for stage, seconds in known.items()}
                chains.append(sum(found.values()))
                shared |= {(job.store_path, s): sec for s, sec in found.items() if s in SCENE_STAGES}
            double = sum(
                self.costs.seconds(job, s) or 0.0 for job, left in self.left.values() for s in left if s in SCENE_STAGES
            )
        total = sum(chains) - double + sum(shared.values())
        return max(total / max(1, workers), max(chains, default=0.0))


def _name(job: Job) -> str:
    return f"{job.store_path} {job.run}"
