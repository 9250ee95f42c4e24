"""Figure of one finding: the episodes in which it is worst, or the whole record where it lasts for months.

The residuals of an extended model, given as `after`, are laid over those of the base.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.data.timestamps import DAY_S
from hygrokf.discovery.discovery_results import LASTING_KINDS, CauseFound, DiscoveryResults, Finding
from hygrokf.discovery.residuals import HUMIDITY, QUANTITIES, TEMPERATURE, UNITS, Residuals, hourly
from hygrokf.identification.wording import one_line
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K
from hygrokf.report.figures.drawing import (
    AMBIENT,
    INK,
    LEVEL_SD,
    MEASURED,
    QUIET,
    SIMULATED,
    NothingToShow,
    area_handle,
    band,
    calendar,
    days,
    envelope,
    figure_key,
    line_handle,
    new_figure,
    shade,
    styled,
    upright,
)
from hygrokf.report.figures.panels import Panels
from hygrokf.report.figures.residual_structure import AFTER, TITLE, error_label, held_out

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CONDITION = "#f3e3c0"
COURSE_LABEL = {TEMPERATURE: "temperature [°C]", HUMIDITY: "absolute humidity [g/m³]"}
AMBIENT_NAME = {TEMPERATURE: "ambient_temperature", HUMIDITY: "ambient_absolute_humidity"}
EPISODES = 3
AROUND_H = (18.0, 42.0)
"""[h] shown on either side of an episode: at least, at most; in between half of the episode."""
LONGEST_H = 120.0
NARROW = 200
"""Stretches of time over the width of a panel."""
LINE = 100
"""Letters of a heading's line."""


# --- what to draw ----------------------------------------------------------------------------


def drawable(found: DiscoveryResults) -> list[Finding]:
    """The findings whose episodes can be drawn, worst first."""
    return [one for one in found.findings if one.spans and one.quantity in QUANTITIES and one.statement]


def events(found: DiscoveryResults) -> list[tuple[CauseFound, Finding]]:
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
            result.append((cause, event))
    return result


def episodes_caption(overlaid: bool) -> str:
    """What to look for in `figure_episodes`; `overlaid`: with the extended model."""
    compare = ": compare the base model (red) with the extended one (green)." if overlaid else "."
    return f"Where the background is shaded the simulation should stay with the blue readings{compare}"


# --- episodes --------------------------------------------------------------------------------


