"""Cases, models or ambient sources side by side: the paper's Table III with bounds, differences, and a sceptic's rules.

A column is one fit's free run on one record.  Errors of two columns are compared on the instants that both have, with
the blocks of both drawn together: what the weather did to both at once cancels.  Columns without instants in common (other
years, other clocks) are not compared instant by instant.

Periods: `identification`, `validation` (by the record's own `until`) and `whole`, what the paper's Table III shows.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from itertools import combinations
from typing import Any

import numpy as np

from hygrokf.data.record import Record
from hygrokf.evaluation.bootstrap import resampled
from hygrokf.evaluation.scoring import PERIODS, SCORED, guesses, period_masks, rmse
from hygrokf.evaluation.simulation import measured
from hygrokf.identification.fit import Fit
from hygrokf.identification.tables import simulated, unlike
from hygrokf.identification.verdict import inherited, told
from hygrokf.identification.wording import NONE, RULES
from hygrokf.version import __version__

REGIMES = ("operation", "standstill", "total")
ALL_PERIODS = (*PERIODS, "whole")
SAME = 1e-6
"""Readings of one instant that differ by less [K], [g/m³] are the same reading."""
CSV_HEAD = (
    "kind", "column", "against", "fit", "case", "quantity", "unit", "period", "regime", "n", "value", "lower", "upper",
)  # fmt: skip
UNSCORED = (
    "nothing to score: no temperature or absolute humidity of the cabinet at a time when all inputs are known (a fit that "
    "knows the power needs the power); see `hygrokf check`"
)
UNITS = {"temperature_K": "K", "absolute_humidity_g_m3": "g/m3"}


@dataclass(frozen=True)
class Column:
    """A fit's free run on a record: errors (T,) by quantity at times (T,) [s], NaN where nothing is scored.

    `label` short name; `fit`, `case` what was combined; `own` whether the fit was identified on this record;
    `rules` errors of the sceptic's rules by quantity and rule; `masks` (T,) by period; `operating` (T,); `verdicts` on the
    numbers of the fit.
    """

    label: str
    fit: str
    case: str
    own: bool
    time_s: np.ndarray
    operating: np.ndarray
    readings: Mapping[str, np.ndarray]
    errors: Mapping[str, np.ndarray]
    rules: Mapping[str, Mapping[str, np.ndarray]]
    masks: Mapping[str, np.ndarray]
    statements: tuple[str, ...]
    synthetic: bool
    verdicts: Mapping[str, Mapping] = field(default_factory=dict)

    def shown(self, quantity: str, period: str, regime: str) -> np.ndarray:
        """(T,) True at the scored instants of a period and a regime."""
        chosen = self.masks[period] & np.isfinite(self.errors[quantity])
        return chosen if regime == "total" else chosen & (self.operating == (regime == "operation"))


def comparison_column(fit: Fit, record: Record, label: str, own: bool = False) -> Column:
    """The free run of a fit on a record.  Raises ValueError where the record lacks an input that the model reads."""
    _, made, predicted = simulated(fit, record)
    known = measured(made)
    errors, rules = {}, {}
    ruled = guesses(made, record.until_s)
    for quantity in SCORED:
        pair = predicted.of(quantity)
        if pair is None or not np.isfinite(known[quantity][made.scored]).any():
            continue
        errors[quantity] = np.where(made.scored, known[quantity] - pair[0], np.nan)
        rules[quantity] = {
            name: np.where(made.scored, known[quantity] - guess[quantity], np.nan)
            for name, guess in ruled.items()
            if quantity in guess
        }
    t = made.timeline
    masks = period_masks(made, record.until_s)
    masks["whole"] = np.ones(len(t), bool)
    statements = unlike(fit, record)
    if not errors:
        statements.append(UNSCORED)
    synthetic = bool(fit.results.get("synthetic")) or "synthetic" in record.name.lower()
    return Column(
        label,
        fit.name,
        record.name,
        own,
        t.origin_s + 3600.0 * t.time,
        made.operating,
        known,
        errors,
        rules,
        masks,
        tuple(statements),
        synthetic,
        inherited(fit.results),
    )


@dataclass(frozen=True)
class Comparison:
    """Columns side by side: plain `results` (compare.json), `columns` for pictures."""

    columns: tuple[Column, ...]
    results: Mapping[str, Any]

    def to_json(self) -> dict:
        return dict(self.results)


def compare(columns: Sequence[Column]) -> Comparison:
    """Scores of all columns, differences between any two, skill against the sceptic's rules.

    Raises ValueError for columns of the same label, and where no column has anything to score.
    """
    labels = [one.label for one in columns]
    twice = sorted({label for label in labels if labels.count(label) > 1})
    if twice:
        raise ValueError(f"expected columns of different names, found several called {', '.join(twice)}")
    if not any(one.errors for one in columns):
        raise ValueError(f"no column can be scored: {UNSCORED}")
    results = {
        "version": __version__,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "synthetic": any(one.synthetic for one in columns),
        "columns": [
            {
                "label": one.label,
                "fit": one.fit,
                "case": one.case,
                "identified_here": one.own,
                "verdicts": dict(one.verdicts),
                "statements": list(one.statements),
                "scores": _scores(one),
                "weeks": {q: [part.tolist() for part in rmse_by_week(one, q)] for q in one.errors},
            }
            for one in columns
        ],
        "differences": [_difference(a, b) for a, b in combinations(columns, 2)],
    }
    return Comparison(tuple(columns), results)


def _scores(one: Column) -> dict:
    """Errors with bounds and skill by period, quantity and regime; the rules' errors beside them on the same instants."""
    found: dict = {}
    for period in ALL_PERIODS:
        found[period] = {}
        for quantity, error in one.errors.items():
            rows = found[period][quantity] = {}
            for regime in REGIMES:
                rows[regime] = _scored(one, quantity, error, one.shown(quantity, period, regime))
    return found


