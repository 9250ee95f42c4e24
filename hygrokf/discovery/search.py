"""The search for what a model lacks: rounds of screening, estimates, acceptance and refutation."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

from hygrokf.discovery.candidates import (
    SENSOR,
    THRESHOLD,
    WATER,
    Candidate,
    acts,
    alike,
    brought,
    candidate,
    estimated,
    grafted,
    jumped,
    lead,
    water,
)
from hygrokf.discovery.estimate import LIGHT, POLISH, Calibration, Columns, acting, estimate_at, fitted
from hygrokf.discovery.judgement import Scores, difference, judged, levelled, scores
from hygrokf.discovery.results import HeldOutTest
from hygrokf.discovery.screening import (
    Screened,
    added,
    amplitudes,
    openings,
    parent_of,
    screened,
    widened,
)
from hygrokf.discovery.starting_model import renewed
from hygrokf.modelling.causes.forms import Form, Setting

FURTHER = 100.0
"""Evidence from which a cause is accepted in a quantity that has a name."""
CAUSES, SETTINGS, FORMS, ROUNDS = 4, 3, 4, 6
"""Causes of a quantity that are estimated, settings of each at least, forms of each at most, and rounds."""
NEAR, NEAR_SHARE = 30.0, 0.15
"""Evidence, and share of the leader's, by which a candidate that is finished may stay behind."""


