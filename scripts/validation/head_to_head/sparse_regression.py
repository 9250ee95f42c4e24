"""PySINDy on the courses in an .npz file; run as a file by an interpreter that has it: sparse_regression.py
IN OUT.

In: `grid` [s] (T,), `until_s`, `known` (T,) whether the states were read there, and courses by name: `T` [K]
and `v` [g/m³] the states, the others control inputs.  Out: the simulated states, and as JSON the terms of the
chosen model by state.
"""

from __future__ import annotations

import json
import sys
import time
import warnings

import numpy as np
import pysindy

STATES = ("T", "v")
TEMPERATURES, VAPOURS = ("T", "Ta"), ("v", "va")
BASE = {"T": ("Ta", "P", "P2", "preheating", "heater", "fan"), "v": ("va", "preheating", "heater", "fan")}
"""Inputs of the model without any candidate, by state."""
THRESHOLDS = (0.003, 0.01, 0.03, 0.1, 0.3)
DEGREES = (1, 2)
DERIVATIVES = ("forward", "smoothed")
LEAST_SEGMENT = 24
LARGEST = 50.0
"""A scaled state beyond which a simulation has diverged."""
TAIL = 0.2


class Model:
    """Equations of some states as a polynomial of all variables, and their simulation."""

    def __init__(
        self, states: tuple[str, ...], names: list[str], powers: np.ndarray, rates: np.ndarray
    ) -> None:
        kept = (np.abs(rates) > 0.0).any(axis=0)
        self.states, self.names = states, names
        self.powers, self.rates = powers[kept], rates[:, kept]

    def terms(self) -> list[str]:
        return [
            " ".join(name for name, power in zip(self.names, row, strict=True) for _ in range(int(power)))
            or "1"
            for row in self.powers
        ]

    def features(self, values: np.ndarray) -> np.ndarray:
        """(T, f) terms of variables (T, m)."""
        return np.stack([np.prod(values**row, axis=1) for row in self.powers], axis=1)

    def simulate(self, start: np.ndarray, inputs: np.ndarray, step_h: float, parts: int) -> np.ndarray:
        """States (T, n) by Euler steps, `parts` of them in each step of the grid; NaN once it has
        diverged."""
        own = self.powers[:, : len(self.states)].astype(int)
        driven = np.stack(
            [np.prod(inputs**row, axis=1) for row in self.powers[:, len(self.states) :]], axis=1
        )
        at, found = start.astype(float).copy(), np.full((len(inputs), len(self.states)), np.nan)
        for k in range(len(inputs)):
            found[k] = at
            for _ in range(parts):
                at = at + step_h / parts * (self.rates @ (driven[k] * np.prod(at**own, axis=1)))
            if not np.all(np.abs(at) < LARGEST):
                break
        return found


def scaled(
    courses: dict[str, np.ndarray], early: np.ndarray
) -> tuple[dict[str, np.ndarray], dict[str, tuple[float, float]]]:
    """Courses in ordinary units: both temperatures with one zero and scale, both vapours too; others by their
    largest."""
    found, units = {}, {}
    for name, course in courses.items():
        like = next((pair for pair in (TEMPERATURES, VAPOURS) if name in pair), None)
        if like is None:
            units[name] = (0.0, float(np.abs(course[early]).max()) or 1.0)
        else:
            both = np.concatenate([courses[one][early] for one in like if one in courses])
            units[name] = (float(both.mean()), float(both.std()))
        found[name] = (course - units[name][0]) / units[name][1]
    return found, units


