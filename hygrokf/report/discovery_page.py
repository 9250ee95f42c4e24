"""`report.html` of a discovery: what the simulation gets wrong, the cause, what to check, and what that
gained."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from hygrokf.data.files import BESIDE_DISCOVERY, REPORT, write_text_whole
from hygrokf.data.lookup import entry, number, numbers
from hygrokf.discovery.findings import Misfit
from hygrokf.discovery.residuals import QUANTITIES, UNITS, Residuals
from hygrokf.discovery.results import read_discovery, write_discovery
from hygrokf.identification.verdict import rests_on
from hygrokf.identification.wording import BASELINES, SCORED, fixed, percent, sentence, text_of
from hygrokf.report.discovery_tables import (
    constants_sentences,
    constants_table,
    misfits_table,
    parameters_table,
    rejected_table,
    scores_table,
)
from hygrokf.report.discovery_text import (
    PARTS,
    PERIOD,
    card_sentences,
    confidence_of,
    evidence_sentence,
    gain_sentence,
    gains_by_quantity,
    numbers_of,
    quantity_of,
    remainder,
    remainder_driver,
    remedy_of,
    repeats_itself,
    rivals_sentence,
    rows_of,
    scored_error,
    settings_words,
    signed_percent,
    spoken,
    title,
    tried,
    untried,
    verdict_of,
)
from hygrokf.report.figures.findings import figure_episodes
from hygrokf.report.figures.residual_structure import (
    figure_day_hour,
    figure_drivers,
    figure_innovations,
    telling_drivers,
)
from hygrokf.report.fit_page import write_report
from hygrokf.report.html import document, figure_html, moment, numbers_html, prose, section, tables_html
from hygrokf.version import __version__

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from hygrokf.discovery.procedure import Discovery

EPISODE_FIGURES = 3
HEADLINE = {
    "none": "Nothing is missing that this record shows",
    "unexplained": "Something is missing; its cause is not known",
}
NOT_RIGHT = "No cause is found, and the model is not right"
REPETITION = "A logger writes readings again that are a day old"
LABEL = {"none": "no cause", "named": "a cause is named", "unexplained": "unexplained"}
TITLES = {"temperature": "temperature", "humidity": "absolute humidity"}


def write_discovery_report(found: Discovery | None, directory: str | os.PathLike[str]) -> Path:
    """Write `report.html`, the page of a discovery, and `fit_report.html`, that of the model that it ends
    with.

    found: a discovery, whose results are written first (`write_discovery`); None: `directory` holds them
    already. Returns the path of report.html.  The page is a pure function of `discovery.json` and
    `discovery.npz`.  Raises ResultFault where these are missing or damaged, ReportFault where fit.json or
    series.npz are.
    """
    folder = Path(directory)
    if found is not None:
        write_discovery(found, folder)
    read = read_discovery(folder)
    write_report(folder)
    return write_text_whole(folder / REPORT, discovery_page(read.results, read.before, read.after))


def discovery_page(
    found: Mapping,
    before: Residuals | None = None,
    after: Residuals | None = None,
    fit_page: str = BESIDE_DISCOVERY,
) -> str:
    """The whole page as HTML text.

    found: the data of `discovery.json`; before, after: residuals of the base and of the extended model, for
    the pictures; fit_page: the file beside it to which the page points ("" = none).
    """
    name = text_of(entry(found, "name")).strip() or "unnamed record"
    parts = [
        _head(found, name, before),
        _headline(found),
        _misfits(found, before),
        _causes(found),
        _pictures(found, before, after),
        _constants(found),
        _scores(found),
        _rejected(found),
        _left(found),
        _method(found, before, fit_page),
    ]
    return document(f"{name} – hygrokf discovery", parts)


# --- head and headline -----------------------------------------------------------------------


def _head(found: Mapping, name: str, before: Residuals | None) -> str:
    lines = _spans(before)
    meta = "".join(f"<p class=meta>{prose(line)}</p>" for line in lines)
    banner = ""
    if entry(found, "synthetic") is True:
        banner = (
            "<p class='banner synthetic'><b>SYNTHETIC</b> This record was made by a computer. "
            "Nothing on this page was measured.</p>"
        )
    return (
        "<header><p class=kind>Hygrothermal model of an enclosure · discovery report</p>"
        f"<h1>{escape(name)}</h1>{meta}{banner}{_numbers(found)}</header>"
    )


def _numbers(found: Mapping) -> str:
    """The time constants of the model that the discovery ends with, and of the base where that is another
    one."""
    extended = isinstance(entry(found, "extended"), Mapping)
    base = numbers_html(
        numbers_of(found, "baseline"),
        "The numbers of the base model" if extended else "The numbers of the model",
    )
    return base + (
        numbers_html(numbers_of(found, "extended"), "The numbers of the extended model") if extended else ""
    )


def _spans(before: Residuals | None) -> list[str]:
    """What the record covers, in words."""
    if before is None or not len(before.time_h):
        return []
    import numpy as np

    def stamp(seconds: float) -> str:
        return moment(str(np.datetime64(round(seconds), "s")))

    time = before.time_s
    line = f"{stamp(time[0])} to {stamp(time[-1])} UTC"
    if before.validation.any():
        line += f"; searched up to {stamp(time[before.validation.argmax()])}, held out from there on"
    else:
        line += "; nothing held out"
    return [line]


def _headline(found: Mapping) -> str:
    verdict, causes = verdict_of(found), rows_of(found, "causes")
    names = [spoken(one.get("cause")) for one in causes]
    heading = HEADLINE.get(verdict) or title(" + ".join(names) or "a cause")
    if verdict == "none" and rests_on(numbers_of(found, "baseline")):
        heading = NOT_RIGHT
    if verdict == "unexplained" and repeats_itself(found):
        heading = REPETITION
    lines = []
    if verdict == "named" and len(causes) == 1:
        lines.append(f"<p class=bounds>confidence {escape(confidence_of(causes[0]))}</p>")
    lines += [f"<p>{prose(line)}</p>" for line in card_sentences(found)]
    open_ = " open" if verdict == "unexplained" or heading == NOT_RIGHT else ""
    cards = [
        f"<div class='card wide{open_}'><p class=label>Verdict <span>{LABEL[verdict]}</span></p>"
        f"<p class='value words'>{escape(heading)}</p>{''.join(lines)}</div>",
        *_error_cards(found),
    ]
    return f"<section class=cards>{''.join(cards)}</section>"


def _error_cards(found: Mapping) -> list[str]:
    """A card for each scored quantity: its free-run error before and after, and the best rule of the
    sceptic."""
    gains, cards = gains_by_quantity(found), []
    for quantity in SCORED:
        before, after, period = scored_error(found, quantity)
        if not math.isfinite(before):
            continue
        name, unit = quantity_of(quantity)
        value = f"{fixed(before)} → {fixed(after)}" if math.isfinite(after) else fixed(before)
        lines = []
        if math.isfinite(after) and before > 0:
            lines.append(f"<p class=bounds>{prose(signed_percent(after / before - 1.0))}</p>")
        if gain := _gain_words(gains.get(quantity), before, after, unit):
            lines.append(f"<p>{prose(gain)}</p>")
        rules = {
            words: number(found, "baseline", "baselines", period, key, quantity, "total")
            for key, words in BASELINES[quantity].items()
        }
        rules = {words: v for words, v in rules.items() if math.isfinite(v)}
        if rules:
            best = min(rules, key=lambda words: rules[words])
            against = (
                (after if math.isfinite(after) else before) / rules[best] - 1.0 if rules[best] > 0 else 0.0
            )
            lines.append(
                f"<p>{percent(abs(against))} {'below' if against <= 0 else 'above'} the rule "
                f"“{escape(best)}” ({fixed(rules[best])} {escape(unit)})</p>"
            )
        cards.append(
            f"<div class=card><p class=label>Error of the {escape(name)} <span>free run, "
            f"{escape(PERIOD.get(period, period).removeprefix('the '))}</span></p>"
            f"<p class=value>{escape(value)} {escape(unit)}</p>{''.join(lines)}</div>"
        )
    return cards


def _gain_words(gain: Mapping | None, before: float, after: float, unit: str) -> str:
    """The measured gain with its bounds; where it compares better simulators than the card does, with their
    errors."""
    first, last, low, high = (number(gain, key) for key in ("rmse_before", "rmse_after", "lower", "upper"))
    bounds = f"falls by {fixed(low)} … {fixed(high)} {unit} (95 %)" if low <= high else ""
    if not math.isfinite(first) or [fixed(first), fixed(last)] == [fixed(before), fixed(after)]:
        return bounds
    return (
        f"as the better simulators that both can be: {fixed(first)} → {fixed(last)} "
        f"{unit}{f', {bounds}' if bounds else ''}"
    )


# --- sections --------------------------------------------------------------------------------


def _misfits(found: Mapping, before: Residuals | None) -> str:
    nothing = "Nothing that is significant, material and more than the sensors’ accuracy explains."
    whole = "".join(f"<p>{prose(line)}</p>" for line in _on_the_whole(before))
    return section("What the simulation gets wrong", whole, tables_html((misfits_table(found), nothing)))


def _on_the_whole(before: Residuals | None) -> list[str]:
    """Mean and root mean square of the free run's errors in the identification period: no condition tells a
    constant."""
    if before is None:
        return []
    import numpy as np

    said = []
    for quantity in QUANTITIES:
        error = -before.error(quantity)[~before.validation]
        error = error[np.isfinite(error)]
        if len(error):
            mean, unit = float(error.mean()), UNITS[quantity]
            said.append(
                f"{TITLES[quantity]} by {fixed(before.rmse(quantity))} {unit}, {fixed(abs(mean))} {unit} too "
                f"{'high' if mean > 0 else 'low'} on average"
            )
    where = "In the identification period the base model’s free run errs in "
    return [sentence(where + "; in ".join(said))] if said else []


def _causes(found: Mapping) -> str:
    causes = rows_of(found, "causes")
    if not causes:
        return ""
    together = ""
    if len(causes) > 1:
        together = (
            "<p>In the order in which they were accepted, each beside those before it. What the extended "
            "model gained was measured with all of them together.</p>"
        )
    heading = "The cause" if len(causes) == 1 else "The causes"
    return section(heading, together, *(_cause(one) for one in causes))


def _cause(cause: Mapping) -> str:
    form = text_of(cause.get("form"))
    rows = [
        ("What it is", sentence(text_of(cause.get("statement")) or spoken(cause.get("cause")))),
        ("Confidence", sentence(confidence_of(cause))),
        ("Evidence", sentence(evidence_sentence(cause))),
        ("Gain", sentence(gain_sentence(cause))),
    ]
    settings = settings_words(entry(cause, "settings"))
    if settings:
        rows.append(("Found by search", sentence("; ".join(settings))))
    rivals = rivals_sentence(cause)
    rows.append(
        ("Could also be", sentence(rivals) if rivals else "No other cause of the library comes near it.")
    )
    rows.append(("To check", sentence(remedy_of(cause))))
    items = "".join(f"<dt>{escape(term)}</dt><dd>{prose(said)}</dd>" for term, said in rows)
    table = tables_html((parameters_table(cause), "The cause has no parameters of its own: it moves stamps."))
    name = escape(title(cause.get("cause"))) + (f" <span>{escape(form)}</span>" if form else "")
    return f"<div class=found><h3 class=cause>{name}</h3><dl>{items}</dl>{table}</div>"


def _constants(found: Mapping) -> str:
    if entry(found, "extended") is None:
        return ""
    said = "".join(f"<p>{prose(line)}</p>" for line in constants_sentences(found))
    table = tables_html((constants_table(found), "No time constant was identified."))
    return section("What the wrong model did to the time constants", said, table)


def _scores(found: Mapping) -> str:
    rows = [
        (
            scores_table(found, "validation"),
            "There is no held-out period with readings (`until` is not stated).",
        ),
        (scores_table(found, "identification"), "Nothing was scored in the identification period."),
    ]
    note = ""
    if gains_by_quantity(found):
        note = (
            "<p class=note>Both models of these tables, and of the cards, are those identified by their "
            "innovations; the fit’s own page shows the same numbers. The gain of a cause is measured between "
            "the better simulators that they can be: each as it is, or moved toward its least free-run "
            "error, whichever simulates the identification period better. So it may be smaller.</p>"
        )
    return section("Errors before and after", tables_html(*rows), note)


def _rejected(found: Mapping) -> str:
    said = untried(found)
    return section(
        "What was tried and left out",
        *([f"<p>{prose(sentence(said))}</p>"] if said else []),
        tables_html((rejected_table(found), "No other cause was tried.")),
    )


def _left(found: Mapping) -> str:
    left, driver = remainder(found), remainder_driver(found)
    if not left:
        which = "extended model" if isinstance(entry(found, "extended"), Mapping) else "base model"
        return section(
            "What is left unexplained",
            f"<p>Nothing: the errors of the {which} show no structure under any condition that was asked, no "
            "readings that repeat those of the day before, and no excursions to one side.</p>",
        )
    lines = [sentence(left), *([sentence(driver)] if driver else [])]
    return section("What is left unexplained", *(f"<p>{prose(line)}</p>" for line in lines))


def _method(found: Mapping, before: Residuals | None, fit_page: str) -> str:
    count = tried(found)
    lines = [
        "The base model was identified on the identification period by its innovations, and once more by its "
        "free run. What its free run gets wrong was asked under every condition (episodes, regimes, hour, "
        "season, level, rate and lag of every driver, steps and drifts), with a block bootstrap that keeps "
        "the errors’ own memory and a rate of false discoveries held over all conditions together.",
        f"{count} {'cause was' if count == 1 else 'causes were'} tried, each in several forms and settings, "
        "every time with all parameters estimated again. One is accepted where its gain in likelihood pays "
        "for its parameters and for the settings searched with evidence to spare, where the squared error of "
        "the free run falls materially, also without the days that gained most, and where no free run gets "
        "worse; then the others are tried again beside it. p-values are corrected for the number of causes "
        "and settings.",
        "The held-out period took no part in any choice. Bounds of a gain come from a bootstrap of blocks of "
        "days: they know how much the gain varies within this period, not how it would in another season.",
        "Confidence estimates the probability that the name, or one of those from which this record cannot "
        "tell it, is right, by the distance to its rivals and the gain that lasts; how well it holds can be "
        "measured on simulated plants alone. A cause that is not in the library cannot be named, and one "
        "that acts alike can be named in its stead: check in the turbine before you act on it.",
    ]
    version = text_of(entry(found, "version"))
    made = f"Found by hygrokf {version or '(version not stated)'}; page written by hygrokf {__version__}."
    paragraphs = "".join(f"<p>{prose(line)}</p>" for line in lines)
    if fit_page:
        which = "extended" if isinstance(entry(found, "extended"), Mapping) else "base"
        made_of = f"The {which} model itself, with all its parameters: "
        paragraphs += f"<p>{made_of}<a href='{escape(fit_page, quote=True)}'>{escape(fit_page)}</a>.</p>"
    return f"<footer><h2>Data and method</h2>{paragraphs}<p>{escape(made)}</p></footer>"


# --- pictures --------------------------------------------------------------------------------


def _pictures(found: Mapping, before: Residuals | None, after: Residuals | None) -> str:
    heading = "Before and after" if after is not None else "Pictures"
    if before is None:
        return section(heading, "<p class=left-out>There are no residuals to draw.</p>")
    known = _known_misfits(found)
    parts = []
    caption = "The simulation should stay with the blue readings where the background is shaded" + (
        ": compare the base model (red) with the extended one (green)." if after is not None else "."
    )
    for place, one in enumerate(known[:EPISODE_FIGURES]):
        draw = _draw(figure_episodes, before, one, after)
        name = f"Misfit {place + 1}: {TITLES[one.quantity]}"
        parts.append(figure_html(f"episodes-{place + 1}", name, "" if place else caption, draw))
    for place, (name, one) in enumerate(_events(found)):
        draw = _draw(figure_episodes, before, one, after)
        said = "Shaded is where it was found. The simulation should stay with the blue readings there."
        parts.append(figure_html(f"event-{place + 1}", f"{title(name)}: when", said, draw))
    drivers = [one.driver for one in known if one.driver]
    parts.append(
        figure_html(
            "drivers",
            "Error against what drives the cabinet",
            "Medians should lie on zero along every driver"
            + (
                "; where the red ones bend and the green ones lie flat, the cause explains the bend. Where "
                "only green is seen both are alike."
                if after is not None
                else "; a bend names what the model lacks."
            ),
            lambda: figure_drivers(before, telling_drivers(before, drivers), after),
        )
    )
    for quantity in QUANTITIES:
        changed = after if _differ(before, after, quantity) else None
        parts.append(
            figure_html(
                f"days-{quantity}",
                f"Error of the {TITLES[quantity]} by day and hour",
                "Level stripes are a matter of the hour, upright ones of weather or operation, a change of "
                "colour from a date on of something that was changed then."
                + (" The extended model leaves these errors as they are." if after is not changed else ""),
                _draw(figure_day_hour, before, quantity, changed),
            )
        )
    parts.append(
        figure_html(
            "innovations",
            "Innovations: periods and what they go with",
            "Curves should stay within the grey bands: a peak names a period, a correlation at lags above "
            "zero an answer to that driver, that the one-step prediction still lacks.",
            lambda: figure_innovations(before, after),
        )
    )
    return section(heading, *parts)


def _differ(before: Residuals, after: Residuals | None, quantity: str) -> bool:
    """Whether the extended model's free run errs otherwise, by more than a hundredth of the error."""
    import numpy as np

    if after is None:
        return False
    if len(before.time_h) != len(after.time_h):
        return True
    apart = np.abs(before.error(quantity) - after.error(quantity))
    return bool(np.nanmax(apart, initial=0.0) > 0.01 * before.rmse(quantity))


