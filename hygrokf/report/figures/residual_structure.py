"""Figures of residuals over drivers and by day and hour, and of the innovations' spectrum and correlations.

Functions take `Residuals`, and those of an extended model as `after` for an overlay, and return a figure.
They raise `drawing.NothingToShow` with one sentence where their data are missing.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.data.timestamps import DAY_S, HOUR_S
from hygrokf.discovery.residuals import (
    HUMIDITY,
    QUANTITIES,
    TEMPERATURE,
    UNITS,
    Hours,
    Residuals,
    displayed,
    hourly,
    words,
)
from hygrokf.evaluation.diagnosis import CrossCorrelation, OutputDiagnosis, Periodogram
from hygrokf.evaluation.innovation_tests import diagnose
from hygrokf.report.figures.drawing import (
    INK,
    QUIET,
    SIMULATED,
    NothingToShow,
    area_handle,
    calendar,
    calendar_ticks,
    days,
    empty,
    figure_key,
    line_handle,
    logarithmic,
    new_figure,
    styled,
    upright,
)
from hygrokf.report.figures.panels import Panels

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

AFTER = "#00796b"
"""Colour of the extended model; the base keeps that of the simulation."""
DIVERGING = ("#16365c", "#4f8fbf", "#f7f7f5", "#dd8a4a", "#8f1d14")
TITLE = {TEMPERATURE: "Temperature", HUMIDITY: "Absolute humidity"}
FEWEST_IN_BIN = 10
"""Hours that a bin needs to be drawn."""
FEWEST_READINGS = 100
DRIVERS = 4
LONGEST_LAG_H = 24.0


def error_label(quantity: str) -> str:
    """Label of an error axis, the sign as in all statements: above zero the simulation is too high."""
    return f"simulation − reading [{UNITS[quantity]}]"


def _known(residuals: Residuals, innovations: bool = False) -> list[str]:
    take = residuals.innovation if innovations else residuals.error
    early = ~residuals.validation
    found = [q for q in QUANTITIES if np.isfinite(take(q)[early]).sum() >= FEWEST_READINGS]
    if not found:
        raise NothingToShow(f"Fewer than {FEWEST_READINGS} readings can be compared with the simulation.")
    return found


# --- over drivers ----------------------------------------------------------------------------


def figure_drivers(
    residuals: Residuals, drivers: Sequence[str] = (), after: Residuals | None = None
) -> Figure:
    """Error of the free run against drivers: medians, middle half and middle 80 % of the hours in equal
    shares.

    drivers: up to four names; without any, those along which the medians move most.
    """
    with styled():
        panels = driver_panels(residuals, drivers, after)
        height = panels.height_in
        figure = new_figure(height)
        grid = figure.add_gridspec(
            panels.rows, panels.columns, hspace=0.25, wspace=0.08, left=0.078, right=0.995,
            top=1.0 - 0.42 / height,
            bottom=0.46 / height,
        )  # fmt: skip
        for place, draw in enumerate(panels.draw):
            row, column = divmod(place, panels.columns)
            axes = figure.add_subplot(grid[row, column])
            draw(axes)
            axes.xaxis.label.set_fontsize(6.8)
            if row < panels.rows - 1:
                axes.tick_params(labelbottom=False)
                axes.set_xlabel("")
            if column:
                axes.tick_params(labelleft=False)
                axes.set_ylabel("")
            else:
                upright(axes, axes.get_ylabel())
        figure_key(figure, _band_handles(after is not None))
    return figure


DRIVERS_HEADING = "Error against what drives the cabinet"


def drivers_caption(overlaid: bool) -> str:
    """What to look for in `figure_drivers`; `overlaid`: with the extended model."""
    bend = (
        "; where the red medians bend and the green ones stay flat, the cause explains the bend. Where only "
        "green shows, both are alike."
        if overlaid
        else "; a bend shows what the model lacks."
    )
    return f"Medians should lie on zero along every driver{bend}"


def driver_panels(
    residuals: Residuals, drivers: Sequence[str] = (), after: Residuals | None = None
) -> Panels:
    """The panels of `figure_drivers`: a row for each quantity, a column for each driver."""
    quantities = _known(residuals)
    early = hourly(residuals)
    late = hourly(after) if after is not None else None
    chosen = [name for name in drivers if name in early.drivers] or _telling(early, quantities)
    chosen = chosen[:DRIVERS]
    if not chosen:
        raise NothingToShow("No driver varies enough to hold the error against it.")
    from matplotlib import rcParams

    def draw(axes: Axes, quantity: str, name: str) -> None:
        error = -early.error[quantity]
        reach = 1.05 * float(np.nanquantile(np.abs(error), 0.95)) or 1.0
        axes.axhline(0.0, color=INK, linewidth=0.7)
        value, unit = displayed(name, early.drivers[name])
        edges = _shares(value[np.isfinite(error)])
        _bands(axes, value, error, edges)
        if late is not None and name in late.drivers:
            other, _ = displayed(name, late.drivers[name])
            x, middle = _medians(other, -late.error[quantity], edges)
            axes.plot(x, middle, color=AFTER, linewidth=1.4, marker="o", markersize=2.4)
        axes.set_ylim(-reach, reach)
        axes.locator_params(axis="x", nbins=5)
        short = unit.replace("% of the rated power", "% of rated")
        axes.set_xlabel(_two_lines(f"{words(name)} [{short or '1'}]"), fontsize=rcParams["xtick.labelsize"])
        axes.set_ylabel(error_label(quantity))
        if name == chosen[0]:
            axes.set_title(TITLE[quantity])

    return Panels(
        tuple(partial(draw, quantity=quantity, name=name) for quantity in quantities for name in chosen),
        height_in=0.7 + 1.7 * len(quantities),
        columns=len(chosen),
        shared="xy",
        handles=partial(_band_handles, after is not None),
    )


def telling_drivers(residuals: Residuals, first: Sequence[str] = ()) -> list[str]:
    """Up to four drivers: those named first, then those along which the medians spread most, in units of the
    error's own spread."""
    hours = hourly(residuals)
    return _telling(hours, _known(residuals), first)