def _scored(one: Column, quantity: str, error: np.ndarray, chosen: np.ndarray) -> dict:
    row: dict = {"n": int(chosen.sum()), "rmse": None, "lower": None, "upper": None, "rules": {}}
    drawn = resampled(one.time_s, np.where(chosen, error, np.nan)[:, None])
    if drawn is None:
        return row
    low, high = drawn.bounds(0) or (None, None)
    row |= {"rmse": float(drawn.value[0]), "lower": low, "upper": high, "blocks": drawn.blocks}
    for name, rule in one.rules[quantity].items():
        both = resampled(one.time_s, np.column_stack([np.where(chosen, error, np.nan), rule]))
        if both is None:
            continue
        value, low, high = both.skill(0, 1) or (_skill(both.value), None, None)
        row["rules"][name] = {
            "n": both.n,
            "rmse": float(both.value[1]),
            "skill": value,
            "lower": low,
            "upper": high,
        }
    return row


def _skill(value: np.ndarray) -> float | None:
    return None if not value[1] > 0 else float(1.0 - (value[0] / value[1]) ** 2)


def _difference(a: Column, b: Column) -> dict:
    """RMSE of `a` less that of `b` on the instants that both score."""
    common, i, j = np.intersect1d(a.time_s, b.time_s, assume_unique=True, return_indices=True)
    found: dict = {"of": a.label, "less": b.label, "same_readings": {}, "scores": {}}
    for quantity in (q for q in a.errors if q in b.errors):
        first, second = a.errors[quantity][i], b.errors[quantity][j]
        there = np.isfinite(first) & np.isfinite(second)
        if there.any():
            apart = np.abs(a.readings[quantity][i] - b.readings[quantity][j])[there]
            found["same_readings"][quantity] = bool(apart.max() <= SAME)
    for period in ALL_PERIODS:
        found["scores"][period] = {}
        for quantity in found["same_readings"]:
            rows: dict[str, dict[str, float | None]] = {}
            found["scores"][period][quantity] = rows
            for regime in REGIMES:
                chosen = a.shown(quantity, period, regime)[i] & b.shown(quantity, period, regime)[j]
                pair = np.column_stack([a.errors[quantity][i], b.errors[quantity][j]])
                drawn = resampled(common, np.where(chosen[:, None], pair, np.nan))
                if drawn is None:
                    rows[regime] = {"n": 0, "value": None, "lower": None, "upper": None}
                    continue
                value, low, high = drawn.difference(0, 1) or (
                    float(drawn.value[0] - drawn.value[1]),
                    None,
                    None,
                )
                rows[regime] = {"n": drawn.n, "value": value, "lower": low, "upper": high}
    return found


def rmse_by_week(one: Column, quantity: str) -> tuple[np.ndarray, np.ndarray]:
    """Middle [s] and root mean squared error of every week with at least a day of scored readings."""
    error = one.errors[quantity]
    there = np.isfinite(error)
    week = np.floor(one.time_s / 604800.0).astype(int)
    middles, values = [], []
    for number in np.unique(week[there]):
        part = there & (week == number)
        if np.ptp(one.time_s[part]) >= 86400.0:
            middles.append((number + 0.5) * 604800.0)
            values.append(rmse(error[part], one.operating[part])["total"])
    return np.array(middles), np.array(values, dtype=float)


# --- as text ---------------------------------------------------------------------------------


