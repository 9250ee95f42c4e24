"""The search for what a model lacks: rounds of screening, estimates, acceptance and refutation."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

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
from hygrokf.discovery.forms import Form, Setting
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

FURTHER = 100.0
"""Evidence from which a cause is accepted in a quantity that has a name."""
CAUSES, SETTINGS, FORMS, ROUNDS = 4, 3, 4, 6
"""Causes of a quantity that are estimated, settings of each at least, forms of each at most, and rounds."""
NEAR, NEAR_SHARE = 30.0, 0.15
"""Evidence, and share of the leader's, by which a candidate that is finished may stay behind."""
Chosen = tuple[Form, Setting]


@dataclass(frozen=True)
class Accepted:
    """A cause that was accepted, what the held-out readings say of it, its rivals of the round, and by how
    much the best of all others stayed behind, in days."""

    candidate: Candidate
    judged: HeldOutTest
    rivals: tuple[Candidate, ...]
    lead: float

    @property
    def wet(self) -> bool:
        """Whether an error of the humidity sensor is told together with water."""
        return self.candidate.cause == SENSOR and any(rival.cause in WATER for rival in self.rivals)

    @property
    def chosen(self) -> Chosen:
        return self.candidate.form, self.candidate.setting


@dataclass(frozen=True)
class SearchEnd:
    """The end of a search: its base, the model with all accepted causes, what was refuted or left again.

    beside: candidates of the last round; not_judged: causes that the budget left out of it; searched: cause →
    settings that were tried.
    """

    base: Calibration
    final: Calibration
    accepted: tuple[Accepted, ...] = ()
    refuted: tuple[tuple[Candidate, HeldOutTest], ...] = ()
    left: tuple[Candidate, ...] = ()
    beside: tuple[Candidate, ...] = ()
    not_judged: tuple[str, ...] = ()
    searched: Mapping[str, int] = field(default_factory=dict)


# -- a round -------------------------------------------------------------------------------------------------
@dataclass
class _Known:
    """What rounds found of forms, valid while the quantities that these act on have the same parent."""

    version: dict[str, int] = field(default_factory=dict)
    screened: dict[str, tuple[tuple[int, ...], list[Screened]]] = field(default_factory=dict)
    candidates: dict[str, tuple[tuple[int, ...], Candidate | None]] = field(default_factory=dict)
    finished: dict[str, tuple[tuple[int, ...], bool]] = field(default_factory=dict)

    def mark(self, forms: Sequence[Form], quantities: Sequence[str]) -> tuple[int, ...]:
        mine = set().union(*(acts(form, quantities) for form in forms))
        return tuple(self.version.get(q, 0) for q in quantities if q in mine)


