"""`report.html` of a comparison: Table III with bounds, differences, the sceptic's rules, pictures."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from functools import partial
from html import escape
from pathlib import Path

import numpy as np

from hygrokf.data.files import COMPARISON, COMPARISON_TABLE, REPORT, write_text_whole
from hygrokf.identification.results import ResultFault, dump
from hygrokf.identification.wording import NONE, RULES, fixed, minus, percent, sentence, text_of
from hygrokf.report.figures.transfer import QUANTITIES, figure_errors, figure_weeks
from hygrokf.report.fit_tables import Table
from hygrokf.report.html import document, figure_html, numbers_html, prose, section, tables_html
from hygrokf.transfer.comparison import ALL_PERIODS, REGIMES, Comparison, comparison_csv
from hygrokf.version import __version__

PERIODS = {
    "whole": "whole record (as the paper's Table III)",
    "validation": "validation (after the end of each record's identification period)",
    "identification": "identification",
}


def write_comparison(found: Comparison | None, directory: str | os.PathLike[str]) -> Path:
    """Write compare.json, compare.csv and report.html; with None the page again from compare.json.

    Returns the path of report.html.  Raises ResultFault where compare.json is missing or damaged, OSError as the system
    gives it.
    """
    folder = Path(directory)
    if found is not None:
        folder.mkdir(parents=True, exist_ok=True)
        text, table, page = (
            dump(found.to_json()),
            comparison_csv(found.results),
            comparison_page(found.results),
        )
        (folder / REPORT).unlink(missing_ok=True)
        write_text_whole(folder / COMPARISON, text)
        write_text_whole(folder / COMPARISON_TABLE, table)
        return write_text_whole(folder / REPORT, page)
    path = folder / COMPARISON
    try:
        page = comparison_page(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError, RecursionError, KeyError, TypeError, AttributeError) as fault:
        raise ResultFault(
            f"{path}: expected the results of `hygrokf compare`, found {type(fault).__name__} {fault}; run it again"
        ) from None
    return write_text_whole(folder / REPORT, page)


def comparison_page(found: Mapping) -> str:
    """The whole page as HTML text: a pure function of the data of compare.json."""
    labels = [text_of(one["label"]) for one in found["columns"]]
    parts = [
        _head(found, labels),
        *(numbers_html(one.get("verdicts"), f"{one['label']}: the fit {one['fit']}") for one in found["columns"]),
        section("In short", *(f"<p>{prose(line)}</p>" for line in summary(found))),
        section(
            "Errors side by side",
            *tables(found),
            *(
                figure_html(f"errors-{period}", f"Errors, {period}", caption, partial(figure_errors, found, period))
                for period, caption in _CAPTIONS.items()
            ),
        ),
        section("Differences on the same instants", tables_html((differences_table(found), "No two columns have instants in common.")), _NOTE),
        section("Against rules that need no model", tables_html((skill_table(found), "No rule could be tried."))),
        section("In the course of time", figure_html("weeks", "Errors by week", "Weeks in which one column alone goes astray show where to look.", lambda: figure_weeks(_weeks(found)))),
        _foot(found),
    ]  # fmt: skip
    return document(f"{', '.join(labels)} – hygrokf comparison", parts)


_CAPTIONS = {
    "whole": "Points with 95 % bounds of a block bootstrap; upright strokes: the best rule without a model, in total.",
    "validation": "The same after the end of each record's identification period.",
}
_NOTE = (
    "<p class=note>Both columns’ errors are drawn in the same blocks of time, so what the weather did to both at once "
    "cancels: bounds of a difference may exclude zero where those of the two errors overlap.</p>"
)


def _head(found: Mapping, labels: list[str]) -> str:
    banner = ""
    if found.get("synthetic"):
        banner = (
            "<p class='banner synthetic'><b>SYNTHETIC</b> At least one of these records was made by a computer: its "
            "numbers were not measured.</p>"
        )
    rows = [
        f"{one['label']}: fit {one['fit']} on {one['case']}"
        + (", identified there" if one["identified_here"] else "")
        for one in found["columns"]
    ]
    notes = [f"{one['label']}: {line}" for one in found["columns"] for line in one["statements"]]
    meta = "".join(f"<p class=meta>{prose(line)}</p>" for line in (*rows, *notes))
    return (
        "<header><p class=kind>Hygrothermal model of an enclosure · comparison</p>"
        f"<h1>{escape(' · '.join(labels))}</h1>{meta}{banner}</header>"
    )


def summary(found: Mapping) -> list[str]:
    """Which differences are sure, in sentences: in validation; where that is too short for bounds, also as a whole."""
    said = []
    for one in found["differences"]:
        for quantity in QUANTITIES:
            rows = [(p, _total(one, p, quantity)) for p in ("validation", "whole")]
            there = [(p, row) for p, row in rows if row is not None]
            last = next((i for i, (_, row) in enumerate(there) if row["lower"] is not None), 0)
            said += [_sentence(one, quantity, period, row) for period, row in there[: last + 1]]
    return said or ["The columns have no instants in common: compare their errors with their own bounds."]


def _sentence(one: Mapping, quantity: str, period: str, row: Mapping) -> str:
    name, unit = QUANTITIES[quantity]
    where = "in validation" if period == "validation" else "over the whole record"
    less, more = (one["of"], one["less"]) if row["value"] < 0 else (one["less"], one["of"])
    if row["lower"] is None:
        sure = "; too few blocks for bounds"
    elif row["lower"] > 0 or row["upper"] < 0:
        ends = sorted((abs(row["lower"]), abs(row["upper"])))
        sure = f" (95 % {fixed(ends[0])} … {fixed(ends[1])})"
    else:
        sure = "; the bounds include no difference"
    size = f"{fixed(abs(row['value']))} {unit}"
    return sentence(f"{less} simulates the {name} {where} with {size} less error than {more}{sure}")


def _total(one: Mapping, period: str, quantity: str) -> Mapping | None:
    """A difference's total in a period, None where no instants are common."""
    row = one["scores"].get(period, {}).get(quantity, {}).get("total")
    return None if row is None or row["value"] is None else row


