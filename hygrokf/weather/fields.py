"""Convert the fields of a reanalysis at one point to series: names, units, means of sums, wind."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from hygrokf.data.columns import TableFault
from hygrokf.data.record import Record, Series, Site
from hygrokf.data.signals import Signal, from_si, signal_named
from hygrokf.data.timestamps import DAY_S, HOUR_S, duration_text, modal_step
from hygrokf.physics.psychrometrics import ZERO_CELSIUS_K
from hygrokf.weather.altitude import GRAVITY

NO_HUMIDITY = (
    "no dew point (d2m, 2m_dewpoint_temperature): this weather has no humidity; ask for it in the request"
)


@dataclass(frozen=True)
class Field:
    """One field at one point: values (T,) and the unit that the file states, or None."""

    value: np.ndarray
    unit: str | None = None


@dataclass(frozen=True)
class PointFields:
    """Fields of a reanalysis at one point, as in the file.

    file: its name. time: [s] (T,) since 1970-01-01T00:00Z, in any order, repeats allowed. fields: name in the
        file -> field.
    latitude_deg, longitude_deg: of the point, or None. altitude_m: [m] height of its ground, or None.
    place: the point in words. warnings: choices and omissions of the reader.
    """

    file: str
    time: np.ndarray
    fields: Mapping[str, Field]
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    altitude_m: float | None = None
    place: str = ""
    warnings: tuple[str, ...] = field(default=())


NAMES: dict[str, tuple[str, ...]] = {
    "t2m": ("t2m", "2m_temperature", "2t", "t_2m", "VAR_2T"),
    "d2m": ("d2m", "2m_dewpoint_temperature", "2d", "d_2m", "VAR_2D"),
    "sp": ("sp", "surface_pressure", "surf_pres"),
    "u10": ("u10", "u_10", "10m_u_component_of_wind", "10u", "VAR_10U"),
    "v10": ("v10", "v_10", "10m_v_component_of_wind", "10v", "VAR_10V"),
    "u100": ("u100", "u_100", "100m_u_component_of_wind", "100u", "VAR_100U"),
    "v100": ("v100", "v_100", "100m_v_component_of_wind", "100v", "VAR_100V"),
    "ssrd": ("ssrd", "surface_solar_radiation_downwards"),
    "fdir": ("fdir", "total_sky_direct_solar_radiation_at_surface"),
    "avg_sdswrf": ("avg_sdswrf", "msdwswrf", "mean_surface_downward_short_wave_radiation_flux"),
    "tp": ("tp", "total_precipitation"),
    "tcc": ("tcc", "total_cloud_cover"),
    "z": ("z", "geopotential", "geopotential_at_surface"),
}
"""Short name of a field of ERA5 -> all names in use."""

_UNITS: dict[str, dict[str, tuple[float, float]]] = {
    "temperature": {
        **dict.fromkeys(("K", "kelvin"), (1.0, 0.0)),
        **dict.fromkeys(
            ("degC", "°C", "C", "celsius", "degree_Celsius", "degrees_celsius"), (1.0, ZERO_CELSIUS_K)
        ),
    },
    "pressure": {"Pa": (1.0, 0.0), "hPa": (100.0, 0.0), "mbar": (100.0, 0.0), "kPa": (1000.0, 0.0)},
    "speed": {
        "m s**-1": (1.0, 0.0), "m s-1": (1.0, 0.0), "m/s": (1.0, 0.0), "m s^-1": (1.0, 0.0),
        "km/h": (1 / 3.6, 0.0), "km h**-1": (1 / 3.6, 0.0), "km h-1": (1 / 3.6, 0.0),
    },
    "radiation": {
        "J m**-2": (1 / HOUR_S, 0.0), "J m-2": (1 / HOUR_S, 0.0), "J/m2": (1 / HOUR_S, 0.0),
        "J m^-2": (1 / HOUR_S, 0.0), "Wh m**-2": (1.0, 0.0), "Wh/m2": (1.0, 0.0),
        "W m**-2": (1.0, 0.0), "W m-2": (1.0, 0.0), "W/m2": (1.0, 0.0), "W m^-2": (1.0, 0.0),
    },
    "depth": {"m": (1000.0, 0.0), "mm": (1.0, 0.0), "kg m**-2": (1.0, 0.0), "kg m-2": (1.0, 0.0)},
    "share": {
        "(0 - 1)": (1.0, 0.0), "1": (1.0, 0.0), "%": (0.01, 0.0), "dimensionless": (1.0, 0.0), "": (1.0, 0.0)
    },
    "geopotential": {"m**2 s**-2": (1 / GRAVITY, 0.0), "m2 s-2": (1 / GRAVITY, 0.0), "m": (1.0, 0.0)},
}  # fmt: skip
"""Kind of field -> unit in the file -> (factor, offset) to K, Pa, m/s, W/m² over the hour, mm, 1, m."""

_KINDS = {
    "t2m": "temperature", "d2m": "temperature", "sp": "pressure", "u10": "speed", "v10": "speed",
    "u100": "speed",
    "v100": "speed", "ssrd": "radiation", "fdir": "radiation", "avg_sdswrf": "radiation", "tp": "depth",
    "tcc": "share",
    "z": "geopotential",
}  # fmt: skip
_OWN_UNIT = {
    "temperature": "K", "pressure": "Pa", "speed": "m s**-1", "radiation": "J m**-2", "depth": "m",
    "share": "1",
    "geopotential": "m**2 s**-2",
}  # fmt: skip
_ACCUMULATED = ("ssrd", "fdir", "tp")


def short_name(name: str) -> str | None:
    """Short name of a field of ERA5, such as "t2m" for "2m_temperature"; None for an unused field."""
    for short, names in NAMES.items():
        if name in names or name.lower() in names:
            return short
    return None


def altitude_of(value: np.ndarray, unit: str | None) -> float | None:
    """Height of the reanalysis' ground [m] from its geopotential, or None."""
    finite = np.asarray(value, dtype=float).ravel()
    finite = finite[np.isfinite(finite)]
    factor, _ = _UNITS["geopotential"].get(unit or "m**2 s**-2", (math.nan, 0.0))
    height = factor * float(np.median(finite)) if len(finite) else math.nan
    return height if -500.0 <= height <= 9000.0 else None


