"""The tables of a discovery: findings, errors, parameters of causes, scores, evidence."""

from __future__ import annotations

import math
from collections.abc import Sequence

from hygrokf.discovery.discovery_results import (
    CauseFound,
    DiscoveryResults,
    Finding,
    HeldOutTest,
    Refuted,
    Rejected,
)
from hygrokf.evaluation.scoring import REGIMES, SCORED
from hygrokf.identification.fit_results import FitResults
from hygrokf.identification.verdict import best_rule
from hygrokf.identification.wording import NONE, fixed, percent, plain_number
from hygrokf.report.blocks import Table
from hygrokf.report.discovery_text import (
    EXCLUSIONS,
    MOST_SATURATED,
    SCORED_AS,
    capital,
    formed,
    parameter_cells,
    place_of,
    quantity_of,
    signed_percent,
    unchanged,
)
from hygrokf.report.fit_tables import rmse_table
from hygrokf.report.fit_text import p_value


def findings_table(found: Sequence[Finding], when: str = "in the identification period") -> Table:
    """Significant and material errors of a simulation, worst first."""
    rows = tuple(
        (
            capital(one.statement.split(" (", 1)[0]),
            f"{plain_number(one.size, 2)} {one.unit}".strip(),
            f"{one.n_episodes} of {one.n_possible}",
            percent(one.sensor_share),
            p_value(one.p_adjusted),
        )
        for one in found
    )
    return Table(
        "Worst first",
        (when, "size", "episodes", "sensors", "p"),
        rows,
        note=(
            "Size: error under this condition less the error at all other times. Episodes: how many of all "
            "episodes show the error. Sensors: share of the squared error that the accuracy of the sensors "
            "explains. p: probability of such an error by chance, corrected for everything that was tested."
        ),
    )


def gains_table(found: DiscoveryResults) -> Table:
    """Free-run errors by quantity, of the base model and of the extended one where there is one, with the
    best rule that needs no model."""
    rows = []
    wider = found.extended is not None
    places = [place_of(found, gain) for gain in found.gains]
    for gain, place in zip(found.gains, places, strict=True):
        name, symbol = quantity_of(gain.quantity)
        scored = SCORED_AS.get(gain.quantity)
        rule = best_rule(found.baseline.fit, scored, gain.period) if scored else None
        against = NONE if rule is None else f"{fixed(rule.rule)} {symbol} (“{rule.words}”)"
        pair = _pair(gain.rmse_before, gain.rmse_after, symbol)
        known = not unchanged(gain.rmse_before, gain.rmse_after) and math.isfinite(gain.upper - gain.lower)
        bounds = f"{fixed(gain.lower)} … {fixed(gain.upper)} {symbol}" if known else NONE
        rows.append((name if place == places[0] else f"{name}, {place}", *pair, bounds, against))
        if math.isfinite(gain.driven_before):
            driven = _pair(gain.driven_before, gain.driven_after, symbol)
            rows.append((f"{name}, on the measured temperature", *driven, NONE, NONE))
    about = f"free-run error on {places[0] if places else 'readings'}"
    head = (about, "base model", "extended model", "change", "bounds of the fall", "best rule, no model")
    kept = range(6) if wider else (0, 1, 5)
    return Table(
        "Root mean squares",
        tuple(head[i] for i in kept),
        tuple(tuple(row[i] for i in kept) for row in rows),
        left=(0, len(kept) - 1),
        brief=(0, 1, 2, 3) if wider else (),
        note=(
            "Bounds: 95 %. Where nothing else is said, the absolute humidity is simulated on the simulated "
            "temperature, as “hygrokf simulate” does."
        ),
    )


def _pair(before: float, after: float, symbol: str) -> tuple[str, str, str]:
    """Two errors and their change."""
    change = "±0 %" if unchanged(before, after) else _change(before, after)
    return f"{fixed(before)} {symbol}", f"{fixed(after)} {symbol}", change


def held_out_table(test: HeldOutTest) -> Table:
    """What held-out readings say of a cause, by quantity."""
    rows = []
    for q in test.before:
        name, symbol = quantity_of(q)
        numbers = (round(one.get(q, math.nan), 2) + 0.0 for one in (test.z, test.growth))  # no −0.00
        pair = _pair(test.before[q], test.after.get(q, math.nan), symbol)
        rows.append((name, *pair, *map(fixed, numbers)))
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


def parameters_table(cause: CauseFound) -> Table:
    """The parameters of a cause with bounds."""
    rows = tuple((name, *parameter_cells(row), row.meaning) for name, row in cause.parameters.items())
    columns = ("parameter", "value", "95 % bounds", "unit", "meaning")
    return Table("Parameters", columns, rows, left=(0, 3, 4), brief=(0, 1, 2, 3))


def scores_table(found: DiscoveryResults, period: str) -> Table | None:
    """Free-run errors of base and extended model in one period, with the simple rules; None without
    scores."""
    before, after = found.baseline.fit, FitResults() if found.extended is None else found.extended.fit
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


def evidence_table(found: DiscoveryResults) -> Table:
    """Every cause that was judged, in order of its evidence; accepted ones are set off."""
    judged: list[tuple[CauseFound | Refuted | Rejected, str]] = [
        *((one, _accepted(one)) for one in found.causes),
        *((one, "held-out readings refute it") for one in found.refuted),
        *((one, _reason(found, one)) for one in found.rejected),
    ]
    judged.sort(key=lambda row: -worth if math.isfinite(worth := row[0].evidence.evidence) else math.inf)
    rows = []
    for one, outcome in judged:
        known = one.evidence
        paid = (str(known.constants), str(known.searched)) if known.gains else (NONE, NONE)
        gains = (fixed(known.gains.get(q, math.nan), 1) for q in ("temperature", "vapour"))
        worths = (fixed(known.evidence, 1), fixed(known.in_days, 1))
        rows.append((capital(formed(one.cause, one.form)), *gains, *paid, *worths, outcome))
    return Table(
        "In order of their evidence",
        ("cause (best form)", "temp.", "hum.", "constants", "settings", "net", "in days", "outcome"),
        tuple(rows),
        left=(0, 7),
        marked=tuple(i for i, (one, _) in enumerate(judged) if isinstance(one, CauseFound)),
        groups=(("", 1), ("2 ln L", 2), ("paid for", 2), ("evidence", 2), ("", 1)),
        note=(
            "2 ln L: gain in twice the log-likelihood, a difference of maxima. Evidence: this gain less ln N "
            "for each constant in each quantity and 2 ln of the settings; in days: by how independent the "
            "days are."
        ),
        brief=(0, 5, 6, 7),
    )


def _accepted(one: CauseFound) -> str:
    """That a cause was accepted, and how far it leads in days."""
    lead = one.evidence.lead
    return f"accepted, {fixed(lead, 0)} ahead of the best rival" if math.isfinite(lead) else "accepted"


def _reason(found: DiscoveryResults, one: Rejected) -> str:
    """Why a cause was left out; a saturated sensor hides condensation."""
    hidden = one.cause == "condensation" and found.saturated > MOST_SATURATED
    return f"{EXCLUSIONS[one.reason]}{', but saturated readings may hide it' if hidden else ''}"
