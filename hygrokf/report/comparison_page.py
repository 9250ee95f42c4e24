"""The page of a comparison: errors side by side, differences with bounds, and skill against simple rules."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from hygrokf.data.files import COMPARISON, COMPARISON_SERIES, COMPARISON_TABLE, REPORT, write_text_whole
from hygrokf.data.result_file import read_result, result_text
from hygrokf.evaluation.scoring import REGIMES
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
from hygrokf.report.fit_tables import RegimeRow, regimes_table
from hygrokf.report.page import page_html
from hygrokf.report.quantities import interval, quantity, share_text, versions
from hygrokf.texts.parts import SCORED
from hygrokf.texts.statement import Value
from hygrokf.texts.transfer_codes import TransferCode
from hygrokf.texts.wording import RULE_NAMES, fixed, sentence, signed
from hygrokf.transfer.comparison import (
    ComparisonColumn,
    ComparisonResults,
    ErrorRow,
)
from hygrokf.transfer.transfer_results import RecordCourse, read_courses, write_courses

COMPARED_PERIODS = ("whole", "validation", "identification")
COMPARE_COMMAND = "hygrokf compare"
LEAST_DIFFERENCE = 0.005
"""[K], [g/m³] a smaller difference of two errors does not show in two decimals."""
MOST_PAIRS = 3
"""Number of pairs of columns whose tables are shown; further tables are folded."""
COMPARISON_METHOD = (
    "Instants at which an input is unknown are not scored.",
    "Bounds come from a bootstrap of circular blocks of hours. A block is four times as long as the errors "
    "are correlated, and at least a day. Student's t widens the bounds for the small number of blocks. They "
    "show how much an error varies within this record, not in another season. Standstills that fill fewer "
    "than four blocks have no bounds.",
    "Differences are taken at the instants that both columns score, with the same blocks drawn for both.",
)


# --- files -----------------------------------------------------------------------------------


def write_comparison(
    results: ComparisonResults | None,
    directory: str | os.PathLike[str],
    columns: Sequence[ComparisonColumn] = (),
) -> Path:
    """Write compare.json, compare.csv, compare.npz and report.html, and return the path of report.html.

    results: None: only the page is written, from the files that the directory holds.

    Raises ResultFault if compare.json is missing or damaged, OSError from the system.
    """
    folder = Path(directory)
    if results is None:
        return write_text_whole(folder / REPORT, page_html(comparison_blocks(*read_comparison(folder))))
    courses = [column.course for column in columns]
    text = result_text(results)
    table = results.to_frame().to_csv(index=False, float_format="%.6g", lineterminator="\n")
    page = page_html(comparison_blocks(results, courses))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / REPORT).unlink(missing_ok=True)
    write_text_whole(folder / COMPARISON, text)
    write_text_whole(folder / COMPARISON_TABLE, table)
    write_courses(courses, folder / COMPARISON_SERIES)
    return write_text_whole(folder / REPORT, page)


def read_comparison(directory: str | os.PathLike[str]) -> tuple[ComparisonResults, tuple[RecordCourse, ...]]:
    """Read the results and courses in a directory; no courses if compare.npz is missing, as in earlier
    versions.

    Raises ResultFault with all faults.
    """
    folder = Path(directory)
    results = read_result(ComparisonResults, folder / COMPARISON, COMPARE_COMMAND)
    path = folder / COMPARISON_SERIES
    if not path.exists():
        return results, ()
    return results, read_courses(path, len(results.columns), COMPARE_COMMAND)


# --- the page --------------------------------------------------------------------------------


def comparison_blocks(results: ComparisonResults, courses: Sequence[RecordCourse] = ()) -> Page:
    """Return the page of a comparison; the columns with the smallest errors and the courses come first."""
    labels = [column.label for column in results.columns]
    cards = tuple(_card(results, name) for name in SCORED if results.errors("whole", name))
    scores = [scores_table(results, name) for name in SCORED]
    differences = [differences_table(results, *pair) for pair in results.pairs]
    skill = skill_table(results)
    verdicts = [
        inherited_verdicts(column.verdicts, f"{column.label}: the fit {column.fit}")
        for column in results.columns
    ]
    notes = tuple(
        Prose(f"{column.label}: {sentence(statement.text)}", "note")
        for column in results.columns
        for statement in column.statements
    )
    errors = (
        Figure(f"errors-{period}", f"Errors, {period}", caption, partial(figure_errors, results, period))
        for period, caption in _CAPTIONS.items()
    )
    body = (
        *section("Errors side by side", *scores, _PERIODS, *errors),
        *section("Differences on the same instants", *_differences(differences)),
        *section("Skill against rules without a model", table_or(skill, "No rule could be tried.")),
        Details(
            "Errors over time",
            (Figure("weeks", "Errors by week", _CAPTION_WEEKS, partial(figure_weeks, results)),),
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
                for column in results.columns
            ),
        ),
        (
            *unmeasured(results.provenance, OF_RECORDS),
            Cards(cards or (Card("Comparison", "Nothing could be scored", wide=True, words=True),)),
            Figure(
                "courses",
                "Readings and simulations",
                "The days after the identification period, twelve at most. The simulations are free runs: "
                "they should stay with the readings.",
                partial(figure_column_courses, results, courses),
            ),
        ),
        body,
        method("Method", *COMPARISON_METHOD, f"Compared by {versions(results.version)}."),
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
    """Return the tables of differences, the first `MOST_PAIRS` open and the others folded."""
    if not tables:
        return (Prose("No two columns have common instants.", "missing"),)
    further_tables = (
        (Details("The other pairs", tuple(tables[MOST_PAIRS:]), printed=True),) if tables[MOST_PAIRS:] else ()
    )
    return (*tables[:MOST_PAIRS], _BOLD, *further_tables)


# --- the answer ------------------------------------------------------------------------------


def _card(results: ComparisonResults, name: str) -> Card:
    """The card of a quantity: the column with the smallest error, and its differences from the others."""
    terms = quantity(name)
    period = "validation" if results.errors("validation", name) else "whole"
    errors_by_label = results.errors(period, name)
    best_label = min(errors_by_label, key=lambda label: errors_by_label[label].value)
    value = f"{best_label}: {terms.with_unit(errors_by_label[best_label].value)}"
    lines = summary(results, name, best_label)
    label = f"Smallest error of the {terms.words}, {_WHERE[period]}"
    return Card(label, value, lines=tuple(lines[:2]), words=True, tone="plain")


_WHERE = {
    "validation": TransferCode.OVER_VALIDATION(),
    "whole": TransferCode.OVER_WHOLE_RECORD(),
}


def summary(results: ComparisonResults, name: str, best_label: str) -> list[str]:
    """Return sentences on how the best column differs from the others in one quantity: in the validation
    period, and also over the whole record if the validation period is too short for bounds."""
    sentences = []
    for column, reference in (pair for pair in results.pairs if best_label in pair):
        rows = [results.row("difference", column, period, name, against=reference) for period in _WHERE]
        rows = [row for row in rows if row.n]
        last_row = next((number for number, row in enumerate(rows) if math.isfinite(row.lower)), 0)
        sentences += [_sentence(row) for row in rows[: last_row + 1]]
    if not sentences and len(results.columns) > 1:
        return [sentence(TransferCode.NO_COMMON_INSTANTS().text)]
    return sentences


def _sentence(row: ErrorRow) -> str:
    """Return a difference of two columns in a sentence."""
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


def scores_table(results: ComparisonResults, name: str) -> Table:
    """Return the errors of one quantity by column, period and regime (Table III of the paper)."""
    labels = short_labels([column.label for column in results.columns])
    rows: list[RegimeRow] = []
    for period in COMPARED_PERIODS:
        for column, label in zip(results.columns, labels, strict=True):
            if (total := results.errors(period, name).get(column.label)) is not None:
                regimes = [results.row("rmse", column.label, period, name, regime) for regime in REGIMES]
                values = [row.value for row in regimes]
                rows.append(((label, period), values, (total.lower, total.upper), total.n))
    return regimes_table(quantity(name).rmse, rows, heads=("", "period"))


def differences_table(results: ComparisonResults, column: str, reference: str) -> Table:
    """RMSE of `column` minus that of `reference`, by quantity and period; bold if the bounds exclude zero."""
    rows: list[RegimeRow] = []
    bold_rows: list[int] = []
    for name in SCORED:
        for period in COMPARED_PERIODS:
            by_regime = {
                regime: results.row("difference", column, period, name, regime, reference)
                for regime in REGIMES
            }
            total = by_regime["total"]
            if not total.n:
                continue
            if total.sure:
                bold_rows.append(len(rows))
            remark = "" if total.same_readings else ", other readings"
            values = [row.value for row in by_regime.values()]
            labels = (f"{quantity(name).change}{remark}", period)
            rows.append((labels, values, (total.lower, total.upper), total.n))
    return regimes_table(
        f"RMSE of {column} minus RMSE of {reference}",
        rows,
        heads=("", "period"),
        number=signed,
        marked=tuple(bold_rows),
    )


def skill_table(results: ComparisonResults) -> Table:
    """The skill against each rule in the validation period; without one over the whole record."""
    labels, rows = short_labels([column.label for column in results.columns]), []
    for column, label in zip(results.columns, labels, strict=True):
        for name in SCORED:
            period = next(
                (candidate for candidate in _WHERE if column.label in results.errors(candidate, name)), None
            )
            if period is None:
                continue
            total = results.errors(period, name)[column.label]
            for rule in RULE_NAMES:
                skill, error = (
                    results.row(kind, column.label, period, name, against=rule) for kind in ("skill", "rule")
                )
                if not skill.n:
                    continue
                bounds = interval(skill.lower, skill.upper, share_text)
                cells = (fixed(error.value), fixed(total.value), share_text(skill.value), bounds)
                rows.append((label, quantity(name).words, RULE_NAMES[rule], period, *cells))
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
