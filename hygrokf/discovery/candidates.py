"""Candidates of a search: a form of a cause fitted beside a parent, its evidence, and its rivals.

A parent is the model that a round starts from; a child is the parent with a form of one more cause.  The
evidence of a cause is its gain in −2 ln L minus k ln N for its k constants in each quantity and minus 2 ln of
the number of settings that were tried.  Gains are differences of maxima: the same rule stops the fits of
parent and child.  Evidence in days is the evidence divided by the ratio of the variance of the scores' daily
sums to that with independent readings.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hygrokf.discovery.discovery_results import HeldOutTest
from hygrokf.discovery.estimate import (
    LIGHT,
    POLISH,
    Calibration,
    Columns,
    acting,
    estimate_at,
    fitted,
    frame,
    slopes,
    weighted,
)
from hygrokf.discovery.screening import added, amplitudes, chord_gains, parent_of, widened
from hygrokf.discovery.simulator import Simulator
from hygrokf.discovery.starting_model import is_plausible
from hygrokf.modelling.causes.forms import Form, Setting
from hygrokf.physics.parameters import Parameter

ACCEPTED_EVIDENCE = 10.0
"""Evidence from which a cause is accepted."""
SWEEPS, FOLLOWED_JUMPS, LARGEST_RISE = 3, 2, 10.0
"""Number of sweeps of jumps; number of jumps of a sweep that are fitted; largest rise of −2 ln L by a jump
that is still fitted."""
CLOSE_Z = 2.0
"""Difference to the best candidate, in standard errors over the days, up to which a rival fits equally
well."""
SENSOR = "humidity_sensor_drift"
WATER = ("internal_moisture_source", "moisture_sorption", "condensation")
WATER_SHARE = 0.5
"""Smallest ratio of the evidence for water to that for a sensor error (both in days) at which water is
reported beside the sensor error."""


@dataclass(frozen=True)
class Candidate:
    """A cause in one form, fitted beside a parent model, with the evidence for it.

    setting: the form's fixed settings.  estimate: the parent extended by the form, fitted.
    gains: gain in −2 ln L by quantity.  constants: number of added parameters.
    searched: number of settings of the cause that were tried.
    evidence: the gains minus the penalties for constants and settings; in_days: the same, divided by the
        correction for readings that are correlated within a day.
    lacking: whether a quantity gains nothing although the form requires a gain in each.
    alike: codes of the cause's other forms that fit equally well.
    judged: the test on held-out readings.
    rivals: candidates of other causes that fit equally well.
    lead: evidence in days minus that of the best other cause.
    """

    form: Form
    setting: Setting
    estimate: Calibration
    gains: Mapping[str, float]
    constants: int
    searched: int
    evidence: float
    in_days: float
    lacking: bool = False
    alike: tuple[str, ...] = ()
    judged: HeldOutTest = field(default_factory=HeldOutTest)
    rivals: tuple[Candidate, ...] = ()
    lead: float = math.nan

    @property
    def cause(self) -> str:
        """Name of the cause."""
        return self.form.cause

    @property
    def acts(self) -> set[str]:
        """Quantities that the form changes: "temperature", "vapour" or both."""
        return acts(self.form, self.estimate.quantities)

    @property
    def plausible(self) -> bool:
        """Whether the simulations of the quantities that the form acts on are plausible."""
        return all(is_plausible(self.estimate, q) for q in self.acts)

    @property
    def wet(self) -> bool:
        """Whether the cause is a humidity sensor error that could also be explained by water."""
        return self.cause == SENSOR and any(rival.cause in WATER for rival in self.rivals)

    @property
    def strength(self) -> float:
        """The smaller of `evidence` and `in_days`; candidates are ranked and accepted by it."""
        return min(self.evidence, self.in_days)

    @property
    def factor(self) -> float:
        """Ratio of evidence to evidence in days."""
        return self.evidence / self.in_days if self.in_days > 0.0 else 1.0


def acts(form: Form, quantities: Sequence[str]) -> set[str]:
    """Return those of the quantities ("temperature", "vapour") that a form changes."""
    if form.clock:
        return set(quantities)
    if form.freed:
        return {"vapour"}
    pairs = (("temperature", form.heat), ("vapour", form.vapour or form.altered))
    return {q for q, mechanisms in pairs if mechanisms and q in quantities}


def own_parameters(form: Form, simulator: Simulator) -> frozenset[str]:
    """Return the names of the parameters that a form's own mechanisms add to a simulator."""
    mechanisms = {name for name, _ in (*form.heat, *form.vapour)}
    return frozenset(
        p.name
        for design in simulator.designs
        for m in design.model.mechanisms
        if m.name in mechanisms
        for p in m.parameters
    )


