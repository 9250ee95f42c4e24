"""Pairs of simulated cabinets that share all, some or none of their parameters, and the verdict that is
right."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from plants.as_record import to_record
from plants.cabinet import Cabinet
from plants.plant import plant

from hygrokf.data.record import Record
from hygrokf.transfer.baseline import HEAT_GROUP, HYGRIC_GROUP, THERMAL_GROUP

DAY_S = 86400.0
DAYS, HELD_OUT_DAYS = 60.0, 15.0
MOST_HEAT = 1.8
"""Largest factor of the heat release: twice as much heats a cabinet beyond what is built."""
KINDS = (
    (),
    (THERMAL_GROUP,),
    (HEAT_GROUP,),
    (HYGRIC_GROUP,),
    (THERMAL_GROUP, HEAT_GROUP),
    (THERMAL_GROUP, HYGRIC_GROUP),
    (HEAT_GROUP, HYGRIC_GROUP),
    (THERMAL_GROUP, HEAT_GROUP, HYGRIC_GROUP),
)
"""What differs; pairs that share everything and nothing come as often as all others together
(`differing`)."""


@dataclass(frozen=True)
class Pair:
    """Records of two turbines and the groups of parameters in which they differ."""

    first: Record
    second: Record
    differ: tuple[str, ...]

    @property
    def right(self) -> tuple[str, tuple[str, ...]]:
        """The right verdict: its word, and what is to be re-estimated."""
        if not self.differ:
            return "transfers", ()
        if len(self.differ) == 3:
            return "does not transfer", self.differ
        return "transfers after re-estimating", self.differ


def differing(seed: int) -> tuple[str, ...]:
    """What the pair of a seed differs in: a third all shared, a third some, a third none."""
    return ((), KINDS[1 + (seed // 3) % 6], KINDS[-1])[seed % 3]


def changed(
    cabinet: Cabinet,
    groups: tuple[str, ...],
    random: np.random.Generator,
    least: float = 1.35,
    most: float = 2.0,
) -> Cabinet:
    """The cabinet with groups of parameters times a factor between `least` and `most`, or its inverse."""

    def factor(top: float) -> float:
        return float(np.exp(random.choice([-1.0, 1.0]) * random.uniform(np.log(least), np.log(top))))

    thermal, heat, hygric = factor(most), factor(min(most, MOST_HEAT)), factor(most)
    if THERMAL_GROUP in groups:
        cabinet = replace(cabinet, heat_capacity=cabinet.heat_capacity * thermal)
    if HEAT_GROUP in groups:
        cabinet = replace(
            cabinet,
            operation_W=tuple(heat * part for part in cabinet.operation_W),
            standstill_W=tuple(heat * part for part in cabinet.standstill_W),
        )
    if HYGRIC_GROUP in groups:
        cabinet = replace(cabinet, gap=cabinet.gap / hygric)
    return cabinet


def record_of(seed: int, cabinet: Cabinet | None, days: float, held_out: float, disturbance: str) -> Record:
    """The record of a plant, with a cabinet that is given or drawn."""
    given = {} if cabinet is None else {one.name: getattr(cabinet, one.name) for one in fields(cabinet)}
    made = plant(seed, days=days, disturbance=disturbance, **given)
    return to_record(made, until_s=float(made.drivers.time[-1]) - held_out * DAY_S)


def pair(
    seed: int,
    differ: tuple[str, ...] | None = None,
    days: float = DAYS,
    held_out: float = HELD_OUT_DAYS,
    disturbance: str = "ou",
    factor: float | None = None,
) -> Pair:
    """Two turbines with weather, operation, loggers and disturbances of their own; what differs does so by
    `factor`."""
    groups = differing(seed) if differ is None else differ
    first, second = 20_000 + 2 * seed, 20_001 + 2 * seed
    cabinet = plant(first, days=2.0).cabinet
    span = {} if factor is None else {"least": factor, "most": factor}
    other = changed(cabinet, groups, np.random.default_rng([seed, 11]), **span)
    return Pair(
        record_of(first, cabinet, days, held_out, disturbance),
        record_of(second, other, days, held_out, disturbance),
        groups,
    )
