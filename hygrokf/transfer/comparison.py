"""Cases, models or ambient sources side by side: the paper's Table III with bounds, differences, and the
skill against rules that need no model.

A column is the free run of one fit on one record.  The errors of two columns are compared on the instants
that both score, with the same blocks drawn for both: errors that the weather causes in both cancel.  Columns
without common instants (other years, other clocks) are not compared instant by instant.

Periods: `identification`, `validation` (by the record's own `until`) and `whole`, as in the paper's Table
III.
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
"""Readings of one instant that differ by less [K], [g/m³] are the same reading."""
UNSCORED = TransferCode.NOTHING_TO_SCORE()
COMPARED_UNITS = {"temperature_K": "K", "absolute_humidity_g_m3": "g/m3"}


# --- what a comparison finds -----------------------------------------------------------------


@dataclass(frozen=True)
class ErrorRow:
    """A number of a comparison in one period, quantity and regime: a row of compare.csv.

    `kind`: "rmse" of a `column` [K], [g/m³]; "rule": that of the rule without a model which `against` names;
    "skill" [1]: 1 − MSE/MSE of that rule; "difference": RMSE of `column` minus RMSE of the column `against`.
    `n` readings, those that both score.  `lower`, `upper`: 95 % bounds, NaN where there are too few readings.
    `same_readings`: whether both columns of a difference are scored on the same ones.
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
    """What is compared: a `fit` on a `case`.

    `identified_here` whether the fit was identified on this record; `weeks` by quantity: middle [s since
    1970] and RMSE of each week; `verdicts` on the fit's time constants.
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
    """The content of compare.json.  `provenance`: the least measured one of all records."""

    version: Version
    created: Instant
    provenance: Provenance
    columns: tuple[ComparedColumn, ...]
    rows: tuple[ErrorRow, ...]

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """The columns that have common instants."""
        return list(dict.fromkeys((r.column, r.against) for r in self.rows if r.kind == "difference"))

    def row(
        self,
        kind: Literal["rmse", "rule", "skill", "difference"],
        column: str,
        period: str,
        quantity: str,
        regime: str = "total",
        against: str = "",
    ) -> ErrorRow:
        """One number; NaN where it is not known."""
        row = self._by_place.get((kind, column, against, quantity, period, regime))
        return row or ErrorRow(kind, column, against, quantity, period, regime)

    @cached_property
    def _by_place(self) -> dict[tuple[str, ...], ErrorRow]:
        return {(r.kind, r.column, r.against, r.quantity, r.period, r.regime): r for r in self.rows}

    def errors(self, period: str, quantity: str) -> dict[str, ErrorRow]:
        """The errors of all scored instants of a period, by label; without columns that have none."""
        wanted = ("rmse", quantity, period, "total")
        return {r.column: r for r in self.rows if (r.kind, r.quantity, r.period, r.regime) == wanted}

    def to_frame(self) -> pandas.DataFrame:
        """Every number of the comparison in one row, as in compare.csv."""
        import pandas as pd

        fits = {column.label: (column.fit, column.case) for column in self.columns}
        rows = [
            (
                r.kind, r.column, r.against, *(("", "") if r.kind == "difference" else fits[r.column]),
                r.quantity, "1" if r.kind == "skill" else COMPARED_UNITS[r.quantity], r.period, r.regime, r.n,
                r.value, r.lower, r.upper,
            )
            for r in self.rows
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
    """The free run of a fit on a record: `errors` (T,) by quantity, NaN where nothing is scored.

    `names` what was combined; `course` its readings and simulation; `rules` errors of the rules without a
    model, by quantity and rule; `masks` (T,) by period.
    """

    names: ComparedColumn
    course: RecordCourse
    errors: Mapping[str, np.ndarray]
    rules: Mapping[str, Mapping[str, np.ndarray]]
    masks: Mapping[str, np.ndarray]
    provenance: Provenance

    @property
    def label(self) -> str:
        return self.names.label

    def scored_at(self, quantity: str, period: str, regime: str) -> np.ndarray:
        """(T,) True at the scored instants of a period and a regime."""
        chosen = self.masks[period] & np.isfinite(self.errors[quantity])
        return chosen if regime == "total" else chosen & (self.course.operating == (regime == "operation"))


def comparison_column(fit: Fit, record: Record, label: str, own: bool = False) -> ComparisonColumn:
    """One column of a comparison: the free run of a fit on a record.

    fit, record: whose free run is compared, and on what; readings in SI units.
    label: of the column.
    own: whether the fit was identified on this record.

    Returns readings, predictions and regimes (T,) for `compare`.
    Raises KeyError where the record lacks an input that the model reads.
    """
    _, run, prediction = simulate_fit(fit, record)
    course = RecordCourse.of(run, {"simulated": prediction})
    guessed = guesses(run)
    errors, rules = {}, {}
    for quantity, simulated in course.simulated["simulated"].items():
        reading = np.where(run.scored, course.measured[quantity], np.nan)
        if np.isfinite(reading).any():
            errors[quantity] = reading - simulated
            rules[quantity] = {
                name: reading - guess[quantity] for name, guess in guessed.items() if quantity in guess
            }
    masks = {**period_masks(run), "whole": np.ones(len(run.timeline), bool)}
    statements = (*mismatches(fit, record), *(() if errors else (UNSCORED,)))
    weeks = {quantity: rmse_by_week(course, error) for quantity, error in errors.items()}
    names = ComparedColumn(label, fit.name, record.name, own, statements, weeks, inherited(fit.results))
    provenance = least_measured((fit.results.provenance, record.provenance))
    return ComparisonColumn(names, course, errors, rules, masks, provenance)


def compare(columns: Sequence[ComparisonColumn]) -> ComparisonResults:
    """Compare columns: errors with bounds, differences between any two, skill against rules without a model.

    columns: of `comparison_column`, with different labels.

    Returns the content of compare.json: RMSE [K], [g/m³] by period, quantity and regime.
    Raises ValueError for columns of the same label, and where no column has anything to score.
    """
    labels = [column.label for column in columns]
    twice = sorted({label for label in labels if labels.count(label) > 1})
    if twice:
        raise ValueError(f"expected columns of different names, found several called {', '.join(twice)}")
    if not any(column.errors for column in columns):
        raise ValueError(f"no column can be scored: {UNSCORED}")
    return ComparisonResults(
        __version__,
        datetime.now(UTC).isoformat(timespec="seconds"),
        least_measured(column.provenance for column in columns),
        tuple(column.names for column in columns),
        (
            *(row for column in columns for row in _scores(column)),
            *(row for a, b in combinations(columns, 2) for row in _differences(a, b)),
        ),
    )


def _scores(one: ComparisonColumn) -> Iterator[ErrorRow]:
    """The errors of a column; those of the rules beside them on the same instants."""
    time = one.course.time_s
    for period, quantity, regime in product(ALL_PERIODS, one.errors, REGIMES):
        chosen, place = one.scored_at(quantity, period, regime), (quantity, period, regime)
        error = np.where(chosen, one.errors[quantity], np.nan)
        drawn = resampled(time, error[:, None])
        if drawn is None:
            continue
        ends = drawn.bounds(0) or ()
        yield ErrorRow("rmse", one.label, "", *place, int(chosen.sum()), float(drawn.value[0]), *ends)
        for name, rule in one.rules[quantity].items():
            both = resampled(time, np.column_stack([error, rule]))
            if both is not None:
                mine, other = map(float, both.value)
                alone = (1.0 - (mine / other) ** 2 if other > 0 else math.nan,)
                yield ErrorRow("rule", one.label, name, *place, both.n, other)
                yield ErrorRow("skill", one.label, name, *place, both.n, *(both.skill(0, 1) or alone))


def _differences(a: ComparisonColumn, b: ComparisonColumn) -> Iterator[ErrorRow]:
    common, i, j = np.intersect1d(a.course.time_s, b.course.time_s, assume_unique=True, return_indices=True)
    shared = [quantity for quantity in a.errors if quantity in b.errors]
    for period, quantity, regime in product(ALL_PERIODS, shared, REGIMES):
        pair = np.column_stack([a.errors[quantity][i], b.errors[quantity][j]])
        there = np.isfinite(pair).all(axis=1)
        chosen = a.scored_at(quantity, period, regime)[i] & b.scored_at(quantity, period, regime)[j]
        drawn = resampled(common, np.where(chosen[:, None], pair, np.nan))
        if drawn is not None:
            apart = np.abs(a.course.measured[quantity][i] - b.course.measured[quantity][j])[there]
            ends = drawn.difference(0, 1) or (float(drawn.value[0] - drawn.value[1]), math.nan, math.nan)
            same = bool(apart.max() <= SAME_READING)
            yield ErrorRow(
                "difference", a.label, b.label, quantity, period, regime, drawn.n, *ends, same_readings=same
            )


def rmse_by_week(course: RecordCourse, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middle [s] and root mean square of an error (T,) in every week with at least a day of scored
    readings."""
    there, time = np.isfinite(error), course.time_s
    week = np.floor(time / WEEK_S).astype(int)
    middles, values = [], []
    for number in np.unique(week[there]):
        part = there & (week == number)
        if np.ptp(time[part]) >= DAY_S:
            middles.append((number + 0.5) * WEEK_S)
            values.append(rmse(error[part], course.operating[part]).total)
    return np.array(middles), np.array(values, dtype=float)
