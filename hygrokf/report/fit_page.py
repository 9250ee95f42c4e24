"""`report.html` from `fit.json` and `series.npz`: one self-contained, printable page; and the same tables as text."""

from __future__ import annotations

import json
import math
import os
import re
import zipfile
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path

import numpy as np

from hygrokf.data.files import BESIDE_DISCOVERY, DISCOVERY, FIT, REPORT, write_text_whole
from hygrokf.data.lookup import entry, number, one_line
from hygrokf.errors import HygrokfError
from hygrokf.identification.verdict import BELIEVE, CAUTION, MARKS, PARTS, PLAIN_MARKS, REJECT
from hygrokf.identification.wording import UNBOUNDED, fixed, plain_number, sentence, text_of, texts
from hygrokf.report.figures.overview import FIGURES, Picture
from hygrokf.report.fit_tables import (
    PERIODS,
    TEXT_WIDTH,
    Table,
    actuators_table,
    bands_table,
    innovations_table,
    optima_table,
    parameters_table,
    rmse_table,
    table_text,
    time_constants_table,
    wrapped,
)
from hygrokf.report.fit_text import Judgement, doubted, judgements, simulated, time_constant
from hygrokf.report.html import (
    KEY,
    document,
    figure_html,
    mark_html,
    moment,
    prose,
    section,
    tables_html,
    verdict_html,
)
from hygrokf.version import __version__

SERIES = "series.npz"
NEEDED = ("name", "version", "parameters", "time_constants")
"""What every fit.json holds."""


class ReportFault(HygrokfError):
    """Results from which no report can be made; one message lists everything wrong with them."""


def write_report(directory: str | os.PathLike[str]) -> Path:
    """Write `report.html` beside `fit.json` and `series.npz`; returns its path.

    directory: what `hygrokf fit` wrote; where `hygrokf discover` did, report.html is the discovery's page, and this one
    becomes `fit_report.html`.  The page is a pure function of the two files, needs no script and no other
    file, names no host, and prints on A4.  Raises ReportFault where a file is missing or is not a result.
    """
    folder = Path(directory)
    if folder.name == FIT and folder.is_file():
        folder = folder.parent
    fit, series = read_results(folder)
    path = folder / (BESIDE_DISCOVERY if (folder / DISCOVERY).exists() else REPORT)
    try:
        return write_text_whole(path, report_page(fit, series))
    except OSError as fault:
        raise ReportFault(f"{path}: expected a file that can be written, found: {fault.strerror}") from None