def fit_form(
    parent: Calibration,
    form: Form,
    setting: Setting,
    values: Mapping[str, float],
    effort: tuple[int, float],
    kept: Columns | None = None,
) -> Calibration:
    """Fit a parent model extended by a form, in the quantities that the form changes.

    setting: the form's fixed settings.  values: start values of the form's own parameters.
    effort: largest number of rounds, and the gain at which they end.
    kept: Jacobian columns to reuse instead of computing them.
    """
    wider = widened(parent, form, setting)
    sizes = frozenset(p.name for p in amplitudes(added(parent, wider)))
    theta = wider.vector({**parent.values, **values})
    start = estimate_at(wider, parent.errors, theta, parent.linear | sizes, parent.variances)
    return fitted(start, acting(start, acts(form, start.quantities)), effort, kept)


def candidate(
    parent: Calibration, child: Calibration, form: Form, setting: Setting, searched: int
) -> Candidate:
    """Return the candidate of a child model: its gains over the parent and its evidence.

    child: the parent extended by `form`, fitted.  searched: number of settings that were tried.  The
        correction for correlated days is computed only for evidence of at least `ACCEPTED_EVIDENCE`.
    """
    added_parameters = added(parent, child.simulator)
    gains, total_constants, lacking = {}, 0, False
    evidence = -2.0 * math.log(max(searched, 1)) - setting.price
    for q in child.quantities:
        gains[q] = float(parent.deviances[q] - child.deviances[q])
        constants = sum(child.simulator.affects(p.name)[0] == q for p in added_parameters)
        constants += (bool(form.clock) and q == "temperature") + (bool(form.freed) and q == "vapour")
        readings = int(np.isfinite(child.residual(q)).sum())
        net_gain = gains[q] - constants * math.log(max(readings, 2))
        lacking |= form.together and constants > 0 and net_gain <= 0.0
        total_constants += constants
        evidence += max(0.0, net_gain)
    factor = day_factor(parent, child) if evidence >= ACCEPTED_EVIDENCE else 1.0
    return Candidate(
        form, setting, child, gains, total_constants, searched, evidence, evidence / factor, lacking
    )


def day_factor(parent: Calibration, child: Calibration) -> float:
    """Return the factor (≥ 1) by which correlation within days overstates a child's evidence.

    It is tr(H⁻¹ J)/k over the k added parameters: H is their information given all other parameters, J the
    sum of squares of their daily scores.  With independent readings H = J in expectation.
    """
    added_names = {p.name for p in added(parent, child.simulator)}
    if not added_names:
        return _factor_of_gains(parent, child)
    coordinates = frame(child.simulator.parameters, set(child.simulator.names), child.linear)
    is_added = np.array([child.simulator.names[i] in added_names for i in coordinates.place])
    information, spread = np.zeros((2, is_added.sum(), is_added.sum()))
    for q, columns in slopes(child, coordinates).items():
        white, error = weighted(child, q, columns)
        white = white / np.maximum(np.sqrt((white**2).sum(axis=0)), 1e-300)
        other_columns = white[:, ~is_added]
        other_columns = other_columns[:, other_columns.any(axis=0)]
        basis = np.linalg.qr(other_columns)[0] if other_columns.shape[1] else other_columns
        own_part = white[:, is_added] - basis @ (basis.T @ white[:, is_added])
        daily = child.simulator.scene.readings[q].by_day(own_part * error[:, None])
        information += own_part.T @ own_part
        spread += daily.T @ daily
    return max(1.0, float(np.trace(np.linalg.pinv(information, rcond=1e-8) @ spread)) / is_added.sum())


def _factor_of_gains(parent: Calibration, child: Calibration) -> float:
    """Return the day factor of a child without added parameters, from its gains per day.

    With independent readings the variance of the summed gain is four times the sum.
    """
    gains = [_daily(child, parent, q) for q in child.quantities]
    total = sum(float(g.sum()) for g in gains)
    spread = sum(float(((g - g.mean()) ** 2).sum()) for g in gains)
    return max(1.0, spread / (4.0 * total)) if total > 0.0 else 1.0


def improved_by_jumps(parent: Calibration, best: Candidate) -> Candidate:
    """Return the candidate after trying large changes of its parameters and settings, to leave a local
    maximum.

    Each jump is simulated after one linear step of the other parameters (`chord_gains`).  The
    `FOLLOWED_JUMPS` best jumps are fitted, unless they are worse than the start by more than `LARGEST_RISE`.
    """
    steps = dict(best.form.steps)
    for _ in range(SWEEPS):
        deviance_before, parent_at_best = best.estimate.deviance, parent_of(best.estimate)
        promising = []
        for setting, values in _jumps(parent, best, steps):
            wider = widened(parent, best.form, setting)
            gain = chord_gains(parent_at_best, wider, wider.vector(values)[:, None], {}, best.acts)[0]
            promising.append((float(gain), setting, values))
        promising.sort(key=lambda jump: -jump[0])
        for gain, setting, values in promising[:FOLLOWED_JUMPS]:
            if gain < -LARGEST_RISE:
                break
            trial = fit_form(parent, best.form, setting, values, LIGHT, parent_at_best.columns)
            if trial.deviance < best.estimate.deviance + 0.5 * LARGEST_RISE:
                fit = fitted(trial, acting(trial, best.acts), POLISH)
                if fit.deviance < best.estimate.deviance - 0.1:
                    best = replace(
                        candidate(parent, fit, best.form, setting, best.searched), alike=best.alike
                    )
        steps = {key: 0.5 * step for key, step in steps.items()}
        if not best.estimate.deviance < deviance_before - 1.0 and not steps:
            break
    return best


