"""The rows of docs/validation/coverage.md: a record of a seed, and what its estimates are held against."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

from other_make import ROWS as SCENARIOS
from other_make import Scenario, Truth, make_plant
from other_make.as_record import to_record as record_of_other_make
from plants import DISTURBANCES, plant
from plants.as_record import to_record

from hygrokf.data.record import Record

Entry = Mapping
"""One of a fit's `time_constants`."""


@dataclass(frozen=True)
class Quantity:
    """A quantity whose truth is known.

    constant: the fit's time constant it is compared with. truth: the true value [h], given the fit's entry,
    which says at which temperatures or which difference it holds. key: the part of that entry that reports
    this quantity; where the fit has no such part, and where None, it is the entry itself.
    """

    constant: str
    truth: Callable[[Entry], float]
    key: str | None = None


@dataclass(frozen=True)
class Row:
    """One row: `make(seed, days)` gives the record and the quantities by name."""

    make: Callable[[int, float], tuple[Record, Mapping[str, Quantity]]]


def _of_other_make(scenario: Scenario, seed: int, days: float) -> tuple[Record, Mapping[str, Quantity]]:
    made = make_plant(seed, scenario, days)
    return record_of_other_make(made), other_make_quantities(scenario, made.truth)


def other_make_quantities(scenario: Scenario, truth: Truth) -> dict[str, Quantity]:
    """What a plant of tests/other_make is held against.

    Under convection the headline is the small-signal constant, and R·C stands beside it.  With a second mass
    it is (R_AT+R_IC) C of the converter, the constant of the paper's network; the network's longest constant
    stands beside it.
    """

    def small_signal(entry: Entry) -> float:
        return truth.cabinet.small_signal_h(_difference_K(entry, truth))

    def resistance_capacity(entry: Entry) -> float:
        return truth.cabinet.resistance_capacity_h(_difference_K(entry, truth))

    found = {
        "thermal": Quantity("thermal", small_signal),
        "hygric": Quantity("hygric", partial(_hygric, truth)),
    }
    if scenario.exponent is not None:
        found["thermal R·C"] = Quantity("thermal", resistance_capacity, "resistance_capacity")
    if scenario.second_mass is not None:
        found["thermal longest"] = Quantity("thermal", lambda entry: truth.dominant_h)
    return found


def _difference_K(entry: Entry, truth: Truth) -> float:
    """The median difference [K] at which the fit reports its thermal constant; the plant's where it does not
    say."""
    stated = entry.get("difference_K")
    return stated[1] if stated else truth.differences_K[1]


def _hygric(truth: Truth, entry: Entry) -> float:
    reference = entry["reference"]
    return truth.hygric_h(reference["cabinet_temperature_K"], reference["ambient_temperature_K"])


def _of_plants(options: Mapping[str, str], seed: int, days: float) -> tuple[Record, Mapping[str, Quantity]]:
    made = plant(seed, days=days, **options)
    return to_record(made), {
        "thermal": Quantity("thermal", lambda entry: made.truth.tau_h),
        "hygric": Quantity("hygric", lambda entry: made.truth.hygric_h),
    }


ROWS = {name: Row(partial(_of_other_make, scenario)) for name, scenario in SCENARIOS.items()}
ROWS |= {
    kind: Row(partial(_of_plants, {"disturbance": kind, "sensor_errors": "cabinet"}))
    for kind in DISTURBANCES
    if kind != "none"
}
ROWS["ou-all-sensors"] = Row(partial(_of_plants, {"disturbance": "ou", "sensor_errors": "all"}))
"""Rows by name: those of tests/other_make, then disturbances of tests/plants."""
