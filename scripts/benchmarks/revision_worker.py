"""The process of one revision: answers "prepare MEASUREMENT" and "run MEASUREMENT" with a line of JSON.

It is run as a file, with the root of the package to measure and a folder for its own files, and takes the
package, and the playback of the golden outputs, from that root, so that each revision measures itself.
"""

from __future__ import annotations

import json
import math
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

SHORT = 150
"""Instants of a likelihood of which most is not the filter."""
SLICE_S = 0.05
"""[s] CPU time that one timed run takes at least: quick calls are repeated within it."""


def likelihood_of(kind: str, scratch: Path) -> tuple[Any, dict[str, float]]:
    """The likelihood of the demo's turbine, "thermal" or "joint", and its start values."""
    from hygrokf import Likelihood, model_inputs, read_case, synthetic_turbine, write_case
    from hygrokf.modelling.design import design

    record = read_case(write_case(synthetic_turbine(seed=1), scratch / "turbine"))
    made = design(record, kind=kind)
    likelihood = Likelihood(made.model, model_inputs(made, record).timeline)
    return likelihood, {one.name: one.start for one in made.model.parameters}


def prepared(measurement: str, root: Path, scratch: Path) -> Callable[[], float]:
    """A function that makes one timed run of a measurement, and returns CPU seconds of one call in it."""
    kind, _, case = measurement.partition(" ")
    if kind == "fit":
        return _fit(root, scratch)
    if kind == "track":
        return lambda: _seconds(lambda: _playback(scratch), 1)
    import numpy as np

    likelihood, values = likelihood_of(case, scratch)
    if kind == "fixed":
        likelihood = type(likelihood)(likelihood.model, likelihood.timeline.window(0, SHORT))
    directions = np.eye(len(values))
    call: Callable[[], object] = {
        "value": lambda: likelihood.value(values),
        "score": lambda: likelihood.score(values),
        "fixed": lambda: likelihood.score(values),
        "information": lambda: likelihood.sensitivities(values, directions),
    }[kind]
    found = likelihood.value(values)
    if not math.isfinite(found):
        raise ValueError(f"expected a finite ln L of the case {case}, found {found}")
    call()  # compiles, allocates, fills caches
    calls = max(1, math.ceil(SLICE_S / max(_seconds(call, 3), 1e-7)))
    return lambda: _seconds(call, calls)


def _seconds(call: Callable[[], object], calls: int) -> float:
    """CPU seconds of one call."""
    begin = time.process_time()
    for _ in range(calls):
        call()
    return (time.process_time() - begin) / calls


def _fit(root: Path, scratch: Path) -> Callable[[], float]:
    """`hygrokf fit` on the case of `hygrokf demo` in a process of its own; user and system time."""
    from hygrokf import synthetic_turbine, write_case

    case = write_case(synthetic_turbine(seed=1), scratch / "demo")
    command = [sys.executable, "-m", "hygrokf.commands.main", "fit", str(case), "--out", str(scratch / "fit")]

    def run() -> float:
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        if done.returncode:
            raise ValueError(f"hygrokf fit: {(done.stderr or done.stdout).strip().splitlines()[-1]}")
        return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime

    run()  # its compiled loops are on disk afterwards
    return run


def _playback(scratch: Path) -> None:
    """Ten days of a turbine through the tracker into a store, with forecasts and alarms."""
    from golden.cases import playback

    with tempfile.TemporaryDirectory(dir=scratch) as folder:
        playback(Path(folder))


def expect_package_under(root: Path) -> None:
    """Raise ValueError where another hygrokf than that under `root` is imported."""
    import hygrokf

    found = Path(hygrokf.__file__).resolve()
    if not found.is_relative_to(root.resolve()):
        raise ValueError(f"expected the package under {root}, found {found}")


def main() -> None:
    """Answer every line of the standard input until it ends."""
    root, scratch = Path(sys.argv[1]), Path(sys.argv[2])
    sys.path[:1] = [str(root / "scripts"), str(root), str(root / "tests")]  # for the folder of this file
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what a revision prints is no answer
    runs: dict[str, Callable[[], float]] = {}
    for line in sys.stdin:
        verb, _, measurement = line.rstrip("\n").partition(" ")
        answer: dict[str, object] = {}
        try:
            expect_package_under(root)
            if verb == "prepare":
                runs[measurement] = prepared(measurement, root, scratch)
            else:
                answer["seconds"] = runs[measurement]()
        except Exception as fault:  # of any revision, which may lack what is measured
            answer["fault"] = f"{type(fault).__name__}: {fault} (in {root.name})"
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    main()
