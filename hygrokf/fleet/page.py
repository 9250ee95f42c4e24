"""`report.html` of a fleet: what failed, who departs from the others, the spread of what was found, a
ranking."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from html import escape

from hygrokf.data.lookup import entry, number
from hygrokf.fleet.job import DONE
from hygrokf.fleet.outliers import DRAWS, FEWEST, LEVEL, Spread, spreads
from hygrokf.fleet.plots import figure_spreads
from hygrokf.fleet.table import CSV
from hygrokf.fleet.tasks import BETWEEN, TASKS, Compared
from hygrokf.identification.turbine_type import TurbineType
from hygrokf.identification.verdict import CAUTION, PARTS, REJECT, VERDICTS, WORDS
from hygrokf.identification.wording import NONE, decimals_for, fixed, percent, plain_number, sentence, text_of
from hygrokf.report.blocks import Table
from hygrokf.report.figures.transfer import figure_type
from hygrokf.report.html import document, figure_html, moment, prose, section, tables_html
from hygrokf.report.transfer_page import type_table, type_without
from hygrokf.version import __version__

RANKED = 50
"""Rows of the ranking on the page; the table of all is fleet.csv."""
REMARKS = 12
"""Remarks on weather and power that the page tells, those of most turbines first."""


def fleet_page(fleet: Mapping) -> str:
    """The whole page as HTML text, a pure function of the data of `fleet.json`."""
    task = TASKS[text_of(fleet["task"])]
    rows = [row for row in fleet["rows"] if isinstance(row, Mapping)]
    done = [row for row in rows if row.get("status") == DONE]
    found = spreads(done, task.compared)
    name = text_of(entry(fleet, "name")) or "unnamed fleet"
    parts = [
        _head(fleet, name, done),
        _cards(rows, done, found),
        _failures(rows),
        _believed(done),
        _verdicts(done),
        _transfers(done),
        _climates(done),
        _spreads_section(found),
        _type(fleet),
        _outliers(found),
        _ranking(task.ranking, task.compared, done, found),
        _method(fleet, found),
    ]
    return document(f"{name} – hygrokf fleet", parts)


def _type(fleet: Mapping) -> str:
    """The type of turbine as a section; nothing where there is none."""
    if not isinstance(fleet.get("type"), Mapping):
        return ""
    found = TurbineType.from_json(fleet["type"])
    left_out = [text_of(one) for one in entry(fleet, "type_without") or ()]
    return section(
        "The type of turbine",
        tables_html((type_table(found), "")),
        f"<p class=note>{escape(type_without(left_out))}</p>" if left_out else "",
        figure_html("type", "Type and next turbine", "", partial(figure_type, found)),
    )


def _head(fleet: Mapping, name: str, done: Sequence[Mapping]) -> str:
    task = text_of(fleet["task"])
    banner = ""
    made = sum(row.get("synthetic") is True for row in done)
    if made:
        which = "All records" if made == len(done) else f"{made} of {len(done)} records"
        banner = (
            f"<p class='banner synthetic'><b>SYNTHETIC</b> {which} were made by a computer. "
            "Nothing of them was measured.</p>"
        )
    return (
        f"<header><p class=kind>Hygrothermal models of enclosures · fleet report · {escape(task)}</p>"
        f"<h1>{escape(name)}</h1><p class=meta>{escape(sentence(TASKS[task].meaning))} "
        f"{escape(moment(fleet.get('created')))} UTC.</p>{banner}</header>"
    )


# --- cards -----------------------------------------------------------------------------------


def _cards(rows: Sequence[Mapping], done: Sequence[Mapping], found: Sequence[Spread]) -> str:
    failed = len(rows) - len(done)
    said = "every turbine has a result" if not failed else f"{failed} without: the reasons are below"
    cards = [_card("Turbines", "with a result", f"{len(done)} of {len(rows)}", sentence(said), failed > 0)]
    odd = {one.turbines[i] for one in found for i in one.outliers}
    judged = [one for one in found if len(one.turbines) >= FEWEST]
    if judged:
        names = ", ".join(sorted(odd)) if len(odd) <= 4 else f"{len(odd)} turbines, listed below"
        text = names or "no turbine departs from the others by more than chance explains"
        cards.append(_card("Outliers", "", str(len(odd)), sentence(text), bool(odd)))
    for one in found:
        if one.compared.lower and len(one.turbines):
            middle, low, high = (math.exp(v) for v in (one.center, one.x.min(), one.x.max()))
            unit = one.compared.unit
            decimals = min(decimals_for(high - low) + 1, 3) if high > low else 2
            between = (
                f"between turbines {100 * one.between:.0f} % (standard deviation beyond their bounds)"
                if one.between > 0.005
                else "the bounds explain all of the spread between turbines"
                if one.explained
                else "most agree within their bounds, but not all of them do"
            )
            if one.outliers:
                between += f", but for {', '.join(one.turbines[i] for i in one.outliers[:4])}"
            if len(one.turbines) < 3:
                between = "too few turbines for a spread"
            cards.append(
                _card(
                    one.compared.title.capitalize(),
                    "median",
                    f"{middle:.{decimals}f} {unit}",
                    f"{low:.{decimals}f} … {high:.{decimals}f} {unit} over {len(one.turbines)}; {between}.",
                )
            )
    return f"<section class=cards>{''.join(cards)}</section>"


def _card(label: str, beside: str, value: str, said: str, care: bool = False) -> str:
    return (
        f"<div class='card{' open' if care else ''}'><p class=label>{escape(label)} "
        f"<span>{escape(beside)}</span></p><p class=value>{prose(value)}</p><p>{prose(said)}</p></div>"
    )


# --- sections --------------------------------------------------------------------------------


def _failures(rows: Sequence[Mapping]) -> str:
    failed = [row for row in rows if row.get("status") != DONE]
    if not failed:
        return ""
    cells = tuple(
        (text_of(r.get("turbine")), text_of(r.get("status")), text_of(r.get("reason"))) for r in failed
    )
    table = Table("Turbines and reasons", ("turbine", "status", "reason"), cells, left=(0, 1, 2))
    said = "<p>Run the fleet again when they are mended: what is done is not done again.</p>"
    return section("Without a result", tables_html((table, "")), said)


def _believed(done: Sequence[Mapping]) -> str:
    """The verdict on the time constants of each turbine's model, those that are not to be believed first."""
    judged = [row for row in done if any(_verdict(row, part) for part in PARTS)]
    if not judged:
        return ""
    order: dict[str, int] = {kind: place for place, kind in enumerate(reversed(VERDICTS))}
    ranked = sorted(judged, key=lambda r: min(order.get(_verdict(r, part), len(order)) for part in PARTS))
    doubtful = [r for r in ranked if any(_verdict(r, part) in (CAUTION, REJECT) for part in PARTS)]
    rows = tuple(
        (text_of(r.get("turbine")), *(_verdict_words(_verdict(r, part)) for part in PARTS))
        for r in doubtful[:RANKED]
    )
    marked = tuple(
        i for i, r in enumerate(doubtful[:RANKED]) if REJECT in [_verdict(r, part) for part in PARTS]
    )
    said = "; ".join(
        f"{part} time constant: "
        + ", ".join(f"{count} {WORDS[kind]}" for kind in VERDICTS if (count := _count(judged, part, kind)))
        for part in PARTS
        if any(_verdict(row, part) for row in judged)
    )
    head = ("turbine", *(f"{part} time constant" for part in PARTS))
    more = f" The first {RANKED} of {len(doubtful)}; all are in {CSV}." if len(doubtful) > RANKED else ""
    note = f"The reasons stand in each turbine's own results.{more}"
    table = Table("Turbines whose numbers are in doubt", head, rows, left=(0, 1, 2), marked=marked, note=note)
    return section(
        "Which numbers to believe",
        f"<p>{prose(sentence(said))}</p>",
        tables_html((table if rows else None, "All of them are to be believed.")),
    )


