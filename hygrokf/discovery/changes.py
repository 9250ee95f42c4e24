"""What lasts: drifts, changes of the mean at an unknown date, and sharp jumps between two readings.

A lasting change raises the estimated memory of the errors, and so its own p, if it is taken for noise: the
noise is judged without it.  And slow wandering looks like a change: so both are held against how the errors'
partial sums wander beside it (self-normalisation).

Shapes: n bins or readings, B surrogates, m candidate dates.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from hygrokf.discovery.significance import Null, centred, tail
from hygrokf.evaluation.bootstrap import autoregression

LEAST_LEAD = -4.0
CLEAR_LEAD = 2.0
"""Twice the log-likelihood by which a lasting jump leads a stray reading or a kick: tolerable, and clear."""
FEWEST_STEP = 200
"""Readings below which no jump between two of them is looked for."""
EDGE = 0.05
"""[1] share of the record at either end in which no jump is looked for."""


def change_p(null: Null, candidates: np.ndarray) -> tuple[float, int]:
    """p that the clearest lasting change of the mean is chance, over candidate bins (m,), and its first bin.

    Self-normalised CUSUM: the difference between after and before is held against how the partial sums wander
    on either side of the date itself, so that slow wandering is not taken for a change, and a large change
    not for wandering. The law comes from surrogates of the noise without the change.

    Source: Shao & Zhang 2010, doi:10.1198/jasa.2010.tm10103.
    """
    known = np.isfinite(null.values)
    width = int(candidates[1] - candidates[0]) if len(candidates) > 1 else int(candidates[0])
    edges = np.arange(0, len(known), width)
    number = np.cumsum(np.add.reduceat(known.astype(float), edges))
    place = candidates // width - 1
    ratio = _changes(np.add.reduceat(null.deviations[None], edges, axis=1), number)[0, place]
    first = int(candidates[int(np.argmax(ratio))])
    noise = null.without((np.arange(len(known)) >= first)[:, None].astype(float))
    world = _changes(np.add.reduceat(noise.made, edges, axis=1), number)[:, place].max(axis=1)
    return tail(math.log(max(float(ratio.max()), 1e-12)), np.log(np.maximum(world, 1e-12))), first


def _changes(sums: np.ndarray, number: np.ndarray) -> np.ndarray:
    """Self-normalised change (B, m) after each of m stretches, from their sums (B, m) and running numbers
    (m,)."""
    total, all_n = np.cumsum(sums, axis=1), number[-1]

    def wandering(s: np.ndarray, i: np.ndarray) -> np.ndarray:
        """Σ_{j ≤ k} (S_j − i_j/i_k S_k)² for every k."""
        slope = s / np.maximum(i, 1.0)
        return np.cumsum(s**2, axis=1) - 2.0 * slope * np.cumsum(i * s, axis=1) + slope**2 * np.cumsum(i**2)

    change = total - number / all_n * total[:, -1:]
    back = (total[:, -1:] - total)[:, ::-1][:, 1:], (all_n - number)[::-1][1:]
    later = wandering(*back)[:, ::-1]
    around = wandering(total, number)
    around[:, :-1] += later
    return np.where(np.arange(len(number)) < len(number) - 1, change**2 / np.maximum(around, 1e-300), 0.0)


def drift_p(null: Null, trend: np.ndarray) -> float:
    """p that a series is free of a slow trend (n, 1), judged by how its partial sums wander
    (self-normalised).

    Source: Kiefer, Vogelsang & Bunzel 2000, doi:10.1111/1468-0262.00128.
    """
    known = np.isfinite(null.values)
    x = centred(trend, known)[known, 0]
    x = x / math.sqrt(float(x @ x))

    def ratio(series: np.ndarray) -> np.ndarray:
        slope = series @ x
        wandering = np.cumsum((series - slope[:, None] * x) * x, axis=1)
        return np.abs(slope) / np.sqrt(np.maximum((wandering**2).mean(axis=1), 1e-300))

    noise = null.without(trend).made[:, known]
    world = ratio(noise - noise.mean(axis=1, keepdims=True))
    typical = float(np.median(world)) or 1.0
    # the law has wide tails; its logarithm has those of a gamma law
    return tail(
        math.log1p(float(ratio(null.deviations[None, known])[0]) / typical), np.log1p(world / typical)
    )


# --- sharp jumps -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Step:
    """A lasting jump of readings: at which one, how large [unit of the series], z, p over all dates.

    lead: twice the log-likelihood by which it explains the readings around it better than what does not last.
    """

    place: int
    size: float
    z: float
    p: float
    lead: float

    @property
    def clear(self) -> bool:
        """Whether the jump's surroundings alone tell it from a stray reading or a kick."""
        return self.lead >= CLEAR_LEAD


