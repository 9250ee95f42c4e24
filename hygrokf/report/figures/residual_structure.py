"""Figures of residuals and innovations: errors of a discovery's models over the drivers, by day, and by day
and hour; and the tests of a fit's innovations.

`after`: residuals of the extended model, drawn over those of the base model. Functions raise
`drawing.NothingToShow` where their data are missing.
"""

from __future__ import annotations

import itertools
import math
import textwrap
from collections.abc import Mapping, Sequence
from statistics import NormalDist

import numpy as np

from hygrokf.data.result_file import array, instants, scalar
from hygrokf.data.timestamps import DAY_S, HOUR_S
from hygrokf.discovery.residuals import (
    RESIDUAL_QUANTITIES,
    TEMPERATURE,
    Quantity,
    Residuals,
    binned,
    displayed,
    words,
)
from hygrokf.estimation.conventions import CONFIDENCE
from hygrokf.evaluation.innovation_tests import (
    Autocorrelation,
    CrossCorrelation,
    CumulativePeriodogram,
    OutputDiagnosis,
    Periodogram,
)
from hygrokf.identification.fit_results import FitResults
from hygrokf.report.figures.drawing import INK, MEASURED, QUIET, SIMULATED_COLOUR, NothingToShow, means
from hygrokf.report.figures.panels import (
    Axis,
    Band,
    ColourScale,
    CrossLine,
    Curve,
    Map,
    Mark,
    Note,
    Panel,
    Picture,
    Shade,
    course,
    strokes,
    validation,
)
from hygrokf.report.quantities import quantity, spoken
from hygrokf.texts.wording import one_line, p_equation

EXTENDED_COLOUR = "#00796b"
"""Colour of the extended model; the base keeps that of the simulation."""
DIVERGING = ("#16365c", "#4f8fbf", "#f7f7f5", "#dd8a4a", "#8f1d14")
FEWEST_IN_BIN = 10
"""Hours that a bin needs to be drawn."""
FEWEST_SHOWN = 100
MOST_DRIVERS = 4
"""Number of drivers that are shown."""
CLASSES = 12
"""Number of classes of a driver."""


def _known(residuals: Residuals) -> list[Quantity]:
    """The quantities with enough errors in the identification period. Raises NothingToShow without any."""
    identified = {name: residuals.error[name][~residuals.validation] for name in RESIDUAL_QUANTITIES}
    quantities = [name for name in RESIDUAL_QUANTITIES if np.isfinite(identified[name]).sum() >= FEWEST_SHOWN]
    if not quantities:
        raise NothingToShow(f"Fewer than {FEWEST_SHOWN} readings can be compared with the simulation.")
    return quantities


# --- over drivers ----------------------------------------------------------------------------


def figure_drivers(residuals: Residuals, drivers: Sequence[str], after: Residuals | None) -> Picture:
    """Draw the error of the free run over drivers: medians, interquartile ranges and 10 to 90 % quantiles in
    classes with equal numbers of hours; a row for each quantity, a column for each driver.

    drivers: up to four names.
    """
    quantities = _known(residuals)
    base_hours = binned(residuals)
    extended_hours = binned(after) if after is not None else None
    chosen = [name for name in drivers if name in base_hours.drivers]
    if not chosen:
        raise NothingToShow("No driver varies enough to hold the error against it.")
    panels = []
    for quantity_name in quantities:
        error, terms = -base_hours.error[quantity_name], quantity(quantity_name)
        largest_error = 1.05 * float(np.nanquantile(np.abs(error), 0.95)) or 1.0
        for name in chosen:
            value, unit = displayed(name, base_hours.drivers[name])
            edges = _class_edges(value[np.isfinite(error)])
            marks = _bands(value, error, edges, "median" if after is None else "median, before")
            if marks and extended_hours is not None and name in extended_hours.drivers:
                extended_value, _ = displayed(name, extended_hours.drivers[name])
                medians = _medians(extended_value, -extended_hours.error[quantity_name], edges)
                marks.append(Curve(*medians, EXTENDED_COLOUR, 1.4, "after", "o", 2.4))
            short_unit = unit.replace("% of the rated power", "% of rated")
            x = Axis(textwrap.fill(f"{words(name)} [{short_unit or '1'}]", 27), most=5)
            title = terms.title if name == chosen[0] else ""
            y = Axis(terms.excess, (-largest_error, largest_error))
            panels.append(Panel(tuple(marks), x, y, title) if marks else Panel(title="too few hours"))
    return Picture(tuple(panels), height_in=0.7 + 1.7 * len(quantities), columns=len(chosen), shared="xy")


