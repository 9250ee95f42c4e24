"""Figures of residuals over drivers, by day, and by day and hour.

Functions take `Residuals`, and those of an extended model as `after` for an overlay, and return a figure.
They raise `drawing.NothingToShow` with one sentence where their data are missing.
"""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Sequence

import numpy as np

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
from hygrokf.report.figures.drawing import INK, SIMULATED_COLOUR, NothingToShow, means
from hygrokf.report.figures.panels import (
    Axis,
    Band,
    ColourScale,
    CrossLine,
    Curve,
    Map,
    Mark,
    Panel,
    Picture,
    validation,
)
from hygrokf.report.quantities import quantity

EXTENDED_COLOUR = "#00796b"
"""Colour of the extended model; the base keeps that of the simulation."""
DIVERGING = ("#16365c", "#4f8fbf", "#f7f7f5", "#dd8a4a", "#8f1d14")
FEWEST_IN_BIN = 10
"""Hours that a bin needs to be drawn."""
FEWEST_SHOWN = 100
MOST_DRIVERS = 4


def _known(residuals: Residuals) -> list[Quantity]:
    early = ~residuals.validation
    found = [q for q in RESIDUAL_QUANTITIES if np.isfinite(residuals.error[q][early]).sum() >= FEWEST_SHOWN]
    if not found:
        raise NothingToShow(f"Fewer than {FEWEST_SHOWN} readings can be compared with the simulation.")
    return found


# --- over drivers ----------------------------------------------------------------------------


def figure_drivers(residuals: Residuals, drivers: Sequence[str], after: Residuals | None) -> Picture:
    """Error of the free run against drivers: medians, interquartile ranges and 10 to 90 % quantiles of
    the hours in equal shares; a row for each quantity, a column for each driver.

    drivers: up to four names.
    """
    quantities = _known(residuals)
    early = binned(residuals)
    late = binned(after) if after is not None else None
    chosen = [name for name in drivers if name in early.drivers]
    if not chosen:
        raise NothingToShow("No driver varies enough to hold the error against it.")
    panels = []
    for one in quantities:
        error, terms = -early.error[one], quantity(one)
        reach = 1.05 * float(np.nanquantile(np.abs(error), 0.95)) or 1.0
        for name in chosen:
            value, unit = displayed(name, early.drivers[name])
            edges = _shares(value[np.isfinite(error)])
            marks = _bands(value, error, edges, "median" if after is None else "median, before")
            if marks and late is not None and name in late.drivers:
                other, _ = displayed(name, late.drivers[name])
                line = _medians(other, -late.error[one], edges)
                marks.append(Curve(*line, EXTENDED_COLOUR, 1.4, "after", "o", 2.4))
            short = unit.replace("% of the rated power", "% of rated")
            x = Axis(textwrap.fill(f"{words(name)} [{short or '1'}]", 27), most=5)
            title = terms.title if name == chosen[0] else ""
            y = Axis(terms.excess, (-reach, reach))
            panels.append(Panel(tuple(marks), x, y, title) if marks else Panel(title="too few hours"))
    return Picture(tuple(panels), height_in=0.7 + 1.7 * len(quantities), columns=len(chosen), shared="xy")


def telling_drivers(residuals: Residuals, first: Sequence[str] = ()) -> list[str]:
    """Up to four drivers: those named first, then those along which the medians spread most, in units of the
    error's own spread."""
    hours, quantities = binned(residuals), _known(residuals)
    rank = {}
    for name, value in hours.drivers.items():
        if name == "preheating":
            continue
        spreads = []
        for quantity_name in quantities:
            error = hours.error[quantity_name]
            _, middle = _medians(value, error, _shares(value[np.isfinite(error)]))
            if len(middle) > 2:
                spreads.append(float(np.nanstd(middle)) / (float(np.nanstd(error)) or 1.0))
        if spreads:
            rank[name] = max(spreads)
    best = dict.fromkeys([name for name in first if name in rank])
    best |= dict.fromkeys(sorted(rank, key=lambda name: -rank[name]))
    return [name for name in hours.drivers if name in list(best)[:MOST_DRIVERS]]


def _shares(value: np.ndarray, count: int = 12) -> np.ndarray:
    known = value[np.isfinite(value)]
    return np.unique(np.quantile(known, np.linspace(0.0, 1.0, count + 1))) if len(known) else np.empty(0)


def _groups(value: np.ndarray, error: np.ndarray, edges: np.ndarray) -> list[tuple[float, np.ndarray]]:
    """Median of the driver and the errors in each share with enough hours."""
    result = []
    for place, (low, high) in enumerate(itertools.pairwise(edges)):
        top = value <= high if place == len(edges) - 2 else value < high
        part = np.isfinite(error) & (value >= low) & top
        if part.sum() >= FEWEST_IN_BIN:
            result.append((float(np.median(value[part])), error[part]))
    return result


