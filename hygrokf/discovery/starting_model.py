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
    TIME_CONSTANT_OF,
    Calibration,
    acting,
    errors_of,
    estimate_at,
    fitted,
)
from hygrokf.discovery.residuals import ambient_sd
from hygrokf.discovery.scene import CELL_PARTS, Scene, driven, scene_of
from hygrokf.discovery.simulator import SimulationWork, Simulator
from hygrokf.identification.steady_state import heat_release_regression
from hygrokf.modelling.causes.forms import MechanismSettings
from hygrokf.modelling.design import CASCADE, Design, accuracy_of, design, extended
from hygrokf.modelling.library import LIBRARY, Library
from hygrokf.physics.signal_names import AMBIENT_RELATIVE_HUMIDITY, CABINET_TEMPERATURE

GAIN_SD = 0.015
"""Standard deviation of the relative error of the ambient vapour that the sensors' accuracy allows."""
SCALE_SD = 0.02
"""Standard deviation of the relative error of the humidity sensor's scale."""
LONGEST_FREE_RESPONSE_H, SHORTEST_FREE_RESPONSE_H = 0.5, 0.002
"""[h] limits of the humidity sensor's response time if none is stated."""
ACCURACY_SHARE = 1.0 / 6.0
"""Largest noise of a temperature reading, as a share of the stated accuracy: with more, the smoother would
remove variations of the temperature itself."""
RESPONSE_PARAMETER = "cabinet_relative_humidity_response"


def base_designs(record: Record, library: Library = LIBRARY) -> tuple[Design, Design | None]:
    """Return the designs of heat and of vapour for a record; the latter is None without humidity readings.

    The vapour design also has the errors that the sensors' accuracy allows: a gain of the ambient vapour, an
    offset of its relative humidity, a scale and a response time of the humidity sensor.
    """
    identification_part = prepare(record.identification())
    regression = heat_release_regression(identification_part)
    heat_design = design(
        identification_part,
        kind="thermal",
        power_order=regression.power_order,
        heat_start=regression.start(),
        library=library,
    )
    vapour_design = design(identification_part, kind=CASCADE, library=library)
    if vapour_design.humidity is None:
        return heat_design, None
    additions: list[MechanismSettings] = [("breathed_air", {"form": "temperature"})]
    priors = {"breathed_gain": (0.0, GAIN_SD, False)}
    humidity_sd = ambient_sd(identification_part, AMBIENT_RELATIVE_HUMIDITY)
    if humidity_sd > 0.0:
        additions.append(("breathed_air", {"form": "humidity"}))
        priors["breathed_humidity_offset"] = (0.0, humidity_sd, False)
    mechanisms = vapour_design.mechanisms
    if vapour_design.humidity == "cabinet_relative_humidity":
        additions.append(("humidity_scale", {"flag": None}))
        priors["humidity_scale_error"] = (0.0, SCALE_SD, False)
        mechanisms = tuple(
            (name, {**settings, "longest_response_h": LONGEST_FREE_RESPONSE_H})
            if name == "humidity_sensor" and not settings.get("response_h")
            else (name, settings)
            for name, settings in mechanisms
        )
    vapour_design = extended(replace(vapour_design, mechanisms=mechanisms), additions)
    return heat_design, replace(vapour_design, priors={**vapour_design.priors, **priors})


def base_estimate(record: Record, library: Library = LIBRARY) -> Calibration:
    """Fit the base model of a record by maximum likelihood.

    The search starts at the parameters' start values and at the minimum of the free-run error.  Of the maxima
    found, the likeliest is taken whose free-run error is at most the standard deviation of the readings.
    """
    heat, vapour = base_designs(record, library)
    scene = scene_of(record, heat, vapour)
    limits = {RESPONSE_PARAMETER: (SHORTEST_FREE_RESPONSE_H, LONGEST_FREE_RESPONSE_H)}
    simulator = Simulator(scene, heat, vapour, limits=limits, work=SimulationWork())
    quantities = tuple(scene.readings)
    start_theta = simulator.vector({p.name: p.start for p in simulator.parameters})
    start_errors = errors_of(simulator, start_theta, quantities)
    least_squares_fit = fitted(estimate_at(simulator, start_errors, start_theta, plain=True), effort=LIGHT)
    fitted_errors = errors_of(simulator, least_squares_fit.theta, quantities)
    fits = [
        _best(simulator, errors, (least_squares_fit.theta, start_theta))
        for errors in (fitted_errors, start_errors)
    ]
    best = min(fits, key=lambda fit: fit.deviance)
    return _drive_vapour(update_error_models(best))