def point_record(points: PointFields, sha256: str = "", *, temperature: bool = True) -> Record:
    """Record of the fields at a point: SI units, each series with the hold of its field.

    points: the fields. sha256: of the file. temperature: whether the fields must include a temperature.

    Temperature, dew point, pressure, wind and cloud are instants.  Radiation and rain are sums over the hour
    that ends at the stamp: radiation becomes the mean of that hour, J/m² / 3600 s, and both hold over it.
    Sums since midnight, as in ERA5-Land, are recognised and made hourly sums first.  Diffuse radiation is
    global minus direct radiation, both on a horizontal plane.  Wind at 100 m is preferred; wind at 10 m
    gives a warning.

    Raises TableFault with every fault: an unknown unit, values impossible in their unit, no temperature.
    """
    given = {short: (name, one) for name, one in points.fields.items() if (short := short_name(name))}
    if temperature and "t2m" not in given:
        raise TableFault(
            f"no 2 m temperature (t2m, 2m_temperature); found {', '.join(points.fields) or 'no field'}: "
            "ask for it in the request"
        )
    if not len(points.time):
        raise TableFault("has no hour in it: fetch it again")
    order = np.argsort(points.time, kind="stable")
    time = points.time[order]
    fresh = np.append(True, np.diff(time) > 0.0)
    made = _Making(points, given, time[fresh], [], list(points.warnings))
    if not fresh.all():
        made.warnings.append(f"{int((~fresh).sum())} stamps occur more than once; the first of each kept")
    value = _values(made, order[fresh])
    series = _instants(made, value) + _sums(made, value) + _wind(made, value)
    if made.faults:
        raise TableFault(*made.faults)
    if temperature and "d2m" not in value:
        made.warnings.append(NO_HUMIDITY)
    if {"t2m", "d2m"} <= set(value):
        made.warnings += saturation_doubt(value["t2m"], value["d2m"])
    found = tuple(one for one in series if one is not None)
    return Record(
        points.file, found, _site(points), warnings=tuple(made.warnings),
        provenance=((points.file, sha256),),
    )  # fmt: skip


def impossible_range(value: np.ndarray, row: Signal) -> str:
    """A fault in words where finite readings (T,) [SI unit] leave the range of their signal, else empty."""
    low, high = np.quantile(value, [0.02, 0.98])
    if row.low <= low and high <= row.high:
        return ""
    unit = "" if row.display == "1" else f" {row.display}"
    low, high = from_si(np.array([low, high]), row.display, row)
    return f"{row.name} would lie at {low:.4g} … {high:.4g}{unit}, which is impossible"


