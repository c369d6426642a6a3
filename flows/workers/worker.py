"""A worker process: batches come in as lines of JSON, answers go out as such. Started by `flows/workers/local.py`."""

from __future__ import annotations

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Work until the input ends, or die with the process that started this one, however that ends."""
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != int(sys.argv[1]):  # it was gone before the line above
        return
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what libraries print belongs in the log

    from flows.workers.work import Batch, run_batch

    for line in sys.stdin:
        answer = run_batch(Batch.model_validate_json(line))
        print(answer.model_dump_json(), file=answers, flush=True)


if __name__ == "__main__":
    main()
