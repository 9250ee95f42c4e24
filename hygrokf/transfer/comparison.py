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
from itertools import combinations
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from hygrokf.data.record import Record
from hygrokf.data.structured import optional
from hygrokf.data.timestamps import DAY_S, WEEK_S
from hygrokf.evaluation.bootstrap import resampled
from hygrokf.evaluation.scoring import PERIODS, REGIMES, guesses, period_masks, rmse
from hygrokf.identification.fit import Fit
from hygrokf.identification.fit_on_record import mismatches, simulate_fit
from hygrokf.identification.verdict import inherited
from hygrokf.identification.verdict_terms import Inherited
from hygrokf.transfer.results import RecordCourse
from hygrokf.version import __version__

if TYPE_CHECKING:
    import pandas

ALL_PERIODS = (*PERIODS, "whole")
SAME = 1e-6
"""Readings of one instant that differ by less [K], [g/m³] are the same reading."""
UNSCORED = (
    "nothing to score: no temperature or absolute humidity of the cabinet at a time when all inputs are "
    "known (a fit that knows the power needs the power); see `hygrokf check`"
)
UNITS = {"temperature_K": "K", "absolute_humidity_g_m3": "g/m3"}
T = TypeVar("T")
ByRegime = Mapping[str, Mapping[str, Mapping[str, T]]]
"""By period, quantity and regime."""


# --- what a comparison finds -----------------------------------------------------------------


@dataclass(frozen=True)
class RuleScore:
    """A rule without a model, on the instants that it and the model score.

    `n` readings; `rmse` [K], [g/m³] of the rule; `skill` [1] 1 − MSE/MSE of the rule, with 95 % bounds.
    """

    n: int
    rmse: float
    skill: float = math.nan
    lower: float = math.nan
    upper: float = math.nan


@dataclass(frozen=True)
class Score:
    """Root mean squared error [K], [g/m³] of `n` readings with 95 % bounds (NaN where there are too few).

    `rules` by name; `blocks` the effective number of bootstrap blocks, where anything was scored.
    """

    n: int
    rmse: float = math.nan
    lower: float = math.nan
    upper: float = math.nan
    rules: Mapping[str, RuleScore] = field(default_factory=dict)
    blocks: float | None = optional()


@dataclass(frozen=True)
class ErrorDifference:
    """RMSE of one column less that of another [K], [g/m³] on `n` common readings, with 95 % bounds."""

    n: int
    value: float = math.nan
    lower: float = math.nan
    upper: float = math.nan

    @property
    def sure(self) -> bool:
        """Whether the bounds exclude zero."""
        return self.lower > 0.0 or self.upper < 0.0


@dataclass(frozen=True)
class ColumnScores:
    """The errors of one column.

    `fit`, `case` what was combined; `identified_here` whether the fit was identified on this record;
    `verdicts` on the fit's time constants; `weeks` by quantity: middle [s since 1970] and RMSE of each week.
    """

    label: str
    fit: str
    case: str
    identified_here: bool
    statements: tuple[str, ...]
    scores: ByRegime[Score]
    weeks: Mapping[str, tuple[np.ndarray, np.ndarray]]
    verdicts: Mapping[str, Inherited] = field(default_factory=dict)

    def total(self, period: str, quantity: str) -> Score | None:
        """The error of all scored instants of a period; None where nothing is scored."""
        found = self.scores.get(period, {}).get(quantity, {}).get("total")
        return found if found is not None and math.isfinite(found.rmse) else None


@dataclass(frozen=True)
class PairDifference:
    """Errors of the column `of` less those of the column `less`, on their common instants.

    `same_readings` by quantity: whether both are scored on the same readings.
    """

    of: str
    less: str
    same_readings: Mapping[str, bool]
    scores: ByRegime[ErrorDifference]

    def total(self, period: str, quantity: str) -> ErrorDifference | None:
        """The difference over a period; None without common instants."""
        found = self.scores.get(period, {}).get(quantity, {}).get("total")
        return found if found is not None and math.isfinite(found.value) else None