@dataclass
class _Making:
    """A record in the making: fields by short name, times (T,) [s], faults and warnings."""

    points: PointFields
    given: Mapping[str, tuple[str, Field]]
    time: np.ndarray
    faults: list[str]
    warnings: list[str]

    def series(
        self,
        signal: str,
        number: np.ndarray,
        shorts: str,
        interval_s: float = 0.0,
        height_m: float | None = None,
    ) -> Series | None:
        """The series of values (T,) from the fields `shorts`; None without a value or with a fault."""
        row = signal_named(signal)
        names = " and ".join(self.given[short][0] for short in shorts.split())
        finite = number[np.isfinite(number)]
        if not len(finite):
            self.warnings.append(f"{names}: no value at this point, {signal} is left out")
            return None
        if beyond := impossible_range(finite, row):
            remedy = f"the file states {_stated(self.given, shorts)}; correct it or fetch the file again"
            self.faults.append(f"{names}: {beyond}: {remedy}")
            return None
        points = self.points
        source = f'{points.file}, column "{names}"' + (f" at {points.place}" if points.place else "")
        return Series(signal, self.time, number, interval_s=interval_s, source=source, height_m=height_m)


def _values(made: _Making, places: np.ndarray) -> dict[str, np.ndarray]:
    """Values (T,) of each field at some rows of the file, in units of `_UNITS`; sums are over one hour."""
    value: dict[str, np.ndarray] = {}
    for short, (name, one) in made.given.items():
        if short != "z":
            raw = np.asarray(one.value, dtype=float)[places]
            endless = np.isinf(raw)
            if endless.any():
                made.warnings.append(f"{name}: {int(endless.sum())} values are infinite, taken as missing")
            value[short] = _converted(short, name, np.where(endless, np.nan, raw), one.unit, made.faults)
            made.faults += _power_for_energy(short, name, one.unit, made.time, value[short])
    daily = {one: _since_midnight(made.time, value[one]) for one in _ACCUMULATED if one in value}
    for short, told in daily.items():
        # a field that hardly ever changes is written as the others of its file
        if told or (told is None and True in daily.values()):
            name = made.given[short][0]
            step = modal_step(made.time)[0]
            if step > HOUR_S:
                made.faults.append(
                    f"{name}: sums since 00:00 UTC, every {duration_text(step)}; expected every hour, of "
                    "which means can be made: ask for all 24 hours of the day"
                )
            value[short] = _hourly_sums(made.time, value[short])
            made.warnings.append(f"{name}: sums since 00:00 UTC, turned into those of each hour")
    return value


def _instants(made: _Making, value: Mapping[str, np.ndarray]) -> list[Series | None]:
    """Series of the instantaneous fields."""
    return [
        made.series(signal, value[short], short)
        for short, signal in (
            ("t2m", "ambient_temperature"),
            ("d2m", "ambient_dew_point_temperature"),
            ("sp", "ambient_pressure"),
            ("tcc", "cloud_cover"),
        )
        if short in value
    ]


def _sums(made: _Making, value: Mapping[str, np.ndarray]) -> list[Series | None]:
    """Series of radiation and rain, which belong to the hour before their stamp."""
    series = []
    if "ssrd" in value:
        sun = np.maximum(value["ssrd"], 0.0)  # NaN stays NaN
        series.append(made.series("global_horizontal_irradiance", sun, "ssrd", HOUR_S))
        if "fdir" in value:
            diffuse = np.maximum(sun - value["fdir"], 0.0)
            series.append(made.series("diffuse_horizontal_irradiance", diffuse, "ssrd fdir", HOUR_S))
    elif "avg_sdswrf" in value:
        sun = np.maximum(value["avg_sdswrf"], 0.0)
        series.append(made.series("global_horizontal_irradiance", sun, "avg_sdswrf", HOUR_S))
    if "tp" in value:
        series.append(made.series("rain", np.maximum(value["tp"], 0.0), "tp", HOUR_S))
    return series


def _site(points: PointFields) -> Site | None:
    """The point as a site; None where the file does not state it.  Raises TableFault."""
    if points.latitude_deg is None or points.longitude_deg is None:
        return None
    east = (points.longitude_deg + 180.0) % 360.0 - 180.0
    try:
        return Site(points.latitude_deg, east, points.altitude_m)
    except ValueError as outside:
        raise TableFault(f"the file's point is impossible: {outside}") from None


def _converted(short: str, name: str, raw: np.ndarray, unit: str | None, faults: list[str]) -> np.ndarray:
    """Values in the unit of their kind in `_UNITS`."""
    known = _UNITS[_KINDS[short]]
    own = "W m**-2" if short == "avg_sdswrf" else _OWN_UNIT[_KINDS[short]]
    stated = own if unit is None else unit.strip()
    if stated not in known:
        listed = ", ".join(one for one in known if one)
        faults.append(f'{name}: unknown unit "{stated}"; expected one of {listed}')
        return np.full(len(raw), np.nan)
    factor, offset = known[stated]
    return factor * raw + offset