def tables(found: Mapping) -> list[str]:
    """Table III for each period that holds readings."""
    return [
        tables_html((table, "")) for period in PERIODS if (table := scores_table(found, period)) is not None
    ]


def scores_table(found: Mapping, period: str) -> Table | None:
    """Table III of one period: op, st, tot for both quantities, bounds and n of the total."""
    rows = []
    for one in found["columns"]:
        cells = [one["label"]]
        for quantity in QUANTITIES:
            by = one["scores"][period].get(quantity)
            if by is None or by["total"]["rmse"] is None:
                cells += [NONE] * 5
                continue
            cells += [_value(by[regime]["rmse"]) for regime in REGIMES]
            cells += [_span(by["total"]), str(by["total"]["n"])]
        if any(cell != NONE for cell in cells[1:]):
            rows.append(tuple(cells))
    if not rows:
        return None
    columns = ("op", "st", "tot", "tot, 95 %", "n")
    return Table(
        f"RMSE, {PERIODS[period]}",
        ("", *columns, *columns),
        tuple(rows),
        groups=(("", 1), ("temperature [K]", 5), ("absolute humidity [g/m³]", 5)),
    )


def differences_table(found: Mapping) -> Table | None:
    """RMSE of one column less that of another, by period and regime; those that bounds keep from zero are set off."""
    rows: list[tuple[str, ...]] = []
    marked: list[int] = []
    for one in found["differences"]:
        for period in (p for p in PERIODS if p in ALL_PERIODS):
            for quantity, by in one["scores"][period].items():
                if by["total"]["value"] is None:
                    continue
                name, unit = QUANTITIES[quantity]
                total = by["total"]
                if total["lower"] is not None and (total["lower"] > 0 or total["upper"] < 0):
                    marked.append(len(rows))
                cells = [_signed(by[regime]["value"]) for regime in REGIMES]
                rows.append(
                    (
                        f"{one['of']} − {one['less']}",
                        f"{name} [{unit}]",
                        period,
                        *cells,
                        _span(total),
                        str(total["n"]),
                    )
                )
    if not rows:
        return None
    return Table(
        "Difference of RMSE",
        ("", "quantity", "period", "op", "st", "tot", "tot, 95 %", "n"),
        tuple(rows),
        left=(0, 1, 2),
        marked=tuple(marked),
        note=(
            "Set off: bounds that exclude zero. Other readings: the columns stand for different cabinets or loggers, so the "
            "difference is also one of these."
        ),
    )


def skill_table(found: Mapping) -> Table | None:
    """Skill 1 − MSE/MSE of each rule, in validation (the whole record without one), in total."""
    rows = []
    for one in found["columns"]:
        for quantity, (name, _) in QUANTITIES.items():
            period = next(
                (
                    p
                    for p in ("validation", "whole")
                    if (one["scores"][p].get(quantity) or {}).get("total", {}).get("n")
                ),
                None,
            )
            if period is None:
                continue
            total = one["scores"][period][quantity]["total"]
            for rule, said in total["rules"].items():
                rows.append(
                    (
                        one["label"], name, RULES.get(rule, rule), period, _value(said["rmse"]), _value(total["rmse"]),
                        minus(percent(said["skill"])) if said["skill"] is not None else NONE,
                        NONE if said["lower"] is None else f"{minus(percent(said['lower']))} … {minus(percent(said['upper']))}",
                    )
                )  # fmt: skip
    if not rows:
        return None
    return Table(
        "Skill",
        ("", "quantity", "rule", "period", "rule", "model", "skill", "95 %"),
        tuple(rows),
        left=(0, 1, 2, 3),
        groups=(("", 4), ("RMSE", 2), ("", 2)),
        note=(
            "Skill: 1 − MSE of the model / MSE of the rule; 100 % is no error, 0 % no gain, below zero the rule is better. "
            "The rule of the temperature was fitted to the record's own identification period."
        ),
    )


def _weeks(found: Mapping) -> list[tuple[str, dict]]:
    return [
        (
            one["label"],
            {q: tuple(np.array(part, dtype=float) for part in pair) for q, pair in one["weeks"].items()},
        )
        for one in found["columns"]
    ]


def _value(value: float | None) -> str:
    return NONE if value is None else fixed(value)


def _signed(value: float | None) -> str:
    return NONE if value is None else f"{'+' if value > 0 else ''}{fixed(value)}"


def _span(row: Mapping) -> str:
    return NONE if row["lower"] is None else f"{fixed(row['lower'])} … {fixed(row['upper'])}"


def _foot(found: Mapping) -> str:
    lines = (
        "Errors are those of the free run: the model driven by its inputs alone, where all inputs are known.",
        "Bounds come from a bootstrap of circular blocks of hours, each four times as long as the errors remember and at "
        "least a day, widened for the blocks’ small number by Student’s t. They know how much an error varies within this "
        "record, not in another season. Where standstills fill fewer than four blocks no bounds are given.",
        "Differences are taken on the instants that both columns score, with the same blocks drawn for both.",
    )
    made = f"Compared by hygrokf {text_of(found['version'])}; page written by hygrokf {__version__}."
    return f"<footer><h2>Method</h2>{''.join(f'<p>{prose(line)}</p>' for line in (*lines, made))}</footer>"