def _telling(hours: Hours, quantities: Sequence[str], first: Sequence[str] = ()) -> list[str]:
    rank = {}
    for name, value in hours.drivers.items():
        if name == "preheating":
            continue
        spreads = []
        for quantity in quantities:
            error = hours.error[quantity]
            _, middle = _medians(value, error, _shares(value[np.isfinite(error)]))
            if len(middle) > 2:
                spreads.append(float(np.nanstd(middle)) / (float(np.nanstd(error)) or 1.0))
        if spreads:
            rank[name] = max(spreads)
    best = dict.fromkeys([name for name in first if name in rank])
    best |= dict.fromkeys(sorted(rank, key=lambda name: -rank[name]))
    return [name for name in hours.drivers if name in list(best)[:DRIVERS]]


def _two_lines(text: str, width: int = 27) -> str:
    import textwrap

    return "\n".join(textwrap.wrap(text, width))


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


def _bands(axes: Axes, value: np.ndarray, error: np.ndarray, edges: np.ndarray) -> None:
    rows = [(x, *np.quantile(part, [0.1, 0.25, 0.5, 0.75, 0.9])) for x, part in _groups(value, error, edges)]
    if not rows:
        empty(axes, "too few hours")
        return
    x, least, low, middle, high, most = np.array(rows).T
    axes.fill_between(x, least, most, color=SIMULATED, alpha=0.10, linewidth=0)
    axes.fill_between(x, low, high, color=SIMULATED, alpha=0.20, linewidth=0)
    axes.plot(x, middle, color=SIMULATED, linewidth=1.4, marker="o", markersize=2.4)


def _band_handles(overlaid: bool) -> list[Artist]:
    before = "median" + (", before" if overlaid else "")
    handles = [
        line_handle(SIMULATED, before, 1.4, marker="o", markersize=2.4),
        area_handle(SIMULATED, "middle half", 0.30),
        area_handle(SIMULATED, "middle 80 %", 0.10),
    ]
    if overlaid:
        handles.insert(1, line_handle(AFTER, "after", 1.4, marker="o", markersize=2.4))
    return handles


# --- course of the error ---------------------------------------------------------------------