@dataclass(frozen=True)
class ComparisonResults:
    """The content of compare.json.  `synthetic`: whether any record was made by a computer."""

    version: str
    created: str
    synthetic: bool
    columns: tuple[ColumnScores, ...]
    differences: tuple[PairDifference, ...]

    def rows(self) -> Iterator[tuple[str | int | float, ...]]:
        """Every number, with the cells of `TABLE_HEAD`; NaN where there are no bounds.

        `kind`: rmse (value RMSE), rule (RMSE of a rule without a model, named in `against`), skill (1 −
        MSE/MSE of that rule), difference (RMSE of `column` less that of `against` on common instants).
        """
        none = (math.nan, math.nan)
        for one in self.columns:
            names = (one.fit, one.case)
            for (period, quantity, regime), row in cells(one.scores):
                if not math.isfinite(row.rmse):
                    continue
                place = (quantity, UNITS[quantity], period, regime)
                yield "rmse", one.label, "", *names, *place, row.n, row.rmse, row.lower, row.upper
                for rule, score in row.rules.items():
                    yield "rule", one.label, rule, *names, *place, score.n, score.rmse, *none
                    ends = (score.n, score.skill, score.lower, score.upper)
                    yield "skill", one.label, rule, *names, quantity, "1", period, regime, *ends
        for pair in self.differences:
            for (period, quantity, regime), apart in cells(pair.scores):
                if math.isfinite(apart.value):
                    place = (quantity, UNITS[quantity], period, regime)
                    ends = (apart.n, apart.value, apart.lower, apart.upper)
                    yield "difference", pair.of, pair.less, "", "", *place, *ends

    def to_frame(self) -> pandas.DataFrame:
        """Every number of the comparison in one row, as in compare.csv."""
        import pandas as pd

        return pd.DataFrame(list(self.rows()), columns=list(TABLE_HEAD))


TABLE_HEAD = (
    "kind", "column", "against", "fit", "case", "quantity", "unit", "period", "regime", "n", "value", "lower",
    "upper",
)  # fmt: skip
"""Columns of compare.csv."""


def cells(scores: ByRegime[T]) -> Iterator[tuple[tuple[str, str, str], T]]:
    """(period, quantity, regime) and the score of each cell."""
    for period, by_quantity in scores.items():
        for quantity, by_regime in by_quantity.items():
            for regime, row in by_regime.items():
                yield (period, quantity, regime), row


# --- comparing -------------------------------------------------------------------------------


@dataclass(frozen=True)
class ComparisonColumn:
    """The free run of a fit on a record: `errors` (T,) by quantity, NaN where nothing is scored.

    `label` short name; `fit`, `case` what was combined; `own` whether the fit was identified on this record;
    `course` its readings and simulation; `rules` errors of the rules without a model, by quantity and rule;
    `masks` (T,) by period; `verdicts` on the fit's time constants.
    """

    label: str
    fit: str
    case: str
    own: bool
    course: RecordCourse
    errors: Mapping[str, np.ndarray]
    rules: Mapping[str, Mapping[str, np.ndarray]]
    masks: Mapping[str, np.ndarray]
    statements: tuple[str, ...]
    synthetic: bool
    verdicts: Mapping[str, Inherited] = field(default_factory=dict)

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
    course = RecordCourse.of(run, record.until_s, {"simulated": prediction})
    guessed = guesses(run, record.until_s)
    errors, rules = {}, {}
    for quantity, simulated in course.simulated["simulated"].items():
        reading = np.where(run.scored, course.measured[quantity], np.nan)
        if np.isfinite(reading).any():
            errors[quantity] = reading - simulated
            rules[quantity] = {
                name: reading - guess[quantity] for name, guess in guessed.items() if quantity in guess
            }
    masks = {**period_masks(run, record.until_s), "whole": np.ones(len(run.timeline), bool)}
    return ComparisonColumn(
        label,
        fit.name,
        record.name,
        own,
        course,
        errors,
        rules,
        masks,
        (*mismatches(fit, record), *(() if errors else (UNSCORED,))),
        fit.results.synthetic or "synthetic" in record.name.lower(),
        inherited(fit.results),
    )


@dataclass(frozen=True)
class Comparison:
    """Free runs side by side: `results` (compare.json), and `columns` with the courses for pictures."""

    columns: tuple[ComparisonColumn, ...]
    results: ComparisonResults


