"""The tables of a discovery: findings, parameters of causes, time constants, scores, what was left out."""

from __future__ import annotations

import math

from hygrokf.discovery.discovery_results import CauseFound, DiscoveryResults, Rejected
from hygrokf.evaluation.scoring import REGIMES, SCORED
from hygrokf.identification.fit_results import FitResults
from hygrokf.identification.verdict import verdicts
from hygrokf.identification.verdict_terms import REJECT
from hygrokf.identification.wording import NONE, fixed, percent, plain_number
from hygrokf.report.blocks import Table
from hygrokf.report.discovery_text import (
    PARTS,
    capital,
    parameter_cells,
    signed_percent,
    spoken,
    title,
)
from hygrokf.report.fit_tables import rmse_table
from hygrokf.report.fit_text import p_value, share_text, simulated, time_constant


def findings_table(found: DiscoveryResults) -> Table:
    """Significant and material errors of the simulation, worst first."""
    rows = tuple(
        (
            capital(one.statement.split(" (", 1)[0]),
            f"{plain_number(one.size, 2)} {one.unit}".strip(),
            f"{one.n_episodes} of {one.n_possible}",
            percent(one.sensor_share),
            p_value(one.p_adjusted),
        )
        for one in found.findings
    )
    return Table(
        "Worst first",
        ("in the identification period", "size", "episodes", "sensors", "p"),
        rows,
        note=(
            "Size: error under this condition less the error at all other times. Episodes: how many of all "
            "episodes show the error. Sensors: share of the squared error that the accuracy of the sensors "
            "explains. p: probability of such an error by chance, corrected for everything that was tested."
        ),
    )


def parameters_table(cause: CauseFound) -> Table:
    """The parameters of a cause with bounds."""
    rows = tuple((name, *parameter_cells(row), row.meaning) for name, row in cause.parameters.items())
    columns = ("parameter", "value", "95 % bounds", "unit", "meaning")
    return Table("Parameters", columns, rows, left=(0, 3, 4), brief=(0, 1, 2, 3))


def models(found: DiscoveryResults) -> tuple[FitResults, FitResults]:
    """The base and the extended model as results of a fit; an absent one is empty."""
    return found.baseline.fit, FitResults() if found.extended is None else found.extended.fit


def constants_table(found: DiscoveryResults) -> Table | None:
    """Both time constants by the base and by the extended model; None without an extended model."""
    if found.extended is None:
        return None
    rows = []
    for name in PARTS:
        pair = [time_constant(model, name) for model in models(found)]
        if all(one.found is None for one in pair):
            continue
        cells = []
        for one in pair:
            known = one.found is not None
            cells += [
                one.value,
                one.bounds.split(",")[0] if one.closed else NONE,
                one.verdict.words if known else NONE,
            ]
        a, b = (one.found.value_h if one.found and one.closed else math.nan for one in pair)
        rows.append((name, *cells, _change(a, b)))
        value, span = simulated(pair[0].found)
        if value:
            # the extended model has no such estimate: its free run is not fitted
            rows.append(("  by its free run", value, span or NONE, "", NONE, NONE, "", NONE))
    return Table(
        "Time constants",
        ("", "value", "bounds [h]", "verdict", "value", "bounds [h]", "verdict", "change"),
        tuple(rows),
        left=(0, 3, 6),
        groups=(("", 1), ("base model", 3), ("extended model", 3), ("", 1)),
        brief=(0, 1, 2, 4, 5, 7),
    )


def constants_sentences(found: DiscoveryResults) -> list[str]:
    """How far off the base model's time constants were, and whether their bounds held the better value."""
    said = []
    base, extended = models(found)
    for name in PARTS:
        first, last = base.time_constants.get(name), extended.time_constants.get(name)
        verdict = verdicts(extended).get(name)
        if first is None or last is None or verdict is None:
            continue
        value, after, low, high = first.value_h, last.value_h, first.lower_h, first.upper_h
        if not (math.isfinite(value) and math.isfinite(after) and after > 0 and value > 0):
            continue
        if verdict.verdict == REJECT:
            said.append(
                f"The {name} time constant of the extended model is {verdict.words} either, so it does not "
                f"show how wrong the base model's is: {verdict.why}."
            )
            continue
        off = value / after - 1.0
        if abs(off) < 0.005:
            said.append(f"The {name} time constant stays the same.")
            continue
        bounds = ""
        if math.isfinite(low) and math.isfinite(high):
            inside = low <= after <= high
            held = "held" if inside else "did not hold"
            bounds = f", {'but' if inside else 'and'} its bounds {held} the value of the extended model"
        direction = "too long" if off > 0 else "too short"
        said.append(
            f"Without the cause the {name} time constant was {signed_percent(off)[1:]} {direction}{bounds}."
        )
    return said


def scores_table(found: DiscoveryResults, period: str) -> Table | None:
    """Free-run errors of base and extended model in one period, with the simple rules; None without
    scores."""
    before, after = models(found)
    base, wider = rmse_table(before, period), rmse_table(after, period)
    if base is None:
        return None
    first, *rest = base.rows
    rows = [("base model, free run", *first[1:])]
    if wider is not None:
        rows.append(("extended model, free run", *wider.rows[0][1:]))
        pairs = (
            (getattr(model.errors(period, quantity), regime) for model in (before, after))
            for quantity in SCORED
            for regime in REGIMES
        )
        rows.append(("  change", *(_change(a, b) for a, b in pairs)))
    return Table(
        base.heading,
        base.columns,
        (*rows, *rest),
        marked=(1 if wider is not None else 0,),
        groups=base.groups,
    )


def _change(before: float, after: float) -> str:
    """The relative change of a number."""
    return signed_percent(after / before - 1.0) if before > 0 and math.isfinite(after) else NONE


def _form(one: Rejected) -> str:
    """The best form of a cause, in brackets, where it has another name than the cause."""
    form = spoken(one.form) if one.form else ""
    return f" ({form})" if form and form != spoken(one.cause) else ""


def rejected_table(found: DiscoveryResults) -> Table:
    """Every cause that was tried and left out, in order of its evidence."""

    def worth(evidence: float) -> float:
        return evidence if math.isfinite(evidence) else -math.inf

    rows = tuple(
        (
            title(one.cause) + _form(one),
            fixed(one.evidence.lr, 1),
            f"{one.evidence.df:.0f}" if math.isfinite(one.evidence.df) else NONE,
            fixed(one.evidence.bic_gain, 1),
            *(share_text(one.evidence.free_run_gain.get(part, math.nan)) for part in PARTS),
            one.reason or NONE,
        )
        for one in sorted(found.rejected, key=lambda one: -worth(one.evidence.bic_gain))
    )
    return Table(
        "In order of their evidence",
        ("cause (best form)", "gain", "df", "net", "temp.", "hum.", "why it was rejected"),
        rows,
        left=(0, 6),
        groups=(("", 1), ("2 ln L", 3), ("free run", 2), ("", 1)),
        note=(
            "2 ln L: gain in twice the log-likelihood, all parameters estimated again; df: new parameters; "
            "net: gain less the penalty (BIC) for parameters and for the settings searched. Free run: "
            "relative reduction of the squared error; below zero the error grows."
        ),
    )