def figure_error_course(before: Residuals, after: Residuals) -> Figure:
    """Root mean square of the free run's error on each held-out day, of the base and of the extended model,
    by quantity; shaded where one lies below the other."""
    # a corrected clock can move an instant past midnight
    numbers = np.concatenate([np.floor(one.time_s[one.validation] / DAY_S) for one in (before, after)])
    if not len(numbers):
        raise NothingToShow("No readings were held out.")
    day = np.arange(numbers.min(), numbers.max() + 1.0)
    every = {q: [_daily_rms(one, q, day) for one in (before, after)] for q in QUANTITIES}
    courses = {q: pair for q, pair in every.items() if all(np.isfinite(one).any() for one in pair)}
    if not courses:
        raise NothingToShow("No held-out readings can be compared with the simulations.")
    with styled():
        height = 0.62 + 1.35 * len(courses)
        figure = new_figure(height)
        grid = figure.add_gridspec(
            len(courses), 1, hspace=0.32, left=0.072, right=0.995, top=1.0 - 0.26 / height,
            bottom=0.36 / height,
        )  # fmt: skip
        for row, (quantity, (base, extended)) in enumerate(courses.items()):
            axes = figure.add_subplot(grid[row])
            for better, colour in ((extended < base, AFTER), (extended > base, SIMULATED)):
                # a step of its own for each day, so that the areas end where the days do
                axes.fill_between(
                    np.repeat(day, 2) + np.tile((0.0, 1.0), len(day)), np.repeat(base, 2),
                    np.repeat(extended, 2), where=np.repeat(better, 2), color=colour, alpha=0.14, linewidth=0,
                )  # fmt: skip
            for value, colour in ((base, SIMULATED), (extended, AFTER)):
                axes.stairs(value, np.append(day, day[-1] + 1.0), baseline=None, color=colour, linewidth=1.2)
            axes.set_ylim(0.0, 1.08 * float(np.nanmax([base, extended])) or 1.0)
            axes.locator_params(axis="y", nbins=5)
            calendar(axes, (DAY_S * day[0], DAY_S * (day[-1] + 1.0)), 12, labels=row == len(courses) - 1)
            upright(axes, f"RMS [{UNITS[quantity]}]")
            axes.set_title(TITLE[quantity])
        handles = (
            line_handle(SIMULATED, "base model"),
            line_handle(AFTER, "extended model"),
            area_handle(AFTER, "smaller with the cause", 0.2),
            area_handle(SIMULATED, "larger", 0.2),
        )
        figure_key(figure, handles)
    return figure


def _daily_rms(residuals: Residuals, quantity: str, days: np.ndarray) -> np.ndarray:
    """Root mean square (n,) of the error on held-out days (n,) since 1970; NaN on those without a reading."""
    error = residuals.error(quantity)
    chosen = residuals.validation & np.isfinite(error)
    place = (np.floor(residuals.time_s[chosen] / DAY_S) - days[0]).astype(int)
    number = np.bincount(place, minlength=len(days))
    total = np.bincount(place, weights=error[chosen] ** 2, minlength=len(days))
    return np.sqrt(np.divide(total, number, out=np.full(len(days), np.nan), where=number > 0))


# --- day and hour ----------------------------------------------------------------------------


def figure_day_hour(
    residuals: Residuals, quantity: str = TEMPERATURE, after: Residuals | None = None
) -> Figure:
    """Error of the free run by day (across) and hour of the day (up), over identification and validation."""
    from matplotlib.colors import LinearSegmentedColormap

    if quantity not in _known(residuals):
        raise NothingToShow(f"There are no errors of the {TITLE[quantity].lower()} to show.")
    models = [("", residuals)] if after is None else [("before", residuals), ("after", after)]
    maps = [_by_day(one, quantity) for _, one in models]
    reach = float(np.nanquantile(np.abs(maps[0][1]), 0.97)) or 1.0
    with styled():
        height = 0.5 + 1.55 * len(maps)
        figure = new_figure(height)
        grid = figure.add_gridspec(
            len(maps), 1, hspace=0.16, left=0.072, right=0.915, top=1.0 - 0.22 / height, bottom=0.31 / height
        )
        colours = LinearSegmentedColormap.from_list("error", DIVERGING).with_extremes(bad="#e3e6ea")
        for row, ((label, one), (first, table)) in enumerate(zip(models, maps, strict=True)):
            axes = figure.add_subplot(grid[row])
            axes.grid(False)
            image = axes.imshow(
                table.T, origin="lower", aspect="auto", cmap=colours, vmin=-reach, vmax=reach,
                interpolation="nearest",
                extent=(first, first + len(table), 0.0, 24.0),
            )  # fmt: skip
            axes.set_yticks(np.arange(0, 25, 6))
            upright(axes, "hour [UTC]")
            at, names = calendar_ticks(DAY_S * first, DAY_S * (first + len(table)), 12)
            last = row == len(maps) - 1
            axes.set_xticks(days(at), names if last else None)
            axes.tick_params(labelbottom=last)
            axes.set_xlim(maps[0][0], maps[0][0] + len(maps[0][1]))
            held_out(axes, one, 23.3)
            axes.set_title(TITLE[quantity] + (f", {label}" if label else ""))
        bar = figure.add_axes((0.93, 0.31 / height, 0.013, 1.0 - 0.72 / height))
        figure.colorbar(image, cax=bar, extend="both", extendfrac=0.03)
        bar.set_title(UNITS[quantity], fontsize=7.0, fontweight="normal", loc="left", pad=10)
        bar.tick_params(labelsize=6.5, length=2)
        bar.locator_params(axis="y", nbins=7)
        figure.text(
            0.915, 1.0 - 0.05 / height, "simulation − reading: blue too low, red too high", ha="right",
            va="top", fontsize=7.0,
            color=QUIET,
        )  # fmt: skip
    return figure


