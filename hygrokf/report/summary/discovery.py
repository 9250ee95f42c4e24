"""The summary of a discovery."""

from __future__ import annotations

from hygrokf.discovery.discovery_results import CauseFound, DiscoveryResults
from hygrokf.discovery.residuals import Residuals
from hygrokf.identification.verdict import inherited
from hygrokf.identification.wording import sentence
from hygrokf.report.blocks import SYNTHETIC_PAGE
from hygrokf.report.discovery_page import spans_text
from hygrokf.report.discovery_tables import gains_table
from hygrokf.report.discovery_text import (
    NOT_RIGHT,
    advice,
    alike_sentence,
    answer,
    apart_sentence,
    check_sentence,
    class_of,
    headline,
    marked,
    meaning,
    so_far,
    sure_of,
    unfinished,
    warnings,
)
from hygrokf.report.figures.lead import lead_of_discovery
from hygrokf.report.summary.content import Summary, drawable, known, made_by, named
from hygrokf.report.summary.remedies import LACKING, remedies


def summary_of_discovery(
    found: DiscoveryResults, before: Residuals | None, after: Residuals | None
) -> Summary:
    """What the model lacks: the cause with its confidence and gain, or that none is named.

    before, after: residuals of the base and of the extended model.
    """
    single = found.verdict in ("named", "ambiguous") and len(found.causes) == 1
    sure = sure_of(found.causes[0]) if single and not unfinished(found) else ""
    checks = (make(one) for one in found.causes for make in (check_sentence, apart_sentence))
    actions = [text for text in (*checks, *advice(found)) if text]
    ended = so_far(found)
    causes = (_cause(found, one, single and not ended) for one in found.causes)
    reasons = (text for text in (ended, *meaning(found), *causes, *warnings(found)) if text)
    wrong = found.verdict == "unexplained" or answer(found) == NOT_RIGHT or bool(ended)
    return Summary(
        "Summary of a discovery",
        named(found.name),
        "What does the model of this cabinet lack?",
        f"{headline(found)}{sure}.",
        "",
        tuple(map(sentence, reasons)),
        gains_table(found),
        drawable(lambda: lead_of_discovery(found, before, after)),
        tuple(map(sentence, actions or _otherwise(found))),
        (
            ("Record", named(found.name)),
            *known("Period", " ".join(spans_text(before))),
            made_by(found.version),
        ),
        "open" if wrong else "plain",
        SYNTHETIC_PAGE if found.synthetic else "",
    )


def _cause(found: DiscoveryResults, one: CauseFound, single: bool) -> str:
    """A cause with its confidence where the answer does not state it, its mark and its rivals."""
    what = "" if one.ambiguous_with else one.statement
    about = what if single else f"{class_of(one)}{sure_of(one)}"
    return "; ".join(text for text in (about, marked(found, one.held_out), alike_sentence(one)) if text)


def _otherwise(found: DiscoveryResults) -> tuple[str, ...]:
    """What to do where the discovery states nothing: after a cause without a check, or a base model that is
    wrong although no cause was found."""
    if found.causes:
        return ("use the extended model, fit.json beside the discovery, in the place of the base model",)
    reasons = [reason for one in inherited(found.baseline.fit).values() for reason in one.reasons]
    return ("do not rely on the base model", *(one for one in remedies(reasons) if one != LACKING))
