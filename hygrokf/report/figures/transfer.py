"""Figures of comparisons and transfers: errors with bounds, errors by week, what differs, what re-estimating changes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.data.lookup import array, entry, instants, number, scalar
from hygrokf.report.figures.drawing import (
    AMBIENT,
    INK,
    MEASURED,
    QUIET,
    RULE,
    SHADE,
    SIMULATED,
    NothingToShow,
    calendar,
    days,
    envelope,
    key,
    logarithmic,
    new_figure,
    styled,
    upright,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

QUANTITIES = {"temperature_K": ("temperature", "K"), "absolute_humidity_g_m3": ("absolute humidity", "g/m³")}
REGIMES = {"operation": "o", "standstill": "s", "total": "D"}
COLOURS = (MEASURED, SIMULATED, "#1d7a3a", "#7a3a9a", AMBIENT, QUIET)
RE_ESTIMATED = "#1d7a3a"
LONGEST = 30
"""Characters of a label beyond which it is cut."""
EXCERPT_S = 12 * 86400.0


def colour_of(place: int) -> str:
    """Colour of the column at a place."""
    return COLOURS[place % len(COLOURS)]


def short(label: str) -> str:
    """A label that fits beside a picture."""
    return label if len(label) <= LONGEST else f"{label[: LONGEST - 1]}…"


# --- comparisons -----------------------------------------------------------------------------


def figure_errors(found: Mapping, period: str) -> Figure:
    """Root mean squared errors of all columns in one period with bounds, by regime; the best rule's beside them."""
    columns = [one for one in found["columns"] if any(_row(one, period, q, "total") for q in QUANTITIES)]
    if not columns:
        raise NothingToShow("Nothing was scored in this period.")
    shown = [q for q in QUANTITIES if any(_row(one, period, q, "total") for one in columns)]
    with styled():
        figure = new_figure(1.1 + 0.34 * len(columns))
        grid = figure.add_gridspec(
            1,
            len(shown),
            wspace=0.08,
            left=0.27,
            right=0.985,
            top=0.78,
            bottom=0.42 / (1.1 + 0.34 * len(columns)),
        )
        for place, quantity in enumerate(shown):
            axes = figure.add_subplot(grid[place])
            for i, one in enumerate(columns):
                _errors_row(
                    axes, one, period, quantity, len(columns) - 1 - i, colour_of(found["columns"].index(one))
                )
            name, unit = QUANTITIES[quantity]
            axes.set_ylim(-0.6, len(columns) - 0.4)
            axes.set_yticks(
                range(len(columns)), [short(one["label"]) for one in reversed(columns)] if place == 0 else []
            )
            axes.grid(axis="y", visible=False)
            axes.set_xlim(left=0.0)
            axes.set_xlabel(f"RMSE of the {name} [{unit}]")
            if place == 0:
                handles = [
                    axes.plot([], [], mark, color=INK, markersize=3.5, linestyle="none", label=regime)[0]
                    for regime, mark in REGIMES.items()
                ]
                handles.append(
                    axes.plot(
                        [],
                        [],
                        "|",
                        color=INK,
                        markersize=9,
                        markeredgewidth=1.4,
                        linestyle="none",
                        label="best simple rule",
                    )[0]
                )
                key(axes, handles, anchor=(0.0, 1.03))
    return figure


def _row(one: Mapping, period: str, quantity: str, regime: str) -> Mapping | None:
    row = entry(one, "scores", period, quantity, regime)
    return row if isinstance(row, Mapping) and math.isfinite(number(row, "rmse")) else None


def _errors_row(axes: Axes, one: Mapping, period: str, quantity: str, height: float, colour: str) -> None:
    for offset, (regime, mark) in zip((0.22, 0.0, -0.22), REGIMES.items(), strict=True):
        row = _row(one, period, quantity, regime)
        if row is None:
            continue
        low, high = number(row, "lower"), number(row, "upper")
        if math.isfinite(low) and math.isfinite(high):
            axes.plot([low, high], [height + offset] * 2, color=colour, linewidth=1.3, alpha=0.55)
        axes.plot(
            row["rmse"], height + offset, mark, color=colour, markersize=4.0 if regime == "total" else 3.4
        )
        rules = [number(rule, "rmse") for rule in (row.get("rules") or {}).values()]
        rules = [v for v in rules if math.isfinite(v)]
        if rules and regime == "total":
            axes.plot(min(rules), height + offset, "|", color=INK, markersize=9, markeredgewidth=1.4)


