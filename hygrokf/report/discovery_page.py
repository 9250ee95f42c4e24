"""The blocks, page and text of a discovery: verdict, errors of the simulation, causes, checks and gains."""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

import numpy as np

from hygrokf.data.files import BESIDE_DISCOVERY, REPORT, write_text_whole
from hygrokf.data.timestamps import stamp_text
from hygrokf.discovery.discovery_results import CauseFound, DiscoveryResults, Refuted
from hygrokf.discovery.procedure import Discovery
from hygrokf.discovery.residuals import QUANTITIES, Residuals
from hygrokf.discovery.results import read_discovery, write_discovery
from hygrokf.identification.verdict import inherited
from hygrokf.identification.wording import one_line, sentence
from hygrokf.report.blocks import (
    FREE_RUN,
    INNOVATIONS,
    SYNTHETIC_PAGE,
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
    inherited_verdicts,
    method,
    present,
    section,
    synthetic,
    table_or,
)
from hygrokf.report.discovery_tables import (
    evidence_table,
    findings_table,
    gains_table,
    held_out_table,
    parameters_table,
    scores_table,
)
from hygrokf.report.discovery_text import (
    actions,
    capital,
    formed,
    headline,
    held_out_sentence,
    held_out_sentences,
    line_sentence,
    named_alone,
    reasons,
    settings_words,
    tried,
    warned,
)
from hygrokf.report.figures.lead import episodes, errors_over_drivers
from hygrokf.report.figures.residual_structure import (
    TITLE,
    figure_day_hour,
    figure_error_course,
    figure_innovations,
)
from hygrokf.report.fit_page import write_report
from hygrokf.report.page import page_html
from hygrokf.version import __version__

ERRORS = "Errors before and after"
BY = "By driver, by day and hour, and by period"
TOGETHER = (
    "In the order of their acceptance, each beside those before it. The errors are those of the extended "
    "model with all of them together."
)


def write_discovery_report(found: Discovery | None, directory: str | os.PathLike[str]) -> Path:
    """Write `report.html`, the page of a discovery, and `fit_report.html`, that of the model it ends with.

    found: a discovery, whose results are written first (`write_discovery`); None: `directory` holds them
        already.

    Returns the path of report.html.  The page is a pure function of `discovery.json` and `discovery.npz`.
    Raises ResultFault where these are missing or damaged, ReportFault where fit.json or series.npz are.
    """
    folder = Path(directory)
    if found is not None:
        write_discovery(found, folder)
    read = read_discovery(folder)
    write_report(folder)
    page = discovery_blocks(read.results, read.before, read.after)
    return write_text_whole(folder / REPORT, page_html(page))


def discovery_blocks(
    found: DiscoveryResults, before: Residuals | None = None, after: Residuals | None = None
) -> Page:
    """What a discovery says: the verdict, the errors, and the readings beside base and extended model, first.

    before, after: residuals of both models, for the pictures.
    """
    shown = [] if before is None else episodes(found, before, after)
    courses = [] if before is None else _courses(found, before, after)
    lead = [*shown, *courses][:1]
    evidence = evidence_table(found)
    rest = [one for one in shown if one not in lead]
    body = (
        *section(
            "What the simulation gets wrong",
            Prose(f"{FREE_RUN} {INNOVATIONS}", "note"),
            table_or(
                findings_table(found.findings),
                "No significant and material error that the accuracy of the sensors does not explain.",
            ),
            *rest,
        ),
        *section(
            "The causes" if len(found.causes) > 1 else "The cause",
            *(block for one in found.causes for block in _judged(found, one)),
            Prose(TOGETHER) if len(found.causes) > 1 else None,
        ),
        *section(
            "Refuted by held-out readings",
            *(block for one in found.refuted for block in _judged(found, one)),
        ),
        *_errors(found, before, after),
        *_constants(found),
        *section("Where the errors are", Details(BY, tuple(courses)) if courses else None),
        *_left(found),
        *section(
            "Causes and their evidence",
            Details(f"{len(evidence.rows)} causes", (evidence,), printed=True)
            if evidence
            else Prose("No cause was tried.", "missing"),
        ),
    )
    gains = table_or(gains_table(found), "No errors of a free run are known.")
    card = Card(
        "Verdict", headline(found), bounds=named_alone(found).removeprefix(", "),
        lines=tuple(map(sentence, (*reasons(found), *actions(found)))), wide=True, words=True,
        tone="open" if warned(found) else "plain",
    )  # fmt: skip
    return Page(
        "Discovery report",
        one_line(found.name).strip() or "unnamed record",
        spans_text(before),
        (*synthetic(found.synthetic, SYNTHETIC_PAGE), Cards((card,)), *lead, gains),
        body,
        _method(found),
    )


def spans_text(before: Residuals | None) -> tuple[str, ...]:
    """What the record covers, in words."""
    if before is None or not len(before.time_h):
        return ()
    time = before.time_s
    first, last = stamp_text(time[0]), stamp_text(time[-1])
    if not before.validation.any():
        return (f"{first} to {last}; nothing held out",)
    until = stamp_text(time[before.validation.argmax()])
    return (f"{first} to {last}; searched up to {until}, held out from there on",)


# --- sections --------------------------------------------------------------------------------


