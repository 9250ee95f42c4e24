"""The page of a transfer: the verdict, the groups of parameters that differ, and the gain of
re-estimating."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Literal

from hygrokf.data.files import REPORT, TRANSFER, TRANSFER_SERIES, TYPE, write_text_whole
from hygrokf.data.record import least_measured
from hygrokf.data.result_file import read_result, result_text
from hygrokf.identification.fit import write_fit
from hygrokf.identification.turbine_type import TurbineType, write_type
from hygrokf.report.blocks import (
    FREE_RUN,
    INNOVATIONS,
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
    SET_LABELS,
    figure_course,
    figure_parameters,
    figure_sets,
    figure_type,
)
from hygrokf.report.fit_page import write_report
from hygrokf.report.fit_tables import RegimeRow, regimes_table
from hygrokf.report.page import page_html
from hygrokf.report.quantities import interval, quantity, versions
from hygrokf.texts.parts import SCORED
from hygrokf.texts.transfer_codes import TransferVerdict
from hygrokf.texts.wording import NONE, fixed, p_value, percent, plain_number, sentence
from hygrokf.transfer.transfer_results import (
    RecordCourse,
    Transfer,
    TransferResult,
    TransferResults,
    read_courses,
    transfer_results,
    write_courses,
)

TRANSFER_COMMAND = "hygrokf transfer"
SETS_NOTE = (
    f"{FREE_RUN} As it is: every parameter of the fit. Own loggers: sensor offsets and disturbances "
    "estimated on this record. Re-estimated: also the groups that differ. All its own: every parameter "
    "estimated on this record. All rows score the same instants; the fit's own page scores more where it "
    "can. The rule of the temperature was fitted to this record's identification period."
)
TRANSFER_METHOD = (
    f"{INNOVATIONS} All parameters were estimated from them on the record's identification period, with the "
    "fit's own model. A group of parameters differs if the estimates are further apart than both covariances "
    "explain (forward selection, corrected for the number of groups) and if the difference matters: 10 % of "
    "a time constant, 0.05 of R_AT/(R_AT+R_IC), 0.3 K or 0.26 g/m³ in the simulation.",
    "Sensor offsets and disturbances belong to a logger, a site and a season: they are always estimated on "
    "the record.",
    "A model does not transfer if every group of the cabinet differs, if a re-estimated parameter ends at a "
    "bound, if the record's own estimate errs by far more than the fit did on its own record, or if the "
    "re-estimated model is worse than a rule without a model, or than the fit as it is.",
)
TRANSFER_TONES: dict[TransferVerdict, Literal["plain", "open", "reject"]] = {
    TransferVerdict.TRANSFERS: "plain",
    TransferVerdict.PARTLY: "open",
    TransferVerdict.CANNOT_BE_JUDGED: "open",
    TransferVerdict.DOES_NOT_TRANSFER: "reject",
}


# --- files -----------------------------------------------------------------------------------


def write_transfer(
    transfers: Sequence[Transfer], directory: str | os.PathLike[str], pooled: TurbineType | None = None
) -> Path:
    """Write transfer.json, transfer.npz, report.html, the fit of each record in a folder of its name, and for
    a pooled type type.json; returns the path of report.html.

    The fit in a record's folder is the one to use there: re-estimated if groups of parameters differ. Raises
    OSError from the system.
    """
    folder = Path(directory)
    results, courses = transfer_results(transfers, pooled), [transfer.course for transfer in transfers]
    text, page = result_text(results), page_html(transfer_blocks(results, courses))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / REPORT).unlink(missing_ok=True)
    for transfer, name in zip(transfers, folders([record.name for record in results.records]), strict=True):
        if transfer.adapted is not None:
            write_fit(transfer.adapted, folder / name)
            write_report(folder / name)
    if pooled is not None:
        write_type(pooled, folder / TYPE)
    write_courses(courses, folder / TRANSFER_SERIES)
    write_text_whole(folder / TRANSFER, text)
    return write_text_whole(folder / REPORT, page)


def rewrite_transfer(directory: str | os.PathLike[str]) -> Path:
    """Write report.html again from the results. Raises ResultFault if they cannot be read."""
    return write_text_whole(Path(directory) / REPORT, page_html(transfer_blocks(*read_transfer(directory))))


def read_transfer(directory: str | os.PathLike[str]) -> tuple[TransferResults, tuple[RecordCourse, ...]]:
    """Read the results and courses in a directory. Raises ResultFault with all faults."""
    folder = Path(directory)
    results = read_result(TransferResults, folder / TRANSFER, TRANSFER_COMMAND)
    return results, read_courses(folder / TRANSFER_SERIES, len(results.records), TRANSFER_COMMAND)


def folders(names: Sequence[str]) -> list[str]:
    """A folder's name for each record: its name in plain letters, numbered if another record has it."""
    folder_names: list[str] = []
    for name in names:
        plain_name = re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-.") or "record"
        number, folder = 2, plain_name
        while folder in folder_names:
            folder, number = f"{plain_name}-{number}", number + 1
        folder_names.append(folder)
    return folder_names


