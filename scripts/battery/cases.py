"""The cases of the trials: what is hidden, in which plant or record, and how strongly."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from plants.hidden import FORMS, LIBRARY, OUT_OF_LIBRARY

from battery.measured import CASES, Known

Cause = tuple[str, int]
"""A cause of `plants.hidden` and the number of its form."""
DAYS = 170.0
APART = 100_000
"""Seeds between cells: no two cells share a plant; halved causes are in the plants of whole ones."""
CAUSES: dict[str, tuple[Cause, ...]] = {
    "sorption": (("moisture_sorption", 0), ("moisture_sorption", 1)),
    "condensation": (("condensation", 0), ("condensation", 1)),
    "wall": (("wall_thermal_mass", 0), ("wall_thermal_mass", 1)),
    "sun": (("solar_gain", 0), ("solar_gain", 1)),
    "wind": (("wind_driven_exchange", 0), ("wind_driven_exchange", 1)),
    "standstill heater": (("unlogged_heater", 0), ("unlogged_heater", 1)),
    "cooling": (("cooling_switching", 0), ("cooling_switching", 1)),
    "exchange step": (("exchange_step", 0), ("exchange_step", 1)),
    "drift of the heat": (("heat_release_drift", 0), ("heat_release_drift", 1)),
    "drift of the humidity sensor": (("humidity_sensor_drift", 0), ("humidity_sensor_drift", 1)),
    "clock": (("clock_shift", 0),),
    "rain": (("rain_ingress", 0), ("rain_ingress", 1)),
    "doors": (("door_opening", 0), ("door_opening", 1)),
    "dehumidifier": (("dehumidifier", 0), ("dehumidifier", 1)),
    "ambient series": (("ambient_bias", 0), ("ambient_bias", 1)),
}
"""The fifteen causes; seeds take their forms by turns.  Summer time cannot be halved."""
THERMAL = ("wall", "sun", "standstill heater", "cooling", "drift of the heat", "wind")
HYGRIC = (
    "sorption",
    "condensation",
    "drift of the humidity sensor",
    "rain",
    "dehumidifier",
    "source",
)
SOURCES = tuple(("internal_moisture_source", form) for form in range(len(FORMS["internal_moisture_source"])))
NULL_KINDS = {
    "nulls": "two_times",
    "sensor_nulls": "probe",
    "fluctuating_nulls": "resistances",
    "burst_nulls": "bursts",
    "apart_burst_nulls": "apart_bursts",
}
"""Group -> kind of `plants.nulls`."""
_CONFIDENCE_STREAM = 71


@dataclass(frozen=True)
class Case:
    """One case: its group, cell and seed, and what the plant of `plant_seed` hides.

    halved: with half the amplitude. null: kind of `plants.nulls`. known: a variant of a measured
    record.
    """

    group: str
    cell: str
    seed: int
    plant_seed: int = 0
    causes: tuple[Cause, ...] = ()
    halved: bool = False
    null: str = ""
    known: Known | None = None

    @property
    def key(self) -> str:
        """What tells the case from all others."""
        return f"{self.group}:{self.cell}:{self.seed}"


def _alone(group: str, halved: bool) -> Callable[[int], Iterator[Case]]:
    def cases(seed: int) -> Iterator[Case]:
        for place, (cell, forms) in enumerate(CAUSES.items(), 1):
            hidden = (forms[seed % len(forms)],)
            yield Case(group, cell, seed, place * APART + seed, hidden, halved)

    return cases


def _pairs(seed: int) -> Iterator[Case]:
    """A cause on heat beside one on moisture; 36 seeds have every pair once, 18 each cause three times."""
    thermal = THERMAL[seed % 6]
    hygric = HYGRIC[(seed + seed // 6) % 6]
    forms = {**CAUSES, "source": SOURCES}
    hidden = tuple(forms[name][seed // 6 % len(forms[name])] for name in (thermal, hygric))
    yield Case("pairs", f"{thermal} + {hygric}", seed, 20 * APART + seed, hidden)


def _nulls(group: str) -> Callable[[int], Iterator[Case]]:
    place = 21 + list(NULL_KINDS).index(group)

    def cases(seed: int) -> Iterator[Case]:
        yield Case(group, "nothing", seed, place * APART + seed, null=NULL_KINDS[group])

    return cases


def _outside(seed: int) -> Iterator[Case]:
    for place, effect in enumerate(OUT_OF_LIBRARY):
        yield Case("outside", effect, seed, (30 + place) * APART + seed, ((effect, 0),))


def _confidence(seed: int) -> Iterator[Case]:
    """A plant as they may come: nothing in one of six, else any form of any cause, halved in one of two."""
    random = np.random.default_rng([_CONFIDENCE_STREAM, seed])
    plant_seed = 50 * APART + seed
    if random.random() < 1.0 / 6.0:
        yield Case("confidence", "drawn", seed, plant_seed, null="two_times")
        return
    cause = LIBRARY[int(random.integers(len(LIBRARY)))]
    form = int(random.integers(len(FORMS[cause])))
    yield Case("confidence", "drawn", seed, plant_seed, ((cause, form),), bool(random.random() < 0.5))


def _measured(seed: int) -> Iterator[Case]:
    """Variants of measured records, once whatever the seeds are."""
    if seed == 0:
        for one in CASES:
            yield Case("measured", f"{one.record}, {one.variant}", seed, known=one)


GROUPS: dict[str, Callable[[int], Iterator[Case]]] = {
    "causes": _alone("causes", False),
    "half": _alone("half", True),
    "pairs": _pairs,
    **{group: _nulls(group) for group in NULL_KINDS},
    "outside": _outside,
    "measured": _measured,
    "confidence": _confidence,
}
"""Group -> its cases of a seed."""


def chosen(groups: Sequence[str], seeds: Iterable[int]) -> list[Case]:
    """The cases of some groups, seed by seed: trials that are stopped early have seen every cell."""
    return [case for seed in seeds for group in groups for case in GROUPS[group](seed)]
