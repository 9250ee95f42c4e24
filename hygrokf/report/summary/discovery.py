"""The summary of a discovery."""

from __future__ import annotations

from hygrokf.discovery.discovery_results import CauseFound, DiscoveryResults
from hygrokf.discovery.residuals import Residuals
from hygrokf.evaluation.scoring import SCORED
from hygrokf.identification.verdict import best_rule, inherited
from hygrokf.identification.wording import NONE, QUANTITIES, fixed, sentence
from hygrokf.report.blocks import SYNTHETIC_PAGE, Table
from hygrokf.report.discovery_page import spans_text
from hygrokf.report.discovery_text import (
    NOT_RIGHT,
    advice,
    confidence_of,
    headline,
    listed,
    meaning,
    quantity_of,
    scored_error,
    short_gain,
    spoken,
    title,
    untried,
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
    single = found.verdict == "named" and len(found.causes) == 1
    sure = f" (confidence {confidence_of(found.causes[0])})" if single else ""
    actions = [text for text in (*map(_check, found.causes), *advice(found), untried(found)) if text]
    return Summary(
        "Summary of a discovery",
        named(found.name),
        "What does the model of this cabinet lack?",
        f"{headline(found)}{sure}.",
        "",
        tuple(map(sentence, (*(text for one in found.causes for text in _cause(one)), *meaning(found)))),
        _gains(found) if found.causes else _errors(found),
        drawable(lambda: lead_of_discovery(found, before, after)),
        tuple(map(sentence, actions or _otherwise(found))),
        (
            ("Record", named(found.name)),
            *known("Period", " ".join(spans_text(before))),
            made_by(found.version),
        ),
        "open" if found.verdict == "unexplained" or headline(found) == NOT_RIGHT else "plain",
        SYNTHETIC_PAGE if found.synthetic else "",
    )


def _cause(one: CauseFound) -> tuple[str, ...]:
    rivals = listed(spoken(name) for name in one.ambiguous_with)
    return (
        one.statement or spoken(one.cause),
        short_gain(one.gain),
        *([f"this record cannot distinguish it from {rivals}"] if rivals else []),
    )


def _check(one: CauseFound) -> str:
    """What to check in the turbine, and the measurement that separates a cause from its rivals."""
    about = f"Check in the turbine for {spoken(one.cause)}: {one.remedy}" if one.remedy else ""
    rivals = listed(spoken(name) for name in one.ambiguous_with)
    apart = f"To distinguish it from {rivals}: {one.separate_by}" if rivals and one.separate_by else ""
    return ". ".join(text for text in (about, apart) if text)


def _otherwise(found: DiscoveryResults) -> tuple[str, ...]:
    """What to do where the discovery states nothing: after a cause without a check, or a base model that is
    wrong although no cause was found."""
    if found.causes:
        return ("use the extended model, fit.json beside the discovery, in the place of the base model",)
    reasons = [reason for one in inherited(found.baseline.fit).values() for reason in one.reasons]
    return ("do not rely on the base model", *(one for one in remedies(reasons) if one != LACKING))


def _gains(found: DiscoveryResults) -> Table:
    """The error without and with each cause, and the bounds of its fall."""
    rows = []
    for one in found.causes:
        gain = one.gain
        if gain is None or not gain.known:
            rows.append((title(one.cause), NONE, NONE, NONE, confidence_of(one)))
            continue
        name, unit = quantity_of(gain.quantity)
        low, high = fixed(gain.lower), fixed(gain.upper)
        bounds = f"{low} … {high} {unit}" if NONE not in (low, high) else NONE
        errors = (f"{fixed(gain.rmse_before)} {unit}", f"{fixed(gain.rmse_after)} {unit}")
        rows.append((f"{title(one.cause)}: {name} error", *errors, bounds, confidence_of(one)))
    head = ("", "without it", "with it", "95 % bounds of the fall", "confidence")
    return Table("The numbers", head, tuple(rows))


def _errors(found: DiscoveryResults) -> Table:
    """The errors of the base model, as no cause is named."""
    rows = []
    for quantity in SCORED:
        error, _, period = scored_error(found, quantity)
        if error == error:
            name, unit = QUANTITIES[quantity]
            rule = best_rule(found.baseline.fit, quantity, period)
            where = "held-out period" if period == "validation" else "identification period"
            simple = NONE if rule is None else f"{fixed(rule.rule)} {unit} (“{rule.words}”)"
            rows.append((f"{name} error, {where}", f"{fixed(error)} {unit}", simple))
    return Table("The numbers", ("", "base model", "best rule without a model"), tuple(rows), left=(0, 2))
