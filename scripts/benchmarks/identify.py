"""Figures of the identification: likelihoods, scores, fits, the command line, memory."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import tracemalloc
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import numpy as np

from benchmarks import cases, rivals
from benchmarks.measure import Figure, Times, interleaved, ratio, repeated, timed
from hygrokf.estimation.confidence import standard_error, uncertainty
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.optimiser import Estimate, Objective, fit_mle
from hygrokf.estimation.profile_likelihood import profile

SIZES = (26_000, 262_000)
QUICK_SIZES = (2_600, 26_000)
FILTERPY_INSTANTS = 1_000
SEARCH_H = 30 * 24.0
"""[h] stretch on which the starts of a long record are tried, as `hygrokf fit` does it."""
REFERENCE = Path(__file__).resolve().parents[3] / "shared" / "data" / "reference" / "thermal10k"
"""The published reference data, if they lie beside the repository."""

Section = Callable[[bool], Iterable[Figure]]


def _sizes(quick: bool) -> tuple[int, ...]:
    return QUICK_SIZES if quick else SIZES


def thermal(quick: bool) -> Iterator[Figure]:
    """One state: value against statsmodels, nanoseconds a step."""
    for count in _sizes(quick):
        section = f"thermal, 1 state, N = {count:,}"
        case = cases.thermal(count)
        contenders = {f"statsmodels, {name}": f for name, f in rivals.statsmodels_variants(case).items()}
        contenders["value"] = rivals.package(case)
        contenders["score"] = lambda case=case: case.likelihood.score(case.values)
        found = interleaved(contenders, 5 if quick else 15)
        value = found["value"]
        others = {name: t for name, t in found.items() if name.startswith("statsmodels")}
        best = min(others, key=lambda name: others[name].median)
        yield timed(section, "value", "ns/step", value * (1e9 / count), at_most=15.0)
        yield timed(
            section,
            "statsmodels / value",
            "×",
            ratio(others[best], value),
            at_least=70.0,
            note=f"fastest variant: {best.split(', ')[1]}; "
            + ", ".join(f"{n.split(', ')[1]} {t.median / count * 1e9:.0f} ns" for n, t in others.items())
            + " a step",
        )
        yield timed(section, "score / value", "×", ratio(found["score"], value))


def joint(quick: bool) -> Iterator[Figure]:
    """Four states, two readings: value against a filterpy loop, score against value."""
    for count in _sizes(quick):
        section = f"joint, 4 states, N = {count:,}"
        case = cases.joint(count)
        stretch = min(FILTERPY_INSTANTS // (4 if quick else 1), count)
        contenders = {
            "value": rivals.package(case),
            "score": lambda case=case: case.likelihood.score(case.values),
            "sensitivities": lambda case=case: case.likelihood.sensitivities(
                case.values, np.eye(len(case.values))
            ),
            "filterpy": rivals.filterpy_loop(case, stretch, rivals.remembered(case, stretch)),
            "filterpy and numpy": rivals.filterpy_loop(case, stretch, rivals.JointStep(case)),
        }
        found = interleaved(contenders, 3 if quick else 9)
        value, scale = found["value"], count / stretch
        yield timed(section, "value", "ns/step", value * (1e9 / count))
        yield timed(
            section,
            "filterpy / value",
            "×",
            ratio(found["filterpy"] * scale, value),
            at_least=300.0,
            note=f"filterpy's calls and the Gaussian terms alone, its steps computed beforehand: "
            f"{found['filterpy'].median / stretch * 1e6:.0f} µs a step over {stretch:,} instants, scaled to "
            f"{count:,}",
        )
        yield timed(
            section,
            "filterpy with its steps in numpy / value",
            "×",
            ratio(found["filterpy and numpy"] * scale, value),
        )
        yield timed(section, "score / value", "×", ratio(found["score"], value), at_most=6.0)
        yield timed(section, "score and information / value", "×", ratio(found["sensitivities"], value))


def thermal10k(quick: bool) -> Iterator[Figure]:
    """Two thermal masses, seven parameters, N = 10,000: a fit with standard errors."""
    runs: dict[str, Likelihood] = {"simulated": cases.simulated_two_masses(10_000)}
    notes = {}
    if (REFERENCE / "thermal10k.csv.gz").exists():
        data = np.genfromtxt(REFERENCE / "thermal10k.csv.gz", delimiter=",", names=True, missing_values="NA")
        runs["published data"] = cases.two_masses(data["t"], data["Ta"], data["P"], data["y"])
    for name, likelihood in runs.items():
        found: dict[str, tuple] = {}

        def fit(likelihood: Likelihood = likelihood, found: dict = found) -> None:
            estimate = fit_mle(likelihood, count=1)
            found["last"] = estimate, uncertainty(Objective(likelihood, estimate.coordinates), estimate)

        fit()
        times = repeated(fit, 3 if quick else 9)
        estimate, second = found["last"]
        notes[name] = f"log-likelihood {estimate.objective:.6f}, {estimate.message}"
        if name == "published data":
            known = json.loads((REFERENCE / "expected.json").read_text())["ml_lkf"]
            off = max(
                abs(np.sqrt(second.wald[second.place(n), second.place(n)]) / se - 1.0)
                for n, se in known["se_log"].items()
            )
            notes[name] += f"; published {-known['nll']:.6f}; largest departure of a standard error {off:.1e}"
        yield timed(
            "thermal10k", f"fit with standard errors, {name}", "s", times, at_most=0.35, note=notes[name]
        )


def _search(likelihood: Likelihood) -> Likelihood | None:
    t = likelihood.timeline
    if t.time[-1] <= 2.0 * SEARCH_H:
        return None
    return Likelihood(likelihood.model, t.window(0, int(np.searchsorted(t.time, SEARCH_H))))


def fit(quick: bool) -> Iterator[Figure]:
    """The joint model, sixteen parameters: estimate, Wald and sandwich; then all starts and both profiles."""
    count = 6_000 if quick else 26_000
    case = cases.joint(count)
    likelihood = case.likelihood
    section = f"joint fit, {len(case.values)} parameters, N = {count:,}"
    found: dict[str, tuple] = {}

    def whole(starts: int, profiles: bool) -> Estimate:
        estimate = fit_mle(likelihood, count=starts, search=_search(likelihood))
        objective = Objective(likelihood, estimate.coordinates)
        second = uncertainty(objective, estimate)
        if profiles:
            for name in ("thermal_time_constant", "hygric_k"):
                profile(objective, estimate, second, name)
        found["last"] = estimate, second
        return estimate

    whole(1, False)
    repetitions = 1 if quick else 5
    times = repeated(lambda: whole(1, False), repetitions)
    estimate, second = found["last"]
    note = ", ".join(
        f"{n} {estimate.values[n]:.3f} ± {standard_error(estimate, second, n):.3f} (truth {case.values[n]:g})"
        for n in ("thermal_time_constant", "hygric_k")
    )
    yield timed(
        section, "one start, Wald, sandwich", "s", times, at_most=3.0, note=f"{estimate.message}; {note}"
    )
    times = repeated(lambda: whole(4, True), max(1, repetitions - 2))
    estimate = found["last"][0]
    best = f"log-likelihood {estimate.objective:.2f}; {len(estimate.others)} other optima"
    yield timed(section, "four starts, both profiles", "s", times, at_most=12.0, note=best)


def _children(command: list[str], environment: dict[str, str]) -> tuple[float, subprocess.CompletedProcess]:
    """CPU seconds of a command."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, done


