"""The figure of innovations: whiteness in time and frequency, correlation with the inputs, distribution."""

from __future__ import annotations

import math
from collections.abc import Mapping
from statistics import NormalDist

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
from hygrokf.report.figures.drawing import INK, MEASURED, QUIET, SIMULATED, NothingToShow
from hygrokf.report.figures.panels import (
    Axis,
    Band,
    CrossLine,
    Curve,
    Mark,
    Note,
    Panel,
    Picture,
    Shade,
    course,
    strokes,
)
from hygrokf.report.quantities import spoken
from hygrokf.texts.wording import one_line, p_equation

QUANTILES = 160
"""Points of the quantile plot, evenly spread over the normal distribution's quantiles."""
INPUTS = 4
"""Inputs that are shown; of more of them those with the smallest p."""
LEVEL = 0.95


def figure_innovations(
    fit: FitResults, series: Mapping[str, np.ndarray], output: str = "temperature"
) -> Picture:
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
        raise NothingToShow(f"No diagnosis: {found.remark or 'too few readings'}.")
    cross = _shown_inputs(found)
    reach = max((_reach(one) for _, one in cross), default=0.0)
    e = value[known]
    panels = (
        _correlation(found.autocorrelation, _reach(found.autocorrelation), "Autocorrelation"),
        _cumulative(found.cumulative_periodogram or CumulativePeriodogram()),
        _periodogram(found.periodogram or Periodogram()),
        _quantiles(e),
        _course(time[known], e),
        *(_correlation(one, reach, f"Correlation with {spoken(one_line(name))}") for name, one in cross),
        *([] if cross else [Panel(title="no input varies, or none is known: no cross-correlation")]),
    )
    return Picture(panels, height_in=1.6 * -(-len(panels) // 3), columns=3)


def _columns(*lists: tuple[float, ...]) -> list[np.ndarray]:
    """Lists of equal length as arrays of the rows in which all are finite; empty where lengths differ."""
    if len({len(values) for values in lists}) != 1:
        return [np.empty(0) for _ in lists]
    rows = np.array(lists, dtype=float)
    return list(rows[:, np.isfinite(rows).all(axis=0)])


def _stems(lag: np.ndarray, value: np.ndarray, limit: float) -> list[Mark]:
    beyond = np.abs(value) > limit
    return [
        strokes(lag[chosen], np.zeros(chosen.sum()), lag[chosen], value[chosen], colour, width)
        for chosen, colour, width in ((~beyond, MEASURED, 0.7), (beyond, SIMULATED, 1.3))
    ]


def _reach(data: Autocorrelation | CrossCorrelation) -> float:
    """Height [1] at which a correlation and its limits can be seen."""
    largest = float(np.abs(_columns(data.lag_h, data.value)[1]).max(initial=0.0))
    limit = data.limit_all if data.limit_all > 0 else 0.0
    return min(max(1.9 * limit, 1.15 * largest, 0.02), 1.02)


def _correlation(data: Autocorrelation | CrossCorrelation, reach: float, title: str) -> Panel:
    """A correlation over the lag, with both of its confidence limits."""
    lag, value = _columns(data.lag_h, data.value)
    crossed = isinstance(data, CrossCorrelation)
    if len(lag) < 2 or not lag[-1] > 0:
        return Panel(title="no autocorrelation in fit.json")
    marks: list[Mark] = [CrossLine(0.0, "y")]
    if math.isfinite(data.limit):
        marks.append(Shade(-data.limit, data.limit, QUIET, 0.16, "", "y"))
    wide = data.limit_all if math.isfinite(data.limit_all) else 0.0
    marks += [CrossLine(sign * wide, "y", INK, 0.7, True) for sign in (-1.0, 1.0) if wide]
    if crossed:
        marks.append(CrossLine(0.0, "x"))
        x = _hours("lag [h], > 0: later", float(lag[0]), float(lag[-1]), 5.0)
    else:
        x = _hours("lag [h]", 0.0, float(lag[-1]))
    y = Axis(limits=(-reach, reach), most=5)
    return Panel((*marks, *_stems(lag, value, wide)), x, y, title, plain=crossed)


def _hours(label: str, low: float, high: float, ticks: float = 8.5) -> Axis:
    """An axis of lags [h] with ticks at hours, parts of a day, or days."""
    step = next((one for one in (1.0, 3.0, 6.0, 12.0, 24.0) if (high - low) / one <= ticks), 0.0)
    at: tuple[float, ...] = ()
    if step and (high - low) / step >= 2:
        at = tuple(step * np.arange(math.ceil(low / step), math.floor(high / step) + 1))
    return Axis(label, (1.02 * low, 1.02 * high), at=at)


def _cumulative(data: CumulativePeriodogram) -> Panel:
    frequency, value = _columns(data.frequency_per_h, data.value)
    if len(frequency) < 2 or not frequency[-1] > 0:
        return Panel(title="no cumulative periodogram in fit.json")
    end = float(frequency[-1])
    line = np.array([0.0, end])
    words = p_equation(data.p)
    marks = (
        Band(line, line / end - data.limit, line / end + data.limit, QUIET),
        Curve(line, line / end, QUIET, 0.6),
        Curve(frequency, value, SIMULATED if data.statistic > data.limit else MEASURED, 1.2),
        Note(f"Kolmogorov–Smirnov\n{words}", 0.03, 0.98, INK, "left", "top", "xy"),
    )
    limits = (0.0, end)
    return Panel(marks, Axis("frequency [1/h]", limits), Axis(limits=(0.0, 1.0)), "Cumulative periodogram")


def _periodogram(data: Periodogram) -> Panel:
    """Power over the period, of white innovations 1, with the 95 % band."""
    frequency, power, lower, upper = _columns(data.frequency_per_h, data.power, data.lower, data.upper)
    if len(frequency) < 2 or frequency[0] <= 0 or np.any(np.diff(frequency) <= 0):
        return Panel(title="no periodogram in fit.json")
    period = 1.0 / frequency
    limits = (max(0.02, 0.7 * float(power.min())), 1.4 * max(float(power.max()), 4.0))
    high, low = min(float(period[0]), 2000.0), float(period[-1])
    ticks = [p for p in (0.1, 0.5, 2.0, 6.0, 24.0, 168.0, 720.0) if low <= p <= high]
    return Panel(
        (
            Band(period, np.maximum(lower, 1e-3), upper, QUIET),
            CrossLine(1.0, "y"),
            Curve(period, np.maximum(power, 1e-3), MEASURED),
        ),
        Axis("period [h]", (high, low), "logarithmic", ticks, [f"{p:g}" for p in ticks]),
        Axis("", limits, "logarithmic"),
        "Periodogram (white = 1)",
    )


def _shown_inputs(found: OutputDiagnosis) -> list[tuple[str, CrossCorrelation]]:
    rows = [
        (name, one)
        for name, one in found.cross_correlation.items()
        if len(_columns(one.lag_h, one.value)[0]) > 1
    ]
    first = sorted(rows, key=lambda row: math.inf if math.isnan(row[1].p) else row[1].p)[:INPUTS]
    return [row for row in rows if row in first]


def _quantiles(e: np.ndarray) -> Panel:
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
    marks = (
        Band(x, x - reach * spread, x + reach * spread, QUIET),
        Curve(x, x, QUIET, 0.6),
        Curve(x, np.sort(e)[place], MEASURED, 0.0, marker=".", size=2.6),
    )
    return Panel(marks, Axis("standard normal [1]"), title="Quantiles of e/√S")


def _course(time: np.ndarray, value: np.ndarray) -> Panel:
    span = (float(time[0]), float(time[-1]))
    reach = min(max(4.5, 1.1 * float(np.max(np.abs(value)))), 12.0)
    return Panel(
        (
            course(time, value, span, MEASURED, 0.5, bins=200),
            *(CrossLine(level, "y", INK, 0.7, dashed=True) for level in (-3.0, 3.0)),
        ),
        Axis(limits=span, kind="time", most=5),
        Axis(limits=(-reach, reach)),
        "Course (±3 dashed)",
    )
