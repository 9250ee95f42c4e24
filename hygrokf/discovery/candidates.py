"""Candidates of a search: a form of a cause fitted beside a parent, its evidence, and its rivals.

Evidence of a cause is what it gains in −2 ln L, less k ln N for its k constants in each quantity and 2 ln of
the number of settings that were tried.  Gains are differences of maxima: parent and child are fitted until
the same rule stops them.  Evidence in days divides it by how much the days' sums of the cause's own scores
vary beyond independent readings.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

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
from hygrokf.discovery.results import HeldOutTest
from hygrokf.discovery.screening import added, amplitudes, chord_gains, parent_of, widened
from hygrokf.discovery.simulator import Simulator
from hygrokf.modelling.causes.forms import Form, Setting
from hygrokf.physics.parameters import Parameter

THRESHOLD = 10.0
"""Evidence from which a cause is accepted."""
SWEEPS, FOLLOWED, WORSE = 3, 2, 10.0
"""Sweeps of jumps, jumps of a sweep that are fitted, and by how much −2 ln L one may be worse at first."""
CLOSE_Z = 2.0
"""Standard errors of its days by which a rival may stay behind."""
SENSOR = "humidity_sensor_drift"
WATER = ("internal_moisture_source", "moisture_sorption", "condensation")
WATER_SHARE = 0.5
"""Share of the evidence of the sensor's error, in days, from which water is told with it."""


@dataclass(frozen=True)
class Candidate:
    """A form of a cause at its maximum beside a parent: gains in −2 ln L by quantity, evidence of the best of
    so many settings that were searched.

    lacking: whether a quantity does not gain that must; alike: the cause's other forms that the
    record cannot tell from it.
    judged: what held-out readings say of it; rivals: of the round in which it was accepted; lead: by how much
    the best of all others stayed behind there, in days.
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
        return self.form.cause

    @property
    def acts(self) -> set[str]:
        """The quantities that it acts on."""
        return acts(self.form, self.estimate.quantities)

    @property
    def wet(self) -> bool:
        """Whether an error of the humidity sensor is told together with water."""
        return self.cause == SENSOR and any(rival.cause in WATER for rival in self.rivals)

    @property
    def strength(self) -> float:
        """The smaller of both evidences, by which candidates are ordered and accepted."""
        return min(self.evidence, self.in_days)

    @property
    def factor(self) -> float:
        """Evidence by evidence in days."""
        return self.evidence / self.in_days if self.in_days > 0.0 else 1.0


def acts(form: Form, quantities: Sequence[str]) -> set[str]:
    """The quantities that a form acts on."""
    if form.clock:
        return set(quantities)
    if form.freed:
        return {"vapour"}
    pairs = (("temperature", form.heat), ("vapour", form.vapour or form.altered))
    return {q for q, mechanisms in pairs if mechanisms and q in quantities}


def brought(form: Form, simulator: Simulator) -> frozenset[str]:
    """The parameters that a form's own mechanisms have in a simulator."""
    mechanisms = {name for name, _ in (*form.heat, *form.vapour)}
    return frozenset(
        p.name
        for design in simulator.designs
        for m in design.model.mechanisms
        if m.name in mechanisms
        for p in m.parameters
    )


def estimated(
    parent: Calibration,
    form: Form,
    setting: Setting,
    values: Mapping[str, float],
    effort: tuple[int, float],
    kept: Columns | None = None,
) -> Calibration:
    """A form beside a parent, fitted from values; what it does not act on stays as it is."""
    wider = widened(parent, form, setting)
    sizes = frozenset(p.name for p in amplitudes(added(parent, wider)))
    theta = wider.vector({**parent.values, **values})
    one = estimate_at(wider, parent.errors, theta, parent.linear | sizes, parent.variances)
    return fitted(one, acting(one, acts(form, one.quantities)), effort, kept)


