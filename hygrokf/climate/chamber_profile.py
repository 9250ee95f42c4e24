"""The test profile of a chamber: days of the climate, warmed to the ageing of the years of service.

With T* from 1/T* = 1/T − δ the law's rate grows by the same factor exp(E_a δ/k_B) in every hour, and the
humidity stays: every condition keeps its share of the ageing.
(A temperature raised by a fixed number of kelvin would give the cold hours more than their share.)  The
chamber's limits cut this off; δ is found for the sequence after them.

The chosen days together have the joint distribution of temperature and humidity, the distribution of ageing
over it, the wet hours and the daily ranges of the whole ensemble.  Each step adds, and later exchanges, the
day that brings the means of these features closest to their targets in least squares.  (The method of test
reference years, ISO 15927-4, with days in place of months and ageing in place of heating demand.)
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from hygrokf.climate.bounds import BoundedMean, expect_shape
from hygrokf.climate.chamber import BOLTZMANN_EV, Acceleration, Chamber, ProfilePlan
from hygrokf.climate.ensemble import YEAR_H, Year
from hygrokf.climate.statistics import CYCLE_RANGES_K, WET_PERCENT, cycles_from
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K
from hygrokf.texts.climate_codes import ClimateCode
from hygrokf.texts.statement import Statement

DAY_H = 24
MOST_DAYS = 3000
"""Days to choose from, at most."""
T_EDGES, H_EDGES = np.arange(-60.0, 125.0, 5.0), np.arange(0.0, 110.0, 10.0)
"""[°C], [%] bins in which distributions are compared."""
RANGE_EDGES_K = np.array([0.0, 2.5, 5.0, 7.5, 10.0, 15.0, 20.0, 1e3])
WEIGHTS = {"joint": 1.0, "ageing": 1.0, "mean": 3.0, "wet": 2.0, "range": 1.0}
"""Weights of the features' squared errors."""
MOST_EXCHANGES = 12


Days: TypeAlias = np.ndarray
"""Temperatures [°C] and relative humidities [%] (2, D, 24) of days, hour by hour."""


def days_of(year: Year, members: Sequence[int]) -> Days:
    """The days of some members of a year whose hours are all known; none where the year is not hourly."""
    hours = np.round(year.time_s / 3600.0).astype(np.int64)
    begins = np.flatnonzero(hours % DAY_H == hours[0] % DAY_H)
    begins = begins[begins + DAY_H <= len(hours)]
    begins = begins[hours[begins + DAY_H - 1] - hours[begins] == DAY_H - 1]
    places = begins[:, None] + np.arange(DAY_H)
    places = places[year.known[places].all(axis=1)]
    assert year.relative_humidity is not None, "a test profile needs the humidity"
    chosen = np.asarray(members)
    courses = (year.temperature_K[chosen] - ZERO_CELSIUS_K, 100.0 * year.relative_humidity[chosen])
    return np.stack([course[:, places].reshape(-1, DAY_H) for course in courses])


def thinned(days: Days) -> Days:
    """At most `MOST_DAYS` days, evenly from all."""
    count = days.shape[1]
    if count <= MOST_DAYS:
        return days
    return days.take(np.linspace(0, count - 1, MOST_DAYS).round().astype(int), axis=1)


def places_in(celsius: np.ndarray, percent: np.ndarray) -> np.ndarray:
    """Bin of each instant in the flattened joint distribution, any shape."""
    i = np.clip(np.searchsorted(T_EDGES, celsius, side="right") - 1, 0, len(T_EDGES) - 2)
    j = np.clip(np.searchsorted(H_EDGES, percent, side="right") - 1, 0, len(H_EDGES) - 2)
    return i * (len(H_EDGES) - 1) + j