def _medians(value: np.ndarray, error: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    rows = [(x, float(np.median(part))) for x, part in _groups(value, error, edges)]
    x, median = np.array(rows).reshape(-1, 2).T
    return x, median


def _bands(value: np.ndarray, error: np.ndarray, edges: np.ndarray, label: str) -> list[Mark]:
    rows = [(x, *np.quantile(part, [0.1, 0.25, 0.5, 0.75, 0.9])) for x, part in _groups(value, error, edges)]
    if not rows:
        return []
    x, least, low, middle, high, most = np.array(rows).T
    return [
        CrossLine(0.0, "y", INK, 0.7),
        Curve(x, middle, SIMULATED_COLOUR, 1.4, label, "o", 2.4),
        Band(x, low, high, SIMULATED_COLOUR, 0.20, "25 to 75 %"),
        Band(x, least, most, SIMULATED_COLOUR, 0.10, "10 to 90 %"),
    ]


# --- course of the error ---------------------------------------------------------------------


def figure_error_course(before: Residuals, after: Residuals) -> Picture:
    """Root mean square of the free run's error on each held-out day, of the base and of the extended model,
    by quantity; shaded where one lies below the other."""
    # a corrected clock can move an instant past midnight
    numbers = np.concatenate([np.floor(one.time_s[one.validation] / DAY_S) for one in (before, after)])
    if not len(numbers):
        raise NothingToShow("No readings were held out.")
    day = np.arange(numbers.min(), numbers.max() + 1.0)
    # a step of its own for each day, so that the areas end where the days do
    time = DAY_S * (np.repeat(day, 2) + np.tile((0.0, 1.0), len(day)))
    every = {
        q: [np.repeat(_daily_rms(one, q, day), 2) for one in (before, after)] for q in RESIDUAL_QUANTITIES
    }
    panels = []
    for one, (base, extended) in every.items():
        if not (np.isfinite(base).any() and np.isfinite(extended).any()):
            continue
        better, worse = np.minimum(base, extended), np.maximum(base, extended)
        marks = (
            Curve(time, base, SIMULATED_COLOUR, 1.2, "base model"),
            Curve(time, extended, EXTENDED_COLOUR, 1.2, "extended model"),
            Band(
                time,
                np.where(extended < base, better, np.nan),
                base,
                EXTENDED_COLOUR,
                0.14,
                "smaller with the cause",
            ),
            Band(time, base, np.where(extended > base, worse, np.nan), SIMULATED_COLOUR, 0.14, "larger"),
        )
        top = 1.08 * float(np.nanmax([base, extended])) or 1.0
        x = Axis(limits=(time[0], time[-1]), kind="time")
        terms = quantity(one)
        panels.append(Panel(marks, x, Axis(f"RMS [{terms.unit}]", (0.0, top), most=5), terms.title))
    if not panels:
        raise NothingToShow("No held-out readings can be compared with the simulations.")
    return Picture(tuple(panels), height_in=0.62 + 1.35 * len(panels), shared="x")


def _daily_rms(residuals: Residuals, name: str, days: np.ndarray) -> np.ndarray:
    """Root mean square (n,) of the error on held-out days (n,) since 1970; NaN on those without a reading."""
    error = residuals.error[name]
    chosen = residuals.validation & np.isfinite(error)
    place = (np.floor(residuals.time_s[chosen] / DAY_S) - days[0]).astype(int)
    return np.sqrt(means(place, error[chosen] ** 2, len(days)))


# --- day and hour ----------------------------------------------------------------------------


def figure_day_hour(residuals: Residuals, name: str = TEMPERATURE, after: Residuals | None = None) -> Picture:
    """Error of the free run by day (across) and hour of the day (up), over identification and validation."""
    terms = quantity(name)
    if name not in _known(residuals):
        raise NothingToShow(f"There are no errors of the {terms.words} to show.")
    models = [("", residuals)] if after is None else [(", before", residuals), (", after", after)]
    maps = [_by_day(one, name) for _, one in models]
    first, table = maps[0]
    reach = float(np.nanquantile(np.abs(table), 0.97)) or 1.0
    scale = ColourScale(DIVERGING, terms.unit, -reach, reach)
    span = (DAY_S * first, DAY_S * (first + len(table)))
    panels = []
    for (label, one), (day, values) in zip(models, maps, strict=True):
        shown = Map(DAY_S * (day + np.arange(len(values) + 1)), np.arange(25.0), values, scale)
        panels.append(
            Panel(
                (shown, *held_out(one, span)),
                Axis(limits=span, kind="time", grid=False),
                Axis("hour [UTC]", (0.0, 24.0), at=range(0, 25, 6), grid=False),
                f"{terms.title}, simulation − reading{label}",
            )
        )
    return Picture(tuple(panels), height_in=0.5 + 1.55 * len(maps), shared="x", scale=scale)


def held_out(residuals: Residuals, span: tuple[float, float]) -> tuple[Mark, ...]:
    """Where the validation period begins in a stretch of time [s]."""
    if not residuals.validation.any():
        return ()
    return validation(float(residuals.time_s[np.argmax(residuals.validation)]), span)


def _by_day(residuals: Residuals, name: str) -> tuple[int, np.ndarray]:
    """Number of the first day since 1970 and mean errors (days, 24), NaN without a reading."""
    error = -residuals.error[name]
    there = np.isfinite(error)
    hour = np.floor(residuals.time_s[there] / HOUR_S).astype(int)
    first = int(np.floor(residuals.time_s[0] / DAY_S))
    count = int(np.floor(residuals.time_s[-1] / DAY_S)) - first + 1
    return first, means(hour - 24 * first, error[there], 24 * count).reshape(count, 24)
