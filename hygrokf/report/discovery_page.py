"""The page of a discovery: verdict, errors of the simulation, causes with their evidence, and what
remains."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from hygrokf.data.files import BESIDE_DISCOVERY, REPORT, write_text_whole
from hygrokf.discovery.discovery_results import (
    CauseFound,
    Discovery,
    DiscoveryResults,
    Finding,
    HeldOutTest,
    Rejected,
    read_discovery,
    write_discovery,
)
from hygrokf.discovery.residuals import RESIDUAL_QUANTITIES, Residuals
from hygrokf.identification.verdict import best_rule, inherited
from hygrokf.report.blocks import (
    FREE_RUN,
    OF_RECORD,
    Block,
    Card,
    Cards,
    Details,
    Figure,
    Heading,
    Items,
    Link,
    Page,
    Prose,
    Table,
    inherited_verdicts,
    method,
    present,
    section,
    table_or,
    unmeasured,
)
from hygrokf.report.discovery_text import (
    cause_with_form,
    chosen_words,
    count_judged,
    discovery_verdict,
    held_out_sentences,
    held_out_text,
    line_statement,
    outcome,
    readings_of,
    unchanged,
)
from hygrokf.report.figures.lead import episodes, errors_over_drivers
from hygrokf.report.figures.residual_structure import figure_day_hour, figure_error_course
from hygrokf.report.fit_page import write_report
from hygrokf.report.fit_tables import rmse_table
from hygrokf.report.page import page_html
from hygrokf.report.quantities import (
    QuantityTerms,
    capital,
    interval,
    parameter_cells,
    quantity,
    signed_percent,
    versions,
)
from hygrokf.texts.wording import NONE, fixed, one_line, p_value, percent, plain_number, sentence, stamp_text


def findings_table(findings: Sequence[Finding], column_name: str = "in the identification period") -> Table:
    """Return the significant and material errors of a simulation, worst first."""
    rows = tuple(
        (
            capital(finding.statement.text),
            f"{plain_number(finding.size, 2)} {quantity(finding.quantity).unit}",
            f"{finding.n_episodes} of {finding.n_possible}",
            percent(finding.sensor_share),
            p_value(finding.p_adjusted),
        )
        for finding in findings
    )
    return Table(
        "Worst first",
        (column_name, "size", "episodes", "sensors", "p"),
        rows,
        note=(
            "Size: error under this condition less the error at all other times. Episodes: how many of all "
            "episodes show the error. Sensors: share of the squared error that the accuracy of the sensors "
            "explains. p: probability of such an error by chance, corrected for everything that was tested."
        ),
    )


def gains_table(results: DiscoveryResults) -> Table:
    """Return the free-run errors by quantity, of the base model and (if there is one) of the extended model,
    beside the best rule that needs no model."""
    rows = []
    has_extended = results.extended is not None
    readings_by_gain = [readings_of(results, gain) for gain in results.gains]
    for gain, readings in zip(results.gains, readings_by_gain, strict=True):
        terms = quantity(gain.quantity)
        name = terms.words
        rule = best_rule(results.baseline.fit, terms.name, gain.period) if terms.name else None
        best_rule_text = NONE if rule is None else f"{terms.with_unit(rule.rule)} (“{rule.words}”)"
        cells = _pair(gain.rmse_before, gain.rmse_after, terms)
        is_changed = not unchanged(gain.rmse_before, gain.rmse_after)
        has_bounds = is_changed and math.isfinite(gain.upper - gain.lower)
        bounds = interval(gain.lower, gain.upper, symbol=terms.unit) if has_bounds else NONE
        label = name if readings == readings_by_gain[0] else f"{name}, {readings}"
        rows.append((label, *cells, bounds, best_rule_text))
        if math.isfinite(gain.driven_before):
            driven = _pair(gain.driven_before, gain.driven_after, terms)
            rows.append((f"{name}, on the measured temperature", *driven, NONE, NONE))
    first_column = f"free-run error on {readings_by_gain[0] if readings_by_gain else 'readings'}"
    models = ("base model", "extended model", "change", "bounds of the fall")
    column_names = (first_column, *models, "best rule, no model")
    shown_columns = range(6) if has_extended else (0, 1, 5)
    return Table(
        "Root mean squares",
        tuple(column_names[column] for column in shown_columns),
        tuple(tuple(row[column] for column in shown_columns) for row in rows),
        left=(0, len(shown_columns) - 1),
        brief=(0, 1, 2, 3) if has_extended else (),
        note=(
            "Bounds: 95 %. Where nothing else is said, the absolute humidity is simulated on the simulated "
            "temperature, as “hygrokf simulate” does."
        ),
    )


def _pair(before: float, after: float, terms: QuantityTerms) -> tuple[str, str, str]:
    """Return the errors before and after, and their relative change, as cells of a table."""
    change = "±0 %" if unchanged(before, after) else _change(before, after)
    return terms.with_unit(before), terms.with_unit(after), change


def held_out_table(test: HeldOutTest) -> Table:
    """Return what held-out readings show of a cause, by quantity."""
    rows = []
    for name in test.before:
        terms = quantity(name)
        numbers = (
            round(by_quantity.get(name, math.nan), 2) + 0.0 for by_quantity in (test.z, test.growth)
        )  # no −0.00
        pair = _pair(test.before[name], test.after.get(name, math.nan), terms)
        rows.append((terms.words, *pair, *map(fixed, numbers)))
    return Table(
        "Held-out readings, without and with the cause",
        ("", "without", "with", "change", "z", "growth"),
        tuple(rows),
        note=(
            "Root mean square of the free run with its levels at their least squares. z: daily mean of the "
            "squared errors’ change 3, 12 and 48 h ahead, in its standard errors. Growth: mean change of the "
            "logarithm of the squared errors. Both are below zero where the errors fall."
        ),
    )


def cause_parameters_table(cause: CauseFound) -> Table:
    """Return the parameters of a cause with their bounds."""
    rows = tuple((name, *parameter_cells(row), row.meaning) for name, row in cause.parameters.items())
    columns = ("parameter", "value", "95 % bounds", "unit", "meaning")
    return Table("Parameters", columns, rows, left=(0, 3, 4), brief=(0, 1, 2, 3))


def scores_tables(results: DiscoveryResults, period: str) -> tuple[Table, ...]:
    """Return the free-run errors of one period by regime: of the base model with the simple rules, and of the
    extended model; empty without scores."""
    models = [("base", results.baseline.fit)]
    if results.extended is not None:
        models.append(("extended", replace(results.extended.fit, baselines={})))
    return tuple(
        replace(table, heading=f"{table.heading}, {model_name} model")
        for model_name, model in models
        if (table := rmse_table(model, period))
    )


def _change(before: float, after: float) -> str:
    """Return the relative change of an error in per cent with its sign; "–" where it is unknown."""
    return signed_percent(after / before - 1.0) if before > 0 and math.isfinite(after) else NONE


def evidence_table(results: DiscoveryResults) -> Table:
    """Return every cause that was judged, ordered by its evidence; accepted causes are bold."""
    judged: list[CauseFound | Rejected] = [*results.causes, *results.refuted, *results.rejected]
    judged.sort(key=lambda row: -net if math.isfinite(net := row.evidence.evidence) else math.inf)
    rows = []
    for cause in judged:
        evidence = cause.evidence
        counts = (str(evidence.constants), str(evidence.searched)) if evidence.gains else (NONE, NONE)
        gains = (fixed(evidence.gains.get(name, math.nan), 1) for name in ("temperature", "vapour"))
        net_cells = (fixed(evidence.evidence, 1), fixed(evidence.in_days, 1))
        rows.append((capital(cause_with_form(cause)), *gains, *counts, *net_cells, outcome(results, cause)))
    return Table(
        "In order of their evidence",
        ("cause (best form)", "temp.", "hum.", "constants", "settings", "net", "in days", "outcome"),
        tuple(rows),
        left=(0, 7),
        marked=tuple(number for number, cause in enumerate(judged) if isinstance(cause, CauseFound)),
        groups=(("", 1), ("2 ln L", 2), ("paid for", 2), ("evidence", 2), ("", 1)),
        note=(
            "2 ln L: gain in twice the log-likelihood, a difference of maxima. Evidence: this gain less ln N "
            "for each constant in each quantity and 2 ln of the settings; in days: by how independent the "
            "days are."
        ),
        brief=(0, 5, 6, 7),
    )


ERRORS_TITLE = "Errors before and after"
NOT_HELD_OUT = "There is no held-out period with readings (`until` is not stated)."
BY = "By driver, by day and hour, and by period"
TOGETHER = (
    "In the order of their acceptance, each beside those before it. The errors are those of the extended "
    "model with all of them together."
)


def write_discovery_report(discovery: Discovery | None, directory: str | os.PathLike[str]) -> Path:
    """Write `report.html`, the page of a discovery, and `fit_report.html`, the page of its final model;
    returns the path of report.html.

    discovery: written first (`write_discovery`); None: the directory holds its results already.

    The page depends on `discovery.json` and `discovery.npz` alone. Raises ResultFault if one of them is
    missing or damaged, ReportFault for fit.json and series.npz.
    """
    folder = Path(directory)
    if discovery is not None:
        write_discovery(discovery, folder)
    stored = read_discovery(folder)
    write_report(folder)
    page = discovery_blocks(stored.results, stored.before, stored.after)
    return write_text_whole(folder / REPORT, page_html(page))


def discovery_blocks(
    results: DiscoveryResults, before: Residuals | None = None, after: Residuals | None = None
) -> Page:
    """Return the page of a discovery; the verdict, the worst episode and the table of gains come first.

    before, after: residuals of the base and the extended model, for the figures.
    """
    episode_figures = [] if before is None else episodes(results, before, after)
    courses = [] if before is None else _courses(results, before, after)
    lead = [*episode_figures, *courses][:1]
    evidence = evidence_table(results)
    further_episodes = [figure for figure in episode_figures if figure not in lead]
    body = (
        *section(
            "What the simulation gets wrong",
            Prose(FREE_RUN, "note"),
            table_or(
                findings_table(results.findings),
                "No significant and material error that the accuracy of the sensors does not explain.",
            ),
            *further_episodes,
        ),
        *section(
            "The causes" if len(results.causes) > 1 else "The cause",
            *(block for cause in results.causes for block in _judged(results, cause)),
            Prose(TOGETHER) if len(results.causes) > 1 else None,
        ),
        *section(
            "Refuted by held-out readings",
            *(block for cause in results.refuted for block in _judged(results, cause)),
        ),
        *_errors(results, before, after),
        *_constants(results),
        *section("Where the errors are", Details(BY, tuple(courses)) if courses else None),
        *_left(results),
        *section(
            "Causes and their evidence",
            Details(f"{len(evidence.rows)} causes", (evidence,), printed=True)
            if evidence
            else Prose("No cause was tried.", "missing"),
        ),
    )
    gains = table_or(gains_table(results), "No errors of a free run are known.")
    verdict = discovery_verdict(results)
    card = Card(
        "Verdict", verdict.headline, bounds=verdict.confidence,
        lines=tuple(map(sentence, (*verdict.reasons, *verdict.actions))), wide=True, words=True,
        tone="open" if verdict.warned else "plain",
    )  # fmt: skip
    return Page(
        "Discovery report",
        one_line(results.name).strip() or "unnamed record",
        spans_text(before),
        (*unmeasured(results.provenance, OF_RECORD), Cards((card,)), *lead, gains),
        body,
        _method(results),
    )


def spans_text(before: Residuals | None) -> tuple[str, ...]:
    """Return the period of the record and of its held-out part in words; empty without residuals."""
    if before is None or not len(before.time_h):
        return ()
    time = before.time_s
    first, last = stamp_text(time[0]), stamp_text(time[-1])
    if not before.validation.any():
        return (f"{first} to {last}; nothing held out",)
    until = stamp_text(time[before.validation.argmax()])
    return (f"{first} to {last}; searched up to {until}, held out from there on",)


# --- sections --------------------------------------------------------------------------------


def _judged(results: DiscoveryResults, cause: CauseFound | Rejected) -> tuple[Block, ...]:
    """The blocks of a judged cause: held-out test, and for an accepted cause settings and parameters."""
    blocks: list[Block | None] = [Heading(capital(cause_with_form(cause)), 3)]
    if isinstance(cause, CauseFound):
        reason_if_empty = "The cause has no parameters of its own: it corrects time stamps."
        blocks += [
            Prose(f"Found by search: {'; '.join(chosen_words(cause))}.") if cause.chosen else None,
            table_or(cause_parameters_table(cause), reason_if_empty),
        ]
    return present(
        *blocks, Prose(sentence(held_out_text(results, cause.held_out))), held_out_table(cause.held_out)
    )


def _errors(
    results: DiscoveryResults, before: Residuals | None, after: Residuals | None
) -> tuple[Block, ...]:
    """Return the section of the free-run errors: day by day on held-out readings, and by regime."""
    daily_errors = None
    if before is not None and after is not None and before.validation.any():
        daily_errors = Figure(
            "error-course",
            "The error on held-out readings, day by day",
            "The green course should stay below the red one, on most days and not on a few.",
            lambda: figure_error_course(before, after),
        )
    return section(
        ERRORS_TITLE,
        *map(Prose, held_out_sentences(results)),
        daily_errors,
        *(scores_tables(results, "validation") or [Prose(NOT_HELD_OUT, "missing")]),
        *scores_tables(results, "identification"),
    )


def _constants(results: DiscoveryResults) -> tuple[Block, ...]:
    """Return the section of the time constants, of the base model and of the extended model."""
    heading = "The time constants without and with the cause" if results.extended else "The time constants"
    base_heading = "Time constants of the base model" if results.extended else "Time constants of the model"
    models = [(results.baseline, base_heading)]
    if results.extended is not None:
        models.append((results.extended, "Time constants of the extended model"))
    return section(heading, *(inherited_verdicts(inherited(model.fit), title) for model, title in models))


def _left(results: DiscoveryResults) -> tuple[Block, ...]:
    """Return the section on what remains: periodic components, and errors of the extended model."""
    lines = (
        Items(tuple(sentence(line_statement(line).text) for line in results.lines)) if results.lines else None
    )
    errors = None
    if results.extended is not None:
        errors = table_or(
            findings_table(results.left, "of the extended model"),
            "The errors of the extended model show no structure under any tested condition.",
        )
    return section("What is left", lines, errors)


def _method(results: DiscoveryResults) -> tuple[Block, ...]:
    """Return how the discovery was made."""
    count = count_judged(results)
    model_name = "base" if results.extended is None else "extended"
    lines = (
        "The base model was simulated from its inputs alone. What it misses is taken as a disturbance that "
        "enters as flows of heat and vapour, with a spectrum of its own. Score tests under this error model "
        "looked for structure under every condition: episodes, regimes, hour, season, level, rate and lag of "
        "every driver, steps and drifts.",
        f"{count} {'cause was' if count == 1 else 'causes were'} judged, each in several forms and settings, "
        f"with {results.work.simulations:,} simulations. A cause is accepted by its evidence: what the "
        "maximum of the likelihood gains, less the price of its constants and of the settings that were "
        "tried. The same must hold by days, which are fewer than readings where they resemble each other.",
        "Choices rest on the identification readings. Held-out readings refute a cause with which the errors "
        "3, 12 and 48 h ahead or of the free run grow, one that they speak against, and one with little "
        "evidence that lowers no free-run error; they choose nothing else. The bounds of the errors’ "
        "fall take days as independent; they show how much it varies within this period, not in another "
        "season.",
        "Confidence is how often a name with such evidence and such a lead over its rivals was right on "
        "simulated plants. A cause that is not in the library cannot be named, and a cause with a similar "
        "effect may be named instead: check in the turbine before acting on it.",
    )
    return (
        *method("Data and method", *lines),
        Link(f"The {model_name} model with all its parameters:", BESIDE_DISCOVERY),
        Prose(f"Found by {versions(results.version)}."),
    )


# --- pictures --------------------------------------------------------------------------------


def _courses(results: DiscoveryResults, before: Residuals, after: Residuals | None) -> list[Figure]:
    """Return the figures of the errors over the drivers, and by day and hour."""
    return [
        errors_over_drivers(results, before, after),
        *(
            Figure(
                f"days-{name}",
                f"Error of the {quantity(name).words} by day and hour",
                "Horizontal stripes: errors tied to the time of day. Vertical stripes: errors tied to "
                "weather or operation. A lasting change of colour: something changed on that date.",
                partial(figure_day_hour, before, name, after),
            )
            for name in RESIDUAL_QUANTITIES
        ),
    ]