def sharp_step(values: np.ndarray) -> Step | None:
    """The likeliest lasting jump between two readings of a series (n,) at equal steps, by generalised least
    squares.

    Free of its memory, a jump of the readings is a pattern of its own: neither a stray reading nor a kick
    that the memory forgets, both of which are tried beside it.  So a jump of 0.6 K stands out from a
    cabinet's smooth errors of 1.5 K, where the means before and after hardly differ.  The tails of the
    errors' law are those of the pattern at all other dates.  None where there are too few readings, or
    another pattern explains them clearly better.
    """
    from scipy.stats import norm

    phi, w = autoregression(values, 24)
    valid, p = np.isfinite(w), len(phi)
    n = len(w)
    if valid.sum() < max(FEWEST_STEP, 0.5 * n):
        return None
    scale = float(w[valid].std())
    w = np.where(valid, w, 0.0) / scale
    there = valid.astype(float)
    kernel = np.concatenate([[1.0], -phi])
    course = np.cumsum(kernel)
    sharp, rest = course[:-1], course[-1]
    margin = max(p + 1, round(EDGE * n))
    dates = np.arange(margin, n - margin)
    head = _ahead(w, sharp)
    after = np.concatenate([np.cumsum(w[::-1])[::-1], np.zeros(p + 1)])
    number = np.concatenate([np.cumsum(there[::-1])[::-1], np.zeros(p + 1)])
    # regressors: the jump, free of its memory, and the constant that the mean before it takes
    constant = max(rest**2 * number[0], 1e-300)
    xw = head[dates] + rest * after[dates + p]
    x1 = rest * (_ahead(there, sharp)[dates] + rest * number[dates + p])
    xx = _ahead(there, sharp**2)[dates] + rest**2 * number[dates + p] - x1**2 / constant
    beta = (xw - x1 * rest * after[0] / constant) / np.maximum(xx, 1e-300)
    z = beta * np.sqrt(np.maximum(xx, 0.0))
    best = int(np.argmax(np.abs(z)))
    near = slice(max(0, dates[best] - 2), dates[best] + 3)
    stray = (_ahead(w, kernel) / math.sqrt(float(kernel @ kernel)))[near]
    rival = max(float(np.max(stray**2)), float(np.max(w[near] ** 2)))
    lead = float(z[best]) ** 2 - rival
    if lead < LEAST_LEAD:
        return None
    # the tails of the pattern's sharp part at all other dates; its lasting part wanders and has none
    others = np.abs(np.delete(head, slice(max(0, dates[best] - 2 * p - 2), dates[best] + 2 * p + 3)))
    normal = float(norm.isf(0.001)) / float(norm.isf(0.05)) * float(np.quantile(others, 0.9))
    heavy = max(1.0, float(np.quantile(others, 0.998)) / normal)
    chance = 2.0 * len(dates) * float(norm.sf(abs(float(z[best])) / heavy))
    return Step(int(dates[best]), float(beta[best]) * scale, float(z[best]), min(1.0, chance), lead)


def _ahead(values: np.ndarray, pattern: np.ndarray) -> np.ndarray:
    """Σ_j pattern[j] values[t + j] for every t."""
    if not len(pattern):
        return np.zeros(len(values))
    return np.correlate(values, pattern, "full")[len(pattern) - 1 :]
