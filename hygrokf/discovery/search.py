"""The search for effects that a model lacks: rounds of screening, estimates, acceptance and refutation."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any

from hygrokf.discovery.candidates import (
    ACCEPTED_EVIDENCE,
    SENSOR,
    WATER,
    Candidate,
    acts,
    candidate,
    fit_form,
    fits_equally_well,
    improved_by_jumps,
    is_water_rival,
    lead_over_others,
    moved_to_parent,
    own_parameters,
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

FURTHER_EVIDENCE = 100.0
"""Evidence that a cause needs if another cause is already named for the same quantity."""
MOST_CAUSES, FEWEST_SETTINGS, MOST_FORMS, MOST_ROUNDS = 4, 3, 4, 6
"""Causes that are fitted per round and quantity; fewest settings and most forms of a cause that are fitted;
largest number of rounds."""
NEAR_EVIDENCE, NEAR_SHARE = 30.0, 0.15
"""A candidate is fitted to its maximum if its evidence lies below the best one's by at most this much, or by
this share of it."""


class Search:
    """A search through the forms of causes for the effects that a base model lacks.

    A round that reaches the budget of simulations names nothing.

    parent: the base model with all accepted causes.
    dropped: causes that were accepted and later dropped.
    last_round: candidates of the last round.
    not_judged: causes for which the budget did not suffice.
    searched: number of settings that are tried, by cause.
    """

    def __init__(
        self,
        base: Calibration,
        forms: Sequence[Form],
        say: Callable[[str], None] = lambda text: None,
        budget: float = math.inf,
    ) -> None:
        """Prepare a search.

        base: the fitted base model.  forms: all forms of all causes.
        say: called with each step in words.  budget: largest number of simulations.
        """
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
        self.dropped: list[Candidate] = []
        self.last_round: list[Candidate] = []
        self.not_judged: list[str] = []
        self.visited: set[frozenset[str]] = set()
        self._version: Counter[str] = Counter()
        self._kept: dict[tuple[str, str], tuple[object, Any]] = {}
        self._columns: Columns = {}
        self._starts: Mapping[str, float] = {}

    @property
    def names(self) -> frozenset[str]:
        """Names of the accepted causes."""
        return frozenset(candidate.cause for candidate in self.accepted)

    def run(self) -> Search:
        """Run rounds until nothing more is found, and return this search."""
        for _ in range(MOST_ROUNDS):
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
        """Whether the simulations have reached the budget."""
        return self.base.simulator.work.simulations >= self.budget

    def _mark(self, cause: str) -> object:
        """Return a key that changes whenever earlier results for a cause become invalid.

        It holds the cause's remaining forms and the parent's version in each quantity that they change.
        """
        forms, quantities = self.forms[cause], self.parent.quantities
        acted_on = set[str]().union(*(acts(form, quantities) for form in forms))
        return [form.code for form in forms], [self._version[q] for q in quantities if q in acted_on]

    def _recalled(self, kind: str, cause: str) -> Any:
        """Return the stored result for a cause; None where there is none or it is out of date."""
        mark, result = self._kept.get((kind, cause), (None, None))
        return result if mark == self._mark(cause) else None

    def _keep(self, kind: str, cause: str, result: Any) -> None:
        """Store a result for a cause; `_recalled` returns it while the cause's state is the same."""
        self._kept[kind, cause] = self._mark(cause), result

    def _round(self) -> bool:
        """Accept the best cause, then the best cause of the other quantity.

        Returns whether another round may find more: a cause was accepted, or a form was refuted.
        """
        candidates = self.last_round = self.candidates()
        if self.not_judged:
            # the best cause may be among those that were not judged
            return False
        scores_before, named_quantities, was_refuted = scores(levelled(self.parent)), set[str](), False
        for best in candidates:
            cause = best.cause
            if best.acts & named_quantities or not self._earns(best) or self.names | {cause} in self.visited:
                continue
            if named_quantities:
                best = replace(best, estimate=moved_to_parent(self.parent, best))
            best = replace(best, judged=self._judged(scores_before, best))
            if best.judged.reason:
                # held-out readings may bear out another form of the cause
                self._refuted.append(best)
                self.forms[cause] = [form for form in self.forms[cause] if form.code != best.form.code]
                was_refuted = True
                continue
            rivals = tuple(
                c
                for c in candidates
                if c.cause != cause and (fits_equally_well(best, c) or is_water_rival(best, c))
            )
            self.accepted.append(replace(best, rivals=rivals, lead=lead_over_others(best, candidates)))
            self.say(f"{cause}: evidence {best.evidence:.0f}, in days {best.in_days:.0f}")
            self.parent = best.estimate
            named_quantities |= best.acts
        if named_quantities:
            self.parent = update_error_models(self.parent, named_quantities)
            self._version.update(named_quantities)
        return bool(named_quantities) or was_refuted

    def _earns(self, candidate: Candidate) -> bool:
        """Whether a candidate has the evidence that it needs beside the other accepted causes."""
        other_causes = [a for a in self.accepted if a.cause != candidate.cause]
        return not candidate.lacking and candidate.strength >= required_evidence(candidate, other_causes)

    def _judged(self, before: Mapping[str, Scores], candidate: Candidate) -> HeldOutTest:
        """Test a candidate on held-out readings; before: scores of the parent by quantity."""
        after = scores(levelled(with_held_out_openings(self.parent, candidate)))
        return held_out_test(
            {q: before[q] for q in candidate.acts},
            {q: after[q] for q in candidate.acts},
            candidate,
            self.accepted,
        )

    def _judge_again(self) -> None:
        """Drop accepted causes that no longer have enough evidence, given the other causes."""
        for accepted_cause in list(self.accepted):
            if self.spent:
                break
            others = [a for a in self.accepted if a is not accepted_cause]
            without = refitted_with(self.base, others, self.parent, accepted_cause.acts)
            refitted = candidate(
                without, self.parent, accepted_cause.form, accepted_cause.setting, accepted_cause.searched
            )
            if self._earns(refitted):
                continue
            self.dropped.append(refitted)
            self.accepted, self.parent = others, update_error_models(without, accepted_cause.acts)
            self._version.update(accepted_cause.acts)

    def candidates(self) -> list[Candidate]:
        """Return the best candidate of each promising cause: plausible ones first, then the strongest."""
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
                if rival.evidence > leader.evidence - max(NEAR_EVIDENCE, NEAR_SHARE * leader.evidence):
                    best[rival.cause] = self._finish(rival, rival is leader)
        return sorted(best.values(), key=lambda c: (not c.plausible, -c.strength))

    def _first(self, screened_of: Mapping[str, Sequence[Screened]]) -> list[str]:
        """Return the causes with the largest screened gains, at most `MOST_CAUSES` for each quantity.

        They are ranked within each quantity, since gains of temperature and vapour differ in size.
        """
        ranked = sorted(
            (cause for cause in screened_of if screened_of[cause]), key=lambda c: -screened_of[c][0].gain
        )
        first: dict[str, None] = {}
        for q in self.parent.quantities:
            acting_causes = [c for c in ranked if q in acts(screened_of[c][0].form, self.parent.quantities)]
            first |= dict.fromkeys(acting_causes[:MOST_CAUSES])
        # an error of the humidity sensor must not take the place of water
        return [*first, *(c for c in WATER if SENSOR in first and c not in first and screened_of.get(c))]

    def _candidate(self, cause: str, settings: Sequence[Screened]) -> Candidate:
        """Return the best candidate of a cause among its screened settings, fitted with little effort."""
        result: Candidate | None = self._recalled("candidate", cause)
        if result is None:
            children = []
            for s in _to_estimate(settings):
                free = acting(self.parent, acts(s.form, self.parent.quantities))
                starts = {**{name: self._starts[name] for name in free}, **s.values}
                child = fit_form(self.parent, s.form, s.setting, starts, LIGHT, self._columns)
                children.append(candidate(self.parent, child, s.form, s.setting, self.searched[cause]))
            best = max(children, key=lambda c: c.evidence)
            equally_good_forms = (
                c.form.code for c in children if c.form is not best.form and fits_equally_well(best, c)
            )
            result = replace(best, alike=tuple(dict.fromkeys(equally_good_forms)))
            self._keep("candidate", cause, result)
        if set(result.estimate.simulator.names) >= set(self.parent.simulator.names):
            return result
        return replace(result, estimate=moved_to_parent(self.parent, result))

    def _finish(self, finished: Candidate, leads: bool) -> Candidate:
        """Fit a candidate to its maximum; if it leads its quantity, also try jumps."""
        if self._recalled("finished", finished.cause) in (True, leads):
            return finished
        child = fitted(finished.estimate, acting(finished.estimate, finished.acts), POLISH)
        finished = replace(
            candidate(self.parent, child, finished.form, finished.setting, finished.searched),
            alike=finished.alike,
        )
        if leads and finished.evidence > 0.0:
            finished = improved_by_jumps(self.parent, finished)
        self._keep("candidate", finished.cause, finished)
        self._keep("finished", finished.cause, leads)
        return finished


