"""Features: inputs of mechanisms derived from a record's signals (sun, wind, calendar, dates, controllers).

A design stores its features with their settings, so that an extended model can be driven by any record:
`{"after_step": {"date_s": 1.6e9}}`.  `time` (T,) [s] are the instants of a run; a feature that holds over
steps is evaluated in the middle of the step that ends at each instant.

Features that several mechanisms read, or that need more than a series' own readings, stand here; a feature of
one mechanism alone stands with it (`Mechanism.features`).
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from hygrokf.data.ambient import AMBIENT_BRIDGE_H, at_times, bridge_h
from hygrokf.data.prepared import VAPOUR, PreparedRecord
from hygrokf.data.record import Record, Series, Site
from hygrokf.data.timestamps import DAY_S
from hygrokf.physics.holds import LINEAR, MEAN, REGIME
from hygrokf.physics.mechanisms import MECHANISMS
from hygrokf.physics.model import Feature
from hygrokf.physics.switches import CONTROLLED, Throttle

SOLAR_CONSTANT = 1361.0
"""[W/m²] irradiance outside the atmosphere."""
RATE_WINDOW_S = 5400.0
READING_BRIDGE_H = 2.0
"""[h] longest gap in which a controller follows an interpolated reading; in longer gaps it keeps its
position."""


def elapsed(record: Record, time: np.ndarray, start_s: float, end_s: float) -> np.ndarray:
    """Elapsed share [1] of the time from `start_s` to `end_s`; above 1 after the end."""
    return (time - start_s) / (end_s - start_s)


def after_step(record: Record, time: np.ndarray, date_s: float, days: float = 0.0) -> np.ndarray:
    """0 before a date [s] and 1 after it, with a linear ramp over `days` where that is above 0."""
    if days <= 0:
        return (time > date_s).astype(float)
    return np.clip((time - date_s) / (days * DAY_S), 0.0, 1.0)


def door_open(record: Record, time: np.ndarray, spans: Sequence[Sequence[float]]) -> np.ndarray:
    """1 within spans (start, end) [s], 0 outside."""
    is_open = np.zeros(len(time))
    for start, end in spans:
        is_open[(time > start) & (time <= end)] = 1.0
    return is_open


def wind_tenth(record: PreparedRecord, time: np.ndarray) -> np.ndarray:
    """Wind speed in units of 10 m/s; gaps take the record's mean."""
    return _signal(record, "wind_speed", time) / 10.0


def sunshine(record: PreparedRecord, time: np.ndarray) -> np.ndarray:
    """Irradiance on a horizontal plane [kW/m²]: measured, else that of a clear sky at the site."""
    if "global_horizontal_irradiance" in record:
        return _signal(record, "global_horizontal_irradiance", time) / 1e3
    if record.site is None:
        raise ValueError(
            "the model needs the sun: expected global_horizontal_irradiance or [site] in the case, found "
            "neither"
        )
    return clear_sky(time, record.site) / 1e3


def sunlit_wall(record: PreparedRecord, time: np.ndarray, azimuth_deg: float) -> np.ndarray:
    """Irradiance [kW/m²] on a vertical wall facing `azimuth_deg` (clockwise from north).

    Beam and diffuse radiation are split by the clearness index (Erbs, Klein and Duffie 1982); the sky is
    isotropic, the ground reflects a fifth.  Below an elevation of six degrees the beam is computed as at six
    degrees, since trees and hills obstruct it.
    """
    horizontal = 1e3 * sunshine(record, time)
    sine, sun_azimuth = sun_place(time, _site(record))
    kt = np.clip(horizontal / np.maximum(SOLAR_CONSTANT * sine, 1.0), 0.0, 1.0)
    middle_branch = 0.9511 + kt * (-0.1604 + kt * (4.388 + kt * (-16.638 + kt * 12.336)))
    share = np.where(kt <= 0.22, 1.0 - 0.09 * kt, np.where(kt <= 0.8, middle_branch, 0.165))
    beam = (1.0 - share) * horizontal / np.maximum(sine, 0.1)
    facing = np.sqrt(1.0 - np.clip(sine, -1.0, 1.0) ** 2) * np.cos(sun_azimuth - np.radians(azimuth_deg))
    return 1e-3 * (beam * np.maximum(facing, 0.0) + (0.5 * share + 0.1) * horizontal)


