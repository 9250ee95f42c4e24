"""The page of a fleet: failures, turbines that depart from the others, the spread, a ranking."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from hygrokf.data.files import FLEET, REPORT, write_text_whole
from hygrokf.data.result_file import ResultFault, read_result
from hygrokf.fleet.job import DONE, Outcome, Row, number, text_of
from hygrokf.fleet.outliers import DRAWS, FEWEST_JUDGED, LEVEL, Scatter, spreads
from hygrokf.fleet.results import CSV, FleetResults
from hygrokf.fleet.tasks import BETWEEN, TASKS, Compared
from hygrokf.identification.verdict_terms import CAUTION, REJECT, VERDICTS, WORDS
from hygrokf.identification.wording import (
    NONE,
    decimals_for,
    fixed,
    moment,
    one_line,
    percent,
    plain_number,
    sentence,
)
from hygrokf.modelling.design import PARTS
from hygrokf.report.blocks import (
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
    synthetic,
    table_or,
)
from hygrokf.report.figures.comparison import figure_spreads
from hygrokf.report.page import page_html
from hygrokf.report.transfer_page import type_section
from hygrokf.version import __version__

RANKED = 50
"""Rows of the ranking on the page; fleet.csv has all."""
REMARKS = 12
"""Remarks on weather and power on the page, those of most turbines first."""
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


def outcome_text(found: Outcome, known: bool) -> str:
    """A line on the outcome of one turbine; known: whether it was on disk already."""
    if found.status != DONE:
        return f"{found.turbine}: {found.status}: {text_of(found.row, 'reason')}"
    values = (
        f"{one.title} {WORDS[REJECT]}" if one.rejected(found.row) else f"{one.title} {value:.3g} {one.unit}"
        for one in TASKS[text_of(found.row, "task")].compared[:2]
        if math.isfinite(value := number(found.row, one.column))
    )
    effort = "done before" if known else f"{found.seconds:.1f} s of CPU"
    return f"{found.turbine}: {', '.join([*values, effort])}"


def fleet_blocks(fleet: FleetResults) -> Page:
    """The page of a fleet."""
    task, done = TASKS[fleet.task], fleet.done
    found = spreads(done, task.compared)
    pictures = _pictures(found)
    cards = Cards(tuple(_cards(fleet, found)))
    ranking = _ranking(task.ranking, task.compared, done, found)
    left_out = ", ".join(fleet.type_without)
    made_up = sum(row.get("synthetic") is True for row in done)
    which = "All records" if made_up == len(done) else f"{made_up} of {len(done)} records"
    body = (
        *_failures(fleet),
        *section("Outliers", _outliers(found)),
        *_believed(done),
        *_verdicts(done),
        *_transfers(done),
        *_climates(done),
        *section("Spread over the fleet", *pictures[1:], *_set_aside(found)),
        *type_section(fleet.type, Prose(f"{LEFT_OUT} {left_out}.", "note") if left_out else None),
        *section("Ranking", Details("Every turbine", (ranking,), printed=True) if ranking else None),
    )
    return Page(
        f"Fleet report, {fleet.task}",
        one_line(fleet.name) or "unnamed fleet",
        (f"{sentence(task.meaning)} {moment(fleet.created)} UTC.",),
        (
            *synthetic(made_up > 0, f"{which} were made by a computer. Nothing of them was measured."),
            cards,
            *pictures[:1],
        ),
        body,
        _method(fleet),
    )


# --- the answer ------------------------------------------------------------------------------


def _cards(fleet: FleetResults, found: Sequence[Scatter]) -> list[Card]:
    failed = len(fleet.missing)
    text = f"{failed} without: the reasons are below" if failed else "every turbine has a result"
    value = f"{len(fleet.done)} of {len(fleet.rows)}"
    cards = [_card("Turbines with a result", value, sentence(text), failed > 0)]
    odd = sorted({one.turbines[i] for one in found for i in one.outliers})
    if any(len(one.turbines) >= FEWEST_JUDGED for one in found):
        names = ", ".join(odd) if len(odd) <= 4 else f"{len(odd)} turbines, listed below"
        text = names or "no turbine differs from the others by more than chance"
        cards.append(_card("Outliers", str(len(odd)), sentence(text), bool(odd)))
    return cards + [_spread_card(one) for one in found if one.compared.lower and one.turbines]


def _spread_card(one: Scatter) -> Card:
    """Median and range of a quantity over the turbines, and whether their bounds explain the range."""
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
    text = f"{low:.{decimals}f} … {high:.{decimals}f} {unit} over {len(one.turbines)} turbines; {between}."
    return _card(f"{one.compared.title.capitalize()}, median", f"{middle:.{decimals}f} {unit}", text)


def _card(label: str, value: str, text: str, warning: bool = False) -> Card:
    return Card(label, value, lines=(text,), tone="open" if warning else "plain")


def _pictures(found: Sequence[Scatter]) -> list[Figure]:
    """The spread of the bounded quantities, and that of the errors."""
    constants = [one for one in found if one.compared.lower]
    errors = [one for one in found if not one.compared.lower]
    pictures = []
    if constants:
        hours = all(one.compared.unit == "h" for one in constants)
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
    cells = tuple(tuple(text_of(row, name) for name in FAILURE) for row in fleet.missing)
    return section(
        "Without a result",
        Table("Turbines and reasons", FAILURE, cells, left=(0, 1, 2)),
        Prose("Correct the faults and run the fleet again: finished turbines are not repeated."),
    )


def _outliers(found: Sequence[Scatter]) -> Block | None:
    """The outliers; None where there are too few turbines to tell."""
    judged = [one for one in found if len(one.turbines) >= FEWEST_JUDGED]
    if not judged:
        return None
    least = 2.0 * len(found) / DRAWS
    rows = tuple(
        (
            one.turbines[i],
            f"{one.compared.title} [{one.compared.unit}]",
            f"{math.exp(one.x[i]):.3g}",
            f"{math.exp(one.center):.3g}",
            f"{100 * math.expm1(one.x[i] - one.center):+.0f} %",
            f"{one.p[i]:.2g}" if one.p[i] > least else f"< {least:.1g}",
        )
        for one in judged
        for i in one.outliers
    )
    head = ("turbine", "quantity", "value", "median", "deviation", "chance")
    return table_or(
        Table("Outliers", head, rows, left=(0, 1)) if rows else None,
        "No turbine differs from the others by more than chance and its bounds explain.",
    )


def _believed(done: Sequence[Row]) -> tuple[Block, ...]:
    """The verdicts on the time constants, and the turbines in doubt, the rejected ones first."""
    found = {text_of(row, "turbine"): [_verdict(row, part) for part in PARTS] for row in done}
    found = {turbine: verdicts for turbine, verdicts in found.items() if any(verdicts)}
    if not found:
        return ()
    counts = {part: Counter(verdicts[i] for verdicts in found.values()) for i, part in enumerate(PARTS)}
    text = "; ".join(
        f"{part} time constant: " + ", ".join(f"{count[v]} {WORDS[v]}" for v in VERDICTS if count[v])
        for part, count in counts.items()
        if any(count[v] for v in VERDICTS)
    )
    doubtful = [turbine for turbine, verdicts in found.items() if CAUTION in verdicts or REJECT in verdicts]
    doubtful.sort(key=lambda turbine: REJECT not in found[turbine])
    listed = doubtful[:RANKED]
    rows = tuple((turbine, *(WORDS.get(v, NONE) for v in found[turbine])) for turbine in listed)
    marked = tuple(i for i, turbine in enumerate(listed) if REJECT in found[turbine])
    head = ("turbine", *(f"{part} time constant" for part in PARTS))
    more = f" The first {RANKED} of {len(doubtful)}; {CSV} has all." if len(doubtful) > RANKED else ""
    note = f"The results of each turbine give the reasons.{more}"
    table = Table("Turbines whose numbers are in doubt", head, rows, left=(0, 1, 2), marked=marked, note=note)
    return section(
        "Which numbers are reliable",
        Prose(sentence(text)),
        table_or(table if rows else None, "All time constants are reliable."),
    )


def _verdict(row: Row, part: str) -> str:
    found = text_of(row, f"{part}_verdict")
    return found if found in VERDICTS else ""


def _verdicts(done: Sequence[Row]) -> tuple[Block, ...]:
    """The verdicts of a fleet's discoveries, and the turbines of each named cause."""
    if not any("verdict" in row for row in done):
        return ()
    verdicts = Counter(text_of(row, "verdict") for row in done)
    causes = Counter(one for row in done for one in text_of(row, "causes").split())
    rows = tuple(
        (
            one.replace("_", " ").replace("/", " or "),
            str(count),
            ", ".join(text_of(r, "turbine") for r in done if one in text_of(r, "causes").split()),
        )
        for one, count in causes.most_common()
    )
    table = Table("Named causes", ("cause", "turbines", "which"), rows, left=(0, 2)) if rows else None
    kinds = ("none", "named", "ambiguous", "unexplained", "refuted")
    counts = ", ".join(f"{verdicts[v]} {v}" for v in kinds if verdicts[v])
    ended = [text_of(row, "turbine") for row in done if text_of(row, "not_judged")]
    budget = f"The budget of simulations ended the search before every cause was judged: {', '.join(ended)}."
    return section(
        "What the simulations lack",
        Prose(budget) if ended else None,
        Prose(f"Verdicts: {counts}."),
        table_or(table, "No cause was named."),
    )