class Search:
    """A search for what a base lacks, through the forms of causes.

    A round in which the simulations reach the budget names nothing.

    parent: the base with all accepted causes.  left: causes that later ones displaced; beside: candidates of
    the last round; not_judged: causes that the budget left out of it; searched: cause → settings that are
    tried.
    """

    def __init__(
        self,
        base: Calibration,
        forms: Sequence[Form],
        say: Callable[[str], None] = lambda text: None,
        budget: float = math.inf,
    ) -> None:
        self.base, self.say, self.budget = base, say, budget
        self.forms: dict[str, list[Form]] = {}
        for form in forms:
            self.forms.setdefault(form.cause, []).append(form)
        self.searched = {cause: sum(len(f.grid) for f in one) for cause, one in self.forms.items()}
        self.parent = base
        self.accepted: list[Candidate] = []
        self._refuted: list[Candidate] = []
        self.left: list[Candidate] = []
        self.beside: list[Candidate] = []
        self.not_judged: list[str] = []
        self.visited: set[frozenset[str]] = set()
        self._version: Counter[str] = Counter()
        self._kept: dict[tuple[str, str], tuple[object, Any]] = {}
        self._columns: Columns = {}

    @property
    def names(self) -> frozenset[str]:
        return frozenset(one.cause for one in self.accepted)

    def run(self) -> Search:
        for _ in range(ROUNDS):
            self.visited.add(self.names)
            if not self._round():
                break
            self._judge_again()
        return self

    @property
    def refuted(self) -> list[Candidate]:
        """The best refuted form of each cause that has no name in the end."""
        best: dict[str, Candidate] = {}
        for one in sorted(self._refuted, key=lambda c: -c.strength):
            if one.cause not in self.names:
                best.setdefault(one.cause, one)
        return list(best.values())

    @property
    def spent(self) -> bool:
        return self.base.simulator.work.simulations >= self.budget

    def _mark(self, cause: str) -> object:
        """What the work on a cause depends on: its forms, and the parents of the quantities they act on."""
        forms, quantities = self.forms[cause], self.parent.quantities
        mine = set[str]().union(*(acts(form, quantities) for form in forms))
        return [form.code for form in forms], [self._version[q] for q in quantities if q in mine]

    def _recalled(self, kind: str, cause: str) -> Any:
        """What was kept of a cause, while it is valid; else None."""
        mark, found = self._kept.get((kind, cause), (None, None))
        return found if mark == self._mark(cause) else None

    def _keep(self, kind: str, cause: str, found: Any) -> None:
        self._kept[kind, cause] = self._mark(cause), found

    def _round(self) -> bool:
        """Accept the best cause, then the best of the other quantity; returns whether any was accepted."""
        found = self.beside = self.candidates()
        if self.not_judged:
            # the best of those that were judged might not be the best
            return False
        before, taken, again = scores(levelled(self.parent)), set[str](), False
        for one in found:
            if one.acts & taken or not self._earns(one) or self.names | {one.cause} in self.visited:
                continue
            if taken:
                one = replace(one, estimate=grafted(self.parent, one))
            one = replace(one, judged=self._judged(before, one))
            if one.judged.reason:
                # another form of the cause may hold what this one does not
                self._refuted.append(one)
                self.forms[one.cause] = [f for f in self.forms[one.cause] if f.code != one.form.code]
                again = True
                continue
            rivals = tuple(c for c in found if c.cause != one.cause and (alike(one, c) or water(one, c)))
            self.accepted.append(replace(one, rivals=rivals, lead=lead(one, found)))
            self.say(f"{one.cause}: evidence {one.evidence:.0f}, in days {one.in_days:.0f}")
            self.parent = one.estimate
            taken |= one.acts
        if taken:
            self.parent = renewed(self.parent, taken)
            self._version.update(taken)
        return bool(taken) or again

    def _earns(self, one: Candidate) -> bool:
        others = [a for a in self.accepted if a.cause != one.cause]
        return not one.lacking and one.strength >= needed(one, others)

    def _judged(self, before: Mapping[str, Scores], one: Candidate) -> HeldOutTest:
        after = scores(levelled(foreseen(self.parent, one)))
        return tested({q: before[q] for q in one.acts}, {q: after[q] for q in one.acts}, one, self.accepted)

    def _judge_again(self) -> None:
        """Leave causes that no longer earn their place beside the others, under the renewed error models."""
        for one in list(self.accepted):
            if self.spent:
                break
            others = [a for a in self.accepted if a is not one]
            without = composed(self.base, others, self.parent, one.acts)
            again = candidate(without, self.parent, one.form, one.setting, one.searched)
            if self._earns(again):
                continue
            self.left.append(again)
            self.accepted, self.parent = others, renewed(without, one.acts)
            self._version.update(one.acts)

    def candidates(self) -> list[Candidate]:
        """The causes' best candidates beside the parent, the strongest first."""
        parent = parent_of(self.parent)
        self._columns = parent.columns
        seen: dict[str, list[Screened]] = {}
        self.not_judged = []
        for cause, forms in self.forms.items():
            if cause in self.names or not forms:
                continue
            self.say(f"screening of {cause}")
            found = self._recalled("screened", cause)
            if found is None:
                if self.spent:
                    self.not_judged.append(cause)
                    continue
                found = [s for form in forms for s in screened(parent, form)]
                found.sort(key=lambda s: -s.gain)
                self._keep("screened", cause, found)
            seen[cause] = found
        best: dict[str, Candidate] = {}
        for cause in self._first(seen):
            if self.spent:
                self.not_judged.append(cause)
                continue
            self.say(f"estimate of {cause}")
            best[cause] = self._candidate(cause, seen[cause])
        for q in self.parent.quantities:
            mine = [one for one in best.values() if q in one.acts]
            if not mine:
                continue
            leader = max(mine, key=lambda one: one.evidence)
            for one in mine:
                if one.evidence > leader.evidence - max(NEAR, NEAR_SHARE * leader.evidence):
                    best[one.cause] = self._finished(one, one is leader)
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

    def _candidate(self, cause: str, seen: Sequence[Screened]) -> Candidate:
        found: Candidate | None = self._recalled("candidate", cause)
        if found is None:
            made = []
            for s in _to_estimate(seen):
                one = estimated(self.parent, s.form, s.setting, s.values, LIGHT, self._columns)
                made.append(candidate(self.parent, one, s.form, s.setting, self.searched[cause]))
            best = max(made, key=lambda one: one.evidence)
            near = (c.form.code for c in made if c.form is not best.form and alike(best, c))
            found = replace(best, alike=tuple(dict.fromkeys(near)))
            self._keep("candidate", cause, found)
        if set(found.estimate.simulator.names) >= set(self.parent.simulator.names):
            return found
        return replace(found, estimate=grafted(self.parent, found))

    def _finished(self, one: Candidate, leads: bool) -> Candidate:
        """A candidate at its maximum; the one that leads a quantity jumps."""
        if self._recalled("finished", one.cause) in (True, leads):
            return one
        made = fitted(one.estimate, acting(one.estimate, one.acts), POLISH)
        one = replace(candidate(self.parent, made, one.form, one.setting, one.searched), alike=one.alike)
        if leads and one.evidence > 0.0:
            one = jumped(self.parent, one)
        self._keep("candidate", one.cause, one)
        self._keep("finished", one.cause, leads)
        return one


