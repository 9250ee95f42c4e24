"""A climate to test on: the EPW-like weather of one made-up year, and a model with known parameters."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from builders.fit_case import typed
from hygrokf.climate.climate_profile import climate_profile
from hygrokf.climate.limits import ClimateLimit
from hygrokf.climate.region import Region
from hygrokf.climate.study import RegionClimate, Study
from hygrokf.data.record import Record, Series
from hygrokf.identification.fit import Fit

HOUR_S = 3600.0
BEGIN_S = float(np.datetime64("2021-01-01T00:00:00", "s").astype(int))
FREE = ("thermal_time_constant", "heat_release_operation", "heat_disturbance_sd", "hygric_k")
"""Parameters that are uncertain in `known_fit`."""
LIMITS = (
    ClimateLimit("temperature_degC", above=90.0, name="never"),
    ClimateLimit("temperature_degC", above=-60.0, name="broken"),
)
"""Limits that made-up weather never and always exceeds."""


@cache
def made_up_weather(days: int = 365, seed: int = 5) -> Record:
    """Hourly temperature, dew point and wind with season, day and fronts; nothing of it was measured."""
    random = np.random.default_rng(seed)
    hour = np.arange(24 * days + 1)
    time = BEGIN_S + HOUR_S * hour

    def wander(scale_h: float) -> np.ndarray:
        gain = np.exp(-1.0 / scale_h)
        kicks = np.sqrt(1 - gain**2) * random.standard_normal(len(hour))
        state, course = 0.0, []
        for kick in kicks.tolist():
            state = gain * state + kick
            course.append(state)
        return np.array(course)

    season = -np.cos(2 * np.pi * (hour / 24.0 - 20) / 365.25)
    day = np.cos(2 * np.pi * (hour - 15) / 24.0)
    celsius = 9.0 + 8.0 * season + 3.5 * day + 3.0 * wander(60.0)
    dew = celsius - 1.0 - np.abs(2.5 + 2.0 * day + 2.0 * wander(20.0))
    wind = 6.0 * np.exp(0.5 * wander(18.0))
    return Record(
        "made-up weather",
        (
            Series("ambient_temperature", time, celsius + 273.15),
            Series("ambient_dew_point_temperature", time, dew + 273.15),
            Series("wind_speed", time, wind),
        ),
    )


def known_fit(
    spread: float = 0.02,
    free: tuple[str, ...] = FREE,
    found: dict[str, Any] | None = None,
    **values: float,
) -> Fit:
    """The usual joint model with stated parameters; those of `free` are uncertain by a share `spread` of
    their value.  `found`: further results of the fit."""
    from hygrokf.modelling.design import Design

    mechanisms = (
        ("thermal_network", {}),
        ("heat_release", {"order": 1, "reference_K": 283.15}),
        ("heat_disturbance", {}),
        ("thermal_diffusion", {}),
        ("temperature_sensor", {}),
        ("hygric_exchange", {}),
        ("vapour_disturbance", {}),
        ("hygric_diffusion", {}),
        ("humidity_sensor", {}),
    )
    made = Design(mechanisms, power_scale_W=2e6, power_order=1, power_mean=(0.8, 0.4))
    stated = {
        "thermal_time_constant": 1.5, "resistance_ratio": 0.85, "heat_release_operation": 5.0,
        "heat_release_power_1": 4.0,
        "heat_release_standstill": 2.0, "heat_disturbance_sd": 1.2, "heat_disturbance_time": 8.0,
        "hygric_k": 0.4,
        "vapour_disturbance_sd": 0.3, "vapour_disturbance_time": 6.0,
    }  # fmt: skip
    known = {p.name: stated.get(p.name, p.start) for p in made.model.parameters} | values
    names = [name for name in free if name in known]
    matrix = np.diag([(spread * known[name]) ** 2 for name in names])
    return Fit(
        "known cabinet",
        made,
        known,
        typed(
            {
                "covariance": {"names": names, "matrix": matrix.tolist()},
                "name": "known cabinet",
                **(found or {}),
            }
        ),
    )


def study_of(weather: Record | None = None, power: Record | None = None, **more: Any) -> Study:
    """The climate of `known_fit` under made-up weather (40 days of it), with three members."""
    made = Region("here", made_up_weather(40) if weather is None else weather)
    return climate_profile(more.pop("fit", None) or known_fit(), [made], power, **{"members": 3} | more)


@cache
def small_study() -> Study:
    """`study_of` with `LIMITS`."""
    return study_of(limits=LIMITS)


def climate_of(weather: Record | None = None, power: Record | None = None, **more: Any) -> RegionClimate:
    """The only region of `study_of`."""
    (region,) = study_of(weather, power, **more).regions
    return region


def hourly_power(weather: Record, value: np.ndarray) -> Record:
    """A turbine of 2 MW with a power [W] at each hour of a weather record."""
    time = weather["wind_speed"].time
    return Record("p", (Series("active_power", time, value, "mean", HOUR_S),), rated_power_W=2e6)