def _power_for_energy(
    short: str, name: str, unit: str | None, time: np.ndarray, value: np.ndarray
) -> list[str]:
    """The fault of radiation in W/m² that is taken for J/m² and becomes 3600 times too small."""
    factor, _ = _UNITS["radiation"].get((unit or _OWN_UNIT["radiation"]).strip(), (1.0, 0.0))
    if (
        short not in ("ssrd", "fdir", "avg_sdswrf")
        or factor == 1.0
        or (short == "avg_sdswrf" and unit is None)
    ):
        return []
    known = value[np.isfinite(value)]
    highest = float(known.max()) if len(known) else 0.0
    # even under the clouds of a winter at 60 degrees some hour in three days has more than 1 W/m²
    if not 1e-3 < highest < 1.0 or time[-1] - time[0] < 3.0 * DAY_S:
        return []
    said = f'the file states "{unit}"' if unit else "it has no unit, so J/m² of an hour was taken"
    return [
        f"{name}: the radiation would reach {highest:.2g} W/m² only; {said}, and its numbers look like W/m²: "
        "correct the unit or multiply by 3600"
    ]


def _stated(given: Mapping[str, tuple[str, Field]], shorts: str) -> str:
    units = []
    for short in shorts.split():
        unit = given[short][1].unit
        units.append(f'the unit "{unit}"' if unit else f"no unit, so {_OWN_UNIT[_KINDS[short]]} was taken")
    return " and ".join(dict.fromkeys(units))


def _wind(made: _Making, value: Mapping[str, np.ndarray]) -> list[Series | None]:
    """Series of wind speed and direction, at 100 m if the file has it, else at 10 m."""
    for height in ("100", "10"):
        east, north = f"u{height}", f"v{height}"
        if east in value and north in value:
            break
    else:
        return []
    if height == "10":
        made.warnings.append(
            "wind_speed is measured at 10 m, not at hub height: the file has no u100 and v100"
        )
    speed = np.hypot(value[east], value[north])
    # where the wind comes from, clockwise from north
    direction = np.mod(np.arctan2(-value[east], -value[north]), 2.0 * math.pi)
    both = f"{east} {north}"
    return [
        made.series("wind_speed", speed, both, height_m=float(height)),
        made.series("wind_direction", direction, both, height_m=float(height)),
    ]


def _since_midnight(time: np.ndarray, value: np.ndarray) -> bool | None:
    """Whether an accumulated field is summed since 00:00 UTC; None where it hardly ever changes.

    time: [s] (T,) increasing. value: (T,).  Sums since 00:00 fall at the end of the day alone, and within it
    by no more than the noise of their packing (16 bits, whose step grows with the field's range); sums of
    single hours fall at every hour.  The squares of both falls, over the whole field, tell which it is.
    """
    steps = np.nan_to_num(np.diff(value))
    falls = np.square(np.minimum(steps, 0.0))
    at_end = np.diff(_day_of(time)) > 0.0
    if np.count_nonzero(steps**2 > 1e-3 * np.max(steps**2, initial=0.0)) < 6:
        return None
    return bool(np.sum(falls[~at_end]) < 0.01 * np.sum(falls[at_end]))


def _day_of(time: np.ndarray) -> np.ndarray:
    """Number of the day (T,) whose sum a stamp [s] belongs to: that at 00:00 is the last of the day before,
    that at 01:00 the first of the new one."""
    return np.ceil(np.round(time) / DAY_S)


def _hourly_sums(time: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Sums of each hour from sums since 00:00 UTC; NaN after a gap.

    A rise that a later sum of the day takes back is noise of the packing.
    """
    days = np.split(value, np.flatnonzero(np.diff(_day_of(time))) + 1)
    least = np.concatenate([np.fmin.accumulate(day[::-1])[::-1] for day in days])
    least[np.isnan(value)] = np.nan
    before = np.append(np.nan, least[:-1])
    before[np.append(True, np.round(np.diff(time)) != HOUR_S)] = np.nan
    return np.where(np.round(np.mod(time, DAY_S)) == HOUR_S, least, np.maximum(least - before, 0.0))


def saturation_doubt(temperature: np.ndarray, dew_point: np.ndarray) -> list[str]:
    """A warning where the dew point (T,) clearly exceeds the temperature (T,), both in K or in °C."""
    above = dew_point - temperature
    share = float(np.mean(above[np.isfinite(above)] > 0.5)) if np.isfinite(above).any() else 0.0
    if share <= 0.01:
        return []
    return [
        f"the dew point lies above the temperature for {100 * share:.0f} % of the hours: are the two swapped?"
    ]
