"""Move weather from the height of a station or grid cell to that of the site."""

from __future__ import annotations

import dataclasses

import numpy as np

from hygrokf.data.record import Record, Site
from hygrokf.physics.psychrometrics import GAS_CONSTANT_DRY_AIR, dew_point, saturation_pressure_water

GRAVITY = 9.80665
"""[m/s²] standard acceleration of free fall; reanalyses use it for geopotential too."""
LAPSE_RATE = 0.0065
"""[K/m] decrease of temperature with height in the standard atmosphere (ICAO)."""
SAID_FROM_M = 100.0
"""[m] difference of height from which an uncorrected record has a warning: 0.65 K."""


def pressure_ratio(temperature: np.ndarray, rise_m: float, lapse_rate: float = LAPSE_RATE) -> np.ndarray:
    """Pressure of the air at a height over that at another, p(z + Δz)/p(z) [-].

    temperature: [K] any shape, at the lower of the two heights z. rise_m: [m] Δz, may be negative.
    lapse_rate: [K/m] Γ, decrease of temperature with height.

    Hydrostatic balance of dry air dp/dz = −g p/(R_d T) with T(z + Δz) = T − Γ Δz:
    (1 − Γ Δz/T)^(g/(R_d Γ)), and exp(−g Δz/(R_d T)) for Γ = 0.  Moisture changes it by less than 0.1 % over
    500 m.
    """
    kelvin = np.asarray(temperature, dtype=float)
    if abs(lapse_rate) < 1e-9:
        return np.exp(-GRAVITY * rise_m / (GAS_CONSTANT_DRY_AIR * kelvin))
    return (1.0 - lapse_rate * rise_m / kelvin) ** (GRAVITY / (GAS_CONSTANT_DRY_AIR * lapse_rate))


def at_altitude(
    record: Record, altitude_m: float, from_m: float | None = None, lapse_rate: float = LAPSE_RATE
) -> Record:
    """A weather record moved to the height of the site.

    record: of ambient signals. altitude_m: [m] height of the site. from_m: [m] height of the record; None:
        that of its site.
    lapse_rate: [K/m] decrease of temperature with height, -0.02 … 0.02.

    Temperature changes by the lapse rate, pressure by hydrostatic balance.  The mixing ratio ε e/(p − e) is
    kept, so that vapour pressure and pressure change by the same factor.  Where the cooled air would be
    supersaturated, the dew point is set to the temperature (the rest condensed on the way up); a warning says
    how often.  Sun, wind, cloud and rain do not change.  The lapse rate is a mean: that of single hours
    differs, in winter inversions even in sign.

    Raises ValueError where the record's height is not known, or a number is out of its range.
    """
    station_m = from_m
    if station_m is None and record.site is not None:
        station_m = record.site.altitude_m
    if station_m is None:
        raise ValueError(f"{record.name}: the height of this weather is not known; state it")
    if not -0.02 <= lapse_rate <= 0.02:
        raise ValueError(f"lapse_rate must lie within -0.02 … 0.02 K/m, found {lapse_rate:g}")
    rise = altitude_m - station_m
    site = record.site and Site(record.site.latitude_deg, record.site.longitude_deg, altitude_m)
    moved, warnings = [], []
    for one in record.series:
        value = one.value
        if one.signal == "ambient_temperature":
            value = value - lapse_rate * rise
        elif one.signal in ("ambient_pressure", "ambient_dew_point_temperature"):
            known = record["ambient_temperature"].known
            before = np.interp(one.time, *known) if len(known[0]) else np.full(len(one), np.nan)
            ratio = pressure_ratio(before, rise, lapse_rate)
        if one.signal == "ambient_pressure":
            value = value * ratio
        elif one.signal == "ambient_dew_point_temperature":
            vapour = saturation_pressure_water(value) * ratio
            # supersaturation in the source, by rounding or packing, is no condensation on the way
            limit = before - lapse_rate * rise + np.fmax(value - before, 0.0)
            condensed = dew_point(vapour) > limit
            value = np.where(condensed, limit, dew_point(vapour))
            if condensed.any():
                warnings.append(
                    f"during the conversion to {altitude_m:g} m the air became saturated in "
                    f"{100 * np.mean(condensed):.1f} % of the hours"
                )
        moved.append(dataclasses.replace(one, value=value))
    warnings.insert(
        0,
        f"converted from {station_m:g} m to {altitude_m:g} m: {-1e3 * lapse_rate:+g} K/km, hydrostatic "
        "pressure, "
        "mixing ratio kept",
    )
    return dataclasses.replace(record, series=tuple(moved), site=site, warnings=(*record.warnings, *warnings))
