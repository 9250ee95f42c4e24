"""A fixture, not a fit: numbers in the form of `fit.json` and `series.npz`, made without any estimation.

The synthetic turbine is simulated once more with slightly wrong parameters and without its disturbances, so
that the free run errs as a real one does; innovations are drawn, bounds and standard errors are invented.
"""

from __future__ import annotations

import json
import math
from functools import cache
from pathlib import Path

import numpy as np

from hygrokf.cases.synthetic import synthetic_turbine
from hygrokf.data.structured import plain, structured
from hygrokf.evaluation.innovation_tests import diagnose
from hygrokf.identification.fit_results import FitResults
from hygrokf.texts.fit_codes import FitCode

DAYS = 40.0
TAU_H, RATIO, HYGRIC_H = 1.45, 0.84, 0.31
RELEASE = {
    "heat_release_operation": 7.3,
    "heat_release_power_1": 5.6,
    "heat_release_operation_ambient": -0.14,
    "heat_release_standstill": 5.1,
    "heat_release_standstill_ambient": -0.1,
}
REFERENCE_K = 288.15


def results(data: dict) -> FitResults:
    """The results of a fit from data in the form of `fit.json`."""
    return structured(FitResults, data)


def _relaxed(time_h: np.ndarray, target: np.ndarray, constant_h: float) -> np.ndarray:
    """x with dx/dt = (target − x)/constant, the target constant over each step."""
    gain = np.exp(-np.diff(time_h, prepend=time_h[0]) / constant_h)
    state, states = target[0], []
    for g, to in zip(gain, target, strict=True):
        state = to + g * (state - to)
        states.append(state)
    return np.array(states)


def _saturation(kelvin: np.ndarray) -> np.ndarray:
    return 611.2 * np.exp(17.62 * (kelvin - 273.15) / (kelvin - 30.03))


def _made(days: float, seed: int) -> tuple[dict, dict[str, np.ndarray]]:
    random = np.random.default_rng(seed)
    turbine = synthetic_turbine(seed=seed, days=days)
    cabinet, ambient, scada = turbine.cabinet, turbine.ambient, turbine.scada
    time = np.unique(np.concatenate([cabinet.time, ambient.time, scada.time + 600.0]))
    time = time[(time >= ambient.time[0]) & (time <= ambient.time[-1])]
    hours = (time - time[0]) / 3600.0
    warm = np.interp(time, ambient.time, ambient["T_amb_degC"]) + 273.15
    damp = np.interp(time, ambient.time, ambient["RH_amb_pct"]) / 100.0
    vapour = 1e3 * damp * _saturation(warm) / (461.5 * warm)
    place = np.clip(np.searchsorted(scada.time + 600.0, time), 0, len(scada.time) - 1)
    power = scada["P_kW"][place] / 2050.0
    unknown = ~np.isfinite(power) | (np.abs(scada.time[place] + 600.0 - time) > 3600.0)
    power = np.where(unknown, 0.4, power)
    heated = scada["preheating"][place]
    running = (power > 0).astype(float)
    above = warm - REFERENCE_K
    release = np.where(
        running > 0,
        RELEASE["heat_release_operation"]
        + RELEASE["heat_release_power_1"] * power
        + RELEASE["heat_release_operation_ambient"] * above,
        RELEASE["heat_release_standstill"] + RELEASE["heat_release_standstill_ambient"] * above,
    )
    converter = _relaxed(hours, warm + (release + 9.0 * heated) / RATIO, TAU_H)
    air = RATIO * converter + (1 - RATIO) * warm
    inside = _relaxed(hours, vapour, HYGRIC_H) * warm / air
    nothing = np.full(len(time), np.nan)
    read = {name: nothing.copy() for name in ("kelvin", "humidity")}
    at = np.searchsorted(time, cabinet.time)
    good = (at < len(time)) & np.isin(cabinet.time, time)
    read["kelvin"][at[good]] = cabinet["T_cab_degC"][good] + 273.15
    read["humidity"][at[good]] = cabinet["RH_cab_pct"][good] / 100.0
    absolute = 1e3 * read["humidity"] * _saturation(read["kelvin"]) / (461.5 * read["kelvin"])
    relative = inside / 1e3 * 461.5 * air / _saturation(air)
    last = np.maximum.accumulate(np.where(unknown, time, -np.inf))
    drawn = {}
    for name in ("kelvin", "humidity"):
        noise = random.standard_normal(len(time))
        drawn[name] = np.where(np.isfinite(read[name]), noise, np.nan)
    jump = np.roll(np.diff(power, prepend=power[0]), 8)
    drawn["humidity"] = drawn["humidity"] + 0.25 * jump / jump.std()
    series = {
        "time_s": time,
        "temperature_measured": read["kelvin"],
        "relative_humidity_measured": read["humidity"],
        "absolute_humidity_measured": absolute,
        "temperature_simulated": air,
        "temperature_sd": np.full(len(time), 1.6),
        "relative_humidity_simulated": relative,
        "relative_humidity_sd": np.full(len(time), 0.05),
        "absolute_humidity_simulated": inside,
        "absolute_humidity_sd": np.full(len(time), 0.45),
        "temperature_innovation": drawn["kelvin"],
        "humidity_innovation": drawn["humidity"],
        "ambient_temperature": warm,
        "ambient_absolute_humidity": vapour,
        "power": power,
        "operating": running,
        "preheating": heated,
        "scored": (time - last > 12 * 3600.0).astype(float),
        "until_s": np.array(turbine.until_s),
        "start_s": np.array(time[0]),
    }
    return _results(turbine.name, series), series