def _verdict(row: Mapping, part: str) -> str:
    found = row.get(f"{part}_verdict")
    return found if found in VERDICTS else ""


def _verdict_words(kind: str) -> str:
    return WORDS.get(kind, NONE)


def _count(rows: Sequence[Mapping], part: str, kind: str) -> int:
    return sum(_verdict(row, part) == kind for row in rows)


def _verdicts(done: Sequence[Mapping]) -> str:
    """How often each cause was accepted, of a fleet's discoveries."""
    if not any("verdict" in row for row in done):
        return ""
    verdicts = Counter(text_of(row.get("verdict")) for row in done)
    causes = Counter(one for row in done for one in text_of(row.get("causes")).split())
    whose = {
        one: ", ".join(text_of(r.get("turbine")) for r in done if one in text_of(r.get("causes")).split())
        for one in causes
    }
    rows = tuple((one.replace("_", " "), str(count), whose[one]) for one, count in causes.most_common())
    table = Table("Accepted causes", ("cause", "turbines", "which"), rows, left=(0, 2)) if rows else None
    said = ", ".join(f"{verdicts[v]} {v}" for v in ("none", "named", "unexplained") if verdicts[v])
    return section(
        "What the simulations lack",
        f"<p>Verdicts: {escape(said)}.</p>",
        tables_html((table, "No cause was accepted.")),
    )


