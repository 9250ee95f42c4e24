"""A fixture, not a discovery: numbers in the form of `discovery.json` and residuals, made without any
estimation."""

from __future__ import annotations

import copy
import math

import numpy as np

from hygrokf.data.structured import structured
from hygrokf.discovery.discovery_results import DiscoveryResults
from hygrokf.discovery.residuals import Residuals

ORIGIN_S = 1594771200.0
"""15 July 2020, midnight UTC."""
HOURS = 24 * 40
BIAS_K = 0.3
"""[K] by which the fixture's simulation is too high throughout."""


def residuals_case(sun: float = 1.5, seed: int = 0) -> Residuals:
    """Forty days by the hour with errors that go with the sun by `sun` [K]; the last ten are held out."""
    random = np.random.default_rng(seed)
    time = np.arange(HOURS, dtype=float)
    light = np.maximum(0.0, np.sin((time % 24.0 - 6.0) / 12.0 * math.pi))
    ambient = 285.0 + 5.0 * np.sin(time / 50.0) + 3.0 * light
    power = np.clip(0.5 + 0.6 * np.sin(time / 17.0), 0.0, 1.0)
    error = {
        "temperature": sun * (light - light.mean()) - BIAS_K + 0.2 * random.standard_normal(HOURS),
        "humidity": 0.3 * random.standard_normal(HOURS),
    }
    for value in error.values():
        value[100:110] = np.nan
        value -= np.nanmean(value[: HOURS * 3 // 4])
    error["temperature"] -= BIAS_K
    simulated = {"temperature": ambient + 8.0, "humidity": np.full(HOURS, 8.0)}
    return Residuals(
        time_h=time,
        origin_s=ORIGIN_S,
        temperature_error=error["temperature"],
        humidity_error=error["humidity"],
        temperature_innovation=random.standard_normal(HOURS),
        humidity_innovation=random.standard_normal(HOURS),
        drivers={
            "ambient_temperature": ambient,
            "power": power,
            "global_horizontal_irradiance": 700.0 * light,
            "cabinet_relative_humidity": np.clip(0.5 + 0.1 * np.cos(time / 9.0), 0.0, 1.0),
        },
        operating=power > 0.1,
        preheating=np.zeros(HOURS, bool),
        validation=time >= HOURS * 3 // 4,
        sensor_error={name: np.full(HOURS, 0.1) for name in error},
        measured={name: simulated[name] + error[name] for name in error},
        simulated=simulated,
        sd={"temperature": np.full(HOURS, 1.0), "humidity": np.full(HOURS, 0.3)},
        name="tower 7",
    )


def _rmse(total: float | None, n: int = 900) -> dict:
    parts = {"operation": 0.95, "standstill": 1.1, "total": 1.0}
    return {
        **{part: None if total is None else total * factor for part, factor in parts.items()},
        "n": {"operation": n - 300, "standstill": 300, "total": n},
    }


def _constant(value: float, half: float) -> dict:
    return {
        "value_h": value,
        "lower_h": value - half,
        "upper_h": value + half,
        "level": 0.95,
        "method": "profile",
        "statement": "",
        "verdict": "believe",
        "reasons": [],
        "simulation": {"value_h": 1.25 * value, "lower_h": value, "upper_h": 1.5 * value},
    }


def _scores(kelvin: float, grams: float, thermal: float) -> dict:
    periods = ("identification", "validation")
    return {
        "rmse": {
            p: {"temperature_K": _rmse(kelvin), "absolute_humidity_g_m3": _rmse(grams)} for p in periods
        },
        "baselines": {
            p: {
                "no_dynamics": {"temperature_K": _rmse(2.1)},
                "ambient": {"absolute_humidity_g_m3": _rmse(0.5)},
                "ambient_pressure_balance": {"absolute_humidity_g_m3": _rmse(0.44)},
            }
            for p in periods
        },
        "time_constants": {"thermal": _constant(thermal, 0.05), "hygric": _constant(0.3, 0.02)},
        "loglik": 1234.5,
        "n_obs": 1800,
    }


def _evidence(lr: float, df: int, worth: float, share: float) -> dict:
    return {
        "lr": lr,
        "df": df,
        "p_adjusted": 0.02,
        "bic_gain": worth,
        "score_statistic": 15.5,
        "free_run_gain": {"thermal": share},
        "lasting_gain": {"thermal": 0.9 * share},
        "settings": {},
    }


def _cause() -> dict:
    return {
        "cause": "solar_gain",
        "form": "on the roof",
        "confidence": 0.87,
        "statement": "the sun heats the cabinet (on the roof)",
        "parameters": {
            "solar_heat": {
                "value": 6.13, "unit": "K/(kW/m2)", "lower": 5.47, "upper": 6.88, "se": 0.36,
                "meaning": "heat of the sun",
            },
            "solar_time": {"value": 0.69, "unit": "h", "lower": None, "upper": 1.01, "se": None,
                "meaning": "lag"},
        },
        "settings": {"date_s": ORIGIN_S + 86400.0, "azimuth_deg": 135.0, "on": 303.15, "off": 0.55,
            "shift_s": -3600.0},
        "evidence": _evidence(296.4, 2, 274.6, 0.28),
        "gain": {
            "quantity": "temperature_K",
            "period": "validation",
            "rmse_before": 1.79,
            "rmse_after": 1.57,
            "identified_before": 1.85,
            "identified_after": 1.57,
            "lower": 0.13,
            "upper": 0.31,
            "loglik_per_obs": 0.02,
        },
        "ambiguous_with": ["cooling_switching"],
        "separate_by": "irradiance measured at the tower",
        "remedy": "shade or paint the wall",
    }  # fmt: skip


def _misfit() -> dict:
    start = ORIGIN_S + 10 * 3600.0
    return {
        "quantity": "temperature", "where": "", "when": "from 10 to 15 h UTC", "size": 1.4, "unit": "K",
        "direction": "too low", "duration_h": 5.0, "n_episodes": 27, "n_possible": 30, "sensor_share": 0.02,
        "statement": "from 10 to 15 h UTC, simulated temperature is 1.4 K too low (27 of 30 days; the "
                     "sensors explain 0.2 K)",
        "p": 1e-9, "p_adjusted": 1e-7, "driver": "global_horizontal_irradiance", "kind": "hour", "curve": {},
        "spans": [[start + 86400.0 * day, start + 86400.0 * day + 18000.0] for day in (12, 5, 20, 1, 2)],
    }  # fmt: skip


def discovery_case() -> dict:
    """The plain data of a discovery that names the sun."""
    return copy.deepcopy(
        {
            "name": "tower 7",
            "version": "0.1.0",
            "synthetic": True,
            "verdict": "named",
            "baseline": _scores(1.85, 0.42, 1.36),
            "extended": _scores(1.57, 0.42, 1.2),
            "misfits": [_misfit()],
            "causes": [_cause()],
            "rejected": [
                {
                    "cause": "door_opening",
                    "form": "2 openings",
                    "evidence": _evidence(0.0, 4, -40.0, -0.03),
                    "reason": "it gains no likelihood",
                },
                {
                    "cause": "wall_thermal_mass",
                    "form": "wall_thermal_mass",
                    "evidence": _evidence(77.7, 3, 55.5, 0.04),
                    "reason": "the free run gains too little",
                },
            ],
            "unexplained": None,
        }
    )


def unexplained_case() -> dict:
    """The plain data of a discovery that finds structure and no cause."""
    return discovery_case() | {
        "verdict": "unexplained",
        "causes": [],
        "extended": None,
        "unexplained": {
            "quantity": "temperature",
            "kind": "one-sided excursions",
            "when": "3 August 2020",
            "driver": "wind_speed",
            "lag_h": 3.0,
            "correlation": -0.31,
            "p": 0.01,
            "statement": "in 14 episodes simulated temperature is up to 4.1 K too low",
        },
    }


def empty_case() -> dict:
    """The plain data of a discovery that finds nothing."""
    return unexplained_case() | {"verdict": "none", "misfits": [], "unexplained": None}


def typed(data: dict) -> DiscoveryResults:
    """Results from plain data, in which `misfits` is what earlier files call the findings."""
    return structured(DiscoveryResults, data)
