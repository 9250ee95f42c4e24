"""Competing forms of one part of the model, and their shares of the evidence.

A time constant depends on the model's form: with a second thermal mass, natural convection, a second
disturbance or a slow sensor, the same readings give another value.  Each form here is the base with one more
mechanism.  Its fit starts at the base's maximum, so that no form is worse than the base.  Its evidence is

    ln Z = ln L̂/c + Σ ln min(1, √(2π) σ_j / w_j),

over its further parameters j with the posterior standard deviations σ_j (conditional on the parameters before
j) and the widths w_j of their ranges, in their coordinates: Laplace's approximation with priors that are flat
over the ranges.  For a parameter at a bound with an outward score g_j, the factor is 1/(|g_j| w_j).
c ≥ 1 is the base's ratio of the sandwich variance to the plain one: under a slightly wrong model, 2 ln L̂ is
too large by the factor c.

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
from hygrokf.modelling.design import Design, extended
from hygrokf.modelling.inputs import Run
from hygrokf.physics.mechanisms.thermal import STILL_K
from hygrokf.physics.parameters import Coordinates
from hygrokf.physics.signal_names import CABINET_TEMPERATURE

BASE_FORM = "base"
CONVECTION = "natural convection"
SECOND_MASS = "second mass"
RESPONSE_FORM = "sensor response"
SECOND = {"heat_disturbance": "second heat disturbance", "vapour_disturbance": "second vapour disturbance"}
"""Coloured disturbance → name of the form that adds a second one with another correlation time."""
OTHER_TIMES = (0.2, 5.0)
"""[1] initial correlation times of a second disturbance, as multiples of the first one's."""
LONGEST_RESPONSE_H = 1.0 / 3.0
"""[h] longest response time of a humidity sensor whose response is not stated: 5 to 15 min are usual behind
filters."""
ADOPTED = 0.99
"""[1] share of the evidence from which a form becomes the base; with 0.95 a slow second disturbance took the
place of sensor drift, which then went undetected."""
FORM_PASSES = 15
"""Largest number of scoring passes of a form."""
FORM_TOLERANCE = 0.02
"""Expected gain in ln L at which scoring ends: a fiftieth of a gain that changes a weight noticeably."""
FORM_STEP_TOLERANCE = 1e-5
"""[1] `tolerance` of the sub-steps while forms are compared: a comparison needs few digits."""
LEAST_SHORT_GAIN = -3.0
"""Gain in ln L over the base on a shorter stretch below which a form is not fitted to the full record."""
SENSOR_OF = {
    "cabinet_relative_humidity": "humidity_sensor",
    "cabinet_absolute_humidity": "absolute_humidity_sensor",
}
"""Signal whose sensor response is estimated where it is not stated → mechanism of the sensor."""


@dataclass(frozen=True)
class CandidateDesign:
    """A form of the model to fit.

    `starts`: start values of its further parameters.  `adoptable`: whether it may become the base.
    """

    name: str
    design: Design
    starts: tuple[Mapping[str, float], ...]
    adoptable: bool


