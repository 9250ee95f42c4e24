"""Figures of residuals over drivers and by day and hour, and of the innovations' spectrum and correlations.

Functions take `Residuals`, and those of an extended model as `after` for an overlay, and return a figure.
They raise `drawing.NothingToShow` with one sentence where their data are missing.
"""

from __future__ import annotations

import itertools
import textwrap
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.data.timestamps import DAY_S, HOUR_S
from hygrokf.discovery.residuals import (
    HUMIDITY,
    QUANTITIES,
    TEMPERATURE,
    UNITS,
    Residuals,
    binned,
    displayed,
    words,
)
from hygrokf.evaluation.diagnosis import CrossCorrelation, OutputDiagnosis, Periodogram
from hygrokf.evaluation.innovation_tests import diagnose
from hygrokf.report.figures.drawing import (
    INK,
    QUIET,
    SIMULATED,
    NothingToShow,
    Panels,
    area_handle,
    calendar,
    empty,
    line_handle,
    mark_validation,
    means,
)
from hygrokf.report.figures.innovations import correlation, correlation_reach, periodogram

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

AFTER = "#00796b"
"""Colour of the extended model; the base keeps that of the simulation."""
COLOURS = (SIMULATED, AFTER)
DIVERGING = ("#16365c", "#4f8fbf", "#f7f7f5", "#dd8a4a", "#8f1d14")
TITLE = {TEMPERATURE: "Temperature", HUMIDITY: "Absolute humidity"}
FEWEST_IN_BIN = 10
"""Hours that a bin needs to be drawn."""
FEWEST_READINGS = 100
DRIVERS = 4
INPUTS = 3
"""Drivers with which innovations are correlated."""
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


def figure_drivers(residuals: Residuals, drivers: Sequence[str], after: Residuals | None) -> Panels:
    """Error of the free run against drivers: medians, middle half and middle 80 % of the hours in equal
    shares; a row for each quantity, a column for each driver.

    drivers: up to four names.
    """
    quantities = _known(residuals)
    early = binned(residuals)
    late = binned(after) if after is not None else None
    chosen = [name for name in drivers if name in early.drivers]
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
        label = textwrap.fill(f"{words(name)} [{short or '1'}]", 27)
        axes.set_xlabel(label, fontsize=rcParams["xtick.labelsize"])
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
    hours, quantities = binned(residuals), _known(residuals)
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
    return [
        line_handle(SIMULATED, before, 1.4, marker="o", markersize=2.4),
        *([line_handle(AFTER, "after", 1.4, marker="o", markersize=2.4)] if overlaid else []),
        area_handle(SIMULATED, "middle half", 0.30),
        area_handle(SIMULATED, "middle 80 %", 0.10),
    ]


# --- course of the error ---------------------------------------------------------------------


def figure_error_course(before: Residuals, after: Residuals) -> Panels:
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

    def draw(axes: Axes, quantity: str) -> None:
        base, extended = courses[quantity]
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
        calendar(axes, (DAY_S * day[0], DAY_S * (day[-1] + 1.0)), 12)
        axes.set_ylabel(f"RMS [{UNITS[quantity]}]")
        axes.set_title(TITLE[quantity])

    def handles() -> list[Artist]:
        return [
            line_handle(SIMULATED, "base model"),
            line_handle(AFTER, "extended model"),
            area_handle(AFTER, "smaller with the cause", 0.2),
            area_handle(SIMULATED, "larger", 0.2),
        ]

    return Panels(
        tuple(partial(draw, quantity=quantity) for quantity in courses),
        height_in=0.62 + 1.35 * len(courses),
        shared="x",
        handles=handles,
    )


def _daily_rms(residuals: Residuals, quantity: str, days: np.ndarray) -> np.ndarray:
    """Root mean square (n,) of the error on held-out days (n,) since 1970; NaN on those without a reading."""
    error = residuals.error(quantity)
    chosen = residuals.validation & np.isfinite(error)
    place = (np.floor(residuals.time_s[chosen] / DAY_S) - days[0]).astype(int)
    return np.sqrt(means(place, error[chosen] ** 2, len(days)))


# --- day and hour ----------------------------------------------------------------------------