# --- the page --------------------------------------------------------------------------------


def transfer_blocks(results: TransferResults, courses: Sequence[RecordCourse] = ()) -> Page:
    """Return the page of a transfer; the verdicts and the held-out course of the first record come first."""
    source_name, names = results.source.name, [record.name for record in results.records]
    cards = Cards(tuple(_card(results, record) for record in results.records))
    figures = [
        Figure(
            f"course-{number}",
            "The first held-out days" if len(names) == 1 else f"The first held-out days of {names[number]}",
            "Twelve days at most. The simulations are free runs: they should stay with the blue readings.",
            partial(figure_course, course, bool(record.re_estimate)),
        )
        for number, (record, course) in enumerate(zip(results.records, courses, strict=False))
    ]
    body: list[Block] = []
    for number in range(len(names)):
        body += _record(results, number, figures[number] if 0 < number < len(figures) else None)
    source_kind = "type of turbine" if results.source.kind == "type" else "fit"
    verdicts = inherited_verdicts(results.source.verdicts, f"The time constants of {source_name}")
    body += section("Models used", verdicts)
    body += type_section(results.type)
    provenance = least_measured(record.provenance for record in results.records)
    return Page(
        "Transfer",
        f"{source_name} on {', '.join(names) if len(names) < 3 else f'{len(names)} records'}",
        (
            f"The {source_kind} of {source_name}, tried on the record{'s' if names[1:] else ''} of "
            f"{', '.join(names)}.",
        ),
        (*unmeasured(provenance, OF_RECORDS), cards, *figures[:1]),
        tuple(body),
        method("Method", *TRANSFER_METHOD, f"Judged by {versions(results.version)}."),
    )


def _card(results: TransferResults, result: TransferResult) -> Card:
    """The card of a record: its verdict with the reasons; with several records only the first reason."""
    reasons = tuple(sentence(reason.text) for reason in result.reasons)
    is_only = len(results.records) == 1
    return Card(
        result.name,
        sentence(result.statement.text),
        lines=reasons if is_only else reasons[:1],
        wide=is_only,
        words=True,
        tone=TRANSFER_TONES[result.verdict],
    )


def _record(results: TransferResults, number: int, course: Figure | None) -> tuple[Block, ...]:
    """Return the section of one record; `course`: the figure of its held-out days."""
    result = results.records[number]
    several = len(results.records) > 1
    reasons = [Prose(sentence(reason.text)) for reason in result.reasons] if several else []
    verdicts = inherited_verdicts(result.verdicts, "The time constants of the model to use here")
    return section(
        f"{result.name}: which parameters transfer" if several else "What transfers",
        *reasons,
        table_or(groups_table(result), "No group of parameters could be judged."),
        Prose(" ".join(sentence(statement.text) for statement in result.statements), "note")
        if result.statements
        else None,
        Figure(
            f"parameters-{number}",
            "Parameters, own against the fit's",
            "The 95 % bounds include the uncertainty of both. Shaded: differences too small to matter. Red: "
            "groups that differ.",
            partial(figure_parameters, result),
        ),
        *(errors_tables(result) or (Prose("Nothing was scored.", "missing"),)),
        Prose(SETS_NOTE, "note"),
        Figure(
            f"sets-{number}",
            "Held-out errors" if result.period == "validation" else "Errors of the identification period",
            "With 95 % bounds.",
            partial(figure_sets, result),
        ),
        course,
        verdicts,
        Details(
            "All parameters, and likelihood ratios",
            (
                table_or(transfer_parameters_table(result), "There are no parameters."),
                table_or(ratios_table(result), "No likelihood ratio was needed."),
            ),
        ),
    )


# --- tables ----------------------------------------------------------------------------------


def groups_table(result: TransferResult) -> Table:
    """Each group of parameters: the test, the effect of its difference on the simulation, and the outcome."""
    rows: list[tuple[str, ...]] = []
    marked: list[int] = []
    for group in result.groups:
        cells: tuple[str, ...] = (NONE,) * 5
        if group.statistic is not None and group.p_adjusted is not None:
            effect = group.effect or {}
            changes = (fixed(effect.get(q, math.nan)) for q in SCORED)
            cells = (fixed(group.statistic, 1), str(group.df), p_value(group.p_adjusted), *changes)
        if group.outcome == "differs":
            marked.append(len(rows))
        rows.append((group.group, *cells, group.statement.text))
    return Table(
        "Groups of parameters",
        ("", "χ²", "df", "p", "[K]", "[g/m³]", "outcome"),
        tuple(rows),
        left=(0, 6),
        marked=tuple(marked),
        groups=(("", 4), ("changes the simulation by", 2), ("", 1)),
        note="χ²: how much of the difference is explained if this group differs too, in addition to the "
        "groups already found to differ. p: corrected for the number of groups. Changes: root mean square "
        "over the record.",
    )