def compare(columns: Sequence[ComparisonColumn]) -> Comparison:
    """Compare columns: errors with bounds, differences between any two, skill against rules without a model.

    columns: of `comparison_column`, with different labels.

    Returns `results` as in compare.json: RMSE [K], [g/m³] by period, quantity and regime.
    Raises ValueError for columns of the same label, and where no column has anything to score.
    """
    labels = [one.label for one in columns]
    twice = sorted({label for label in labels if labels.count(label) > 1})
    if twice:
        raise ValueError(f"expected columns of different names, found several called {', '.join(twice)}")
    if not any(one.errors for one in columns):
        raise ValueError(f"no column can be scored: {UNSCORED}")
    results = ComparisonResults(
        __version__,
        datetime.now(UTC).isoformat(timespec="seconds"),
        any(one.synthetic for one in columns),
        tuple(_column_scores(one) for one in columns),
        tuple(_difference(a, b) for a, b in combinations(columns, 2)),
    )
    return Comparison(tuple(columns), results)


def _column_scores(one: ComparisonColumn) -> ColumnScores:
    scores = {
        period: {
            quantity: {
                regime: _scored(one, quantity, one.scored_at(quantity, period, regime)) for regime in REGIMES
            }
            for quantity in one.errors
        }
        for period in ALL_PERIODS
    }
    weeks = {quantity: rmse_by_week(one, quantity) for quantity in one.errors}
    return ColumnScores(
        one.label, one.fit, one.case, one.own, one.statements, scores, weeks, dict(one.verdicts)
    )


def _scored(one: ComparisonColumn, quantity: str, chosen: np.ndarray) -> Score:
    """The error on the chosen instants (T,); the rules' errors beside it on the same instants."""
    time, error = one.course.time_s, np.where(chosen, one.errors[quantity], np.nan)
    drawn = resampled(time, error[:, None])
    if drawn is None:
        return Score(int(chosen.sum()))
    rules = {}
    for name, rule in one.rules[quantity].items():
        both = resampled(time, np.column_stack([error, rule]))
        if both is not None:
            alone = 1.0 - (both.value[0] / both.value[1]) ** 2 if both.value[1] > 0 else math.nan
            skill = both.skill(0, 1) or (float(alone), math.nan, math.nan)
            rules[name] = RuleScore(both.n, float(both.value[1]), *skill)
    ends = drawn.bounds(0) or (math.nan, math.nan)
    return Score(int(chosen.sum()), float(drawn.value[0]), *ends, rules, drawn.blocks)


def _difference(a: ComparisonColumn, b: ComparisonColumn) -> PairDifference:
    common, i, j = np.intersect1d(a.course.time_s, b.course.time_s, assume_unique=True, return_indices=True)
    same: dict[str, bool] = {}
    pairs: dict[str, np.ndarray] = {}
    for quantity in (q for q in a.errors if q in b.errors):
        pair = np.column_stack([a.errors[quantity][i], b.errors[quantity][j]])
        there = np.isfinite(pair).all(axis=1)
        if there.any():
            apart = np.abs(a.course.measured[quantity][i] - b.course.measured[quantity][j])[there]
            same[quantity], pairs[quantity] = bool(apart.max() <= SAME), pair

    def apart_in(period: str, quantity: str, regime: str) -> ErrorDifference:
        chosen = a.scored_at(quantity, period, regime)[i] & b.scored_at(quantity, period, regime)[j]
        drawn = resampled(common, np.where(chosen[:, None], pairs[quantity], np.nan))
        if drawn is None:
            return ErrorDifference(0)
        alone = (float(drawn.value[0] - drawn.value[1]), math.nan, math.nan)
        return ErrorDifference(drawn.n, *(drawn.difference(0, 1) or alone))

    scores = {
        period: {q: {regime: apart_in(period, q, regime) for regime in REGIMES} for q in pairs}
        for period in ALL_PERIODS
    }
    return PairDifference(a.label, b.label, same, scores)


def rmse_by_week(one: ComparisonColumn, quantity: str) -> tuple[np.ndarray, np.ndarray]:
    """Middle [s] and root mean squared error of every week with at least a day of scored readings."""
    error, time = one.errors[quantity], one.course.time_s
    there = np.isfinite(error)
    week = np.floor(time / WEEK_S).astype(int)
    middles, values = [], []
    for number in np.unique(week[there]):
        part = there & (week == number)
        if np.ptp(time[part]) >= DAY_S:
            middles.append((number + 0.5) * WEEK_S)
            values.append(rmse(error[part], one.course.operating[part]).total)
    return np.array(middles), np.array(values, dtype=float)
