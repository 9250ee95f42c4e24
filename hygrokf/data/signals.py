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
    """A unit that case files may use: SI value = factor * value + offset.

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
"""Quantities each of which, together with the temperature, gives the vapour of a place."""
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
    idle: [SI unit] range in which unchanged readings are ordinary (calm, night, standstill, saturated air),
        so that the frozen-sensor check leaves them alone; None: nowhere.
    also: units of another dimension whose numbers are taken as they stand.
    hold: how a live source continues after its latest instant: "linear", or "previous" for what jumps (power,
        speeds of machines, duties, flags), for rain and cloud cover, and for a direction, whose straight line
        may pass through all other directions.
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
        """How instants of a table or of a `Series` continue unless a hold is stated."""
        return PREVIOUS if self.name in SWITCHED or self.dimension == "angle" else LINEAR

    @property
    def dimension(self) -> str:
        """Dimension of the signal, as in `UNITS`."""
        return UNITS[self.unit].dimension


_ALWAYS = (-math.inf, math.inf)
_WATER = "over liquid water, also below 0 °C"


def _temperature(
    name: str, lowest: float, highest: float, meaning: str, accuracy: float | None = None
) -> Signal:
    """Return the row of a temperature, with its range in degrees Celsius."""
    lowest, highest = lowest + ZERO_CELSIUS_K, highest + ZERO_CELSIUS_K
    return Signal(name, "K", lowest, highest, meaning, accuracy, display="degC")


def _relative_humidity(name: str, meaning: str, accuracy: float | None = None) -> Signal:
    """Return the row of a relative humidity; exactly 0 is a dead sensor, up to 1.05 a saturated one."""
    meaning = f"{meaning}, {_WATER}"
    return Signal(name, "1", 0.005, 1.05, meaning, accuracy, display="%", idle=(0.97, 1.05))


def _vapour_density(name: str, meaning: str) -> Signal:
    """Return the row of a vapour concentration."""
    return Signal(name, "kg/m3", 0.0, 0.3, meaning, display="g/m3")


def _irradiance(name: str, meaning: str) -> Signal:
    """Return the row of an irradiance; pyranometers show a few W/m2 below zero at night."""
    return Signal(name, "W/m2", -20.0, 1600.0, meaning, display="W/m2", idle=(-20.0, 5.0))


def _duty(name: str, meaning: str) -> Signal:
    """Return the row of a duty, a share or a flag between 0 and 1."""
    return Signal(name, "1", 0.0, 1.0, meaning, display="1", idle=_ALWAYS, hold=PREVIOUS)


def _power(name: str, low: float, high: float, idle_high: float, meaning: str) -> Signal:
    """Return the row of a power; unchanged readings are ordinary up to `idle_high`."""
    return Signal(name, "W", low, high, meaning, display="kW", idle=(-math.inf, idle_high), hold=PREVIOUS)


def _speed(name: str, low: float, high: float, idle_high: float) -> Signal:
    """Return the row of the speed of a machine."""
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
    """Return the row of a signal in the signal table.

    name: of the signal, or already its row.  Raises KeyError, with similar names, for an unknown one.
    """
    if isinstance(name, Signal):
        return name
    if name not in SIGNALS:
        raise KeyError(f'unknown signal "{name}"{suggestion(name, SIGNALS)}')
    return SIGNALS[name]


def fitting_units(signal: str | Signal) -> tuple[str, ...]:
    """Return the names of the units that a case file may give for a signal."""
    signal_row = signal_named(signal)
    of_dimension = tuple(unit.name for unit in UNITS.values() if unit.dimension == signal_row.dimension)
    return of_dimension + signal_row.also


def unit_fault(unit: str, signal: str | Signal) -> str | None:
    """Return the fault of a unit for a signal in one sentence; None if the unit fits.

    unit: as written in the case file.  signal: of the signal table, or its name.
    """
    signal_row = signal_named(signal)
    units = fitting_units(signal_row)
    if unit in units:
        return None
    listed_units = ", ".join(units)
    if unit not in UNITS:
        unit_known = unit_named(unit)
        hint = f'; did you mean "{unit_known}"?' if unit_known in units else suggestion(unit, units)
        return f'unknown unit "{unit}" for {signal_row.name}; units that fit: {listed_units}{hint}'
    return (
        f'unit "{unit}" is one of {UNITS[unit].dimension}, but {signal_row.name} is '
        f"a {signal_row.dimension}; units that fit: {listed_units}"
    )


def _fitting(unit: str, signal: str | Signal) -> Unit:
    """Return a unit that fits a signal.  Raises ValueError for any other."""
    fault = unit_fault(unit, signal)
    if fault is not None:
        raise ValueError(fault)
    return UNITS[unit]


def to_si(values: np.ndarray, unit: str, signal: str | Signal) -> np.ndarray:
    """Convert values to the SI unit of a signal: factor * value + offset.

    values: [unit] any shape; NaN stays NaN.
    unit: one of `fitting_units(signal)`; rain in mm is taken as a plain number.
    signal: of the signal table, or its name.
    Raises ValueError, with the units that fit, for an unknown unit or one of another dimension.
    """
    unit_row = _fitting(unit, signal)
    return unit_row.factor * np.asarray(values, dtype=float) + unit_row.offset


def unit_named(text: str) -> str | None:
    """Return the name in `UNITS` of a unit as exports write it ("°C", "% RH", "W/m²"); None if unknown."""
    name = text.strip()
    return name if name in UNITS else _OTHER_SPELLINGS.get(re.sub(r"[\s_.]", "", name.lower()))


def from_si(values: np.ndarray | float, unit: str, signal: str | Signal) -> np.ndarray:
    """Convert values from the SI unit of a signal to another unit: the inverse of `to_si`.

    values: [SI unit] any shape.  unit, signal: as for `to_si`, and the same errors.
    """
    unit_row = _fitting(unit, signal)
    return (np.asarray(values, dtype=float) - unit_row.offset) / unit_row.factor


def difference_to_si(difference: float, unit: str, signal: str | Signal) -> float:
    """Convert a difference (accuracy, resolution) to the SI unit of a signal: scaled, not shifted.

    difference: [unit].  unit, signal: as for `to_si`, and the same errors.
    """
    return _fitting(unit, signal).factor * float(difference)


def difference_from_si(difference: float, unit: str, signal: str | Signal) -> float:
    """Convert a difference from the SI unit of a signal to another unit: the inverse of
    `difference_to_si`."""
    return float(difference) / _fitting(unit, signal).factor


def share_in_range(values: np.ndarray, unit: str, signal: str | Signal) -> float:
    """Return the share [1] of readings that lie in the signal's physical range if their unit is `unit`.

    values: [unit] (N,) finite, N > 0.  unit, signal: as for `to_si`, and the same errors.
    """
    signal_row = signal_named(signal)
    converted = to_si(values, unit, signal_row)
    return float(np.mean((converted >= signal_row.low) & (converted <= signal_row.high)))


def better_units(values: np.ndarray, unit: str, signal: str | Signal) -> list[str]:
    """Return the other units in which more than half of the readings would lie in the signal's physical
    range.

    values: [unit] (N,) finite, N > 0.  unit, signal: as for `to_si`, and the same errors.
    """
    signal_row = signal_named(signal)
    other_units = [other for other in fitting_units(signal_row) if other != unit]
    return [other for other in other_units if share_in_range(values, other, signal_row) > 0.5]


def unit_mistaken(values: np.ndarray, unit: str, signal: str | Signal) -> Statement | None:
    """Return the reason why readings cannot be in the stated unit; None if they can.

    values: [unit] (N,); NaN = missing.  unit, signal: as for `to_si`, and the same errors.

    Fractions labelled as per cent, and the reverse, are recognised by the largest readings; otherwise most
    readings must lie in the signal's physical range.
    """
    signal_row = signal_named(signal)
    finite_values = values[np.isfinite(values)]
    if not len(finite_values):
        return None
    if signal_row.dimension == "fraction" and not signal_row.also:
        plausible = finite_values[(finite_values >= 0.0) & (finite_values <= 110.0)]
        highest = float(np.quantile(plausible, 0.995)) if len(plausible) else math.nan
        if unit == "%" and 0.0 < highest <= LARGEST_FRACTION:
            return DoubtCode.CALLED_PER_CENT(signal=signal_row.name, high=highest)
        if unit == "1" and highest > LARGEST_FRACTION:
            return DoubtCode.CALLED_FRACTION(signal=signal_row.name, high=highest)
    share_inside = share_in_range(finite_values, unit, signal_row)
    median = float(np.median(finite_values))
    if signal_row.name == "ambient_temperature" and unit == "degC" and share_inside > 0.5 and median > 45.0:
        return DoubtCode.HOTTER_THAN_CLIMATES(signal=signal_row.name, median=median)
    if share_inside >= 0.5:
        return None
    better_fitting = better_units(finite_values, unit, signal_row)
    if share_inside > 0.0 and not better_fitting:
        return None
    return DoubtCode.WRONG_UNIT(
        signal=signal_row.name,
        unit=unit,
        median=median,
        low=in_words(signal_row.low, signal_row),
        high=in_words(signal_row.high, signal_row),
        hint=(RecordCode.WOULD_FIT(units=tuple(better_fitting)),) if better_fitting else (),
    )


def in_words(value: float, signal: str | Signal) -> str:
    """Return a value with the unit that messages show, such as "-273.0 degC".

    value: [SI unit].  signal: of the signal table, or its name.
    """
    signal_row = signal_named(signal)
    shown = float(from_si(value, signal_row.display, signal_row))
    return f"{shown:.4g}" if signal_row.display == "1" else f"{shown:.4g} {signal_row.display}"