def _to_estimate(settings: Sequence[Screened]) -> list[Screened]:
    """Return the screened settings to fit: the best of each form, then the best of the rest.

    Forms come first, because they differ more than settings of one form do.
    """
    first: dict[str, Screened] = {}
    for s in settings:
        first.setdefault(s.form.code, s)
    rest = [s for s in settings if first[s.form.code] is not s]
    return [*first.values(), *rest][: max(FEWEST_SETTINGS, min(len(first), MOST_FORMS))]


def refitted_with(
    base: Calibration, causes: Sequence[Candidate], larger: Calibration, quantities: Collection[str]
) -> Calibration:
    """Return the base model with the given causes, refitted in the given quantities.

    larger: a model that contains these causes; it gives the start values and the error models.
    """
    extended = base
    for cause in causes:
        extended = replace(extended, simulator=widened(extended, cause.form, cause.setting))
    theta = extended.simulator.vector(larger.values)
    start = estimate_at(extended.simulator, larger.errors, theta, larger.linear, larger.variances)
    return fitted(start, acting(start, quantities))


def with_held_out_openings(parent: Calibration, candidate: Candidate) -> Calibration:
    """Return the candidate's model with door openings added in the held-out part of the record.

    Openings cannot be predicted.  One is added where it raises the held-out likelihood by more than the price
    of a window.  Models without openings are returned unchanged.
    """
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
    """Return the candidate's model with the door open during `spans` [s], at unchanged parameters."""
    wider, estimate = (
        widened(parent, candidate.form, Setting({"door_open": {"spans": spans}})),
        candidate.estimate,
    )
    return estimate_at(
        wider, estimate.errors, wider.vector(estimate.values), estimate.linear, estimate.variances
    )


