"""The page of a fit: `report.html` from `fit.json` and `series.npz`."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from hygrokf.data.files import BESIDE_DISCOVERY, DISCOVERY, FIT, REPORT, write_text_whole
from hygrokf.data.result_file import ResultFault, read_result
from hygrokf.errors import HygrokfError
from hygrokf.evaluation.innovation_tests import NOTE
from hygrokf.identification.fit import read_series
from hygrokf.identification.fit_results import FitResults
from hygrokf.identification.verdict import inherited, with_verdicts
from hygrokf.report.blocks import (
    FREE_RUN,
    INNOVATIONS,
    OF_RECORD,
    Banner,
    Block,
    Card,
    Cards,
    Details,
    Items,
    Line,
    Page,
    Prose,
    Table,
    Verdicts,
    method,
    section,
    table_or,
    unmeasured,
)
from hygrokf.report.figures.fit_figures import FIGURES, PRODUCT, figure_of
from hygrokf.report.fit_tables import (
    actuators_table,
    bands_table,
    fit_parameters_table,
    innovations_table,
    optima_table,
    rmse_table,
    time_constants_table,
)
from hygrokf.report.fit_text import free_run_text, judgements, level_and_method, range_text
from hygrokf.report.page import page_html
from hygrokf.report.quantities import place, versions
from hygrokf.texts.parts import PARTS
from hygrokf.texts.reasons import BELIEVE, CAUTION, REJECT, ReasonCode
from hygrokf.texts.wording import UNBOUNDED, fixed, moment, one_line, sentence


class ReportFault(HygrokfError):
    """Results from which no page can be made; the message lists everything that is wrong with them."""


def write_report(directory: str | os.PathLike[str]) -> Path:
    """Write the page of a fit, `report.html`, beside `fit.json` and `series.npz`.

    directory: that of the two files. If it also holds a discovery, report.html is the page of the discovery,
        and this page is written to `fit_report.html`.

    Returns the path of the page. Raises ReportFault if a file is missing or not a result, or if the page
    cannot be written.
    """
    folder = Path(directory)
    if folder.name == FIT and folder.is_file():
        folder = folder.parent
    fit, series = read_results(folder)
    path = folder / (BESIDE_DISCOVERY if (folder / DISCOVERY).exists() else REPORT)
    try:
        return write_text_whole(path, page_html(fit_blocks(fit, series)))
    except OSError as fault:
        raise ReportFault(f"{path}: expected a file that can be written, found: {fault.strerror}") from None


def read_results(folder: Path) -> tuple[FitResults, dict[str, np.ndarray]]:
    """Read the results in both files. Raises ReportFault with all faults."""
    faults: list[str] = []
    fit = FitResults()
    series: dict[str, np.ndarray] = {}
    try:
        fit = with_verdicts(read_result(FitResults, folder / FIT, "hygrokf fit"))
        if missing_fields := [
            field for field in ("name", "version", "parameters") if not getattr(fit, field)
        ]:
            remark = f"it lacks {', '.join(missing_fields)}; name the directory of one"
            faults.append(f"{folder / FIT}: not a result of `hygrokf fit`: {remark}")
    except ResultFault as fault:
        faults.append(str(fault))
    try:
        series = read_series(folder)
    except ResultFault as fault:
        faults.append(str(fault))
    if faults:
        raise ReportFault("\n".join(faults))
    return fit, series


# --- the page --------------------------------------------------------------------------------


def fit_blocks(fit: FitResults, series: Mapping[str, np.ndarray]) -> Page:
    """The page of a fit; the time constants with their verdicts and the validation period come first."""
    figures = {name: figure_of(name, fit, series) for name in FIGURES}
    body = (
        *section("What is reliable", Prose(FIT_TERMS, "note"), _judgements(fit)),
        *section(
            "Accuracy",
            table_or(
                rmse_table(fit, "validation"),
                "No validation period: `until` is not stated, or nothing was scored after it.",
            ),
            table_or(rmse_table(fit, "identification"), "Nothing was scored in the identification period."),
            table_or(bands_table(fit), "No band could be checked against readings."),
        ),
        *section(
            "Measured and simulated", *(figures[name] for name in ("temperature", "humidity", "excerpts"))
        ),
        *section(
            "What was identified",
            table_or(time_constants_table(fit), "No time constant was identified."),
            figures["profiles"],
            figures["composition"],
            figures["heat-release"],
            actuators_table(fit),
            Details(
                "All parameters",
                (
                    table_or(fit_parameters_table(fit), "The fit holds no parameters."),
                    table_or(optima_table(fit), "All starts ended in the same optimum."),
                ),
                printed=True,
            ),
        ),
        *section(
            "What the model leaves unexplained",
            figures["residuals"],
            Details(
                "Innovations and their tests",
                (*_innovations(fit), figures["innovations-temperature"], figures["innovations-humidity"]),
                printed=True,
            ),
        ),
        *section("Data", Details("Masks, repairs, warnings and files", _data(fit))),
    )
    return Page(
        "Identification report",
        one_line(fit.name).strip() or "unnamed record",
        _about(fit),
        (*_banners(fit), Cards(tuple(_card(fit, name) for name in PARTS)), figures["validation"]),
        body,
        _method(fit),
    )


def fit_period(fit: FitResults) -> str:
    """Return the record's first and last instant and the end of its identification; empty if unknown."""
    start, until, end = (
        moment(instant or "") for instant in (fit.period.start, fit.period.until, fit.period.end)
    )
    if not (start and end):
        return ""
    return f"{start} to {end} UTC" + (f", identified on the part until {until}" if until else "")


