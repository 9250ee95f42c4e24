"""Figure of one finding: the episodes in which it is worst, or the whole record where it lasts for months.

The residuals of an extended model, given as `after`, are laid over those of the base.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.data.timestamps import DAY_S
from hygrokf.discovery.residuals import HUMIDITY, QUANTITIES, TEMPERATURE, UNITS, Residuals, binned
from hygrokf.discovery.results import LASTING_KINDS, DiscoveryResults, Finding
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K
from hygrokf.report.figures.drawing import (
    AMBIENT,
    INK,
    MEASURED,
    QUIET,
    SIMULATED,
    NothingToShow,
    Panels,
    area_handle,
    calendar,
    courses,
    days,
    line,
    line_handle,
    shade,
)
from hygrokf.report.figures.residual_structure import AFTER, TITLE, error_label, held_out

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

CONDITION = "#f3e3c0"
COURSE_LABEL = {TEMPERATURE: "temperature [°C]", HUMIDITY: "absolute humidity [g/m³]"}
AMBIENT_NAME = {TEMPERATURE: "ambient_temperature", HUMIDITY: "ambient_absolute_humidity"}
EPISODES = 3
AROUND_H = (18.0, 42.0)
"""[h] shown on either side of an episode: at least, at most; in between half of the episode."""
LONGEST_H = 120.0
NARROW = 200
"""Stretches of time over the width of a panel."""


# --- what to draw ----------------------------------------------------------------------------


def drawable(found: DiscoveryResults) -> list[Finding]:
    """The findings whose episodes can be drawn, worst first."""
    return [one for one in found.findings if one.spans and one.quantity in QUANTITIES and one.statement]


def events(found: DiscoveryResults) -> list[Finding]:
    """Accepted causes that were found in stretches of time, each as a finding of the quantity that gained
    most there."""
    result = []
    for cause in found.causes:
        spans = tuple((float(a), float(b)) for a, b in cause.settings.get("spans", ()) if a < b)
        gains, statement = cause.evidence.gains, cause.statement.split(";")[0]
        if spans and gains and statement:
            most = max(gains, key=lambda name: gains[name])
            quantity = TEMPERATURE if most == TEMPERATURE else HUMIDITY
            event = Finding(
                quantity, "", "", 0.0, UNITS[quantity], "", float("nan"), len(spans), len(spans), 0.0,
                statement, 0.0, 0.0, None, "episode", spans=spans,
            )  # fmt: skip
            result.append(event)
    return result


# --- episodes --------------------------------------------------------------------------------


def figure_episodes(residuals: Residuals, finding: Finding, after: Residuals | None = None) -> Panels:
    """The episodes in which a finding is largest, with the free run's 95 % band and below it the error; of a
    lasting finding the daily means over the whole record."""
    quantity = finding.quantity
    if quantity not in residuals.measured or not np.isfinite(residuals.error(quantity)).any():
        raise NothingToShow(f"There are no errors of the {TITLE[quantity].lower()} to show.")
    if finding.kind in LASTING_KINDS:
        draw = partial(_lasting, residuals=residuals, finding=finding, after=after)
        return Panels((draw,), height_in=2.5, handles=partial(_lasting_handles, after is not None))
    windows = _windows(finding, residuals)
    if not windows:
        raise NothingToShow("The finding has no episodes.")
    models = _before_after(residuals, after)
    reach = max(_largest(one, quantity, start, end) for one, _ in models for start, end, _ in windows)

    def course(axes: Axes, span: tuple[float, float]) -> None:
        _course(axes, residuals, quantity, span, after)
        axes.set_ylabel(COURSE_LABEL[quantity])

    def error(axes: Axes, span: tuple[float, float]) -> None:
        axes.axhline(0.0, color=QUIET, linewidth=0.6)
        for one, colour in models:
            line(axes, one.time_s, -one.error(quantity), span, colour, 1.0, NARROW)
        axes.set_ylim(-1.1 * reach, 1.1 * reach)
        axes.locator_params(axis="y", nbins=5)
        axes.set_ylabel(f"error [{UNITS[quantity]}]")

    def window(axes: Axes, draw: Callable[[Axes, tuple[float, float]], None], place: int) -> None:
        start, end, shaded = windows[place]
        draw(axes, (start, end))
        for first, last in shaded:
            inside = (max(first, start), min(last, end))
            shade(axes, *inside, color=CONDITION, alpha=0.75, zorder=0, linewidth=0)
        calendar(axes, (start, end), 5)
        if place:
            axes.set_ylabel("")

    return Panels(
        tuple(partial(window, draw=draw, place=i) for draw in (course, error) for i in range(len(windows))),
        height_in=3.3,
        columns=len(windows),
        shared="x",
        handles=partial(_course_handles, after is not None),
        heights=(2.3, 1.0),
    )


def _largest(residuals: Residuals, quantity: str, start_s: float, end_s: float) -> float:
    inside = (residuals.time_s >= start_s) & (residuals.time_s <= end_s)
    return float(np.nanmax(np.abs(residuals.error(quantity)[inside]), initial=0.0)) or 1.0


def _before_after(residuals: Residuals, after: Residuals | None) -> list[tuple[Residuals, str]]:
    return [(residuals, SIMULATED), *([(after, AFTER)] if after is not None else [])]


def _windows(finding: Finding, residuals: Residuals) -> list[tuple[float, float, list[tuple[float, float]]]]:
    """Up to three windows (start, end, episodes in it) [s] in order of time around the worst episodes."""
    low, high = float(residuals.time_s[0]), float(residuals.time_s[-1])
    chosen: list[tuple[float, float]] = []
    for first, last in finding.spans:
        around = 3600.0 * float(np.clip(0.5 * (last - first) / 3600.0, *AROUND_H))
        last = min(last, first + 3600.0 * LONGEST_H)
        start, end = max(low, first - around), min(high, last + around)
        if all(end <= a or start >= b for a, b in chosen):
            chosen.append((start, end))
        if len(chosen) == EPISODES:
            break
    chosen.sort()
    return [(a, b, [span for span in finding.spans if span[1] > a and span[0] < b]) for a, b in chosen]


def _course(
    axes: Axes, residuals: Residuals, quantity: str, span: tuple[float, float], after: Residuals | None
) -> None:
    """Ambient, reading, simulation with its band, and the extended model's."""
    shift = ZERO_CELSIUS_K if quantity == TEMPERATURE else 0.0
    shown = [
        (residuals.measured[quantity] - shift, MEASURED, 1.3),
        (residuals.simulated[quantity] - shift, SIMULATED, 1.0),
    ]
    ambient = residuals.drivers.get(AMBIENT_NAME[quantity])
    if ambient is not None:
        shown.insert(0, (ambient - shift, AMBIENT, 0.9))
    courses(axes, residuals.time_s, shown, residuals.sd.get(quantity), span, NARROW)
    if after is not None:
        line(axes, after.time_s, after.simulated[quantity] - shift, span, AFTER, 1.2, NARROW)


