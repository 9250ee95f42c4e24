"""Competing forms of one part of the model, and their shares of the evidence.

A time constant depends on the model's form: with a second thermal mass, natural convection, a second
disturbance or a slow sensor, the same readings give another value.  Each form here is the base with one more
mechanism, fitted from the base's own maximum (so that it is never worse), and has the evidence

    ln Z = ln L̂/c + Σ ln min(1, √(2π) σ_j / w_j),

over its further parameters j with the posterior standard deviations σ_j (each given those before it) and the
widths w_j of their ranges, in their coordinates: Laplace's approximation with priors that are flat over the
ranges.  For a parameter at a bound that the score g_j points beyond, the factor is 1/(|g_j| w_j).  c ≥ 1 is
the base's ratio of the sandwich variance to the plain one: under a slightly wrong model, 2 ln L̂ is too large
by that factor.

Weights are the shares of Z, with equal prior probability of all forms.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.engine.parallel import mapped
from hygrokf.estimation.confidence import Uncertainty, uncertainty_by
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.optimiser import Estimate, Objective, climb, estimate_of
from hygrokf.modelling.design import TEMPERATURE, Design, extended
from hygrokf.modelling.inputs import Run
from hygrokf.physics.mechanisms.thermal import STILL_K
from hygrokf.physics.parameters import Coordinates

BASE = "base"
CONVECTION = "natural convection"
SECOND_MASS = "second mass"
RESPONSE = "sensor response"
SECOND = {"heat_disturbance": "second heat disturbance", "vapour_disturbance": "second vapour disturbance"}
"""Coloured disturbances, and the names of the forms that add another one on another time scale."""
OTHER_TIMES = (0.2, 5.0)
"""[1] initial correlation times of a second disturbance, as multiples of the first one's."""
LONGEST_RESPONSE_H = 1.0 / 3.0
"""[h] longest response time of a humidity sensor without a stated one: behind filters 5 to 15 min are
usual."""
ADOPTED = 0.99
"""[1] share of the evidence with which a form becomes the base; with 0.95 a slow second disturbance replaced
drifting sensors, which then went undetected."""
PASSES = 15
"""Scoring passes after which a form's climb is stopped."""
TOLERANCE = 0.02
"""Promised gain in ln L at which the climb ends: a fiftieth of a gain that changes a weight noticeably."""
STEP_TOLERANCE = 1e-5
"""[1] `tolerance` of the sub-steps while forms are compared, where the last digits do not matter."""
SCOUT_GAIN = -3.0
"""Change of ln L on the shorter stretch below which a form is not tried on the whole record."""
UNSTATED = {
    "cabinet_relative_humidity": "humidity_sensor",
    "cabinet_absolute_humidity": "absolute_humidity_sensor",
}
"""Signals whose sensor response is estimated where it is not stated, and the mechanisms of these sensors."""


@dataclass(frozen=True)
class CandidateDesign:
    """A form to try: `design`, start values besides the base's maximum, and whether it may become the
    base."""

    name: str
    design: Design
    starts: tuple[Mapping[str, float], ...]
    adoptable: bool


@dataclass(frozen=True)
class FittedForm:
    """A form on one record.

    `estimate` is its maximum; `gain` its advantage over the base in the penalised ln L; `weight` its share of
    the evidence [1]; `covariance` (f, f) that of the coordinates `names` inside their bounds, from the wider
    of expected information and sandwich.
    """

    name: str
    design: Design
    estimate: Estimate
    gain: float
    weight: float
    names: tuple[str, ...]
    covariance: np.ndarray
    adoptable: bool = False

    def within(self, chosen: FittedForm) -> FittedForm:
        """This form as one of those that share the weight of an adopted form."""
        name = chosen.name if self.name == BASE else f"{chosen.name} + {self.name}"
        return replace(self, name=name, gain=chosen.gain + self.gain, weight=chosen.weight * self.weight)

    def variance(self, slopes: Mapping[str, float]) -> float:
        """Variance of a combination of coordinates with these slopes (delta method); coordinates at a bound
        contribute none."""
        inside = [name for name in slopes if name in self.names]
        places = [self.names.index(name) for name in inside]
        slope = np.array([slopes[name] for name in inside])
        return float(slope @ self.covariance[np.ix_(places, places)] @ slope) if inside else 0.0


