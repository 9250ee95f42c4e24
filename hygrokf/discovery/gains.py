"""Errors of the base and of the extended model, as they are told: from the two final sets, without the hours
in which openings were named."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from hygrokf.data.timestamps import DAY_S
from hygrokf.discovery.conclusion import Conclusion
from hygrokf.discovery.discovery_results import Gain
from hygrokf.discovery.estimate import Estimate
from hygrokf.discovery.residuals import NORMAL_95, QUANTITIES, Residuals
from hygrokf.discovery.search import foreseen

QUANTITY = {"temperature": "temperature", "humidity": "vapour"}
"""A quantity of residuals → of the search."""


def gains(ended: Conclusion, before: Residuals, after: Residuals) -> tuple[Gain, ...]:
    """The gains by quantity: on held-out readings where there are any, else on those that identified.

    before, after: residuals of both models' free runs; the same ones without an extended model.
    """
    spans = _openings(ended)
    # a corrected clock moves the instants of one model: no differences remain
    together = np.array_equal(before.time_s, after.time_s)
    found = []
    for quantity in QUANTITIES:
        old = _outside(before.time_s, before.error(quantity), spans)
        new = _outside(after.time_s, after.error(quantity), spans)
        for period, chosen in (("validation", True), ("identification", False)):
            pair = old[before.validation == chosen], new[after.validation == chosen]
            if all(np.isfinite(one).any() for one in pair):
                chosen_s = before.time_s[before.validation == chosen]
                day = np.floor(chosen_s / DAY_S) if together else np.empty(0)
                found.append(
                    _gain(quantity, period, *pair, day, _driven(ended, QUANTITY[quantity], chosen, spans))
                )
                break
    return tuple(found)


def _openings(ended: Conclusion) -> list[list[float]]:
    """The stretches [s] in which a door was named, those of the held-out part included."""
    spans = []
    for one in ended.accepted:
        if one.candidate.form.windows and ended.extended is not None:
            whole = foreseen(ended.base.estimate, one.candidate)
            spans += next(
                design.features["door_open"]["spans"]
                for design in whole.simulator.designs
                if "door_open" in design.features
            )
    return spans


def _outside(time_s: np.ndarray, error: np.ndarray, spans: Sequence[Sequence[float]]) -> np.ndarray:
    inside = np.zeros(len(time_s), bool)
    for first, last in spans:
        inside |= (time_s >= first) & (time_s <= last)
    return np.where(inside, np.nan, error)


def _driven(
    ended: Conclusion, quantity: str, held_out: bool, spans: Sequence[Sequence[float]]
) -> tuple[float, float]:
    """RMSE of the vapour of both models on the measured temperature; NaN of the temperature."""
    if quantity == "temperature":
        return math.nan, math.nan

    def error(one: Estimate) -> float:
        r = one.simulator.scene.readings[quantity]
        chosen = np.where(r.identified != held_out, r.value - one.simulated[quantity], np.nan)
        return _root(_outside(r.time_s, chosen, spans))

    return error(ended.base.estimate), error(ended.last.estimate)


def _gain(
    quantity: str, period: str, old: np.ndarray, new: np.ndarray, day: np.ndarray, driven: tuple[float, float]
) -> Gain:
    lower, upper = _bounds(old, new, day) if len(day) else (math.nan, math.nan)
    return Gain(quantity, period, _root(old), _root(new), lower, upper, *driven)


def _bounds(old: np.ndarray, new: np.ndarray, day: np.ndarray) -> tuple[float, float]:
    """95 % bounds of the fall of the root mean square at common instants: days are independent, the mean
    square's change is normal."""
    both = np.isfinite(old) & np.isfinite(new)
    _, which = np.unique(day[both], return_inverse=True)
    if not len(which) or which.max() < 1:
        return math.nan, math.nan
    # by the delta method: d rmse = d (mean square) / (2 rmse)
    a, b = _root(old[both]), _root(new[both])
    each = old[both] ** 2 / max(2.0 * a, 1e-12) - new[both] ** 2 / max(2.0 * b, 1e-12)
    daily = np.bincount(which, each - each.mean())
    reach = NORMAL_95 * math.sqrt(float(daily @ daily)) / len(each)
    return a - b - reach, a - b + reach


def _root(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if len(known) else math.nan