def candidate(
    parent: Calibration, one: Calibration, form: Form, setting: Setting, searched: int
) -> Candidate:
    """What a child is worth beside its parent; evidence in days only where the evidence would do."""
    new = added(parent, one.simulator)
    gains, number, lacking = {}, 0, False
    evidence = -2.0 * math.log(max(searched, 1)) - setting.price
    for q in one.quantities:
        gains[q] = float(parent.deviances[q] - one.deviances[q])
        constants = sum(one.simulator.affects(p.name)[0] == q for p in new)
        constants += (bool(form.clock) and q == "temperature") + (bool(form.freed) and q == "vapour")
        readings = int(np.isfinite(one.residual(q)).sum())
        paid = gains[q] - constants * math.log(max(readings, 2))
        lacking |= form.together and constants > 0 and paid <= 0.0
        number += constants
        evidence += max(0.0, paid)
    factor = day_factor(parent, one) if evidence >= THRESHOLD else 1.0
    return Candidate(form, setting, one, gains, number, searched, evidence, evidence / factor, lacking)


def day_factor(parent: Calibration, one: Calibration) -> float:
    """tr(H⁻¹ J)/k of the k added parameters, at least 1: H their information beside all others, J the sum of
    squares of the days' scores."""
    new = {p.name for p in added(parent, one.simulator)}
    if not new:
        return _factor_of_gains(parent, one)
    f = frame(one.simulator.parameters, set(one.simulator.names), one.linear)
    mine = np.array([one.simulator.names[i] in new for i in f.place])
    information, spread = np.zeros((2, mine.sum(), mine.sum()))
    for q, columns in slopes(one, f).items():
        white, error = weighted(one, q, columns)
        white = white / np.maximum(np.sqrt((white**2).sum(axis=0)), 1e-300)
        rest = white[:, ~mine]
        rest = rest[:, rest.any(axis=0)]
        basis = np.linalg.qr(rest)[0] if rest.shape[1] else rest
        x = white[:, mine] - basis @ (basis.T @ white[:, mine])
        daily = one.simulator.scene.readings[q].by_day(x * error[:, None])
        information += x.T @ x
        spread += daily.T @ daily
    return max(1.0, float(np.trace(np.linalg.pinv(information, rcond=1e-8) @ spread)) / mine.sum())


def _factor_of_gains(parent: Calibration, one: Calibration) -> float:
    """The same of a child without parameters of its own, from the days' gains: with independent readings the
    variance of their sum is four times the sum."""
    gains = [_daily(one, parent, q) for q in one.quantities]
    total = sum(float(g.sum()) for g in gains)
    spread = sum(float(((g - g.mean()) ** 2).sum()) for g in gains)
    return max(1.0, spread / (4.0 * total)) if total > 0.0 else 1.0


def jumped(parent: Calibration, best: Candidate) -> Candidate:
    """The candidate after jumps of its size, its shapes and its settings, while they improve it.

    All jumps are run; those that promise to be no worse, if all other parameters follow by one chord step,
    are fitted.
    """
    steps = dict(best.form.steps)
    for _ in range(SWEEPS):
        before, here = best.estimate.deviance, parent_of(best.estimate)
        promising = []
        for setting, values in _jumps(parent, best, steps):
            wider = widened(parent, best.form, setting)
            gain = chord_gains(here, wider, wider.vector(values)[:, None], {}, best.acts)[0]
            promising.append((float(gain), setting, values))
        promising.sort(key=lambda one: -one[0])
        for gain, setting, values in promising[:FOLLOWED]:
            if gain < -WORSE:
                break
            light = estimated(parent, best.form, setting, values, LIGHT, here.columns)
            if light.deviance < best.estimate.deviance + 0.5 * WORSE:
                one = fitted(light, acting(light, best.acts), POLISH)
                if one.deviance < best.estimate.deviance - 0.1:
                    best = replace(
                        candidate(parent, one, best.form, setting, best.searched), alike=best.alike
                    )
        steps = {key: 0.5 * step for key, step in steps.items()}
        if not best.estimate.deviance < before - 1.0 and not steps:
            break
    return best