def _transfers(done: Sequence[Mapping]) -> str:
    """On which turbines a model transfers, and what is to be re-estimated."""
    judged = [row for row in done if text_of(row.get("transfer"))]
    if not judged:
        return ""
    rows = tuple(
        (
            text_of(r.get("turbine")),
            text_of(r.get("re_estimate")).replace("_", " "),
            text_of(r.get("sentence")),
        )
        for r in judged
    )
    counts = Counter(text_of(row.get("transfer")) for row in judged)
    table = Table("Verdicts", ("turbine", "to be re-estimated", "in words"), rows, left=(0, 1, 2))
    said = "; ".join(f"{n} {verdict}" for verdict, n in counts.most_common())
    return section("What travels", f"<p>{escape(sentence(said))}</p>", tables_html((table, "")))


def _climates(done: Sequence[Mapping]) -> str:
    """Of a fleet's climates: the limits, the class of wetness, condensation, and what is to be said of
    each."""
    judged = [row for row in done if "wetness_class" in row]
    if not judged:
        return ""
    rows = tuple(
        (
            text_of(r.get("turbine")),
            text_of(r.get("limits")) or NONE,
            text_of(r.get("wetness_class")) or NONE,
            _span(*(number(r, f"condensation_h{end}") for end in ("", "_lower", "_upper"))),
        )
        for r in judged
    )
    counts = Counter(text_of(row.get("limits")) for row in judged)
    verdicts = ", ".join(f"{counts[v]} {v}" for v in ("fail", "undecided", "pass") if counts[v])
    said = f"Limits: {verdicts}." if verdicts else "No limits were given."
    head = ("turbine", "limits", "wetness", "condensation, h/a")
    marked = tuple(i for i, row in enumerate(judged) if row.get("limits") == "fail")
    shares = [share for row in judged if math.isfinite(share := number(row, "bounds_hold"))]
    held = f" that hold {percent(min(shares))} of single years" if shares else " for a single year"
    note = (
        "Limits: the worst of a turbine's verdicts. Wetness: class of ISO 9223:1992. In brackets "
        f"bounds{held}."
    )
    table = Table("Each turbine", head, rows, left=(0, 1, 2), marked=marked, note=note)
    remarks = Counter(one for row in judged for one in text_of(row.get("statements")).split(BETWEEN) if one)
    told = "".join(
        f"<p class=note>{count} of {len(judged)}: {prose(one)}</p>"
        for one, count in remarks.most_common(REMARKS)
    )
    if len(remarks) > REMARKS:
        told += f"<p class=note>{len(remarks) - REMARKS} more in the column statements of {CSV}.</p>"
    return section("Climates", f"<p>{escape(said)}</p>", tables_html((table, "")), told)


def _span(value: float, low: float, high: float) -> str:
    """A value with its bounds, which may be zero."""
    if not math.isfinite(value):
        return NONE
    if plain_number(low) == plain_number(high):
        return plain_number(value)
    return f"{plain_number(value)} ({plain_number(low)} … {plain_number(high)})"


def _spreads_section(found: Sequence[Spread]) -> str:
    constants = [one for one in found if one.compared.lower]
    errors = [one for one in found if not one.compared.lower]
    parts = []
    for name, heading, chosen, caption in (
        (
            "constants",
            "Time constants" if all(one.compared.unit == "h" for one in constants) else "Climate of a year",
            constants,
            "Turbines of one type should reach with their bounds into the shade, or to the median where "
            "there is none.",
        ),
        (
            "errors",
            "Free-run errors",
            errors,
            "A turbine far to the right is simulated worse than the others.",
        ),
    ):
        if chosen:
            parts.append(figure_html(name, heading, caption, partial(figure_spreads, chosen)))
    for one in found:
        for names, why in (
            (one.open, "Without a value and bounds above zero on both sides"),
            (one.rejected, WORDS[REJECT].capitalize()),
        ):
            if names:
                parts.append(
                    f"<p class=note>{why}, so not compared: {escape(one.compared.title)} of "
                    f"{escape(', '.join(names[:20]))}{' …' if len(names) > 20 else ''}.</p>"
                )
    return section("Spread over the fleet", *parts) if parts else ""


