"""Compare cases, models or ambient sources: errors with bounds (Table III of the paper), differences, and the
skill against rules that need no model.

A column is the free run of one fit on one record. Two columns are compared at the instants that both score,
with the same blocks drawn for both, so that errors which the weather causes in both cancel. Columns without
common instants (other years, other clocks) are not compared instant by instant.

Periods: `identification`, `validation` (by the record's own `until`), and `whole` as in Table III of the
paper.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cached_property
from itertools import combinations, product
from typing import TYPE_CHECKING, Literal

import numpy as np

from hygrokf.data.record import Provenance, Record, least_measured
from hygrokf.data.timestamps import DAY_S, WEEK_S
from hygrokf.evaluation.bootstrap import resampled
from hygrokf.evaluation.scoring import REGIMES, SCORED_PERIODS, guesses, period_masks, rmse
from hygrokf.identification.fit import Fit
from hygrokf.identification.fit_on_record import mismatches, simulate_fit
from hygrokf.identification.verdict import inherited
from hygrokf.identification.verdict_terms import Inherited
from hygrokf.texts.statement import Statement
from hygrokf.texts.terms import Instant, Name, Version
from hygrokf.texts.transfer_codes import TransferCode
from hygrokf.transfer.transfer_results import RecordCourse
from hygrokf.version import __version__

if TYPE_CHECKING:
    import pandas

ALL_PERIODS = (*SCORED_PERIODS, "whole")
SAME_READING = 1e-6
"""[K], [g/m³] two readings at one instant that differ by less are the same reading."""
UNSCORED = TransferCode.NOTHING_TO_SCORE()
COMPARED_UNITS = {"temperature_K": "K", "absolute_humidity_g_m3": "g/m3"}


# --- what a comparison finds -----------------------------------------------------------------


@dataclass(frozen=True)
class ErrorRow:
    """A number of a comparison for one period, quantity and regime: a row of compare.csv.

    `kind`: "rmse": error of `column` [K], [g/m³]; "rule": error of the rule `against`, which needs no model;
    "skill" [1]: 1 − MSE/MSE of that rule; "difference": RMSE of `column` minus RMSE of the column `against`.
    `n`: number of readings that both score. `lower`, `upper`: 95 % bounds, NaN for too few readings.
    `same_readings`: whether both columns of a difference have the same readings.
    """

    kind: Literal["rmse", "rule", "skill", "difference"]
    column: Name
    against: Name
    quantity: Name
    period: Name
    regime: Name
    n: int = 0
    value: float = math.nan
    lower: float = math.nan
    upper: float = math.nan
    same_readings: bool = True

    @property
    def sure(self) -> bool:
        """Whether the bounds exclude zero."""
        return self.lower > 0.0 or self.upper < 0.0


@dataclass(frozen=True)
class ComparedColumn:
    """A column of a comparison: a `fit` on a `case`.

    `identified_here`: whether the fit was identified on this record; `weeks`: by quantity, the middle [s
    since 1970] and the RMSE of each week; `verdicts` on the fit's time constants.
    """

    label: Name
    fit: Name
    case: Name
    identified_here: bool
    statements: tuple[Statement, ...]
    weeks: Mapping[Name, tuple[np.ndarray, np.ndarray]]
    verdicts: Mapping[Name, Inherited] = field(default_factory=dict)


@dataclass(frozen=True)
class ComparisonResults:
    """The content of compare.json; `provenance`: the least measured one of all records."""

    version: Version
    created: Instant
    provenance: Provenance
    columns: tuple[ComparedColumn, ...]
    rows: tuple[ErrorRow, ...]

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """The pairs of columns that have common instants."""
        return list(dict.fromkeys((row.column, row.against) for row in self.rows if row.kind == "difference"))

    def row(
        self,
        kind: Literal["rmse", "rule", "skill", "difference"],
        column: str,
        period: str,
        quantity: str,
        regime: str = "total",
        against: str = "",
    ) -> ErrorRow:
        """Return one number; NaN if it is not known."""
        row = self._by_place.get((kind, column, against, quantity, period, regime))
        return row or ErrorRow(kind, column, against, quantity, period, regime)

    @cached_property
    def _by_place(self) -> dict[tuple[str, ...], ErrorRow]:
        """The rows by kind, column, reference, quantity, period and regime."""
        return {(r.kind, r.column, r.against, r.quantity, r.period, r.regime): r for r in self.rows}

    def errors(self, period: str, quantity: str) -> dict[str, ErrorRow]:
        """Return the total errors of a period by label; columns without scores are left out."""
        key = ("rmse", quantity, period, "total")
        return {r.column: r for r in self.rows if (r.kind, r.quantity, r.period, r.regime) == key}

    def to_frame(self) -> pandas.DataFrame:
        """Return every number of the comparison in one row, as in compare.csv."""
        import pandas as pd

        fits = {column.label: (column.fit, column.case) for column in self.columns}
        rows = [
            (
                row.kind, row.column, row.against,
                *(("", "") if row.kind == "difference" else fits[row.column]),
                row.quantity, "1" if row.kind == "skill" else COMPARED_UNITS[row.quantity],
                row.period, row.regime, row.n, row.value, row.lower, row.upper
            )
            for row in self.rows
        ]  # fmt: skip
        return pd.DataFrame(rows, columns=list(TABLE_HEAD))


TABLE_HEAD = (
    "kind", "column", "against", "fit", "case", "quantity", "unit", "period", "regime", "n", "value", "lower",
    "upper",
)  # fmt: skip
"""Columns of compare.csv."""


# --- comparing -------------------------------------------------------------------------------


@dataclass(frozen=True)
class ComparisonColumn:
    """The free run of a fit on a record: `errors` (T,) by quantity, NaN at instants that are not scored.

    `names`: fit, case and label; `course`: readings and simulation; `rules`: errors (T,) of the rules without
    a model, by quantity and rule; `masks` (T,) by period.
    """

    names: ComparedColumn
    course: RecordCourse
    errors: Mapping[str, np.ndarray]
    rules: Mapping[str, Mapping[str, np.ndarray]]
    masks: Mapping[str, np.ndarray]
    provenance: Provenance

    @property
    def label(self) -> str:
        """The label of the column."""
        return self.names.label

    def scored_at(self, quantity: str, period: str, regime: str) -> np.ndarray:
        """Return whether each instant (T,) is scored and belongs to a period and a regime."""
        chosen = self.masks[period] & np.isfinite(self.errors[quantity])
        return chosen if regime == "total" else chosen & (self.course.operating == (regime == "operation"))


def comparison_column(fit: Fit, record: Record, label: str, own: bool = False) -> ComparisonColumn:
    """Return a column of a comparison: the free run of a fit on a record.

    fit: whose free run is compared. record: on which it is run, in SI units.
    label: of the column. own: whether the fit was identified on this record.

    Returns readings, predictions and regimes (T,) for `compare`. Raises KeyError if the record lacks an input
    of the model.
    """
    _, run, prediction = simulate_fit(fit, record)
    course = RecordCourse.of(run, {"simulated": prediction})
    predictions_of_rules = guesses(run)
    errors, rules = {}, {}
    for quantity, simulated in course.simulated["simulated"].items():
        reading = np.where(run.scored, course.measured[quantity], np.nan)
        if np.isfinite(reading).any():
            errors[quantity] = reading - simulated
            rules[quantity] = {
                name: reading - prediction_of_rule[quantity]
                for name, prediction_of_rule in predictions_of_rules.items()
                if quantity in prediction_of_rule
            }
    masks = {**period_masks(run), "whole": np.ones(len(run.timeline), bool)}
    statements = (*mismatches(fit, record), *(() if errors else (UNSCORED,)))
    weeks = {quantity: rmse_by_week(course, error) for quantity, error in errors.items()}
    names = ComparedColumn(label, fit.name, record.name, own, statements, weeks, inherited(fit.results))
    provenance = least_measured((fit.results.provenance, record.provenance))
    return ComparisonColumn(names, course, errors, rules, masks, provenance)


def compare(columns: Sequence[ComparisonColumn]) -> ComparisonResults:
    """Compare columns: their errors with bounds, the differences between any two, and the skill against rules
    without a model.

    columns: of `comparison_column`, with different labels.

    Returns the content of compare.json: RMSE [K], [g/m³] by period, quantity and regime. Raises ValueError if
    labels are equal, or if no column has anything to score.
    """
    labels = [column.label for column in columns]
    repeated = sorted({label for label in labels if labels.count(label) > 1})
    if repeated:
        raise ValueError(f"expected columns of different names, found several called {', '.join(repeated)}")
    if not any(column.errors for column in columns):
        raise ValueError(f"no column can be scored: {UNSCORED}")
    return ComparisonResults(
        __version__,
        datetime.now(UTC).isoformat(timespec="seconds"),
        least_measured(column.provenance for column in columns),
        tuple(column.names for column in columns),
        (
            *(row for column in columns for row in _scores(column)),
            *(row for first, second in combinations(columns, 2) for row in _differences(first, second)),
        ),
    )


def _scores(column: ComparisonColumn) -> Iterator[ErrorRow]:
    """The errors of a column, and on the same instants the errors of the rules and the skill against them."""
    time = column.course.time_s
    for period, quantity, regime in product(ALL_PERIODS, column.errors, REGIMES):
        chosen, key = column.scored_at(quantity, period, regime), (quantity, period, regime)
        error = np.where(chosen, column.errors[quantity], np.nan)
        bootstrap = resampled(time, error[:, None])
        if bootstrap is None:
            continue
        bounds = bootstrap.bounds(0) or ()
        yield ErrorRow("rmse", column.label, "", *key, int(chosen.sum()), float(bootstrap.value[0]), *bounds)
        for name, rule_errors in column.rules[quantity].items():
            pair = resampled(time, np.column_stack([error, rule_errors]))
            if pair is not None:
                model_error, rule_error = map(float, pair.value)
                without_bounds = (1.0 - (model_error / rule_error) ** 2 if rule_error > 0 else math.nan,)
                skill = pair.skill(0, 1) or without_bounds
                yield ErrorRow("rule", column.label, name, *key, pair.n, rule_error)
                yield ErrorRow("skill", column.label, name, *key, pair.n, *skill)


def _differences(first: ComparisonColumn, second: ComparisonColumn) -> Iterator[ErrorRow]:
    """Yield the differences of the errors of two columns at their common instants."""
    common, in_first, in_second = np.intersect1d(
        first.course.time_s, second.course.time_s, assume_unique=True, return_indices=True
    )
    shared = [quantity for quantity in first.errors if quantity in second.errors]
    for period, quantity, regime in product(ALL_PERIODS, shared, REGIMES):
        errors = np.column_stack([first.errors[quantity][in_first], second.errors[quantity][in_second]])
        both_known = np.isfinite(errors).all(axis=1)
        scored_by_first = first.scored_at(quantity, period, regime)[in_first]
        chosen = scored_by_first & second.scored_at(quantity, period, regime)[in_second]
        bootstrap = resampled(common, np.where(chosen[:, None], errors, np.nan))
        if bootstrap is None:
            continue
        readings = first.course.measured[quantity][in_first], second.course.measured[quantity][in_second]
        is_same = bool(np.abs(readings[0] - readings[1])[both_known].max() <= SAME_READING)
        without_bounds = (float(bootstrap.value[0] - bootstrap.value[1]), math.nan, math.nan)
        numbers = (bootstrap.n, *(bootstrap.difference(0, 1) or without_bounds))
        key = (first.label, second.label, quantity, period, regime)
        yield ErrorRow("difference", *key, *numbers, same_readings=is_same)


def rmse_by_week(course: RecordCourse, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the middle [s] and the root mean square of an error (T,) for every week with at least a day of
    scored readings."""
    is_scored, time = np.isfinite(error), course.time_s
    week_of_instant = np.floor(time / WEEK_S).astype(int)
    middles, values = [], []
    for week_number in np.unique(week_of_instant[is_scored]):
        in_week = is_scored & (week_of_instant == week_number)
        if np.ptp(time[in_week]) >= DAY_S:
            middles.append((week_number + 0.5) * WEEK_S)
            values.append(rmse(error[in_week], course.operating[in_week]).total)
    return np.array(middles), np.array(values, dtype=float)
