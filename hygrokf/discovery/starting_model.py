"""The base model as a simulator at its maximum likelihood, and the temperature that drives its vapour."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from hygrokf.data.prepared import prepare
from hygrokf.data.record import Record
from hygrokf.discovery.error_model import Instants, filtered
from hygrokf.discovery.estimate import (
    LIGHT,
    TIME_CONSTANT,
    Calibration,
    acting,
    errors_of,
    estimate_at,
    fitted,
)
from hygrokf.discovery.residuals import ambient_sd
from hygrokf.discovery.scene import PARTS, Scene, driven, scene_of
from hygrokf.discovery.simulator import SimulationWork, Simulator
from hygrokf.identification.steady_state import heat_release_regression
from hygrokf.modelling.causes.forms import AMBIENT_HUMIDITY, MechanismSettings
from hygrokf.modelling.design import CASCADE, TEMPERATURE, Design, accuracy_of, design, extended
from hygrokf.modelling.library import LIBRARY, Library

GAIN_SD = 0.015
"""Standard deviation of the relative error of the ambient vapour within the accuracy of its sensors."""
SCALE_SD = 0.02
"""Standard deviation of the relative error of the humidity sensor's scale."""
LONGEST_RESPONSE_H, SHORTEST_RESPONSE_H = 0.5, 0.002
"""[h] limits of the humidity sensor's response time where none is stated."""
ACCURACY_SHARE = 1.0 / 6.0
"""Largest noise of a temperature reading, as a share of the stated accuracy: with more, the smoother would
remove variations of the temperature itself."""
RESPONSE = "cabinet_relative_humidity_response"


def base_designs(record: Record, library: Library = LIBRARY) -> tuple[Design, Design | None]:
    """The designs of heat and of vapour for a record's identification period; without humidity readings the
    design of vapour is None.

    Besides the base model's parameters, the vapour has errors that the sensors' accuracy allows: a gain of
    the ambient vapour, an offset of its relative humidity, a scale and a response time of the humidity
    sensor.
    """
    early = prepare(record.identification())
    regression = heat_release_regression(early)
    heat = design(
        early, kind="thermal", power_order=regression.power_order, heat_start=regression.start(),
        library=library,
    )  # fmt: skip
    moist = design(early, kind=CASCADE, library=library)
    if moist.humidity is None:
        return heat, None
    additions: list[MechanismSettings] = [("breathed_air", {"form": "temperature"})]
    priors = {"breathed_gain": (0.0, GAIN_SD, False)}
    sd = ambient_sd(early, AMBIENT_HUMIDITY)
    if sd > 0.0:
        additions.append(("breathed_air", {"form": "humidity"}))
        priors["breathed_humidity_offset"] = (0.0, sd, False)
    mechanisms = moist.mechanisms
    if moist.humidity == "cabinet_relative_humidity":
        additions.append(("humidity_scale", {"flag": None}))
        priors["humidity_scale_error"] = (0.0, SCALE_SD, False)
        mechanisms = tuple(
            (name, {**settings, "longest_response_h": LONGEST_RESPONSE_H})
            if name == "humidity_sensor" and not settings.get("response_h")
            else (name, settings)
            for name, settings in mechanisms
        )
    moist = extended(replace(moist, mechanisms=mechanisms), additions)
    return heat, replace(moist, priors={**moist.priors, **priors})


def base_estimate(record: Record, library: Library = LIBRARY) -> Calibration:
    """The base model of a record at its maximum of the likelihood.

    The search starts at the parameters' start values and at the minimum of the free-run error.  Of the
    maxima whose free-run error is at most the standard deviation of the readings, the likeliest is chosen.
    """
    heat, vapour = base_designs(record, library)
    scene = scene_of(record, heat, vapour)
    limits = {RESPONSE: (SHORTEST_RESPONSE_H, LONGEST_RESPONSE_H)}
    simulator = Simulator(scene, heat, vapour, limits=limits, work=SimulationWork())
    quantities = tuple(scene.readings)
    guess = simulator.vector({p.name: p.start for p in simulator.parameters})
    start_errors = errors_of(simulator, guess, quantities)
    plain = fitted(estimate_at(simulator, start_errors, guess, plain=True), effort=LIGHT)
    fitted_errors = errors_of(simulator, plain.theta, quantities)
    fits = [_best(simulator, errors, (plain.theta, guess)) for errors in (fitted_errors, start_errors)]
    best = min(fits, key=lambda fit: fit.deviance)
    return _drive_vapour(update_error_models(best))


