"""What the terminal is told of a fleet: each outcome as it comes, and the table at the end."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from hygrokf.data.lookup import number
from hygrokf.fleet.job import DONE, Outcome
from hygrokf.fleet.outliers import FEWEST, spreads
from hygrokf.fleet.tasks import TASKS, Compared
from hygrokf.identification.verdict import REJECT, WORDS
from hygrokf.identification.wording import text_of

SHOWN = 60
"""Turbines of the table at the terminal; the file has all."""


def outcome_text(found: Outcome, known: bool) -> str:
    """One line of one turbine."""
    if found.status != DONE:
        return f"{found.turbine}: {found.status}: {text_of(found.row['reason'])}"
    compared = TASKS[text_of(found.row["task"])].compared
    values = (
        f"{one.title} {WORDS[REJECT]}" if one.rejected(found.row) else f"{one.title} {value:.3g} {one.unit}"
        for one in compared[:2]
        if math.isfinite(value := number(found.row, one.column))
    )
    took = "done before" if known else f"{found.seconds:.1f} s of CPU"
    return f"{found.turbine}: {', '.join([*values, took])}"


def fleet_text(task: str, rows: Sequence[Mapping[str, object]]) -> str:
    """The turbines with what they are compared by, as a fixed-width table; the reason where there is no
    result."""
    compared = [
        one for one in TASKS[task].compared if any(math.isfinite(number(row, one.column)) for row in rows)
    ]
    done = sum(row["status"] == DONE for row in rows)
    heads = [_HEADS.get(one.column, one.title) for one in compared]
    lines = [f"{done} of {len(rows)} turbines with a result", ""]
    width = max([7, *(len(text_of(row["turbine"])) for row in rows)])
    lines.append(f"{'turbine':{width}}" + "".join(f"{head:>22}" for head in heads))
    for row in rows[:SHOWN]:
        name = f"{text_of(row['turbine']):{width}}"
        if row["status"] != DONE:
            lines.append(f"{name}  {row['status']}: {text_of(row['reason'])}")
        else:
            lines.append(name + "".join(f"{_cell(row, one):>22}" for one in compared))
    if len(rows) > SHOWN:
        lines.append(f"… {len(rows) - SHOWN} more in fleet.csv")
    return "\n".join([*lines, *_departing(rows, compared)])


def _departing(rows: Sequence[Mapping[str, object]], compared: Sequence[Compared]) -> list[str]:
    """Who departs from the others, a line each; nothing where there are too few to tell."""
    found = [
        one
        for one in spreads([row for row in rows if row["status"] == DONE], compared)
        if len(one.turbines) >= FEWEST
    ]
    said = [
        f"departs: {one.turbines[i]}, {one.compared.title} {math.exp(one.x[i]):.3g} {one.compared.unit} "
        f"(median {math.exp(one.center):.3g}), chance {one.p[i]:.2g}"
        for one in found
        for i in one.outliers
    ]
    return ["", *(said or ["none departs from the others by more than chance explains"])] if found else []


_HEADS = {
    "thermal_value_h": "thermal [h]",
    "hygric_value_h": "hygric [h]",
    "temperature_rmse_K": "RMSE T [K]",
    "humidity_rmse_g_m3": "RMSE c [g/m³]",
}


def _cell(row: Mapping[str, object], one: Compared) -> str:
    value = number(row, one.column)
    if not math.isfinite(value):
        return "–"
    if one.rejected(row):
        return WORDS[REJECT]
    if not one.lower:
        return f"{value:.2f}"
    low, high = number(row, one.lower), number(row, one.upper)
    ends = f"{low:.2f} … {high:.2f}" if math.isfinite(high) else f"from {low:.2f}"
    return f"{value:.2f} ({ends})"
