"""The tables of a discovery, once as data: misfits, parameters of causes, time constants, scores, what was
left out."""

from __future__ import annotations

import math
from collections.abc import Mapping

from hygrokf.data.lookup import entry, number
from hygrokf.identification.verdict import REJECT, verdicts
from hygrokf.identification.wording import NONE, SCORED, fixed, percent, plain_number, text_of
from hygrokf.report.blocks import Table
from hygrokf.report.discovery_text import (
    PARTS,
    chance,
    fit_like,
    parameter_cells,
    rows_of,
    share_words,
    signed_percent,
    spoken,
    title,
)
from hygrokf.report.fit_tables import REGIMES, rmse_table
from hygrokf.report.fit_text import simulated, time_constant

WHICH = ("baseline", "extended")


def misfits_table(found: Mapping) -> Table | None:
    """What the simulation gets wrong, worst first; None where nothing is both significant and material."""
    rows = []
    for one in rows_of(found, "misfits"):
        size, seen, possible, share = (
            number(one, part) for part in ("size", "n_episodes", "n_possible", "sensor_share")
        )
        unit = text_of(entry(one, "unit"))
        episodes = NONE
        if math.isfinite(seen):
            episodes = f"{seen:.0f} of {possible:.0f}" if math.isfinite(possible) else f"{seen:.0f}"
        rows.append(
            (
                _capital(text_of(entry(one, "statement")).split(" (", 1)[0]),
                f"{plain_number(size, 2)} {unit}".strip(),
                episodes,
                percent(share),
                chance(number(one, "p_adjusted")),
            )
        )
    if not rows:
        return None
    return Table(
        "Worst first",
        ("in the identification period", "size", "episodes", "sensors", "p"),
        tuple(rows),
        note=(
            "Size: against all other times of the same record. Episodes: in how many of all that there were "
            "it is seen. Sensors: share of its square that their accuracy explains. p: chance of it without "
            "a cause, corrected for everything that was asked."
        ),
    )


def parameters_table(cause: Mapping) -> Table | None:
    """The parameters of a cause with bounds; None where it has none."""
    found = entry(cause, "parameters")
    rows = []
    for name, row in found.items() if isinstance(found, Mapping) else ():
        value, bounds, unit = parameter_cells(row)
        rows.append((text_of(name), value, bounds, unit, text_of(entry(row, "meaning"))))
    if not rows:
        return None
    return Table(
        "Parameters", ("parameter", "value", "95 % bounds", "unit", "meaning"), tuple(rows), left=(0, 3, 4)
    )


def constants_table(found: Mapping) -> Table | None:
    """Both time constants by the base and by the extended model; None without an extended model."""
    if not isinstance(entry(found, "extended"), Mapping):
        return None
    rows = []
    for name in ("thermal", "hygric"):
        pair = [time_constant(fit_like(found, which), name) for which in WHICH]
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
        rows.append((name, *cells, signed_percent(b / a - 1.0) if a > 0 and math.isfinite(b) else NONE))
        value, _, span = simulated(pair[0].found).partition(" (")
        if value:
            # the extended model has no such estimate: its free run is not fitted
            rows.append(("  by its free run", value, span.rstrip(")") or NONE, "", NONE, NONE, "", NONE))
    if not rows:
        return None
    return Table(
        "Time constants",
        ("", "value", "bounds [h]", "verdict", "value", "bounds [h]", "verdict", "change"),
        tuple(rows),
        left=(0, 3, 6),
        groups=(("", 1), ("base model", 3), ("extended model", 3), ("", 1)),
    )


def constants_sentences(found: Mapping) -> list[str]:
    """By how much the base model was wrong about each time constant, and whether its bounds hid that."""
    said = []
    for name in ("thermal", "hygric"):
        value, low, high = (
            number(found, "baseline", "time_constants", name, part)
            for part in ("value_h", "lower_h", "upper_h")
        )
        after = number(found, "extended", "time_constants", name, "value_h")
        if not (math.isfinite(value) and math.isfinite(after) and after > 0 and value > 0):
            continue
        verdict = verdicts(fit_like(found, "extended")).get(name)
        if verdict is None:
            continue
        if verdict.verdict == REJECT:
            said.append(
                f"The {name} time constant of the extended model is {verdict.words} either, so it does not "
                f"tell how wrong the base model's is: {verdict.why}."
            )
            continue
        off = value / after - 1.0
        if abs(off) < 0.005:
            said.append(f"The {name} time constant stays as it was.")
            continue
        known = math.isfinite(low) and math.isfinite(high)
        inside = known and low <= after <= high
        bounds = (
            ""
            if not known
            else ", within its own bounds"
            if inside
            else ", and its bounds did not hold the value that the extended model finds"
        )
        direction = "too long" if off > 0 else "too short"
        said.append(
            f"Without the cause the {name} time constant was "
            f"{percent(abs(off), 1 if abs(off) < 0.095 else 0)} {direction}{bounds}."
        )
    return said


def scores_table(found: Mapping, period: str) -> Table | None:
    """Free-run errors of base and extended model in one period, with the sceptic's baselines; None without
    scores."""
    base = rmse_table(fit_like(found, "baseline"), period)
    if base is None:
        return None
    first, *rest = base.rows
    wider = rmse_table(fit_like(found, "extended"), period)
    rows = [("base model, free run", *first[1:])]
    if wider is not None:
        rows.append(("extended model, free run", *wider.rows[0][1:]))
        rows.append(("  change", *_changes(found, period)))
    return Table(
        base.heading,
        base.columns,
        (*rows, *rest),
        marked=(1 if wider is not None else 0,),
        groups=base.groups,
    )


def _changes(found: Mapping, period: str) -> list[str]:
    cells = []
    for quantity in SCORED:
        for regime in REGIMES:
            a, b = (number(found, which, "rmse", period, quantity, regime) for which in WHICH)
            cells.append(signed_percent(b / a - 1.0) if a > 0 and math.isfinite(b) else NONE)
    return cells


def rejected_table(found: Mapping) -> Table | None:
    """Every cause that was tried and left out, the one with most evidence first; None without any."""
    rows = []
    for one in rows_of(found, "rejected"):
        lr, df, worth = (number(one, "evidence", part) for part in ("lr", "df", "bic_gain"))
        shares = [number(one, "evidence", "free_run_gain", part) for part in PARTS]
        cells = [share_words(share) for share in shares]
        form = text_of(one.get("form"))
        name = title(one.get("cause"))
        rows.append(
            (
                worth if math.isfinite(worth) else -math.inf,
                (
                    f"{name} ({spoken(form)})" if form and spoken(form) != spoken(one.get("cause")) else name,
                    fixed(lr, 1),
                    f"{df:.0f}" if math.isfinite(df) else NONE,
                    fixed(worth, 1),
                    *cells,
                    text_of(one.get("reason")) or NONE,
                ),
            )
        )
    if not rows:
        return None
    rows.sort(key=lambda row: -row[0])
    return Table(
        "In order of their evidence",
        ("cause (best form)", "gain", "df", "net", "temp.", "hum.", "why it was left out"),
        tuple(row for _, row in rows),
        left=(0, 6),
        groups=(("", 1), ("2 ln L", 3), ("free run", 2), ("", 1)),
        note=(
            "2 ln L: gain in twice the log-likelihood, all parameters estimated again; df: new parameters; "
            "net: gain less the price (BIC) of parameters and of the settings searched. Free run: share of "
            "the squared error of temperature and humidity that is gone; below zero it gets worse."
        ),
    )


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