def figure_day_hour(
    residuals: Residuals, quantity: str = TEMPERATURE, after: Residuals | None = None
) -> Panels:
    """Error of the free run by day (across) and hour of the day (up), over identification and validation."""
    from matplotlib.colors import LinearSegmentedColormap

    if quantity not in _known(residuals):
        raise NothingToShow(f"There are no errors of the {TITLE[quantity].lower()} to show.")
    models = [("", residuals)] if after is None else [(", before", residuals), (", after", after)]
    maps = [_by_day(one, quantity) for _, one in models]
    reach = float(np.nanquantile(np.abs(maps[0][1]), 0.97)) or 1.0
    colours = LinearSegmentedColormap.from_list("error", DIVERGING).with_extremes(bad="#e3e6ea")

    def draw(axes: Axes, place: int) -> None:
        (label, one), (first, table) = models[place], maps[place]
        axes.grid(False)
        axes.imshow(
            table.T, origin="lower", aspect="auto", cmap=colours, vmin=-reach, vmax=reach,
            interpolation="nearest",
            extent=(first, first + len(table), 0.0, 24.0),
        )  # fmt: skip
        axes.set_yticks(np.arange(0, 25, 6))
        axes.set_ylabel("hour [UTC]")
        first, table = maps[0]
        calendar(axes, (DAY_S * first, DAY_S * (first + len(table))), 12)
        held_out(axes, one)
        axes.set_title(f"{TITLE[quantity]}, simulation − reading{label}")

    def scale(axes: Sequence[Axes]) -> None:
        figure = axes[0].get_figure(root=True)
        assert figure is not None
        bar = figure.colorbar(
            axes[0].images[0], ax=list(axes), extend="both", extendfrac=0.03, fraction=0.03, pad=0.01
        )
        bar.set_label(UNITS[quantity])

    return Panels(
        tuple(partial(draw, place=place) for place in range(len(maps))),
        height_in=0.5 + 1.55 * len(maps),
        shared="x",
        finish=scale,
    )


def held_out(axes: Axes, residuals: Residuals) -> None:
    """Where the validation period begins, on calendar axes."""
    if residuals.validation.any():
        mark_validation(axes, float(residuals.time_s[np.argmax(residuals.validation)]))


def _by_day(residuals: Residuals, quantity: str) -> tuple[int, np.ndarray]:
    """Number of the first day since 1970 and mean errors (days, 24), NaN without a reading."""
    error = -residuals.error(quantity)
    there = np.isfinite(error)
    hour = np.floor(residuals.time_s[there] / HOUR_S).astype(int)
    first = int(np.floor(residuals.time_s[0] / DAY_S))
    count = int(np.floor(residuals.time_s[-1] / DAY_S)) - first + 1
    return first, means(hour - 24 * first, error[there], 24 * count).reshape(count, 24)


# --- innovations -----------------------------------------------------------------------------


def figure_innovations(residuals: Residuals, after: Residuals | None = None) -> Panels:
    """Periodogram of the standardised innovations and, by quantity, their largest cross-correlations with
    drivers."""
    quantities = _known(residuals, innovations=True)
    found = _diagnosed(residuals)
    later = _diagnosed(after) if after is not None else {}
    drawn: list[Callable[[Axes], None]] = []
    for quantity in quantities:
        base, wider = (one.get(quantity, OutputDiagnosis()) for one in (found, later))
        rows = {name: one for name, one in base.cross_correlation.items() if one.lag_h}
        best = sorted(rows, key=lambda name: rows[name].p)[:INPUTS]
        reach = max((correlation_reach(rows[name]) for name in best), default=0.1)

        def spectrum(axes: Axes, quantity: str, shown: tuple[Periodogram | None, ...]) -> None:
            periodogram(axes, shown, COLOURS)
            axes.set_title(TITLE[quantity])
            axes.set_ylabel("power (white = 1)")

        def correlated(
            axes: Axes, name: str, shown: tuple[CrossCorrelation | None, ...], reach: float
        ) -> None:
            correlation(axes, shown, COLOURS, reach)
            axes.set_title(textwrap.fill(f"with {words(name)}", 26), fontweight="normal", fontsize=7.0)

        drawn.append(partial(spectrum, quantity=quantity, shown=(base.periodogram, wider.periodogram)))
        for name in best:
            shown = (rows[name], wider.cross_correlation.get(name))
            drawn.append(partial(correlated, name=name, shown=shown, reach=reach))
        drawn += [lambda axes: axes.set_axis_off()] * (INPUTS - len(best))
    return Panels(
        tuple(drawn),
        height_in=0.75 + 1.65 * len(quantities),
        columns=1 + INPUTS,
        handles=partial(_line_handles, after is not None),
    )


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


def _line_handles(overlaid: bool) -> list[Artist]:
    return [
        line_handle(SIMULATED, "innovations" + (", before" if overlaid else ""), 1.4),
        *([line_handle(AFTER, "after", 1.4)] if overlaid else []),
        area_handle(QUIET, "95 % if white", 0.16),
        line_handle(INK, "95 %, all lags together", 0.7, dashes=(4, 2)),
    ]