def _course_handles(overlaid: bool) -> list[Artist]:
    return [
        line_handle(MEASURED, "readings"),
        line_handle(SIMULATED, "simulated" + (", before" if overlaid else "")),
        *([line_handle(AFTER, "after")] if overlaid else []),
        area_handle(SIMULATED, "95 % band", 0.15),
        line_handle(AMBIENT, "ambient"),
        area_handle(CONDITION, "under the condition"),
    ]


def _lasting_handles(overlaid: bool) -> list[Artist]:
    return [
        line_handle(SIMULATED, f"daily mean{', before' * overlaid}"),
        *([line_handle(AFTER, "after")] if overlaid else []),
        area_handle(SIMULATED, "middle 80 % of the day", 0.13),
        line_handle(INK, "mean of either part", 1.1, dashes=(5, 2)),
        area_handle(CONDITION, "where the finding is"),
    ]


def _lasting(axes: Axes, residuals: Residuals, finding: Finding, after: Residuals | None) -> None:
    quantity = finding.quantity
    hours = binned(residuals)
    axes.axhline(0.0, color=QUIET, linewidth=0.6)
    for one, colour in _before_after(residuals, after):
        day, mean, low, high = _daily(one, quantity)
        if colour == SIMULATED:
            axes.fill_between(days(day), low, high, color=colour, alpha=0.13, linewidth=0)
        axes.plot(days(day), mean, color=colour, linewidth=1.0)
    inside = np.zeros(len(hours), dtype=bool)
    for first, last in finding.spans:
        shade(axes, first, last, color=CONDITION, alpha=0.6, zorder=0, linewidth=0)
        inside |= (hours.time_s >= first) & (hours.time_s <= last)
    error = -hours.error[quantity]
    for flag in (inside, ~inside):
        if np.isfinite(error[flag]).any():
            level = np.where(flag, np.nanmean(error[flag]), np.nan)
            axes.plot(days(hours.time_s), level, color=INK, linewidth=1.1, dashes=(5, 2))
    calendar(axes, (float(residuals.time_s[0]), float(residuals.time_s[-1])), 12)
    axes.locator_params(axis="y", nbins=6)
    held_out(axes, residuals)
    axes.set_ylabel(error_label(quantity))


def _daily(residuals: Residuals, quantity: str) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Day's noon [s], mean and 10th and 90th percentile of simulation − reading."""
    error = -residuals.error(quantity)
    there = np.isfinite(error)
    number = np.floor(residuals.time_s[there] / DAY_S).astype(int)
    starts = np.flatnonzero(np.append(True, np.diff(number) > 0))
    parts = np.split(error[there], starts[1:])
    rows = [(np.mean(part), *np.quantile(part, [0.1, 0.9])) for part in parts]
    return (number[starts] + 0.5) * DAY_S, *np.array(rows).T
