"""The search for effects that a model lacks: rounds of screening, estimates, acceptance and refutation."""

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
from hygrokf.discovery.discovery_results import HeldOutTest
from hygrokf.discovery.estimate import LIGHT, POLISH, Calibration, Columns, acting, estimate_at, fitted
from hygrokf.discovery.judgement import Scores, difference, judged, levelled, scores
from hygrokf.discovery.screening import (
    Screened,
    added,
    amplitudes,
    openings,
    parent_of,
    screened,
    widened,
)
from hygrokf.discovery.starting_model import screening_point, update_error_models
from hygrokf.modelling.causes.forms import Form, Setting

FURTHER = 100.0
"""Evidence from which a further cause is accepted in a quantity for which a cause is named already."""
CAUSES, SETTINGS, FORMS, ROUNDS = 4, 3, 4, 6
"""Per round: causes estimated for a quantity, fewest settings and most forms of a cause; number of rounds."""
NEAR, NEAR_SHARE = 30.0, 0.15
"""Largest lag behind the leader's evidence, and the same as a share of that evidence, with which a candidate
is fitted to its maximum."""


class Search:
    """A search through the forms of causes for the effects that a base lacks.

    A round in which the simulations reach the budget names nothing.

    parent: the base with all accepted causes; left: causes that later causes displaced; beside: candidates of
    the last round; not_judged: causes that the budget left out of the last round; searched: cause → number of
    settings that are tried.
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
        self.searched = {
            cause: sum(len(form.grid) for form in of_cause) for cause, of_cause in self.forms.items()
        }
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
        self._starts: Mapping[str, float] = {}

    @property
    def names(self) -> frozenset[str]:
        return frozenset(candidate.cause for candidate in self.accepted)

    def run(self) -> Search:
        for _ in range(ROUNDS):
            self.visited.add(self.names)
            if not self._round():
                break
            self._judge_again()
        return self

    @property
    def refuted(self) -> list[Candidate]:
        """The best refuted form of each cause that is not accepted."""
        best: dict[str, Candidate] = {}
        for refuted in sorted(self._refuted, key=lambda c: -c.strength):
            if refuted.cause not in self.names:
                best.setdefault(refuted.cause, refuted)
        return list(best.values())

    @property
    def spent(self) -> bool:
        return self.base.simulator.work.simulations >= self.budget

    def _mark(self, cause: str) -> object:
        """The state on which the work on a cause depends: its forms, and the versions of the parent in the
        quantities that they act on."""
        forms, quantities = self.forms[cause], self.parent.quantities
        acted_on = set[str]().union(*(acts(form, quantities) for form in forms))
        return [form.code for form in forms], [self._version[q] for q in quantities if q in acted_on]

    def _recalled(self, kind: str, cause: str) -> Any:
        """The stored result of a cause; None where there is none or the cause's state has changed."""
        mark, result = self._kept.get((kind, cause), (None, None))
        return result if mark == self._mark(cause) else None

    def _keep(self, kind: str, cause: str, result: Any) -> None:
        self._kept[kind, cause] = self._mark(cause), result

    def _round(self) -> bool:
        """Accept the best cause, then the best cause of the other quantity; return whether another round may
        find more: a cause was accepted, or a form refuted."""
        candidates = self.beside = self.candidates()
        if self.not_judged:
            # the best cause may be among those that were not judged
            return False
        scores_before, named_quantities, was_refuted = scores(levelled(self.parent)), set[str](), False
        for best in candidates:
            cause = best.cause
            if best.acts & named_quantities or not self._earns(best) or self.names | {cause} in self.visited:
                continue
            if named_quantities:
                best = replace(best, estimate=grafted(self.parent, best))
            best = replace(best, judged=self._judged(scores_before, best))
            if best.judged.reason:
                # held-out readings may bear out another form of the cause
                self._refuted.append(best)
                self.forms[cause] = [form for form in self.forms[cause] if form.code != best.form.code]
                was_refuted = True
                continue
            rivals = tuple(c for c in candidates if c.cause != cause and (alike(best, c) or water(best, c)))
            self.accepted.append(replace(best, rivals=rivals, lead=lead(best, candidates)))
            self.say(f"{cause}: evidence {best.evidence:.0f}, in days {best.in_days:.0f}")
            self.parent = best.estimate
            named_quantities |= best.acts
        if named_quantities:
            self.parent = update_error_models(self.parent, named_quantities)
            self._version.update(named_quantities)
        return bool(named_quantities) or was_refuted

    def _earns(self, candidate: Candidate) -> bool:
        others = [a for a in self.accepted if a.cause != candidate.cause]
        return not candidate.lacking and candidate.strength >= needed(candidate, others)

    def _judged(self, before: Mapping[str, Scores], candidate: Candidate) -> HeldOutTest:
        after = scores(levelled(foreseen(self.parent, candidate)))
        return tested(
            {q: before[q] for q in candidate.acts},
            {q: after[q] for q in candidate.acts},
            candidate,
            self.accepted,
        )

    def _judge_again(self) -> None:
        """Drop accepted causes whose evidence beside the others is too small under the new error models."""
        for tried in list(self.accepted):
            if self.spent:
                break
            others = [a for a in self.accepted if a is not tried]
            without = composed(self.base, others, self.parent, tried.acts)
            refitted = candidate(without, self.parent, tried.form, tried.setting, tried.searched)
            if self._earns(refitted):
                continue
            self.left.append(refitted)
            self.accepted, self.parent = others, update_error_models(without, tried.acts)
            self._version.update(tried.acts)

    def candidates(self) -> list[Candidate]:
        """The causes' best candidates beside the parent, the plausible ones first, then the strongest."""
        parent = parent_of(screening_point(self.parent))
        self._columns, self._starts = parent.columns, parent.estimate.values
        screened_of: dict[str, list[Screened]] = {}
        self.not_judged = []
        for cause, forms in self.forms.items():
            if cause in self.names or not forms:
                continue
            self.say(f"screening of {cause}")
            screened_settings = self._recalled("screened", cause)
            if screened_settings is None:
                if self.spent:
                    self.not_judged.append(cause)
                    continue
                screened_settings = [s for form in forms for s in screened(parent, form)]
                screened_settings.sort(key=lambda s: -s.gain)
                self._keep("screened", cause, screened_settings)
            screened_of[cause] = screened_settings
        best: dict[str, Candidate] = {}
        for cause in self._first(screened_of):
            if self.spent:
                self.not_judged.append(cause)
                continue
            self.say(f"estimate of {cause}")
            best[cause] = self._candidate(cause, screened_of[cause])
        for q in self.parent.quantities:
            rivals = [c for c in best.values() if q in c.acts]
            if not rivals:
                continue
            leader = max(rivals, key=lambda c: c.evidence)
            for rival in rivals:
                if rival.evidence > leader.evidence - max(NEAR, NEAR_SHARE * leader.evidence):
                    best[rival.cause] = self._finish(rival, rival is leader)
        return sorted(best.values(), key=lambda c: (not c.plausible, -c.strength))

    def _first(self, screened_of: Mapping[str, Sequence[Screened]]) -> list[str]:
        """The causes with the largest screened gains, ranked within each quantity, since gains of temperature
        and vapour differ in size."""
        ranked = sorted(
            (cause for cause in screened_of if screened_of[cause]), key=lambda c: -screened_of[c][0].gain
        )
        first: dict[str, None] = {}
        for q in self.parent.quantities:
            acting_causes = [c for c in ranked if q in acts(screened_of[c][0].form, self.parent.quantities)]
            first |= dict.fromkeys(acting_causes[:CAUSES])
        # an error of the humidity sensor must not take the place of water
        return [*first, *(c for c in WATER if SENSOR in first and c not in first and screened_of.get(c))]

    def _candidate(self, cause: str, seen: Sequence[Screened]) -> Candidate:
        result: Candidate | None = self._recalled("candidate", cause)
        if result is None:
            tried = []
            for s in _to_estimate(seen):
                free = acting(self.parent, acts(s.form, self.parent.quantities))
                starts = {**{name: self._starts[name] for name in free}, **s.values}
                child = estimated(self.parent, s.form, s.setting, starts, LIGHT, self._columns)
                tried.append(candidate(self.parent, child, s.form, s.setting, self.searched[cause]))
            best = max(tried, key=lambda c: c.evidence)
            near = (c.form.code for c in tried if c.form is not best.form and alike(best, c))
            result = replace(best, alike=tuple(dict.fromkeys(near)))
            self._keep("candidate", cause, result)
        if set(result.estimate.simulator.names) >= set(self.parent.simulator.names):
            return result
        return replace(result, estimate=grafted(self.parent, result))

    def _finish(self, finished: Candidate, leads: bool) -> Candidate:
        """Fit a candidate to its maximum; the leader of a quantity is also improved by jumps."""
        if self._recalled("finished", finished.cause) in (True, leads):
            return finished
        child = fitted(finished.estimate, acting(finished.estimate, finished.acts), POLISH)
        finished = replace(
            candidate(self.parent, child, finished.form, finished.setting, finished.searched),
            alike=finished.alike,
        )
        if leads and finished.evidence > 0.0:
            finished = jumped(self.parent, finished)
        self._keep("candidate", finished.cause, finished)
        self._keep("finished", finished.cause, leads)
        return finished