def _stamp(seconds: float) -> str:
    return f"{np.datetime64(round(seconds), 's')}+00:00"


def _errors(error: np.ndarray, running: np.ndarray) -> dict:
    parts = {"operation": running > 0, "standstill": running == 0, "total": running >= 0}
    found: dict = {"n": {}}
    for name, chosen in parts.items():
        there = error[chosen & np.isfinite(error)]
        found[name] = float(np.sqrt(np.mean(there**2))) if len(there) else None
        found["n"][name] = len(there)
    return found


def _points(series: dict[str, np.ndarray], chosen: np.ndarray, regime: str) -> dict:
    rows = np.flatnonzero(chosen & np.isfinite(series["temperature_measured"]))[::40]
    warm, power = series["ambient_temperature"][rows], series["power"][rows]
    difference = series["temperature_measured"][rows] - warm
    names = [name for name in RELEASE if regime in name or (regime == "operation" and "power" in name)]
    columns = {"power_1": power, "ambient": warm - REFERENCE_K}
    table = np.column_stack(
        [next((v for k, v in columns.items() if name.endswith(k)), np.ones(len(rows))) for name in names]
    )
    found = np.linalg.lstsq(table, difference, rcond=None)[0]
    return {
        "n_points": len(rows),
        "n_episodes": 12,
        "order": len(names) - 2,
        "ambient": True,
        "coefficients": dict(zip(names, found.tolist(), strict=True)),
        "points": {
            "power": power.tolist(),
            "difference_K": difference.tolist(),
            "ambient_K": warm.tolist(),
        },
    }


def _constant(value: float, half: float, simulated: float) -> dict:
    at = value * np.exp(np.linspace(-1.2, 1.2, 7) * half / value)
    return {
        "value_h": value,
        "lower_h": value - half,
        "upper_h": value + half,
        "composition": [
            {"source": "profile", "lower_h": value - 0.6 * half, "upper_h": value + 0.6 * half},
            {
                "source": "forms",
                "sd_ln": 0.3 * half / value,
                "lower_h": value - 0.8 * half,
                "upper_h": value + 0.8 * half,
            },
            {
                "source": "sampling",
                "sd_ln": 0.3 * half / value,
                "lower_h": value - half,
                "upper_h": value + half,
            },
        ],
        "forms": [
            {"form": "base", "weight": 0.7, "value_h": value},
            {"form": "second mass", "weight": 0.3, "value_h": value + 0.5 * half},
        ],
        "level": 0.95,
        "method": "composed",
        "factor": 1.3,
        "threshold": 1.3 * 3.8415,
        "curve": [[float(x), 1.3 * 3.8415 * math.log(x / value) ** 2 / (half / value) ** 2] for x in at],
        "clock": None,
        "simulation": {"value_h": simulated, "lower_h": 0.85 * simulated, "upper_h": 1.15 * simulated},
        "criteria_disagree": False,
        "modes": [value],
    }


