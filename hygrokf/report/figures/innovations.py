"""The figure of innovations: whiteness in time and frequency, correlation with the inputs, distribution."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from statistics import NormalDist
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.data.result_file import array, instants, scalar
from hygrokf.evaluation.diagnosis import (
    Autocorrelation,
    CrossCorrelation,
    CumulativePeriodogram,
    OutputDiagnosis,
    Periodogram,
)
from hygrokf.identification.fit_results import FitResults
from hygrokf.identification.wording import one_line
from hygrokf.report.figures.drawing import (
    INK,
    MEASURED,
    QUIET,
    SIMULATED,
    NothingToShow,
    Panels,
    calendar,
    empty,
    line,
    logarithmic,
    segments,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes

QUANTILES = 160
"""Points of the quantile plot, evenly spread over the normal distribution's quantiles."""
INPUTS = 4
"""Inputs that are shown; of more of them those with the smallest p."""
LEVEL = 0.95


def figure_innovations(
    fit: FitResults, series: Mapping[str, np.ndarray], output: str = "temperature"
) -> Panels:
    """Standardised innovations [1] of one output, "temperature" or "humidity", over the identification
    period."""
    found = fit.innovations.outputs.get(output)
    time = instants(series)
    value = array(series, f"{output}_innovation")
    until = scalar(series, "until_s")
    known = np.isfinite(value) & (time <= until if math.isfinite(until) else True)
    if found is None or not known.any():
        raise NothingToShow(
            f"There are no innovations of the {output}: the filter observed none of its readings."
        )
    if found.autocorrelation is None:
        why = found.statements[0] if found.statements else "too few readings"
        raise NothingToShow(f"No diagnosis: {why}.")
    cross = _shown_inputs(found)
    reach = max((correlation_reach(one) for _, one in cross), default=0.0)
    without = "no input varies, or none is known: no cross-correlation"

    def crossed(axes: Axes, name: str, one: CrossCorrelation) -> None:
        correlation(axes, [one], [MEASURED], reach)
        axes.set_title(
            f"Correlation with {one_line(name).replace('_', ' ')}", fontweight="normal", fontsize=7.0
        )

    draw = (
        partial(_autocorrelation, data=found.autocorrelation),
        partial(_cumulative, data=found.cumulative_periodogram or CumulativePeriodogram()),
        partial(periodogram, shown=[found.periodogram], colours=[MEASURED]),
        partial(_histogram, e=value[known]),
        partial(_quantiles, e=value[known]),
        partial(_course, time=time, value=np.where(known, value, np.nan)),
        *(partial(crossed, name=name, one=one) for name, one in cross),
        *([] if cross else [partial(empty, sentence=without)]),
    )
    return Panels(draw, height_in=1.6 * -(-len(draw) // 3), columns=3)


def _columns(*lists: tuple[float, ...]) -> list[np.ndarray]:
    """Lists of equal length as arrays of the rows in which all are finite; empty where lengths differ."""
    if len({len(one) for one in lists}) != 1:
        return [np.empty(0) for _ in lists]
    rows = np.array(lists, dtype=float)
    return list(rows[:, np.isfinite(rows).all(axis=0)])


def _limits(axes: Axes, data: Autocorrelation | CrossCorrelation) -> float:
    """Both confidence limits of a correlation; returns the wider one."""
    single, together = data.limit, data.limit_all
    if math.isfinite(single):
        axes.axhspan(-single, single, color=QUIET, alpha=0.16, linewidth=0)
    for sign in (-1.0, 1.0):
        if math.isfinite(together):
            axes.axhline(sign * together, color=INK, linewidth=0.7, dashes=(4, 2))
    return together if math.isfinite(together) else 0.0


def _stems(axes: Axes, lag: np.ndarray, value: np.ndarray, limit: float) -> None:
    beyond = np.abs(value) > limit
    axes.axhline(0.0, color=QUIET, linewidth=0.6)
    for chosen, colour, width in ((~beyond, MEASURED, 0.7), (beyond, SIMULATED, 1.3)):
        x = lag[chosen]
        segments(axes, x, np.zeros(len(x)), x, value[chosen], colour, width)


def _reach(limit: float, *values: np.ndarray) -> float:
    largest = max((float(np.nanmax(np.abs(v), initial=0.0)) for v in values), default=0.0)
    return min(max(1.9 * limit, 1.15 * largest, 0.02), 1.02)


def _autocorrelation(axes: Axes, data: Autocorrelation) -> None:
    lag, value = _columns(data.lag_h, data.value)
    axes.set_title("Autocorrelation")
    if len(lag) < 2 or not lag[-1] > 0:
        return empty(axes, "no autocorrelation in fit.json")
    limit = _limits(axes, data)
    _stems(axes, lag, value, limit)
    reach = _reach(limit, value)
    axes.set_ylim(-reach, reach)
    axes.set_xlim(0.0, float(lag[-1]) * 1.02)
    axes.locator_params(axis="y", nbins=5)
    _hours(axes, 0.0, float(lag[-1]))
    axes.set_xlabel("lag [h]")


def _hours(axes: Axes, low: float, high: float, ticks: float = 8.5) -> None:
    for step in (1.0, 3.0, 6.0, 12.0, 24.0):
        if (high - low) / step <= ticks:
            if (high - low) / step >= 2:
                axes.set_xticks(np.arange(math.ceil(low / step), math.floor(high / step) + 1) * step)
            break


def _cumulative(axes: Axes, data: CumulativePeriodogram) -> None:
    frequency, value = _columns(data.frequency_per_h, data.value)
    axes.set_title("Cumulative periodogram")
    if len(frequency) < 2 or not frequency[-1] > 0:
        return empty(axes, "no cumulative periodogram in fit.json")
    limit, end = data.limit, float(frequency[-1])
    line = np.array([0.0, end])
    axes.fill_between(line, line / end - limit, line / end + limit, color=QUIET, alpha=0.16, linewidth=0)
    axes.plot(line, line / end, color=QUIET, linewidth=0.6)
    outside = data.statistic > limit
    axes.plot(frequency, value, color=SIMULATED if outside else MEASURED, linewidth=1.2)
    axes.set_xlim(0.0, end)
    axes.set_ylim(0.0, 1.0)
    axes.set_xlabel("frequency [1/h]")
    words = "p < 0.001" if data.p < 0.001 else f"p = {data.p:.2f}"
    axes.text(0.04, 0.95, f"Kolmogorov–Smirnov\n{words}", transform=axes.transAxes, va="top", fontsize=7.0)


def periodogram(axes: Axes, shown: Sequence[Periodogram | None], colours: Sequence[str]) -> None:
    """Power over the period, of white innovations 1, with the 95 % band of the first one."""
    every = [
        (_columns(one.frequency_per_h, one.power, one.lower, one.upper), colour)
        for one, colour in zip(shown, colours, strict=True)
        if one is not None
    ]
    every = [
        (rows, colour)
        for rows, colour in every
        if len(rows[0]) > 1 and rows[0][0] > 0 and np.all(np.diff(rows[0]) > 0)
    ]
    if not every:
        return empty(axes, "no periodogram in fit.json")
    frequency, _, lower, upper = every[0][0]
    period = 1.0 / frequency
    axes.fill_between(period, np.maximum(lower, 1e-3), upper, color=QUIET, alpha=0.16, linewidth=0)
    axes.axhline(1.0, color=QUIET, linewidth=0.6)
    for rows, colour in every:
        axes.plot(1.0 / rows[0], np.maximum(rows[1], 1e-3), color=colour, linewidth=0.9)
    powers = np.concatenate([rows[1] for rows, _ in every])
    axes.set_ylim(max(0.02, 0.7 * float(powers.min())), 1.4 * max(float(powers.max()), 4.0))
    logarithmic(axes, "y")
    high, low = min(float(period[0]), 2000.0), float(period[-1])
    axes.set_xscale("log")
    axes.set_xlim(high, low)
    ticks = [p for p in (0.1, 0.5, 2.0, 6.0, 24.0, 168.0, 720.0) if low <= p <= high]
    axes.set_xticks(ticks, [f"{p:g}" for p in ticks])
    axes.minorticks_off()
    axes.set_title("Periodogram (white = 1)")
    axes.set_xlabel("period [h]")


def _shown_inputs(found: OutputDiagnosis) -> list[tuple[str, CrossCorrelation]]:
    rows = [
        (name, one)
        for name, one in found.cross_correlation.items()
        if len(_columns(one.lag_h, one.value)[0]) > 1
    ]
    first = sorted(rows, key=lambda row: math.inf if math.isnan(row[1].p) else row[1].p)[:INPUTS]
    return [row for row in rows if row in first]


def correlation_reach(one: CrossCorrelation) -> float:
    """Height [1] at which a correlation and its limits can be seen."""
    return _reach(one.limit_all if one.limit_all > 0 else 0.0, _columns(one.lag_h, one.value)[1])


def correlation(
    axes: Axes, shown: Sequence[CrossCorrelation | None], colours: Sequence[str], reach: float
) -> None:
    """Correlations with an input over the lag, those of several models as lines, within the limits of the
    first one."""
    pairs = zip(shown, colours, strict=True)
    every = [(one, colour) for one, colour in pairs if one is not None and one.lag_h]
    limit = _limits(axes, every[0][0])
    for one, colour in every:
        lag, value = _columns(one.lag_h, one.value)
        if colours[1:]:
            axes.plot(lag, value, color=colour, linewidth=0.9)
        else:
            _stems(axes, lag, value, limit)
    lag, _ = _columns(every[0][0].lag_h, every[0][0].value)
    axes.axhline(0.0, color=QUIET, linewidth=0.6)
    axes.axvline(0.0, color=QUIET, linewidth=0.6)
    axes.set_ylim(-reach, reach)
    axes.set_xlim(1.02 * float(lag[0]), 1.02 * float(lag[-1]))
    _hours(axes, float(lag[0]), float(lag[-1]), 5.0)
    axes.locator_params(axis="y", nbins=5)
    axes.set_xlabel("lag [h], > 0: later")


def _histogram(axes: Axes, e: np.ndarray) -> None:
    edges = np.linspace(-4.5, 4.5, 46)
    count, _ = np.histogram(np.clip(e, -4.499, 4.499), edges)
    width = edges[1] - edges[0]
    middle = 0.5 * (edges[1:] + edges[:-1])
    axes.fill_between(middle, 0.0, count / (len(e) * width), step="mid", color=MEASURED, alpha=0.3)
    x = np.linspace(-4.5, 4.5, 120)
    axes.plot(x, np.exp(-0.5 * x**2) / math.sqrt(2.0 * math.pi), color=INK, linewidth=0.9)
    axes.set_title("Histogram and standard normal")
    axes.set_xlim(-4.5, 4.5)
    axes.set_ylim(0.0, None)
    axes.set_xlabel("e/√S [1]; the ends hold all beyond")


def _quantiles(axes: Axes, e: np.ndarray) -> None:
    """Quantiles of the innovations against those of the standard normal, with a pointwise 95 % band."""
    n = len(e)
    normal = NormalDist()
    ends = normal.inv_cdf((n - 0.5) / n) if n > 1 else 0.0
    wanted = np.linspace(-ends, ends, QUANTILES)
    place = np.unique(np.clip([math.floor(n * normal.cdf(v)) for v in wanted], 0, n - 1))
    share = (place + 0.5) / n
    x = np.array([normal.inv_cdf(float(p)) for p in share])
    # standard error of an order statistic: √(p(1−p)/n) over the density
    spread = np.sqrt(share * (1 - share) / n) / (np.exp(-0.5 * x**2) / math.sqrt(2.0 * math.pi))
    reach = normal.inv_cdf(0.5 + 0.5 * LEVEL)
    axes.fill_between(x, x - reach * spread, x + reach * spread, color=QUIET, alpha=0.16, linewidth=0)
    axes.plot(x, x, color=QUIET, linewidth=0.6)
    axes.plot(x, np.sort(e)[place], ".", color=MEASURED, markersize=2.6, markeredgewidth=0)
    axes.set_title("Quantiles of e/√S")
    axes.set_xlabel("standard normal [1]")


def _course(axes: Axes, time: np.ndarray, value: np.ndarray) -> None:
    known = np.isfinite(value)
    span = (float(time[known][0]), float(time[known][-1]))
    line(axes, time, value, span, MEASURED, 0.5, 200)
    for level in (-3.0, 3.0):
        axes.axhline(level, color=INK, linewidth=0.7, dashes=(4, 2))
    reach = max(4.5, 1.1 * float(np.max(np.abs(value[known]))))
    axes.set_ylim(-min(reach, 12.0), min(reach, 12.0))
    calendar(axes, span, 5)
    axes.set_title("Course (±3 dashed)")