def figure_weeks(weeks: Sequence[tuple[str, Mapping[str, tuple[np.ndarray, np.ndarray]]]]) -> Figure:
    """Errors by week: pairs of a column's label and, by quantity, middles [s] and RMSE of its weeks."""
    shown = [q for q in QUANTITIES if any(len(by.get(q, ((),))[0]) > 1 for _, by in weeks)]
    if not shown:
        raise NothingToShow("There are fewer than two weeks to show.")
    ends = [by[q][0][[0, -1]] for _, by in weeks for q in shown if q in by and len(by[q][0])]
    span = (min(e[0] for e in ends) - 302400.0, max(e[1] for e in ends) + 302400.0)
    with styled():
        figure = new_figure(0.6 + 1.5 * len(shown))
        grid = figure.add_gridspec(
            len(shown),
            1,
            hspace=0.16,
            left=0.07,
            right=0.985,
            top=0.9,
            bottom=0.15 if len(shown) > 1 else 0.25,
        )
        for place, quantity in enumerate(shown):
            axes = figure.add_subplot(grid[place])
            handles = []
            for i, (label, by) in enumerate(weeks):
                if quantity in by:
                    middle, value = by[quantity]
                    handles += axes.plot(
                        days(middle), value, "-o", color=colour_of(i), markersize=2.6, label=short(label)
                    )
            name, unit = QUANTITIES[quantity]
            axes.set_ylim(bottom=0.0)
            upright(axes, f"{name} [{unit}]")
            calendar(axes, span, labels=place == len(shown) - 1)
            if place == 0:
                key(axes, handles, columns=min(len(handles), 4))
    return figure


# --- transfers -------------------------------------------------------------------------------

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


def figure_sets(found: Mapping) -> Figure:
    """Errors of the four sets of values and of the rules in the scored period, with bounds."""
    tables = {q: rows for q in QUANTITIES if isinstance(rows := entry(found, "rmse", q), Mapping) and rows}
    if not tables:
        raise NothingToShow("Nothing was scored.")
    most = max(len(rows) for rows in tables.values())
    height = 0.75 + 0.2 * most
    with styled():
        figure = new_figure(height)
        grid = figure.add_gridspec(
            1, len(tables), wspace=0.72, left=0.17, right=0.985, top=0.97, bottom=0.42 / height
        )
        for place, (quantity, rows) in enumerate(tables.items()):
            axes = figure.add_subplot(grid[place])
            names = [name for name in SETS if name in rows]
            for i, name in enumerate(names):
                at, colour = len(names) - 1 - i, SET_COLOURS.get(name, QUIET)
                bounds = rows[name].get("bounds")
                if bounds:
                    axes.plot(bounds, [at, at], color=colour, linewidth=1.6, alpha=0.55)
                axes.plot(
                    number(rows, name, "total"),
                    at,
                    "D" if name in SET_COLOURS else "|",
                    color=colour,
                    markersize=4.5,
                )
            axes.set_yticks(range(len(names)), [SETS[name] for name in reversed(names)])
            axes.set_ylim(-0.6, len(names) - 0.4)
            axes.grid(axis="y", visible=False)
            axes.set_xlim(left=0.0)
            axes.set_xlabel("RMSE of the {} [{}]".format(*QUANTITIES[quantity]))
    return figure


def figure_parameters(found: Mapping) -> Figure:
    """By how much the cabinet's parameters differ from those of the fit, with 95 % bounds; differing groups in red."""
    rows = entry(found, "parameters")
    rows = rows if isinstance(rows, Mapping) else {}
    judged = {name: row for name, row in rows.items() if isinstance(entry(row, "difference"), Mapping)}
    ratios = {n: r for n, r in judged.items() if r.get("difference_is") == "ratio"}
    others = {n: r for n, r in judged.items() if n not in ratios}
    panels = [part for part in (ratios, others) if part]
    if not panels:
        raise NothingToShow("No parameter of the cabinet could be judged.")
    differing = set(found.get("re_estimate") or ())
    height = 0.75 + 0.19 * max(len(part) for part in panels)
    with styled():
        figure = new_figure(height)
        grid = figure.add_gridspec(
            1, len(panels), wspace=0.85, left=0.18, right=0.985, top=0.92, bottom=0.42 / height
        )
        for place, part in enumerate(panels):
            axes = figure.add_subplot(grid[place])
            ratio = part is ratios
            if ratio:
                margin = math.exp(number(found, "matters", "ln_time_constant"))
                if math.isfinite(margin):
                    axes.axvspan(1.0 / margin, margin, color=SHADE, zorder=0)
            axes.axvline(1.0 if ratio else 0.0, color=QUIET, linewidth=0.8, zorder=1)
            for i, (_, row) in enumerate(part.items()):
                colour = SIMULATED if row.get("group") in differing else MEASURED
                d, at = row["difference"], len(part) - 1 - i
                axes.plot([d["lower"], d["upper"]], [at, at], color=colour, linewidth=1.6, alpha=0.6)
                axes.plot(d["value"], at, "o", color=colour, markersize=4)
            labels = [n.replace("heat_release_", "").replace("_", " ") for n in part]
            labels = [
                f"{label} [{row['unit']}]" if not ratio else label
                for label, row in zip(labels, part.values(), strict=True)
            ]
            axes.set_yticks(range(len(part)), labels[::-1])
            axes.set_ylim(-0.6, len(part) - 0.4)
            axes.grid(axis="y", visible=False)
            axes.set_xlabel("own value over the fit's" if ratio else "own value less the fit's")
            if ratio:
                _around(axes, part)
                logarithmic(axes, "x")
                _plain_ratios(axes)
    return figure


