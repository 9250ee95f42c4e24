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
        error=error,
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
    }


def _evidence(temperature: float, vapour: float, constants: int, worth: float, in_days: float) -> dict:
    return {
        "gains": {"temperature": temperature, "vapour": vapour},
        "constants": constants,
        "searched": 12,
        "evidence": worth,
        "in_days": in_days,
        "lead": None,
    }


def _held_out(before: float, after: float, reason: str = "") -> dict:
    return {
        "z": {"temperature": -3.21, "vapour": 0.4},
        "growth": {"temperature": -0.26, "vapour": 0.004},
        "before": {"temperature": before, "vapour": 0.4},
        "after": {"temperature": after, "vapour": 0.4},
        "gain": 45.2,
        "days": 10,
        "reason": reason,
    }


def cause(name: str = "solar_gain", form: str = "on_the_roof", **changes: object) -> dict:
    """The plain data of an accepted cause."""
    return {
        "cause": name,
        "form": form,
        "forms_alike": ["on_a_wall"],
        "confidence": 0.87,
        "parameters": {
            "solar_heat": {
                "value": 6.13, "unit": "K/(kW/m2)", "lower": 5.47, "upper": 6.88, "se": 0.36,
                "meaning": "heat of the sun",
            },
            "solar_time": {"value": 0.69, "unit": "h", "lower": None, "upper": 1.01, "se": None,
                "meaning": "lag"},
        },
        "settings": {"date_s": ORIGIN_S + 86400.0, "azimuth_deg": 135.0},
        "chosen": ["azimuth_deg"],
        "evidence": _evidence(296.4, 0.2, 2, 274.6, 81.5) | {"lead": 33.3},
        "held_out": _held_out(1.79, 1.57),
        "ambiguous_with": [],
    } | changes  # fmt: skip


def _gain(quantity: str, before: float, after: float, lower: float, upper: float) -> dict:
    return {
        "quantity": quantity, "period": "validation", "rmse_before": before, "rmse_after": after,
        "lower": lower, "upper": upper,
    }  # fmt: skip


def _misfit() -> dict:
    start = ORIGIN_S + 10 * 3600.0
    return {
        "quantity": "temperature", "kind": "hour", "driver": "global_horizontal_irradiance",
        "condition": {"code": "hours_of_the_day", "values": {"first": 10.0, "last": 15.0}},
        "side": "low",
        "size": 1.4, "n_episodes": 27, "n_possible": 30, "sensor_share": 0.02, "p_adjusted": 1e-7,
        "spans": [[start + 86400.0 * day, start + 86400.0 * day + 18000.0] for day in (12, 5, 20, 1, 2)],
    }  # fmt: skip


def discovery_case() -> dict:
    """The plain data of a discovery that names the sun."""
    return copy.deepcopy(
        {
            "name": "tower 7",
            "version": "0.1.0",
            "provenance": "synthetic",
            "verdict": "named",
            "baseline": _scores(1.85, 0.42, 1.36),
            "extended": _scores(1.57, 0.42, 1.2),
            "estimator": "output-error",
            "gains": [
                _gain("temperature", 1.85, 1.57, 0.13, 0.31),
                _gain("humidity", 0.42, 0.42, 0.0, 0.0) | {"driven_before": 0.40, "driven_after": 0.38},
            ],
            "held_out_days": 10,
            "causes": [cause()],
            "rejected": [
                {
                    "cause": "door_opening", "form": "single_openings", "evidence": {}, "reason": "no_effect",
                },
                {
                    "cause": "wall_thermal_mass",
                    "form": "a_second_mass_beside_the_converter",
                    "evidence": _evidence(17.7, 0.0, 3, -5.5, -5.5),
                    "reason": "weak",
                },
                {"cause": "rain_ingress", "reason": "no_form"},
            ],
            "refuted": [],
            "lines": [],
            "work": {"simulations": 4321, "budget": 40_000, "not_judged": []},
            "repeated": {},
            "saturated": 0.0,
            "findings": [_misfit()],
            "left": [],
        }
    )  # fmt: skip


def two_causes_case() -> dict:
    """The plain data of a discovery that names two causes, the second without use on held-out readings."""
    second = cause(
        "exchange_step", "from_a_date_on", forms_alike=[], held_out=_held_out(1.57, 1.56), confidence=0.61,
    )  # fmt: skip
    return discovery_case() | {"causes": [cause(), second]}


def ambiguous_case() -> dict:
    """The plain data of a discovery that cannot tell an error of the humidity sensor from water."""
    wet = cause(
        "humidity_sensor_drift", "an_offset_that_grows", forms_alike=["a_scale_that_goes_off"],
        ambiguous_with=["internal_moisture_source", "moisture_sorption"], confidence=0.48, settings={},
        chosen=[],
        evidence=_evidence(0.0, 88.0, 1, 79.5, 40.1) | {"lead": 20.0},
    )  # fmt: skip
    return discovery_case() | {
        "verdict": "ambiguous",
        "causes": [wet],
        "gains": [
            _gain("temperature", 1.85, 1.85, 0.0, 0.0),
            _gain("humidity", 0.42, 0.33, 0.05, 0.13) | {"driven_before": 0.40, "driven_after": 0.30},
        ],
        "saturated": 0.034,
        "rejected": [{"cause": "condensation", "reason": "no_effect"}],
    }


def long_class_case() -> dict:
    """The plain data of a discovery whose class of rivals is too long to name anything."""
    rivals = ["cooling_switching", "unlogged_heater", "scheduled_heat"]
    return discovery_case() | {"verdict": "ambiguous", "causes": [cause(ambiguous_with=rivals)]}


def _without_causes() -> dict:
    alone = {"rmse_after": 1.85, "lower": 0.0, "upper": 0.0}
    found = discovery_case()
    gains = [found["gains"][0] | alone, found["gains"][1] | {"driven_after": 0.40}]
    return found | {"causes": [], "extended": None, "gains": gains}


def unexplained_case() -> dict:
    """The plain data of a discovery that finds a line and no cause."""
    line = {"quantity": "vapour", "period_h": 12.42, "p": 1e-9, "cause": ""}
    return _without_causes() | {"verdict": "unexplained", "lines": [line]}


def refuted_case() -> dict:
    """The plain data of a discovery whose cause held-out readings refute."""
    one = {
        "cause": "unlogged_heater", "form": "humidistat__at_standstill", "evidence": cause()["evidence"],
        "reason": "refuted",
        "held_out": _held_out(1.85, 2.4, "worse")
        | {"z": {"temperature": 4.4}, "growth": {"temperature": 0.52}},
    }  # fmt: skip
    return _without_causes() | {"verdict": "refuted", "refuted": [one]}


def unfinished_case() -> dict:
    """The plain data of a discovery that its budget ended."""
    left = ["moisture_sorption", "condensation"]
    work = {"simulations": 3010, "budget": 3000, "not_judged": left}
    rejected = [{"cause": name, "reason": "left_to_budget"} for name in left]
    return empty_case() | {"work": work, "rejected": rejected}


def empty_case() -> dict:
    """The plain data of a discovery that finds nothing."""
    return _without_causes() | {"verdict": "none", "findings": []}


def typed(data: dict) -> DiscoveryResults:
    """Results from plain data."""
    return structured(DiscoveryResults, data)
