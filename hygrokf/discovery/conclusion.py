"""The end of a search: one set of parameters for the base and for the extended model, and the names that it
bears out.

Both sets are made by one estimator.  A name that held-out readings refute under these sets goes, and the
choice is made again.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from hygrokf.discovery.candidates import Candidate
from hygrokf.discovery.discovery_results import HeldOutTest
from hygrokf.discovery.estimate import Estimate
from hygrokf.discovery.final_set import Estimator, FinalSet, final_estimator, final_set
from hygrokf.discovery.judgement import NOTICED, judged, scores
from hygrokf.discovery.search import Accepted, Found, composed, effect_of, foreseen, needed


@dataclass(frozen=True)
class Conclusion:
    """The sets of the base and of the extended model (None without a name), and what is named and refuted."""

    base: FinalSet
    extended: FinalSet | None
    accepted: tuple[Accepted, ...]
    refuted: tuple[tuple[Candidate, HeldOutTest], ...]

    @property
    def last(self) -> FinalSet:
        return self.extended or self.base


def concluded(found: Found) -> Conclusion:
    """The sets with which a search ends."""
    accepted, refuted, one = list(found.accepted), list(found.refuted), found.final
    while accepted:
        estimator = final_estimator(found.base, one)
        base, extended = (final_set(model, estimator) for model in (found.base, one))
        verdicts = [_judged(found.base, base, accepted, name, extended, estimator) for name in accepted]
        worst = max(range(len(accepted)), key=lambda i: _harm(verdicts[i]))
        if not verdicts[worst].reason:
            return Conclusion(
                base,
                extended,
                tuple(replace(a, judged=v) for a, v in zip(accepted, verdicts, strict=True)),
                tuple(refuted),
            )
        refuted.append((accepted[worst].candidate, verdicts[worst]))
        del accepted[worst]
        one = composed(found.base, [a.chosen for a in accepted], one)
    return Conclusion(final_set(found.base, final_estimator(found.base)), None, (), tuple(refuted))


def _judged(
    start: Estimate,
    base: FinalSet,
    accepted: Sequence[Accepted],
    name: Accepted,
    extended: FinalSet,
    estimator: Estimator,
) -> HeldOutTest:
    """What held-out readings say of the extended model beside the one without a name."""
    others = [a.chosen for a in accepted if a is not name]
    without = base.estimate
    if others:
        without = final_set(composed(start, others, extended.estimate), estimator).estimate
    child = foreseen(without, replace(name.candidate, estimate=extended.estimate))
    after, one = scores(child), name.candidate
    earlier = list(itertools.takewhile(lambda a: a is not name, accepted))
    verdict = judged(scores(without), after, one.in_days - needed(one, earlier), one.factor)
    if effect_of(one.form, without, child, after) < NOTICED:
        return replace(verdict, reason="no_effect")
    return verdict


def _harm(one: HeldOutTest) -> float:
    """By how much a name grows the errors, where it is refuted; without an effect it goes first."""
    if one.reason == "no_effect":
        return math.inf
    return max(one.growth.values(), default=0.0) if one.reason else -math.inf
