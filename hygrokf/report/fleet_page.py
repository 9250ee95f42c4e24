"""The page of a fleet: turbines without a result, outliers, spread between turbines, and ranking."""

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
"""Largest number of rows of the ranking; fleet.csv has all turbines."""
TALLIED = 12
"""Largest number of values of a column that are counted; values of most turbines first."""
MOST_NAMED_TURBINES = 20
"""Largest number of turbines that are named in a cell."""
LEFT_OUT = "Left out, because they differ from the others by more than chance:"
FAILURE = ("turbine", "status", "reason")
"""Columns that report a turbine without a result."""


def write_fleet_report(out: Path) -> Path:
    """Write `report.html` of a directory with `fleet.json`; returns its path.

    Raises ResultFault if fleet.json is missing or damaged.
    """
    results_file = out / FLEET
    fleet = read_result(FleetResults, results_file, "hygrokf fleet")
    turbines = [row.get("turbine") for row in fleet.rows]
    if fleet.task not in TASKS or None in turbines or len(turbines) != len(set(turbines)):
        raise ResultFault(
            f"{results_file}: expected rows of a task of this version; run `hygrokf fleet` again"
        )
    return write_text_whole(out / REPORT, page_html(fleet_blocks(fleet)))


def outcome_text(row: Row, is_stored: bool) -> str:
    """Return a line on the outcome of one turbine; is_stored: whether its result was on disk already."""
    turbine, status = cell_text(row, "turbine"), cell_text(row, "status")
    if status != DONE:
        return f"{turbine}: {status}: {cell_text(row, 'reason')}"
    values = (
        f"{compared.title} {WORDS[REJECT]}"
        if compared.rejected(row)
        else f"{compared.title} {value:.3g} {compared.unit}"
        for compared in TASKS[cell_text(row, "task")].compared[:2]
        if math.isfinite(value := cell_number(row, compared.column))
    )
    return f"{turbine}: {', '.join([*values, 'done before' if is_stored else 'done'])}"


