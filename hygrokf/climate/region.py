"""A region: its weather files, and the weather and power that drive its cabinets."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from hygrokf.cases.case_file import read_case
from hygrokf.climate.power import (
    PowerCurve,
    PowerFault,
    covers,
    power_by_season,
    power_from_wind,
    standstill,
    years_of_power,
)
from hygrokf.data.actuators import ACTUATORS
from hygrokf.data.ambient import AMBIENT_BRIDGE_H, at_times, bridge_h
from hygrokf.data.input_paths import input_path
from hygrokf.data.record import Record, Series
from hygrokf.data.timestamps import HOUR_S
from hygrokf.identification.fit import Fit
from hygrokf.weather.reading import TYPICAL, form_of, read_weather

DUTIES = ("preheating", *ACTUATORS)
"""Signals of what is switched in a cabinet; they go with the power."""
TYPICAL_YEAR = 2001
"""Calendar year in which a typical year, whose months are from several years, is placed; without 29
February."""


@dataclass(frozen=True)
class Region:
    """Weather of one place under its name, as a record; `files` that it was read from."""

    name: str
    weather: Record
    files: tuple[str, ...] = ()


def read_region(
    name: str, files: Sequence[str | os.PathLike[str]], power: Record | PowerCurve | None = None
) -> Region:
    """The weather of one region: weather files, put after each other, or one case file with ambient
    signals.

    A typical year is placed in `TYPICAL_YEAR`; with a record of `power` it is repeated once for each year of
    power, so that every one is used.  Raises PowerFault, CaseFault, TableFault.
    """
    paths = [Path(one) for one in files]
    cases = [one.name for one in paths if one.suffix == ".toml"]
    if cases and len(paths) > 1:
        raise PowerFault(
            f"{name}: expected weather files, or one case file (.toml) alone, found "
            f"{', '.join(one.name for one in paths)}"
        )
    if cases:
        weather = read_case(paths[0], cabinet=False)
    else:
        typical = len(paths) == 1 and form_of(paths[0]) in TYPICAL
        years = years_of_power(power["active_power"]) if typical and isinstance(power, Record) else 1
        weather = read_weather(paths, year=TYPICAL_YEAR if typical else None, years=years)
        if years > 1:
            said = (
                f"the typical year is repeated {years} times, once for each year of power: between_years and "
                "the bounds describe years that differ in their power, not in their weather"
            )
            weather = replace(weather, warnings=(*weather.warnings, said))
    return Region(name, weather, tuple(one.name for one in paths))


def read_power(path: str | os.PathLike[str]) -> Record:
    """The record of a case file that has active power; of other signals pre-heating and logged actuators are
    kept.

    Raises CaseFault, PowerFault.
    """
    record = read_case(path, cabinet=False, ambient=False)
    if "active_power" not in record:
        raise PowerFault(
            f"{path}: expected a case file with signals.active_power, found {', '.join(record.signals)}"
        )
    return replace(record, series=tuple(record[name] for name in ("active_power", *DUTIES) if name in record))


def driven(fit: Fit, weather: Record, power: Record | PowerCurve | None) -> tuple[Record, list[str]]:
    """Weather and power as a record for a fit's model, and statements on how they were combined.

    `power`: a record of it, a power curve, or None for standstill all year.  The record's pre-heating and
    actuators are used where its power is taken hour by hour; else they are off.  Power, cabinet and
    actuators in the weather's own record are ignored.  Raises PowerFault where there is no usable power.
    """
    said = []
    kept = [s for s in weather.series if not s.signal.startswith(("cabinet_", "active_power", *DUTIES))]
    series: list[Series] = []
    if fit.design.power_scale_W is None:
        said.append("the model has no power input: the whole year counts as standstill")
    elif power is None:
        series.append(standstill(weather))
        said.append("the turbine stands still all year: there is no power at any time")
    else:
        if isinstance(power, PowerCurve):
            taken, words = power_from_wind(power, weather), power.words()
        else:
            taken, words = power_by_season(power["active_power"], weather)
        series.append(taken)
        said += [words, *_scale_words(fit, power.rated_power_W)]
    for name in DUTIES:
        if name in fit.design.model.inputs:
            duty, words = _duty(name, weather, power if isinstance(power, Record) else None)
            series.append(duty)
            said.append(words)
    return replace(weather, series=(*map(_hourly, kept), *series), until_s=None), said


def _duty(name: str, weather: Record, power: Record | None) -> tuple[Series, str]:
    """The course of pre-heating or of an actuator over a weather record, and a statement on its source."""
    words = name.replace("preheating", "pre-heating")
    if power is not None and name in power and covers(power["active_power"], weather):
        if covers(power[name], weather):
            return power[name], f"{words} follows the record of the power, hour by hour"
    why = (
        "no record shows when it is on"
        if power is None or name not in power
        else ("the record of the power does not cover the weather's time")
    )
    off = replace(standstill(weather), signal=name, source="off")
    return off, f"{words} is off all year: {why}"


def _scale_words(fit: Fit, rated_W: float | None) -> list[str]:
    """A statement where the rated power of the power's turbine differs from that of the fit."""
    scale = fit.design.power_scale_W
    if rated_W is None or scale is None or abs(rated_W / scale - 1.0) < 0.1:
        return []
    return [
        f"the turbine of the power is rated {rated_W / 1e3:.0f} kW, that of the fit {scale / 1e3:.0f} kW: "
        "the heat release is that of the same power in kW"
    ]


def _hourly(series: Series) -> Series:
    """Weather that is rarer than hourly, interpolated linearly to hours, so that statistics are hourly."""
    middle = input_path(series)
    steps = series.steps_s
    if not len(steps) or steps[len(steps) // 2] <= 1.01 * HOUR_S:
        return series
    import numpy as np

    time = np.arange(np.ceil(middle.time[0] / HOUR_S), np.floor(middle.time[-1] / HOUR_S) + 1.0) * HOUR_S
    return replace(middle, time=time, value=at_times(middle, time, bridge_h(middle, AMBIENT_BRIDGE_H)))