def _to_estimate(seen: Sequence[Screened]) -> list[Screened]:
    """The best setting of each form, then the best remaining settings: forms differ more than settings."""
    first: dict[str, Screened] = {}
    for s in seen:
        first.setdefault(s.form.code, s)
    rest = [s for s in seen if first[s.form.code] is not s]
    return [*first.values(), *rest][: max(SETTINGS, min(len(first), FORMS))]


def composed(
    base: Calibration, causes: Sequence[Candidate], larger: Calibration, quantities: Collection[str]
) -> Calibration:
    """The base with some of the causes, fitted in the given quantities from the values of a larger model,
    under the error models of that model."""
    extended = base
    for cause in causes:
        extended = replace(extended, simulator=widened(extended, cause.form, cause.setting))
    theta = extended.simulator.vector(larger.values)
    start = estimate_at(extended.simulator, larger.errors, theta, larger.linear, larger.variances)
    return fitted(start, acting(start, quantities))


def foreseen(parent: Calibration, candidate: Candidate) -> Calibration:
    """The candidate's estimate with door openings of the held-out part, which cannot be predicted: those that
    raise the likelihood of the held-out readings by more than the price of a window."""
    if not candidate.form.windows:
        return candidate.estimate
    whole_form = replace(candidate.form, grid=(Setting({"door_open": {"spans": [[-1e18, 1e18]]}}),))
    identified_spans, estimate = candidate.setting.features["door_open"]["spans"], candidate.estimate
    spans, price = openings(parent, whole_form, identified=False)
    held_out_spans: list[list[float]] = []
    best_deviance = _held_out_deviance(estimate)
    for span in spans:
        trial = _opened(parent, candidate, sorted([*identified_spans, *held_out_spans, span]))
        if _held_out_deviance(trial) < best_deviance - price:
            held_out_spans.append(span)
            best_deviance = _held_out_deviance(trial)
    return _opened(parent, candidate, sorted([*identified_spans, *held_out_spans]))