def held_out(axes: Axes, residuals: Residuals, height: float) -> None:
    """Where the validation period begins, on an axis of days; its name hangs at `height` of the other
    axis."""
    if not residuals.validation.any():
        return
    start = float(days(residuals.time_s[np.argmax(residuals.validation)]))
    axes.axvline(start, color=INK, linewidth=0.9, dashes=(4, 2))
    axes.text(
        start, height, " validation", fontsize=6.5, color=INK, fontstyle="italic", va="top",
        bbox={"facecolor": "white", "alpha": 0.8, "pad": 0.8, "linewidth": 0},
    )  # fmt: skip


def _by_day(residuals: Residuals, quantity: str) -> tuple[int, np.ndarray]:
    """Number of the first day since 1970 and mean errors (days, 24), NaN without a reading."""
    error = -residuals.error(quantity)
    there = np.isfinite(error)
    hour = np.floor(residuals.time_s[there] / HOUR_S).astype(int)
    first = int(np.floor(residuals.time_s[0] / DAY_S))
    count = int(np.floor(residuals.time_s[-1] / DAY_S)) - first + 1
    number = np.bincount(hour - 24 * first, minlength=24 * count).astype(float)
    total = np.bincount(hour - 24 * first, weights=error[there], minlength=24 * count)
    mean = np.divide(total, number, out=np.full(24 * count, np.nan), where=number > 0)
    return first, mean.reshape(count, 24)


# --- innovations -----------------------------------------------------------------------------


def figure_innovations(
    residuals: Residuals, after: Residuals | None = None, drivers: Sequence[str] = ()
) -> Figure:
    """Periodogram of the standardised innovations and their cross-correlations with drivers, by quantity.

    drivers: up to three names; without any, those with the largest cross-correlations before.
    """
    quantities = _known(residuals, innovations=True)
    found = _diagnosed(residuals)
    later = _diagnosed(after) if after is not None else {}
    with styled():
        height = 0.75 + 1.65 * len(quantities)
        figure = new_figure(height)
        grid = figure.add_gridspec(
            len(quantities), 5, hspace=0.48, wspace=0.12, left=0.055, right=0.985, top=1.0 - 0.52 / height,
            bottom=0.36 / height, width_ratios=(1.25, 0.12, 1.0, 1.0, 1.0),
        )  # fmt: skip
        for row, quantity in enumerate(quantities):
            base, wider = (one.get(quantity, OutputDiagnosis()) for one in (found, later))
            last = row == len(quantities) - 1
            axes = figure.add_subplot(grid[row, 0])
            _periodogram(axes, base.periodogram, wider.periodogram)
            axes.set_title(TITLE[quantity])
            if last:
                axes.set_xlabel("power (white = 1) by period [h]")
            rows = {name: one for name, one in base.cross_correlation.items() if one.lag_h}
            ranked = sorted(rows, key=lambda name: rows[name].p)
            best = [name for name in drivers if name in rows] or ranked
            reach = max((_size(rows[name]) for name in best[:3]), default=0.1)
            for column, name in enumerate(best[:3]):
                axes = figure.add_subplot(grid[row, column + 2])
                _correlation(axes, rows[name], wider.cross_correlation.get(name), reach)
                axes.set_title(_two_lines(f"with {words(name)}", 26), fontweight="normal", fontsize=7.0)
                if last:
                    axes.set_xlabel("lag [h]; > 0: after the driver" if column == 0 else "lag [h]")
                if column:
                    axes.tick_params(labelleft=False)
        _line_key(figure, after is not None)
    return figure


