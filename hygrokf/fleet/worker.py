"""A process that does jobs one after the other.

Each line of the standard input is a job, each line of the standard output its outcome, both as JSON; the
process ends with its input.
"""

from __future__ import annotations

import json
import os
import signal
import sys

from hygrokf.engine.parallel import THREADS
from hygrokf.fleet.job import Job
from hygrokf.fleet.tasks import perform

ENVIRONMENT = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", THREADS)}
"""One thread for linear algebra: the matrices are tiny, and as many processes as cores are at work."""


def main() -> int:
    """Do what comes until the input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the one who was interrupted ends this process
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(
        sys.stderr.fileno(), sys.stdout.fileno()
    )  # whatever else is printed must not stand among the answers
    for line in sys.stdin:
        found = perform(Job.from_json(json.loads(line)))
        answers.write(json.dumps(found.to_json()) + "\n")
        answers.flush()
    return 0
