"""The structure that is left in the errors of a free run: under a condition, to one side, or in time
alone."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from hygrokf.discovery.changes import GROWS, growth, period
from hygrokf.discovery.discovery_results import ResidualStructure
from hygrokf.discovery.findings import LEVEL, MATERIAL, NAMES, digits, findings
from hygrokf.discovery.residuals import (
    FEWEST_HOURS,
    HUMIDITY,
    QUANTITIES,
    TEMPERATURE,
    UNITS,
    Hours,
    Residuals,
    closed,
    first_dates,
    hourly,
    run_lengths,
)
from hygrokf.discovery.strata import LAGS_H
from hygrokf.evaluation.bootstrap import block_h

BLOCK_H = 3.0
"""[h] blocks in which unrest is looked for."""
WANDERS_H = 24.0
"""[h] standard deviation of the bell by which the error's slow course is taken out: effects that come and go
last for hours."""
APART = 24
"""Fewest blocks (three days) by which two series are moved apart to see what chance makes of them."""
RESTLESS = {(TEMPERATURE, 1): 2.4, (TEMPERATURE, -1): 3.6, (HUMIDITY, 1): 3.0, (HUMIDITY, -1): 3.0}
"""(quantity, side) -> standard errors beyond which unrest goes with that side of the error.  A cabinet is
warmer than the air around it, so an ordinary restless exchange makes errors to the cold side."""
UNSTEADY = 1.3
"""[1] variance of the innovations' size below which there is no unrest."""
REGULAR = 1e-3
"""p below which errors have a period; slow errors of 20 cabinets without a hidden cause came down to
0.005."""
CHANCE = 0.01
"""p below which errors grow or come in bursts, if they also exceed `GROWS` or `PEAKED`."""
PEAKED = 6.0
"""[1] kurtosis of the errors from which they come in bursts, twice that of a Gaussian disturbance."""
SKEWED = 0.5
"""[1] skewness below which errors are not called one-sided."""


def structure(residuals: Residuals, level: float = LEVEL) -> ResidualStructure | None:
    """The strongest structure left in the errors, or None.

    level: [1] chance of a structure where there is none.

    Either a finding under a condition that came more than once, or excursions to one side under no logged
    condition.  `driver`, `lag_h` and `correlation` name the driver that the error follows best.
    """
    hours = hourly(residuals)
    one = next((finding for finding in findings(residuals, level) if not finding.once), None)
    if one is not None:
        when = ", ".join(part for part in (one.when, one.where) if part)
        return _with_driver(hours, one.quantity, "condition", when, one.statement, one.p_adjusted, one.driver)
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
        when, rest = first_dates(float(hours.time_s[a]) for a, _ in spans)
        when += f" and {rest} more" if rest else ""
        text = (
            f"in {len(spans)} episodesthat match no logged condition, simulated {NAMES[quantity]} is up "
            f"to {digits(size)} {UNITS[quantity]} {'too low' if side > 0 else 'too high'}: {when}"
        )
        return _with_driver(hours, quantity, "one-sided excursions", when, text, p)
    return None


def _course(hours: Hours, quantity: str) -> ResidualStructure | None:
    """A period, growth or bursts of a quantity's errors, or None."""
    error, name, unit = hours.error[quantity], NAMES[quantity], UNITS[quantity]
    scale = float(np.nanstd(error))
    line = period(error, hours.step_h, REGULAR)
    if line is not None and line.size > MATERIAL * scale:
        text = f"{line.hours:.1f} h" if line.hours < 72.0 else f"{line.hours / 24.0:.1f} days"
        words = (
            f"simulated {name} errs with a period of {text}, by {digits(line.size)} {unit} (root mean "
            "square); something unlogged follows a timer or a cycle of its own"
        )
        return _with_driver(hours, quantity, "period", f"every {text}", words, line.p)
    ratio, p = growth(error, hours.step_h)
    if p < CHANCE and max(ratio, 1.0 / ratio) > GROWS:
        change = f"grow to {ratio:.1f} times" if ratio > 1.0 else f"shrink to {ratio:.2f} times"
        words = f"the errors of the simulated {name} {change} their size over the record"
        return _with_driver(hours, quantity, "growth", "from beginning to end", words, p)
    peaked, p = bursts(error, hours.step_h)
    if p < CHANCE and peaked > PEAKED:
        words = (
            f"the errors of the simulated {name} come in bursts (kurtosis {peaked:.1f}, a steady "
            "disturbance has 3) that match no logged condition"
        )
        return _with_driver(hours, quantity, "bursts", "now and then", words, p)
    return None


