"""The search for what a model lacks: screening, estimates, jumps, evidence, acceptance.

Evidence of a cause is what it gains in −2 ln L, less k ln N for its k constants in each quantity and 2 ln of
the number of settings that were tried.  Gains are differences of maxima: parent and child are fitted until
the same rule stops them.  Evidence in days divides it by how much the days' sums of the cause's own scores
vary beyond independent readings.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from hygrokf.discovery.estimate import (
    LIGHT,
    POLISH,
    Columns,
    Estimate,
    estimate_at,
    fitted,
    frame,
    slopes,
)
from hygrokf.discovery.forms import Form, Setting
from hygrokf.discovery.judgement import Judged, Scores, difference, judged, levelled, scores
from hygrokf.discovery.screening import (
    Screened,
    added,
    amplitudes,
    chord_gains,
    openings,
    parent_of,
    screened,
    widened,
)
from hygrokf.discovery.starting_model import renewed
from hygrokf.physics.parameters import Parameter

THRESHOLD, FURTHER = 10.0, 25.0
"""Evidence from which a cause is accepted, and from which one is in a quantity that has a name."""
CAUSES, SETTINGS, FORMS, ROUNDS = 4, 3, 4, 6
"""Causes of a quantity that are estimated, settings of each at least, forms of each at most, and rounds."""
NEAR, NEAR_SHARE = 30.0, 0.15
SWEEPS, FOLLOWED, WORSE = 3, 2, 10.0
"""Sweeps of jumps, jumps of a sweep that are fitted, and by how much −2 ln L one may be worse at first."""
CLOSE, CLOSE_Z = 10.0, 2.0
"""Evidence by which a rival may stay behind, and standard errors of its days, within which it is one."""
SENSOR = "humidity_sensor_drift"
WATER = ("internal_moisture_source", "moisture_sorption", "condensation")
WATER_SHARE = 0.5
"""Share of the evidence of the sensor's error, in days, from which water is told with it."""
Chosen = tuple[Form, Setting]


@dataclass(frozen=True)
class Candidate:
    """A form of a cause at its maximum beside a parent: gains in −2 ln L by quantity, evidence.

    lacking: whether a quantity does not gain that must; alike: codes of the cause's other forms that the
    record cannot tell from it.
    """

    form: Form
    setting: Setting
    estimate: Estimate
    gains: Mapping[str, float]
    constants: int
    evidence: float
    in_days: float
    lacking: bool = False
    alike: tuple[str, ...] = ()

    @property
    def cause(self) -> str:
        return self.form.cause

    @property
    def strength(self) -> float:
        """The smaller of both evidences, by which candidates are ordered and accepted."""
        return min(self.evidence, self.in_days)


@dataclass(frozen=True)
class Accepted:
    """A cause that was accepted, what the held-out readings say of it, its rivals of the round, and by how
    much the best of all others stayed behind, in days."""

    candidate: Candidate
    judged: Judged
    rivals: tuple[Candidate, ...]
    lead: float

    @property
    def chosen(self) -> Chosen:
        return self.candidate.form, self.candidate.setting


@dataclass(frozen=True)
class Found:
    """The end of a search: its base, the model with all accepted causes, what was refuted or left again.

    beside: candidates of the last round; not_judged: causes that the budget left out of it; searched: cause →
    settings that were tried.
    """

    base: Estimate
    final: Estimate
    accepted: tuple[Accepted, ...] = ()
    refuted: tuple[tuple[Candidate, Judged], ...] = ()
    left: tuple[Candidate, ...] = ()
    beside: tuple[Candidate, ...] = ()
    not_judged: tuple[str, ...] = ()
    searched: Mapping[str, int] = field(default_factory=dict)


def acts(form: Form, quantities: Sequence[str]) -> set[str]:
    """The quantities that a form acts on."""
    if form.clock:
        return set(quantities)
    if form.freed:
        return {"vapour"}
    pairs = (("temperature", form.heat), ("vapour", form.vapour or form.altered))
    return {q for q, mechanisms in pairs if mechanisms and q in quantities}