def command_line(quick: bool) -> Iterator[Figure]:
    """`hygrokf --help`, and `hygrokf fit` on the demo case from a cold process."""
    with tempfile.TemporaryDirectory() as folder:
        cache = str(Path(folder) / "kernels")
        environment = {**os.environ, "HYGROKF_CACHE": cache}
        hygrokf = [sys.executable, "-m", "hygrokf.commands.main"]
        runs = [_children([*hygrokf, "--help"], environment) for _ in range(3 if quick else 9)]
        fault = next((done for _, done in runs if done.returncode), None)
        if fault is not None:
            yield Figure("command", "hygrokf --help", "s", float("nan"), note=f"not run: {_last_line(fault)}")
            return
        yield timed("command", "hygrokf --help", "s", Times(np.array([s for s, _ in runs])), at_most=0.5)
        if quick:
            return
        from hygrokf.cases.synthetic import synthetic_turbine, write_case

        made = write_case(synthetic_turbine(seed=1), folder)
        fit_it = [*hygrokf, "fit", str(made), "--out", str(Path(folder) / "fit")]
        cold, done = _children(fit_it, environment)
        if done.returncode:
            yield Figure("command", "hygrokf fit", "s", float("nan"), note=f"not run: {_last_line(done)}")
            return
        yield Figure("command", "hygrokf fit on the demo case, no compiled code yet", "s", cold)
        warm = Times(np.array([_children(fit_it, environment)[0] for _ in range(3)]))
        yield timed("command", "hygrokf fit on the demo case, compiled code on disk", "s", warm, at_most=20.0)


def _last_line(done: subprocess.CompletedProcess) -> str:
    lines = (done.stderr or done.stdout).strip().splitlines()
    return lines[-1] if lines else f"exit status {done.returncode}"


def memory(quick: bool) -> Iterator[Figure]:
    """Bytes an instant: the timeline's arrays and what a likelihood, a score and an information allocate and
    keep."""
    count = 26_000 if quick else 262_000
    for name, make in (("thermal, 1 state", cases.thermal), ("joint, 4 states", cases.joint)):
        case = make(count)
        t, values = case.likelihood.timeline, case.values
        directions = np.eye(len(values))
        held = sum(a.nbytes for a in (t.time, t.key, t.steps, t.u, t.y, t.reset)) / count
        calls: dict[str, Callable[[Likelihood], object]] = {
            "value": lambda made, values=values: made.value(values),
            "score": lambda made, values=values: made.score(values),
            "score and information": lambda made, values=values, d=directions: made.sensitivities(values, d),
        }
        for what, call in calls.items():
            call(
                Likelihood(case.likelihood.model, t.window(0, 100))
            )  # the compiler's memory is not the likelihood's
            fresh = Likelihood(case.likelihood.model, t)
            tracemalloc.start()
            call(fresh)
            peak = tracemalloc.get_traced_memory()[1] / count
            tracemalloc.stop()
            yield Figure(
                f"memory, {name}, N = {count:,}",
                what,
                "bytes/instant",
                held + peak,
                at_most=300.0,
                note=f"{held:.0f} for the timeline's arrays, {peak:.0f} of workspace",
            )


SECTIONS: dict[str, Section] = {
    "thermal": thermal,
    "joint": joint,
    "thermal10k": thermal10k,
    "fit": fit,
    "command": command_line,
    "memory": memory,
}
