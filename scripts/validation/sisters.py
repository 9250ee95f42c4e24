"""Transfers between measured sisters: two 2 MW turbines (the generator stands for the cabinet) and three
greenhouse compartments: docs/validation/real_input.md.  Some minutes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache

from builders import greenhouse

from hygrokf import identify, transfer_fit
from hygrokf.data.record import Record
from hygrokf.identification.fit import Fit
from validation.counts import markdown
from validation.frame import DATA, Claim
from validation.records import expect

TURBINES = "two_sister_turbines_2MW_10min_2016.csv.gz"
PAIRS = {
    "turbines": (("turbine 1", "turbine 2"), ("turbine 2", "turbine 1")),
    "greenhouses": (("Reference", "Koala"), ("Reference", "CVA")),
}
"""Variant -> the source and the other record of each of its cases."""


def turbine(number: int) -> Record:
    """One of the two turbines: generator, outside temperature, power; a sensor that shows exactly zero is
    down."""
    import pandas as pd

    from hygrokf.cases.frames import read_frames

    rows = pd.read_csv(DATA / TURBINES)
    rows = rows[rows.turbine == number]
    rows.index = pd.to_datetime(rows.pop("time"))
    rows = rows[~rows.index.duplicated()]
    down = (rows.generator_temperature_degC == 0.0) | (rows.outside_temperature_degC == 0.0)
    rows = rows.mask(down & (rows.active_power_kW == 0.0) & (rows.rotor_speed_rpm == 0.0))
    columns = {
        "cabinet_temperature": ("generator_temperature_degC", "degC"),
        "ambient_temperature": ("outside_temperature_degC", "degC"),
        "active_power": ("active_power_kW", "kW"),
    }
    return read_frames(
        {"SCADA": pd.DataFrame({signal: rows[column] for signal, (column, _) in columns.items()})},
        units={signal: unit for signal, (_, unit) in columns.items()},
        timezone="UTC",
        identification={"until": "2016-03-01T00:00Z"},
        rated_power_kW=2000.0,
        name=f"turbine {number}",
    )


def record(name: str) -> Record:
    if name.startswith("turbine"):
        expect(TURBINES)
        return turbine(int(name.split()[1]))
    expect(*greenhouse.files(name))
    return greenhouse.whole(name)


@lru_cache(maxsize=2)
def fitted(name: str) -> Fit:
    return identify(record(name), starts=2, profiles=False)


def one(variant: str, seed: int) -> dict:
    """The fit of a source, and its transfer to another record."""
    source, other = PAIRS[variant][seed]
    own = fitted(source)
    found = transfer_fit(own, record(other)).results
    return {
        "source": source,
        "other": other,
        "constant": own.to_json()["time_constants"]["thermal"],
        "verdict": str(found.verdict),
        "sentence": found.statement.text,
    }


def table(lines: Sequence[Mapping]) -> str:
    """Of each transfer the source's time constant and the verdict."""
    rows = []
    for line in lines:
        own = line["constant"]
        constant = f"{own['value_h']:.2f} h ({own['lower_h']:.2f} … {own['upper_h']:.2f}), {own['verdict']}"
        rows.append((line["source"], constant, line["other"], line["verdict"], line["sentence"]))
    return markdown(("source", "thermal", "on", "verdict", ""), rows)


CLAIM = Claim("sisters", {variant: range(len(pairs)) for variant, pairs in PAIRS.items()}, one, table)