def candidates(base: Design, run: Run, values: Mapping[str, float]) -> list[CandidateDesign]:
    """The forms to compare with a design on its run, except those that the design already contains; they read
    the same inputs, so that the run is theirs, too."""
    names = [name for name, _ in base.mechanisms]
    found: list[CandidateDesign] = []
    if "thermal_network" in names:
        apart = np.abs(run.timeline.reading(TEMPERATURE) - run.timeline.input("ambient_temperature"))
        difference = float(np.nanmedian(apart)) if np.isfinite(apart).any() else 0.0
        if "natural_convection" not in names and difference > STILL_K:
            wider = extended(base, [("natural_convection", {"difference_K": difference})])
            found.append(CandidateDesign(CONVECTION, wider, ({"convection_exponent": 0.1},), True))
        if "wall_thermal_mass" not in names:
            wider = extended(base, [("wall_thermal_mass", {})])
            start = {"wall_conductance": 0.1, "wall_time_constant": 5.0, "wall_position": 0.9}
            found.append(CandidateDesign(SECOND_MASS, wider, (start,), False))
    for signal, sensor in UNSTATED.items():
        known = run.record[signal] if base.humidity == signal and signal in run.record else None
        if known is None or known.response_time_s is not None:
            continue
        settings = dict(base.mechanisms)[sensor]
        if settings.get("longest_response_h") is None:
            responding = {**settings, "longest_response_h": LONGEST_RESPONSE_H}
            wider = replace(
                base, mechanisms=tuple((m, responding if m == sensor else s) for m, s in base.mechanisms)
            )
            found.append(CandidateDesign(RESPONSE, wider, ({f"{signal}_response": 0.1},), True))
    return found + [
        _second(base, first, values) for first in SECOND if first in names and f"second_{first}" not in names
    ]


def _second(base: Design, first: str, values: Mapping[str, float]) -> CandidateDesign:
    """A second disturbance of the same kind, with a faster and a slower start.

    Real disturbances rarely have a single time scale, and the remainder would be attributed to the cabinet's
    dynamics.
    """
    time, sd = values[f"{first}_time"], values[f"{first}_sd"]
    settings = {**dict(base.mechanisms)[first], "start_h": OTHER_TIMES[0] * time}
    starts = tuple(
        {f"second_{first}_time": factor * time, f"second_{first}_sd": 0.4 * sd} for factor in OTHER_TIMES
    )
    return CandidateDesign(SECOND[first], extended(base, [(f"second_{first}", settings)]), starts, True)


def weigh_forms(
    base: Design,
    run: Run,
    estimate: Estimate,
    constants: Sequence[str],
    scout: Likelihood | None = None,
) -> tuple[FittedForm, ...]:
    """The base and its competing forms, with their weights.

    `run` is the base's run on the identification period; `constants` are the parameters of interest, whose
    misfit tempers the evidence; `scout` is the base's likelihood of a shorter stretch, on which every form is
    tried first.
    """
    likelihood = Likelihood(base.model, run.timeline)
    at_base, _ = _curvature(likelihood, estimate)
    places = [at_base.names.index(name) for name in constants if name in at_base.names]
    temper = max([1.0, *(float(at_base.factor[i]) for i in places)])
    # the base's maximum on the shorter stretch
    known = -math.inf
    if scout is not None:
        start = Objective(scout, estimate.coordinates)
        known = climb(start, estimate.z, passes=8, tolerance=1e-2).objective
    forms = [FittedForm(BASE, base, estimate, 0.0, 1.0, at_base.names, at_base.wider)]
    evidence = [0.0]

    def try_form(one: CandidateDesign) -> tuple[FittedForm, float] | None:
        """A form and its evidence; None where the shorter stretch rules it out."""
        likelihood = Likelihood(one.design.model, run.timeline, tolerance=STEP_TOLERANCE)
        found = _fitted(one, likelihood, estimate, scout, known)
        if found is None:
            return None
        at, score = _curvature(likelihood, found)
        gain = found.objective - estimate.objective
        further = [p.name for p in found.coordinates.free if p.name not in estimate.coordinates.names]
        adoptable = one.adoptable and not ended_at_limits(found, estimate)
        spread = _within_ranges(found, at, further)
        form = FittedForm(one.name, one.design, found, gain, 0.0, at.names, spread, adoptable)
        return form, gain / temper + _occam(found, at, score, further, temper)

    for tried in mapped(try_form, candidates(base, run, estimate.values)):
        if tried is not None:
            forms.append(tried[0])
            evidence.append(tried[1])
    share = np.exp(np.array(evidence) - max(evidence))
    weights = (share / share.sum()).tolist()
    return tuple(replace(form, weight=weight) for form, weight in zip(forms, weights, strict=True))


