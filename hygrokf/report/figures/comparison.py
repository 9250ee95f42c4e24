"""Figures of several turbines. Of a comparison: readings beside simulations, errors with bounds, errors by
week. Of a fleet: every turbine's value with its bounds, in order, beside the fleet's median and spread. Of
a transfer: courses, what differs, what re-estimating changes, the type of turbine."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.data.timestamps import DAY_S, WEEK_S
from hygrokf.evaluation.scoring import SCORED
from hygrokf.fleet.outliers import REACH, Scatter
from hygrokf.identification.turbine_type import TurbineType
from hygrokf.identification.wording import QUANTITIES
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K
from hygrokf.report.figures.drawing import (
    AMBIENT,
    INK,
    MEASURED,
    QUIET,
    RULE,
    SHADE,
    SIMULATED,
    NothingToShow,
    Panels,
    area_handle,
    calendar,
    days,
    line,
    line_handle,
    logarithmic,
    name_rows,
)
from hygrokf.transfer.comparison import ColumnScores, ComparisonResults
from hygrokf.transfer.results import ParameterChange, RecordCourse, TransferResult

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes

REGIMES = {"operation": "o", "standstill": "s", "total": "D"}
COLOURS = (SIMULATED, "#1d7a3a", "#7a3a9a", AMBIENT, QUIET)
LONGEST = 30
"""Characters of a label beyond which it is cut."""
MOST_RECORDS = 3
"""Records whose courses fit side by side."""
MEASURED_NAME = "measured"
EXCERPT_S = 12 * DAY_S


def colour_of(place: int) -> str:
    """The colour of a column; blue is left to the readings."""
    return COLOURS[place % len(COLOURS)]


def short_labels(labels: Sequence[str]) -> list[str]:
    """Labels that fit beside a picture and can still be told apart: long ones are cut in the middle."""
    cut = [
        one if len(one) <= LONGEST else f"{one[: LONGEST // 2]}…{one[1 - LONGEST // 2 :]}" for one in labels
    ]
    return [one if cut.count(one) == 1 else f"{i + 1}: {one}" for i, one in enumerate(cut)]


@dataclass(frozen=True)
class Panel:
    """One record's readings with lines for the simulations: label and colour by name in the course."""

    title: str
    course: RecordCourse
    lines: Mapping[str, tuple[str, str]]

    @property
    def span(self) -> tuple[float, float]:
        """The first held-out days [s since 1970]; the first days where less than one is held out."""
        first, last = float(self.course.time_s[0]), float(self.course.time_s[-1])
        begin = self.course.until_s if self.course.until_s < last - DAY_S else first
        return begin, min(begin + EXCERPT_S, last)

    def has(self, quantity: str) -> bool:
        return bool(np.isfinite(self.course.measured.get(quantity, np.empty(0))).any())