def _around(axes: Axes, part: Mapping[str, Mapping]) -> None:
    """Limits that show one and all bounds, of a width that is worth looking at."""
    ends = [v for row in part.values() for v in (row["difference"]["lower"], row["difference"]["upper"])]
    reach = max(1.3, 1.1 * max(max(v, 1.0 / v) for v in ends if v > 0))
    axes.set_xlim(max(1.0 / reach, 0.02), min(reach, 50.0))


def _plain_ratios(axes: Axes) -> None:
    from matplotlib.ticker import FixedLocator

    low, high = axes.get_xlim()
    ticks = [
        t for t in (0.05, 0.1, 0.25, 0.5, 0.67, 0.8, 1.0, 1.25, 1.5, 2.0, 4.0, 10.0, 20.0) if low < t < high
    ]
    if high / low > 30:
        ticks = [t for t in ticks if t in (0.05, 0.1, 0.25, 1.0, 4.0, 10.0, 20.0)]
    elif high / low > 3.5:
        ticks = [t for t in ticks if t not in (0.8, 1.25)]
    axes.xaxis.set_major_locator(FixedLocator(ticks))


def figure_course(series: Mapping[str, np.ndarray], re_estimated: bool) -> Figure:
    """Twelve held-out days: readings, the model as it is and, where something was re-estimated, the re-estimated one."""
    time = instants(series)
    until = scalar(series, "until_s")
    shown = [q for q in QUANTITIES if np.isfinite(array(series, f"{q}_measured")).any()]
    if not len(time) or not shown:
        raise NothingToShow("There are no readings to show.")
    first = until if math.isfinite(until) and until < time[-1] - 86400.0 else time[0]
    last = min(first + EXCERPT_S, time[-1])
    sets = {"as_is": "as it is"} | (
        {"re_estimated": "re-estimated"} if re_estimated else {"own_loggers": "own loggers"}
    )
    with styled():
        figure = new_figure(0.6 + 1.45 * len(shown))
        grid = figure.add_gridspec(len(shown), 1, hspace=0.16, left=0.07, right=0.985, top=0.91, bottom=0.13)
        for place, quantity in enumerate(shown):
            axes = figure.add_subplot(grid[place])
            handles = []
            shift = 273.15 if quantity == "temperature_K" else 0.0
            lines = {"measured": ("reading", MEASURED, 1.3)}
            lines |= {name: (f"simulated, {words}", SET_COLOURS[name], 0.9) for name, words in sets.items()}
            for name, (words, colour, width) in lines.items():
                x, y = envelope(time, array(series, f"{quantity}_{name}") - shift, (first, last))
                handles += axes.plot(days(x), y, color=colour, linewidth=width, label=words)
            name, unit = QUANTITIES[quantity]
            upright(axes, f"{name} [{'°C' if shift else unit}]")
            calendar(axes, (first, last), labels=place == len(shown) - 1)
            if place == 0:
                key(axes, handles)
    return figure


def figure_type(found: Mapping) -> Figure:
    """Type-level values with bounds and the range of the next turbine, as ratios to the type's value."""
    rows = entry(found, "type_parameters")
    rows = rows if isinstance(rows, Mapping) else {}
    shown = {
        n: r
        for n, r in rows.items()
        if r.get("logarithmic") and not n.endswith(("_sd", "_time", "_diffusion"))
    }
    if not shown:
        raise NothingToShow("The type has no time constant.")
    height = 0.8 + 0.3 * len(shown)
    with styled():
        figure = new_figure(height)
        axes = figure.add_axes((0.2, 0.45 / height, 0.785, 1.0 - 0.78 / height))
        for i, (_, row) in enumerate(shown.items()):
            at, ends = len(shown) - 1 - i, row["in_unit"]
            axes.plot([ends["next_lower"], ends["next_upper"]], [at, at], color=RULE, linewidth=7.0)
            axes.plot([ends["lower"], ends["upper"]], [at, at], color=MEASURED, linewidth=2.2)
            axes.plot(ends["value"], at, "o", color=INK, markersize=4)
        axes.set_yticks(
            range(len(shown)), [f"{n.replace('_', ' ')} [{r['unit']}]" for n, r in reversed(shown.items())]
        )
        axes.set_ylim(-0.6, len(shown) - 0.4)
        axes.grid(axis="y", visible=False)
        logarithmic(axes, "x")
        handles = [
            axes.plot([], [], color=RULE, linewidth=7.0, label="next turbine, 95 %")[0],
            axes.plot([], [], color=MEASURED, linewidth=2.2, label="type, 95 %")[0],
        ]
        key(axes, handles)
    return figure
