"""The table of signals, the units that case files may use, and conversion to SI."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np

from hygrokf.errors import suggestion
from hygrokf.physics.holds import LINEAR, PREVIOUS
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K
from hygrokf.texts.record_codes import DoubtCode, RecordCode
from hygrokf.texts.statement import Statement


@dataclass(frozen=True)
class Unit:
    """A unit of a case file: SI value = factor * value + offset.

    name: as written in a case file.
    dimension: what the unit measures; a signal takes every unit of its own dimension.
    factor: [SI unit per unit].
    offset: [SI unit]; differences (accuracy, resolution) are scaled without it.
    """

    name: str
    dimension: str
    factor: float = 1.0
    offset: float = 0.0


LARGEST_FRACTION = 1.5
"""[-] largest plausible fraction: larger numbers are per cent, since no faulty sensor shows 150 % and no
climate stays at 1.5 % for long."""

UNITS: dict[str, Unit] = {
    unit.name: unit
    for unit in (
        Unit("K", "temperature"),
        Unit("degC", "temperature", 1.0, ZERO_CELSIUS_K),
        Unit("degF", "temperature", 5.0 / 9.0, ZERO_CELSIUS_K - 160.0 / 9.0),
        Unit("1", "fraction"),
        Unit("%", "fraction", 0.01),
        Unit("Pa", "pressure"),
        Unit("hPa", "pressure", 100.0),
        Unit("kPa", "pressure", 1000.0),
        Unit("W", "power"),
        Unit("kW", "power", 1e3),
        Unit("MW", "power", 1e6),
        Unit("kg/m3", "vapour density"),
        Unit("g/m3", "vapour density", 1e-3),
        Unit("m/s", "speed"),
        Unit("W/m2", "irradiance"),
        Unit("mm", "rain depth"),
        Unit("rad", "angle"),
        Unit("deg", "angle", math.pi / 180.0),
        Unit("rad/s", "rotational speed"),
        Unit("rpm", "rotational speed", math.pi / 30.0),
    )
}

_OTHER_SPELLINGS = {
    **dict.fromkeys(("°c", "c", "celsius", "degc", "gradc", "grdc", "ºc", "℃"), "degC"),
    **dict.fromkeys(("°f", "f", "degf"), "degF"),
    **dict.fromkeys(("kelvin", "k"), "K"),
    **dict.fromkeys(("percent", "pct", "prozent", "%rh", "%rf", "rh%", "%rel"), "%"),
    **dict.fromkeys(("-", "", "frac"), "1"),
    **dict.fromkeys(("g/m³", "g/m^3"), "g/m3"),
    **dict.fromkeys(("kg/m³", "kg/m^3"), "kg/m3"),
    **dict.fromkeys(("w/m²", "w/m^2", "wm2", "w/qm"), "W/m2"),
    **dict.fromkeys(("mps", "ms", "ms-1", "m/sec"), "m/s"),
    **dict.fromkeys(("1/min", "u/min", "rpm", "min-1", "umin"), "rpm"),
    **dict.fromkeys(("°", "deg", "grad"), "deg"),
    **{"mbar": "hPa", "hpa": "hPa", "pa": "Pa", "kw": "kW", "mw": "MW", "w": "W"},
}
"""Other spellings found in exports -> the name that a case file takes; used only for suggestions."""


HUMIDITIES = ("relative_humidity", "absolute_humidity", "dew_point_temperature")
"""Quantities of which each tells the vapour of a place, besides its temperature."""
SWITCHED = (
    "preheating", "heater_power", "heater_duty", "fan_duty", "pump_duty", "dehumidifier_duty", "door_open",
)  # fmt: skip
"""Signals that change only when something switches them."""


@dataclass(frozen=True)
class Signal:
    """One row of the table of signals.

    name: `place_quantity`.
    unit: SI unit in which a Record holds the signal.
    low, high: [SI unit] physical range; readings outside of it are masked.
    meaning: what the value stands for, whatever its hold.
    default_accuracy: [SI unit] 95 % accuracy assumed where the case file states none; None: none.
    display: unit used in messages and tables.
    idle: [SI unit] range in which unchanged readings are ordinary (calm, night, standstill,
        saturated air), so that the frozen-sensor check leaves them alone; None: nowhere.
    also: units of another dimension whose numbers are taken as they stand.
    hold: how the quantity itself goes on between two instants in a live source, where the next one is still
        to come: "linear", or "previous" for what jumps (power, speeds of machines, duties, flags), for rain
        and cloud cover, and for a direction, whose straight line may pass through all other directions.
    """

    name: str
    unit: str
    low: float
    high: float
    meaning: str
    default_accuracy: float | None = None
    display: str = ""
    idle: tuple[float, float] | None = None
    also: tuple[str, ...] = ()
    hold: str = LINEAR

    @property
    def hold_of_instants(self) -> str:
        """How instants of a table or of a `Series` continue unless that is stated."""
        return PREVIOUS if self.name in SWITCHED or self.dimension == "angle" else LINEAR

    @property
    def dimension(self) -> str:
        """Dimension of the signal, as in `UNITS`."""
        return UNITS[self.unit].dimension


_ALWAYS = (-math.inf, math.inf)
_WATER = "over liquid water, also below 0 °C"


def _temperature(name: str, low: float, high: float, meaning: str, accuracy: float | None = None) -> Signal:
    """Signal in kelvin from a range in degrees Celsius."""
    low, high = low + ZERO_CELSIUS_K, high + ZERO_CELSIUS_K
    return Signal(name, "K", low, high, meaning, accuracy, display="degC")


def _relative_humidity(name: str, meaning: str, accuracy: float | None = None) -> Signal:
    """Relative humidity: exactly 0 is a dead sensor, up to 105 % is a saturated one."""
    meaning = f"{meaning}, {_WATER}"
    return Signal(name, "1", 0.005, 1.05, meaning, accuracy, display="%", idle=(0.97, 1.05))


def _vapour_density(name: str, meaning: str) -> Signal:
    return Signal(name, "kg/m3", 0.0, 0.3, meaning, display="g/m3")


def _irradiance(name: str, meaning: str) -> Signal:
    """Irradiance: pyranometers show a few W/m2 below zero at night."""
    return Signal(name, "W/m2", -20.0, 1600.0, meaning, display="W/m2", idle=(-20.0, 5.0))


def _duty(name: str, meaning: str) -> Signal:
    return Signal(name, "1", 0.0, 1.0, meaning, display="1", idle=_ALWAYS, hold=PREVIOUS)


def _power(name: str, low: float, high: float, idle_high: float, meaning: str) -> Signal:
    return Signal(name, "W", low, high, meaning, display="kW", idle=(-math.inf, idle_high), hold=PREVIOUS)


def _speed(name: str, low: float, high: float, idle_high: float) -> Signal:
    """Speed of a machine; its name is its meaning."""
    part = name.removesuffix("_speed")
    return Signal(name, "rad/s", low, high, part, display="rpm", idle=(low, idle_high), hold=PREVIOUS)


_TURN = 2.0 * math.pi
_ROWS = (
    _temperature("cabinet_temperature", -60, 120, "air in the cabinet", 0.3),
    _relative_humidity("cabinet_relative_humidity", "air in the cabinet at its own temperature", 0.02),
    _vapour_density("cabinet_absolute_humidity", "vapour mass per volume of the air in the cabinet"),
    _temperature("cabinet_dew_point_temperature", -80, 100, f"dew point of the cabinet air, {_WATER}"),
    _temperature("cabinet_wall_temperature", -60, 120, "inner face of the cabinet wall"),
    _temperature("converter_temperature", -60, 200, "power semiconductors or their heat sink"),
    _temperature("coolant_temperature", -60, 150, "liquid coolant entering the converter"),
    _temperature("ambient_temperature", -80, 60, "outside air in the shade"),
    _relative_humidity("ambient_relative_humidity", "outside air at ambient_temperature"),
    _vapour_density("ambient_absolute_humidity", "vapour mass per volume of outside air"),
    _temperature("ambient_dew_point_temperature", -80, 50, f"dew point of the outside air, {_WATER}"),
    Signal("ambient_pressure", "Pa", 3e4, 1.1e5, "air pressure at the site", display="hPa"),
    _temperature("nacelle_temperature", -60, 100, "air in the nacelle around the cabinet"),
    _relative_humidity("nacelle_relative_humidity", "air in the nacelle"),
    _temperature("tower_temperature", -60, 100, "air in the tower base around the cabinet"),
    _relative_humidity("tower_relative_humidity", "air in the tower base"),
    _power("active_power", -5e6, 3e7, 2e4, "power fed into the grid; consumption is negative"),
    _power("heater_power", 0.0, 1e5, 1.0, "electric power of the cabinet's heater"),
    _power("auxiliary_power", -1e6, 5e6, 1e3, "own consumption of the turbine, positive"),
    _speed("rotor_speed", -1.0, 15.0, 0.05),
    _speed("generator_speed", -50.0, 500.0, 1.0),
    Signal("wind_speed", "m/s", 0.0, 75.0, "at hub height", display="m/s", idle=(0.0, 0.5)),
    Signal(
        "wind_direction", "rad", -_TURN, _TURN, "where the wind comes from, clockwise from north",
        display="deg", idle=_ALWAYS, hold=PREVIOUS,
    ),
    _irradiance("global_horizontal_irradiance", "sun and sky on a horizontal plane"),
    _irradiance("diffuse_horizontal_irradiance", "sky alone on a horizontal plane"),
    _irradiance("direct_normal_irradiance", "sun alone on a plane that faces it"),
    Signal(
        "rain", "1", 0.0, 500.0,
        "0 = dry, above = wet: a flag, a share of the interval, or the depth in mm fallen in the reading's "
        "interval (taken as a plain number)",
        display="1", idle=_ALWAYS, also=("mm",), hold=PREVIOUS,
    ),
    _duty("cloud_cover", "share of the sky that is covered"),
    _duty("preheating", "1 while the cabinet is heated before start-up, 0 else"),
    _duty("heater_duty", "share of the time that the cabinet's heater runs"),
    _duty("fan_duty", "share of the time (or of full speed) that the cabinet's fan runs"),
    _duty("pump_duty", "share of the time (or of full speed) that the coolant pump runs"),
    _duty("dehumidifier_duty", "share of the time that the cabinet's dehumidifier runs"),
    _duty("door_open", "1 while the cabinet's door is open, 0 else"),
)  # fmt: skip
SIGNALS: dict[str, Signal] = {row.name: row for row in _ROWS}


def signal_named(name: str | Signal) -> Signal:
    """Row of the signal table.

    name: a signal, or already its row. Raises KeyError, with near names, where the table has no such signal.
    """
    if isinstance(name, Signal):
        return name
    if name not in SIGNALS:
        raise KeyError(f'unknown signal "{name}"{suggestion(name, SIGNALS)}')
    return SIGNALS[name]


def fitting_units(signal: str | Signal) -> tuple[str, ...]:
    """Names of the units that a case file may give for a signal."""
    row = signal_named(signal)
    of_dimension = tuple(unit.name for unit in UNITS.values() if unit.dimension == row.dimension)
    return of_dimension + row.also


def unit_fault(unit: str, signal: str | Signal) -> str | None:
    """The fault of a unit for a signal in one sentence, or None if the unit fits.

    unit: as written in the case file. signal: a signal of the table, or its name.
    """
    row = signal_named(signal)
    choices = fitting_units(row)
    if unit in choices:
        return None
    choice = ", ".join(choices)
    if unit not in UNITS:
        unit_known = unit_named(unit)
        hint = f'; did you mean "{unit_known}"?' if unit_known in choices else suggestion(unit, choices)
        return f'unknown unit "{unit}" for {row.name}; units that fit: {choice}{hint}'
    return (
        f'unit "{unit}" is one of {UNITS[unit].dimension}, but {row.name} is '
        f"a {row.dimension}; units that fit: {choice}"
    )


def _fitting(unit: str, signal: str | Signal) -> Unit:
    fault = unit_fault(unit, signal)
    if fault is not None:
        raise ValueError(fault)
    return UNITS[unit]


def to_si(values: np.ndarray, unit: str, signal: str | Signal) -> np.ndarray:
    """Values in the SI unit of the signal.

    values: [unit] any shape; NaN stays NaN.
    unit: one of `fitting_units(signal)`.
    signal: a signal of the table, or its name.

    SI = factor * values + offset (rain in mm is taken as a plain number).
    Raises ValueError, with the units that fit, for an unknown unit or one of another dimension.
    """
    row = _fitting(unit, signal)
    return row.factor * np.asarray(values, dtype=float) + row.offset


def unit_named(text: str) -> str | None:
    """The name in `UNITS` of a unit as it is written in exports ("°C", "% RH", "W/m²"); None if unknown."""
    name = text.strip()
    return name if name in UNITS else _OTHER_SPELLINGS.get(re.sub(r"[\s_.]", "", name.lower()))


def from_si(values: np.ndarray | float, unit: str, signal: str | Signal) -> np.ndarray:
    """Values in a unit, from the SI unit of the signal: the inverse of `to_si`.

    values: [SI unit] any shape. unit, signal: as for `to_si`, and the same errors.
    """
    row = _fitting(unit, signal)
    return (np.asarray(values, dtype=float) - row.offset) / row.factor


def difference_to_si(difference: float, unit: str, signal: str | Signal) -> float:
    """Difference (accuracy, resolution) in the SI unit of the signal: scaled, not shifted.

    difference: [unit]. unit, signal: as for `to_si`, and the same errors.
    """
    return _fitting(unit, signal).factor * float(difference)


def difference_from_si(difference: float, unit: str, signal: str | Signal) -> float:
    """Difference in a unit, from the SI unit of the signal: the inverse of `difference_to_si`."""
    return float(difference) / _fitting(unit, signal).factor


def share_in_range(values: np.ndarray, unit: str, signal: str | Signal) -> float:
    """Share of readings within the signal's physical range if their unit is `unit` [-].

    values: [unit] (N,) finite, N > 0. unit, signal: as for `to_si`, and the same errors.
    """
    row = signal_named(signal)
    converted = to_si(values, unit, row)
    return float(np.mean((converted >= row.low) & (converted <= row.high)))


def better_units(values: np.ndarray, unit: str, signal: str | Signal) -> list[str]:
    """Other units in which more than half of the readings would lie in the signal's physical range.

    values: [unit] (N,) finite, N > 0. unit, signal: as for `to_si`, and the same errors.
    """
    row = signal_named(signal)
    others = [other for other in fitting_units(row) if other != unit]
    return [other for other in others if share_in_range(values, other, row) > 0.5]


def unit_mistaken(values: np.ndarray, unit: str, signal: str | Signal) -> Statement | None:
    """The reason why readings cannot be in the stated unit; None if they can.

    values: [unit] (N,); NaN = missing. unit, signal: as for `to_si`, and the same errors.

    Fractions labelled as per cent, and the reverse, are recognised by the largest readings; otherwise most
    readings must lie in the signal's physical range.
    """
    row = signal_named(signal)
    finite = values[np.isfinite(values)]
    if not len(finite):
        return None
    if row.dimension == "fraction" and not row.also:
        plausible = finite[(finite >= 0.0) & (finite <= 110.0)]
        high = float(np.quantile(plausible, 0.995)) if len(plausible) else math.nan
        if unit == "%" and 0.0 < high <= LARGEST_FRACTION:
            return DoubtCode.CALLED_PER_CENT(signal=row.name, high=high)
        if unit == "1" and high > LARGEST_FRACTION:
            return DoubtCode.CALLED_FRACTION(signal=row.name, high=high)
    share = share_in_range(finite, unit, row)
    median = float(np.median(finite))
    if row.name == "ambient_temperature" and unit == "degC" and share > 0.5 and median > 45.0:
        return DoubtCode.HOTTER_THAN_CLIMATES(signal=row.name, median=median)
    if share >= 0.5:
        return None
    better = better_units(finite, unit, row)
    if share > 0.0 and not better:
        return None
    return DoubtCode.WRONG_UNIT(
        signal=row.name, unit=unit, median=median, low=in_words(row.low, row), high=in_words(row.high, row),
        hint=(RecordCode.WOULD_FIT(units=tuple(better)),) if better else (),
    )  # fmt: skip


def in_words(value: float, signal: str | Signal) -> str:
    """A value with the unit that messages show, such as "-273.0 degC".

    value: [SI unit]. signal: a signal of the table, or its name.
    """
    row = signal_named(signal)
    shown = float(from_si(value, row.display, row))
    return f"{shown:.4g}" if row.display == "1" else f"{shown:.4g} {row.display}"