def telling_drivers(residuals: Residuals, first: Sequence[str] = ()) -> list[str]:
    """Return up to four drivers to show: those of `first`, then those over which the medians of the error
    spread most, relative to the spread of the error itself."""
    hours, quantities = binned(residuals), _known(residuals)
    rank = {}
    for name, value in hours.drivers.items():
        if name == "preheating":
            continue
        spreads = []
        for quantity_name in quantities:
            error = hours.error[quantity_name]
            _, medians = _medians(value, error, _class_edges(value[np.isfinite(error)]))
            if len(medians) > 2:
                spreads.append(float(np.nanstd(medians)) / (float(np.nanstd(error)) or 1.0))
        if spreads:
            rank[name] = max(spreads)
    best = dict.fromkeys([name for name in first if name in rank])
    best |= dict.fromkeys(sorted(rank, key=lambda name: -rank[name]))
    return [name for name in hours.drivers if name in list(best)[:MOST_DRIVERS]]


def _class_edges(driver: np.ndarray) -> np.ndarray:
    """Return the edges of `CLASSES` classes of a driver (T,) that hold equal numbers of hours."""
    known = driver[np.isfinite(driver)]
    return np.unique(np.quantile(known, np.linspace(0.0, 1.0, CLASSES + 1))) if len(known) else np.empty(0)


