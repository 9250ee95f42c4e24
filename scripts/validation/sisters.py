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
PARAMETERS = ("thermal_time_constant", "hygric_k", "heat_release_operation", "heat_release_power_1")


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
    expect(*(f"greenhouse_agc2022_{part}_5min.csv.gz" for part in (name, "weather")))
    return greenhouse.record(name, greenhouse.whole(name))


@lru_cache(maxsize=2)
def fitted(name: str) -> Fit:
    return identify(record(name), starts=2, profiles=False)


def one(variant: str, seed: int) -> dict:
    """The fit of a source, and its transfer to another record."""
    source, other = PAIRS[variant][seed]
    own = fitted(source).to_json()
    found = transfer_fit(fitted(source), record(other)).results
    return {
        "source": source,
        "other": other,
        "constant": own["time_constants"]["thermal"],
        "validation_K": own["rmse"]["validation"]["temperature_K"]["total"],
        "verdict": str(found.verdict),
        "sentence": found.sentence,
        "groups": [[g.group, str(g.outcome), g.p_adjusted, str(g.effect), g.statement] for g in found.groups],
        "parameters": {
            name: [str(part) for part in (row.original, row.own, row.difference)]
            for name, row in found.parameters.items()
            if name in PARAMETERS
        },
        "rmse": {q: {key: one.total for key, one in columns.items()} for q, columns in found.rmse.items()},
    }


def table(lines: Sequence[Mapping]) -> str:
    """Of each transfer the source's time constant and the verdict, with groups, parameters and errors."""
    parts = []
    for line in lines:
        own = line["constant"]
        rows = [tuple(row) for row in line["groups"]]
        rows += [(name, f"{a} → {b}", "", change, "") for name, (a, b, change) in line["parameters"].items()]
        for quantity, columns in line["rmse"].items():
            rows.append((quantity, ", ".join(f"{key} {value}" for key, value in columns.items()), "", "", ""))
        parts += [
            f"{line['source']}: {own['value_h']:.2f} h ({own['lower_h']:.2f} … {own['upper_h']:.2f}), "
            f"{own['verdict']}; free run {line['validation_K']:.2f} K in validation. On {line['other']}: "
            f"{line['verdict']}; {line['sentence']}",
            markdown(("", "", "p", "effect", ""), rows),
        ]
    return "\n\n".join(parts)


CLAIM = Claim("sisters", {variant: range(len(pairs)) for variant, pairs in PAIRS.items()}, one, table)