def _results(name: str, series: dict[str, np.ndarray]) -> dict:
    time, until = series["time_s"], float(series["until_s"])
    early = time <= until
    running, scored = series["operating"], series["scored"] > 0
    pairs = {"temperature_K": "temperature", "absolute_humidity_g_m3": "absolute_humidity"}
    errors = {q: series[f"{n}_simulated"] - series[f"{n}_measured"] for q, n in pairs.items()}
    ambient = series["ambient_absolute_humidity"] - series["absolute_humidity_measured"]
    static = series["ambient_temperature"] + 8.0 - series["temperature_measured"]
    rmse, baselines, share = {}, {}, {}
    for period, chosen in (("identification", early), ("validation", ~early)):
        inside = chosen & scored
        rmse[period] = {q: _errors(np.where(inside, e, np.nan), running) for q, e in errors.items()}
        baselines[period] = {
            "ambient": {"absolute_humidity_g_m3": _errors(np.where(inside, ambient, np.nan), running)},
            "ambient_pressure_balance": {
                "absolute_humidity_g_m3": _errors(np.where(inside, 1.1 * ambient, np.nan), running)
            },
            "no_dynamics": {"temperature_K": _errors(np.where(inside, static, np.nan), running)},
        }
        share[period] = {"temperature_K": 0.02, "absolute_humidity_g_m3": 0.27}
    hygric = _constant(0.30, 0.03, 0.33)
    hygric["mean_temperatures"] = {"cabinet_temperature_K": 296.2, "ambient_temperature_K": 288.1}
    hygric["range_h"] = [0.27, 0.33]
    values = {"thermal_time_constant": (TAU_H, "h"), "resistance_ratio": (1.0, "1"), "hygric_k": (0.34, "h")}
    values |= {n: (v, "K/K" if n.endswith("ambient") else "K") for n, v in RELEASE.items()}
    values |= {"cabinet_temperature_bias": (0.05, "K"), "hygric_diffusion": (4.2e-5, "g/m3/h^0.5")}
    parameters = {
        n: {
            "value": v,
            "unit": unit,
            "se": 0.03 * abs(v),
            "lower": 0.94 * v,
            "upper": 1.06 * v,
            "meaning": f"meaning of {n}",
            "prior": {"mean": 0.0, "sd": 0.153} if n.endswith("bias") else None,
            "fixed": False,
            "at_bound": False,
        }
        for n, (v, unit) in values.items()
    }
    parameters["resistance_ratio"] |= {"se": None, "lower": None, "upper": None, "at_bound": True}
    coverage = {
        q: {"coverage": c, "n": 250, "scale": s}
        for q, c, s in (
            ("temperature_K", 0.93, 1.08),
            ("absolute_humidity_g_m3", 0.87, 1.31),
            ("relative_humidity", 0.95, 1.0),
        )
    }
    inputs = {
        n: series[n][early]
        for n in ("ambient_temperature", "ambient_absolute_humidity", "power", "preheating")
    }
    standard = {n: series[f"{n}_innovation"][early] for n in ("temperature", "humidity")}
    return {
        "name": name,
        "provenance": "synthetic",
        "version": "0.1.0",
        "created": "2024-05-01T12:00:00+00:00",
        "criterion": "likelihood",
        "kind": "joint",
        "statements": plain((FitCode.NO_FEED_THROUGH(),)),
        "warnings": ["cabinet_temperature (cabinet.csv, T_cab_degC): 3 readings of −273 °C masked"],
        "rated_power_kW": 2050.0,
        "site": {"latitude_deg": 52.4, "longitude_deg": -0.95, "altitude_m": None},
        "period": {
            "start": _stamp(time[0]),
            "until": _stamp(until),
            "end": _stamp(time[-1]),
            "n_readings": int(np.isfinite(series["temperature_measured"]).sum()),
        },
        "design": {
            "mechanisms": [["heat_release", {"reference_K": REFERENCE_K}]],
            "power_mean": [],
            "ambient_noise": {},
            "statements": [],
        },
        "parameters": parameters,
        "time_constants": {"thermal": _constant(TAU_H, 0.05, 1.52), "hygric": hygric},
        "loglik": 12345.6,
        "aic": -24650.0,
        "bic": -24500.0,
        "n_obs": 7000,
        "converged": True,
        "messages": plain((FitCode.CONVERGED(),)),
        "other_optima": [{"objective": 12001.2, "thermal_time_constant": 8.4, "hygric_k": 2.1}],
        "at_bounds": ["resistance_ratio"],
        "flat": ["hygric_diffusion"],
        "trade_offs": [["heat_release_operation", "heat_release_power_1", -0.96]],
        "rmse": rmse,
        "baselines": baselines,
        "sensor_share": share,
        "bands": {lead: coverage for lead in ("1h", "6h", "24h", "free_run")},
        "heat_release": {
            "operation": _points(series, early & (running > 0), "operation"),
            "standstill": _points(series, early & (running == 0), "standstill"),
            "reference_K": REFERENCE_K,
            "statements": [],
        },
        "innovations": plain(diagnose((time[early] - time[0]) / 3600.0, standard, inputs)),
        "files": [["cabinet.csv", "0f" * 32], ["ambient.csv", "1e" * 32], ["scada.csv", "2d" * 32]],
    }


@cache
def _text(days: float, seed: int) -> tuple[str, dict[str, np.ndarray]]:
    fit, series = _made(days, seed)
    return json.dumps(fit, allow_nan=False), series


def report_case(days: float = DAYS, seed: int = 3) -> tuple[dict, dict[str, np.ndarray]]:
    """(fit, series) of the fixture, fresh copies that a test may change."""
    text, series = _text(days, seed)
    return json.loads(text), {name: value.copy() for name, value in series.items()}


def write_case(directory: Path, fit: dict, series: dict[str, np.ndarray]) -> Path:
    """Write both files as `hygrokf fit` does; returns the directory."""
    directory.mkdir(parents=True, exist_ok=True)
    (directory / "fit.json").write_text(json.dumps(fit), encoding="utf-8")
    np.savez_compressed(directory / "series.npz", **series)
    return directory
