"""The blocks, page and text of a transfer: verdict, groups that differ, what re-estimating gains."""

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
    """Write transfer.json, transfer.npz and report.html, each record's own fit in a folder of its name, and
    type.json.

    The fit in a record's folder is the one to use there: re-estimated where that was called for.  Returns the
    path of report.html.  Raises OSError from the system.
    """
    folder = Path(directory)
    found, courses = transfer_results(transfers, pooled), [transfer.course for transfer in transfers]
    text, page = result_text(found), page_html(transfer_blocks(found, courses))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / REPORT).unlink(missing_ok=True)
    for transfer, name in zip(transfers, folders([record.name for record in found.records]), strict=True):
        if transfer.adapted is not None:
            write_fit(transfer.adapted, folder / name)
            write_report(folder / name)
    if pooled is not None:
        write_type(pooled, folder / TYPE)
    write_courses(courses, folder / TRANSFER_SERIES)
    write_text_whole(folder / TRANSFER, text)
    return write_text_whole(folder / REPORT, page)


def rewrite_transfer(directory: str | os.PathLike[str]) -> Path:
    """Write report.html again from transfer.json and transfer.npz.  Raises ResultFault where these cannot be
    read."""
    return write_text_whole(Path(directory) / REPORT, page_html(transfer_blocks(*read_transfer(directory))))


def read_transfer(directory: str | os.PathLike[str]) -> tuple[TransferResults, tuple[RecordCourse, ...]]:
    """The results and courses in a directory.  Raises ResultFault with all faults."""
    folder = Path(directory)
    found = read_result(TransferResults, folder / TRANSFER, TRANSFER_COMMAND)
    return found, read_courses(folder / TRANSFER_SERIES, len(found.records), TRANSFER_COMMAND)


def folders(names: Sequence[str]) -> list[str]:
    """A folder's name for each record: its own in plain letters, numbered where two would be the same."""
    result: list[str] = []
    for name in names:
        plain = re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-.") or "record"
        number, made = 2, plain
        while made in result:
            made, number = f"{plain}-{number}", number + 1
        result.append(made)
    return result


# --- the page --------------------------------------------------------------------------------


def transfer_blocks(found: TransferResults, courses: Sequence[RecordCourse] = ()) -> Page:
    """What a transfer says: the verdict on each record, and the held-out course of the first, first."""
    source, names = found.source.name, [record.name for record in found.records]
    cards = Cards(tuple(_card(found, record) for record in found.records))
    pictures = [
        Figure(
            f"course-{i}",
            "The first held-out days" if len(names) == 1 else f"The first held-out days of {names[i]}",
            "Twelve days at most. The simulations are free runs: they should stay with the blue readings.",
            partial(figure_course, course, bool(record.re_estimate)),
        )
        for i, (record, course) in enumerate(zip(found.records, courses, strict=False))
    ]
    body: list[Block] = []
    for i in range(len(names)):
        body += _record(found, i, pictures[i] if 0 < i < len(pictures) else None)
    kind = "type of turbine" if found.source.kind == "type" else "fit"
    handed = inherited_verdicts(found.source.verdicts, f"The time constants of {source}")
    body += section("Models used", handed)
    body += type_section(found.type)
    provenance = least_measured(record.provenance for record in found.records)
    return Page(
        "Transfer",
        f"{source} on {', '.join(names) if len(names) < 3 else f'{len(names)} records'}",
        (f"The {kind} of {source}, tried on the record{'s' if names[1:] else ''} of {', '.join(names)}.",),
        (*unmeasured(provenance, OF_RECORDS), cards, *pictures[:1]),
        tuple(body),
        method("Method", *TRANSFER_METHOD, f"Judged by {versions(found.version)}."),
    )


def _card(found: TransferResults, one: TransferResult) -> Card:
    """The verdict on one record with its reasons; of several records, with the first reason."""
    reasons = tuple(sentence(reason.text) for reason in one.reasons)
    alone = len(found.records) == 1
    return Card(
        one.name,
        sentence(one.statement.text),
        lines=reasons if alone else reasons[:1],
        wide=alone,
        words=True,
        tone=TRANSFER_TONES[one.verdict],
    )


def _record(found: TransferResults, place: int, course: Figure | None) -> tuple[Block, ...]:
    one = found.records[place]
    several = len(found.records) > 1
    reasons = [Prose(sentence(reason.text)) for reason in one.reasons] if several else []
    own = inherited_verdicts(one.verdicts, "The time constants of the model to use here")
    return section(
        f"{one.name}: which parameters transfer" if several else "What transfers",
        *reasons,
        table_or(groups_table(one), "No group of parameters could be judged."),
        Prose(" ".join(sentence(line.text) for line in one.statements), "note") if one.statements else None,
        Figure(
            f"parameters-{place}",
            "Parameters, own against the fit's",
            "The 95 % bounds include the uncertainty of both. Shaded: differences too small to matter. Red: "
            "groups that differ.",
            partial(figure_parameters, one),
        ),
        *(errors_tables(one) or (Prose("Nothing was scored.", "missing"),)),
        Prose(SETS_NOTE, "note"),
        Figure(
            f"sets-{place}",
            "Held-out errors" if one.period == "validation" else "Errors of the identification period",
            "With 95 % bounds.",
            partial(figure_sets, one),
        ),
        course,
        own,
        Details(
            "All parameters, and likelihood ratios",
            (
                table_or(transfer_parameters_table(one), "There are no parameters."),
                table_or(ratios_table(one), "No likelihood ratio was needed."),
            ),
        ),
    )


