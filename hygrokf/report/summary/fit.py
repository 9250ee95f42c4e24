"""The summary of a fit."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hygrokf.evaluation.scoring import SCORED
from hygrokf.identification.fit_results import FitResults
from hygrokf.identification.verdict import verdicts
from hygrokf.identification.verdict_terms import BELIEVE, CAUTION, REJECT, VERDICTS, WORDS, Verdict
from hygrokf.identification.wording import NONE, QUANTITIES, fixed, sentence
from hygrokf.modelling.design import PARTS
from hygrokf.report.blocks import SYNTHETIC_PAGE, Table
from hygrokf.report.figures.lead import lead_of_fit
from hygrokf.report.fit_page import period_text
from hygrokf.report.fit_text import head, judgements, time_constant
from hygrokf.report.summary.page import Summary, drawable, known, made_by, named, remedies


def summary_of_fit(fit: FitResults, series: Mapping[str, np.ndarray]) -> Summary:
    """How fast the cabinet follows: both time constants with verdicts, and the errors of the free run.

    series: the arrays of `series.npz`.
    """
    found = verdicts(fit)
    parts = [name for name in PARTS if name in found]
    quantities = " and ".join(QUANTITIES_OF[name] for name in parts) or "the air"
    doubted = [name for name in parts if found[name].verdict != BELIEVE]
    return Summary(
        "Summary of an identification",
        named(fit.name),
        f"How fast do {quantities} in the cabinet follow the weather and the operation?"
        if len(parts) > 1
        else f"How fast does {quantities} in the cabinet follow the weather and the operation?",
        " ".join(f"{head(fit, name).rstrip(':.')}." for name in parts)
        or "This record determines no time constant.",
        max((found[name].verdict for name in parts), key=VERDICTS.index, default=REJECT),
        tuple(sentence(f"{name} time constant, {found[name].sentence}") for name in doubted),
        _constants(fit, parts),
        drawable(lambda: lead_of_fit(series)),
        (*_uses(found), *remedies(reason for one in found.values() for reason in one.reasons)),
        (
            ("Record", named(fit.name)),
            *known("Period", period_text(fit)),
            made_by(fit.version),
        ),
        synthetic=SYNTHETIC_PAGE if fit.synthetic else "",
    )


QUANTITIES_OF = {"thermal": "the temperature", "hygric": "the humidity"}


def _uses(found: Mapping[str, Verdict]) -> tuple[str, ...]:
    """Which time constants may be used."""
    said = []
    for kind in VERDICTS:
        names = [name for name, one in found.items() if one.verdict == kind]
        if not names:
            continue
        end, its, them = ("s", "their", "them") if len(names) > 1 else ("", "its", "it")
        how = {
            BELIEVE: f"can be used with {its} bounds: in simulations, forecasts and the climate of a site",
            CAUTION: f"can be used if {its} bounds and the doubts above are stated with {them}",
            REJECT: f"must not be used, nor what rests on {them}",
        }[kind]
        said.append(f"The {' and '.join(names)} time constant{end} {how}.")
    return tuple(said)


def _constants(fit: FitResults, parts: list[str]) -> Table:
    """The time constants, then the errors of the free run."""
    rows = []
    for name in parts:
        one = time_constant(fit, name)
        bounds = f"{one.bounds.split(',')[0]} h" if one.closed else NONE
        rows.append((f"{name} time constant", one.value, bounds, one.verdict.words))
    kinds = {one.about: one.kind for one in judgements(fit)}
    for quantity in SCORED:
        late, early = (fit.errors(period, quantity).total for period in ("validation", "identification"))
        if quantity in kinds and (late == late or early == early):
            name, unit = QUANTITIES[quantity]
            error, where = (late, "on new data") if late == late else (early, "on the data of the fit")
            words = f"error of the simulated {name}, {where}"
            rows.append((words, f"{fixed(error)} {unit}", "", WORDS[kinds[quantity]]))
    return Table(
        "The numbers",
        ("", "value", "95 % bounds", "verdict"),
        tuple(rows),
        left=(0, 3),
        note="A time constant is the time in which 63 % of a lasting change outside reach the cabinet.",
    )