def remaining(pair: tuple[Residuals, Residuals]) -> tuple[ResidualStructure | None, bool]:
    """(structure that is left in the errors of two versions of a model or None, whether no logged signal
    makes it).

    pair: as estimated by innovations, and moved toward the least free-run error.  Structure that the second
        version does not show comes from a poor simulator: a model of a wrong form is estimated to predict the
        next reading.
    """
    first, second = (unlogged(one) for one in pair)
    if first and second and first.quantity == second.quantity:
        return second, True
    return (structure(pair[1]) if structure(pair[0]) else None), False


def unlogged(residuals: Residuals) -> ResidualStructure | None:
    """Unrest to one side, a period, growth or bursts, or None: an effect that no logged signal explains,
    whatever else was found."""
    hours = hourly(residuals)
    for quantity in QUANTITIES:
        z, unsteady = unrest(residuals, quantity)
        if abs(z) > RESTLESS[quantity, int(math.copysign(1, z))] and unsteady > UNSTEADY:
            words = (
                f"something unlogged acts intermittently: the {NAMES[quantity]} fluctuates more while it "
                f"is simulated too {'low' if z > 0 else 'high'} (rank correlation {z:.1f} "
                "standard errors; a symmetric disturbance has none)"
            )
            return _with_driver(
                hours,
                quantity,
                "one-sided fluctuations",
                "now and then",
                words,
                math.erfc(abs(z) / math.sqrt(2.0)),
            )
        if np.isfinite(hours.error[quantity]).sum() >= FEWEST_HOURS:
            course = _course(hours, quantity)
            if course is not None:
                return course
    return None


def unrest(residuals: Residuals, quantity: str) -> tuple[float, float]:
    """(z, u) of a quantity: whether the size of its innovations goes with the side of its error.

    z: rank correlation of the mean squared innovation and the mean error in blocks of three hours, in
        standard errors; the error's slow course and the mean course over the day are taken out.  The standard
        error is that of the same series moved against each other by days.  Ordinary disturbances, also shots
        or those that go with the hour, have no side: z is a standard normal variate.  An effect that acts now
        and then, to one side, makes |z| large.
    u: variance of the mean squared innovations over that of a steady Gaussian's, 1 for a steady disturbance.
    """
    e = residuals.innovation(quantity)
    error = residuals.error(quantity)
    known = np.isfinite(e) & np.isfinite(error)
    if known.sum() < FEWEST_HOURS:
        return 0.0, 1.0
    block = np.floor((residuals.origin_s / 3600.0 + residuals.time_h[known]) / BLOCK_H).astype(int)
    hour = (np.arange(block.min(), block.max() + 1) % round(24.0 / BLOCK_H)).astype(int)
    block -= block.min()
    count = np.bincount(block, minlength=len(hour))
    full = count >= max(3, 0.5 * float(np.median(count[count > 0])))
    if full.sum() < 40:
        return 0.0, 1.0
    square = (np.bincount(block, e[known] ** 2, len(hour)) / np.maximum(count, 1))[full]
    mean = (np.bincount(block, error[known], len(hour)) / np.maximum(count, 1))[full]
    unsteady = float(np.var(square / square.mean()) * np.median(count[full]) / 2.0)
    rank = np.argsort(np.argsort(square)).astype(float)
    parts = np.zeros((2, len(hour)))
    for row, one in enumerate((rank, mean - _slow(mean, full))):
        parts[row, full] = _without_course(one, hour[full])
    # both have a memory: their product by chance is seen where one is moved against the other by days
    spectrum = np.fft.rfft(parts)
    products = np.fft.irfft(spectrum[0] * np.conj(spectrum[1]), len(hour))
    apart = products[APART : len(hour) - APART]
    spread = float(np.sqrt(np.mean(apart**2))) if len(apart) else 0.0
    return (float(products[0]) / spread if spread > 0 else 0.0), unsteady