# --- tables ----------------------------------------------------------------------------------


def groups_table(one: TransferResult) -> Table:
    """Group by group: the statistic, p, the effect of the difference on the simulation, and the outcome."""
    rows: list[tuple[str, ...]] = []
    marked: list[int] = []
    for row in one.groups:
        cells: tuple[str, ...] = (NONE,) * 5
        if row.statistic is not None and row.p_adjusted is not None:
            effect = row.effect or {}
            changes = (fixed(effect.get(q, math.nan)) for q in SCORED)
            cells = (fixed(row.statistic, 1), str(row.df), p_value(row.p_adjusted), *changes)
        if row.outcome == "differs":
            marked.append(len(rows))
        rows.append((row.group, *cells, row.statement.text))
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


def errors_tables(one: TransferResult) -> tuple[Table, ...]:
    """For each quantity the errors of the four sets and the rules on the instants that all of them score."""
    held_out = one.period == "validation"
    where = "held out" if held_out else "identification period: nothing is held out"
    tables = []
    for scored, by_set in one.rmse.items():
        rows: list[RegimeRow] = []
        for name in (n for n in SET_LABELS if n in by_set):
            row = by_set[name]
            values = (row.operation, row.standstill, row.total)
            rows.append(((SET_LABELS[name],), values, row.bounds, row.n.total))
        tables.append(regimes_table(f"{quantity(scored).rmse}, {where}", rows))
    return tuple(tables)


def transfer_parameters_table(one: TransferResult) -> Table:
    """Every parameter of the cabinet: original, own, difference."""
    rows = []
    for name, row in one.parameters.items():
        cells = (NONE, NONE)
        if row.difference is not None:
            times = "× " if row.difference_is == "ratio" else ""
            bounds = interval(row.difference.lower, row.difference.upper, plain_number)
            cells = (f"{times}{plain_number(row.difference.value)}", bounds)
        both = (_with_se(row.original, row.original_se), _with_se(row.own, row.own_se))
        rows.append((f"{name} [{row.unit}]", *both, *cells))
    return Table(
        "Parameters",
        ("parameter", "original", "own", "difference", "95 %"),
        tuple(rows),
        note="± standard error. ×: ratio of own to original value. The values to use are in the record's "
        "own folder.",
    )


def ratios_table(one: TransferResult) -> Table:
    """Exact likelihood ratios on this record."""
    return Table(
        "Likelihood ratios on this record alone",
        ("", "2 ln L", "df", "factor", "p"),
        tuple(
            (r.of.text, fixed(r.likelihood_ratio, 1), str(r.df), fixed(r.factor), p_value(r.p))
            for r in one.likelihood_ratios
        ),
        note="The original values count as exact here, so a small p of the rest need not mean that it "
        "differs: the table of groups includes both uncertainties. Factor: how much coloured noise widens "
        "the bounds; 2 ln L is divided by it.",
    )


# --- the type of turbine ---------------------------------------------------------------------


def type_section(found: TurbineType | None, note: Prose | None = None) -> tuple[Block, ...]:
    """The section about a type of turbine; nothing without one."""
    if found is None:
        return ()
    picture = Figure("type", "Type and next turbine", "", partial(figure_type, found))
    return section("The type of turbine", type_table(found), note, picture)


def type_table(found: TurbineType) -> Table:
    """Each parameter of a type with bounds, its spread, and the range of the next turbine."""
    rows, alike = [], False
    for name, row in found.parameters.items():
        ends = row.in_unit()
        spread = percent(row.spread) if row.logarithmic else plain_number(row.spread)
        if row.spread < 0.01 * row.se:
            spread, alike = "0", True
        span = interval(ends["lower"], ends["upper"], plain_number)
        following = interval(ends["next_lower"], ends["next_upper"], plain_number)
        rows.append((name, plain_number(ends["value"]), span, spread, following, row.unit, str(row.turbines)))
    note = (
        "Spread: standard deviation from turbine to turbine beyond the uncertainty of the estimates (REML)."
    )
    if alike:
        note += (
            " A spread of 0 means that the uncertainty of these turbines' own estimates explains their "
            "differences, not that the next turbine is like them: a few turbines hardly determine the "
            "spread, and the range of the next turbine is then too narrow."
        )
    return Table(
        f"{len(found.turbines)} turbines: {', '.join(found.turbines)}",
        ("parameter", "type", "95 %", "spread", "next turbine, 95 %", "unit", "n"),
        tuple(rows),
        left=(0, 5),
        note=note,
        brief=(0, 1, 2, 4, 5),
    )


def _with_se(value: float, se: float) -> str:
    return plain_number(value) if math.isnan(se) else f"{plain_number(value)} ± {plain_number(se, 2)}"