def read_results(folder: Path) -> tuple[dict, dict[str, np.ndarray]]:
    """The plain data of both files; raises ReportFault that lists all faults."""
    faults: list[str] = []
    fit: object = {}
    series: dict[str, np.ndarray] = {}
    again = "run `hygrokf fit` with --out on this directory first"
    try:
        fit = json.loads((folder / FIT).read_text(encoding="utf-8"))
        if not isinstance(fit, dict):
            faults.append(
                f"{folder / FIT}: expected an object with the results of a fit, found {type(fit).__name__}"
            )
        elif missing := [name for name in NEEDED if name not in fit]:
            faults.append(
                f"{folder / FIT}: not a result of `hygrokf fit`: it lacks {', '.join(missing)}; {again}"
            )
    except FileNotFoundError:
        faults.append(f"{folder / FIT}: no such file; {again}")
    except (OSError, ValueError, RecursionError) as fault:
        faults.append(f"{folder / FIT}: expected JSON written by `hygrokf fit`, found: {fault}; {again}")
    try:
        with open(folder / SERIES, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            series = {name: np.asarray(file[name]) for name in file.files}
    except FileNotFoundError:
        faults.append(f"{folder / SERIES}: no such file; {again}")
    except (OSError, ValueError, EOFError, KeyError, AttributeError, zipfile.BadZipFile) as fault:
        faults.append(f"{folder / SERIES}: expected arrays written by `hygrokf fit`, found: {fault}; {again}")
    text = [name for name, value in series.items() if value.dtype.kind not in "fiub"]
    if text:
        faults.append(
            f"{folder / SERIES}: expected numbers, found text or objects in {', '.join(sorted(text))}; {again}"
        )
    if faults:
        raise ReportFault("\n".join(faults))
    assert isinstance(fit, dict)
    return fit, series


# --- the page --------------------------------------------------------------------------------


def report_page(fit: Mapping, series: Mapping[str, np.ndarray]) -> str:
    """The whole page as HTML text."""
    name = text_of(entry(fit, "name")).strip() or "unnamed record"
    pictures = {picture.name: _figure(picture, fit, series) for picture in FIGURES}
    constants = (time_constants_table(fit), "No time constant was identified, so there is no table of them.")
    actuators = actuators_table(fit)
    parameters = (parameters_table(fit), "The fit holds no parameters.")
    optima = (optima_table(fit), "The starts met no other optimum.")
    parts = [
        _head(fit, name),
        _headline(fit),
        _believe(fit),
        _accuracy(fit),
        section(
            "Measured and simulated", *(pictures[one] for one in ("temperature", "humidity", "excerpts"))
        ),
        section(
            "What was identified",
            tables_html(constants),
            pictures["profiles"],
            pictures["composition"],
            pictures["heat-release"],
            *([] if actuators is None else [tables_html((actuators, ""))]),
            tables_html(parameters, optima),
        ),
        section("What the model leaves", pictures["residuals"], _innovations(fit)),
        *(pictures[one] for one in ("innovations-temperature", "innovations-humidity")),
        _data(fit),
        _method(fit),
    ]
    return document(f"{name} – hygrokf report", parts)


def _head(fit: Mapping, name: str) -> str:
    start, until, end = (moment(entry(fit, "period", part)) for part in ("start", "until", "end"))
    n = number(fit, "period", "n_readings")
    lines = []
    if start and end:
        lines.append(f"{start} to {end} UTC" + (f", identified on the part until {until}" if until else ""))
    facts = []
    if math.isfinite(n):
        facts.append(f"{n:,.0f} times with a reading")
    rated = number(fit, "rated_power_kW")
    facts.append(f"rated power {rated:,.0f} kW" if math.isfinite(rated) else "rated power not stated")
    place = [number(fit, "site", part) for part in ("latitude_deg", "longitude_deg")]
    if all(math.isfinite(v) for v in place):
        facts.append(
            f"{abs(place[0]):.2f}° {'N' if place[0] >= 0 else 'S'}, {abs(place[1]):.2f}° {'E' if place[1] >= 0 else 'W'}"
        )
    lines.append(" · ".join(facts))
    meta = "".join(f"<p class=meta>{escape(line)}</p>" for line in lines)
    banners = ""
    if entry(fit, "synthetic") is True:
        banners += (
            "<p class='banner synthetic'><b>SYNTHETIC</b> This record was made by a computer. "
            "Nothing on this page was measured.</p>"
        )
    if entry(fit, "converged") is not True:
        said = text_of(entry(fit, "message"))
        words = "NOT CONVERGED" if entry(fit, "converged") is False else "CONVERGENCE UNKNOWN"
        banners += (
            f"<p class='banner failed'><b>{words}</b> {escape(said)} None of the numbers below is final.</p>"
        )
    return (
        "<header><p class=kind>Hygrothermal model of an enclosure · identification report</p>"
        f"<h1>{escape(name)}</h1>{meta}{banners}</header>"
    )


def _headline(fit: Mapping) -> str:
    cards = []
    for name, product in (
        ("thermal", "(R<sub>AT</sub>+R<sub>IC</sub>)·C"),
        ("hygric", "R<sub>D</sub>*·V*"),
    ):
        constant = time_constant(fit, name)
        rejected = constant.verdict.verdict == REJECT
        value = f"<p class=value>{escape(constant.value)}</p>"
        lines = [f"<p class=bounds>{prose(constant.bounds)}</p>"] if constant.bounds else []
        if rejected:  # the number is told, and is no headline
            words = UNBOUNDED if constant.value == UNBOUNDED else constant.verdict.words
            value = f"<p class=value>{MARKS[REJECT]} {words}</p>"
            lines = [f"<p class=verdict>{prose(sentence(constant.verdict.why))}</p>"]
            lines.append(f"<p class=bounds><s>{prose(constant.span)}</s></p>")
        elif constant.found is not None:
            lines.append(verdict_html(constant.verdict))
        said = text_of(entry(constant.found, "statement"))
        if said and not constant.closed:
            lines.append(f"<p>{escape(said)}</p>")
        if constant.found is None:
            lines.append(f"<p>{escape(_why_missing(fit, name))}</p>")
        other = simulated(constant.found)
        if other:
            lines.append(f"<p>by simulation {escape(other)}</p>")
        span = entry(constant.found, "range_h")
        if isinstance(span, (list, tuple)) and len(span) == 2:
            low, high = (number({"": v}, "") for v in span)
            if math.isfinite(low) and math.isfinite(high):
                lines.append(
                    f"<p>{plain_number(low)} … {plain_number(high)} h over the record's temperatures</p>"
                )
        kind = "open" if constant.found is None else constant.verdict.verdict
        cards.append(
            f"<div class='card {kind}'><p class=label>{name} time constant <span>{product}</span></p>"
            f"{value}{''.join(lines)}</div>"
        )
    return f"<section class=cards>{''.join(cards)}</section>"


def _why_missing(fit: Mapping, name: str) -> str:
    said = [
        line for line in texts(entry(fit, "design", "statements")) if "humidity" in line or "hygric" in line
    ]
    if name == "hygric":
        return (
            said[0]
            if said
            else "The record has no humidity inside and outside, so the hygric model is left out."
        )
    return "The model has no thermal part."


def _believe(fit: Mapping) -> str:
    found = judgements(fit)
    rows = [*doubted(fit), *(one for one in found if one.about in PARTS)]
    more = [one for one in found if one.about not in PARTS]
    more += [Judgement(CAUTION, sentence(line), "record") for line in _untold(fit, found)]
    order = {REJECT: 0, BELIEVE: 1, CAUTION: 2}
    rows += sorted(more, key=lambda one: order[one.kind])
    if not rows:
        return "<p class=left-out>The fit holds nothing to judge it by.</p>"
    items = ""
    for one in rows:
        place = " reason" if one.reason else " head" if one.about in PARTS else ""
        items += f"<li class='{one.kind}{place}'>{mark_html(one.kind)}{escape(one.sentence)}</li>"
    return (
        "<section><h2>What to believe, and what not</h2>"
        f"<p class=key>{KEY}</p><ul class=judgements>{items}</ul></section>"
    )


def _untold(fit: Mapping, found: Sequence[Judgement]) -> list[str]:
    """Statements of the fit that no judgement repeats; a judgement begins with a capital."""
    named = " ".join(one.sentence for one in found)
    return [line for line in texts(entry(fit, "statements")) if line[1:] not in named]


def _accuracy(fit: Mapping) -> str:
    rows = [
        (rmse_table(fit, "identification"), "Nothing was scored in the identification period."),
        (
            rmse_table(fit, "validation"),
            "There is no validation period with readings (`until` is not stated, or nothing was scored after it).",
        ),
        (bands_table(fit), "No band could be checked against readings."),
    ]
    return f"<section><h2>Accuracy</h2>{tables_html(*rows)}</section>"


def _innovations(fit: Mapping) -> str:
    table = innovations_table(fit)
    said = texts(entry(fit, "innovations", "statements"))
    if table is None and not said:
        return "<p class=left-out>The fit holds no diagnosis of its innovations.</p>"
    items = "".join(f"<li>{escape(sentence(line))}</li>" for line in said)
    note = text_of(entry(fit, "innovations", "note"))
    return (
        "<h3>Innovations</h3>"
        "<p>What each reading adds to its one-step prediction, in units of the prediction’s own standard deviation. "
        "White noise here means that the model has used all that the readings before and the inputs can tell.</p>"
        f"{tables_html((table, 'The diagnosis holds no numbers.'))}{f'<ul>{items}</ul>' if items else ''}"
        f"{f'<p class=note>{escape(sentence(note))}</p>' if note else ''}"
    )


def _figure(picture: Picture, fit: Mapping, series: Mapping[str, np.ndarray]) -> str:
    return figure_html(picture.name, picture.heading, picture.caption, lambda: picture.draw(fit, series))


def _data(fit: Mapping) -> str:
    warnings = texts(entry(fit, "warnings"))
    files = entry(fit, "provenance")
    rows = [
        (text_of(row[0]), text_of(row[1]))
        for row in (files if isinstance(files, (list, tuple)) else ())
        if isinstance(row, (list, tuple)) and len(row) == 2
    ]
    listed = "".join(f"<li>{escape(sentence(line))}</li>" for line in warnings)
    masks = f"<ul>{listed}</ul>" if listed else "<p>Nothing had to be masked or repaired.</p>"
    table = Table("Files read", ("file", "SHA-256"), tuple(rows), left=(0, 1))
    return (
        "<section><h2>Data</h2><h3>Masks, repairs and warnings</h3>"
        f"{masks}{tables_html((table if rows else None, 'The fit does not say which files it was made from.'))}</section>"
    )


def _method(fit: Mapping) -> str:
    criterion = text_of(entry(fit, "criterion")) or "likelihood"
    kind = text_of(entry(fit, "kind"))
    how = (
        "maximum likelihood over the innovations of an extended Kalman filter"
        if criterion == "likelihood"
        else "least squares on the free run (output error), as in the paper"
    )
    lines = [
        "Heat: dT_conv/dt = (T_amb − T_conv + f_ΔT/ρ)/τ and T_conv,a = ρ T_conv + (1−ρ) T_amb, with τ = (R_AT+R_IC)·C "
        "and ρ = R_AT/(R_AT+R_IC); the heat release f_ΔT [K] is a polynomial of the power in operation and a line over "
        "the ambient temperature at standstill. Vapour: dc*/dt = T_conv,a T_amb^0.8 (c_amb − c*)/(k (273 K)^1.8) and "
        "c = c* T_amb/T_conv,a. Coloured and white disturbances of both flows are estimated with everything else; the "
        "sensors' accuracy is a prior on a constant error.",
        f"Reported values: {how}{f', {kind} model' if kind else ''}, on the identification period alone. Every reading "
        "is taken at its own time. Instants of inputs are joined by straight lines, interval means of the ambient give the "
        "path that keeps them, and means of the power hold over their interval.",
        "Intervals of the time constants begin with the profile likelihood's bounds, widened where the scores vary more than "
        "the model says; what parts of the record, other forms of the model, the free run, clocks and the sampling of the "
        "ambient add is shown above. Other bounds are the wider of Wald's and the sandwich's. Errors are those of the free run, "
        "measured readings unseen; stretches with unknown power or weather, and the hours after them, are not scored.",
    ]
    lines += [sentence(line) for line in texts(entry(fit, "design", "statements"))]
    values = [
        f"{label} {fixed(number(fit, name))}"
        for name, label in (("loglik", "log-likelihood"), ("aic", "AIC"), ("bic", "BIC"))
        if math.isfinite(number(fit, name))
    ]
    n = number(fit, "n_obs")
    if math.isfinite(n):
        values.append(f"{n:,.0f} readings in the likelihood")
    if values:
        lines.append(", ".join(values) + ".")
    version = text_of(entry(fit, "version"))
    when = moment(entry(fit, "created"))
    made = f"Fitted by hygrokf {version or '(version not stated)'}{f' on {when} UTC' if when else ''}; page written by hygrokf {__version__}."
    paragraphs = "".join(f"<p>{escape(line)}</p>" for line in (*lines, made))
    return f"<footer><h2>How this was computed</h2>{paragraphs}</footer>"


# --- text ------------------------------------------------------------------------------------


def report_text(fit: Mapping) -> str:
    """The tables of a fit as text of at most 100 columns, for the command line."""
    name = text_of(entry(fit, "name")).strip() or "unnamed record"
    blocks = [
        _wrapped(f"{name}{' (SYNTHETIC: nothing measured)' if entry(fit, 'synthetic') is True else ''}")
    ]
    if entry(fit, "converged") is not True:
        said = text_of(entry(fit, "message"))
        blocks.append(_wrapped(f"NOT CONVERGED{f': {said}' if said else ''}. No number below is final."))
    blocks.append("\n".join(_wrapped(time_constant(fit, one).sentence) for one in ("thermal", "hygric")))
    tables = [
        time_constants_table(fit),
        actuators_table(fit),
        *(rmse_table(fit, period) for period in PERIODS),
        bands_table(fit),
    ]
    blocks += [table_text(table) for table in tables if table is not None]
    parameters = parameters_table(fit)
    if parameters is not None:
        blocks.append(table_text(parameters, columns=(0, 1, 2, 3, 4, 6)))
    innovations = innovations_table(fit)
    if innovations is not None:
        blocks.append(table_text(innovations))
    found = judgements(fit)
    remarks = [*doubted(fit), *found]
    remarks += [Judgement(CAUTION, sentence(line), "record") for line in _untold(fit, found)]
    if remarks:
        title = "What to believe (+), what with caution (!), what not (x)"
        blocks.append("\n".join([title, *(_item(one) for one in remarks)]))
    return "\n\n".join(blocks)


def _item(one: Judgement) -> str:
    """A judgement as an item of a list; a reason stands further in than what it is a reason for."""
    edge = "  " if one.reason else ""
    lines = _wrapped(f"{PLAIN_MARKS[one.kind]} {one.sentence}", "  ", TEXT_WIDTH - len(edge)).splitlines()
    return "\n".join(edge + line for line in lines)


def _wrapped(text: str, indent: str = "", width: int = TEXT_WIDTH) -> str:
    """Lines of at most so many columns that do not part a number from its unit."""
    kept = re.sub(r"(?<=\d) (?=(?:%|K|h|g/m³)(?![\w/]))", "\xa0", one_line(text))
    return "\n".join(wrapped(kept, width, indent)).replace("\xa0", " ")