def _value(row: Mapping, one: Compared) -> str:
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
        return text_of(row.get(one.column.replace("value_h", "statement"))) or "open"
    decimals = decimals_for(high - low)
    return f"{value:.{decimals}f} ({low:.{decimals}f} … {high:.{decimals}f})"


def _outliers(found: Sequence[Spread]) -> str:
    judged = [one for one in found if len(one.turbines) >= FEWEST]
    if not judged:
        return ""
    rows = tuple(
        (
            one.turbines[i],
            f"{one.compared.title} [{one.compared.unit}]",
            f"{math.exp(one.x[i]):.3g}",
            f"{math.exp(one.center):.3g}",
            f"{100 * math.expm1(one.x[i] - one.center):+.0f} %",
            f"{one.p[i]:.2g}" if one.p[i] > 2.0 * len(found) / DRAWS else f"< {2.0 * len(found) / DRAWS:.1g}",
        )
        for one in judged
        for i in one.outliers
    )
    head = ("turbine", "quantity", "value", "median", "departs", "chance")
    table = Table("Turbines that depart from the others", head, rows, left=(0, 1)) if rows else None
    return section(
        "Outliers",
        tables_html((table, "None: what the turbines differ by is what chance and their bounds explain.")),
    )


def _ranking(
    column: str, compared: Sequence[Compared], done: Sequence[Mapping], found: Sequence[Spread]
) -> str:
    there = [one for one in compared if any(math.isfinite(number(row, one.column)) for row in done)]
    if not there:
        return ""
    key = [(-v if math.isfinite(v := number(row, column)) else math.inf) for row in done]
    order = sorted(range(len(done)), key=lambda i: (key[i], str(done[i]["turbine"])))
    odd = {one.turbines[i] for one in found for i in one.outliers}
    rows = tuple(
        (str(place), text_of(done[i]["turbine"]), *(_value(done[i], one) for one in there))
        for place, i in enumerate(order[:RANKED], 1)
    )
    marked = tuple(k for k, i in enumerate(order[:RANKED]) if str(done[i]["turbine"]) in odd)
    head = ("", "turbine", *(f"{one.title} [{one.unit}]" for one in there))
    by = next((one.title for one in compared if one.column == column), column)
    more = f" The first {RANKED} of {len(done)}; all are in {CSV}." if len(done) > RANKED else ""
    note = f"In brackets 95 % bounds. Outliers are set off.{more}"
    table = Table(f"By the {by}, the largest first", head, rows, left=(1,), marked=marked, note=note)
    return section("Ranking", tables_html((table, "")))


def _method(fleet: Mapping, found: Sequence[Spread]) -> str:
    options = entry(fleet, "options")
    stated = ", ".join(f"{k} = {v}" for k, v in options.items()) if isinstance(options, Mapping) else ""
    lines = [
        f"Each turbine was treated alone, with the same options ({stated})."
        if stated
        else "Each turbine was treated alone.",
        "Outliers: the distance of each turbine’s logarithm from the median, in median absolute deviations "
        "from which the turbines’ own bounds are taken out and added again for each, is compared with the "
        f"largest distance in as many normal numbers ({DRAWS} simulated fleets at most). The chance of any "
        f"false outlier is {100 * LEVEL:.0f} % for the whole fleet and all quantities together, if turbines "
        f"differ normally; fewer than {FEWEST} turbines are not judged. A turbine that departs is not "
        "therefore faulty: it may stand, run or be built otherwise.",
        f"All numbers are in {CSV}, each turbine’s results in its folder.",
    ]
    made = f"Done by hygrokf {text_of(fleet.get('version'))}; page written by hygrokf {__version__}."
    said = "".join(f"<p>{prose(line)}</p>" for line in lines)
    return f"<footer><h2>Data and method</h2>{said}<p>{escape(made)}</p></footer>"