def _about(fit: FitResults) -> tuple[str, ...]:
    """Return the lines below the name: period, number of readings, rated power and site."""
    period = fit_period(fit)
    lines = [period] if period else []
    count, rated_kW = fit.period.n_readings, fit.rated_power_kW
    facts = [f"{count:,} times with a reading"] if count else []
    facts.append(f"rated power {rated_kW:,.0f} kW" if math.isfinite(rated_kW) else "rated power not stated")
    if fit.site is not None:
        facts.append(", ".join(place(fit.site)))
    return (*lines, " · ".join(facts))


def _banners(fit: FitResults) -> tuple[Banner, ...]:
    """Return the warnings: readings that were not measured, and a search that did not converge."""
    banners = unmeasured(fit.provenance, OF_RECORD)
    if fit.converged:
        return banners
    word = "CONVERGENCE UNKNOWN" if fit.converged is None else "NOT CONVERGED"
    messages = "; ".join(map(str, fit.messages))
    text = f"{messages} None of the numbers below is final.".strip()
    return (*banners, Banner(word, text, severe=True))


def _card(fit: FitResults, name: str) -> Card:
    """Return the card of a time constant: value, bounds, verdict with its first reason, and the free run's
    estimate."""
    label, symbol = f"{name} time constant", PRODUCT[name]
    constant = fit.time_constants.get(name)
    if constant is None:
        reasons = () if fit.design is None else tuple(map(str, fit.design.statements))
        return Card(
            label, "not identified", symbol=symbol, lines=reasons or (f"The model has no {name} part.",)
        )
    reported = inherited(fit)[name]
    value, bounds = reported.texts
    by_free_run, range_of_values = free_run_text(constant), range_text(constant)
    remarks = [f"The free run alone gives {by_free_run}."] if by_free_run else []
    remarks += [f"{range_of_values} over the record's temperatures."] if range_of_values else []
    reason = sentence(reported.why) if reported.verdict == REJECT and reported.why else reported.why
    return Card(
        label, value, reported.verdict, f"{bounds}, {level_and_method(constant)}".strip(", "), reason, symbol,
        (" ".join(remarks),) if remarks else (), words=value == UNBOUNDED,
    )  # fmt: skip


def _judgements(fit: FitResults) -> Verdicts:
    """Doubts about the record, time constants with their reasons, then the rest, the worst first."""
    order = {REJECT: 0, BELIEVE: 1, CAUTION: 2}
    sorted_judgements = sorted(
        judgements(fit), key=lambda judgement: 0 if judgement.about in PARTS else 1 + order[judgement.verdict]
    )
    lines = [Line(CAUTION, sentence(ReasonCode.RECORD_DOUBTED(doubt=doubt).text)) for doubt in fit.doubts]
    for judgement in sorted_judgements:
        text = f"{judgement.head}{':' if judgement.reasons else '.'}"
        lines.append(Line(judgement.verdict, text, head=judgement.about in PARTS))
        lines += [Line(reason.verdict, sentence(reason.text), within=True) for reason in judgement.reasons]
    lines += [Line(CAUTION, sentence(statement.text)) for statement in fit.statements]
    return Verdicts(tuple(lines))


