"""Unlogged controllers: two-point switches and throttles of a heater, a cooling stage, a vent or a drier."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from hygrokf.physics.expression import Value, maximum, minimum, where

TEMPERATURE = "cabinet_temperature"
HUMIDITY = "cabinet_relative_humidity"


def position(value: Value, before: Value, first: Value, second: Value, two_point: Value) -> Value:
    """Position of a controller, 0 to 1, that follows a `value` and had the position `before`.

    With `two_point` 1 it is on from where the value passes `first` to where it passes `second`, upward where
    `first` is the higher level, else downward.  With `two_point` 0 it opens in proportion: 0 at `first`, 1 at
    `second`.
    """
    sign = where(first < second, -1.0, 1.0)
    away = sign * value
    switched = where(away < sign * second, 0.0, where(sign * first < away, 1.0, before))
    share = minimum(maximum((value - first) / (second - first), 0.0), 1.0)
    return where(two_point > 0.5, switched, share)


@dataclass(frozen=True)
class Switch:
    """A two-point switch that follows a reading of the cabinet, `reads` [K] or [1].

    With `rising`, the switch starts above `on` and stops below `off`; otherwise it starts below `on` and
    stops above `off`. With `idle`, it runs at standstill only.
    """

    reads: str
    on: float
    off: float
    rising: bool = True
    idle: bool = False

    @property
    def levels(self) -> tuple[float, float]:
        return self.on, self.off

    def course(self, value: np.ndarray, idle: np.ndarray) -> np.ndarray:
        """State (T,) for a series of readings (T,); a missing reading keeps the state.  `idle` (T,) is True
        at standstill."""
        allowed = idle if self.idle else np.ones(len(value), bool)
        sign = 1.0 if self.rising else -1.0
        return two_point(sign * value, sign * self.on, sign * self.off, allowed)

    def after(
        self, before: np.ndarray | float, value: np.ndarray | float, idle: np.ndarray | bool
    ) -> np.ndarray | float:
        """State after one reading, of one switch or of N such switches (N,)."""
        started = value > self.on if self.rising else value < self.on
        stopped = value < self.off if self.rising else value > self.off
        if self.idle:
            stopped = stopped | np.logical_not(idle)
        return np.where(stopped, 0.0, np.where(started, 1.0, before))[()]


def two_point(value: np.ndarray, on_above: float, off_below: float, allowed: np.ndarray) -> np.ndarray:
    """State (T,) of a two-point switch: 1 from the first value above `on_above` to the first below
    `off_below`.

    value: (T,); a missing value keeps the state. allowed: (T,) bool; the switch is off where it is False.
    """
    event = np.where(~allowed | (value < off_below), -1, np.where(value > on_above, 1, 0))
    last = np.maximum.accumulate(np.where(event != 0, np.arange(len(value)), -1))
    return ((last >= 0) & (event[np.maximum(last, 0)] > 0)).astype(float)


@dataclass(frozen=True)
class Throttle:
    """A proportional controller that follows a reading of the cabinet, `reads` [K] or [1]: 0 at `start`, 1
    from `full` on; with `idle` at standstill only."""

    reads: str
    start: float
    full: float
    idle: bool = False

    @property
    def levels(self) -> tuple[float, float]:
        return self.start, self.full

    def course(self, value: np.ndarray, idle: np.ndarray) -> np.ndarray:
        """Position (T,) for a series of readings (T,); a missing reading keeps the position."""
        known = np.maximum.accumulate(np.where(np.isfinite(value), np.arange(len(value)), 0))
        return np.nan_to_num(self.after(0.0, value[known], idle))

    def after(
        self, before: np.ndarray | float, value: np.ndarray | float, idle: np.ndarray | bool
    ) -> np.ndarray | float:
        """Position after one reading, of one controller or of N such controllers (N,)."""
        share = np.clip((value - self.start) / (self.full - self.start), 0.0, 1.0)
        return (np.where(idle, share, 0.0) if self.idle else share)[()]


def cooling_stage(on_K: float, off_K: float) -> Switch:
    """A cooling stage that starts when the cabinet temperature exceeds `on_K` and stops when it falls below
    `off_K`."""
    return Switch(TEMPERATURE, on_K, off_K)


def heater(reads: str, on: float, off: float, idle: bool = True) -> Switch:
    """A heater: a thermostat starts below `on` [K] and stops above `off`; a humidistat [1] starts above `on`
    and stops below `off`.

    With `idle`, the heater runs at standstill only.
    """
    return Switch(reads, on, off, rising=reads != TEMPERATURE, idle=idle)


def drier(on: float, off: float) -> Switch:
    """A drier that starts when the cabinet's relative humidity [1] exceeds `on` and stops when it falls below
    `off`."""
    return Switch(HUMIDITY, on, off)


SWITCHES: Mapping[str, Callable[..., Switch | Throttle]] = {
    "cooling": cooling_stage,
    "heating": heater,
    "throttled_heating": Throttle,
    "venting": Throttle,
    "throttled_drying": Throttle,
    "drying": drier,
}
"""Controllers by the name of the feature, and input, that they provide."""