def figure_courses(panels: Sequence[Panel]) -> Panels:
    """Twelve days of each record: a row for each quantity, a column for each record."""
    rows = [q for q in SCORED if any(panel.has(q) for panel in panels)]
    if not rows:
        raise NothingToShow("There are no readings to show.")

    def draw(axes: Axes, quantity: str, panel: Panel) -> None:
        name, unit = QUANTITIES[quantity]
        shift = ZERO_CELSIUS_K if quantity == "temperature_K" else 0.0
        for name_, (_, colour) in {MEASURED_NAME: ("", MEASURED), **panel.lines}.items():
            made = panel.course.simulated.get(name_, panel.course.measured)
            if quantity in made:
                width = 1.3 if name_ == MEASURED_NAME else 0.9
                line(axes, panel.course.time_s, made[quantity] - shift, panel.span, colour, width)
        axes.set_ylabel(f"{name} [{'°C' if shift else unit}]".replace(" ", "\n", name.count(" ")))
        if quantity == rows[0] and len(panels) > 1:
            axes.set_title(panel.title, fontsize=7.5)
        calendar(axes, panel.span, 9 // len(panels) + 1)

    def handles() -> list[Artist]:
        words = dict(pair for panel in panels for pair in panel.lines.values())
        return [line_handle(colour, label) for label, colour in {"reading": MEASURED, **words}.items()]

    return Panels(
        tuple(partial(draw, quantity=quantity, panel=panel) for quantity in rows for panel in panels),
        height_in=3.0 if len(rows) > 1 else 3.4,
        columns=len(panels),
        shared="xy",
        handles=handles,
    )


def figure_column_courses(found: ComparisonResults, courses: Sequence[RecordCourse]) -> Panels:
    """Readings and simulations of the first records; columns on the same instants of a case share a panel."""
    if not courses:
        raise NothingToShow(
            "These results hold no courses: `hygrokf compare` adds them when it is run again."
        )
    groups: dict[tuple[str, bytes], list[int]] = {}
    for i, (one, course) in enumerate(zip(found.columns, courses, strict=True)):
        groups.setdefault((one.case, course.time_s.tobytes()), []).append(i)
    labels = short_labels([one.label for one in found.columns])
    panels = []
    for (case, _), group in list(groups.items())[:MOST_RECORDS]:
        unique = sum(one == case for one, _ in groups) == 1
        made = {f"column {i}": courses[i].simulated["simulated"] for i in group}
        lines = {f"column {i}": (labels[i], colour_of(i)) for i in group}
        title = short_labels([case])[0] if unique else labels[group[0]]
        panels.append(Panel(title, replace(courses[group[0]], simulated=made), lines))
    return figure_courses(panels)


def figure_errors(found: ComparisonResults, period: str) -> Panels:
    """Root mean squared errors of all columns in one period with bounds, by regime, beside the error of the
    best rule."""
    columns = [one for one in found.columns if any(one.total(period, q) for q in SCORED)]
    if not columns:
        raise NothingToShow("Nothing was scored in this period.")
    shown = [q for q in SCORED if any(one.total(period, q) for one in columns)]
    labels = short_labels([one.label for one in columns])

    def draw(axes: Axes, quantity: str) -> None:
        for i, one in enumerate(columns):
            colour = colour_of(found.columns.index(one))
            _errors_row(axes, one, period, quantity, len(columns) - 1 - i, colour)
        name_rows(axes, labels)
        axes.set_xlim(left=0.0)
        axes.set_xlabel("RMSE of the {} [{}]".format(*QUANTITIES[quantity]))

    def handles() -> list[Artist]:
        marks = {**{regime: (mark, 3.5) for regime, mark in REGIMES.items()}, "best rule": ("|", 9.0)}
        return [
            line_handle(INK, words, 0.0, marker=mark, markersize=size)
            for words, (mark, size) in marks.items()
        ]

    return Panels(
        tuple(partial(draw, quantity=quantity) for quantity in shown),
        height_in=1.1 + 0.34 * len(columns),
        columns=len(shown),
        shared="y",
        handles=handles,
    )


def _errors_row(
    axes: Axes, one: ColumnScores, period: str, quantity: str, height: float, colour: str
) -> None:
    by_regime = one.scores.get(period, {}).get(quantity, {})
    for offset, (regime, mark) in zip((0.22, 0.0, -0.22), REGIMES.items(), strict=True):
        row = by_regime.get(regime)
        if row is None or not math.isfinite(row.rmse):
            continue
        if math.isfinite(row.lower):
            axes.plot([row.lower, row.upper], [height + offset] * 2, color=colour, linewidth=1.3, alpha=0.55)
        size = 4.0 if regime == "total" else 3.4
        axes.plot(row.rmse, height + offset, mark, color=colour, markersize=size)
        if row.rules and regime == "total":
            best = min(rule.rmse for rule in row.rules.values())
            axes.plot(best, height + offset, "|", color=INK, markersize=9, markeredgewidth=1.4)


def figure_weeks(found: ComparisonResults) -> Panels:
    """Root mean squared errors of all columns by week."""
    shown = [q for q in SCORED if any(len(one.weeks[q][0]) > 1 for one in found.columns if q in one.weeks)]
    if not shown:
        raise NothingToShow("There are fewer than two weeks to show.")
    middles = [one.weeks[q][0] for one in found.columns for q in shown if q in one.weeks]
    ends = [(m[0], m[-1]) for m in middles if len(m)]
    span = (min(first for first, _ in ends) - WEEK_S / 2, max(last for _, last in ends) + WEEK_S / 2)
    labels = short_labels([one.label for one in found.columns])

    def draw(axes: Axes, quantity: str) -> None:
        for i, one in enumerate(found.columns):
            if quantity in one.weeks:
                middle, value = one.weeks[quantity]
                axes.plot(days(middle), value, "-o", color=colour_of(i), markersize=2.6)
        axes.set_ylim(bottom=0.0)
        axes.set_ylabel("{} [{}]".format(*QUANTITIES[quantity]))
        calendar(axes, span)

    return Panels(
        tuple(partial(draw, quantity=quantity) for quantity in shown),
        height_in=0.6 + 1.5 * len(shown),
        shared="x",
        handles=lambda: [line_handle(colour_of(i), label) for i, label in enumerate(labels)],
    )


NAMED = 45
"""Turbines up to which every one has its name beside its row."""


def figure_spreads(found: Sequence[Scatter]) -> Panels:
    """One panel a quantity: turbines from the least to the largest value, bounds as lines, outliers in red.

    The shade is where 95 % of turbines would lie if their bounds were closed to a point: median and spread
    between them. There is none where the median deviation is no more than the bounds explain.
    """
    shown = [one for one in found if len(one.turbines)]
    if not shown:
        raise NothingToShow("No turbine has a value with bounds.")
    most = max(len(one.turbines) for one in shown)
    named = most <= NAMED
    height = 0.95 + (0.155 * most if named else min(0.155 * NAMED, 0.03 * most + 3.0))

    def handles() -> list[Artist]:
        bounds = ", 95 % bounds" if any(one.compared.lower for one in shown) else ""
        made = [line_handle(MEASURED, f"turbine{bounds}", marker="o", markersize=3)]
        if any(one.outliers for one in shown):
            made.append(line_handle(SIMULATED, "outlier", marker="o", markersize=3))
        made.append(line_handle(QUIET, "median"))
        if any(one.between > 0 for one in shown):
            made.append(area_handle(SHADE, "95 % of turbines"))
        return made

    return Panels(
        tuple(partial(_panel, one=one, named=named, most=most) for one in shown),
        height_in=max(height, 1.9),
        columns=len(shown),
        handles=handles,
    )


def _panel(axes: Axes, one: Scatter, named: bool, most: int) -> None:
    order = np.argsort(one.x)
    value, error = np.exp(one.x[order]), one.error[order]
    place = np.arange(len(order))
    odd = np.isin(order, one.outliers)
    low, high = np.exp([one.center - REACH * one.between, one.center + REACH * one.between])
    axes.axvspan(low, high, color=SHADE, zorder=0)
    axes.axvline(np.exp(one.center), color=QUIET, linewidth=0.8, zorder=1)
    for chosen, colour in ((~odd, MEASURED), (odd, SIMULATED)):
        if np.isfinite(error).all() and chosen.any():
            ends = value[chosen] * np.exp(np.outer([-REACH, REACH], error[chosen]))
            axes.hlines(place[chosen], *ends, color=colour, linewidth=1.1 if named else 0.5, zorder=2)
        axes.plot(value[chosen], place[chosen], "o", color=colour, markersize=3.2 if named else 1.4, zorder=3)
    axes.set_ylim(-0.8, max(most, 2) - 0.2)
    if named:
        names = [one.turbines[i] for i in order]
        axes.set_yticks(place, [name if len(name) <= 18 else f"{name[:17]}…" for name in names])
        axes.tick_params(axis="y", length=0)
    else:
        axes.set_yticks([])
        axes.set_ylabel(f"{len(order)} turbines, from the least to the largest")
    axes.grid(axis="y", visible=False)
    axes.set_xlabel(f"{one.compared.title} [{one.compared.unit}]")
    left, right = axes.get_xlim()
    if left <= 0 or right / left < 5.0:  # a decade's marks would leave such a narrow axis empty
        from matplotlib.ticker import MaxNLocator

        axes.xaxis.set_major_locator(MaxNLocator(7, steps=[1, 2, 2.5, 5, 10]))
    else:
        axes.set_xlim(max(left, 0.5 * value.min()), right)
        logarithmic(axes, "x", 4)


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


def figure_course(course: RecordCourse, re_estimated: bool) -> Panels:
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