def _draw(make: Callable[..., Figure], *arguments: object) -> Callable[[], Figure]:
    return lambda: make(*arguments)


def _events(found: Mapping) -> list[tuple[str, Misfit]]:
    """Accepted causes that were found in stretches of time, each as a misfit of the quantity that gained most
    there."""
    result = []
    for cause in rows_of(found, "causes"):
        spans = entry(cause, "settings", "spans")
        pairs = (
            [one for one in spans if isinstance(one, (list, tuple)) and len(one) == 2]
            if isinstance(spans, list)
            else []
        )
        known = tuple((a, b) for a, b in (numbers({"": one}, "") for one in pairs) if a < b)
        shares = {part: number(cause, "evidence", "free_run_gain", part) for part in PARTS}
        shares = {PARTS[part]: share for part, share in shares.items() if math.isfinite(share)}
        statement = text_of(entry(cause, "statement")).split(";")[0]
        if known and shares and statement:
            quantity = max(shares, key=lambda name: shares[name])
            known = tuple((float(a), float(b)) for a, b in known)
            result.append(
                (
                    text_of(cause.get("cause")),
                    Misfit(
                        quantity, "", "", 0.0, "", None, len(known), len(known), 0.0, statement, 0.0, 0.0, "",
                        "episode",
                        spans=known,
                    ),
                )
            )  # fmt: skip
    return result


def _known_misfits(found: Mapping) -> list[Misfit]:
    """The misfits of the results as objects; those that cannot be drawn are left out."""
    result = []
    for one in rows_of(found, "misfits"):
        try:
            made = Misfit.from_json(one)
        except (KeyError, TypeError, ValueError):
            continue
        if made.spans and made.quantity in QUANTITIES and made.statement:
            result.append(made)
    return result