def _transfers(done: Sequence[Row]) -> tuple[Block, ...]:
    """The turbines to which a model transfers, and the parameters that must be re-estimated."""
    judged = [row for row in done if text_of(row, "transfer")]
    if not judged:
        return ()
    rows = tuple(
        (text_of(row, "turbine"), text_of(row, "re_estimate").replace("_", " "), text_of(row, "sentence"))
        for row in judged
    )
    counts = Counter(text_of(row, "transfer") for row in judged)
    return section(
        "What travels",
        Prose(sentence("; ".join(f"{n} {verdict}" for verdict, n in counts.most_common()))),
        Table("Verdicts", ("turbine", "to be re-estimated", "in words"), rows, left=(0, 1, 2)),
    )


def _climates(done: Sequence[Row]) -> tuple[Block, ...]:
    """The climates of a fleet: limits, class of wetness, condensation, and remarks."""
    judged = [row for row in done if "wetness_class" in row]
    if not judged:
        return ()
    rows = tuple(
        (
            text_of(r, "turbine"),
            text_of(r, "limits") or NONE,
            text_of(r, "wetness_class") or NONE,
            _span(*(number(r, f"condensation_h{end}") for end in ("", "_lower", "_upper"))),
        )
        for r in judged
    )
    counts = Counter(text_of(row, "limits") for row in judged)
    verdicts = ", ".join(f"{counts[v]} {v}" for v in ("fail", "undecided", "pass") if counts[v])
    head = ("turbine", "limits", "wetness", "condensation, h/a")
    marked = tuple(i for i, row in enumerate(judged) if row.get("limits") == "fail")
    shares = [share for row in judged if math.isfinite(share := number(row, "bounds_hold"))]
    held = f" that hold {percent(min(shares))} of single years" if shares else " for a single year"
    note = (
        "Limits: the worst of a turbine's verdicts. Wetness: class of ISO 9223:1992. In brackets "
        f"bounds{held}."
    )
    remarks = Counter(one for row in judged for one in text_of(row, "statements").split(BETWEEN) if one)
    notes = [Prose(f"{count} of {len(judged)}: {one}", "note") for one, count in remarks.most_common(REMARKS)]
    if len(remarks) > REMARKS:
        notes.append(Prose(f"{len(remarks) - REMARKS} more in the column statements of {CSV}.", "note"))
    return section(
        "Climates",
        Prose(f"Limits: {verdicts}." if verdicts else "No limits were given."),
        Table("Each turbine", head, rows, left=(0, 1, 2), marked=marked, note=note),
        *notes,
    )


