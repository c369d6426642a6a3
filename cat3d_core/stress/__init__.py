"""Numerical stress: every routine of the core against a reference, at the inputs where it is worst.

`stress(ROUTINES, cases)` searches; see `routine.Routine` for what a row says and
`docs/reference/stress.md` for the results.
"""

from cat3d_core.stress import (
    coordinates,
    diffusion,
    geometry,
    intervals,
    matching,
    metrics,
    networks,
    poses,
    rendering,
    splats,
    training,
)  # fmt: skip
from cat3d_core.stress.routine import Exact, Routine
from cat3d_core.stress.search import Finding, stress

_SUBJECTS = (
    geometry, poses, coordinates, intervals, rendering, training, diffusion, networks, metrics, matching, splats,
)  # fmt: skip
ROUTINES = [routine for subject in _SUBJECTS for routine in subject.ROUTINES]

__all__ = ["ROUTINES", "Exact", "Finding", "Routine", "stress"]