def figure_episodes(residuals: Residuals, finding: Finding, after: Residuals | None = None) -> Figure:
    """The episodes in which a finding is largest, with the free run's 95 % band; a lasting finding over the
    whole record."""
    quantity = finding.quantity
    _measured(residuals, quantity)
    if finding.kind in LASTING_KINDS:
        return _lasting(residuals, finding, after)
    windows = _windows(finding, residuals)
    if not windows:
        raise NothingToShow("The finding has no episodes.")
    with styled():
        height = 3.45
        figure = new_figure(height)
        used = _heading(figure, finding, _course_handles(after is not None, "under the condition"))
        grid = figure.add_gridspec(
            2, len(windows), height_ratios=(2.3, 1.0), hspace=0.12, wspace=0.15, left=0.072, right=0.995,
            top=1.0 - used / height, bottom=0.38 / height,
        )  # fmt: skip
        reach = 0.0
        lower: list[Axes] = []
        for column, (start, end, spans) in enumerate(windows):
            main = figure.add_subplot(grid[0, column])
            error = figure.add_subplot(grid[1, column])
            _window(main, residuals, quantity, (start, end), spans, after)
            main.tick_params(labelbottom=False)
            error.axhline(0.0, color=QUIET, linewidth=0.6)
            for one, colour in _before_after(residuals, after):
                reach = max(reach, _error_line(error, one, quantity, (start, end), colour))
            _shade(error, (start, end), spans)
            _midnights(error, (start, end))
            if column == len(windows) - 1:
                year = np.datetime64(int(end // DAY_S), "D").item().year
                error.set_xlabel(f"{year}, midnights UTC", loc="right", color=QUIET, fontsize=6.8)
            main.set_ylabel("")
            if column == 0:
                upright(main, COURSE_LABEL[quantity])
                upright(error, f"error [{UNITS[quantity]}]")
            lower.append(error)
        for error in lower:
            error.set_ylim(-1.1 * reach, 1.1 * reach)
            error.locator_params(axis="y", nbins=5)
    return figure


def episode_panels(residuals: Residuals, finding: Finding, after: Residuals | None = None) -> Panels:
    """The upper row of `figure_episodes`, or the only panel of a lasting finding."""
    quantity = finding.quantity
    _measured(residuals, quantity)
    if finding.kind in LASTING_KINDS:
        draw = partial(_lasting_course, residuals=residuals, finding=finding, after=after)
        return Panels((draw,), height_in=2.5, handles=partial(_lasting_handles, after is not None))
    windows = _windows(finding, residuals)
    if not windows:
        raise NothingToShow("The finding has no episodes.")

    def window(axes: Axes, place: int) -> None:
        start, end, spans = windows[place]
        _window(axes, residuals, quantity, (start, end), spans, after)
        axes.set_xlabel(f"{np.datetime64(int(end // DAY_S), 'D').item().year}, midnights UTC")
        if place:
            axes.set_ylabel("")

    return Panels(
        tuple(partial(window, place=place) for place in range(len(windows))),
        height_in=2.6,
        columns=len(windows),
        handles=partial(_course_handles, after is not None, "under the condition"),
    )


def _window(
    axes: Axes,
    residuals: Residuals,
    quantity: str,
    span: tuple[float, float],
    shaded: Sequence[tuple[float, float]],
    after: Residuals | None,
) -> None:
    """Readings and simulations of a stretch of time [s], with the episodes in it shaded."""
    _course(axes, residuals, quantity, span, after)
    _shade(axes, span, shaded)
    _midnights(axes, span)
    axes.set_ylabel(COURSE_LABEL[quantity])


def _shade(axes: Axes, span: tuple[float, float], shaded: Sequence[tuple[float, float]]) -> None:
    for first, last in shaded:
        inside = (max(first, span[0]), min(last, span[1]))
        shade(axes, *inside, color=CONDITION, alpha=0.75, zorder=0, linewidth=0)


def _before_after(residuals: Residuals, after: Residuals | None) -> list[tuple[Residuals, str]]:
    return [(residuals, SIMULATED), *([(after, AFTER)] if after is not None else [])]


def _measured(residuals: Residuals, quantity: str) -> None:
    if quantity not in residuals.measured or not np.isfinite(residuals.error(quantity)).any():
        raise NothingToShow(f"There are no errors of the {TITLE[quantity].lower()} to show.")


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
    time = residuals.time_s
    shift = ZERO_CELSIUS_K if quantity == TEMPERATURE else 0.0
    sd = residuals.sd.get(quantity)
    simulated = residuals.simulated[quantity] - shift
    if sd is not None:
        t, low, high = band(time, simulated - LEVEL_SD * sd, simulated + LEVEL_SD * sd, span, NARROW)
        axes.fill_between(days(t), low, high, color=SIMULATED, alpha=0.15, linewidth=0)
    ambient = residuals.drivers.get(AMBIENT_NAME[quantity])
    courses = [(residuals.measured[quantity] - shift, MEASURED, 1.3), (simulated, SIMULATED, 1.0)]
    if ambient is not None:
        courses.insert(0, (ambient - shift, AMBIENT, 0.9))
    for value, colour, width in courses:
        t, v = envelope(time, value, span, NARROW)
        axes.plot(days(t), v, color=colour, linewidth=width)
    if after is not None:
        t, v = envelope(after.time_s, after.simulated[quantity] - shift, span, NARROW)
        axes.plot(days(t), v, color=AFTER, linewidth=1.2)
    inside = (time >= span[0]) & (time <= span[1])
    there = np.concatenate([value[inside & np.isfinite(value)] for value, _, _ in courses])
    if len(there):
        margin = 0.08 * float(np.ptp(there)) or 1.0
        axes.set_ylim(float(there.min()) - margin, float(there.max()) + margin)


def _error_line(
    axes: Axes, residuals: Residuals, quantity: str, span: tuple[float, float], colour: str
) -> float:
    """Simulation − reading over a window; returns its largest size."""
    t, v = envelope(residuals.time_s, -residuals.error(quantity), span, NARROW)
    axes.plot(days(t), v, color=colour, linewidth=1.0)
    return float(np.nanmax(np.abs(v), initial=0.0))


def _course_handles(overlaid: bool, shaded: str) -> list[Artist]:
    handles = [
        line_handle(MEASURED, "readings"),
        line_handle(SIMULATED, "simulated" + (", before" if overlaid else "")),
        area_handle(SIMULATED, "95 % band", 0.15),
        line_handle(AMBIENT, "ambient"),
        area_handle(CONDITION, shaded),
    ]
    if overlaid:
        handles.insert(2, line_handle(AFTER, "after"))
    return handles


def _heading(figure: Figure, finding: Finding, handles: list[Artist]) -> float:
    """The finding's own sentence and a key above the figure; returns the height [in] that they take."""
    import textwrap

    statement = one_line(finding.statement)
    lines = textwrap.wrap(statement[:1].upper() + statement[1:], LINE)
    height = figure.get_size_inches()[1]
    used = 0.09 + 0.145 * len(lines)
    top = 1.0 - 0.06 / height
    figure.text(0.012, top, "\n".join(lines), va="top", fontsize=8.0, fontweight="bold", linespacing=1.2)
    figure_key(figure, handles, (0.012, 1.0 - used / height), left=True)
    return used + 0.24


def _midnights(axes: Axes, span: tuple[float, float]) -> None:
    """Days of a window, at most five of them named; noons as small ticks."""
    first, last = np.ceil(span[0] / DAY_S), np.floor(span[1] / DAY_S)
    every = np.arange(first, last + 1.0)
    named = every[:: max(1, -(-len(every) // 5))]
    words = [f"{np.datetime64(int(day), 'D').item():%-d %b}" for day in named]
    axes.set_xlim(float(days(span[0])), float(days(span[1])))
    axes.set_xticks(named, words)
    axes.set_xticks(np.arange(first - 0.5, last + 1.0), minor=True)
    axes.tick_params(axis="x", which="minor", length=1.5, color=QUIET, width=0.5)
    axes.set_xlim(float(days(span[0])), float(days(span[1])))


def _lasting(residuals: Residuals, finding: Finding, after: Residuals | None) -> Figure:
    """Daily means of the error over the whole record, and its means before and after, or by month."""
    with styled():
        height = 2.5
        figure = new_figure(height)
        used = _heading(figure, finding, _lasting_handles(after is not None))
        axes = figure.add_axes((0.072, 0.31 / height, 0.923, 1.0 - (used + 0.31) / height))
        _lasting_course(axes, residuals, finding, after)
        upright(axes, error_label(finding.quantity))
    return figure


def _lasting_handles(overlaid: bool) -> list[Artist]:
    handles = [
        line_handle(SIMULATED, f"daily mean{', before' * overlaid}"),
        area_handle(SIMULATED, "middle 80 % of the day", 0.13),
        line_handle(INK, "mean of either part", 1.1, dashes=(5, 2)),
        area_handle(CONDITION, "where the finding is"),
    ]
    if overlaid:
        handles.insert(1, line_handle(AFTER, "after"))
    return handles


def _lasting_course(axes: Axes, residuals: Residuals, finding: Finding, after: Residuals | None) -> None:
    quantity = finding.quantity
    hours = hourly(residuals)
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
    held_out(axes, residuals, axes.get_ylim()[1])
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
