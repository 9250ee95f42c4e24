"""What all trials of causes share: a record, its two likelihoods at their maxima, and their errors day by day.

The two parts of the cascade are tried by themselves: "thermal" on the cabinet temperature, "hygric" on the humidity
with the smoothed temperature as its input.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from hygrokf.design import CASCADE, Design, design, extended
from hygrokf.drivers import Run, run
from hygrokf.fitting import Objective, climb
from hygrokf.likelihood import Likelihood
from hygrokf.parameters import Coordinates
from hygrokf.psychrometrics import absolute_humidity
from hygrokf.record import Record
from hygrokf.stage import Estimated, Progress, estimated, smoothed_temperature
from hygrokf.stationary import heat_release_regression

THERMAL = "thermal"
HYGRIC = "hygric"
DAY_H = 24.0


@dataclass(frozen=True)
class Part:
    """One likelihood of a scene at its maximum: `objective` ln L + ln prior, `values` of its parameters, n readings.

    `error` (T,) reading − free run in K or g/m³ at the run's instants, NaN where there is none or it is not scored.
    """

    name: str
    record: Record
    base: Design
    run: Run
    values: Mapping[str, float]
    objective: float
    converged: bool
    error: np.ndarray

    @property
    def n(self) -> int:
        return self.run.timeline.n_readings

    @property
    def parameters(self) -> int:
        return len(self.base.model.parameters)

    @property
    def time_s(self) -> np.ndarray:
        t = self.run.timeline
        return t.origin_s + 3600.0 * t.time


@dataclass(frozen=True)
class Scene:
    """The identification period of a record and the parts that were identified on it."""

    record: Record
    parts: Mapping[str, Part]


def scene(record: Record, starts: int = 2, say: Progress = lambda text: None) -> Scene:
    """Identify the base model on the identification period of a record."""
    early = record.identification()
    regression = heat_release_regression(early)
    order = 2
    if regression.operation is not None and regression.operation.coefficients:
        order = max(2, regression.operation.order)
    parts: dict[str, Part] = {}
    thermal = estimated(
        early, design(early, kind=THERMAL, power_order=order, heat_start=regression.start()), starts, say
    )
    parts[THERMAL] = part_of(THERMAL, early, thermal)
    base = design(early, kind=CASCADE)
    if base.humidity is not None:
        say("smoothed cabinet temperature")
        driven = early.replace_series(smoothed_temperature(thermal, early, base.humidity))
        parts[HYGRIC] = part_of(HYGRIC, driven, estimated(driven, base, starts, say))
    return Scene(early, parts)


def part_of(name: str, record: Record, found: Estimated) -> Part:
    estimate = found.estimate
    return _part(name, record, found.base, found.run, estimate.values, estimate.objective, estimate.converged)


def refitted(
    part: Part,
    additions: Sequence[tuple[str, dict]],
    features: Mapping[str, dict],
    starts: Sequence[Mapping[str, float]],
    record: Record | None = None,
) -> Part:
    """The part with further mechanisms, all its parameters estimated again, the noise's too; the best of several starts."""
    wider = extended(part.base, additions, features=features)
    record = part.record if record is None else record
    made = run(wider, record)
    likelihood = Likelihood(wider.model, made.timeline)
    coordinates = Coordinates(wider.model.parameters)
    objective = Objective(likelihood, coordinates)
    given = {p.name: p.start for p in wider.model.parameters} | dict(part.values)
    first = [coordinates.start({**given, **start}) for start in starts or ({},)]
    if len(first) > 1:  # a start that is far behind after a few passes is not followed
        short = [climb(objective, z, passes=4, tolerance=1.0) for z in first]
        first = [max(short, key=lambda o: o.objective).z]
    best = climb(objective, first[0], passes=20, tolerance=0.2)
    values = coordinates.values(best.z)
    return _part(part.name, record, wider, made, values, best.objective, best.converged)


def _part(
    name: str,
    record: Record,
    base: Design,
    made: Run,
    values: Mapping[str, float],
    objective: float,
    converged: bool,
) -> Part:
    return Part(
        name, record, base, made, dict(values), objective, converged, free_run_error(base, made, values)
    )


def free_run_error(base: Design, made: Run, values: Mapping[str, float]) -> np.ndarray:
    """Reading − free run (T,): temperature [K]; humidity as absolute humidity [g/m³] at the measured temperature.

    Where innovations estimate a model that lacks something it is a poor simulator.  So the error is that of the better
    of two: of the estimate as it is, and after one Gauss–Newton step toward the least free-run error.
    """
    model, t = base.model, made.timeline
    likelihood = Likelihood(model, t)
    own = [i for i, p in enumerate(model.parameters) if not p.noise]
    directions = np.zeros((len(model.parameters), len(own)))
    for column, i in enumerate(own):
        p = model.parameters[i]
        directions[i, column] = p.slope(values[p.name]) * (1.0 if p.prior is None else p.prior.sd)
    error, slopes = likelihood.residuals(values, directions)
    error, slopes = error[:, 0], slopes[:, 0, :]
    if t.outputs[0] == "cabinet_relative_humidity":
        weight = 1e3 * absolute_humidity(1.0, t.input("cabinet_temperature"))
        error, slopes = error * weight, slopes * weight[:, None]
    there = np.isfinite(error) & made.scored
    x, e = slopes[there], error[there]
    # a step of one in a coordinate (or a prior's standard deviation) costs as much as a day of errors
    ridge = 96.0 * float(np.mean(e**2)) if len(e) else 1.0
    step = np.linalg.solve(x.T @ x + ridge * np.eye(x.shape[1]), -x.T @ e) if len(e) else np.zeros(x.shape[1])
    better = np.where(there, error + slopes @ step, np.nan)
    return better if np.nansum(better**2) < np.sum(e**2) else np.where(there, error, np.nan)


def days(part: Part) -> np.ndarray:
    """Number (T,) of the day of each instant."""
    return np.floor(part.run.timeline.time / DAY_H).astype(int)


def rmse(part: Part) -> float:
    """Root mean squared free-run error [K], [g/m³]."""
    there = part.error[np.isfinite(part.error)]
    return float(np.sqrt(np.mean(there**2))) if len(there) else math.nan
