"""Unlogged proportional controllers of a heater, a cooling stage, a vent or a drier."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hygrokf.physics.expression import Value, maximum, minimum

CONTROLLED = ("throttled_heating", "venting", "throttled_drying")
"""Features, and inputs, that a `Throttle` provides."""


def position(value: Value, first: Value, second: Value) -> Value:
    """Position of a controller that opens in proportion to a `value`: 0 at `first`, 1 at `second`."""
    return minimum(maximum((value - first) / (second - first), 0.0), 1.0)


@dataclass(frozen=True)
class Throttle:
    """A proportional controller of a cabinet reading `reads` [K] or [1]: its position is 0 at `start` and 1
    from `full` on.  With `idle` it acts at standstill only."""

    reads: str
    start: float
    full: float
    idle: bool = False

    @property
    def levels(self) -> tuple[float, float]:
        return self.start, self.full

    def course(self, value: np.ndarray, idle: np.ndarray) -> np.ndarray:
        """Position (T,) for a series of readings (T,); a missing reading keeps the position.  `idle` (T,) is
        True at standstill."""
        last_valid = np.maximum.accumulate(np.where(np.isfinite(value), np.arange(len(value)), 0))
        return np.nan_to_num(self.at(value[last_valid], idle))

    def at(self, value: np.ndarray | float, idle: np.ndarray | bool) -> np.ndarray | float:
        """Position at one reading, of one controller or of N such controllers (N,)."""
        share = np.clip((value - self.start) / (self.full - self.start), 0.0, 1.0)
        return (np.where(idle, share, 0.0) if self.idle else share)[()]