def night_sky(record: PreparedRecord, time: np.ndarray) -> np.ndarray:
    """Radiative cooling by the night sky, 0 to 1: 0 by day, by night the clearness of the last 24 h.

    Clearness is measured irradiance divided by that of a clear sky; 1 where irradiance is not measured.
    """
    site = _site(record)
    sine, _ = sun_place(time, site)
    dark = (sine <= 0.0).astype(float)
    if "global_horizontal_irradiance" not in record:
        return dark
    hours = np.arange(float(time[0]) - DAY_S, float(time[-1]) + 3600.0, 1800.0)
    clear = clear_sky(hours, site)
    measured = np.minimum(_signal(record, "global_horizontal_irradiance", hours), 1.2 * clear)
    window = np.ones(48)
    sums = [np.convolve(irradiance, window)[: len(hours)] for irradiance in (measured, clear)]
    clearness = np.clip(sums[0] / np.maximum(sums[1], 1.0), 0.0, 1.0)
    return dark * np.interp(time, hours, clearness)


def wind_square(record: PreparedRecord, time: np.ndarray) -> np.ndarray:
    """Square of the wind speed in units of (10 m/s)²; gaps take the record's mean speed."""
    return wind_tenth(record, time) ** 2


def scheduled(
    record: Record, time: np.ndarray, start_h: float, hours: float, workdays: bool = False
) -> np.ndarray:
    """1 for `hours` hours from `start_h` [h, UTC], every day or on Monday to Friday only; 0 otherwise."""
    since_start = time - 3600.0 * start_h
    day = np.floor(since_start / DAY_S)
    is_scheduled = since_start - DAY_S * day < 3600.0 * hours
    # 1 January 1970 was a Thursday
    return (is_scheduled & (~np.array(workdays) | ((day + 3) % 7 < 5))).astype(float)


def ambient_temperature_rate(record: PreparedRecord, time: np.ndarray) -> np.ndarray:
    """Rate of the ambient temperature [K/h]; see `rate`."""
    return rate(record["ambient_temperature"], record.path("ambient_temperature"), time)


def ambient_vapour_rate(record: PreparedRecord, time: np.ndarray) -> np.ndarray:
    """Rate of the ambient absolute humidity [g/(m³ h)]; see `rate`."""
    vapour = record.ambient_vapour
    if vapour is None:
        raise ValueError(
            "the model needs an ambient humidity (relative, absolute or dew point), which the record "
            "does not have; add the signal"
        )
    return 1e3 * rate(vapour, record.path(VAPOUR), time)


def rate(series: Series, path: Series, time: np.ndarray) -> np.ndarray:
    """Rate of change [1/h] of a series at `time` (T,) [s]: slope of a straight line fitted to the path of the
    series over 1.5 h, since differences of neighbouring readings are mostly noise; 0 in longer gaps."""
    step = RATE_WINDOW_S / 10.0
    lag = step * np.arange(-5, 6)
    value = at_times(path, time[:, None] + lag[None, :], bridge_h(series, AMBIENT_BRIDGE_H))
    return np.nan_to_num(value @ (lag / float(lag @ lag)) * 3600.0)


def standstill(record: Record, time: np.ndarray) -> np.ndarray:
    """1 while the turbine feeds no power, 0 in operation."""
    return 1.0 - operating(record, time)