class Search:
    """A search for what a base lacks, through the forms of causes.

    A round in which the simulations reach the budget names nothing.
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
        self.accepted: list[Accepted] = []
        self._refuted: list[tuple[Candidate, HeldOutTest]] = []
        self.left: list[Candidate] = []
        self.beside: list[Candidate] = []
        self.not_judged: list[str] = []
        self.visited: set[frozenset[str]] = set()
        self._known = _Known()
        self._columns: Columns = {}

    @property
    def names(self) -> frozenset[str]:
        return frozenset(one.candidate.cause for one in self.accepted)

    def run(self) -> SearchEnd:
        for _ in range(ROUNDS):
            self.visited.add(self.names)
            if not self._round():
                break
            self._judge_again()
        return SearchEnd(
            self.base, self.parent, tuple(self.accepted), self.refuted, tuple(self.left),
            tuple(self.beside), tuple(self.not_judged), self.searched,
        )  # fmt: skip

    @property
    def refuted(self) -> tuple[tuple[Candidate, HeldOutTest], ...]:
        """The best refuted form of each cause that has no name in the end."""
        best: dict[str, tuple[Candidate, HeldOutTest]] = {}
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
                self.forms[one.cause] = [f for f in self.forms[one.cause] if f.words != one.form.words]
                for known in (self._known.screened, self._known.candidates, self._known.finished):
                    known.pop(one.cause, None)
                again = True
                continue
            rivals = tuple(c for c in found if c.cause != one.cause and (alike(one, c) or water(one, c)))
            self.accepted.append(Accepted(one, verdict, rivals, lead(one, found)))
            self.say(f"{one.cause}: evidence {one.evidence:.0f}, in days {one.in_days:.0f}")
            self.parent = child
            taken |= mine
        if taken:
            self.parent = renewed(self.parent, taken)
            for q in taken:
                self._known.version[q] = self._known.version.get(q, 0) + 1
        return bool(taken) or again

    def _earns(self, one: Candidate) -> bool:
        others = [a for a in self.accepted if a.candidate.cause != one.cause]
        return not one.lacking and one.strength >= needed(one, others)

    def _judged(self, before: Mapping[str, Scores], one: Candidate) -> HeldOutTest:
        child = levelled(foreseen(self.parent, one))
        after, mine = scores(child), acts(one.form, self.parent.quantities)
        return tested({q: before[q] for q in mine}, {q: after[q] for q in mine}, one, self.accepted)

    def _judge_again(self) -> None:
        """Leave causes that no longer earn their place beside the others, under the renewed error models."""
        for one in list(self.accepted):
            if self.spent:
                break
            others = [a for a in self.accepted if a is not one]
            mine = acts(one.candidate.form, self.parent.quantities)
            without = composed(self.base, [a.chosen for a in others], self.parent, mine)
            again = candidate(without, self.parent, *one.chosen, self.searched[one.candidate.cause])
            if self._earns(again):
                continue
            self.left.append(again)
            self.accepted, self.parent = others, renewed(without, mine)
            for q in mine:
                self._known.version[q] += 1

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

    def _candidate(self, cause: str, seen: Sequence[Screened]) -> Candidate | None:
        mark = self._known.mark(self.forms[cause], self.parent.quantities)
        if self._known.candidates.get(cause, (None,))[0] != mark:
            made = []
            for s in _to_estimate(seen):
                one = estimated(self.parent, s.form, s.setting, s.values, LIGHT, self._columns)
                made.append(candidate(self.parent, one, s.form, s.setting, self.searched[cause]))
            best = max(made, key=lambda one: one.evidence, default=None)
            if best is not None:
                near = (c.form.words for c in made if c.form is not best.form and alike(best, c))
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
        made = fitted(one.estimate, acting(one.estimate, acts(one.form, one.estimate.quantities)), POLISH)
        again = candidate(self.parent, made, one.form, one.setting, self.searched[one.cause])
        one = replace(again, alike=one.alike)
        if leads and one.evidence > 0.0:
            one = jumped(self.parent, one, self.searched[one.cause])
        self._known.candidates[one.cause] = mark, one
        self._known.finished[one.cause] = mark, leads
        return one


def _to_estimate(seen: Sequence[Screened]) -> list[Screened]:
    """The best setting of each form, then the best of the others: forms differ more than settings."""
    first: dict[str, Screened] = {}
    for s in seen:
        first.setdefault(s.form.words, s)
    rest = [s for s in seen if first[s.form.words] is not s]
    return [*first.values(), *rest][: max(SETTINGS, min(len(first), FORMS))]


def composed(
    base: Calibration, chosen: Sequence[Chosen], near: Calibration, moved: Collection[str]
) -> Calibration:
    """The base with some causes, fitted from a larger model's values under the same error models in the
    quantities that moved."""
    one = base
    for form, setting in chosen:
        one = replace(one, simulator=widened(one, form, setting))
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
    found = openings(parent, whole, identified=False)
    kept: list[list[float]] = []
    best = _held_out_deviance(e)
    for span in found.spans:
        trial = _opened(parent, one, sorted([*known, *kept, span]))
        if _held_out_deviance(trial) < best - found.price:
            kept.append(span)
            best = _held_out_deviance(trial)
    return _opened(parent, one, sorted([*known, *kept]))


def _opened(parent: Calibration, one: Candidate, spans: Sequence[Sequence[float]]) -> Calibration:
    wider, e = widened(parent, one.form, Setting({"door_open": {"spans": spans}})), one.estimate
    return estimate_at(wider, e.errors, wider.vector(e.values), e.linear, e.variances)


def _held_out_deviance(one: Calibration) -> float:
    return sum(score.deviance for score in scores(one).values())


def needed(one: Candidate, accepted: Sequence[Accepted]) -> float:
    """The evidence that a candidate needs: more if a quantity on which it acts has a name already, since what
    is left there is more often that one's misfit than another cause."""
    quantities = one.estimate.quantities
    mine = acts(one.form, quantities)
    return FURTHER if any(mine & acts(a.candidate.form, quantities) for a in accepted) else THRESHOLD


def tested(
    before: Mapping[str, Scores], after: Mapping[str, Scores], one: Candidate, accepted: Sequence[Accepted]
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