def _set_aside(found: Sequence[Scatter]) -> list[Prose]:
    """The turbines that are not compared, and why."""
    notes = []
    for one in found:
        for names, why in (
            (one.open, "Without a value and bounds above zero on both sides"),
            (one.rejected, WORDS[REJECT].capitalize()),
        ):
            if names:
                listed = f"{', '.join(names[:20])}{' …' if len(names) > 20 else ''}"
                notes.append(Prose(f"{why}, so not compared: {one.compared.title} of {listed}.", "note"))
    return notes


def _ranking(
    column: str, compared: Sequence[Compared], done: Sequence[Row], found: Sequence[Scatter]
) -> Table | None:
    present = [one for one in compared if any(math.isfinite(number(row, one.column)) for row in done)]
    if not present:
        return None
    key = [(-v if math.isfinite(v := number(row, column)) else math.inf) for row in done]
    order = sorted(range(len(done)), key=lambda i: (key[i], str(done[i]["turbine"])))
    odd = {one.turbines[i] for one in found for i in one.outliers}
    rows = tuple(
        (str(place), text_of(done[i], "turbine"), *(_value(done[i], one) for one in present))
        for place, i in enumerate(order[:RANKED], 1)
    )
    marked = tuple(k for k, i in enumerate(order[:RANKED]) if str(done[i]["turbine"]) in odd)
    head = ("", "turbine", *(f"{one.title} [{one.unit}]" for one in present))
    by = next((one.title for one in compared if one.column == column), column)
    more = f" The first {RANKED} of {len(done)}; {CSV} has all." if len(done) > RANKED else ""
    note = f"In brackets 95 % bounds. Bold: outliers.{more}"
    return Table(f"By the {by}, the largest first", head, rows, left=(1,), marked=marked, note=note)