def _groups(value: np.ndarray, error: np.ndarray, edges: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """Return, for each class with enough hours, the median of the driver and the errors in the class."""
    result = []
    for class_number, (low, high) in enumerate(itertools.pairwise(edges)):
        below_upper_edge = value <= high if class_number == len(edges) - 2 else value < high
        in_class = np.isfinite(error) & (value >= low) & below_upper_edge
        if in_class.sum() >= FEWEST_IN_BIN:
            result.append((float(np.median(value[in_class])), error[in_class]))
    return result


def _medians(value: np.ndarray, error: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return, for each class with enough hours, the median of the driver and the median of the error."""
    rows = [(x, float(np.median(errors))) for x, errors in _groups(value, error, edges)]
    x, median = np.array(rows).reshape(-1, 2).T
    return x, median


def _bands(value: np.ndarray, error: np.ndarray, edges: np.ndarray, label: str) -> list[Mark]:
    """Medians of the error over the driver with bands of quantiles; empty if all classes have too few
    hours."""
    rows = [
        (x, *np.quantile(errors, [0.1, 0.25, 0.5, 0.75, 0.9])) for x, errors in _groups(value, error, edges)
    ]
    if not rows:
        return []
    x, q10, q25, median, q75, q90 = np.array(rows).T
    return [
        CrossLine(0.0, "y", INK, 0.7),
        Curve(x, median, SIMULATED_COLOUR, 1.4, label, "o", 2.4),
        Band(x, q25, q75, SIMULATED_COLOUR, 0.20, "25 to 75 %"),
        Band(x, q10, q90, SIMULATED_COLOUR, 0.10, "10 to 90 %"),
    ]


# --- course of the error ---------------------------------------------------------------------


def figure_error_course(before: Residuals, after: Residuals) -> Picture:
    """Draw the root mean square error of the free run on each held-out day, for the base and the extended
    model; shaded where one model is better than the other."""
    # a corrected clock can move an instant past midnight
    held_out_days = np.concatenate(
        [np.floor(model.time_s[model.validation] / DAY_S) for model in (before, after)]
    )
    if not len(held_out_days):
        raise NothingToShow("No readings were held out.")
    day = np.arange(held_out_days.min(), held_out_days.max() + 1.0)
    # a step of its own for each day, so that the areas end where the days do
    time = DAY_S * (np.repeat(day, 2) + np.tile((0.0, 1.0), len(day)))
    rms_by_quantity = {
        name: [np.repeat(_daily_rms(model, name, day), 2) for model in (before, after)]
        for name in RESIDUAL_QUANTITIES
    }
    panels = []
    for quantity_name, (base, extended) in rms_by_quantity.items():
        if not (np.isfinite(base).any() and np.isfinite(extended).any()):
            continue
        lower, higher = np.minimum(base, extended), np.maximum(base, extended)
        marks = (
            Curve(time, base, SIMULATED_COLOUR, 1.2, "base model"),
            Curve(time, extended, EXTENDED_COLOUR, 1.2, "extended model"),
            Band(
                time,
                np.where(extended < base, lower, np.nan),
                base,
                EXTENDED_COLOUR,
                0.14,
                "smaller with the cause",
            ),
            Band(time, base, np.where(extended > base, higher, np.nan), SIMULATED_COLOUR, 0.14, "larger"),
        )
        highest = 1.08 * float(np.nanmax([base, extended])) or 1.0
        x = Axis(limits=(time[0], time[-1]), kind="time")
        terms = quantity(quantity_name)
        panels.append(Panel(marks, x, Axis(f"RMS [{terms.unit}]", (0.0, highest), most=5), terms.title))
    if not panels:
        raise NothingToShow("No held-out readings can be compared with the simulations.")
    return Picture(tuple(panels), height_in=0.62 + 1.35 * len(panels), shared="x")


def _daily_rms(residuals: Residuals, name: str, days: np.ndarray) -> np.ndarray:
    """Return the root mean square (n,) of the error on the held-out days `days` (n,), counted from 1970; NaN
    for a day without a reading."""
    error = residuals.error[name]
    is_held_out = residuals.validation & np.isfinite(error)
    day = (np.floor(residuals.time_s[is_held_out] / DAY_S) - days[0]).astype(int)
    return np.sqrt(means(day, error[is_held_out] ** 2, len(days)))


# --- day and hour ----------------------------------------------------------------------------


def figure_day_hour(residuals: Residuals, name: str = TEMPERATURE, after: Residuals | None = None) -> Picture:
    """Draw the error of the free run as a map: days across, hours of the day upwards."""
    terms = quantity(name)
    if name not in _known(residuals):
        raise NothingToShow(f"There are no errors of the {terms.words} to show.")
    models = [("", residuals)] if after is None else [(", before", residuals), (", after", after)]
    errors_by_model = [_by_day(model, name) for _, model in models]
    first_day, hourly_errors = errors_by_model[0]
    largest_error = float(np.nanquantile(np.abs(hourly_errors), 0.97)) or 1.0
    scale = ColourScale(DIVERGING, terms.unit, -largest_error, largest_error)
    span = (DAY_S * first_day, DAY_S * (first_day + len(hourly_errors)))
    panels = []
    for (label, model), (start_day, errors) in zip(models, errors_by_model, strict=True):
        colours = Map(DAY_S * (start_day + np.arange(len(errors) + 1)), np.arange(25.0), errors, scale)
        panels.append(
            Panel(
                (colours, *held_out(model, span)),
                Axis(limits=span, kind="time", grid=False),
                Axis("hour [UTC]", (0.0, 24.0), at=range(0, 25, 6), grid=False),
                f"{terms.title}, simulation − reading{label}",
            )
        )
    return Picture(tuple(panels), height_in=0.5 + 1.55 * len(errors_by_model), shared="x", scale=scale)


def held_out(residuals: Residuals, span: tuple[float, float]) -> tuple[Mark, ...]:
    """Return the line at the begin of the validation period in a span of time [s]; empty without one."""
    if not residuals.validation.any():
        return ()
    return validation(float(residuals.time_s[np.argmax(residuals.validation)]), span)


def _by_day(residuals: Residuals, name: str) -> tuple[int, np.ndarray]:
    """The first day, counted from 1970, and the mean errors (days, 24); NaN for an hour without a reading."""
    error = -residuals.error[name]
    is_known = np.isfinite(error)
    hour = np.floor(residuals.time_s[is_known] / HOUR_S).astype(int)
    first_day = int(np.floor(residuals.time_s[0] / DAY_S))
    days = int(np.floor(residuals.time_s[-1] / DAY_S)) - first_day + 1
    return first_day, means(hour - 24 * first_day, error[is_known], 24 * days).reshape(days, 24)


# -- innovations ---------------------------------------------------------------------------------------------
QUANTILES = 160
"""Points of the quantile plot, evenly spread over the normal distribution's quantiles."""
MOST_INPUTS = 4
"""Inputs that are shown; of more of them those with the smallest p."""


def figure_innovations(
    fit: FitResults, series: Mapping[str, np.ndarray], output: str = "temperature"
) -> Picture:
    """Draw tests of the standardised innovations [1] of one output, "temperature" or "humidity"."""
    diagnosis = fit.innovations.outputs.get(output)
    time = instants(series)
    all_innovations = array(series, f"{output}_innovation")
    until_s = scalar(series, "until_s")
    is_known = np.isfinite(all_innovations) & (time <= until_s if math.isfinite(until_s) else True)
    if diagnosis is None or not is_known.any():
        raise NothingToShow(
            f"There are no innovations of the {output}: the filter observed none of its readings."
        )
    if diagnosis.autocorrelation is None:
        raise NothingToShow(f"No diagnosis: {diagnosis.remark or 'too few readings'}.")
    shown_inputs = _shown_inputs(diagnosis)
    height = max((_reach(correlation) for _, correlation in shown_inputs), default=0.0)
    innovations = all_innovations[is_known]
    panels = (
        _correlation(diagnosis.autocorrelation, _reach(diagnosis.autocorrelation), "Autocorrelation"),
        _cumulative(diagnosis.cumulative_periodogram or CumulativePeriodogram()),
        _periodogram(diagnosis.periodogram or Periodogram()),
        _quantiles(innovations),
        _course(time[is_known], innovations),
        *(
            _correlation(correlation, height, f"Correlation with {spoken(one_line(name))}")
            for name, correlation in shown_inputs
        ),
        *([] if shown_inputs else [Panel(title="no input varies, or none is known: no cross-correlation")]),
    )
    return Picture(panels, height_in=1.6 * -(-len(panels) // 3), columns=3)


def _columns(*lists: tuple[float, ...]) -> list[np.ndarray]:
    """Lists of equal length as arrays of the rows in which all are finite; else empty arrays."""
    if len({len(values) for values in lists}) != 1:
        return [np.empty(0) for _ in lists]
    rows = np.array(lists, dtype=float)
    return list(rows[:, np.isfinite(rows).all(axis=0)])


def _stems(lag: np.ndarray, value: np.ndarray, limit: float) -> list[Mark]:
    """Return a vertical line for each lag from 0 to its correlation; beyond the limit [1] in red."""
    is_beyond = np.abs(value) > limit
    return [
        strokes(lag[chosen], np.zeros(chosen.sum()), lag[chosen], value[chosen], colour, width)
        for chosen, colour, width in ((~is_beyond, MEASURED, 0.7), (is_beyond, SIMULATED_COLOUR, 1.3))
    ]


def _reach(data: Autocorrelation | CrossCorrelation) -> float:
    """Return the height [1] of a panel on which a correlation and its limits can be seen."""
    largest = float(np.abs(_columns(data.lag_h, data.value)[1]).max(initial=0.0))
    limit = data.limit_all if data.limit_all > 0 else 0.0
    return min(max(1.9 * limit, 1.15 * largest, 0.02), 1.02)


def _correlation(data: Autocorrelation | CrossCorrelation, height: float, title: str) -> Panel:
    """Return the panel of a correlation over the lag [h]: shaded its limit for a single lag, dashed its limit
    for all lags together."""
    lag, value = _columns(data.lag_h, data.value)
    is_cross = isinstance(data, CrossCorrelation)
    if len(lag) < 2 or not lag[-1] > 0:
        return Panel(title="no autocorrelation in fit.json")
    marks: list[Mark] = [CrossLine(0.0, "y")]
    if math.isfinite(data.limit):
        marks.append(Shade(-data.limit, data.limit, QUIET, 0.16, "", "y"))
    limit_of_all = data.limit_all if math.isfinite(data.limit_all) else 0.0
    marks += [CrossLine(sign * limit_of_all, "y", INK, 0.7, True) for sign in (-1.0, 1.0) if limit_of_all]
    if is_cross:
        marks.append(CrossLine(0.0, "x"))
        x = _hours("lag [h], > 0: later", float(lag[0]), float(lag[-1]), 5.0)
    else:
        x = _hours("lag [h]", 0.0, float(lag[-1]))
    y = Axis(limits=(-height, height), most=5)
    return Panel((*marks, *_stems(lag, value, limit_of_all)), x, y, title, plain=is_cross)


def _hours(label: str, low: float, high: float, ticks: float = 8.5) -> Axis:
    """Return an axis of lags [h] with ticks at hours, parts of a day, or days."""
    step = next((step_h for step_h in (1.0, 3.0, 6.0, 12.0, 24.0) if (high - low) / step_h <= ticks), 0.0)
    positions: tuple[float, ...] = ()
    if step and (high - low) / step >= 2:
        positions = tuple(step * np.arange(math.ceil(low / step), math.floor(high / step) + 1))
    return Axis(label, (1.02 * low, 1.02 * high), at=positions)


def _cumulative(data: CumulativePeriodogram) -> Panel:
    """Return the panel of the cumulative periodogram, with its band for white noise."""
    frequency, value = _columns(data.frequency_per_h, data.value)
    if len(frequency) < 2 or not frequency[-1] > 0:
        return Panel(title="no cumulative periodogram in fit.json")
    end = float(frequency[-1])
    diagonal = np.array([0.0, end])
    p_text = p_equation(data.p)
    marks = (
        Band(diagonal, diagonal / end - data.limit, diagonal / end + data.limit, QUIET),
        Curve(diagonal, diagonal / end, QUIET, 0.6),
        Curve(frequency, value, SIMULATED_COLOUR if data.statistic > data.limit else MEASURED, 1.2),
        Note(f"Kolmogorov–Smirnov\n{p_text}", 0.03, 0.98, INK, "left", "top", "xy"),
    )
    limits = (0.0, end)
    return Panel(marks, Axis("frequency [1/h]", limits), Axis(limits=(0.0, 1.0)), "Cumulative periodogram")


def _periodogram(data: Periodogram) -> Panel:
    """The panel of the power over the period [h] with its 95 % band; white innovations have power 1."""
    frequency, power, lower, upper = _columns(data.frequency_per_h, data.power, data.lower, data.upper)
    if len(frequency) < 2 or frequency[0] <= 0 or np.any(np.diff(frequency) <= 0):
        return Panel(title="no periodogram in fit.json")
    period = 1.0 / frequency
    limits = (max(0.02, 0.7 * float(power.min())), 1.4 * max(float(power.max()), 4.0))
    longest_h, shortest_h = min(float(period[0]), 2000.0), float(period[-1])
    ticks = [
        tick_h for tick_h in (0.1, 0.5, 2.0, 6.0, 24.0, 168.0, 720.0) if shortest_h <= tick_h <= longest_h
    ]
    return Panel(
        (
            Band(period, np.maximum(lower, 1e-3), upper, QUIET),
            CrossLine(1.0, "y"),
            Curve(period, np.maximum(power, 1e-3), MEASURED),
        ),
        Axis(
            "period [h]", (longest_h, shortest_h), "logarithmic", ticks, [f"{tick_h:g}" for tick_h in ticks]
        ),
        Axis("", limits, "logarithmic"),
        "Periodogram (white = 1)",
    )


def _shown_inputs(diagnosis: OutputDiagnosis) -> list[tuple[str, CrossCorrelation]]:
    """The `MOST_INPUTS` inputs whose correlation with the innovations has the smallest p, in their order."""
    pairs = [
        (name, correlation)
        for name, correlation in diagnosis.cross_correlation.items()
        if len(_columns(correlation.lag_h, correlation.value)[0]) > 1
    ]
    most_significant = sorted(pairs, key=lambda pair: math.inf if math.isnan(pair[1].p) else pair[1].p)[
        :MOST_INPUTS
    ]
    return [pair for pair in pairs if pair in most_significant]


def _quantiles(innovations: np.ndarray) -> Panel:
    """The panel of the innovations' quantiles over those of the normal distribution, with a 95 % band."""
    count = len(innovations)
    normal = NormalDist()
    largest_quantile = normal.inv_cdf((count - 0.5) / count) if count > 1 else 0.0
    wanted = np.linspace(-largest_quantile, largest_quantile, QUANTILES)
    ranks = np.unique(
        np.clip([math.floor(count * normal.cdf(quantile)) for quantile in wanted], 0, count - 1)
    )
    probability = (ranks + 0.5) / count
    x = np.array([normal.inv_cdf(float(probability_of_rank)) for probability_of_rank in probability])
    # standard error of an order statistic: √(p(1−p)/n) over the density
    standard_error = np.sqrt(probability * (1 - probability) / count) / (
        np.exp(-0.5 * x**2) / math.sqrt(2.0 * math.pi)
    )
    reach_sd = normal.inv_cdf(0.5 + 0.5 * CONFIDENCE)
    marks = (
        Band(x, x - reach_sd * standard_error, x + reach_sd * standard_error, QUIET),
        Curve(x, x, QUIET, 0.6),
        Curve(x, np.sort(innovations)[ranks], MEASURED, 0.0, marker=".", size=2.6),
    )
    return Panel(marks, Axis("standard normal [1]"), title="Quantiles of e/√S")


def _course(time: np.ndarray, value: np.ndarray) -> Panel:
    """Return the panel of the innovations over time, with dashed lines at ±3."""
    span = (float(time[0]), float(time[-1]))
    height = min(max(4.5, 1.1 * float(np.max(np.abs(value)))), 12.0)
    return Panel(
        (
            course(time, value, span, MEASURED, 0.5, bins=200),
            *(CrossLine(level, "y", INK, 0.7, dashed=True) for level in (-3.0, 3.0)),
        ),
        Axis(limits=span, kind="time", most=5),
        Axis(limits=(-height, height)),
        "Course (±3 dashed)",
    )
