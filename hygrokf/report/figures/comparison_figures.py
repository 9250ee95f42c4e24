"""Figures of several turbines: of a comparison, a fleet, a transfer and a type of turbine."""

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
    estimate,
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
"""Regime → its marker, and the size [pt] of this marker."""
BEST = ("|", INK, 9.0)
"""Marker of the best rule."""
COLOURS = (SIMULATED_COLOUR, "#1d7a3a", "#7a3a9a", AMBIENT_COLOUR, QUIET)
LONGEST_LABEL = 30
"""Characters of a label beyond which it is cut."""
MOST_RECORDS = 3
"""Records whose courses fit side by side."""
MEASURED_NAME = "measured"
EXCERPT_S = 12 * DAY_S
"""[s] longest part of a record that is drawn."""


def colour_of(column: int) -> str:
    """Return the colour of a column by its number; blue is left to the readings."""
    return COLOURS[column % len(COLOURS)]


def short_labels(labels: Sequence[str]) -> list[str]:
    """Return labels that fit beside a picture and still differ: long ones are cut in the middle."""
    cut = [
        label
        if len(label) <= LONGEST_LABEL
        else f"{label[: LONGEST_LABEL // 2]}…{label[1 - LONGEST_LABEL // 2 :]}"
        for label in labels
    ]
    return [label if cut.count(label) == 1 else f"{number + 1}: {label}" for number, label in enumerate(cut)]


@dataclass(frozen=True)
class Shown:
    """A record to draw: readings, and simulations by `lines`: name in the course → (label, colour)."""

    title: str
    course: RecordCourse
    lines: Mapping[str, tuple[str, str]]

    @property
    def span(self) -> tuple[float, float]:
        """The first held-out days [s since 1970], at most `EXCERPT_S`; the first days of the record where
        less than one day is held out."""
        first, last = float(self.course.time_s[0]), float(self.course.time_s[-1])
        begin = self.course.until_s if self.course.until_s < last - DAY_S else first
        return begin, min(begin + EXCERPT_S, last)

    def has(self, quantity: str) -> bool:
        """Return whether the record has readings of a quantity."""
        return bool(np.isfinite(self.course.measured.get(quantity, np.empty(0))).any())


