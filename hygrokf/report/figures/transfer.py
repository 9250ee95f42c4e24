"""Figures of a transfer: courses, what differs, what re-estimating changes, the type of turbine."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING

from hygrokf.identification.turbine_type import TurbineType
from hygrokf.identification.wording import QUANTITIES
from hygrokf.report.figures.comparison import Panel, figure_courses
from hygrokf.report.figures.drawing import (
    AMBIENT,
    INK,
    MEASURED,
    QUIET,
    RULE,
    SHADE,
    SIMULATED,
    NothingToShow,
    line_handle,
    logarithmic,
    name_rows,
)
from hygrokf.report.figures.panels import Panels
from hygrokf.transfer.course import Course
from hygrokf.transfer.results import ParameterChange, TransferResult

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

RE_ESTIMATED = "#1d7a3a"
TICKS = (0.05, 0.1, 0.25, 0.5, 0.67, 0.8, 1.0, 1.25, 1.5, 2.0, 4.0, 10.0, 20.0)
SETS = {
    "as_is": "as it is",
    "own_loggers": "own loggers",
    "re_estimated": "re-estimated",
    "all_own": "all its own",
    "no_dynamics": "rule: no heat storage",
    "ambient": "rule: c = c_amb",
    "ambient_pressure_balance": "rule: c = c_amb T_amb/T",
}
SET_COLOURS = {"as_is": SIMULATED, "own_loggers": AMBIENT, "re_estimated": RE_ESTIMATED, "all_own": MEASURED}


def figure_course(course: Course, re_estimated: bool) -> Panels:
    """Twelve held-out days: readings, the model as it is, and the re-estimated one, or that with its own
    loggers where nothing was re-estimated."""
    chosen = ("as_is", "re_estimated" if re_estimated else "own_loggers")
    lines = {name: (f"simulated, {SETS[name]}", SET_COLOURS[name]) for name in chosen}
    return figure_courses([Panel("", course, lines)])


def figure_sets(found: TransferResult) -> Panels:
    """Errors of the four sets of values and of the rules in the scored period, with bounds."""
    tables = {q: rows for q, rows in found.rmse.items() if rows}
    if not tables:
        raise NothingToShow("Nothing was scored.")

    def draw(axes: Axes, quantity: str) -> None:
        rows = tables[quantity]
        names = [name for name in SETS if name in rows]
        for i, name in enumerate(names):
            at, colour = len(names) - 1 - i, SET_COLOURS.get(name, QUIET)
            bounds = rows[name].bounds
            if bounds is not None:
                axes.plot(list(bounds), [at, at], color=colour, linewidth=1.6, alpha=0.55)
            mark, size = ("D", 4.5) if name in SET_COLOURS else ("|", 9.0)
            axes.plot(rows[name].total, at, mark, color=colour, markersize=size)
        name_rows(axes, [SETS[name] for name in names])
        axes.set_xlim(left=0.0)
        axes.set_xlabel("RMSE of the {} [{}]".format(*QUANTITIES[quantity]))

    return Panels(
        tuple(partial(draw, quantity=quantity) for quantity in tables),
        height_in=0.75 + 0.2 * max(len(rows) for rows in tables.values()),
        columns=len(tables),
    )


def figure_parameters(found: TransferResult) -> Panels:
    """Differences of the cabinet's parameters from those of the fit, with 95 % bounds; differing groups in
    red."""
    compared = {name: row for name, row in found.parameters.items() if row.difference is not None}
    panels = {
        kind: {n: r for n, r in compared.items() if r.difference_is == kind}
        for kind in ("ratio", "difference")
    }
    panels = {kind: rows for kind, rows in panels.items() if rows}
    if not panels:
        raise NothingToShow("No parameter of the cabinet could be judged.")

    def draw(axes: Axes, kind: str) -> None:
        rows, ratio = panels[kind], kind == "ratio"
        if ratio:
            margin = math.exp(found.matters["ln_time_constant"])
            axes.axvspan(1.0 / margin, margin, color=SHADE, zorder=0)
        axes.axvline(1.0 if ratio else 0.0, color=QUIET, linewidth=0.8, zorder=1)
        for i, row in enumerate(rows.values()):
            colour, at = SIMULATED if row.group in found.re_estimate else MEASURED, len(rows) - 1 - i
            change = row.difference
            assert change is not None
            axes.plot([change.lower, change.upper], [at, at], color=colour, linewidth=1.6, alpha=0.6)
            axes.plot(change.value, at, "o", color=colour, markersize=4)
        name_rows(axes, [_label(name, "" if ratio else row.unit) for name, row in rows.items()])
        axes.set_xlabel("own value over the fit's" if ratio else "own value less the fit's")
        if ratio:
            _around(axes, rows)
            logarithmic(axes, "x")
            _plain_ratios(axes)

    return Panels(
        tuple(partial(draw, kind=kind) for kind in panels),
        height_in=0.75 + 0.19 * max(len(rows) for rows in panels.values()),
        columns=len(panels),
    )


def _label(name: str, unit: str) -> str:
    words = name.replace("heat_release_", "").replace("_", " ")
    return f"{words} [{unit}]" if unit else words


def _around(axes: Axes, rows: Mapping[str, ParameterChange]) -> None:
    """Limits that show one and all bounds, neither too narrow nor too wide to read."""
    changes = [row.difference for row in rows.values() if row.difference is not None]
    ends = [v for change in changes for v in (change.lower, change.upper)]
    reach = max(1.3, 1.1 * max(max(v, 1.0 / v) for v in ends if v > 0))
    axes.set_xlim(max(1.0 / reach, 0.02), min(reach, 50.0))


def _plain_ratios(axes: Axes) -> None:
    from matplotlib.ticker import FixedLocator

    low, high = axes.get_xlim()
    ticks = [t for t in TICKS if low < t < high]
    if high / low > 30:
        ticks = [t for t in ticks if t in (0.05, 0.1, 0.25, 1.0, 4.0, 10.0, 20.0)]
    elif high / low > 3.5:
        ticks = [t for t in ticks if t not in (0.8, 1.25)]
    axes.xaxis.set_major_locator(FixedLocator(ticks))


def figure_type(found: TurbineType) -> Panels:
    """The time constants of a type with bounds and the range of the next turbine."""
    shown = {
        n: r
        for n, r in found.parameters.items()
        if r.logarithmic and not n.endswith(("_sd", "_time", "_diffusion"))
    }
    if not shown:
        raise NothingToShow("The type has no time constant.")

    def draw(axes: Axes) -> None:
        for i, row in enumerate(shown.values()):
            at, ends = len(shown) - 1 - i, row.in_unit()
            axes.plot([ends["next_lower"], ends["next_upper"]], [at, at], color=RULE, linewidth=7.0)
            axes.plot([ends["lower"], ends["upper"]], [at, at], color=MEASURED, linewidth=2.2)
            axes.plot(ends["value"], at, "o", color=INK, markersize=4)
        name_rows(axes, [f"{n.replace('_', ' ')} [{r.unit}]" for n, r in shown.items()])
        logarithmic(axes, "x")

    def handles() -> list[Artist]:
        return [line_handle(RULE, "next turbine, 95 %", 7.0), line_handle(MEASURED, "type, 95 %", 2.2)]

    return Panels((draw,), height_in=0.8 + 0.3 * len(shown), handles=handles)
