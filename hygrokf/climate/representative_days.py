"""Days of simulated climate that together stand for all of it.

The chosen days together have the joint distribution of temperature and humidity, the distribution of ageing
over it, the wet hours and the daily ranges of the whole ensemble.  Each step adds, and later exchanges, the
day that brings the means of these features closest to their targets in least squares.  (The method of test
reference years, ISO 15927-4, with days in place of months and ageing in place of heating demand.)
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hygrokf.climate.chamber import Acceleration
from hygrokf.climate.ensemble import Year
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K

DAY_H = 24
MOST_DAYS = 3000
"""Days to choose from, at most."""
T_EDGES, H_EDGES = np.arange(-60.0, 125.0, 5.0), np.arange(0.0, 110.0, 10.0)
"""[°C], [%] bins in which distributions are compared."""
RANGE_EDGES_K = np.array([0.0, 2.5, 5.0, 7.5, 10.0, 15.0, 20.0, 1e3])
WEIGHTS = {"joint": 1.0, "ageing": 1.0, "mean": 3.0, "wet": 2.0, "range": 1.0}
"""Weights of the features' squared errors."""
ROUNDS = 12


@dataclass(frozen=True)
class Days:
    """Days (D, 24): temperature [°C] and relative humidity [%], hour by hour; `start_s` (D,) their starts
    [s since 1970, UTC]."""

    temperature_degC: np.ndarray
    relative_humidity_percent: np.ndarray
    start_s: np.ndarray

    def __len__(self) -> int:
        return len(self.start_s)

    def take(self, places: Sequence[int] | np.ndarray) -> Days:
        """The days at these places."""
        return Days(
            self.temperature_degC[places], self.relative_humidity_percent[places], self.start_s[places]
        )


def days_of(year: Year, members: Sequence[int]) -> Days:
    """The days of some members of a year whose hours are all known; none where the year is not hourly."""
    hours = np.round(year.time_s / 3600.0).astype(np.int64)
    begins = np.flatnonzero(hours % DAY_H == hours[0] % DAY_H)
    begins = begins[begins + DAY_H <= len(hours)]
    begins = begins[hours[begins + DAY_H - 1] - hours[begins] == DAY_H - 1]
    places = begins[:, None] + np.arange(DAY_H)
    whole = year.known[places].all(axis=1)
    places = places[whole]
    assert year.relative_humidity is not None, "a test profile needs the humidity"
    chosen = np.asarray(members)
    temperature = year.temperature_K[chosen][:, places] - ZERO_CELSIUS_K
    humidity = 100.0 * year.relative_humidity[chosen][:, places]
    return Days(
        temperature.reshape(-1, DAY_H),
        humidity.reshape(-1, DAY_H),
        np.tile(year.time_s[places[:, 0]], len(chosen)) if len(places) else np.empty(0),
    )


def joined(parts: Sequence[Days]) -> Days:
    """The days of several parts, one after the other."""
    return Days(*(np.concatenate([getattr(p, name) for p in parts]) for name in Days.__dataclass_fields__))


def thinned(days: Days, most: int = MOST_DAYS) -> Days:
    """At most so many days, evenly from all."""
    if len(days) <= most:
        return days
    return days.take(np.linspace(0, len(days) - 1, most).round().astype(int))


def places_in(celsius: np.ndarray, percent: np.ndarray) -> np.ndarray:
    """Bin of each instant in the flattened joint distribution, any shape."""
    i = np.clip(np.searchsorted(T_EDGES, celsius, side="right") - 1, 0, len(T_EDGES) - 2)
    j = np.clip(np.searchsorted(H_EDGES, percent, side="right") - 1, 0, len(H_EDGES) - 2)
    return i * (len(H_EDGES) - 1) + j


def shares(celsius: np.ndarray, percent: np.ndarray, weight: np.ndarray | None = None) -> np.ndarray:
    """Shares (B,) of all instants, or of a weight, in the bins of the joint distribution."""
    bins = (len(T_EDGES) - 1) * (len(H_EDGES) - 1)
    weights = None if weight is None else np.ravel(weight)
    counted = np.bincount(places_in(celsius, percent).ravel(), weights=weights, minlength=bins).astype(float)
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
    for _ in range(ROUNDS):
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
    celsius, percent = days.temperature_degC, days.relative_humidity_percent
    bins = (len(T_EDGES) - 1) * (len(H_EDGES) - 1)
    place = places_in(celsius, percent)
    used = np.unique(place)
    column = np.zeros(bins, dtype=int)
    column[used] = np.arange(len(used))
    flat = (np.arange(len(days))[:, None] * len(used) + column[place]).ravel()
    rate = law.rate(celsius + ZERO_CELSIUS_K, percent / 100.0)
    rate = rate / rate.mean()
    size = len(days) * len(used)
    joint = np.bincount(flat, minlength=size).reshape(len(days), -1) / DAY_H
    ageing = np.bincount(flat, weights=rate.ravel(), minlength=size).reshape(len(days), -1) / DAY_H
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
    first = np.column_stack([days.temperature_degC[:, 0] / 5.0, days.relative_humidity_percent[:, 0] / 10.0])
    last = np.column_stack([days.temperature_degC[:, -1] / 5.0, days.relative_humidity_percent[:, -1] / 10.0])
    jump = np.linalg.norm(last[:, None] - first[None], axis=2)
    order = [int(np.argmin(days.temperature_degC.mean(axis=1)))]
    left = set(range(len(days))) - set(order)
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
    """Sum of the jumps from each of some days to the next."""
    return float(sum(jump[a, b] for a, b in itertools.pairwise(days)))