def segments(known: np.ndarray) -> list[slice]:
    """Stretches without a gap, of a day's quarter at least."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], known.astype(int), [0]])))
    return [slice(a, b) for a, b in edges.reshape(-1, 2) if b - a >= LEAST_SEGMENT]


def fitted(
    courses: dict[str, np.ndarray], states: tuple[str, ...], inputs: list[str], pieces: list[slice],
    step_h: float, degree: int, threshold: float, derivative: str, bias: bool = True,
) -> Model:  # fmt: skip
    x_of = np.stack([courses[name] for name in states], axis=1)
    u_of = np.stack([courses[name] for name in inputs], axis=1)
    xs, us, rates = [], [], []
    for piece in pieces:
        x = x_of[piece]
        if derivative == "forward":
            xs.append(x[:-1])
            us.append(u_of[piece][:-1])
            rates.append(np.diff(x, axis=0) / step_h)
        else:
            smooth = pysindy.SmoothedFiniteDifference(smoother_kws={"window_length": 5, "polyorder": 2})
            xs.append(x)
            us.append(u_of[piece])
            rates.append(np.asarray(smooth(x, step_h * np.arange(len(x)))))
    library = pysindy.PolynomialLibrary(degree=degree, include_bias=bias)
    model = pysindy.SINDy(optimizer=pysindy.STLSQ(threshold=threshold), feature_library=library)
    model.fit(xs, t=step_h, x_dot=rates, u=us)
    return Model(states, [*states, *inputs], np.asarray(library.powers_), np.asarray(model.coefficients()))


def base(
    courses: dict, states: tuple[str, ...], pieces: list[slice], step_h: float, derivative: str
) -> list[Model]:
    """One linear model a state: exchange with the ambient, and for the temperature the power and its
    square."""
    return [
        fitted(courses, (state,), [n for n in BASE[state] if n in courses], pieces, step_h, 1, 0.0,
            derivative, state == "T")
        for state in states
    ]  # fmt: skip


def simulated(
    models: list[Model], courses: dict[str, np.ndarray], step_h: float, parts: int
) -> dict[str, np.ndarray]:
    found = {}
    for model in models:
        start = np.array([courses[name][0] for name in model.states])
        inputs = np.stack([courses[name] for name in model.names[len(model.states) :]], axis=1)
        states = model.simulate(start, inputs, step_h, parts)
        found |= {name: states[:, i] for i, name in enumerate(model.states)}
    return found


def missed(run: dict[str, np.ndarray], courses: dict[str, np.ndarray], known: np.ndarray) -> float:
    """Sum over the states of the root mean squared error over the reading's spread; infinite where a run
    diverged."""
    parts = [np.sqrt(np.mean((run[n] - courses[n])[known] ** 2)) / np.std(courses[n][known]) for n in run]
    return float(np.sum(parts)) if np.isfinite(parts).all() else float("inf")


def told(models: list[Model], courses: dict[str, np.ndarray], early: np.ndarray) -> dict[str, list]:
    """By state, (term, size) of what the base does not have: the term's spread in the rate's, the largest
    first."""
    found: dict[str, list] = {}
    for model in models:
        values = np.stack([courses[name] for name in model.names], axis=1)[early]
        features = model.features(values)
        for row, state in zip(model.rates, model.states, strict=True):
            spread = float(np.std(features @ row)) or 1.0
            free = {state, *BASE[state], *(("1",) if state == "T" else ()), "P P"}
            sizes = [
                (term, float(abs(rate) * np.sqrt(np.mean(column**2)) / spread))
                for term, rate, column in zip(model.terms(), row, features.T, strict=True)
                if rate != 0.0 and term not in free
            ]
            found[state] = sorted(sizes, key=lambda one: -one[1])
    return found


def main(given: str, out: str) -> None:
    warnings.simplefilter("ignore")
    data = dict(np.load(given))
    begin = time.process_time()
    grid, until, known = data.pop("grid"), float(data.pop("until_s")), data.pop("known")
    step_h = float(grid[1] - grid[0]) / 3600.0
    early = grid <= until
    courses, units = scaled(data, early)
    courses["P2"] = courses["P"] ** 2 if "P" in courses else np.zeros(len(grid))
    states = tuple(name for name in STATES if name in courses)
    inputs = [name for name in courses if name not in (*states, "P2")]
    cut = int((1.0 - TAIL) * early.sum())
    first, tail = np.arange(len(grid)) < cut, slice(cut, int(early.sum()))
    later = {name: course[tail] for name, course in courses.items()}
    settings: list[tuple] = [(None, 0.0, derivative) for derivative in DERIVATIVES]
    settings += [(d, threshold, one) for d in DEGREES for threshold in THRESHOLDS for one in DERIVATIVES]

    def made(setting: tuple, there: np.ndarray) -> list[Model]:
        degree, threshold, derivative = setting
        pieces = segments(known & there)
        if degree is None:
            return base(courses, states, pieces, step_h, derivative)
        return [fitted(courses, states, inputs, pieces, step_h, degree, threshold, derivative)]

    def score(setting: tuple) -> float:
        models = made(setting, first)
        if not all(len(model.powers) for model in models):
            return float("inf")
        return missed(
            simulated(models, later, step_h, 1 if setting[2] == "forward" else 4), later, known[tail]
        )

    with np.errstate(all="ignore"):
        order = sorted((score(setting), place) for place, setting in enumerate(settings))
        for (
            _,
            place,
        ) in order:  # the best setting whose model, estimated again, does not diverge where it was identified
            best = settings[place]
            models = made(best, early)
            run = simulated(models, courses, step_h, 1 if best[2] == "forward" else 4)
            if all(np.isfinite(course[early]).all() for course in run.values()):
                break
    back = {name: course * units[name][1] + units[name][0] for name, course in run.items()}
    account = {
        "terms": told(models, courses, early),
        "setting": {"degree": best[0], "threshold": best[1], "derivative": best[2]},
        "cpu_s": time.process_time() - begin,
        "version": pysindy.__version__,
    }
    np.savez(out, account=json.dumps(account), **back)


if __name__ == "__main__":
    main(*sys.argv[1:])
