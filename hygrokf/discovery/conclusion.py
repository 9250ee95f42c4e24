"""The end of a search: one set of parameters for the base and for the extended model, and the names that it
bears out.

Both sets are made by one estimator.  A name that held-out readings refute under these sets goes, and the
choice is made again.  What is left are lines in the spectrum of the whitened errors, and in the daily scores
of a named cause: a missing effect that no cause describes often has a rhythm, such as a tide, a weekly
routine or a duty cycle.  Under a right model the ordinates of a periodogram are independent exponential
numbers.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.discovery.candidates import Candidate, brought
from hygrokf.discovery.estimate import Calibration, frame, slopes
from hygrokf.discovery.final_set import Estimator, FinalSet, final_estimator, final_set, fitted_by
from hygrokf.discovery.judgement import NOTICED, scores
from hygrokf.discovery.results import HeldOutTest, SpectralLine
from hygrokf.discovery.screening import added
from hygrokf.discovery.search import Search, composed, effect_of, foreseen, tested


@dataclass(frozen=True)
class Conclusion:
    """The sets of the base and of the extended model (None without a name), and what is named and refuted."""

    base: FinalSet
    extended: FinalSet | None
    accepted: tuple[Candidate, ...]
    refuted: tuple[Candidate, ...]


def concluded(found: Search) -> Conclusion:
    """The sets with which a search ends."""
    accepted, refuted, one = list(found.accepted), list(found.refuted), found.parent
    while accepted:
        estimator = final_estimator(found.base, one)
        base, extended = (final_set(model, estimator) for model in (found.base, one))
        verdicts = [_judged(found.base, base, accepted, name, extended, estimator) for name in accepted]
        gone = [i for i, verdict in enumerate(verdicts) if verdict.reason]
        if not gone:
            told = tuple(replace(a, judged=v) for a, v in zip(accepted, verdicts, strict=True))
            return Conclusion(base, extended, told, tuple(refuted))
        # without an effect first, then the one with which the errors grow most
        harm = [(v.reason == "no_effect", max(v.growth.values(), default=0.0)) for v in verdicts]
        worst = max(gone, key=lambda i: harm[i])
        refuted.append(replace(accepted.pop(worst), judged=verdicts[worst]))
        one = composed(found.base, accepted, one, refuted[-1].acts)
    return Conclusion(final_set(found.base, final_estimator(found.base)), None, (), tuple(refuted))


def _judged(
    start: Calibration,
    base: FinalSet,
    accepted: Sequence[Candidate],
    name: Candidate,
    extended: FinalSet,
    estimator: Estimator,
) -> HeldOutTest:
    """What held-out readings say of the extended model beside the one without a name."""
    others = [a for a in accepted if a is not name]
    without = base.estimate
    if others:
        without = fitted_by(composed(start, others, extended.estimate, name.acts), estimator, name.acts)
    child = foreseen(without, replace(name, estimate=extended.estimate))
    after = scores(child)
    earlier = list(itertools.takewhile(lambda a: a is not name, accepted))
    verdict = tested(scores(without), after, name, earlier)
    if effect_of(name.form, without, child, after) < NOTICED:
        return replace(verdict, reason="no_effect")
    return verdict


SIGNIFICANT = 1e-4
"""Chance of such a line without an effect, below which it is told."""
BIN_H = 1.0
NEIGHBOURS = 101
FEWEST = 3 * NEIGHBOURS
CYCLES = 4
"""Cycles of a rhythm in the record at least: what comes less often is a course."""
FEWEST_DAYS = 30


def lines(one: Calibration, causes: Mapping[str, tuple[str, ...]]) -> list[SpectralLine]:
    """Significant lines of an estimate, the least likely first; causes: cause → its own parameters."""
    found = [line for q in one.quantities if (line := _in_errors(one, q)) is not None]
    scores = _daily_scores(one)
    for cause, names in causes.items():
        for (q, name), daily in scores.items():
            if name in names and (line := _in_days(q, cause, daily)) is not None:
                found.append(line)
    best: dict[tuple[str, str], SpectralLine] = {}
    for line in sorted(found, key=lambda line: line.p):
        best.setdefault((line.quantity, line.cause), line)
    return list(best.values())


def _in_errors(one: Calibration, quantity: str) -> SpectralLine | None:
    """The strongest line of the whitened errors, against the mean of its neighbours."""
    known, r = one.filtered[quantity], one.simulator.scene.readings[quantity]
    seen = np.isfinite(known.innovation)
    e = (known.standardised * known.weight)[seen]
    hours = r.time_h[seen]
    width = max(BIN_H, float(np.median(np.diff(hours)))) if len(hours) > 1 else BIN_H
    place = ((hours - hours[0]) / width).astype(int)
    total = np.bincount(place, e)
    number = np.bincount(place)
    mean = np.divide(total, np.sqrt(np.maximum(number, 1)))
    power = np.abs(np.fft.rfft(mean - mean[number > 0].mean() * (number > 0))) ** 2
    power = power[1:-1]
    if len(power) < FEWEST:
        return None
    half = NEIGHBOURS // 2
    sums = np.cumsum(np.pad(power, (half + 1, half), mode="reflect"))
    around = (sums[NEIGHBOURS:] - sums[:-NEIGHBOURS] - power) / (NEIGHBOURS - 1)
    ratio = power / np.maximum(around, 1e-300)
    ratio[: CYCLES - 1] = 0.0
    best = int(np.argmax(ratio))
    # the neighbours' mean is itself uncertain: F with 2 and 2 (neighbours − 1) degrees of freedom
    alone = (1.0 + ratio[best] / (NEIGHBOURS - 1)) ** (1.0 - NEIGHBOURS)
    p = -math.expm1(len(power) * math.log1p(-min(alone, 1.0 - 1e-16)))
    return SpectralLine(quantity, width * len(mean) / (best + 1), p) if p < SIGNIFICANT else None


def _daily_scores(one: Calibration) -> dict[tuple[str, str], np.ndarray]:
    """(days,) sums of the scores of every parameter, by quantity and name."""
    f = frame(one.simulator.parameters, set(one.simulator.names), one.linear)
    found = {}
    for q, columns in slopes(one, f).items():
        known = one.filtered[q]
        score = known.whitened(columns) * (np.nan_to_num(known.standardised) * known.weight)[:, None]
        readings = one.simulator.scene.readings[q]
        daily = readings.by_day(score)
        read = np.bincount(readings.day, np.isfinite(known.innovation)) > 0
        for i, place in enumerate(f.place):
            if columns[:, i].any():
                found[q, one.simulator.names[place]] = daily[: np.flatnonzero(read)[-1] + 1, i]
    return found


def _in_days(quantity: str, cause: str, daily: np.ndarray) -> SpectralLine | None:
    """The strongest line of daily scores by Fisher's g: the largest share of one ordinate."""
    if len(daily) < FEWEST_DAYS:
        return None
    ranks = np.argsort(np.argsort(daily)) - 0.5 * (len(daily) - 1)  # single days must not decide
    power = np.abs(np.fft.rfft(ranks)) ** 2
    power = power[CYCLES : (len(daily) + 1) // 2]
    if not power.sum() > 0.0:
        return None
    share = float(power.max() / power.sum())
    p = min(len(power) * (1.0 - share) ** (len(power) - 1), 1.0)
    period = 24.0 * len(daily) / (int(np.argmax(power)) + CYCLES)
    return SpectralLine(quantity, period, p, cause) if p < SIGNIFICANT else None


def what_is_left(ended: Conclusion) -> list[SpectralLine]:
    """What is left in the errors of the last model, and in the daily scores of what is named."""
    one, own = (ended.extended or ended.base).estimate, {}
    for accepted in ended.accepted:
        new = {p.name for p in added(ended.base.estimate, accepted.estimate.simulator)}
        own[accepted.cause] = tuple(sorted(new & brought(accepted.form, one.simulator)))
    return lines(one, own)