# -- one candidate -------------------------------------------------------------------------------------------
def estimated(
    parent: Estimate,
    form: Form,
    setting: Setting,
    values: Mapping[str, float],
    effort: tuple[int, float],
    kept: Columns | None = None,
) -> Estimate:
    """A form beside a parent, fitted from values; what it does not act on stays as it is."""
    wider = widened(parent, form, setting)
    sizes = frozenset(p.name for p in amplitudes(added(parent, wider)))
    theta = wider.vector({**parent.values, **values})
    one = estimate_at(wider, parent.errors, theta, parent.linear | sizes, parent.variances)
    return fitted(one, _free(one, form), effort, kept)


def _free(one: Estimate, form: Form) -> list[str]:
    mine = acts(form, one.quantities)
    return [name for name in one.simulator.names if set(one.simulator.affects(name)) & mine]


def candidate(parent: Estimate, one: Estimate, form: Form, setting: Setting, searched: int) -> Candidate:
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
    return Candidate(form, setting, one, gains, number, evidence, evidence / factor, lacking)


def day_factor(parent: Estimate, one: Estimate) -> float:
    """tr(H⁻¹ J)/k of the k added parameters, at least 1: H their information beside all others, J the sum of
    squares of the days' scores."""
    new = {p.name for p in added(parent, one.simulator)}
    if not new:
        return _factor_of_gains(parent, one)
    f = frame(one.simulator.parameters, set(one.simulator.names), one.linear)
    mine = np.array([one.simulator.names[i] in new for i in f.place])
    information, spread = np.zeros((2, mine.sum(), mine.sum()))
    for q, columns in slopes(one, f).items():
        known = one.filtered[q]
        root = np.sqrt(known.weight)
        white = known.whitened(columns) * root[:, None]
        white = white / np.maximum(np.sqrt((white**2).sum(axis=0)), 1e-300)
        rest = white[:, ~mine]
        rest = rest[:, rest.any(axis=0)]
        basis = np.linalg.qr(rest)[0] if rest.shape[1] else rest
        x = white[:, mine] - basis @ (basis.T @ white[:, mine])
        score = x * (np.nan_to_num(known.standardised) * root)[:, None]
        day = np.floor(one.simulator.scene.readings[q].time_h / 24.0).astype(int)
        daily = np.zeros((day.max() + 1, score.shape[1]))
        np.add.at(daily, day, score)
        information += x.T @ x
        spread += daily.T @ daily
    return max(1.0, float(np.trace(np.linalg.pinv(information, rcond=1e-8) @ spread)) / mine.sum())


def _factor_of_gains(parent: Estimate, one: Estimate) -> float:
    """The same of a child without parameters of its own, from the days' gains: with independent readings the
    variance of their sum is four times the sum."""
    gains = [_daily(one, parent, q) for q in one.quantities]
    total = sum(float(g.sum()) for g in gains)
    spread = sum(float(((g - g.mean()) ** 2).sum()) for g in gains)
    return max(1.0, spread / (4.0 * total)) if total > 0.0 else 1.0


def jumped(parent: Estimate, best: Candidate, searched: int) -> Candidate:
    """The candidate after jumps of its size, its shapes and its settings, while they improve it.

    All jumps are run; those that promise to be no worse, if all other parameters follow by one chord step,
    are fitted.
    """
    steps = dict(best.form.steps)
    for _ in range(SWEEPS):
        before, here = best.estimate.deviance, parent_of(best.estimate)
        mine = acts(best.form, parent.quantities)
        promising = []
        for setting, values in _jumps(parent, best, steps):
            wider = widened(parent, best.form, setting)
            gain = chord_gains(here, wider, wider.vector(values)[:, None], {}, mine)[0]
            promising.append((float(gain), setting, values))
        promising.sort(key=lambda one: -one[0])
        for gain, setting, values in promising[:FOLLOWED]:
            if gain < -WORSE:
                break
            light = estimated(parent, best.form, setting, values, LIGHT, here.columns)
            if light.deviance < best.estimate.deviance + 0.5 * WORSE:
                one = fitted(light, _free(light, best.form), POLISH)
                if one.deviance < best.estimate.deviance - 0.1:
                    best = replace(candidate(parent, one, best.form, setting, searched), alike=best.alike)
        steps = {key: 0.5 * step for key, step in steps.items()}
        if not best.estimate.deviance < before - 1.0 and not steps:
            break
    return best