def _jumps(
    parent: Calibration, best: Candidate, steps: Mapping[tuple[str, str], float]
) -> Iterator[tuple[Setting, dict[str, float]]]:
    """Yield the jumps to try from the best candidate: (setting, parameter values).

    Amplitudes are scaled, other parameters are shifted, and each setting moves by one of `steps`.
    """
    values, setting = best.estimate.values, best.setting
    added_parameters = added(parent, best.estimate.simulator)
    sizes = amplitudes(added_parameters)
    # the amplitude in one quantity may be right while that in the other is at a wrong maximum
    for moved in [sizes, *([p] for p in sizes if len(sizes) > 1)]:
        for factor in (2.5, 0.4) if moved else ():
            scaled = {p.name: (p.null or 0.0) + factor * (values[p.name] - (p.null or 0.0)) for p in moved}
            yield setting, values | {p.name: _within(p, scaled[p.name]) for p in moved}
    for p in added_parameters:
        for sign in (1.0, -1.0) if p not in sizes else ():
            further = 1.5**sign if p.positive else 1.0
            shift = 0.0 if p.positive else sign * 0.1 * min(p.upper - p.lower, 20.0)
            yield setting, values | {p.name: _within(p, values[p.name] * further + shift)}
    for (feature, key), step in steps.items():
        for sign in (1.0, -1.0):
            if feature == "clock":
                yield replace(setting, shift_s=setting.shift_s + sign * step), values
                continue
            # the effect of a date outside the record would be constant
            first_step = best.form.steps[feature, key]
            grid_values = [point.features[feature][key] for point in best.form.grid]
            settings = dict(setting.features[feature])
            target = settings[key] + sign * step
            settings[key] = float(
                np.clip(target, min(grid_values) - first_step, max(grid_values) + first_step)
            )
            yield replace(setting, features={**setting.features, feature: settings}), values


def _within(p: Parameter, value: float) -> float:
    """Return the value limited to the parameter's range; its null value counts as part of the range."""
    return float(np.clip(value, p.lower if p.null is None else min(p.lower, p.null), p.upper))


def moved_to_parent(parent: Calibration, candidate: Candidate) -> Calibration:
    """Return the candidate's fitted model with a newer parent, without refitting it.

    The newer parent must differ from the candidate's own parent only in quantities that the candidate leaves
    unchanged.
    """
    wider = widened(parent, candidate.form, candidate.setting)
    own_values = {
        n: v
        for n, v in candidate.estimate.values.items()
        if set(candidate.estimate.simulator.affects(n)) & candidate.acts
    }
    theta = wider.vector({**parent.values, **own_values})
    variances = {**parent.variances, **{q: candidate.estimate.variances[q] for q in candidate.acts}}
    return estimate_at(wider, parent.errors, theta, parent.linear | candidate.estimate.linear, variances)


def fits_equally_well(best: Candidate, rival: Candidate) -> bool:
    """Whether a rival explains the readings as well as the best candidate.

    They are compared in the quantities that both change, by Vuong's test on daily sums of −2 ln L.
    """
    shared = best.acts & rival.acts
    if not shared or rival.evidence < ACCEPTED_EVIDENCE:
        return False
    if best.evidence - rival.evidence < ACCEPTED_EVIDENCE:
        return True
    daily = np.concatenate([_daily(best.estimate, rival.estimate, q) for q in sorted(shared)])
    return float(daily.sum() / (math.sqrt(len(daily)) * max(daily.std(), 1e-12))) < CLOSE_Z


def _daily(best: Calibration, rival: Calibration, quantity: str) -> np.ndarray:
    """Return −2 ln L of the rival minus that of the best fit, summed by day (days,)."""
    terms = rival.filtered[quantity].terms - best.filtered[quantity].terms
    return best.simulator.scene.readings[quantity].by_day(terms)


def is_water_rival(best: Candidate, rival: Candidate) -> bool:
    """Whether a rival describes water that a humidity sensor error would wrongly explain away."""
    return best.cause == SENSOR and rival.cause in WATER and rival.in_days >= WATER_SHARE * best.in_days


def lead_over_others(best: Candidate, candidates: Sequence[Candidate]) -> float:
    """Return the candidate's evidence in days minus that of the best other cause.

    Only causes that share a quantity with the candidate count; without any, the other evidence is 0.
    """
    others = [c.in_days for c in candidates if c.cause != best.cause and c.acts & best.acts]
    return best.in_days - max([0.0, *others])