def fleet_blocks(fleet: FleetResults) -> Page:
    """Return the page of a fleet."""
    task, done = TASKS[fleet.task], fleet.done
    scatters = spreads(done, task.compared)
    figures = _pictures(scatters)
    cards = Cards(tuple(_cards(fleet, scatters)))
    ranking = _ranking(task, done, scatters)
    left_out = ", ".join(fleet.type_without)
    body = (
        *_failures(fleet),
        *section("Outliers", _outliers(scatters)),
        *section("What was found", _tallies(task.tallies, done)),
        *section("Spread over the fleet", *figures[1:], *_set_aside(scatters)),
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
            *figures[:1],
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
    """Yield a warning for each kind of record that was not measured."""
    for provenance, text in OF_FLEET.items():
        count = sum(row.get("provenance") == provenance for row in done)
        records_text = "All records" if count == len(done) else f"{count} of {len(done)} records"
        if count:
            yield Banner(provenance.upper(), f"{records_text} {text}")


def _cards(fleet: FleetResults, scatters: Sequence[Scatter]) -> list[Card]:
    """Return the cards: number of results, outliers, and the spread of each quantity with bounds."""
    failed = len(fleet.missing)
    text = f"{failed} without: the reasons are below" if failed else "every turbine has a result"
    value = f"{len(fleet.done)} of {len(fleet.rows)}"
    cards = [_card("Turbines with a result", value, sentence(text), failed > 0)]
    outliers = sorted({scatter.turbines[index] for scatter in scatters for index in scatter.outliers})
    if any(len(scatter.turbines) >= FEWEST_JUDGED for scatter in scatters):
        names = ", ".join(outliers) if len(outliers) <= 4 else f"{len(outliers)} turbines, listed below"
        text = names or "no turbine differs from the others by more than chance"
        cards.append(_card("Outliers", str(len(outliers)), sentence(text), bool(outliers)))
    return cards + [
        _spread_card(scatter) for scatter in scatters if scatter.compared.lower and scatter.turbines
    ]


def _spread_card(scatter: Scatter) -> Card:
    """The card of a quantity: median and range over the turbines, and the spread beyond their bounds."""
    median, low, high = map(math.exp, (scatter.center, scatter.x.min(), scatter.x.max()))
    unit = scatter.compared.unit
    decimals = min(decimals_for(high - low) + 1, 3) if high > low else 2
    if len(scatter.turbines) < 3:
        remark = "too few turbines for a spread"
    elif scatter.between > 0.005:
        remark = f"standard deviation between turbines {percent(scatter.between)}, beyond their bounds"
    elif scatter.explained:
        remark = "the bounds explain all of the spread between turbines"
    else:
        remark = "most turbines agree within their bounds, but not all"
    if scatter.outliers:
        remark = f"apart from {', '.join(scatter.turbines[i] for i in scatter.outliers[:4])}: {remark}"
    digits = partial(fixed, decimals=decimals)
    text = f"{interval(low, high, digits, unit)} over {len(scatter.turbines)} turbines; {remark}."
    return _card(f"{scatter.compared.title.capitalize()}, median", f"{digits(median)} {unit}", text)


def _card(label: str, value: str, text: str, warning: bool = False) -> Card:
    """Return a card with one line of text; `warning`: its edge is shown as a warning."""
    return Card(label, value, lines=(text,), tone="open" if warning else "plain")


def _pictures(scatters: Sequence[Scatter]) -> list[Figure]:
    """Return the figures of the spread: quantities with bounds, and errors."""
    constants = [scatter for scatter in scatters if scatter.compared.lower]
    errors = [scatter for scatter in scatters if not scatter.compared.lower]
    figures = []
    if constants:
        is_in_hours = all(constant.compared.unit == "h" for constant in constants)
        heading = "Time constants" if is_in_hours else "Climate of a year"
        caption = (
            "The bounds of turbines of one type should overlap the shaded range, or include the median "
            "if nothing is shaded."
        )
        figures.append(Figure("constants", heading, caption, partial(figure_spreads, constants)))
    if errors:
        caption = "Turbines far to the right have larger simulation errors."
        figures.append(Figure("errors", "Free-run errors", caption, partial(figure_spreads, errors)))
    return figures


# --- sections --------------------------------------------------------------------------------


def _failures(fleet: FleetResults) -> tuple[Block, ...]:
    """Return the section of turbines without a result; empty if every turbine has one."""
    if not fleet.missing:
        return ()
    cells = tuple(tuple(cell_text(row, name) for name in FAILURE) for row in fleet.missing)
    return section(
        "Without a result",
        Table("Turbines and reasons", FAILURE, cells, left=(0, 1, 2)),
        Prose("Correct the faults and run the fleet again: finished turbines are not repeated."),
    )


def _outliers(scatters: Sequence[Scatter]) -> Block | None:
    """Return the table of outliers; None if there are too few turbines to judge."""
    judged = [scatter for scatter in scatters if len(scatter.turbines) >= FEWEST_JUDGED]
    if not judged:
        return None
    smallest_p = 2.0 * len(scatters) / SIMULATED_FLEETS
    rows = tuple(
        (
            scatter.turbines[index],
            f"{scatter.compared.title} [{scatter.compared.unit}]",
            f"{math.exp(scatter.x[index]):.3g}",
            f"{math.exp(scatter.center):.3g}",
            f"{100 * math.expm1(scatter.x[index] - scatter.center):+.0f} %",
            f"{scatter.p[index]:.2g}" if scatter.p[index] > smallest_p else f"< {smallest_p:.1g}",
        )
        for scatter in judged
        for index in scatter.outliers
    )
    column_names = ("turbine", "quantity", "value", "median", "deviation", "chance")
    return table_or(
        Table("Outliers", column_names, rows, left=(0, 1)) if rows else None,
        "No turbine differs from the others by more than chance and its bounds explain.",
    )


def _tallies(tallies: Sequence[Tally], done: Sequence[Row]) -> Table:
    """Return the values of each counted column with their turbines, the most frequent values first."""
    rows: list[tuple[str, ...]] = []
    for tally in tallies:
        turbines_by_value: dict[str, list[str]] = {}
        for row in done:
            cell = row.get(tally.column)
            for item in cell if isinstance(cell, tuple) else (cell,):
                if value := "" if item is None else one_line(str(item)):
                    turbines_by_value.setdefault(value, []).append(cell_text(row, "turbine"))
        most_frequent = sorted(turbines_by_value.items(), key=lambda pair: -len(pair[1]))
        rows += [
            (tally.title, _in_words(value), str(len(turbines)), _some(turbines))
            for value, turbines in most_frequent[:TALLIED]
        ]
        if most_frequent[TALLIED:]:
            remark = f"{len(most_frequent) - TALLIED} more in the column {tally.column} of {CSV}"
            rows.append((tally.title, remark, "", ""))
    return Table(
        "Turbines by what was found", ("", "found", "turbines", "which"), tuple(rows), left=(0, 1, 3)
    )


def _in_words(value: str) -> str:
    """Return a value of a column in words."""
    return WORDS.get(value) or (value if " " in value else spoken(value).replace("/", " or "))


def _some(turbines: Sequence[str]) -> str:
    """Return the names of the first turbines, with "…" if there are more."""
    return f"{', '.join(turbines[:MOST_NAMED_TURBINES])}{' …' if turbines[MOST_NAMED_TURBINES:] else ''}"


def _set_aside(scatters: Sequence[Scatter]) -> list[Prose]:
    """Return notes on the turbines whose values are not compared, with the reason."""
    notes = []
    for scatter in scatters:
        for names, reason in (
            (scatter.open, "Without a value and bounds above zero on both sides"),
            (scatter.rejected, WORDS[REJECT].capitalize()),
        ):
            if names:
                text = f"{reason}, so not compared: {scatter.compared.title} of {_some(names)}."
                notes.append(Prose(text, "note"))
    return notes


def _ranking(task: Task, done: Sequence[Row], scatters: Sequence[Scatter]) -> Table | None:
    """Every turbine with the quantities of the task, ranked by one of them; None without any quantity."""
    quantities = [
        shown for shown in (*task.listed, *task.compared) if any(_value(row, shown) != NONE for row in done)
    ]
    if not quantities:
        return None
    sort_keys = [
        (-value if math.isfinite(value := cell_number(row, task.ranking)) else math.inf) for row in done
    ]
    order = sorted(range(len(done)), key=lambda i: (sort_keys[i], str(done[i]["turbine"])))
    outliers = {scatter.turbines[i] for scatter in scatters for i in scatter.outliers}
    ranked = [done[i] for i in order[:RANKED]]
    rows = tuple(
        (str(rank), cell_text(row, "turbine"), *(_value(row, quantity) for quantity in quantities))
        for rank, row in enumerate(ranked, 1)
    )
    marked = tuple(i for i, row in enumerate(ranked) if str(row["turbine"]) in outliers)
    titles = (f"{shown.title} [{shown.unit}]" if shown.unit else shown.title for shown in quantities)
    ranked_by = next((shown.title for shown in task.compared if shown.column == task.ranking), task.ranking)
    shares = [share for row in done if math.isfinite(share := cell_number(row, "bounds_hold"))]
    bounds = f"bounds that hold {percent(min(shares))} of single years" if shares else "95 % bounds"
    remark = f" The first {RANKED} of {len(done)}; {CSV} has all." if len(done) > RANKED else ""
    note = f"In brackets {bounds}. Bold: outliers.{remark}"
    word_columns = (1, *(i for i, quantity in enumerate(quantities, 2) if not quantity.unit))
    heading = f"By the {ranked_by}, the largest first"
    return Table(heading, ("", "turbine", *titles), rows, left=word_columns, marked=marked, note=note)


def _value(row: Row, quantity: Compared) -> str:
    """Return a turbine's value of a quantity with its bounds, as the cell of a table."""
    value = cell_number(row, quantity.column)
    if not math.isfinite(value):
        return cell_text(row, quantity.column) or NONE
    if quantity.rejected(row):
        return WORDS[REJECT]
    if not quantity.lower:
        return fixed(value)
    low, high = cell_number(row, quantity.lower), cell_number(row, quantity.upper)
    if quantity.column.endswith("value_h") and not 0 < low < high:
        return cell_text(row, quantity.column.replace("value_h", "statement")) or "open"
    if plain_number(low) == plain_number(high):
        return plain_number(value)
    return f"{plain_number(value)} ({interval(low, high, plain_number)})"


def _method(fleet: FleetResults) -> tuple[Block, ...]:
    """Return how the fleet was computed."""
    options_text = ", ".join(f"{key} = {value}" for key, value in fleet.options.items())
    options = f" ({options_text})" if options_text else ""
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
