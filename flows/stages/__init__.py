"""The stages of a scene, one module each, in the order of `schemas.layout.STAGES`.

A stage module has VERSION (raised when the same inputs give another result) and `execute(job, store, key) -> Outcome`:
it reads what earlier stages stored, calls the core, writes its own group of the store; `key` is its content key. An
optional `inputs(job)` names further inputs of the key. `flows/pipeline/jobs.py` decides whether
it runs at all.
"""
