"""Measured records, and known effects in them.

Attics: the air in the middle under the roof stands for the cabinet, the weather station for the ambient.
House: the living room.  Neither has a converter, so there is no power.  The loggers inside and the weather
station are two sources with a clock each, although they come in one file.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from plants.injection import YEAR_S, inject
from plants.saturation import concentration, saturation_pressure

from hygrokf.cases.case_file import read_case
from hygrokf.data.record import Record, Series

DATA = Path(__file__).resolve().parents[2] / "../shared/data"
IDENTIFIED = 2.0 / 3.0
"""Share of a record, from its start, that identifies; the rest gives the gain."""
CAUSE_OF = {
    "clock_shift": "clock_shift",
    "humidity_drift": "humidity_sensor_drift",
    "temperature_step": "temperature_sensor_offset",
    "sorption": "moisture_sorption",
}
"""The library's name of each effect that is put in."""
SORPTION_G_M3 = (0.4, 0.8)
"""[g/m3] root mean square change of the vapour that sorption makes; the others are sized by what they are."""
MOST_CAPACITY_KG_M3 = 2.0
_SIZINGS = 3
INSIDE = ("cabinet_temperature", "cabinet_relative_humidity")

_ATTIC = """\
name = "{name}"
[[source]]
file = "{file}"
time = "t_UTC+2"
timezone = "+02:00"
signals.cabinet_temperature = {{ column = "T_roofmiddle_airmiddle", unit = "degC" }}
signals.cabinet_relative_humidity = {{ column = "RH_roofmiddle_airmiddle", unit = "%" }}
signals.ambient_temperature = {{ column = "T_fmi", unit = "degC" }}
signals.ambient_relative_humidity = {{ column = "RH_fmi", unit = "%" }}
signals.wind_speed = {{ column = "ws", unit = "m/s" }}
[[source]]
file = "{file}"
time = "t_UTC+2"
timezone = "+02:00"
stamp = "end"
signals.global_horizontal_irradiance = {{ column = "Rglob", unit = "W/m2" }}
signals.rain = {{ column = "precip", unit = "mm" }}
"""
# The stamps run through the night in which summer time begins: the clock keeps winter time.
_HOUSE = """\
name = "{name}"
[site]
latitude_deg = 50.5
longitude_deg = 3.7
[[source]]
file = "{file}"
time = "date"
time_format = "%Y/%m/%d %H:%M"
timezone = "+01:00"
signals.cabinet_temperature = {{ column = "T2", unit = "degC" }}
signals.cabinet_relative_humidity = {{ column = "RH_2", unit = "%" }}
signals.ambient_temperature = {{ column = "T_out", unit = "degC" }}
signals.ambient_relative_humidity = {{ column = "RH_out", unit = "%" }}
signals.wind_speed = {{ column = "Windspeed", unit = "m/s" }}
"""
RECORDS: dict[str, tuple[str, str]] = {
    "attic R2": ("attic_trh1_R2_hourly.csv.gz", _ATTIC),
    "attic R4": ("attic_trh1_R4_hourly.csv.gz", _ATTIC),
    "attic R7": ("attic_trh1_R7_hourly.csv.gz", _ATTIC),
    "house": ("house_uci_energy_10min.csv.gz", _HOUSE),
}
"""Name of a record -> its file and its case."""


def absent(name: str) -> str:
    """Why a record cannot be read; empty where it can."""
    file = RECORDS[name][0]
    return "" if (DATA / file).is_file() else f"../shared/data/{file} is not there"


def measured(name: str) -> Record:
    """A measured record as it is."""
    file, text = RECORDS[name]
    with tempfile.TemporaryDirectory() as directory:
        case = Path(directory) / "case.toml"
        case.write_text(text.format(name=name, file=(DATA / file).resolve()), encoding="utf-8")
        record = read_case(case)
    clocks = {
        one.signal: "loggers inside" if one.signal in INSIDE else "weather station" for one in record.series
    }
    record = record.replace_series(*(replace(one, source=clocks[one.signal]) for one in record.series))
    # The loggers inside may stop long before the weather station does.
    end = max(float(record[name].time[np.isfinite(record[name].value)][-1]) for name in INSIDE)
    return replace(record, until_s=record.start_s + IDENTIFIED * (end - record.start_s))