def _jumps(
    parent: Calibration, best: Candidate, steps: Mapping[tuple[str, str], float]
) -> Iterator[tuple[Setting, dict[str, float]]]:
    values, setting = best.estimate.values, best.setting
    new = added(parent, best.estimate.simulator)
    sizes = amplitudes(new)
    # an effect on two quantities may be right in one and stuck in the other
    for moved in [sizes, *([p] for p in sizes if len(sizes) > 1)]:
        for factor in (2.5, 0.4) if moved else ():
            grown = {p.name: (p.null or 0.0) + factor * (values[p.name] - (p.null or 0.0)) for p in moved}
            yield setting, values | {p.name: _within(p, grown[p.name]) for p in moved}
    for p in new:
        for sign in (1.0, -1.0) if p not in sizes else ():
            further = 1.5**sign if p.positive else 1.0
            shift = 0.0 if p.positive else sign * 0.1 * min(p.upper - p.lower, 20.0)
            yield setting, values | {p.name: _within(p, values[p.name] * further + shift)}
    for (feature, key), step in steps.items():
        for sign in (1.0, -1.0):
            if feature == "clock":
                yield replace(setting, shift_s=setting.shift_s + sign * step), values
                continue
            # a date outside the record would be another constant
            first = best.form.steps[feature, key]
            tried = [one.features[feature][key] for one in best.form.grid]
            settings = dict(setting.features[feature])
            wanted = settings[key] + sign * step
            settings[key] = float(np.clip(wanted, min(tried) - first, max(tried) + first))
            yield replace(setting, features={**setting.features, feature: settings}), values


def _within(p: Parameter, value: float) -> float:
    return float(np.clip(value, p.lower if p.null is None else min(p.lower, p.null), p.upper))


def grafted(parent: Calibration, one: Candidate) -> Calibration:
    """A candidate of an earlier parent beside one that differs in the other quantity alone."""
    wider = widened(parent, one.form, one.setting)
    own = {n: v for n, v in one.estimate.values.items() if set(one.estimate.simulator.affects(n)) & one.acts}
    theta = wider.vector({**parent.values, **own})
    variances = {**parent.variances, **{q: one.estimate.variances[q] for q in one.acts}}
    return estimate_at(wider, parent.errors, theta, parent.linear | one.estimate.linear, variances)


def alike(best: Candidate, rival: Candidate) -> bool:
    """Whether a rival explains the days' readings of a quantity that both act on as well (Vuong by days)."""
    shared = best.acts & rival.acts
    if not shared or rival.evidence < THRESHOLD:
        return False
    if best.evidence - rival.evidence < THRESHOLD:
        return True
    daily = np.concatenate([_daily(best.estimate, rival.estimate, q) for q in sorted(shared)])
    return float(daily.sum() / (math.sqrt(len(daily)) * max(daily.std(), 1e-12))) < CLOSE_Z


def _daily(best: Calibration, rival: Calibration, quantity: str) -> np.ndarray:
    """(days,) by how much −2 ln L of the rival exceeds that of the best."""
    terms = rival.filtered[quantity].terms - best.filtered[quantity].terms
    return best.simulator.scene.readings[quantity].by_day(terms)


def water(best: Candidate, rival: Candidate) -> bool:
    """Whether a rival is water that an error of the humidity sensor must not explain away."""
    return best.cause == SENSOR and rival.cause in WATER and rival.in_days >= WATER_SHARE * best.in_days


def lead(best: Candidate, found: Sequence[Candidate]) -> float:
    """By how much the best of all other causes on the same quantities stays behind, in days."""
    others = [c.in_days for c in found if c.cause != best.cause and c.acts & best.acts]
    return best.in_days - max([0.0, *others])