def figure_courses(records: Sequence[Shown]) -> Picture:
    """Twelve days of each record: a row for each quantity, a column for each record."""
    quantities = [name for name in SCORED if any(record.has(name) for record in records)]
    if not quantities:
        raise NothingToShow("There are no readings to show.")
    panels = []
    for name in quantities:
        terms = quantity(name)
        label = terms.level.replace(" ", "\n", terms.words.count(" "))
        for record in records:
            series = {MEASURED_NAME: record.course.measured, **record.course.simulated}
            marks = []
            for line, (line_label, colour) in {MEASURED_NAME: ("reading", MEASURED), **record.lines}.items():
                if name in series[line]:
                    value, width = series[line][name] - terms.zero, 1.3 if line == MEASURED_NAME else 0.9
                    marks.append(course(record.course.time_s, value, record.span, colour, width, line_label))
            x = Axis(limits=record.span, kind="time", most=9 // len(records) + 1)
            title = record.title if name == quantities[0] and len(records) > 1 else ""
            panels.append(Panel(tuple(marks), x, Axis(label), title))
    height_in = 3.0 if len(quantities) > 1 else 3.4
    return Picture(tuple(panels), height_in, columns=len(records), shared="xy")


def figure_column_courses(results: ComparisonResults, courses: Sequence[RecordCourse]) -> Picture:
    """Draw readings and simulations; columns with the same case and instants share a panel."""
    if not courses:
        raise NothingToShow(
            "These results hold no courses: `hygrokf compare` adds them when it is run again."
        )
    groups: dict[tuple[str, bytes], list[int]] = {}
    for number, (column, record_course) in enumerate(zip(results.columns, courses, strict=True)):
        groups.setdefault((column.case, record_course.time_s.tobytes()), []).append(number)
    labels = short_labels([column.label for column in results.columns])
    panels = []
    for (case, _), group in list(groups.items())[:MOST_RECORDS]:
        is_alone = sum(other == case for other, _ in groups) == 1
        simulated = {f"column {number}": courses[number].simulated["simulated"] for number in group}
        lines = {f"column {number}": (labels[number], colour_of(number)) for number in group}
        title = short_labels([case])[0] if is_alone else labels[group[0]]
        panels.append(Shown(title, replace(courses[group[0]], simulated=simulated), lines))
    return figure_courses(panels)


def figure_errors(results: ComparisonResults, period: str) -> Picture:
    """Draw the root mean squared error of every column in one period, by regime, with bounds, and the total
    error of the best rule."""
    scored = {name: errors for name in SCORED if (errors := results.errors(period, name))}
    columns = [
        column for column in results.columns if any(column.label in errors for errors in scored.values())
    ]
    if not columns:
        raise NothingToShow("Nothing was scored in this period.")
    labels = rows(short_labels([column.label for column in columns]))
    panels = []
    for name in scored:
        marks: list[Mark] = []
        for row_number, column in enumerate(columns):
            colour = colour_of(results.columns.index(column))
            for height, (regime, (mark, size)) in zip(
                (-0.22, 0.0, 0.22), REGIME_MARKERS.items(), strict=True
            ):
                row = results.row("rmse", column.label, period, name, regime)
                if not row.n:
                    continue
                at = row_number + height
                marks += estimate(row.value, row.lower, row.upper, at, colour, mark, size)
            key_of_rules = ("rule", column.label, name, period, "total")
            rule_errors = [
                row.value
                for row in results.rows
                if (row.kind, row.column, row.quantity, row.period, row.regime) == key_of_rules
            ]
            if rule_errors:
                marks.append(point(min(rule_errors), row_number + 0.22, *BEST))
        panels.append(Panel(tuple(marks), _rmse(name), labels))
    key_marks = tuple(
        replace(point(0.0, 0.0, mark, INK, size), label=label)
        for label, (mark, size) in {**REGIME_MARKERS, "best rule": ("|", 9.0)}.items()
    )
    return Picture(tuple(panels), 1.1 + 0.34 * len(columns), columns=len(scored), shared="y", key=key_marks)


def _rmse(quantity_name: str) -> Axis:
    """Return the axis of root mean squared errors of a quantity, from zero."""
    return Axis(quantity(quantity_name).rmse, (0.0, None))


def figure_weeks(results: ComparisonResults) -> Picture:
    """Draw the root mean squared error of every column by week."""
    middles_of = {
        name: [column.weeks[name][0] for column in results.columns if name in column.weeks] for name in SCORED
    }
    quantities = [name for name in SCORED if any(len(middles) > 1 for middles in middles_of[name])]
    if not quantities:
        raise NothingToShow("There are fewer than two weeks to show.")
    week_middles = [middles for name in quantities for middles in middles_of[name]]
    first_and_last = [(middle_s[0], middle_s[-1]) for middle_s in week_middles if len(middle_s)]
    span = (
        min(first for first, _ in first_and_last) - WEEK_S / 2,
        max(last for _, last in first_and_last) + WEEK_S / 2,
    )
    labels = short_labels([column.label for column in results.columns])
    panels = [
        Panel(
            tuple(
                Curve(column.weeks[name][0], column.weeks[name][1], colour_of(number), 0.9, label, "o", 2.6)
                for number, (column, label) in enumerate(zip(results.columns, labels, strict=True))
                if name in column.weeks
            ),
            Axis(limits=span, kind="time", most=9),
            Axis(quantity(name).change, (0.0, None)),
        )
        for name in quantities
    ]
    return Picture(tuple(panels), height_in=0.6 + 1.5 * len(quantities), shared="x")


MOST_NAMED_ROWS = 45
"""Turbines up to which every one has its name beside its row."""


def figure_spreads(scatters: Sequence[Scatter]) -> Picture:
    """Draw a panel for each quantity: turbines from the smallest to the largest value, with bounds as lines
    and outliers in red.

    The shade is where 95 % of turbines would lie if their values were known exactly: the median, and the
    spread between turbines. There is no shade if the bounds explain all of the spread.
    """
    scatters_drawn = [scatter for scatter in scatters if len(scatter.turbines)]
    if not scatters_drawn:
        raise NothingToShow("No turbine has a value with bounds.")
    most_turbines = max(len(scatter.turbines) for scatter in scatters_drawn)
    height = 0.95 + (
        0.155 * most_turbines
        if most_turbines <= MOST_NAMED_ROWS
        else min(0.155 * MOST_NAMED_ROWS, 0.03 * most_turbines + 3.0)
    )
    panels = tuple(_spread(scatter, most_turbines) for scatter in scatters_drawn)
    return Picture(panels, height_in=max(height, 1.9), columns=len(scatters_drawn))


def _spread(scatter: Scatter, most_turbines: int) -> Panel:
    """The panel of one quantity; most_turbines: largest number of turbines in a panel of the figure."""
    is_named = most_turbines <= MOST_NAMED_ROWS
    order = np.argsort(scatter.x)
    value, error = np.exp(scatter.x[order]), scatter.error[order]
    heights = np.arange(len(order))
    is_outlier = np.isin(order, scatter.outliers)
    low, high = np.exp(
        [scatter.center - INTERVAL_SD * scatter.between, scatter.center + INTERVAL_SD * scatter.between]
    )
    bounded = np.isfinite(error).all()
    marks: list[Mark] = []
    for chosen, colour, label in (
        (~is_outlier, MEASURED, "turbine"),
        (is_outlier, SIMULATED_COLOUR, "outlier"),
    ):
        if not chosen.any():
            continue
        if bounded:
            ends = value[chosen] * np.exp(np.outer([-INTERVAL_SD, INTERVAL_SD], error[chosen]))
            width = 1.1 if is_named else 0.5
            marks.append(strokes(ends[0], heights[chosen], ends[1], heights[chosen], colour, width))
            label = f"{label}, 95 % bounds" if label == "turbine" else label
        size = 3.2 if is_named else 1.4
        marks.append(Curve(value[chosen], heights[chosen], colour, 0.0, label, "o", size))
    marks.append(CrossLine(float(np.exp(scatter.center)), "x", QUIET, 0.8, label="median"))
    if scatter.between > 0:
        marks.append(Shade(low, high, SHADE, label="95 % of turbines"))
    limits = (-0.8, max(most_turbines, 2) - 0.2)
    y = Axis(
        f"{len(order)} turbines, from the least to the largest", limits, at=(-0.8,), words=("",), grid=False
    )
    if is_named:
        names = [scatter.turbines[i] for i in order]
        short_names = [name if len(name) <= 18 else f"{name[:17]}…" for name in names]
        y = Axis(limits=limits, at=heights, words=short_names, grid=False)
    label = f"{scatter.compared.title} [{scatter.compared.unit}]"
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


def figure_course(record_course: RecordCourse, re_estimated: bool) -> Picture:
    """Draw twelve held-out days: readings, the model as it is, and the re-estimated model (where nothing was
    re-estimated, the model with own loggers)."""
    names = ("as_is", "re_estimated" if re_estimated else "own_loggers")
    lines = {name: (f"simulated, {SET_LABELS[name]}", SET_COLOURS[name]) for name in names}
    return figure_courses([Shown("", record_course, lines)])


def figure_sets(result: TransferResult) -> Picture:
    """Draw the errors of the four sets of values and of the rules in the scored period, with bounds."""
    errors_by_quantity = {
        quantity_name: {name: by_set[name] for name in SET_LABELS if name in by_set}
        for quantity_name, by_set in result.rmse.items()
        if by_set
    }
    if not errors_by_quantity:
        raise NothingToShow("Nothing was scored.")
    panels = []
    for quantity_name, errors_by_set in errors_by_quantity.items():
        marks: list[Mark] = []
        for row_number, (name, row) in enumerate(errors_by_set.items()):
            colour = SET_COLOURS.get(name, QUIET)
            low, high = row.bounds or (math.nan, math.nan)
            marker, size = ("D", 4.5) if name in SET_COLOURS else ("|", 9.0)
            marks += estimate(row.total, low, high, row_number, colour, marker, size)
        panels.append(
            Panel(tuple(marks), _rmse(quantity_name), rows([SET_LABELS[name] for name in errors_by_set]))
        )
    most_rows = max(map(len, errors_by_quantity.values()))
    return Picture(tuple(panels), 0.75 + 0.2 * most_rows, columns=len(errors_by_quantity))


def figure_parameters(result: TransferResult) -> Picture:
    """Draw the parameters' differences from those of the fit with 95 % bounds; differing groups in red."""
    panels, most_rows = [], 0
    for kind in ("ratio", "difference"):
        is_ratio = kind == "ratio"
        changes = {
            _label(name, "" if is_ratio else row.unit): (row.difference, row.group in result.re_estimate)
            for name, row in result.parameters.items()
            if row.difference is not None and row.difference_is == kind
        }
        if not changes:
            continue
        most_rows = max(most_rows, len(changes))
        marks: list[Mark] = [CrossLine(1.0 if is_ratio else 0.0, "x", QUIET, 0.8)]
        for row_number, (change, differs) in enumerate(changes.values()):
            colour = SIMULATED_COLOUR if differs else MEASURED
            marks += estimate(change.value, change.lower, change.upper, row_number, colour)
        x = Axis("own value less the fit's")
        if is_ratio:
            margin = math.exp(MATERIAL_DIFFERENCE["ln_time_constant"])
            marks.append(Shade(1.0 / margin, margin, SHADE))
            x = _ratios([bound for change, _ in changes.values() for bound in (change.lower, change.upper)])
        panels.append(Panel(tuple(marks), x, rows(list(changes))))
    if not panels:
        raise NothingToShow("No parameter of the cabinet could be judged.")
    return Picture(tuple(panels), height_in=0.75 + 0.19 * most_rows, columns=len(panels))


def _label(name: str, unit: str) -> str:
    """Return the name of a parameter in words, with its unit."""
    words = spoken(name.replace("heat_release_", ""))
    return f"{words} [{unit}]" if unit else words


def _ratios(bounds_shown: Sequence[float]) -> Axis:
    """Return a logarithmic axis of ratios that includes the bounds, within 0.02 … 50, with ticks at plain
    numbers."""
    largest_ratio = max(1.3, 1.1 * max(max(bound, 1.0 / bound) for bound in bounds_shown if bound > 0))
    low, high = max(1.0 / largest_ratio, 0.02), min(largest_ratio, 50.0)
    ticks = [tick for tick in TICKS if low < tick < high]
    if high / low > 30:
        ticks = [tick for tick in ticks if tick in (0.05, 0.1, 0.25, 1.0, 4.0, 10.0, 20.0)]
    elif high / low > 3.5:
        ticks = [tick for tick in ticks if tick not in (0.8, 1.25)]
    words = [f"{tick:g}" for tick in ticks]
    return Axis("own value over the fit's", (low, high), "logarithmic", ticks, words)


def figure_type(turbine_type: TurbineType) -> Picture:
    """Draw the time constants of a type of turbine with their bounds, and the range of the next turbine."""
    constants = {
        name: row
        for name, row in turbine_type.parameters.items()
        if row.logarithmic and not name.endswith(("_sd", "_time", "_diffusion"))
    }
    if not constants:
        raise NothingToShow("The type has no time constant.")
    marks: list[Mark] = []
    for row_number, row in enumerate(constants.values()):
        in_unit = row.in_unit()
        next_turbine = bounds(in_unit["next_lower"], in_unit["next_upper"], row_number, RULE, 7.0, 1.0)
        of_type = bounds(in_unit["lower"], in_unit["upper"], row_number, MEASURED, 2.2, 1.0)
        marks += [replace(next_turbine, label="next turbine, 95 %"), replace(of_type, label="type, 95 %")]
        marks.append(point(in_unit["value"], row_number, "o", INK, 4.0))
    labels = rows([f"{spoken(name)} [{row.unit}]" for name, row in constants.items()])
    panel = Panel(tuple(marks), Axis(kind="logarithmic"), labels)
    return Picture((panel,), height_in=0.8 + 0.3 * len(constants))