def throttled(
    record: PreparedRecord, time: np.ndarray, reads: str, start: float, full: float, idle: bool = False
) -> np.ndarray:
    """Position (T,) of a proportional controller that follows the signal `reads` (see `physics.switches`).

    Without any cabinet reading the position is 0: such a run can only be simulated, and simulations drive
    their own controllers (`evaluation.self_switching`).
    """
    if not any(signal.startswith("cabinet_") for signal in record.signals):
        return np.zeros(len(time))
    if reads not in record:
        raise ValueError(f"the model switches by {reads}, which the record does not have; add the signal")
    value = at_times(record.path(reads), time, READING_BRIDGE_H)
    return Throttle(reads, start, full, idle).course(value, ~operating(record, time))


BASE_INPUTS: Mapping[str, tuple[str, str]] = MappingProxyType({
    "exchange_factor": (LINEAR, "ambient_temperature"),
    "operating": (MEAN, "active_power"),
    "power_unknown": (REGIME, "active_power"),
    **{f"power_{exponent}": (MEAN, "active_power") for exponent in range(1, 6)},
})  # fmt: skip
"""Derived inputs of the base models: hold, and the signal whose clock the input has."""
_OF_A_SIGNAL: Mapping[str, tuple[Feature, str]] = {
    "sunshine": ((sunshine, LINEAR), "global_horizontal_irradiance"),
    "sunlit_wall": ((sunlit_wall, LINEAR), "global_horizontal_irradiance"),
    "night_sky": ((night_sky, LINEAR), "global_horizontal_irradiance"),
    "ambient_temperature_rate": ((ambient_temperature_rate, LINEAR), "ambient_temperature"),
    "ambient_vapour_rate": ((ambient_vapour_rate, LINEAR), "ambient_temperature"),
    "wind_tenth": ((wind_tenth, LINEAR), "wind_speed"),
    "wind_square": ((wind_square, LINEAR), "wind_speed"),
    "standstill": ((standstill, MEAN), "active_power"),
}
SIGNAL_OF: Mapping[str, str] = MappingProxyType({
    **{name: signal for name, (_, signal) in BASE_INPUTS.items()},
    **{name: signal for name, (_, signal) in _OF_A_SIGNAL.items()},
})  # fmt: skip
"""Derived input → the signal whose clock it has."""
FEATURES: Mapping[str, Feature] = MappingProxyType({
    "elapsed": (elapsed, LINEAR),
    **{name: pair for name, (pair, _) in _OF_A_SIGNAL.items()},
    "after_step": (after_step, MEAN),
    "door_open": (door_open, MEAN),
    "scheduled": (scheduled, MEAN),
    **dict.fromkeys(CONTROLLED, (throttled, MEAN)),
    **{name: pair for factory in MECHANISMS.values() for name, pair in factory().features.items()},
})  # fmt: skip
"""The package's features, with their holds, by the name of the input that they provide."""


def feature(
    record: PreparedRecord,
    name: str,
    settings: Mapping[str, Any],
    time: np.ndarray,
    features: Mapping[str, Feature] = FEATURES,
) -> np.ndarray:
    """Values (T,) of one of the `features` at the instants `time` (T,) [s] of a run.

    Raises ValueError if the function of the feature returns anything but T finite numbers.
    """
    function, hold = features[name]
    if hold == MEAN:
        time = 0.5 * (time + np.concatenate([time[:1], time[:-1]]))
    values = np.asarray(function(record, time, **settings))
    if values.shape != time.shape or values.dtype.kind not in "bif":
        raise ValueError(
            f"{name}: expected {len(time)} values, found shape {values.shape} of type {values.dtype}"
        )
    if not np.isfinite(values).all():
        raise ValueError(f"{name}: expected finite values, found {values[~np.isfinite(values)][0]}")
    return values


def without_settings(
    inputs: Iterable[str], features: Mapping[str, Feature] = FEATURES
) -> dict[str, dict[str, Any]]:
    """The features without settings among a mechanism's inputs, by name, with empty settings."""
    return {name: {} for name in inputs if name in features and not feature_faults({name: {}}, features)}