def _diagnosed(residuals: Residuals) -> Mapping[str, OutputDiagnosis]:
    """`diagnose` of the identification period's innovations, by quantity."""
    early = ~residuals.validation
    innovations = {q: residuals.innovation(q)[early] for q in QUANTITIES}
    inputs = {name: value[early] for name, value in residuals.drivers.items()}
    known, varying = (
        {name: value for name, value in one.items() if np.isfinite(value).any()}
        for one in (innovations, inputs)
    )
    return diagnose(residuals.time_h[early], known, varying, longest_h=LONGEST_LAG_H).outputs


def _periodogram(axes: Axes, base: Periodogram | None, wider: Periodogram | None) -> None:
    if base is None:
        return empty(axes, "too few innovations for a periodogram")
    period = 1.0 / np.array(base.frequency_per_h)
    axes.fill_between(period, np.maximum(base.lower, 1e-3), base.upper, color=QUIET, alpha=0.16, linewidth=0)
    axes.axhline(1.0, color=QUIET, linewidth=0.6)
    top, least = 4.0, 1.0
    for one, colour in ((base, SIMULATED), (wider, AFTER)):
        if one is not None:
            power = np.array(one.power)
            top, least = max(top, float(power.max())), min(least, float(power.min()))
            axes.plot(1.0 / np.array(one.frequency_per_h), power, color=colour, linewidth=1.0)
    axes.set_xlim(min(float(period[0]), 2000.0), float(period[-1]))
    axes.set_ylim(max(0.02, min(0.5, 0.7 * least)), 1.5 * top)
    logarithmic(axes, "y")
    axes.set_xscale("log")
    low, high = float(period[-1]), min(float(period[0]), 2000.0)
    ticks = [one for one in (0.5, 2.0, 6.0, 24.0, 168.0, 720.0) if low <= one <= high]
    axes.set_xticks(ticks, [f"{one:g}" for one in ticks])
    axes.set_xticks([], minor=True)


def _size(one: CrossCorrelation) -> float:
    return max(1.2 * float(np.max(np.abs(one.value))), 1.8 * one.limit_all)


def _correlation(axes: Axes, one: CrossCorrelation, other: CrossCorrelation | None, reach: float) -> None:
    axes.axhspan(-one.limit, one.limit, color=QUIET, alpha=0.16, linewidth=0)
    for sign in (-1.0, 1.0):
        axes.axhline(sign * one.limit_all, color=INK, linewidth=0.6, dashes=(4, 2))
    axes.axhline(0.0, color=QUIET, linewidth=0.6)
    axes.axvline(0.0, color=QUIET, linewidth=0.6)
    axes.plot(one.lag_h, one.value, color=SIMULATED, linewidth=0.9)
    if other is not None and other.lag_h:
        axes.plot(other.lag_h, other.value, color=AFTER, linewidth=0.9)
    axes.set_ylim(-reach, reach)
    end = math.ceil(one.lag_h[-1])
    axes.set_xlim(-end, end)
    ticks = [tick for tick in (-24, -12, 0, 12, 24) if abs(tick) <= end]
    # the labels of two neighbours' ends would touch
    axes.set_xticks(ticks, [f"{tick}".replace("-", "−") if abs(tick) < 24 else "" for tick in ticks])
    axes.locator_params(axis="y", nbins=5)


def _line_key(figure: Figure, overlaid: bool) -> None:
    handles = [
        line_handle(SIMULATED, "innovations" + (", before" if overlaid else ""), 1.4),
        area_handle(QUIET, "95 % if white", 0.16),
        line_handle(INK, "95 %, all lags together", 0.7, dashes=(4, 2)),
    ]
    if overlaid:
        handles.insert(1, line_handle(AFTER, "after", 1.4))
    figure_key(figure, handles)