def _to_estimate(seen: Sequence[Screened]) -> list[Screened]:
    """The best setting of each form, then the best of the others: forms differ more than settings."""
    first: dict[str, Screened] = {}
    for s in seen:
        first.setdefault(s.form.code, s)
    rest = [s for s in seen if first[s.form.code] is not s]
    return [*first.values(), *rest][: max(SETTINGS, min(len(first), FORMS))]


def composed(
    base: Calibration, causes: Sequence[Candidate], near: Calibration, moved: Collection[str]
) -> Calibration:
    """The base with some causes, fitted from a larger model's values under the same error models in the
    quantities that moved."""
    one = base
    for cause in causes:
        one = replace(one, simulator=widened(one, cause.form, cause.setting))
    theta = one.simulator.vector(near.values)
    made = estimate_at(one.simulator, near.errors, theta, near.linear, near.variances)
    return fitted(made, acting(made, moved))


def foreseen(parent: Calibration, one: Candidate) -> Calibration:
    """The candidate's estimate with the openings of the held-out part, which nothing foresees: those that
    make its readings likelier by more than the price of finding them."""
    if not one.form.windows:
        return one.estimate
    whole = replace(one.form, grid=(Setting({"door_open": {"spans": [[-1e18, 1e18]]}}),))
    known, e = one.setting.features["door_open"]["spans"], one.estimate
    spans, price = openings(parent, whole, identified=False)
    kept: list[list[float]] = []
    best = _held_out_deviance(e)
    for span in spans:
        trial = _opened(parent, one, sorted([*known, *kept, span]))
        if _held_out_deviance(trial) < best - price:
            kept.append(span)
            best = _held_out_deviance(trial)
    return _opened(parent, one, sorted([*known, *kept]))


def _opened(parent: Calibration, one: Candidate, spans: Sequence[Sequence[float]]) -> Calibration:
    wider, e = widened(parent, one.form, Setting({"door_open": {"spans": spans}})), one.estimate
    return estimate_at(wider, e.errors, wider.vector(e.values), e.linear, e.variances)


def _held_out_deviance(one: Calibration) -> float:
    return sum(score.deviance for score in scores(one).values())


def needed(one: Candidate, accepted: Sequence[Candidate]) -> float:
    """The evidence that a candidate needs: more if a quantity on which it acts has a name already, since what
    is left there is more often that one's misfit than another cause."""
    return FURTHER if any(one.acts & a.acts for a in accepted) else THRESHOLD


def tested(
    before: Mapping[str, Scores], after: Mapping[str, Scores], one: Candidate, accepted: Sequence[Candidate]
) -> HeldOutTest:
    """What held-out readings say of a candidate beside earlier names."""
    return judged(before, after, one.in_days - needed(one, accepted), one.factor, one.in_days < FURTHER)


def effect_of(form: Form, parent: Calibration, child: Calibration, after: Mapping[str, Scores]) -> float:
    """The difference that a cause itself makes to the readings (`difference`); infinite for one without a
    size."""
    names = {p.name: p.null for p in amplitudes(added(parent, child.simulator)) if p.null is not None}
    mine = brought(form, child.simulator)
    if not mine & set(names):
        return math.inf
    theta = child.simulator.vector({**child.values, **{n: v for n, v in names.items() if n in mine}})
    without = scores(estimate_at(child.simulator, child.errors, theta, child.linear, child.variances))
    return sum(float(square.sum()) for square in difference(after, without).values())