def _value(row: Row, one: Compared) -> str:
    """Value with bounds, as a cell."""
    value = number(row, one.column)
    if not math.isfinite(value):
        return NONE
    if one.rejected(row):
        return WORDS[REJECT]
    if not one.lower:
        return fixed(value)
    low, high = number(row, one.lower), number(row, one.upper)
    if not (0 < low < high) and not one.column.endswith("value_h"):
        return _span(value, low, high)
    if not (0 < low < high):
        return text_of(row, one.column.replace("value_h", "statement")) or "open"
    decimals = decimals_for(high - low)
    return f"{value:.{decimals}f} ({low:.{decimals}f} … {high:.{decimals}f})"


def _span(value: float, low: float, high: float) -> str:
    """A value with its bounds, which may be zero."""
    if not math.isfinite(value):
        return NONE
    if plain_number(low) == plain_number(high):
        return plain_number(value)
    return f"{plain_number(value)} ({plain_number(low)} … {plain_number(high)})"


def _method(fleet: FleetResults) -> tuple[Block, ...]:
    stated = ", ".join(f"{key} = {value}" for key, value in fleet.options.items())
    options = f" ({stated})" if stated else ""
    lines = (
        f"Each turbine was treated alone, with the same options{options}.",
        "Outliers: the distance of the logarithm of a turbine’s value from the median, in median absolute "
        "deviations (the turbines’ own bounds taken out, and those of the turbine added again), is compared "
        f"with the largest distance in as many normal numbers ({DRAWS} simulated fleets at most). If "
        f"turbines differ normally, the chance of any false outlier is {percent(LEVEL)} for the whole fleet "
        f"and all quantities together; fewer than {FEWEST_JUDGED} turbines are not judged. An outlier need "
        "not be faulty: the turbine may have another site, operation or design.",
        f"{CSV} has all numbers, and each turbine’s folder its results.",
        f"Done by hygrokf {fleet.version}; page written by hygrokf {__version__}.",
    )
    return method("Data and method", *lines)
