"""What structure is left in the errors of a free run: under a condition, or to one side."""

from __future__ import annotations

import math
from collections.abc import Sequence
from datetime import UTC, datetime

import numpy as np

from hygrokf.discovery.conditions import LAGS_H
from hygrokf.discovery.misfits import LEVEL, NAMES, Misfit, digits, misfits
from hygrokf.discovery.residuals import (
    FEWEST_HOURS,
    QUANTITIES,
    UNITS,
    Hours,
    Residuals,
    closed,
    hourly,
    run_lengths,
)
from hygrokf.discovery.significance import block_h

SKEWED = 0.5
"""[1] skewness of the errors below which nothing is called one-sided."""


def structure(
    residuals: Residuals, level: float = LEVEL, found: Sequence[Misfit] | None = None
) -> dict | None:
    """The strongest structure left in the errors, or None: quantity, when, what it goes with, p.

    level: [1] chance of an answer where there is none.  found: `misfits(residuals)` if at hand.  Looked for are misfits
    under any condition, and excursions to one side under no condition that was logged.  `driver`, `lag_h` and `correlation` name the driver that the error follows best.
    """
    found = misfits(residuals, level) if found is None else found
    hours = hourly(residuals)
    if found:
        one = found[0]
        when = ", ".join(part for part in (one.when, one.where) if part)
        return _left(hours, one.quantity, "condition", when, one.statement, one.q, one.driver)
    for quantity in QUANTITIES:
        error = hours.error[quantity]
        if np.isfinite(error).sum() < FEWEST_HOURS:
            continue
        skewness, p = one_sided(error, hours.step_h)
        p = min(1.0, len(QUANTITIES) * p)
        if p > level or abs(skewness) < SKEWED:
            continue
        side = np.sign(skewness)
        size = float(np.nanquantile(side * error, 0.99))
        spans = [(a, b) for a, b in run_lengths(closed(side * error > 0.5 * size, hours.step_h)) if b - a > 1]
        spans = sorted(spans, key=lambda span: -float(np.nansum(side * error[slice(*span)])))
        when = _dates([float(hours.time_s[a]) for a, _ in spans])
        words = (
            f"in {len(spans)} episodes, under no condition that is logged, simulated {NAMES[quantity]} is up to "
            f"{digits(size)} {UNITS[quantity]} {'too low' if side > 0 else 'too high'}: {when}"
        )
        return _left(hours, quantity, "one-sided excursions", when, words, p)
    return None


def _left(hours: Hours, quantity: str, kind: str, when: str, words: str, p: float, driver: str = "") -> dict:
    """A structure in words, with the driver and lag of the largest correlation with the error."""
    error = hours.error[quantity]
    best: tuple[float, str | None, float | None] = (0.0, None, None)
    for name, value in hours.drivers.items():
        if driver not in ("", name):
            continue
        for lag in (0, *(round(one / hours.step_h) for one in LAGS_H)):
            before = np.append(np.full(lag, np.nan), value[: len(value) - lag])
            both = np.isfinite(error) & np.isfinite(before)
            if both.sum() < FEWEST_HOURS or not before[both].std() > 0 or not error[both].std() > 0:
                continue
            r = float(np.corrcoef(error[both], before[both])[0, 1])
            if abs(r) > abs(best[0]):
                best = (r, name, lag * hours.step_h)
    return {
        "quantity": quantity,
        "kind": kind,
        "when": when,
        "driver": best[1],
        "lag_h": best[2],
        "correlation": best[0],
        "p": p,
        "statement": words,
    }


def _dates(instants_s: Sequence[float]) -> str:
    """Dates in words: the first three, and how many more."""
    days = list(dict.fromkeys(f"{datetime.fromtimestamp(one, UTC):%-d %B %Y}" for one in instants_s))
    more = f" and {len(days) - 3} more" if len(days) > 3 else ""
    return ", ".join(days[:3]) + more


def one_sided(values: np.ndarray, step_h: float = 1.0) -> tuple[float, float]:
    """Skewness [1] of a series (n,), NaN = missing, and p that a symmetrical one shows it; blocks are the witnesses."""
    from scipy.stats import t as t_law

    known = np.isfinite(values)
    if known.sum() < 2 or not float(values[known].std()) > 0:
        return 0.0, 1.0
    z = np.where(known, (values - float(values[known].mean())) / float(values[known].std()), 0.0)
    block = max(1, round(block_h(values, step_h) / step_h))
    shares = np.add.reduceat(z**3 - 3.0 * z, np.arange(0, len(z), block))
    ratio = float(shares.sum()) / math.sqrt(float((shares**2).sum()))
    return float((z**3).sum() / known.sum()), float(2.0 * t_law.sf(abs(ratio), max(1, len(shares) - 1)))