def _best(simulator: Simulator, errors: Mapping[str, Instants], starts: Sequence[np.ndarray]) -> Calibration:
    """Fit from each start and return one fit that combines the best parameters of each quantity."""
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
    """Return the root mean square error of a quantity's simulation in the identification period."""
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
    held = {TIME_CONSTANT_OF[q]: q for q in estimate.quantities if not is_plausible(estimate, q)}
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
    """Refit an estimate, with error models based on its own time constants where these are likelier.

    quantities: whose error models may change; None: all.  The old error model is kept where it is likelier,
        since a time constant that ended at a limit may not be the low pass of the disturbances.
    """
    quantities_to_change = [q for q in estimate.quantities if quantities is None or q in quantities]
    new_errors = errors_of(estimate.simulator, estimate.theta, estimate.quantities)
    free = acting(estimate, quantities_to_change)

    def refit(changed: Mapping[str, Instants], theta: np.ndarray) -> Calibration:
        """Refit the estimate from parameters theta with some error models changed."""
        errors = {**estimate.errors, **changed}
        start = estimate_at(estimate.simulator, errors, theta, estimate.linear, estimate.variances)
        return fitted(start, free)

    with_old_errors = refit({}, estimate.theta)
    with_new_errors = refit({q: new_errors[q] for q in quantities_to_change}, estimate.theta)
    improved = {q: with_new_errors.deviances[q] < with_old_errors.deviances[q] for q in quantities_to_change}
    if all(improved.values()):
        return with_new_errors
    if not any(improved.values()):
        return with_old_errors
    theta = with_old_errors.theta.copy()
    for i, name in enumerate(estimate.simulator.names):
        if all(improved.get(q, False) for q in estimate.simulator.affects(name)):
            theta[i] = with_new_errors.theta[i]
    return refit(
        {
            q: with_new_errors.errors[q] if improved[q] else with_old_errors.errors[q]
            for q in quantities_to_change
        },
        theta,
    )


def smoothed_temperature(estimate: Calibration) -> np.ndarray:
    """Return the simulated temperature plus its smoothed error, (F,) [K] at the edges of parts of cells.

    Up to the end of the identification period only its readings are used.  The noise of the readings is
    limited to that of the sensor, so that fast variations such as a heater's cycles remain.
    """
    scene: Scene = estimate.simulator.scene
    readings = scene.readings["temperature"]
    series = scene.record[CABINET_TEMPERATURE]
    sensor_variance = series.resolution**2 / 12.0 + (ACCURACY_SHARE * accuracy_of(series)) ** 2
    variances = estimate.variances["temperature"].copy()
    variances[0] = min(variances[0], sensor_variance) if sensor_variance > 0.0 else variances[0]
    instants = estimate.errors["temperature"]
    error = readings.value - estimate.simulated["temperature"]
    early_error = filtered(instants, variances, np.where(readings.identified, error, np.nan)).smoothed()
    full_error = filtered(instants, variances, error).smoothed()
    simulated_K = estimate.simulator.shown(estimate.theta[:, None], "temperature")[:, 0]
    at_edges = np.interp(scene.edges_s, scene.edges_s[::CELL_PARTS], np.append(simulated_K[:1], simulated_K))
    middle_s = 0.5 * (readings.begin + readings.end) * (3600.0 * scene.cell_h) + scene.first_s
    return at_edges + np.interp(
        scene.edges_s, middle_s, np.where(readings.identified, early_error, full_error)
    )