def _changed(one: Series, effect: str, **parameters: object) -> Series:
    time, value = inject(one.time, one.value, effect, **parameters)
    return replace(one, time=time, value=value)


def _clock_shift(record: Record, random: np.random.Generator) -> tuple[list[Series], dict[str, float]]:
    minutes = 60.0 * float(random.choice((-1.0, 1.0)))
    return [_changed(record[name], "clock_shift", minutes=minutes) for name in INSIDE], {"late_min": minutes}


def _humidity_drift(record: Record, random: np.random.Generator) -> tuple[list[Series], dict[str, float]]:
    one = record["cabinet_relative_humidity"]
    at_the_end = float(random.choice((-1.0, 1.0)) * random.uniform(0.08, 0.15))
    per_year = at_the_end * YEAR_S / float(one.time[-1] - one.time[0])
    given = {"offset_at_the_end": at_the_end, "per_year": per_year}
    return [_changed(one, "humidity_drift", per_year=per_year)], given


def _temperature_step(record: Record, random: np.random.Generator) -> tuple[list[Series], dict[str, float]]:
    assert record.until_s is not None
    kelvin = float(random.choice((-1.0, 1.0)) * random.uniform(2.0, 4.0))
    date = record.start_s + float(random.uniform(0.3, 0.7)) * (record.until_s - record.start_s)
    step = _changed(record["cabinet_temperature"], "temperature_step", kelvin=kelvin, date_s=date)
    return [step], {"offset_K": kelvin, "date_s": date}


def _sorption(record: Record, random: np.random.Generator) -> tuple[list[Series], dict[str, float]]:
    one, warm = record["cabinet_relative_humidity"], record["cabinet_temperature"]
    known = np.isfinite(warm.value)
    kelvin = np.interp(one.time, warm.time[known], warm.value[known])
    wanted = float(random.uniform(*SORPTION_G_M3))
    given = {
        "capacity_kg_m3": 0.05,
        "time_constant_h": float(random.uniform(5.0, 25.0)),
        "exchange_h": float(random.uniform(1.0, 3.0)),
    }
    # A house's humidity moves less than an attic's: the capacity follows from what it does to the readings.
    for _ in range(_SIZINGS):
        made = _changed(one, "sorption", kelvin=kelvin, **given)
        added = _added(record, record.replace_series(made))["added_absolute_humidity_g_m3"]
        given["capacity_kg_m3"] = min(given["capacity_kg_m3"] * wanted / added, MOST_CAPACITY_KG_M3)
    return [_changed(one, "sorption", kelvin=kelvin, **given)], given


_PUT_IN: dict[str, Callable[[Record, np.random.Generator], tuple[list[Series], dict[str, float]]]] = {
    "clock_shift": _clock_shift,
    "humidity_drift": _humidity_drift,
    "temperature_step": _temperature_step,
    "sorption": _sorption,
}


def injected(record: Record, effect: str, seed: int) -> tuple[Record, dict]:
    """The record with a known effect in the readings inside, and the account of it: size drawn from the
    seed."""
    random = np.random.default_rng([seed, list(_PUT_IN).index(effect), list(RECORDS).index(record.name)])
    series, parameters = _PUT_IN[effect](record, random)
    made = record.replace_series(*series)
    account = {"cause": CAUSE_OF[effect], "form": 0, "parameters": parameters, **_added(record, made)}
    return made, account


def _added(before: Record, after: Record) -> dict[str, float]:
    """Root mean square change of the readings about its mean: temperature [K], vapour at the told temperature
    [g/m3]."""
    time = before["cabinet_temperature"].time
    found = []
    for record in (before, after):
        kelvin, humidity = (np.interp(time, record[name].time, _filled(record[name])) for name in INSIDE)
        found.append((kelvin, 1e3 * humidity * concentration(saturation_pressure(kelvin), kelvin)))
    names = ("added_temperature_K", "added_absolute_humidity_g_m3")
    return {name: float(np.std(b - a)) for name, a, b in zip(names, *found, strict=True)}


def _filled(one: Series) -> np.ndarray:
    known = np.isfinite(one.value)
    return np.interp(one.time, one.time[known], one.value[known])