def shares(days: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
    """Shares (B,) of all instants, or of a weight, in the bins of the joint distribution."""
    bins = (len(T_EDGES) - 1) * (len(H_EDGES) - 1)
    weights = None if weight is None else np.ravel(weight)
    counted = np.bincount(places_in(*days).ravel(), weights=weights, minlength=bins).astype(float)
    return counted / counted.sum()


def choose_days(days: Days, count: int, law: Acceleration) -> np.ndarray:
    """Places (count,) of the days that together come closest to all of them; a day is repeated only where
    there are too few."""
    rows, target = _features(days, law)
    count = max(1, count)
    used, most = np.zeros(len(rows), dtype=int), -(-count // len(rows))
    square = np.einsum("df,df->d", rows, rows)
    chosen: list[int] = []
    total = np.zeros(rows.shape[1])

    def best(aim: np.ndarray) -> int:
        cost = square + 2.0 * rows @ (total - aim)
        return int(np.argmin(np.where(used < most, cost, np.inf)))

    for number in range(1, count + 1):
        # at each length the days so far shall be like the whole
        place = best(number * target)
        chosen.append(place)
        used[place] += 1
        total += rows[place]
    for _ in range(MOST_EXCHANGES):
        changed = False
        for slot, old in enumerate(chosen):
            total -= rows[old]
            used[old] -= 1
            new = best(count * target)
            used[new] += 1
            total += rows[new]
            changed |= new != old
            chosen[slot] = new
        if not changed:
            break
    return np.array(chosen)


def _features(days: Days, law: Acceleration) -> tuple[np.ndarray, np.ndarray]:
    """Features (D, F) of every day, and their means (F,), the targets."""
    celsius, percent = days
    bins = (len(T_EDGES) - 1) * (len(H_EDGES) - 1)
    place = places_in(celsius, percent)
    used = np.unique(place)
    column = np.zeros(bins, dtype=int)
    column[used] = np.arange(len(used))
    flat = (np.arange(len(celsius))[:, None] * len(used) + column[place]).ravel()
    rate = _rate(law, celsius, percent)
    rate = rate / rate.mean()
    size = len(celsius) * len(used)
    joint = np.bincount(flat, minlength=size).reshape(len(celsius), -1) / DAY_H
    ageing = np.bincount(flat, weights=rate.ravel(), minlength=size).reshape(len(celsius), -1) / DAY_H
    wet = ((percent > 80.0) & (celsius > 0.0)).mean(axis=1, keepdims=True)
    span = np.ptp(celsius, axis=1)
    ranged = (
        np.searchsorted(RANGE_EDGES_K, span, side="right")[:, None] == np.arange(1, len(RANGE_EDGES_K))
    ).astype(float)
    parts = {
        "joint": joint, "ageing": ageing, "mean": rate.mean(axis=1, keepdims=True), "wet": wet,
        "range": ranged
    }  # fmt: skip
    rows = np.hstack([np.sqrt(WEIGHTS[name]) * part for name, part in parts.items()])
    return rows, rows.mean(axis=0)


def ordered(days: Days) -> np.ndarray:
    """Order (D,) of days in which the end of each is near the beginning of the next: nearest neighbour, then
    moves of single days."""
    first, last = (days[:, :, place].T / (5.0, 10.0) for place in (0, -1))
    jump = np.linalg.norm(last[:, None] - first[None], axis=2)
    order = [int(np.argmin(days[0].mean(axis=1)))]
    left = set(range(days.shape[1])) - set(order)
    while left:
        nearest = min(left, key=lambda d: (jump[order[-1], d], d))
        order.append(nearest)
        left.remove(nearest)

    # then move single days to where they fit better; a piece of several days cannot be turned round
    for _ in range(4):
        moved = False
        for day in list(order):
            at = order.index(day)
            around = order[max(at - 1, 0) : at + 2]
            gain = _length(jump, around) - _length(jump, [d for d in around if d != day])
            rest = order[:at] + order[at + 1 :]
            costs = [
                _length(jump, [rest[place - 1], day, *rest[place : place + 1]])
                - _length(jump, rest[place - 1 : place + 1])
                for place in range(1, len(rest) + 1)
            ]
            place = int(np.argmin(costs)) + 1 if costs else 0
            if costs and at > 0 and costs[place - 1] < gain - 1e-9:
                order = [*rest[:place], day, *rest[place:]]
                moved = True
        if not moved:
            break
    return np.array(order)


def _length(jump: np.ndarray, days: Sequence[int]) -> float:
    return float(sum(jump[a, b] for a, b in itertools.pairwise(days)))


CUT_MOST = 0.5
"""Share of the hours that may stand at the chamber's highest temperature."""


@dataclass(frozen=True)
class Ageing:
    """Ageing [h at the reference condition] of the test and of the years of service, and the years [a] at the
    site that the test stands for, with bounds."""

    test_h: float
    service_h: float
    years: float
    years_lower: float
    years_upper: float


@dataclass(frozen=True)
class Reproduced:
    """A number of the site beside that of the test."""

    name: Statement
    site: float
    test: float


@dataclass(frozen=True)
class Closeness:
    """What a test profile reproduces of the site, and how closely.

    Distances [1] are total variations between distributions: of temperature before warming and humidity, and
    of the ageing over these.
    """

    ageing: Ageing
    joint_distance: float
    ageing_distance: float
    numbers: tuple[Reproduced, ...] = ()


@dataclass(frozen=True, eq=False)
class ChamberProfile:
    """A sequence of a chamber, hour by hour, and what it reproduces of the site.

    Temperature [°C] and relative humidity [%] of the chamber, and of the site in the same hours;
    `acceleration` exp(E_a δ/k_B) [1] before the chamber's limits; `share_at_chamber_limit` [1] of the hours;
    `reached`: whether it ages as much as the years of service.
    """

    temperature_degC: np.ndarray
    relative_humidity_percent: np.ndarray
    site_temperature_degC: np.ndarray
    site_humidity_percent: np.ndarray
    acceleration: float
    share_at_chamber_limit: float
    reached: bool
    closeness: Closeness

    def __post_init__(self) -> None:
        expect_shape(
            self.temperature_degC.shape,
            {name: var for name, var in vars(self).items() if isinstance(var, np.ndarray)},
        )


def build_profile(
    days: Days, plan: ProfilePlan, ageing: BoundedMean, service_cycles: np.ndarray
) -> ChamberProfile:
    """A test profile from all days of a climate, one at least.

    ageing: [h a year at the reference] of the site.  service_cycles: (3,) cycles a year from each of
    `CYCLE_RANGES_K`.
    """
    length, target = round(plan.test.length_h), plan.test.service_years * ageing.value
    chosen = days.take(choose_days(days, -(-length // DAY_H), plan.law), axis=1)
    site = chosen.take(ordered(chosen), axis=1).reshape(2, -1)[:, :length]

    def aged(shift: float) -> float:
        return float(_rate(plan.law, *set_points(site, shift, plan.chamber)).sum())

    low, high = _span(site[0], plan.chamber)
    reached = aged(low) <= target <= aged(high)
    shift = high if target > aged(high) else low
    if reached:
        for _ in range(60):
            shift = 0.5 * (low + high)
            low, high = (shift, high) if aged(shift) < target else (low, shift)
    test = set_points(site, shift, plan.chamber)
    cut = np.isclose(test[0][:, None], plan.chamber.temperature_degC).any(axis=1)
    warm, damp, celsius, percent = (np.round(one, 2) for one in (*test, *site))
    return ChamberProfile(
        warm,
        damp,
        celsius,
        percent,
        acceleration=float(np.exp(plan.law.activation_energy_eV / BOLTZMANN_EV * shift)),
        share_at_chamber_limit=float(cut.mean()),
        reached=reached,
        closeness=closeness(days, site, test, plan, ageing, service_cycles),
    )


def _span(celsius: np.ndarray, chamber: Chamber) -> tuple[float, float]:
    """Shifts between which to look: the hottest half of the hours at the limit, and the coldest half at the
    other one."""
    kelvin = np.sort(celsius) + ZERO_CELSIUS_K
    bottom, top = (one + ZERO_CELSIUS_K for one in chamber.temperature_degC)
    place = int((1.0 - CUT_MOST) * (len(kelvin) - 1))
    return 1.0 / kelvin[place] - 1.0 / max(bottom, 1.0), 1.0 / kelvin[place] - 1.0 / top


def set_points(site: np.ndarray, shift: float, chamber: Chamber) -> np.ndarray:
    """Temperature [°C] and humidity [%] (2, n) after the shift δ [1/K], as the chamber can follow them."""
    celsius, percent = site
    inverse = np.maximum(
        1.0 / (celsius + ZERO_CELSIUS_K) - shift, 1.0 / (chamber.temperature_degC[1] + ZERO_CELSIUS_K)
    )
    warm = np.clip(1.0 / inverse - ZERO_CELSIUS_K, *chamber.temperature_degC)
    damp = np.clip(percent, *chamber.relative_humidity_percent)
    ramps = (chamber.temperature_ramp_K_per_h, chamber.humidity_ramp_percent_per_h)
    return np.stack([_ramped(one, most) for one, most in zip((warm, damp), ramps, strict=True)])


def _ramped(values: np.ndarray, most: float) -> np.ndarray:
    """The course that follows values (n,) with at most so much change from one to the next."""
    if not len(values) or np.abs(np.diff(values)).max(initial=0.0) <= most:
        return values
    course = [float(values[0])]
    for value in values[1:].tolist():
        course.append(min(max(value, course[-1] - most), course[-1] + most))
    return np.array(course)


def _rate(law: Acceleration, celsius: np.ndarray, percent: np.ndarray) -> np.ndarray:
    return law.rate(celsius + ZERO_CELSIUS_K, percent / 100.0)


def closeness(
    days: Days,
    site: np.ndarray,
    test: np.ndarray,
    plan: ProfilePlan,
    ageing: BoundedMean,
    service_cycles: np.ndarray,
) -> Closeness:
    """What a test profile reproduces of the site, and how closely.

    days, ageing, service_cycles: as for `build_profile`.  site, test: temperatures [°C] and humidities [%] of
    the chosen days before warming, and of the test (2, n).
    """
    all_rate, own_rate = (_rate(plan.law, *one) for one in (days, test))
    aged, service = float(own_rate.sum()), plan.test.service_years
    years = [
        aged / max(one, 1e-300)
        for one in (ageing.value, ageing.mean_upper, ageing.mean_lower)  # many years: their mean
    ]
    wet, test_wet = (percent > WET_PERCENT for _, percent in (days, test))
    numbers = [
        (ClimateCode.WET_HOURS(percent=WET_PERCENT), 100.0 * wet.mean(), 100.0 * test_wet.mean()),
        (
            ClimateCode.WET_AGEING(percent=WET_PERCENT),
            100.0 * all_rate[wet].sum() / all_rate.sum(),
            100.0 * own_rate[test_wet].sum() / own_rate.sum(),
        ),
        (ClimateCode.MEAN_HUMIDITY(), days[1].mean(), test[1].mean()),
    ]
    cycles = (cycles_from(site[0]) * (YEAR_H / len(site[0])), cycles_from(test[0]))
    for least, a_year, before, after in zip(CYCLE_RANGES_K, service_cycles, *cycles, strict=True):
        numbers.append((ClimateCode.CYCLES_BEFORE_WARMING(range_K=float(least)), a_year, before))
        numbers.append((ClimateCode.CYCLES_IN_SERVICE(range_K=float(least)), service * a_year, after))
    return Closeness(
        Ageing(aged, service * ageing.value, *years),
        _distance(shares(site), shares(days)),
        _distance(shares(site, own_rate), shares(days, all_rate)),
        tuple(Reproduced(name, float(a), float(b)) for name, a, b in numbers),
    )


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    """Total variation distance of two distributions (B,): 0 the same, 1 nothing in common."""
    return float(0.5 * np.abs(a - b).sum())
