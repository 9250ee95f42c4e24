"""Figures of several turbines. Of a comparison: readings beside simulations, errors with bounds, errors by
week. Of a fleet: every turbine's value with its bounds, in order, beside the fleet's median and spread. Of
a transfer: courses, what differs, what re-estimating changes, the type of turbine."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from hygrokf.data.timestamps import DAY_S, WEEK_S
from hygrokf.fleet.outliers import INTERVAL_SD, Scatter
from hygrokf.identification.turbine_type import TurbineType
from hygrokf.report.figures.drawing import (
    AMBIENT_COLOUR,
    INK,
    MEASURED,
    QUIET,
    RULE,
    SHADE,
    SIMULATED_COLOUR,
    NothingToShow,
)
from hygrokf.report.figures.panels import (
    Axis,
    CrossLine,
    Curve,
    Mark,
    Panel,
    Picture,
    Shade,
    bounds,
    course,
    point,
    rows,
    strokes,
)
from hygrokf.report.quantities import quantity, spoken
from hygrokf.texts.parts import SCORED
from hygrokf.transfer.comparison import ComparisonResults
from hygrokf.transfer.transfer_results import RecordCourse, TransferResult
from hygrokf.transfer.transferability import MATERIAL_DIFFERENCE

REGIME_MARKERS = {"operation": ("o", 3.4), "standstill": ("s", 3.4), "total": ("D", 4.0)}
"""Regime → its marker and size [pt]."""
BEST = ("|", INK, 9.0)
"""Marker of the best rule."""
COLOURS = (SIMULATED_COLOUR, "#1d7a3a", "#7a3a9a", AMBIENT_COLOUR, QUIET)
LONGEST_LABEL = 30
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
        label
        if len(label) <= LONGEST_LABEL
        else f"{label[: LONGEST_LABEL // 2]}…{label[1 - LONGEST_LABEL // 2 :]}"
        for label in labels
    ]
    return [label if cut.count(label) == 1 else f"{i + 1}: {label}" for i, label in enumerate(cut)]


@dataclass(frozen=True)
class Shown:
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


def figure_courses(records: Sequence[Shown]) -> Picture:
    """Twelve days of each record: a row for each quantity, a column for each record."""
    quantities = [q for q in SCORED if any(record.has(q) for record in records)]
    if not quantities:
        raise NothingToShow("There are no readings to show.")
    panels = []
    for name in quantities:
        terms = quantity(name)
        label = terms.level.replace(" ", "\n", terms.words.count(" "))
        for record in records:
            made = {MEASURED_NAME: record.course.measured, **record.course.simulated}
            lines = {MEASURED_NAME: ("reading", MEASURED), **record.lines}
            marks = tuple(
                course(record.course.time_s, made[key][name] - terms.zero, record.span, colour, width, words)
                for key, (words, colour) in lines.items()
                if name in made[key]
                for width in (1.3 if key == MEASURED_NAME else 0.9,)
            )
            x = Axis(limits=record.span, kind="time", most=9 // len(records) + 1)
            title = record.title if name == quantities[0] and len(records) > 1 else ""
            panels.append(Panel(marks, x, Axis(label), title))
    height_in = 3.0 if len(quantities) > 1 else 3.4
    return Picture(tuple(panels), height_in, columns=len(records), shared="xy")


def figure_column_courses(found: ComparisonResults, courses: Sequence[RecordCourse]) -> Picture:
    """Readings and simulations of the first records; columns on the same instants of a case share a panel."""
    if not courses:
        raise NothingToShow(
            "These results hold no courses: `hygrokf compare` adds them when it is run again."
        )
    groups: dict[tuple[str, bytes], list[int]] = {}
    for i, (column, own) in enumerate(zip(found.columns, courses, strict=True)):
        groups.setdefault((column.case, own.time_s.tobytes()), []).append(i)
    labels = short_labels([column.label for column in found.columns])
    panels = []
    for (case, _), group in list(groups.items())[:MOST_RECORDS]:
        unique = sum(other == case for other, _ in groups) == 1
        made = {f"column {i}": courses[i].simulated["simulated"] for i in group}
        lines = {f"column {i}": (labels[i], colour_of(i)) for i in group}
        title = short_labels([case])[0] if unique else labels[group[0]]
        panels.append(Shown(title, replace(courses[group[0]], simulated=made), lines))
    return figure_courses(panels)


def figure_errors(found: ComparisonResults, period: str) -> Picture:
    """Root mean squared errors of all columns in one period with bounds, by regime, beside the error of the
    best rule."""
    scored = {q: errors for q in SCORED if (errors := found.errors(period, q))}
    columns = [
        column for column in found.columns if any(column.label in errors for errors in scored.values())
    ]
    if not columns:
        raise NothingToShow("Nothing was scored in this period.")
    labels = rows(short_labels([column.label for column in columns]))
    panels = []
    for name in scored:
        marks: list[Mark] = []
        for place, column in enumerate(columns):
            colour = colour_of(found.columns.index(column))
            for offset, (regime, (mark, size)) in zip(
                (-0.22, 0.0, 0.22), REGIME_MARKERS.items(), strict=True
            ):
                row = found.row("rmse", column.label, period, name, regime)
                if not row.n:
                    continue
                if math.isfinite(row.lower):
                    marks.append(bounds(row.lower, row.upper, place + offset, colour))
                marks.append(point(row.value, place + offset, mark, colour, size))
            wanted = ("rule", column.label, name, period, "total")
            rules = [
                r.value for r in found.rows if (r.kind, r.column, r.quantity, r.period, r.regime) == wanted
            ]
            if rules:
                marks.append(point(min(rules), place + 0.22, *BEST))
        panels.append(Panel(tuple(marks), _rmse(name), labels))
    key = tuple(
        replace(point(0.0, 0.0, mark, INK, size), label=words)
        for words, (mark, size) in {**REGIME_MARKERS, "best rule": ("|", 9.0)}.items()
    )
    return Picture(tuple(panels), 1.1 + 0.34 * len(columns), columns=len(scored), shared="y", key=key)


def _rmse(name: str) -> Axis:
    return Axis(quantity(name).rmse, (0.0, None))


def figure_weeks(found: ComparisonResults) -> Picture:
    """Root mean squared errors of all columns by week."""
    shown = [
        q for q in SCORED if any(len(column.weeks[q][0]) > 1 for column in found.columns if q in column.weeks)
    ]
    if not shown:
        raise NothingToShow("There are fewer than two weeks to show.")
    middles = [column.weeks[q][0] for column in found.columns for q in shown if q in column.weeks]
    ends = [(m[0], m[-1]) for m in middles if len(m)]
    span = (min(first for first, _ in ends) - WEEK_S / 2, max(last for _, last in ends) + WEEK_S / 2)
    labels = short_labels([column.label for column in found.columns])
    panels = [
        Panel(
            tuple(
                Curve(column.weeks[q][0], column.weeks[q][1], colour_of(i), 0.9, label, "o", 2.6)
                for i, (column, label) in enumerate(zip(found.columns, labels, strict=True))
                if q in column.weeks
            ),
            Axis(limits=span, kind="time", most=9),
            Axis(quantity(q).change, (0.0, None)),
        )
        for q in shown
    ]
    return Picture(tuple(panels), height_in=0.6 + 1.5 * len(shown), shared="x")


MOST_NAMED_ROWS = 45
"""Turbines up to which every one has its name beside its row."""


def figure_spreads(found: Sequence[Scatter]) -> Picture:
    """One panel a quantity: turbines from the least to the largest value, bounds as lines, outliers in red.

    The shade is where 95 % of turbines would lie if their bounds were closed to a point: median and spread
    between them. There is none where the median deviation is no more than the bounds explain.
    """
    shown = [scatter for scatter in found if len(scatter.turbines)]
    if not shown:
        raise NothingToShow("No turbine has a value with bounds.")
    most = max(len(scatter.turbines) for scatter in shown)
    height = 0.95 + (
        0.155 * most if most <= MOST_NAMED_ROWS else min(0.155 * MOST_NAMED_ROWS, 0.03 * most + 3.0)
    )
    panels = tuple(_spread(scatter, most) for scatter in shown)
    return Picture(panels, height_in=max(height, 1.9), columns=len(shown))


def _spread(one: Scatter, most: int) -> Panel:
    named = most <= MOST_NAMED_ROWS
    order = np.argsort(one.x)
    value, error = np.exp(one.x[order]), one.error[order]
    place = np.arange(len(order))
    odd = np.isin(order, one.outliers)
    low, high = np.exp([one.center - INTERVAL_SD * one.between, one.center + INTERVAL_SD * one.between])
    bounded = np.isfinite(error).all()
    marks: list[Mark] = []
    for chosen, colour, words in ((~odd, MEASURED, "turbine"), (odd, SIMULATED_COLOUR, "outlier")):
        if not chosen.any():
            continue
        if bounded:
            ends = value[chosen] * np.exp(np.outer([-INTERVAL_SD, INTERVAL_SD], error[chosen]))
            width = 1.1 if named else 0.5
            marks.append(strokes(ends[0], place[chosen], ends[1], place[chosen], colour, width))
            words = f"{words}, 95 % bounds" if words == "turbine" else words
        size = 3.2 if named else 1.4
        marks.append(Curve(value[chosen], place[chosen], colour, 0.0, words, "o", size))
    marks.append(CrossLine(float(np.exp(one.center)), "x", QUIET, 0.8, label="median"))
    if one.between > 0:
        marks.append(Shade(low, high, SHADE, label="95 % of turbines"))
    limits = (-0.8, max(most, 2) - 0.2)
    y = Axis(
        f"{len(order)} turbines, from the least to the largest", limits, at=(-0.8,), words=("",), grid=False
    )
    if named:
        names = [one.turbines[i] for i in order]
        cut = [name if len(name) <= 18 else f"{name[:17]}…" for name in names]
        y = Axis(limits=limits, at=place, words=cut, grid=False)
    label = f"{one.compared.title} [{one.compared.unit}]"
    ends = value * np.exp(np.outer([-INTERVAL_SD, INTERVAL_SD], error if bounded else np.zeros(len(error))))
    left, right = 0.97 * float(min(ends.min(), low)), 1.03 * float(max(ends.max(), high))
    if left <= 0 or right / left < 5.0:  # a decade's marks would leave such a narrow axis empty
        return Panel(tuple(marks), Axis(label, most=7), y)
    x = Axis(label, (max(left, 0.5 * float(value.min())), right), "logarithmic", most=4)
    return Panel(tuple(marks), x, y)


TICKS = (0.05, 0.1, 0.25, 0.5, 0.67, 0.8, 1.0, 1.25, 1.5, 2.0, 4.0, 10.0, 20.0)
SET_LABELS = {
    "as_is": "as it is",
    "own_loggers": "own loggers",
    "re_estimated": "re-estimated",
    "all_own": "all its own",
    "no_dynamics": "rule: no heat storage",
    "ambient": "rule: c = c_amb",
    "ambient_pressure_balance": "rule: c = c_amb T_amb/T",
}
SET_COLOURS = {
    "as_is": SIMULATED_COLOUR,
    "own_loggers": AMBIENT_COLOUR,
    "re_estimated": COLOURS[1],
    "all_own": MEASURED,
}


def figure_course(found: RecordCourse, re_estimated: bool) -> Picture:
    """Twelve held-out days: readings, the model as it is, and the re-estimated one, or that with its own
    loggers where nothing was re-estimated."""
    chosen = ("as_is", "re_estimated" if re_estimated else "own_loggers")
    lines = {name: (f"simulated, {SET_LABELS[name]}", SET_COLOURS[name]) for name in chosen}
    return figure_courses([Shown("", found, lines)])


def figure_sets(found: TransferResult) -> Picture:
    """Errors of the four sets of values and of the rules in the scored period, with bounds."""
    tables = {
        q: {n: by_set[n] for n in SET_LABELS if n in by_set} for q, by_set in found.rmse.items() if by_set
    }
    if not tables:
        raise NothingToShow("Nothing was scored.")
    panels = []
    for scored, table in tables.items():
        marks: list[Mark] = []
        for place, (name, row) in enumerate(table.items()):
            colour = SET_COLOURS.get(name, QUIET)
            if row.bounds is not None:
                marks.append(bounds(*row.bounds, place, colour))
            mark, size = ("D", 4.5) if name in SET_COLOURS else ("|", 9.0)
            marks.append(point(row.total, place, mark, colour, size))
        panels.append(Panel(tuple(marks), _rmse(scored), rows([SET_LABELS[name] for name in table])))
    return Picture(tuple(panels), 0.75 + 0.2 * max(map(len, tables.values())), columns=len(tables))


def figure_parameters(found: TransferResult) -> Picture:
    """Differences of the cabinet's parameters from those of the fit, with 95 % bounds; differing groups in
    red."""
    panels, most = [], 0
    for kind in ("ratio", "difference"):
        ratio = kind == "ratio"
        changes = {
            _label(name, "" if ratio else row.unit): (row.difference, row.group in found.re_estimate)
            for name, row in found.parameters.items()
            if row.difference is not None and row.difference_is == kind
        }
        if not changes:
            continue
        most = max(most, len(changes))
        marks: list[Mark] = [CrossLine(1.0 if ratio else 0.0, "x", QUIET, 0.8)]
        for place, (change, differs) in enumerate(changes.values()):
            colour = SIMULATED_COLOUR if differs else MEASURED
            marks.append(bounds(change.lower, change.upper, place, colour))
            marks.append(point(change.value, place, "o", colour, 4.0))
        x = Axis("own value less the fit's")
        if ratio:
            margin = math.exp(MATERIAL_DIFFERENCE["ln_time_constant"])
            marks.append(Shade(1.0 / margin, margin, SHADE))
            x = _ratios([end for change, _ in changes.values() for end in (change.lower, change.upper)])
        panels.append(Panel(tuple(marks), x, rows(list(changes))))
    if not panels:
        raise NothingToShow("No parameter of the cabinet could be judged.")
    return Picture(tuple(panels), height_in=0.75 + 0.19 * most, columns=len(panels))


def _label(name: str, unit: str) -> str:
    words = spoken(name.replace("heat_release_", ""))
    return f"{words} [{unit}]" if unit else words


def _ratios(ends: Sequence[float]) -> Axis:
    """Limits that show one and all bounds, neither too narrow nor too wide to read, with plain ratios."""
    reach = max(1.3, 1.1 * max(max(v, 1.0 / v) for v in ends if v > 0))
    low, high = max(1.0 / reach, 0.02), min(reach, 50.0)
    ticks = [t for t in TICKS if low < t < high]
    if high / low > 30:
        ticks = [t for t in ticks if t in (0.05, 0.1, 0.25, 1.0, 4.0, 10.0, 20.0)]
    elif high / low > 3.5:
        ticks = [t for t in ticks if t not in (0.8, 1.25)]
    words = [f"{t:g}" for t in ticks]
    return Axis("own value over the fit's", (low, high), "logarithmic", ticks, words)


def figure_type(found: TurbineType) -> Picture:
    """The time constants of a type with bounds and the range of the next turbine."""
    shown = {
        n: r
        for n, r in found.parameters.items()
        if r.logarithmic and not n.endswith(("_sd", "_time", "_diffusion"))
    }
    if not shown:
        raise NothingToShow("The type has no time constant.")
    marks: list[Mark] = []
    for place, row in enumerate(shown.values()):
        ends = row.in_unit()
        following = bounds(ends["next_lower"], ends["next_upper"], place, RULE, 7.0, 1.0)
        own = bounds(ends["lower"], ends["upper"], place, MEASURED, 2.2, 1.0)
        marks += [replace(following, label="next turbine, 95 %"), replace(own, label="type, 95 %")]
        marks.append(point(ends["value"], place, "o", INK, 4.0))
    labels = rows([f"{spoken(n)} [{r.unit}]" for n, r in shown.items()])
    panel = Panel(tuple(marks), Axis(kind="logarithmic"), labels)
    return Picture((panel,), height_in=0.8 + 0.3 * len(shown))