def _judged(found: DiscoveryResults, one: CauseFound | Refuted) -> tuple[Block, ...]:
    """A cause: settings and parameters of one that was accepted, and the held-out test."""
    blocks: list[Block | None] = [Heading(capital(formed(one.cause, one.form)), 3)]
    if isinstance(one, CauseFound):
        settings = settings_words(one.settings)
        without = "The cause has no parameters of its own: it corrects time stamps."
        blocks += [
            Prose(f"Found by search: {'; '.join(settings)}.") if settings else None,
            table_or(parameters_table(one), without),
        ]
    return present(
        *blocks, Prose(sentence(held_out_sentence(found, one.held_out))), held_out_table(one.held_out)
    )


def _errors(found: DiscoveryResults, before: Residuals | None, after: Residuals | None) -> tuple[Block, ...]:
    course = None
    if before is not None and after is not None and before.validation.any():
        course = Figure(
            "error-course",
            "The error on held-out readings, day by day",
            "The green course should stay below the red one, on most days and not on a few.",
            lambda: figure_error_course(before, after),
        )
    return section(
        ERRORS,
        *map(Prose, held_out_sentences(found)),
        course,
        table_or(
            scores_table(found, "validation"),
            "There is no held-out period with readings (`until` is not stated).",
        ),
        table_or(scores_table(found, "identification"), "Nothing was scored in the identification period."),
    )


def _constants(found: DiscoveryResults) -> tuple[Block, ...]:
    """The time constants of both models with their verdicts."""
    heading = "The time constants without and with the cause" if found.extended else "The time constants"
    base = "Time constants of the base model" if found.extended else "Time constants of the model"
    models = [(found.baseline, base)]
    if found.extended is not None:
        models.append((found.extended, "Time constants of the extended model"))
    return section(heading, *(inherited_verdicts(inherited(one.fit), words) for one, words in models))


def _left(found: DiscoveryResults) -> tuple[Block, ...]:
    """Lines in the spectra, and the errors of the extended model where there is one."""
    lines = Items(tuple(sentence(line_sentence(one)) for one in found.lines)) if found.lines else None
    errors = None
    if found.extended is not None:
        errors = table_or(
            findings_table(found.left, "of the extended model"),
            "The errors of the extended model show no structure under any tested condition.",
        )
    return section("What is left", lines, errors)


def _method(found: DiscoveryResults) -> tuple[Block, ...]:
    count = tried(found)
    which = "base" if found.extended is None else "extended"
    lines = (
        "The base model was simulated from its inputs alone. What it misses is taken as a disturbance that "
        "enters as flows of heat and vapour, with a spectrum of its own. Score tests under this error model "
        "looked for structure under every condition: episodes, regimes, hour, season, level, rate and lag of "
        "every driver, steps and drifts. The rate of false discoveries is controlled over all of them.",
        f"{count} {'cause was' if count == 1 else 'causes were'} judged, each in several forms and settings, "
        f"with {found.work.simulations:,} simulations. A cause is accepted by its evidence: what the maximum "
        "of the likelihood gains, less the price of its constants and of the settings that were tried. The "
        "same must hold by days, which are fewer than readings where they resemble each other.",
        "Choices rest on the identification readings. Held-out readings refute a cause with which the errors "
        "3, 12 and 48 h ahead or of the free run grow, one that they speak against, and one with little "
        "evidence that lowers no free-run error; they choose nothing else. The bounds of the errors’ "
        "fall take days as independent; they show how much it varies within this period, not in another "
        "season.",
        "Confidence is how often a name with such evidence and such a lead over its rivals was right on "
        "simulated plants. A cause that is not in the library cannot be named, and a cause with a similar "
        "effect may be named instead: check in the turbine before acting on it.",
    )
    version = found.version or "(version not stated)"
    return (
        *method("Data and method", *lines),
        Link(f"The {which} model with all its parameters:", BESIDE_DISCOVERY),
        Prose(f"Found by hygrokf {version}; page by hygrokf {__version__}."),
    )


# --- pictures --------------------------------------------------------------------------------


def _courses(found: DiscoveryResults, before: Residuals, after: Residuals | None) -> list[Figure]:
    """The errors over drivers, over days and hours, and the innovations."""
    figures = [errors_over_drivers(found, before, after)]
    for quantity in QUANTITIES:
        changed = after if _differ(before, after, quantity) else None
        same = " The extended model leaves these errors as they are." if after is not changed else ""
        figures.append(
            Figure(
                f"days-{quantity}",
                f"Error of the {TITLE[quantity].lower()} by day and hour",
                "Horizontal stripes: errors tied to the time of day. Vertical stripes: errors tied to "
                f"weather or operation. A lasting change of colour: something changed on that date.{same}",
                partial(figure_day_hour, before, quantity, changed),
            )
        )
    figures.append(
        Figure(
            "innovations",
            "Innovations: periods, and correlation with the drivers",
            "Curves should stay within the grey bands. A peak shows a period; a correlation at lags above "
            "zero shows a response to that driver that the one-step prediction lacks.",
            lambda: figure_innovations(before, after),
        )
    )
    return figures


def _differ(before: Residuals, after: Residuals | None, quantity: str) -> bool:
    """Whether the extended model's free run errs otherwise, by more than a hundredth of the error."""
    if after is None:
        return False
    if len(before.time_h) != len(after.time_h):
        return True
    apart = np.abs(before.error(quantity) - after.error(quantity))
    return bool(np.nanmax(apart, initial=0.0) > 0.01 * before.rmse(quantity))
