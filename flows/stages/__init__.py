"""The stages of a scene in the order they run, one module each. What a stage is: `flows/jobs/stage.py`."""

from flows.jobs.stage import Stage
from flows.stages import decode, encode, evaluate, ingest, match, plan, poses, reconstruct, render, sample

STAGES: tuple[Stage, ...] = (
    ingest.STAGE,
    poses.STAGE,
    plan.STAGE,
    match.STAGE,
    encode.STAGE,
    sample.STAGE,
    decode.STAGE,
    reconstruct.STAGE,
    render.STAGE,
    evaluate.STAGE,
)