def _best(simulator: Simulator, errors: Mapping[str, Instants], starts: Sequence[np.ndarray]) -> Calibration:
    """The maximum that has, for each quantity, the parameters of the best fit over the starts."""
    fits = [fitted(estimate_at(simulator, errors, start)) for start in starts]
    theta = fits[0].theta.copy()
    for q in errors:
        plausible = [fit for fit in fits if is_plausible(fit, q)]
        best = min(
            plausible or fits, key=lambda fit: fit.deviances[q] if plausible else free_run_error(fit, q)
        )
        own_places = [i for i, name in enumerate(simulator.names) if q in simulator.affects(name)]
        theta[own_places] = best.theta[own_places]
    return fitted(estimate_at(simulator, errors, theta))


def free_run_error(estimate: Calibration, quantity: str) -> float:
    """Root mean square error of a quantity's simulation in the identification period."""
    return float(np.sqrt(np.nanmean(estimate.residual(quantity) ** 2)))


def is_plausible(estimate: Calibration, quantity: str) -> bool:
    """Whether the simulation of a quantity errs no more than its identification readings vary."""
    return free_run_error(estimate, quantity) <= float(np.sqrt(estimate.errors[quantity].largest))


def screening_point(estimate: Calibration) -> Calibration:
    """The estimate with the time constants of implausible quantities at their start values.

    Such a time constant describes what the model lacks: the search would not see effects that show only with
    another time constant.  The other parameters and the variances are refitted.
    """
    simulator = estimate.simulator
    held = {TIME_CONSTANT[q]: q for q in estimate.quantities if not is_plausible(estimate, q)}
    if not held:
        return estimate
    start_values = {p.name: p.start for p in simulator.parameters if p.name in held}
    theta = simulator.vector({**estimate.values, **start_values})
    moved = estimate_at(simulator, estimate.errors, theta, estimate.linear)
    return fitted(moved, [name for name in acting(moved, held.values()) if name not in held])


def _drive_vapour(estimate: Calibration) -> Calibration:
    """Refit the estimate with its vapour driven by the smoothed temperature."""
    simulator = estimate.simulator
    if "vapour" not in estimate.quantities:
        return estimate
    scene = driven(simulator.scene, smoothed_temperature(estimate))
    return update_error_models(replace(estimate, simulator=replace(simulator, scene=scene, _cells={})))


def update_error_models(estimate: Calibration, quantities: Collection[str] | None = None) -> Calibration:
    """Refit an estimate, under error models with its own time constants where these are likelier.

    quantities: those whose error models may change (None: all).  A time constant that ended at a limit may
    not be the low pass of the disturbances: the earlier error model stays where it is likelier.
    """
    chosen = [q for q in estimate.quantities if quantities is None or q in quantities]
    new_errors = errors_of(estimate.simulator, estimate.theta, estimate.quantities)
    free = acting(estimate, chosen)

    def refit(changed: Mapping[str, Instants], theta: np.ndarray) -> Calibration:
        errors = {**estimate.errors, **changed}
        start = estimate_at(estimate.simulator, errors, theta, estimate.linear, estimate.variances)
        return fitted(start, free)

    old = refit({}, estimate.theta)
    new = refit({q: new_errors[q] for q in chosen}, estimate.theta)
    improved = {q: new.deviances[q] < old.deviances[q] for q in chosen}
    if all(improved.values()):
        return new
    if not any(improved.values()):
        return old
    theta = old.theta.copy()
    for i, name in enumerate(estimate.simulator.names):
        if all(improved.get(q, False) for q in estimate.simulator.affects(name)):
            theta[i] = new.theta[i]
    return refit({q: new.errors[q] if improved[q] else old.errors[q] for q in chosen}, theta)


def smoothed_temperature(estimate: Calibration) -> np.ndarray:
    """(F,) [K] the simulated temperature plus its smoothed error, at the edges of parts of cells.

    Up to the end of the identification period the smoother uses identification readings only.  The noise of
    the readings is at most that of the sensor, so that fast variations such as a heater's cycles remain.
    """
    scene: Scene = estimate.simulator.scene
    readings = scene.readings["temperature"]
    series = scene.record[TEMPERATURE]
    sensor_variance = series.resolution**2 / 12.0 + (ACCURACY_SHARE * accuracy_of(series)) ** 2
    variances = estimate.variances["temperature"].copy()
    variances[0] = min(variances[0], sensor_variance) if sensor_variance > 0.0 else variances[0]
    course = estimate.errors["temperature"]
    error = readings.value - estimate.simulated["temperature"]
    early_error = filtered(course, variances, np.where(readings.identified, error, np.nan)).smoothed()
    full_error = filtered(course, variances, error).smoothed()
    shown = estimate.simulator.shown(estimate.theta[:, None], "temperature")[:, 0]
    at_edges = np.interp(scene.edges_s, scene.edges_s[::PARTS], np.append(shown[:1], shown))
    middle_s = 0.5 * (readings.begin + readings.end) * (3600.0 * scene.cell_h) + scene.first_s
    return at_edges + np.interp(
        scene.edges_s, middle_s, np.where(readings.identified, early_error, full_error)
    )