def _jumps(
    parent: Estimate, best: Candidate, steps: Mapping[tuple[str, str], float]
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


def grafted(parent: Estimate, one: Candidate) -> Estimate:
    """A candidate of an earlier parent beside one that differs in the other quantity alone."""
    wider = widened(parent, one.form, one.setting)
    mine = acts(one.form, parent.quantities)
    own = {n: v for n, v in one.estimate.values.items() if set(one.estimate.simulator.affects(n)) & mine}
    theta = wider.vector({**parent.values, **own})
    variances = {**parent.variances, **{q: one.estimate.variances[q] for q in mine}}
    return estimate_at(wider, parent.errors, theta, parent.linear | one.estimate.linear, variances)


# -- a round -------------------------------------------------------------------------------------------------
@dataclass
class _Known:
    """What rounds found of forms, valid while the quantities that these act on have the same parent."""

    version: dict[str, int] = field(default_factory=dict)
    screened: dict[str, tuple[tuple[int, ...], list[Screened]]] = field(default_factory=dict)
    candidates: dict[str, tuple[tuple[int, ...], Candidate | None]] = field(default_factory=dict)
    finished: dict[str, tuple[tuple[int, ...], bool]] = field(default_factory=dict)

    def drop(self, cause: str) -> None:
        """Forget a cause whose forms changed."""
        self.screened.pop(cause, None)
        self.candidates.pop(cause, None)
        self.finished.pop(cause, None)

    def mark(self, forms: Sequence[Form], quantities: Sequence[str]) -> tuple[int, ...]:
        mine = set().union(*(acts(form, quantities) for form in forms))
        return tuple(self.version.get(q, 0) for q in quantities if q in mine)


class Search:
    """A search from a base through the forms of causes, which ends where the budget of simulations does."""

    def __init__(
        self, base: Estimate, forms: Sequence[Form], say: Callable[[str], None], budget: float
    ) -> None:
        self.base, self.say, self.budget = base, say, budget
        self.forms: dict[str, list[Form]] = {}
        for form in forms:
            self.forms.setdefault(form.cause, []).append(form)
        self.searched = {cause: sum(len(f.grid) for f in one) for cause, one in self.forms.items()}
        self.parent = base
        self.accepted: list[Accepted] = []
        self._refuted: list[tuple[Candidate, Judged]] = []
        self.left: list[Candidate] = []
        self.beside: list[Candidate] = []
        self.not_judged: list[str] = []
        self.visited: set[frozenset[str]] = set()
        self._known = _Known()
        self._columns: Columns = {}

    @property
    def names(self) -> frozenset[str]:
        return frozenset(one.candidate.cause for one in self.accepted)

    def run(self) -> Found:
        for _ in range(ROUNDS):
            self.visited.add(self.names)
            if not self._round():
                break
            self._judge_again()
        return Found(
            self.base, self.parent, tuple(self.accepted), self.refuted, tuple(self.left),
            tuple(self.beside), tuple(self.not_judged), self.searched,
        )  # fmt: skip

    @property
    def refuted(self) -> tuple[tuple[Candidate, Judged], ...]:
        """The best refuted form of each cause that has no name in the end."""
        best: dict[str, tuple[Candidate, Judged]] = {}
        for one, verdict in sorted(self._refuted, key=lambda pair: -pair[0].strength):
            if one.cause not in self.names:
                best.setdefault(one.cause, (one, verdict))
        return tuple(best.values())

    @property
    def spent(self) -> bool:
        return self.base.simulator.work.simulations >= self.budget

    def _round(self) -> bool:
        """Accept the best cause, then the best of the other quantity; returns whether any was accepted."""
        found = self.beside = self.candidates()
        if self.not_judged:
            # the best of those that were judged might not be the best
            return False
        before, taken, again = scores(levelled(self.parent)), set[str](), False
        for one in found:
            mine = acts(one.form, self.parent.quantities)
            if mine & taken or not self._earns(one) or self.names | {one.cause} in self.visited:
                continue
            child = grafted(self.parent, one) if taken else one.estimate
            one = replace(one, estimate=child)
            verdict = self._judged(before, one)
            if verdict.reason:
                # another form of the cause may hold what this one does not
                self._refuted.append((one, verdict))
                self.forms[one.cause] = [f for f in self.forms[one.cause] if f.code != one.form.code]
                self._known.drop(one.cause)
                again = True
                continue
            rivals = tuple(c for c in found if c.cause != one.cause and (alike(one, c) or water(one, c)))
            self.accepted.append(Accepted(one, verdict, rivals, lead(one, found)))
            self.say(f"{one.cause}: evidence {one.evidence:.0f}, in days {one.in_days:.0f}")
            self.parent = child
            taken |= mine
        if taken:
            self.parent = renewed(self.parent)
            for q in taken:
                self._known.version[q] = self._known.version.get(q, 0) + 1
        return bool(taken) or again

    def _earns(self, one: Candidate) -> bool:
        others = [a for a in self.accepted if a.candidate.cause != one.cause]
        return not one.lacking and one.strength >= (FURTHER if beside(one, others) else THRESHOLD)

    def _judged(self, before: Mapping[str, Scores], one: Candidate) -> Judged:
        child = levelled(foreseen(self.parent, one))
        after, mine = scores(child), acts(one.form, self.parent.quantities)
        effect = math.inf if beside(one, self.accepted) else effect_of(one.form, self.parent, child, after)
        return judged({q: before[q] for q in mine}, {q: after[q] for q in mine}, effect)

    def _judge_again(self) -> None:
        """Leave causes that no longer earn their place beside the others, under the renewed error models."""
        for one in list(self.accepted):
            others = [a for a in self.accepted if a is not one]
            without = composed(self.base, [a.chosen for a in others], self.parent)
            again = candidate(without, self.parent, *one.chosen, self.searched[one.candidate.cause])
            if self._earns(again):
                continue
            self.left.append(again)
            self.accepted, self.parent = others, renewed(without)
            for q in acts(one.candidate.form, self.parent.quantities):
                self._known.version[q] += 1

    def candidates(self) -> list[Candidate]:
        """The causes' best candidates beside the parent, the strongest first."""
        gone = self.names
        parent = parent_of(self.parent)
        self._columns = parent.columns
        seen: dict[str, list[Screened]] = {}
        self.not_judged = []
        for cause, forms in self.forms.items():
            if cause in gone or not forms:
                continue
            self.say(f"screening of {cause}")
            mark = self._known.mark(forms, self.parent.quantities)
            if self._known.screened.get(cause, (None,))[0] != mark:
                if self.spent:
                    self.not_judged.append(cause)
                    continue
                found = [s for form in forms for s in screened(parent, form)]
                self._known.screened[cause] = mark, sorted(found, key=lambda s: -s.gain)
            seen[cause] = self._known.screened[cause][1]
        made: dict[str, Candidate | None] = {}
        for cause in self._first(seen):
            if self.spent:
                self.not_judged.append(cause)
                continue
            self.say(f"estimate of {cause}")
            made[cause] = self._candidate(cause, seen[cause])
        best = {cause: one for cause, one in made.items() if one is not None}
        for q in self.parent.quantities:
            mine = [one for one in best.values() if q in acts(one.form, self.parent.quantities)]
            if not mine:
                continue
            lead = max(mine, key=lambda one: one.evidence)
            for one in mine:
                if one.evidence > lead.evidence - max(NEAR, NEAR_SHARE * lead.evidence):
                    best[one.cause] = self._finished(one, one is lead)
        return sorted(best.values(), key=lambda c: -c.strength)

    def _first(self, seen: Mapping[str, Sequence[Screened]]) -> list[str]:
        """The causes that promise most, of each quantity by itself: gains of the two are not alike in
        size."""
        ranked = sorted((cause for cause in seen if seen[cause]), key=lambda c: -seen[c][0].gain)
        first: dict[str, None] = {}
        for q in self.parent.quantities:
            mine = [c for c in ranked if q in acts(seen[c][0].form, self.parent.quantities)]
            first |= dict.fromkeys(mine[:CAUSES])
        # water must not be explained away by an error of its sensor
        return [*first, *(c for c in WATER if SENSOR in first and c not in first and seen.get(c))]

    def _candidate(self, cause: str, seen: Sequence[Screened]) -> Candidate | None:
        mark = self._known.mark(self.forms[cause], self.parent.quantities)
        if self._known.candidates.get(cause, (None,))[0] != mark:
            made = []
            for s in _to_estimate(seen):
                one = estimated(self.parent, s.form, s.setting, s.values, LIGHT, self._columns)
                made.append(candidate(self.parent, one, s.form, s.setting, self.searched[cause]))
            best = max(made, key=lambda one: one.evidence, default=None)
            if best is not None:
                near = (c.form.code for c in made if c.form is not best.form and alike(best, c))
                best = replace(best, alike=tuple(dict.fromkeys(near)))
            self._known.candidates[cause] = mark, best
        found = self._known.candidates[cause][1]
        if found is None or set(found.estimate.simulator.names) >= set(self.parent.simulator.names):
            return found
        return replace(found, estimate=grafted(self.parent, found))

    def _finished(self, one: Candidate, leads: bool) -> Candidate:
        """A candidate at its maximum; the one that leads a quantity jumps."""
        mark = self._known.mark(self.forms[one.cause], self.parent.quantities)
        if self._known.finished.get(one.cause) in ((mark, True), (mark, leads)):
            return one
        made = fitted(one.estimate, _free(one.estimate, one.form), POLISH)
        same = one.alike
        one = candidate(self.parent, made, one.form, one.setting, self.searched[one.cause])
        one = replace(one, alike=same)
        if leads and one.evidence > 0.0:
            one = jumped(self.parent, one, self.searched[one.cause])
        self._known.candidates[one.cause] = mark, one
        self._known.finished[one.cause] = mark, leads
        return one


def _to_estimate(seen: Sequence[Screened]) -> list[Screened]:
    """The best setting of each form, then the best of the others: forms differ more than settings."""
    first: dict[str, Screened] = {}
    for s in seen:
        first.setdefault(s.form.code, s)
    rest = [s for s in seen if first[s.form.code] is not s]
    return [*first.values(), *rest][: max(SETTINGS, min(len(first), FORMS))]


def search(
    base: Estimate,
    forms: Sequence[Form],
    say: Callable[[str], None] = lambda text: None,
    budget: float = math.inf,
) -> Found:
    """Name what a base lacks; a round in which the simulations reach the budget names nothing."""
    return Search(base, forms, say, budget).run()


def composed(base: Estimate, chosen: Sequence[Chosen], near: Estimate) -> Estimate:
    """The base with some causes, fitted from a larger model's values under the same error models."""
    one = base
    for form, setting in chosen:
        one = replace(one, simulator=widened(one, form, setting))
    theta = one.simulator.vector(near.values)
    return fitted(estimate_at(one.simulator, near.errors, theta, near.linear, near.variances))


def foreseen(parent: Estimate, one: Candidate) -> Estimate:
    """The candidate's estimate with the openings of the held-out part, which nothing foresees: those that
    make its readings likelier by more than the price of finding them."""
    if not one.form.windows:
        return one.estimate
    whole = replace(one.form, grid=(Setting({"door_open": {"spans": [[-1e18, 1e18]]}}),))
    known, e = one.setting.features["door_open"]["spans"], one.estimate
    found = openings(parent, whole, identified=False)
    kept: list[list[float]] = []
    best = _held_out_deviance(e)
    for span in found.spans:
        trial = _opened(parent, one, sorted([*known, *kept, span]))
        if _held_out_deviance(trial) < best - found.price:
            kept.append(span)
            best = _held_out_deviance(trial)
    return _opened(parent, one, sorted([*known, *kept]))


def _opened(parent: Estimate, one: Candidate, spans: Sequence[Sequence[float]]) -> Estimate:
    wider, e = widened(parent, one.form, Setting({"door_open": {"spans": spans}})), one.estimate
    return estimate_at(wider, e.errors, wider.vector(e.values), e.linear, e.variances)


def _held_out_deviance(one: Estimate) -> float:
    return sum(score.deviance for score in scores(one).values())


def beside(one: Candidate, accepted: Sequence[Accepted]) -> bool:
    """Whether a quantity on which a candidate acts has a name already: what is left there is more often that
    one's misfit than another cause."""
    quantities = one.estimate.quantities
    mine = acts(one.form, quantities)
    return any(mine & acts(a.candidate.form, quantities) for a in accepted)


def effect_of(form: Form, parent: Estimate, child: Estimate, after: Mapping[str, Scores]) -> float:
    """The difference that a cause itself makes to held-out readings (`difference`); infinite for one without
    a size."""
    names = {p.name: p.null for p in amplitudes(added(parent, child.simulator)) if p.null is not None}
    mine = {p for m in (*form.heat, *form.vapour) for p in _parameters(child, m[0])}
    if not mine & set(names):
        return math.inf
    theta = child.simulator.vector({**child.values, **{n: v for n, v in names.items() if n in mine}})
    without = scores(estimate_at(child.simulator, child.errors, theta, child.linear, child.variances))
    return sum(difference(after, without).values())


def _parameters(one: Estimate, mechanism: str) -> list[str]:
    """The parameters of a mechanism."""
    return [
        p.name
        for design in one.simulator.designs
        for m in design.model.mechanisms
        if m.name == mechanism
        for p in m.parameters
    ]


def alike(best: Candidate, rival: Candidate) -> bool:
    """Whether a rival explains the days' readings of a quantity that both act on as well (Vuong by days)."""
    shared = acts(best.form, best.estimate.quantities) & acts(rival.form, best.estimate.quantities)
    if not shared or rival.evidence < THRESHOLD:
        return False
    if best.evidence - rival.evidence < CLOSE:
        return True
    daily = np.concatenate([_daily(best.estimate, rival.estimate, q) for q in sorted(shared)])
    return float(daily.sum() / (math.sqrt(len(daily)) * max(daily.std(), 1e-12))) < CLOSE_Z


def _daily(best: Estimate, rival: Estimate, quantity: str) -> np.ndarray:
    """(days,) by how much −2 ln L of the rival exceeds that of the best."""
    day = np.floor(best.simulator.scene.readings[quantity].time_h / 24.0).astype(int)
    found = np.zeros(day.max() + 1)
    np.add.at(found, day, rival.filtered[quantity].terms - best.filtered[quantity].terms)
    return found


def water(best: Candidate, rival: Candidate) -> bool:
    """Whether a rival is water that an error of the humidity sensor must not explain away."""
    return best.cause == SENSOR and rival.cause in WATER and rival.in_days >= WATER_SHARE * best.in_days


def lead(best: Candidate, found: Sequence[Candidate]) -> float:
    """By how much the best of all other causes on the same quantities stays behind, in days."""
    mine = acts(best.form, best.estimate.quantities)
    others = [
        c.in_days for c in found if c.cause != best.cause and acts(c.form, best.estimate.quantities) & mine
    ]
    return best.in_days - max([0.0, *others])
