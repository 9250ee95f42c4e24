"""The years of one ensemble, reduced one after the other to numbers, curves, days and hours beyond limits.

Shapes: N members, T instants, I temperature bins, J humidity bins.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

from hygrokf.climate.bounds import Bounded, bounded, bounded_array, rounded
from hygrokf.climate.chamber import Acceleration, ProfilePlan
from hygrokf.climate.chamber_profile import ChamberProfile, build_profile
from hygrokf.climate.ensemble import WHOLE, YEAR_H, Year
from hygrokf.climate.limits import Limit, exceeded
from hygrokf.climate.representative_days import Days, days_of, joined, thinned
from hygrokf.climate.statistics import CYCLE_RANGES_K, SCOPES, courses, outside, rates, scalars
from hygrokf.climate.study import DurationCurve, JointDistribution

DAYS_OF = 8
"""Members of each year whose days a test profile may choose from."""
SHARES = (0.0, 0.001, 0.01, 0.02, 0.05, *np.arange(0.1, 0.91, 0.05).round(2), 0.95, 0.98, 0.99, 0.999, 1.0)
"""Shares of the time [1] at which a duration curve is given."""
RATES = {"temperature_degC": "temperature", "relative_humidity_percent": "relative_humidity"}
"""Quantities whose rates of change have a duration curve, with their keys in climate.json."""
TEMPERATURE_EDGES = np.arange(-60.0, 120.1, 2.5)
HUMIDITY_EDGES = np.arange(0.0, 100.1, 5.0)
"""Edges of the joint distribution [°C], [%]; the last bin also counts what is above saturation."""


@dataclass(frozen=True)
class Curves:
    """The curves of one year for every member (N).

    `duration`: by quantity, the values (N, len(SHARES)) that are exceeded for these shares of the time;
    `rates`: the same of absolute rates of change; `joint`: hours a year (N, temperature bins, humidity bins),
    or None without humidity.
    """

    duration: Mapping[str, np.ndarray]
    rates: Mapping[str, np.ndarray]
    joint: np.ndarray | None


def curves(year: Year) -> Curves:
    """Duration curves, rates and the joint distribution of a year."""
    rows = courses(year)
    shares = 1.0 - np.array(SHARES)
    duration = {name: np.quantile(value[:, year.known], shares, axis=1).T for name, value in rows.items()}
    steep = {
        short: np.quantile(rates(rows[name], year), shares, axis=1).T
        for name, short in RATES.items()
        if name in rows
    }
    percent = rows.get("relative_humidity_percent")
    celsius = rows["temperature_degC"][:, year.known]
    return Curves(duration, steep, None if percent is None else _joint_hours(celsius, percent[:, year.known]))


def _joint_hours(celsius: np.ndarray, percent: np.ndarray) -> np.ndarray:
    """Hours a year (N, I, J) of every member in the bins of `TEMPERATURE_EDGES` and `HUMIDITY_EDGES`."""
    rows, columns = len(TEMPERATURE_EDGES) - 1, len(HUMIDITY_EDGES) - 1
    i = np.clip(np.searchsorted(TEMPERATURE_EDGES, celsius, side="right") - 1, 0, rows - 1)
    j = np.clip(np.searchsorted(HUMIDITY_EDGES, percent, side="right") - 1, 0, columns - 1)
    member = np.arange(len(celsius))[:, None]
    flat = ((member * rows + i) * columns + j).ravel()
    counted = np.bincount(flat, minlength=len(celsius) * rows * columns)
    return counted.reshape(-1, rows, columns) * (YEAR_H / celsius.shape[1])


class Span(NamedTuple):
    """A year: first and last instant [s since 1970, UTC], known hours [h], and their share in operation."""

    begin_s: float
    end_s: float
    hours: float
    operating: float


@dataclass
class Gathered:
    """The years of one ensemble, reduced: each list has an entry for each year."""

    scalars: dict[str, list[dict[str, np.ndarray]]] = field(
        default_factory=lambda: {scope: [] for scope in SCOPES}
    )
    curves: list[Curves] = field(default_factory=list)
    limits: dict[str, list[np.ndarray]] = field(default_factory=dict)
    weather: list[dict[str, float]] = field(default_factory=list)
    weather_curves: list[Curves] = field(default_factory=list)
    days: list[Days] = field(default_factory=list)
    spans: list[Span] = field(default_factory=list)

    @property
    def part(self) -> str:
        """The known part of the fullest year, such as "80 days"; "" where it can stand for a year."""
        fullest = max(self.spans, key=lambda span: span.hours)
        if fullest.hours >= WHOLE * YEAR_H:
            return ""
        covered = (fullest.end_s - fullest.begin_s) / 3600.0 + 1.0  # gaps included
        hours = covered if covered < WHOLE * YEAR_H else fullest.hours
        return f"{hours / 24.0:.0f} days" if hours >= 48.0 else f"{hours:.0f} hours"

    def has(self, scope: str) -> bool:
        """Whether any hour of any year belongs to a scope."""
        return any(year["hours"].max() > 0.0 for year in self.scalars[scope])

    def add(self, year: Year, limits: Sequence[Limit], law: Acceleration, members: int) -> None:
        """Reduce one more year of an ensemble of so many members."""
        for scope in SCOPES:  # a year without operation has 0 h of it, and counts among the others
            self.scalars[scope].append(scalars(year, law, scope))
        self.curves.append(curves(year))
        weather = outside(year)
        self.weather.append({name: float(value[0]) for name, value in scalars(weather, law).items()})
        self.weather_curves.append(curves(weather))
        for one in limits:
            found = exceeded(year, one)
            if found is not None:
                self.limits.setdefault(one.name, []).append(found)
        if year.relative_humidity is not None and abs(year.step_h - 1.0) < 1e-6:
            # each year contributes other members, so that the days show the differences between members
            first = len(self.days) * DAYS_OF
            chosen = sorted({(first + i) % members for i in range(min(DAYS_OF, members))})
            self.days.append(thinned(days_of(year, chosen)))
        operating = float(year.operating[year.known].mean())
        self.spans.append(Span(year.time_s[0], year.time_s[-1], year.hours, operating))

    def outside(self) -> dict[str, float]:
        """The numbers of the weather, means over the years."""
        return {name: float(np.mean([rows[name] for rows in self.weather])) for name in self.weather[0]}

    def duration_curves(self, kind: Literal["duration", "rates"]) -> dict[str, DurationCurve]:
        """The curves by quantity, with bounds."""
        found = {}
        weather = [getattr(one, kind) for one in self.weather_curves]
        for name in getattr(self.curves[0], kind):
            made = bounded_array(np.array([getattr(one, kind)[name] for one in self.curves]))
            around = np.mean([one[name][0] for one in weather if name in one], axis=0)
            parts = {part: rounded(value) for part, value in vars(made).items()}
            found[name] = DurationCurve(**parts, share_beyond=np.array(SHARES), outside=rounded(around))
        return found

    def joint(self) -> JointDistribution | None:
        """The joint distribution without its empty rows; None without humidity."""
        if self.curves[0].joint is None:
            return None
        inside = bounded_array(np.array([one.joint for one in self.curves]))
        weather = np.mean([one.joint[0] for one in self.weather_curves if one.joint is not None], axis=0)
        used = np.flatnonzero((inside.value > 0).any(axis=1) | (weather > 0).any(axis=1))
        rows = slice(int(used[0]), int(used[-1]) + 1)
        hours = (inside.value, inside.lower, inside.upper, weather)
        return JointDistribution(
            TEMPERATURE_EDGES[rows.start : rows.stop + 1],
            HUMIDITY_EDGES,
            *(rounded(one[rows], 4) for one in hours),
        )

    def test_profile(self, plan: ProfilePlan) -> ChamberProfile | None:
        """The test profile; None where no whole day with humidity is known hour by hour."""
        days = thinned(joined(self.days)) if self.days else None
        if days is None or not len(days):
            return None
        years = self.scalars["all"]
        names = [f"temperature_cycles_from_{least:g}_K_number" for least in CYCLE_RANGES_K]
        cycles = np.array([np.mean([rows[name].mean() for rows in years]) for name in names])
        return build_profile(days, plan, bounded(np.array([rows["ageing_h"] for rows in years])), cycles)


def is_whole(year: Year) -> bool:
    """Whether enough of a year is known to stand for it."""
    return year.hours >= WHOLE * YEAR_H


def summary(years: Sequence[Mapping[str, np.ndarray]]) -> dict[str, Bounded]:
    """The numbers of all years with their bounds, by name."""
    return {name: bounded(np.array([year[name] for year in years])) for name in years[0]}
