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

COUNT, SHORT = 10_000, 150
SLICE_S = 0.05
"""[s] CPU time that one timed run takes at least: quick calls are repeated within it."""


def three_boxes(count: int) -> tuple[Any, dict[str, float]]:
    """Likelihood and values of a model of the earth's energy balance with three boxes: four states, two
    readings, eleven parameters.

        dF = γ (F₂ u − F) dt + σ_η dW,  C₁ dT₁ = (F − κ₁ T₁ − κ₂ (T₁ − T₂)) dt + σ_ξ dW,
        C₂ dT₂ = (κ₂ (T₁ − T₂) − ε κ₃ (T₂ − T₃)) dt,  C₃ dT₃ = κ₃ (T₂ − T₃) dt,
        y₁ = T₁,  y₂ = F − κ₁ T₁ + (1 − ε) κ₃ (T₂ − T₃).

    Source of the equations: Cummins, Stephenson, Stott, J. Climate 33 (2020), doi:10.1175/JCLI-D-19-0589.1.
    The readings are noise about a step response: they only have to be finite and of the right size.
    """
    import numpy as np

    from hygrokf import Likelihood, Parameter, compose, linear_network, timeline

    values = {
        "gamma": 3.0, "c1": 4.0, "c2": 12.0, "c3": 75.0, "k1": 1.1, "k2": 2.4, "k3": 0.9, "epsilon": 1.25,
        "s_eta": 0.55, "s_xi": 0.7, "f2": 3.7,
    }  # fmt: skip

    def rates(p: Any, x: Any, u: Any) -> dict[str, Any]:
        upper, lower = p.k2 * (x.t1 - x.t2), p.k3 * (x.t2 - x.t3)
        return {
            "force": p.gamma * (p.f2 * u.step - x.force),
            "t1": (x.force - p.k1 * x.t1 - upper) / p.c1,
            "t2": (upper - p.epsilon * lower) / p.c2,
            "t3": lower / p.c3,
        }

    network = linear_network(
        "three_boxes",
        [Parameter(name, "1", value, 1e-3, 1e3) for name, value in values.items()],
        ["force", "t1", "t2", "t3"],
        ["step"],
        rates,
        {
            "surface": lambda p, x, u: (x.t1, 1e-6),
            "balance": lambda p, x, u: (
                x.force - p.k1 * x.t1 + (1.0 - p.epsilon) * p.k3 * (x.t2 - x.t3),
                1e-6,
            ),
        },
        lambda p: {"force": p.s_eta * p.s_eta, "t1": p.s_xi * p.s_xi / (p.c1 * p.c1), "t2": 0.0, "t3": 0.0},
        lambda p, u: {"force": (0.0, 1.0), "t1": (0.0, 1.0), "t2": (0.0, 1.0), "t3": (0.0, 1.0)},
    )
    model = compose([network], {"step": "mean"})
    random = np.random.default_rng(5)
    instants = np.arange(count, dtype=float)
    response = 3.0 * (1.0 - np.exp(-instants / 30.0))
    readings = {
        "surface": response + 0.2 * random.normal(size=count),
        "balance": 3.7 - 1.1 * response + 0.5 * random.normal(size=count),
    }
    run = timeline(model, instants, {"step": np.ones(count)}, readings)
    return Likelihood(model, run), values


def likelihood_of(case: str, count: int, scratch: Path) -> tuple[Any, dict[str, float]]:
    """The likelihood of a case and values of the right size: three boxes, or the thermal or the joint model of
    the demo's turbine."""
    if case == "3-box":
        return three_boxes(count)
    from hygrokf import Likelihood, model_inputs, read_case, synthetic_turbine, write_case
    from hygrokf.modelling.design import design

    record = read_case(write_case(synthetic_turbine(seed=1), scratch / "turbine"))
    made = design(record, kind=case)
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

    likelihood, values = likelihood_of(case, SHORT if kind == "fixed" else COUNT, scratch)
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
