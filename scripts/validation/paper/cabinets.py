"""Simulated cabinets under the measured drivers of a site, and their records with local or with ERA5's air.

The simulator is that of `tests/plants`: physical units and an integrator of its own, coloured disturbances,
loggers with bias, noise and resolution.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from plants.as_record import to_record
from plants.cabinet import Cabinet
from plants.chance import ornstein_uhlenbeck
from plants.drivers import Drivers, minutes
from plants.loggers import Logging
from plants.plant import Plant, build_plant

from hygrokf.data.record import Record, Series
from hygrokf.physics.psychrometrics import absolute_humidity
from validation.paper.published import TIME_CONSTANTS_H
from validation.paper.sites import STEP_S, Site

INDIVIDUAL = 0.10
"""[-] standard deviation of the logarithm of each property of a sister of the same type."""


@dataclass(frozen=True)
class LocalAir:
    """How the air at a turbine differs from ERA5's: two Ornstein-Uhlenbeck processes.

    temperature_sd_K: [K], temperature_time_h: [h]. vapour_sd: [-] of the logarithm of the absolute humidity,
    vapour_time_h: [h].  The defaults are what `sites` finds in measurements: `nacelle_deviation` for
    the temperature, without its mean and its course of the day, which belong to a warm sensor high above the
    ground; the middle house of `eave_deviations` for the humidity.
    """

    temperature_sd_K: float = 1.53
    temperature_time_h: float = 6.9
    vapour_sd: float = 0.072
    vapour_time_h: float = 4.7


def local_drivers(site: Site, days: float, seed: int, outdoor: bool = False) -> Drivers:
    """What a cabinet at the site is exposed to, each minute: measured power, and air that differs from
    ERA5's.

    outdoor: take the temperature of the turbine's own outdoor sensor instead of the simulated local one.
    """
    air = LocalAir()
    time = minutes(str(np.datetime64(int(site.hour_s[0]), "s")), days)
    random = np.random.default_rng(np.random.SeedSequence([seed, 21]))
    apart = [
        sd * ornstein_uhlenbeck(random, time.size, 1.0 / 60.0, correlation_h)
        for sd, correlation_h in (
            (air.temperature_sd_K, air.temperature_time_h),
            (air.vapour_sd, air.vapour_time_h),
        )
    ]
    kelvin = np.interp(time, site.hour_s, site.temperature_K) + apart[0]
    if outdoor and site.outdoor_K is not None:
        kelvin = np.interp(time, site.step_s + 0.5 * STEP_S, site.outdoor_K)
    vapour = np.interp(time, site.hour_s, site.vapour_kg_m3) * np.exp(apart[1] - 0.5 * air.vapour_sd**2)
    place = ((time - site.step_s[0]) // STEP_S).astype(int)
    return Drivers(
        time=time,
        ambient_K=kelvin,
        ambient_kg_m3=np.minimum(vapour, absolute_humidity(1.0, kelvin)),
        power_W=site.power_W[place],
        power_known=site.power_known[place],
        preheating=np.zeros(time.size),
        wind_m_s=np.zeros(time.size),
        irradiance_W_m2=np.zeros(time.size),
        ambient_step_min=10,
        ambient_offset_min=0,
        latitude_deg=site.latitude_deg,
        longitude_deg=site.longitude_deg,
    )


LOGGING = Logging(logger_step_min=15.0, sensor_errors="all")
"""Cabinet loggers every 15 min, ambient loggers every 10 min, all with bias, noise and resolution (0.3 K, 2
%)."""


def first_plant(site: Site, drivers: Drivers, seed: int) -> Plant:
    """A cabinet with the paper's time constants, otherwise drawn by `seed`."""
    return build_plant(
        f"simulated cabinet at {site.name}",
        seed,
        drivers,
        LOGGING,
        tau_h=TIME_CONSTANTS_H["thermal"],
        hygric_h=TIME_CONSTANTS_H["hygric"],
    )


def sister_plant(site: Site, drivers: Drivers, seed: int, kin: Cabinet) -> Plant:
    """A cabinet of the same type: `kin` with each property moved by a factor of its own, other disturbances
    and loggers."""
    random = np.random.default_rng(np.random.SeedSequence([seed, 22]))
    moved = ("heat_capacity", "outer_resistance", "inner_resistance", "gap")
    factors = np.exp(INDIVIDUAL * random.standard_normal(len(moved) + 1))
    changed = {name: factor * getattr(kin, name) for name, factor in zip(moved, factors, strict=False)}
    # the release in kelvin has a factor of its own: it must not follow the resistance
    warm = float(factors[-1]) * kin.outer_resistance / changed["outer_resistance"]
    released = {
        name: tuple(warm * part for part in getattr(kin, name)) for name in ("operation_W", "standstill_W")
    }
    own = replace(kin, **changed, **released)
    given = {one.name: getattr(own, one.name) for one in fields(Cabinet)}
    return build_plant(f"simulated sister at {site.name}", seed + 10_000, drivers, LOGGING, **given)


def local_record(made: Plant, until_s: float | None) -> Record:
    """Readings in the cabinet, of the local air, and the power."""
    kept = ("cabinet_temperature", "cabinet_relative_humidity", "ambient_temperature",
        "ambient_relative_humidity",
            "active_power")  # fmt: skip
    found = to_record(made, until_s=until_s)
    return replace(
        found,
        name=f"{made.name}, local air",
        series=tuple(one for one in found.series if one.signal in kept),
    )


def era5_record(local: Record, site: Site) -> Record:
    """The same cabinet and power with ERA5's hours as the ambient air."""
    source = "ERA5, hourly"
    ambient = (
        Series("ambient_temperature", site.hour_s, site.temperature_K, source=source),
        Series("ambient_absolute_humidity", site.hour_s, site.vapour_kg_m3, source=source),
    )
    others = tuple(one for one in local.series if not one.signal.startswith("ambient_"))
    return replace(local, name=local.name.replace("local air", "ERA5's air"), series=(*others, *ambient))