def errors_tables(result: TransferResult) -> tuple[Table, ...]:
    """Return for each quantity the errors of the sets and rules, on the instants that all of them score."""
    held_out = result.period == "validation"
    where = "held out" if held_out else "identification period: nothing is held out"
    tables = []
    for quantity_name, by_set in result.rmse.items():
        rows: list[RegimeRow] = []
        for name in (set_name for set_name in SET_LABELS if set_name in by_set):
            row = by_set[name]
            values = (row.operation, row.standstill, row.total)
            rows.append(((SET_LABELS[name],), values, row.bounds, row.n.total))
        tables.append(regimes_table(f"{quantity(quantity_name).rmse}, {where}", rows))
    return tuple(tables)


def transfer_parameters_table(result: TransferResult) -> Table:
    """Return every parameter: its original value, its own value on the record, and the difference."""
    rows = []
    for name, change in result.parameters.items():
        cells = (NONE, NONE)
        if change.difference is not None:
            times = "× " if change.difference_is == "ratio" else ""
            bounds = interval(change.difference.lower, change.difference.upper, plain_number)
            cells = (f"{times}{plain_number(change.difference.value)}", bounds)
        values = (_with_se(change.original, change.original_se), _with_se(change.own, change.own_se))
        rows.append((f"{name} [{change.unit}]", *values, *cells))
    return Table(
        "Parameters",
        ("parameter", "original", "own", "difference", "95 %"),
        tuple(rows),
        note="± standard error. ×: ratio of own to original value. The values to use are in the record's "
        "own folder.",
    )


def ratios_table(result: TransferResult) -> Table:
    """Return the exact likelihood ratios on this record."""
    rows = []
    for ratio in result.likelihood_ratios:
        numbers = (fixed(ratio.likelihood_ratio, 1), str(ratio.df), fixed(ratio.factor), p_value(ratio.p))
        rows.append((ratio.of.text, *numbers))
    return Table(
        "Likelihood ratios on this record alone",
        ("", "2 ln L", "df", "factor", "p"),
        tuple(rows),
        note="The original values count as exact here, so a small p of the rest need not mean that it "
        "differs: the table of groups includes both uncertainties. Factor: how much coloured noise widens "
        "the bounds; 2 ln L is divided by it.",
    )


# --- the type of turbine ---------------------------------------------------------------------


def type_section(turbine_type: TurbineType | None, note: Prose | None = None) -> tuple[Block, ...]:
    """Return the section about a type of turbine; empty without one."""
    if turbine_type is None:
        return ()
    picture = Figure("type", "Type and next turbine", "", partial(figure_type, turbine_type))
    return section("The type of turbine", type_table(turbine_type), note, picture)


def type_table(turbine_type: TurbineType) -> Table:
    """Return each parameter of a type with its bounds, its spread, and the range of the next turbine."""
    rows, has_zero_spread = [], False
    for name, row in turbine_type.parameters.items():
        in_unit = row.in_unit()
        spread = percent(row.spread) if row.logarithmic else plain_number(row.spread)
        if row.spread < 0.01 * row.se:
            spread, has_zero_spread = "0", True
        span = interval(in_unit["lower"], in_unit["upper"], plain_number)
        next_range = interval(in_unit["next_lower"], in_unit["next_upper"], plain_number)
        rows.append(
            (name, plain_number(in_unit["value"]), span, spread, next_range, row.unit, str(row.turbines))
        )
    note = (
        "Spread: standard deviation from turbine to turbine beyond the uncertainty of the estimates (REML)."
    )
    if has_zero_spread:
        note += (
            " A spread of 0 means that the uncertainty of these turbines' own estimates explains their "
            "differences, not that the next turbine is like them: a few turbines hardly determine the "
            "spread, and the range of the next turbine is then too narrow."
        )
    return Table(
        f"{len(turbine_type.turbines)} turbines: {', '.join(turbine_type.turbines)}",
        ("parameter", "type", "95 %", "spread", "next turbine, 95 %", "unit", "n"),
        tuple(rows),
        left=(0, 5),
        note=note,
        brief=(0, 1, 2, 4, 5),
    )


def _with_se(value: float, se: float) -> str:
    """Return a value with its standard error: "1.52 ± 0.03"; the value alone if there is none."""
    return plain_number(value) if math.isnan(se) else f"{plain_number(value)} ± {plain_number(se, 2)}"
