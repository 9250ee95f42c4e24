"""The end of a search: final parameters of the base and of the extended model, and the names that held-out
readings confirm.

One estimator makes both sets of parameters.  A name that held-out readings refute under these sets is
dropped, and the estimator is chosen again.  Then lines are searched in the spectrum of the whitened errors
and of a named cause's daily scores: a missing effect that no cause describes often has a rhythm, such as a
tide, a weekly routine or a duty cycle.  Under a right model the ordinates of a periodogram are independent
exponential numbers.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.discovery.candidates import Candidate, brought
from hygrokf.discovery.discovery_results import HeldOutTest, SpectralLine
from hygrokf.discovery.estimate import Calibration, frame, slopes
from hygrokf.discovery.final_set import Estimator, FinalSet, final_estimator, final_set, fitted_by
from hygrokf.discovery.judgement import NOTICED, scores
from hygrokf.discovery.screening import added
from hygrokf.discovery.search import Search, composed, effect_of, foreseen, tested


@dataclass(frozen=True)
class Conclusion:
    """The final sets of the base and of the extended model (None without a name), with the accepted and the
    refuted candidates."""

    base: FinalSet
    extended: FinalSet | None
    accepted: tuple[Candidate, ...]
    refuted: tuple[Candidate, ...]


def conclude(search: Search) -> Conclusion:
    """The conclusion of a search, without the names that held-out readings refute under the final sets."""
    accepted, refuted, extended_estimate = list(search.accepted), list(search.refuted), search.parent
    while accepted:
        estimator = final_estimator(search.base, extended_estimate)
        base, extended = (final_set(model, estimator) for model in (search.base, extended_estimate))
        verdicts = [_judged(search.base, base, accepted, name, extended, estimator) for name in accepted]
        refuted_places = [i for i, verdict in enumerate(verdicts) if verdict.reason]
        if not refuted_places:
            named = tuple(replace(a, judged=v) for a, v in zip(accepted, verdicts, strict=True))
            return Conclusion(base, extended, named, tuple(refuted))
        # drop first a name without an effect, then the name with the largest growth of errors
        harm = [(v.reason == "no_effect", max(v.growth.values(), default=0.0)) for v in verdicts]
        worst = max(refuted_places, key=lambda i: harm[i])
        refuted.append(replace(accepted.pop(worst), judged=verdicts[worst]))
        extended_estimate = composed(search.base, accepted, extended_estimate, refuted[-1].acts)
    return Conclusion(final_set(search.base, final_estimator(search.base)), None, (), tuple(refuted))


def _judged(
    start: Calibration,
    base: FinalSet,
    accepted: Sequence[Candidate],
    name: Candidate,
    extended: FinalSet,
    estimator: Estimator,
) -> HeldOutTest:
    """The test, on held-out readings, of the extended model against the model without one of the names."""
    others = [candidate for candidate in accepted if candidate is not name]
    without = base.estimate
    if others:
        without = fitted_by(composed(start, others, extended.estimate, name.acts), estimator, name.acts)
    child = foreseen(without, replace(name, estimate=extended.estimate))
    after = scores(child)
    earlier = list(itertools.takewhile(lambda candidate: candidate is not name, accepted))
    verdict = tested(scores(without), after, name, earlier)
    if effect_of(name.form, without, child, after) < NOTICED:
        return replace(verdict, reason="no_effect")
    return verdict


SIGNIFICANT = 1e-4
"""Probability of a line without an effect, below which the line is reported."""
BIN_H = 1.0
NEIGHBOURS = 101
"""Ordinates of the periodogram whose mean is compared with the ordinate in their middle."""
FEWEST = 3 * NEIGHBOURS
CYCLES = 4
"""Fewest cycles of a rhythm in the record: with fewer cycles it cannot be distinguished from a trend."""
FEWEST_DAYS = 30


def lines(estimate: Calibration, causes: Mapping[str, tuple[str, ...]]) -> list[SpectralLine]:
    """Significant lines of an estimate, the smallest p first; causes: cause → its own parameters."""
    all_lines = [line for q in estimate.quantities if (line := _in_errors(estimate, q)) is not None]
    scores = _daily_scores(estimate)
    for cause, names in causes.items():
        for (q, name), daily in scores.items():
            if name in names and (line := _in_days(q, cause, daily)) is not None:
                all_lines.append(line)
    best: dict[tuple[str, str], SpectralLine] = {}
    for line in sorted(all_lines, key=lambda line: line.p):
        best.setdefault((line.quantity, line.cause), line)
    return list(best.values())


def _in_errors(estimate: Calibration, quantity: str) -> SpectralLine | None:
    """The strongest line of the whitened errors relative to the mean of its neighbours; None if it is not
    significant."""
    reference, r = estimate.filtered[quantity], estimate.simulator.scene.readings[quantity]
    is_present = np.isfinite(reference.innovation)
    errors = (reference.standardised * reference.weight)[is_present]
    hours = r.time_h[is_present]
    width = max(BIN_H, float(np.median(np.diff(hours)))) if len(hours) > 1 else BIN_H
    bin_index = ((hours - hours[0]) / width).astype(int)
    total = np.bincount(bin_index, errors)
    count_in_bin = np.bincount(bin_index)
    mean = np.divide(total, np.sqrt(np.maximum(count_in_bin, 1)))
    power = np.abs(np.fft.rfft(mean - mean[count_in_bin > 0].mean() * (count_in_bin > 0))) ** 2
    power = power[1:-1]
    if len(power) < FEWEST:
        return None
    half = NEIGHBOURS // 2
    sums = np.cumsum(np.pad(power, (half + 1, half), mode="reflect"))
    neighbours = (sums[NEIGHBOURS:] - sums[:-NEIGHBOURS] - power) / (NEIGHBOURS - 1)
    ratio = power / np.maximum(neighbours, 1e-300)
    ratio[: CYCLES - 1] = 0.0
    best = int(np.argmax(ratio))
    # the neighbours' mean is itself uncertain: F with 2 and 2 (neighbours − 1) degrees of freedom
    tail_probability = (1.0 + ratio[best] / (NEIGHBOURS - 1)) ** (1.0 - NEIGHBOURS)
    p = -math.expm1(len(power) * math.log1p(-min(tail_probability, 1.0 - 1e-16)))
    return SpectralLine(quantity, width * len(mean) / (best + 1), p) if p < SIGNIFICANT else None


def _daily_scores(estimate: Calibration) -> dict[tuple[str, str], np.ndarray]:
    """(days,) sums of the scores of every parameter, by quantity and name."""
    coordinates = frame(estimate.simulator.parameters, set(estimate.simulator.names), estimate.linear)
    daily_scores = {}
    for q, columns in slopes(estimate, coordinates).items():
        reference = estimate.filtered[q]
        score = (
            reference.whitened(columns) * (np.nan_to_num(reference.standardised) * reference.weight)[:, None]
        )
        readings = estimate.simulator.scene.readings[q]
        daily = readings.by_day(score)
        has_reading = np.bincount(readings.day, np.isfinite(reference.innovation)) > 0
        for i, place in enumerate(coordinates.place):
            if columns[:, i].any():
                daily_scores[q, estimate.simulator.names[place]] = daily[
                    : np.flatnonzero(has_reading)[-1] + 1, i
                ]
    return daily_scores


def _in_days(quantity: str, cause: str, daily: np.ndarray) -> SpectralLine | None:
    """The strongest line of daily scores by Fisher's g, the largest share of an ordinate in the total power;
    None if it is not significant."""
    if len(daily) < FEWEST_DAYS:
        return None
    ranks = np.argsort(np.argsort(daily)) - 0.5 * (len(daily) - 1)  # ranks: single days must not decide
    power = np.abs(np.fft.rfft(ranks)) ** 2
    power = power[CYCLES : (len(daily) + 1) // 2]
    if not power.sum() > 0.0:
        return None
    share = float(power.max() / power.sum())
    p = min(len(power) * (1.0 - share) ** (len(power) - 1), 1.0)
    period = 24.0 * len(daily) / (int(np.argmax(power)) + CYCLES)
    return SpectralLine(quantity, period, p, cause) if p < SIGNIFICANT else None


def remaining_lines(conclusion: Conclusion) -> list[SpectralLine]:
    """The lines in the errors of the last model and in the daily scores of the named causes."""
    final, parameters_of = conclusion.extended or conclusion.base, {}
    for candidate in conclusion.accepted:
        added_names = {p.name for p in added(conclusion.base.estimate, candidate.estimate.simulator)}
        parameters_of[candidate.cause] = tuple(
            sorted(added_names & brought(candidate.form, final.estimate.simulator))
        )
    return lines(final.estimate, parameters_of)