def _slow(mean: np.ndarray, full: np.ndarray) -> np.ndarray:
    """Slow course of block means (n,) of the blocks flagged by `full` (N,): their mean under a bell."""
    sd = round(WANDERS_H / BLOCK_H)
    bell = np.exp(-0.5 * (np.arange(-3 * sd, 3 * sd + 1) / sd) ** 2)
    spread = np.zeros(len(full))
    spread[full] = mean
    sums, weight = (
        np.convolve(one, bell)[3 * sd : 3 * sd + len(full)] for one in (spread, full.astype(float))
    )
    return sums[full] / weight[full]


def _without_course(value: np.ndarray, hour: np.ndarray) -> np.ndarray:
    """Values (n,) less the mean of their block of the day."""
    sums = np.bincount(hour, value)
    return value - (sums / np.maximum(np.bincount(hour), 1))[hour]


def _with_driver(
    hours: Hours, quantity: str, kind: str, when: str, text: str, p: float, driver: str | None = None
) -> ResidualStructure:
    """A structure with the driver (of all, or the given one) and lag of the largest correlation with the
    error."""
    error = hours.error[quantity]
    best: tuple[float, str | None, float] = (0.0, None, math.nan)
    for name, value in hours.drivers.items():
        if driver not in (None, name):
            continue
        for lag in (0, *(round(one / hours.step_h) for one in LAGS_H)):
            before = np.append(np.full(lag, np.nan), value[: len(value) - lag])
            both = np.isfinite(error) & np.isfinite(before)
            if both.sum() < FEWEST_HOURS or not before[both].std() > 0 or not error[both].std() > 0:
                continue
            r = float(np.corrcoef(error[both], before[both])[0, 1])
            if abs(r) > abs(best[0]):
                best = (r, name, lag * hours.step_h)
    return ResidualStructure(quantity, kind, text, when, best[1], best[2], best[0], p)


def one_sided(values: np.ndarray, step_h: float = 1.0) -> tuple[float, float]:
    """Skewness [1] of a series (n,), NaN = missing, and p that a symmetrical one shows it."""
    return _moment(values, step_h, 3, lambda z: z**3 - 3.0 * z)


def bursts(values: np.ndarray, step_h: float = 1.0) -> tuple[float, float]:
    """Kurtosis [1] of a series (n,), NaN = missing, and p that a Gaussian one shows it."""
    return _moment(values, step_h, 4, lambda z: z**4 - 6.0 * z**2 + 3.0)


def _moment(
    values: np.ndarray, step_h: float, order: int, polynomial: Callable[[np.ndarray], np.ndarray]
) -> tuple[float, float]:
    """Standardised moment of an order, and p that it is that of a Gaussian series, by the scatter of blocks.

    The Hermite polynomial of the order has mean zero, and hardly any error from the estimated mean and
    variance.
    """
    from scipy.stats import t as t_law

    known = np.isfinite(values)
    if known.sum() < 2 or not float(values[known].std()) > 0:
        return 0.0, 1.0
    z = (values - float(values[known].mean())) / float(values[known].std())
    block = max(1, round(block_h(values, step_h) / step_h))
    shares = np.add.reduceat(np.where(known, polynomial(z), 0.0), np.arange(0, len(z), block))
    ratio = float(shares.sum()) / math.sqrt(float((shares**2).sum()))
    found = float(np.mean(z[known] ** order))
    return found, float(2.0 * t_law.sf(abs(ratio), max(1, len(shares) - 1)))