def _opened(parent: Calibration, candidate: Candidate, spans: Sequence[Sequence[float]]) -> Calibration:
    wider, estimate = (
        widened(parent, candidate.form, Setting({"door_open": {"spans": spans}})),
        candidate.estimate,
    )
    return estimate_at(
        wider, estimate.errors, wider.vector(estimate.values), estimate.linear, estimate.variances
    )


def _held_out_deviance(estimate: Calibration) -> float:
    return sum(score.deviance for score in scores(estimate).values())


def needed(candidate: Candidate, accepted: Sequence[Candidate]) -> float:
    """The evidence that a candidate needs: more if a cause is named for a quantity on which it acts, since
    the remaining errors are then more often the misfit of the named cause than another cause."""
    return FURTHER if any(candidate.acts & a.acts for a in accepted) else THRESHOLD


def tested(
    before: Mapping[str, Scores],
    after: Mapping[str, Scores],
    candidate: Candidate,
    accepted: Sequence[Candidate],
) -> HeldOutTest:
    """The test of a candidate on held-out readings, beside the accepted causes."""
    return judged(
        before,
        after,
        candidate.in_days - needed(candidate, accepted),
        candidate.factor,
        candidate.in_days < FURTHER,
    )


def effect_of(form: Form, parent: Calibration, child: Calibration, after: Mapping[str, Scores]) -> float:
    """The squared `difference` that a cause makes to the readings; infinite for a form without an
    amplitude."""
    names = {p.name: p.null for p in amplitudes(added(parent, child.simulator)) if p.null is not None}
    own_names = brought(form, child.simulator)
    if not own_names & set(names):
        return math.inf
    theta = child.simulator.vector({**child.values, **{n: v for n, v in names.items() if n in own_names}})
    scores_without = scores(estimate_at(child.simulator, child.errors, theta, child.linear, child.variances))
    return sum(float(square.sum()) for square in difference(after, scores_without).values())