def comparison_csv(found: Mapping) -> str:
    """Everything of compare.json that is a number, one a line.

    `kind`: rmse (value RMSE), rule (RMSE of a sceptic's rule, named in `against`), skill (1 − MSE/MSE of that rule),
    difference (RMSE of `column` less that of `against` on common instants).
    """
    import csv

    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(CSV_HEAD)

    def cell(value: object) -> object:
        return "" if value is None else f"{value:.6g}" if isinstance(value, float) else value

    for one in found["columns"]:
        names = (one["fit"], one["case"])
        for period, quantity, regime, row in _cells(one["scores"]):
            place = (quantity, UNITS[quantity], period, regime)
            if row["rmse"] is None:
                continue
            ends = (row["n"], row["rmse"], row["lower"], row["upper"])
            writer.writerow(map(cell, ("rmse", one["label"], "", *names, *place, *ends)))
            for rule, said in row["rules"].items():
                writer.writerow(
                    map(
                        cell,
                        ("rule", one["label"], rule, *names, *place, said["n"], said["rmse"], None, None),
                    )
                )
                place_ = (quantity, "1", period, regime)
                ends = (said["n"], said["skill"], said["lower"], said["upper"])
                writer.writerow(map(cell, ("skill", one["label"], rule, *names, *place_, *ends)))
    for one in found["differences"]:
        for period, quantity, regime, row in _cells(one["scores"]):
            if row["value"] is not None:
                place = (quantity, UNITS[quantity], period, regime)
                ends = (row["n"], row["value"], row["lower"], row["upper"])
                writer.writerow(map(cell, ("difference", one["of"], one["less"], "", "", *place, *ends)))
    return buffer.getvalue()


def _cells(scores: Mapping) -> list[tuple[str, str, str, Mapping]]:
    return [
        (period, quantity, regime, row)
        for period, by_quantity in scores.items()
        for quantity, by_regime in by_quantity.items()
        for regime, row in by_regime.items()
    ]


def comparison_text(found: Mapping) -> str:
    """Table III as fixed-width text, the rules below it, then the differences in total."""
    labels = [one["label"] for one in found["columns"]]
    widest = max(map(len, labels))
    # names are cut only where they can still be told apart
    cut = 30 if len({label[:30] for label in labels}) == len(labels) else widest
    width = max(min(widest, cut), 12) + 2
    lines = []
    for one in found["columns"]:
        lines += [f"{one['label']}: {line}" for line in told(one.get("verdicts"))]
        lines += [f"note: {one['label']}: {sentence}" for sentence in one["statements"]]
    for quantity, name in (
        ("temperature_K", "temperature [K]"),
        ("absolute_humidity_g_m3", "absolute humidity [g/m³]"),
    ):
        for period in ALL_PERIODS:
            rows = [(one["label"], one["scores"][period].get(quantity)) for one in found["columns"]]
            rows = [(label, row) for label, row in rows if row and row["total"]["rmse"] is not None]
            if not rows:
                continue
            lines.append(f"RMSE of the {name}, {period}")
            lines.append(
                f"{'':{width}}" + "".join(f"{regime:>13}" for regime in REGIMES) + f"{'95 %':>17}{'n':>9}"
            )
            for label, row in rows:
                cells = "".join(f"{_plain(row[regime]['rmse']):>13}" for regime in REGIMES)
                total = row["total"]
                lines.append(f"{label[: width - 2]:{width}}{cells}{_span(total):>17}{total['n']:>9}")
                for rule, said in total["rules"].items():
                    skill = NONE if said["skill"] is None else f"{100 * said['skill']:.0f} %"
                    ends = (f"{100 * said[end]:.0f}" for end in ("lower", "upper"))
                    bounds = "" if said["lower"] is None else f" ({' … '.join(ends)})"
                    lines.append(f"  against {RULES.get(rule, rule)}: skill {skill}{bounds}")
            for one in found["differences"]:
                row = one["scores"][period].get(quantity, {}).get("total")
                if row and row["value"] is not None:
                    words = f"{one['of']} − {one['less']}"
                    words += "" if one["same_readings"][quantity] else " (other readings)"
                    bounds = "too few blocks for bounds"
                    if row["lower"] is not None:
                        bounds = f"95 % {row['lower']:+.3f} … {row['upper']:+.3f}"
                    lines.append(f"  {words}: {row['value']:+.3f} ({bounds}; n {row['n']})")
            lines.append("")
    return "\n".join(lines).rstrip()


def _plain(value: float | None) -> str:
    return NONE if value is None else f"{value:.2f}"


def _span(row: Mapping) -> str:
    return "" if row["lower"] is None else f"{row['lower']:.2f} … {row['upper']:.2f}"