@dataclass(frozen=True)
class FittedForm:
    """A form of the model, fitted to a record.

    `estimate`: the maximum.  `gain`: penalised ln L minus that of the base.  `weight`: share of the evidence
        [1].

    `covariance` (f, f): of the coordinates `names`, all inside their bounds; the wider of inverse expected
    information and sandwich.
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
        """Return this form, which was fitted with `chosen` as its base, relative to the base of `chosen`.

        Gains add and weights multiply.
        """
        name = chosen.name if self.name == BASE_FORM else f"{chosen.name} + {self.name}"
        return replace(self, name=name, gain=chosen.gain + self.gain, weight=chosen.weight * self.weight)

    def variance(self, derivatives: Mapping[str, float]) -> float:
        """Return the variance of a function of the coordinates with these derivatives (delta method).

        Coordinates at a bound contribute nothing.
        """
        inside = [name for name in derivatives if name in self.names]
        places = [self.names.index(name) for name in inside]
        gradient = np.array([derivatives[name] for name in inside])
        return float(gradient @ self.covariance[np.ix_(places, places)] @ gradient) if inside else 0.0


def candidates(base: Design, run: Run, values: Mapping[str, float]) -> list[CandidateDesign]:
    """Return the forms to compare with a design, without those that it already contains.

    values: the base's parameter values.  All forms read the inputs of the base, so that they share its run.
    """
    names = [name for name, _ in base.mechanisms]
    forms: list[CandidateDesign] = []
    if "thermal_network" in names:
        differences = np.abs(
            run.timeline.reading(CABINET_TEMPERATURE) - run.timeline.input("ambient_temperature")
        )
        difference = float(np.nanmedian(differences)) if np.isfinite(differences).any() else 0.0
        if "natural_convection" not in names and difference > STILL_K:
            wider = extended(base, [("natural_convection", {"difference_K": difference})])
            forms.append(CandidateDesign(CONVECTION, wider, ({"convection_exponent": 0.1},), True))
        if "wall_thermal_mass" not in names:
            wider = extended(base, [("wall_thermal_mass", {})])
            start_values = {"wall_conductance": 0.1, "wall_time_constant": 5.0, "wall_position": 0.9}
            forms.append(CandidateDesign(SECOND_MASS, wider, (start_values,), False))
    for signal, sensor in SENSOR_OF.items():
        series = run.record[signal] if base.humidity == signal and signal in run.record else None
        if series is None or series.response_time_s is not None:
            continue
        settings = dict(base.mechanisms)[sensor]
        if settings.get("longest_response_h") is None:
            responding = {**settings, "longest_response_h": LONGEST_RESPONSE_H}
            wider = replace(
                base,
                mechanisms=tuple(
                    (name_of_mechanism, responding if name_of_mechanism == sensor else settings_of_mechanism)
                    for name_of_mechanism, settings_of_mechanism in base.mechanisms
                ),
            )
            forms.append(CandidateDesign(RESPONSE_FORM, wider, ({f"{signal}_response": 0.1},), True))
    return forms + [
        _second(base, disturbance, values)
        for disturbance in SECOND
        if disturbance in names and f"second_{disturbance}" not in names
    ]


def _second(base: Design, disturbance: str, values: Mapping[str, float]) -> CandidateDesign:
    """Return the form with a second disturbance of the same kind.

    It is started from a shorter and from a longer correlation time.  Real disturbances rarely have a single
    time scale; without a second one, the rest would be attributed to the cabinet's dynamics.
    """
    time, sd = values[f"{disturbance}_time"], values[f"{disturbance}_sd"]
    settings = {**dict(base.mechanisms)[disturbance], "start_h": OTHER_TIMES[0] * time}
    starts = tuple(
        {f"second_{disturbance}_time": factor * time, f"second_{disturbance}_sd": 0.4 * sd}
        for factor in OTHER_TIMES
    )
    return CandidateDesign(
        SECOND[disturbance], extended(base, [(f"second_{disturbance}", settings)]), starts, True
    )


def weigh_forms(
    base: Design,
    run: Run,
    estimate: Estimate,
    constants: Sequence[str],
    short_likelihood: Likelihood | None = None,
) -> tuple[FittedForm, ...]:
    """Fit the base's competing forms and return all, the base first, with their shares of the evidence.

    run, estimate: of the base on the identification period.
    constants: the parameters of interest; the largest of their variance ratios is c of the evidence.
    short_likelihood: the base's likelihood on a shorter stretch, on which every form is fitted first.
    """
    likelihood = Likelihood(base.model, run.timeline)
    at_base, _ = _curvature(likelihood, estimate)
    places = [at_base.names.index(name) for name in constants if name in at_base.names]
    variance_ratio = max([1.0, *(float(at_base.factor[i]) for i in places)])
    base_maximum_on_short = -math.inf
    if short_likelihood is not None:
        short_objective = Objective(short_likelihood, estimate.coordinates)
        base_maximum_on_short = climb(short_objective, estimate.z, passes=8, tolerance=1e-2).objective
    forms = [FittedForm(BASE_FORM, base, estimate, 0.0, 1.0, at_base.names, at_base.wider)]
    evidence = [0.0]

    def fit_form(candidate: CandidateDesign) -> tuple[FittedForm, float] | None:
        """A form and its evidence; None where the shorter stretch rules the form out."""
        likelihood = Likelihood(candidate.design.model, run.timeline, tolerance=FORM_STEP_TOLERANCE)
        optimum = _maximise(candidate, likelihood, estimate, short_likelihood, base_maximum_on_short)
        if optimum is None:
            return None
        at_optimum, score = _curvature(likelihood, optimum)
        gain = optimum.objective - estimate.objective
        further = [p.name for p in optimum.coordinates.free if p.name not in estimate.coordinates.names]
        adoptable = candidate.adoptable and not ended_at_limits(optimum, estimate)
        covariance = _within_ranges(optimum, at_optimum, further)
        form = FittedForm(
            candidate.name, candidate.design, optimum, gain, 0.0, at_optimum.names, covariance, adoptable
        )
        return form, gain / variance_ratio + _occam(optimum, at_optimum, score, further, variance_ratio)

    for fitted_form in mapped(fit_form, candidates(base, run, estimate.values)):
        if fitted_form is not None:
            forms.append(fitted_form[0])
            evidence.append(fitted_form[1])
    relative_evidence = np.exp(np.array(evidence) - max(evidence))
    weights = (relative_evidence / relative_evidence.sum()).tolist()
    return tuple(replace(form, weight=weight) for form, weight in zip(forms, weights, strict=True))


def ended_at_limits(estimate: Estimate, base: Estimate) -> set[str]:
    """Return the further parameters of a form that ended at a limit of their range, a sign of another cause.

    Parameters of disturbances are exempt: the step and the length of the record set their limits.
    """
    return {
        p.name
        for p in estimate.coordinates.free
        if not p.noise and p.name in estimate.at_bounds and p.name not in base.coordinates.names
    }


def _maximise(
    candidate: CandidateDesign,
    likelihood: Likelihood,
    base: Estimate,
    short_likelihood: Likelihood | None,
    base_maximum_on_short: float,
) -> Estimate | None:
    """Fit a form from its starts; None where it is too far below the base on the shorter stretch.

    base_maximum_on_short: ln L of the base there.
    """
    coordinates = Coordinates(candidate.design.model.parameters)
    starts = [coordinates.start({**base.values, **start}) for start in candidate.starts]
    if short_likelihood is not None:
        time = likelihood.timeline.time
        end_of_short = int(np.searchsorted(time, short_likelihood.timeline.time[-1], side="right"))
        short = replace(likelihood, timeline=likelihood.timeline.window(0, end_of_short))
        short_optima = [
            climb(Objective(short, coordinates), position, passes=12, tolerance=1e-2) for position in starts
        ]
        best_on_short = max(short_optima, key=lambda optimum: optimum.objective)
        if best_on_short.objective - base_maximum_on_short < LEAST_SHORT_GAIN:
            return None
        starts = [best_on_short.z]
    optima = [
        climb(Objective(likelihood, coordinates), position, passes=FORM_PASSES, tolerance=FORM_TOLERANCE)
        for position in starts
    ]
    return estimate_of(likelihood, coordinates, optima)


def _curvature(likelihood: Likelihood, estimate: Estimate) -> tuple[Uncertainty, dict[str, float]]:
    """Return the uncertainty and the score (by name) at a maximum, by the expected information."""
    objective = Objective(likelihood, estimate.coordinates)
    information = objective.information(estimate.z, each=True)
    score = dict(zip(estimate.coordinates.names, information.score.tolist(), strict=True))
    return uncertainty_by(objective, estimate, information), score


def _within_ranges(estimate: Estimate, uncertainty: Uncertainty, further: Sequence[str]) -> np.ndarray:
    """Return the covariance (f, f), limited by the ranges of the further parameters.

    Each further parameter gets a normal prior with the variance of its range: where a form hardly acts,
    nothing else bounds what its parameters could imitate.
    """
    range_widths = _ranges(estimate)
    indices = [uncertainty.names.index(name) for name in further if name in uncertainty.names]
    prior = np.diag([range_widths[uncertainty.names[i]] ** 2 / 12.0 for i in indices])
    covariance_with_further, covariance_of_further = (
        uncertainty.wider[:, indices],
        uncertainty.wider[np.ix_(indices, indices)],
    )
    return uncertainty.wider - covariance_with_further @ np.linalg.solve(
        covariance_of_further + prior, covariance_with_further.T
    )


def _ranges(estimate: Estimate) -> dict[str, float]:
    """Return the width of every parameter's range, in its coordinate."""
    coordinates = estimate.coordinates
    return dict(zip(coordinates.names, (coordinates.upper - coordinates.lower).tolist(), strict=True))


def _occam(
    estimate: Estimate,
    uncertainty: Uncertainty,
    score: Mapping[str, float],
    further: Sequence[str],
    variance_ratio: float,
) -> float:
    """Return the logarithm of the share of the further parameters' ranges that the readings leave (Occam
    factor)."""
    range_widths = _ranges(estimate)
    inside = [name for name in further if name in uncertainty.names]
    log_share = 0.0
    if inside:
        indices = [uncertainty.names.index(name) for name in inside]
        scaled_covariance = variance_ratio * uncertainty.wald[np.ix_(indices, indices)]
        deviations = np.diag(
            np.linalg.cholesky(scaled_covariance + 1e-12 * np.diag(np.diag(scaled_covariance)))
        )
        for name, sd in zip(inside, deviations, strict=True):
            log_share += math.log(min(1.0, math.sqrt(2.0 * math.pi) * float(sd) / range_widths[name]))
    for name in set(further) - set(inside):
        steepness = abs(score[name]) / variance_ratio * range_widths[name]
        log_share -= math.log(max(1.0, steepness))
    return log_share
