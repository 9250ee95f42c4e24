"""The blocks, page and text of a comparison: errors side by side, differences with bounds, simple rules."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from hygrokf.data.files import COMPARISON, COMPARISON_SERIES, COMPARISON_TABLE, REPORT, write_text_whole
from hygrokf.data.result_file import read_result, result_text
from hygrokf.evaluation.scoring import REGIMES, SCORED
from hygrokf.report.blocks import (
    FREE_RUN,
    OF_RECORDS,
    Block,
    Card,
    Cards,
    Details,
    Figure,
    Page,
    Prose,
    Table,
    inherited_verdicts,
    method,
    section,
    table_or,
    unmeasured,
)
from hygrokf.report.figures.comparison_figures import (
    figure_column_courses,
    figure_errors,
    figure_weeks,
    short_labels,
)
from hygrokf.report.page import page_html
from hygrokf.report.quantities import interval, quantity, share_text, versions
from hygrokf.texts.statement import Value
from hygrokf.texts.transfer_codes import TransferCode
from hygrokf.texts.wording import RULES, fixed, sentence, signed
from hygrokf.transfer.comparison import (
    ComparisonColumn,
    ComparisonResults,
    ErrorRow,
)
from hygrokf.transfer.transfer_results import RecordCourse, read_courses, write_courses

PERIODS = ("whole", "validation", "identification")
COMMAND = "hygrokf compare"
LEAST_DIFFERENCE = 0.005
"""Difference of two errors [K], [g/m³] that two decimals do not show."""
MOST_PAIRS = 3
"""Pairs whose differences are not folded."""
METHOD = (
    "Instants at which an input is unknown are not scored.",
    "Bounds come from a bootstrap of circular blocks of hours. A block is four times as long as the errors "
    "are correlated, and at least a day. Student's t widens the bounds for the small number of blocks. They "
    "show how much an error varies within this record, not in another season. Standstills that fill fewer "
    "than four blocks have no bounds.",
    "Differences are taken at the instants that both columns score, with the same blocks drawn for both.",
)


# --- files -----------------------------------------------------------------------------------


def write_comparison(
    found: ComparisonResults | None,
    directory: str | os.PathLike[str],
    columns: Sequence[ComparisonColumn] = (),
) -> Path:
    """Write compare.json, compare.csv, compare.npz and report.html; with None the page again from these.

    Returns the path of report.html.  Raises ResultFault where compare.json is missing or damaged, OSError
    from the system.
    """
    folder = Path(directory)
    if found is None:
        return write_text_whole(folder / REPORT, page_html(comparison_blocks(*read_comparison(folder))))
    courses = [column.course for column in columns]
    text = result_text(found)
    table = found.to_frame().to_csv(index=False, float_format="%.6g", lineterminator="\n")
    page = page_html(comparison_blocks(found, courses))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / REPORT).unlink(missing_ok=True)
    write_text_whole(folder / COMPARISON, text)
    write_text_whole(folder / COMPARISON_TABLE, table)
    write_courses(courses, folder / COMPARISON_SERIES)
    return write_text_whole(folder / REPORT, page)


def read_comparison(directory: str | os.PathLike[str]) -> tuple[ComparisonResults, tuple[RecordCourse, ...]]:
    """The results and courses in a directory; no courses where compare.npz is missing, as in earlier results.

    Raises ResultFault with all faults.
    """
    folder = Path(directory)
    found = read_result(ComparisonResults, folder / COMPARISON, COMMAND)
    path = folder / COMPARISON_SERIES
    if not path.exists():
        return found, ()
    return found, read_courses(path, len(found.columns), COMMAND)


# --- the page --------------------------------------------------------------------------------


def comparison_blocks(found: ComparisonResults, courses: Sequence[RecordCourse] = ()) -> Page:
    """What a comparison says: which column errs less, and the courses, first."""
    labels = [column.label for column in found.columns]
    cards = tuple(_card(found, q) for q in SCORED if found.errors("whole", q))
    scores = [scores_table(found, name) for name in SCORED]
    differences = [differences_table(found, *pair) for pair in found.pairs]
    skill = skill_table(found)
    verdicts = [
        inherited_verdicts(column.verdicts, f"{column.label}: the fit {column.fit}")
        for column in found.columns
    ]
    notes = tuple(
        Prose(f"{column.label}: {sentence(line.text)}", "note")
        for column in found.columns
        for line in column.statements
    )
    errors = (
        Figure(f"errors-{period}", f"Errors, {period}", caption, partial(figure_errors, found, period))
        for period, caption in _CAPTIONS.items()
    )
    body = (
        *section("Errors side by side", *scores, _PERIODS, *errors),
        *section("Differences on the same instants", *_differences(differences)),
        *section("Skill against rules without a model", table_or(skill, "No rule could be tried.")),
        Details(
            "Errors over time",
            (Figure("weeks", "Errors by week", _CAPTION_WEEKS, partial(figure_weeks, found)),),
        ),
        *section("Models used", *verdicts, *notes),
    )
    return Page(
        "Comparison",
        " · ".join(labels) if len(labels) < 3 else f"{labels[0]} and {len(labels) - 1} others",
        (
            " · ".join(
                f"{column.label}: fit {column.fit} on {column.case}"
                f"{', identified there' * column.identified_here}"
                for column in found.columns
            ),
        ),
        (
            *unmeasured(found.provenance, OF_RECORDS),
            Cards(cards or (Card("Comparison", "Nothing could be scored", wide=True, words=True),)),
            Figure(
                "courses",
                "Readings and simulations",
                "The days after the identification period, twelve at most. The simulations are free runs: "
                "they should stay with the readings.",
                partial(figure_column_courses, found, courses),
            ),
        ),
        body,
        method("Method", *METHOD, f"Compared by {versions(found.version)}."),
    )


_CAPTIONS = {
    "whole": "Errors with 95 % bounds of a block bootstrap. Vertical strokes: total error of the best rule "
    "without a model.",
    "validation": "The same after the end of each record's identification period.",
}
_CAPTION_WEEKS = "Look for weeks in which only one column errs."

_PERIODS = Prose(
    f"Errors are those of the free run. {FREE_RUN} Whole: the whole record, as in the paper's Table III. "
    "Validation: after the end of each record's identification period.",
    "note",
)
_BOLD = Prose(
    "Bold: the bounds exclude zero. The bootstrap draws the same blocks of time for both columns, so that "
    "weather that affects both cancels: the bounds of a difference may exclude zero although the bounds of "
    "the two errors overlap. Other readings: the columns stand for different cabinets or loggers, which may "
    "cause the difference.",
    "note",
)


def _differences(tables: Sequence[Table]) -> tuple[Block, ...]:
    if not tables:
        return (Prose("No two columns have common instants.", "missing"),)
    rest = (
        (Details("The other pairs", tuple(tables[MOST_PAIRS:]), printed=True),) if tables[MOST_PAIRS:] else ()
    )
    return (*tables[:MOST_PAIRS], _BOLD, *rest)


# --- the answer ------------------------------------------------------------------------------


def _card(found: ComparisonResults, name: str) -> Card:
    """The column that errs least in one quantity, and its differences from the others."""
    terms = quantity(name)
    period = "validation" if found.errors("validation", name) else "whole"
    scored = found.errors(period, name)
    best = min(scored, key=lambda label: scored[label].value)
    value = f"{best}: {terms.with_unit(scored[best].value)}"
    lines = summary(found, name, best)
    label = f"Smallest error of the {terms.words}, {_WHERE[period]}"
    return Card(label, value, lines=tuple(lines[:2]), words=True, tone="plain")


_WHERE = {
    "validation": TransferCode.OVER_VALIDATION(),
    "whole": TransferCode.OVER_WHOLE_RECORD(),
}


def summary(found: ComparisonResults, name: str, best: str) -> list[str]:
    """The differences of the best column from the others in one quantity, in sentences: in validation, and
    over the whole record where the validation is too short for bounds."""
    said = []
    for of, less in (pair for pair in found.pairs if best in pair):
        rows = [found.row("difference", of, period, name, against=less) for period in _WHERE]
        rows = [row for row in rows if row.n]
        last = next((i for i, row in enumerate(rows) if math.isfinite(row.lower)), 0)
        said += [_sentence(row) for row in rows[: last + 1]]
    if not said and len(found.columns) > 1:
        return [sentence(TransferCode.NO_COMMON_INSTANTS().text)]
    return said


def _sentence(row: ErrorRow) -> str:
    if math.isnan(row.lower):
        bounds = TransferCode.BOUNDS_LACKING()
    elif row.sure:
        lower, upper = sorted((abs(row.lower), abs(row.upper)))
        bounds = TransferCode.BOUNDS_STATED(lower=lower, upper=upper)
    else:
        bounds = TransferCode.BOUNDS_INCLUDE_ZERO()
    terms = quantity(row.quantity)
    values: dict[str, Value] = {"unit": terms.unit, "period": _WHERE[row.period], "bounds": bounds}
    if abs(row.value) < LEAST_DIFFERENCE:
        least = 2.0 * LEAST_DIFFERENCE
        statement = TransferCode.DIFFERS_LITTLE(first=row.column, second=row.against, least=least, **values)
    else:
        better, worse = (row.column, row.against) if row.value < 0 else (row.against, row.column)
        difference = abs(row.value)
        statement = TransferCode.ERRS_LESS(better=better, worse=worse, difference=difference, **values)
    return f"{statement}."


# --- tables ----------------------------------------------------------------------------------


def scores_table(found: ComparisonResults, name: str) -> Table:
    """Table III of one quantity: operation, standstill and total by column and period."""
    labels, rows = short_labels([column.label for column in found.columns]), []
    for period in PERIODS:
        for column, label in zip(found.columns, labels, strict=True):
            if (total := found.errors(period, name).get(column.label)) is not None:
                regimes = (found.row("rmse", column.label, period, name, regime) for regime in REGIMES)
                cells = (fixed(row.value) for row in regimes)
                rows.append((label, period, *cells, interval(total.lower, total.upper), str(total.n)))
    return Table(
        quantity(name).rmse,
        ("", "period", *REGIMES, "total, 95 %", "n"),
        tuple(rows),
        left=(0, 1),
    )


def differences_table(found: ComparisonResults, of: str, less: str) -> Table:
    """RMSE of one column less that of another; rows whose bounds exclude zero are bold."""
    rows: list[tuple[str, ...]] = []
    marked: list[int] = []
    for name in SCORED:
        for period in PERIODS:
            by_regime = {
                regime: found.row("difference", of, period, name, regime, less) for regime in REGIMES
            }
            total = by_regime["total"]
            if not total.n:
                continue
            if total.sure:
                marked.append(len(rows))
            others = "" if total.same_readings else ", other readings"
            cells = (signed(row.value) for row in by_regime.values())
            span = interval(total.lower, total.upper)
            rows.append((f"{quantity(name).change}{others}", period, *cells, span, str(total.n)))
    return Table(
        f"RMSE of {of} less that of {less}",
        ("", "period", *REGIMES, "total, 95 %", "n"),
        tuple(rows),
        left=(0, 1),
        marked=tuple(marked),
    )


def skill_table(found: ComparisonResults) -> Table:
    """Skill against each rule, in total, in validation (over the whole record where there is none)."""
    labels, rows = short_labels([column.label for column in found.columns]), []
    for column, label in zip(found.columns, labels, strict=True):
        for name in SCORED:
            period = next((p for p in _WHERE if column.label in found.errors(p, name)), None)
            if period is None:
                continue
            total = found.errors(period, name)[column.label]
            for rule in RULES:
                skill, error = (
                    found.row(kind, column.label, period, name, against=rule) for kind in ("skill", "rule")
                )
                if not skill.n:
                    continue
                bounds = interval(skill.lower, skill.upper, share_text)
                cells = (fixed(error.value), fixed(total.value), share_text(skill.value), bounds)
                rows.append((label, quantity(name).words, RULES[rule], period, *cells))
    return Table(
        "Skill",
        ("", "quantity", "rule", "period", "rule", "model", "skill", "95 %"),
        tuple(rows),
        left=(0, 1, 2, 3),
        groups=(("", 4), ("RMSE", 2), ("", 2)),
        note="Skill: 1 − mean squared error of the model / that of the rule. 100 %: no error; 0 %: no gain; "
        "below zero the rule is better. The rule of the temperature was fitted to the record's "
        "identification period.",
        brief=(0, 2, 3, 6, 7),
    )