def _innovations(fit: FitResults) -> tuple[Block, ...]:
    """Return the table of the innovations, their tests in sentences, and a note on their meaning."""
    table = innovations_table(fit)
    statements = tuple(sentence(statement.text) for statement in fit.innovations.statements)
    if not (table or statements):
        return (Prose("The fit holds no tests of its innovations.", "missing"),)
    return (
        Prose(
            "Innovations are shown in units of the prediction's own standard deviation. White innovations "
            "mean that the model uses everything that earlier readings and the inputs can tell."
        ),
        table_or(table, "The tests hold no numbers."),
        *([Items(statements)] if statements else []),
        Prose(sentence(NOTE), "note"),
    )


def _data(fit: FitResults) -> tuple[Block, ...]:
    """Return the warnings about masked or repaired readings, and the files that were read."""
    warnings = tuple(sentence(line) for line in fit.warnings)
    return (
        Items(warnings) if warnings else Prose("Nothing had to be masked or repaired."),
        Table("Files read", ("file", "SHA-256"), fit.files, left=(0, 1))
        if fit.files
        else Prose("The fit does not name the files that it was made from.", "missing"),
    )


def _method(fit: FitResults) -> tuple[Block, ...]:
    """Return how the fit was computed."""
    criterion = (
        "maximum likelihood over the innovations of an extended Kalman filter"
        if fit.criterion == "likelihood"
        else "least squares on the free run (output error), as in the paper"
    )
    kind_text = f" ({fit.kind} model)" if fit.kind else ""
    sentence_on_estimation = (
        f"The parameters were estimated by {criterion}{kind_text}, on the identification period alone. "
    )
    lines = [FIT_METHOD[0], sentence_on_estimation + FIT_METHOD[1], *FIT_METHOD[2:]]
    lines += [sentence(statement.text) for statement in (() if fit.design is None else fit.design.statements)]
    values = [
        f"{label} {fixed(value)}"
        for label, value in (("log-likelihood", fit.loglik), ("AIC", fit.aic), ("BIC", fit.bic))
        if math.isfinite(value)
    ]
    if fit.n_obs:
        values.append(f"{fit.n_obs:,} readings in the likelihood")
    if values:
        lines.append(", ".join(values) + ".")
    fitted = f"Fitted by {versions(fit.version, moment(fit.created))}."
    return method("How this was computed", *lines, fitted)


FIT_TERMS = (
    f"{FREE_RUN} {INNOVATIONS} All sources: bounds of the profile likelihood, widened by every other source "
    "of uncertainty. Sandwich: bounds from the observed scatter of the scores, which hold even where the "
    "model's noise is not quite right."
)
FIT_METHOD = (
    "Heat balance: dT_conv/dt = (T_amb − T_conv + f_ΔT/ρ)/τ and T_conv,a = ρ T_conv + (1−ρ) T_amb, with "
    "τ = (R_AT+R_IC)·C and ρ = R_AT/(R_AT+R_IC). The heat release f_ΔT [K] is a polynomial of the power in "
    "operation and a line over the ambient temperature at standstill. Vapour balance: dc*/dt = T_conv,a "
    "T_amb^0.8 (c_amb − c*)/(k (273 K)^1.8) and c = c* T_amb/T_conv,a. Coloured and white disturbances of "
    "both flows are estimated together with the other parameters. The stated accuracy of a sensor is the "
    "prior of its constant error.",
    "Each reading is used at its own time. Inputs read at instants are interpolated linearly, interval means "
    "of the ambient by the curve that keeps the means, and mean powers hold over their interval.",
    "The interval of a time constant starts from the bounds of the profile likelihood and is widened where "
    "the scores vary more than the model predicts. Parts of the record, other forms of the model, the free "
    "run, clock errors and the sampling of the ambient widen it further, as shown above. Other bounds are "
    "the wider of Wald's and the sandwich's. Errors are those of the free run. Stretches with unknown power "
    "or weather, and the hours after them, are not scored.",
)
