"""What a test in a climate chamber is asked for, and what the chamber can do.

A file of a test:

    [test]
    length_h = 1000
    service_years = 20

    [law]                                   # of acceleration: Peck; exponent 0 is Arrhenius
    humidity_exponent = 2.66
    activation_energy_eV = 0.79
    reference_degC = 85
    reference_percent = 85

    [chamber]
    temperature_degC = [-20, 85]
    relative_humidity_percent = [10, 95]
    temperature_ramp_K_per_h = 60
    humidity_ramp_percent_per_h = 60
"""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, field, fields

from hygrokf.climate.acceleration import Acceleration
from hygrokf.climate.form import FormFault, number_of, pair_of, read_toml, unknown_keys


@dataclass(frozen=True)
class Chamber:
    """What a chamber can set: ranges of temperature [°C] and relative humidity [%], steepest ramps [K/h], [%/h]."""

    temperature_degC: tuple[float, float] = (-20.0, 85.0)
    relative_humidity_percent: tuple[float, float] = (10.0, 95.0)
    temperature_ramp_K_per_h: float = 60.0
    humidity_ramp_percent_per_h: float = 60.0


@dataclass(frozen=True)
class ProfilePlan:
    """A test: its length [h], the years of service whose ageing it is to have, law and chamber."""

    length_h: float = 1000.0
    service_years: float = 20.0
    law: Acceleration = field(default_factory=Acceleration)
    chamber: Chamber = field(default_factory=Chamber)

    def to_json(self) -> dict:
        return asdict(self)


def read_test_plan(path: str | os.PathLike[str]) -> ProfilePlan:
    """A test from a TOML file, defaults for what it leaves out; raises FormFault with everything that is wrong."""
    data = read_toml(path, "a test with [test], [law] and [chamber]")
    faults = unknown_keys(data, ("test", "law", "chamber"), "the file")
    tables = {}
    for name, known in (
        ("test", ("length_h", "service_years")),
        ("law", tuple(f.name for f in fields(Acceleration))),
        ("chamber", tuple(f.name for f in fields(Chamber))),
    ):
        table = data.get(name, {})
        if not isinstance(table, dict):
            faults.append(f"{name}: expected a table [{name}], found {table!r}")
            table = {}
        faults += unknown_keys(table, known, f"[{name}]")
        tables[name] = table
    test, law, chamber = tables["test"], tables["law"], tables["chamber"]
    plain = ProfilePlan()
    made = ProfilePlan(
        number_of(test, "length_h", "[test]", 24.0, 20000.0, plain.length_h, faults),
        number_of(test, "service_years", "[test]", 0.001, 100.0, plain.service_years, faults),
        Acceleration(
            number_of(law, "humidity_exponent", "[law]", 0.0, 10.0, 2.66, faults),
            number_of(law, "activation_energy_eV", "[law]", 0.05, 3.0, 0.79, faults),
            number_of(law, "reference_degC", "[law]", -50.0, 200.0, 85.0, faults),
            number_of(law, "reference_percent", "[law]", 1.0, 100.0, 85.0, faults),
        ),
        Chamber(
            pair_of(chamber, "temperature_degC", "[chamber]", -80.0, 200.0, plain.chamber.temperature_degC, faults),
            pair_of(
                chamber, "relative_humidity_percent", "[chamber]", 0.0, 100.0,
                plain.chamber.relative_humidity_percent, faults,
            ),
            number_of(chamber, "temperature_ramp_K_per_h", "[chamber]", 0.1, 6000.0, 60.0, faults),
            number_of(chamber, "humidity_ramp_percent_per_h", "[chamber]", 0.1, 6000.0, 60.0, faults),
        ),
    )  # fmt: skip
    if faults:
        raise FormFault(path, faults)
    return made