def ended_at_limits(found: Estimate, base: Estimate) -> set[str]:
    """Parameters of an estimate, besides the base's, that ended at a limit of their range, which indicates
    another cause.

    Parameters of disturbances are exempt: their limits are set by the step and the length of the record.
    """
    return {
        p.name
        for p in found.coordinates.free
        if not p.noise and p.name in found.at_bounds and p.name not in base.coordinates.names
    }


def _fitted(
    one: CandidateDesign, whole: Likelihood, base: Estimate, scout: Likelihood | None, known: float
) -> Estimate | None:
    """A form's maximum from its starts; None where it is too far below the `known` maximum of the base on the
    shorter stretch `scout`."""
    coordinates = Coordinates(one.design.model.parameters)
    starts = [coordinates.start({**base.values, **start}) for start in one.starts]
    if scout is not None:
        time = whole.timeline.time
        last = int(np.searchsorted(time, scout.timeline.time[-1], side="right"))
        cut = replace(whole, timeline=whole.timeline.window(0, last))
        tried = [climb(Objective(cut, coordinates), z, passes=12, tolerance=1e-2) for z in starts]
        best = max(tried, key=lambda found: found.objective)
        if best.objective - known < SCOUT_GAIN:
            return None
        starts = [best.z]
    found = [climb(Objective(whole, coordinates), z, passes=PASSES, tolerance=TOLERANCE) for z in starts]
    return estimate_of(whole, coordinates, found)


def _curvature(likelihood: Likelihood, estimate: Estimate) -> tuple[Uncertainty, dict[str, float]]:
    """Uncertainty and score at a maximum, by the expected information of one pass."""
    objective = Objective(likelihood, estimate.coordinates)
    at = objective.information(estimate.z, each=True)
    score = dict(zip(estimate.coordinates.names, at.score.tolist(), strict=True))
    return uncertainty_by(objective, estimate, at), score


def _within_ranges(estimate: Estimate, found: Uncertainty, further: Sequence[str]) -> np.ndarray:
    """The covariance (f, f) with the ranges of the further parameters as priors, flat ones taken as normal
    with their variance: where a form hardly acts, nothing else bounds what its parameters could imitate."""
    width = _ranges(estimate)
    places = [found.names.index(name) for name in further if name in found.names]
    known = np.diag([width[found.names[i]] ** 2 / 12.0 for i in places])
    column, block = found.wider[:, places], found.wider[np.ix_(places, places)]
    return found.wider - column @ np.linalg.solve(block + known, column.T)


def _ranges(estimate: Estimate) -> dict[str, float]:
    """Width of every parameter's range, in its coordinate."""
    coordinates = estimate.coordinates
    return dict(zip(coordinates.names, (coordinates.upper - coordinates.lower).tolist(), strict=True))


def _occam(
    estimate: Estimate, found: Uncertainty, score: Mapping[str, float], further: Sequence[str], temper: float
) -> float:
    """Logarithm of the share of the further parameters' ranges that remains after the readings."""
    width = _ranges(estimate)
    inside = [name for name in further if name in found.names]
    total = 0.0
    if inside:
        places = [found.names.index(name) for name in inside]
        block = temper * found.wald[np.ix_(places, places)]
        deviations = np.diag(np.linalg.cholesky(block + 1e-12 * np.diag(np.diag(block))))
        for name, sd in zip(inside, deviations, strict=True):
            total += math.log(min(1.0, math.sqrt(2.0 * math.pi) * float(sd) / width[name]))
    for name in set(further) - set(inside):
        steepness = abs(score[name]) / temper * width[name]
        total -= math.log(max(1.0, steepness))
    return total
