"""The summary of a discovery."""

from __future__ import annotations

from hygrokf.discovery.discovery_results import DiscoveryResults
from hygrokf.discovery.residuals import Residuals
from hygrokf.identification.verdict import inherited
from hygrokf.identification.wording import sentence
from hygrokf.report.blocks import SYNTHETIC_PAGE
from hygrokf.report.discovery_page import spans_text
from hygrokf.report.discovery_tables import gains_table
from hygrokf.report.discovery_text import actions, headline, named_alone, reasons, warned
from hygrokf.report.figures.lead import lead_of_discovery
from hygrokf.report.summary.page import LACKING, Summary, drawable, known, made_by, named, remedies


def summary_of_discovery(
    found: DiscoveryResults, before: Residuals | None, after: Residuals | None
) -> Summary:
    """What the model lacks: the cause with its confidence and gain, or that none is named.

    before, after: residuals of the base and of the extended model.
    """
    return Summary(
        "Summary of a discovery",
        named(found.name),
        "What does the model of this cabinet lack?",
        f"{headline(found)}{named_alone(found)}.",
        "",
        tuple(map(sentence, reasons(found))),
        gains_table(found),
        drawable(lambda: lead_of_discovery(found, before, after)),
        tuple(map(sentence, actions(found) or _otherwise(found))),
        (
            ("Record", named(found.name)),
            *known("Period", " ".join(spans_text(before))),
            made_by(found.version),
        ),
        "open" if warned(found) else "plain",
        SYNTHETIC_PAGE if found.synthetic else "",
    )


def _otherwise(found: DiscoveryResults) -> tuple[str, ...]:
    """What to do where the discovery states nothing: after a cause without a check, or a base model that is
    wrong although no cause was found."""
    if found.causes:
        return ("use the extended model, fit.json beside the discovery, in the place of the base model",)
    against = [reason for one in inherited(found.baseline.fit).values() for reason in one.reasons]
    return ("do not rely on the base model", *(one for one in remedies(against) if one != LACKING))