def feature_faults(
    stated: Mapping[str, Mapping[str, Any]], features: Mapping[str, Feature] = FEATURES
) -> list[str]:
    """Faults of stated features: unknown names, and settings that are missing or unknown."""
    faults = []
    for name, settings in stated.items():
        if name not in features:
            faults.append(f"{name}: expected one of {', '.join(features)}")
            continue
        arguments = dict(list(inspect.signature(features[name][0]).parameters.items())[2:])
        needed = {key for key, argument in arguments.items() if argument.default is argument.empty}
        if not isinstance(settings, Mapping) or not needed <= set(settings) <= set(arguments):
            faults.append(
                f"{name}: expected the settings {', '.join(arguments) or 'none'}, found {settings!r}"
            )
    return faults


def operating(record: Record, time: np.ndarray) -> np.ndarray:
    """True (T,) where the turbine feeds power at `time` [s]; False where the power is unknown or absent."""
    if "active_power" not in record:
        return np.zeros(len(time), bool)
    return np.nan_to_num(at_times(record["active_power"], time, 1.0), nan=0.0) > 0.0


def sun_place(time: np.ndarray, site: Site) -> tuple[np.ndarray, np.ndarray]:
    """Sine of the sun's elevation (T,) [1] and the sun's azimuth (T,) [rad] clockwise from north, at `time`
    (T,) [s].

    Spencer's series (1971), accurate to a quarter of a degree.
    """
    day = np.floor(time / DAY_S)
    date = day.astype("datetime64[D]")
    new_year = date.astype("datetime64[Y]").astype("datetime64[D]")
    angle = 2.0 * np.pi * ((date - new_year).astype(float) + (time / DAY_S - day) - 0.5) / 365.0
    declination = (
        0.006918 - 0.399912 * np.cos(angle) + 0.070257 * np.sin(angle) - 0.006758 * np.cos(2 * angle)
        + 0.000907 * np.sin(2 * angle) - 0.002697 * np.cos(3 * angle) + 0.00148 * np.sin(3 * angle)
    )  # fmt: skip
    equation_min = 229.18 * (
        0.000075 + 0.001868 * np.cos(angle) - 0.032077 * np.sin(angle)
        - 0.014615 * np.cos(2 * angle) - 0.040849 * np.sin(2 * angle)
    )  # fmt: skip
    solar = (time / DAY_S - day) * 24.0 + site.longitude_deg / 15.0 + equation_min / 60.0
    hour_angle = np.radians(15.0 * (solar - 12.0))
    latitude = np.radians(site.latitude_deg)
    sine = np.sin(latitude) * np.sin(declination)
    sine = sine + np.cos(latitude) * np.cos(declination) * np.cos(hour_angle)
    east = -np.cos(declination) * np.sin(hour_angle)
    north = np.cos(latitude) * np.sin(declination)
    north = north - np.sin(latitude) * np.cos(declination) * np.cos(hour_angle)
    return sine, np.arctan2(east, north)


def clear_sky(time: np.ndarray, site: Site) -> np.ndarray:
    """Global irradiance of a clear sky [W/m²] at `time` (T,) [s]: 1098 cos z exp(−0.057/cos z) (Haurwitz
    1945)."""
    sine, _ = sun_place(time, site)
    positive_sine = np.maximum(sine, 1e-3)
    return np.where(sine > 0.0, 1098.0 * positive_sine * np.exp(-0.057 / positive_sine), 0.0)


def _site(record: Record) -> Site:
    if record.site is None:
        raise ValueError("the model needs the sun's place: expected [site] in the case, found none")
    return record.site


def _signal(record: PreparedRecord, name: str, time: np.ndarray) -> np.ndarray:
    """A signal at instants; unknown values take the record's mean."""
    if name not in record:
        raise ValueError(f"the model reads {name}, which the record does not have; add the signal")
    series = record[name]
    value = at_times(record.path(name), time, bridge_h(series, AMBIENT_BRIDGE_H))
    return np.where(np.isnan(value), np.nanmean(series.value), value)