def _held_out_deviance(estimate: Calibration) -> float:
    """Return −2 ln L of the held-out readings, summed over the quantities."""
    return sum(score.deviance for score in scores(estimate).values())


def required_evidence(candidate: Candidate, accepted: Sequence[Candidate]) -> float:
    """Return the evidence that a candidate needs: `FURTHER_EVIDENCE` or `ACCEPTED_EVIDENCE`.

    More is needed once a cause is named for a quantity that the candidate changes: what remains there is more
    often a misfit of the named cause than another cause.
    """
    return FURTHER_EVIDENCE if any(candidate.acts & a.acts for a in accepted) else ACCEPTED_EVIDENCE


def held_out_test(
    before: Mapping[str, Scores],
    after: Mapping[str, Scores],
    candidate: Candidate,
    accepted: Sequence[Candidate],
) -> HeldOutTest:
    """Test a candidate on held-out readings.

    before, after: scores without and with the candidate, by quantity.  accepted: the causes accepted so far.
    """
    return judged(
        before,
        after,
        candidate.in_days - required_evidence(candidate, accepted),
        candidate.factor,
        candidate.in_days < FURTHER_EVIDENCE,
    )


def effect_of(form: Form, parent: Calibration, child: Calibration, after: Mapping[str, Scores]) -> float:
    """Return how much a cause changes the simulated readings: the summed squared whitened `difference`.

    after: scores of the child by quantity.  Infinite for a form without an amplitude that could be set to
        zero.
    """
    names = {p.name: p.null for p in amplitudes(added(parent, child.simulator)) if p.null is not None}
    own_names = own_parameters(form, child.simulator)
    if not own_names & set(names):
        return math.inf
    theta = child.simulator.vector({**child.values, **{n: v for n, v in names.items() if n in own_names}})
    scores_without = scores(estimate_at(child.simulator, child.errors, theta, child.linear, child.variances))
    return sum(float(square.sum()) for square in difference(after, scores_without).values())
