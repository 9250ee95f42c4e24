"""The page of a fleet: failures, turbines that depart from the others, the spread, a ranking."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

from hygrokf.data.files import FLEET, REPORT, write_text_whole
from hygrokf.data.record import Provenance
from hygrokf.data.result_file import ResultFault, read_result
from hygrokf.estimation.conventions import SIGNIFICANCE
from hygrokf.fleet.fleet_results import CSV, FleetResults
from hygrokf.fleet.job import DONE, Row, cell_number, cell_text
from hygrokf.fleet.outliers import FEWEST_JUDGED, SIMULATED_FLEETS, Scatter, spreads
from hygrokf.fleet.tasks import TASKS, Compared, Tally, Task
from hygrokf.report.blocks import (
    Banner,
    Block,
    Card,
    Cards,
    Details,
    Figure,
    Page,
    Prose,
    Table,
    method,
    section,
    table_or,
)
from hygrokf.report.figures.comparison_figures import figure_spreads
from hygrokf.report.page import page_html
from hygrokf.report.quantities import interval, spoken, versions
from hygrokf.report.transfer_page import type_section
from hygrokf.texts.reasons import REJECT, WORDS
from hygrokf.texts.wording import NONE, decimals_for, fixed, moment, one_line, percent, plain_number, sentence

RANKED = 50
"""Rows of the ranking on the page; fleet.csv has all."""
TALLIED = 12
"""Values of a column that the page counts, those of most turbines first."""
MOST_NAMED_TURBINES = 20
"""Turbines that are named; of more the first."""
LEFT_OUT = "Left out, because they differ from the others by more than chance:"
FAILURE = ("turbine", "status", "reason")
"""Columns that report a turbine without a result."""


def write_fleet_report(out: Path) -> Path:
    """Write `report.html` of a directory with `fleet.json`; returns its path.

    Raises ResultFault where fleet.json is missing or damaged.
    """
    file = out / FLEET
    fleet = read_result(FleetResults, file, "hygrokf fleet")
    named = [row.get("turbine") for row in fleet.rows]
    if fleet.task not in TASKS or None in named or len(named) != len(set(named)):
        raise ResultFault(f"{file}: expected rows of a task of this version; run `hygrokf fleet` again")
    return write_text_whole(out / REPORT, page_html(fleet_blocks(fleet)))


def outcome_text(row: Row, known: bool) -> str:
    """A line on the outcome of one turbine; known: whether it was on disk already."""
    turbine, status = cell_text(row, "turbine"), cell_text(row, "status")
    if status != DONE:
        return f"{turbine}: {status}: {cell_text(row, 'reason')}"
    values = (
        f"{quantity.title} {WORDS[REJECT]}"
        if quantity.rejected(row)
        else f"{quantity.title} {value:.3g} {quantity.unit}"
        for quantity in TASKS[cell_text(row, "task")].compared[:2]
        if math.isfinite(value := cell_number(row, quantity.column))
    )
    return f"{turbine}: {', '.join([*values, 'done before' if known else 'done'])}"


def fleet_blocks(fleet: FleetResults) -> Page:
    """The page of a fleet."""
    task, done = TASKS[fleet.task], fleet.done
    found = spreads(done, task.compared)
    pictures = _pictures(found)
    cards = Cards(tuple(_cards(fleet, found)))
    ranking = _ranking(task, done, found)
    left_out = ", ".join(fleet.type_without)
    body = (
        *_failures(fleet),
        *section("Outliers", _outliers(found)),
        *section("What was found", _tallies(task.tallies, done)),
        *section("Spread over the fleet", *pictures[1:], *_set_aside(found)),
        *type_section(fleet.type, Prose(f"{LEFT_OUT} {left_out}.", "note") if left_out else None),
        *section("Ranking", Details("Every turbine", (ranking,), printed=True) if ranking else None),
    )
    return Page(
        f"Fleet report, {fleet.task}",
        one_line(fleet.name) or "unnamed fleet",
        (f"{sentence(task.meaning)} {moment(fleet.created)} UTC.",),
        (
            *_unmeasured(done),
            cards,
            *pictures[:1],
        ),
        body,
        _method(fleet),
    )


# --- the answer ------------------------------------------------------------------------------


OF_FLEET = {
    Provenance.SIMULATED: "hold readings in the cabinet that a model computed.",
    Provenance.SYNTHETIC: "were made by a computer. Nothing of them was measured.",
}


def _unmeasured(done: Sequence[Row]) -> Iterator[Banner]:
    """Warnings about the records that were not measured."""
    for provenance, text in OF_FLEET.items():
        count = sum(row.get("provenance") == provenance for row in done)
        which = "All records" if count == len(done) else f"{count} of {len(done)} records"
        if count:
            yield Banner(provenance.upper(), f"{which} {text}")


def _cards(fleet: FleetResults, found: Sequence[Scatter]) -> list[Card]:
    failed = len(fleet.missing)
    text = f"{failed} without: the reasons are below" if failed else "every turbine has a result"
    value = f"{len(fleet.done)} of {len(fleet.rows)}"
    cards = [_card("Turbines with a result", value, sentence(text), failed > 0)]
    odd = sorted({scatter.turbines[i] for scatter in found for i in scatter.outliers})
    if any(len(scatter.turbines) >= FEWEST_JUDGED for scatter in found):
        names = ", ".join(odd) if len(odd) <= 4 else f"{len(odd)} turbines, listed below"
        text = names or "no turbine differs from the others by more than chance"
        cards.append(_card("Outliers", str(len(odd)), sentence(text), bool(odd)))
    return cards + [_spread_card(scatter) for scatter in found if scatter.compared.lower and scatter.turbines]


def _spread_card(one: Scatter) -> Card:
    middle, low, high = (math.exp(v) for v in (one.center, one.x.min(), one.x.max()))
    unit = one.compared.unit
    decimals = min(decimals_for(high - low) + 1, 3) if high > low else 2
    if len(one.turbines) < 3:
        between = "too few turbines for a spread"
    elif one.between > 0.005:
        between = f"standard deviation between turbines {percent(one.between)}, beyond their bounds"
    elif one.explained:
        between = "the bounds explain all of the spread between turbines"
    else:
        between = "most turbines agree within their bounds, but not all"
    if one.outliers:
        between = f"apart from {', '.join(one.turbines[i] for i in one.outliers[:4])}: {between}"
    digits = partial(fixed, decimals=decimals)
    text = f"{interval(low, high, digits, unit)} over {len(one.turbines)} turbines; {between}."
    return _card(f"{one.compared.title.capitalize()}, median", f"{digits(middle)} {unit}", text)


def _card(label: str, value: str, text: str, warning: bool = False) -> Card:
    return Card(label, value, lines=(text,), tone="open" if warning else "plain")


def _pictures(found: Sequence[Scatter]) -> list[Figure]:
    constants = [scatter for scatter in found if scatter.compared.lower]
    errors = [scatter for scatter in found if not scatter.compared.lower]
    pictures = []
    if constants:
        hours = all(constant.compared.unit == "h" for constant in constants)
        heading = "Time constants" if hours else "Climate of a year"
        caption = (
            "The bounds of turbines of one type should overlap the shaded range, or include the median "
            "if nothing is shaded."
        )
        pictures.append(Figure("constants", heading, caption, partial(figure_spreads, constants)))
    if errors:
        caption = "Turbines far to the right have larger simulation errors."
        pictures.append(Figure("errors", "Free-run errors", caption, partial(figure_spreads, errors)))
    return pictures


# --- sections --------------------------------------------------------------------------------


def _failures(fleet: FleetResults) -> tuple[Block, ...]:
    if not fleet.missing:
        return ()
    cells = tuple(tuple(cell_text(row, name) for name in FAILURE) for row in fleet.missing)
    return section(
        "Without a result",
        Table("Turbines and reasons", FAILURE, cells, left=(0, 1, 2)),
        Prose("Correct the faults and run the fleet again: finished turbines are not repeated."),
    )


def _outliers(found: Sequence[Scatter]) -> Block | None:
    """The outliers; None where there are too few turbines to tell."""
    judged = [scatter for scatter in found if len(scatter.turbines) >= FEWEST_JUDGED]
    if not judged:
        return None
    least = 2.0 * len(found) / SIMULATED_FLEETS
    rows = tuple(
        (
            scatter.turbines[i],
            f"{scatter.compared.title} [{scatter.compared.unit}]",
            f"{math.exp(scatter.x[i]):.3g}",
            f"{math.exp(scatter.center):.3g}",
            f"{100 * math.expm1(scatter.x[i] - scatter.center):+.0f} %",
            f"{scatter.p[i]:.2g}" if scatter.p[i] > least else f"< {least:.1g}",
        )
        for scatter in judged
        for i in scatter.outliers
    )
    head = ("turbine", "quantity", "value", "median", "deviation", "chance")
    return table_or(
        Table("Outliers", head, rows, left=(0, 1)) if rows else None,
        "No turbine differs from the others by more than chance and its bounds explain.",
    )


def _tallies(tallies: Sequence[Tally], done: Sequence[Row]) -> Table:
    """The values of each column, those of most turbines first, with their turbines."""
    rows: list[tuple[str, ...]] = []
    for tally in tallies:
        having: dict[str, list[str]] = {}
        for row in done:
            cell = row.get(tally.column)
            for part in cell if isinstance(cell, tuple) else (cell,):
                if value := "" if part is None else one_line(str(part)):
                    having.setdefault(value, []).append(cell_text(row, "turbine"))
        kinds = sorted(having.items(), key=lambda pair: -len(pair[1]))
        rows += [(tally.title, _in_words(v), str(len(who)), _some(who)) for v, who in kinds[:TALLIED]]
        if kinds[TALLIED:]:
            rows.append(
                (tally.title, f"{len(kinds) - TALLIED} more in the column {tally.column} of {CSV}", "", "")
            )
    return Table(
        "Turbines by what was found", ("", "found", "turbines", "which"), tuple(rows), left=(0, 1, 3)
    )


def _in_words(value: str) -> str:
    """A value of a column; the names of causes in words."""
    return WORDS.get(value) or (value if " " in value else spoken(value).replace("/", " or "))


def _some(turbines: Sequence[str]) -> str:
    return f"{', '.join(turbines[:MOST_NAMED_TURBINES])}{' …' if turbines[MOST_NAMED_TURBINES:] else ''}"


def _set_aside(found: Sequence[Scatter]) -> list[Prose]:
    notes = []
    for scatter in found:
        for names, why in (
            (scatter.open, "Without a value and bounds above zero on both sides"),
            (scatter.rejected, WORDS[REJECT].capitalize()),
        ):
            if names:
                told = f"{why}, so not compared: {scatter.compared.title} of {_some(names)}."
                notes.append(Prose(told, "note"))
    return notes


def _ranking(task: Task, done: Sequence[Row], found: Sequence[Scatter]) -> Table | None:
    """Every turbine with the quantities of the task, the largest of one of them first."""
    shown = [
        quantity
        for quantity in (*task.listed, *task.compared)
        if any(_value(row, quantity) != NONE for row in done)
    ]
    if not shown:
        return None
    key = [(-v if math.isfinite(v := cell_number(row, task.ranking)) else math.inf) for row in done]
    order = sorted(range(len(done)), key=lambda i: (key[i], str(done[i]["turbine"])))
    odd = {scatter.turbines[i] for scatter in found for i in scatter.outliers}
    rows = tuple(
        (str(place), cell_text(done[i], "turbine"), *(_value(done[i], quantity) for quantity in shown))
        for place, i in enumerate(order[:RANKED], 1)
    )
    marked = tuple(k for k, i in enumerate(order[:RANKED]) if str(done[i]["turbine"]) in odd)
    head = (
        "",
        "turbine",
        *(f"{quantity.title} [{quantity.unit}]" if quantity.unit else quantity.title for quantity in shown),
    )
    by = next((quantity.title for quantity in task.compared if quantity.column == task.ranking), task.ranking)
    shares = [share for row in done if math.isfinite(share := cell_number(row, "bounds_hold"))]
    bounds = f"bounds that hold {percent(min(shares))} of single years" if shares else "95 % bounds"
    more = f" The first {RANKED} of {len(done)}; {CSV} has all." if len(done) > RANKED else ""
    note = f"In brackets {bounds}. Bold: outliers.{more}"
    words = (1, *(i for i, quantity in enumerate(shown, 2) if not quantity.unit))
    return Table(f"By the {by}, the largest first", head, rows, left=words, marked=marked, note=note)


def _value(row: Row, one: Compared) -> str:
    value = cell_number(row, one.column)
    if not math.isfinite(value):
        return cell_text(row, one.column) or NONE
    if one.rejected(row):
        return WORDS[REJECT]
    if not one.lower:
        return fixed(value)
    low, high = cell_number(row, one.lower), cell_number(row, one.upper)
    if one.column.endswith("value_h") and not 0 < low < high:
        return cell_text(row, one.column.replace("value_h", "statement")) or "open"
    if plain_number(low) == plain_number(high):
        return plain_number(value)
    return f"{plain_number(value)} ({interval(low, high, plain_number)})"


def _method(fleet: FleetResults) -> tuple[Block, ...]:
    stated = ", ".join(f"{key} = {value}" for key, value in fleet.options.items())
    options = f" ({stated})" if stated else ""
    lines = (
        f"Each turbine was treated alone, with the same options{options}.",
        "Outliers: the distance of the logarithm of a turbine’s value from the median, in median absolute "
        "deviations (the turbines’ own bounds taken out, and those of the turbine added again), is compared "
        f"with the largest distance in as many normal numbers ({SIMULATED_FLEETS} simulated fleets at most). "
        f"If turbines differ normally, the chance of any false outlier is {percent(SIGNIFICANCE)} for the "
        f"whole fleet and all quantities together; fewer than {FEWEST_JUDGED} turbines are not judged. An "
        "outlier need not be faulty: the turbine may have another site, operation or design.",
        f"{CSV} has all numbers, and each turbine’s folder its results.",
        f"Done by {versions(fleet.version)}.",
    )
    return method("Data and method", *lines)
