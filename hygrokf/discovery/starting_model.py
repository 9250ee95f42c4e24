"""The base model as a simulator at its maximum, and the temperature on which its vapour runs."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from hygrokf.data.prepared import prepare
from hygrokf.data.record import Record
from hygrokf.discovery.error_model import Instants, filtered
from hygrokf.discovery.estimate import (
    LIGHT,
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
"""Standard deviation of the share by which the ambient sensors' accuracy lets the vapour outside be wrong."""
SCALE_SD = 0.02
"""The same of the humidity sensor's scale."""
LONGEST_RESPONSE_H, SHORTEST_RESPONSE_H = 0.5, 0.002
ACCURACY_SHARE = 1.0 / 6.0
"""Noise of a temperature reading, as a share of the stated accuracy, above which a smoother would smooth the
temperature itself."""
RESPONSE = "cabinet_relative_humidity_response"


def base_designs(record: Record, library: Library = LIBRARY) -> tuple[Design, Design | None]:
    """The designs of heat and of vapour for a record's identification period; none of vapour without
    humidity.

    Beside the base model's own parameters, the vapour has the errors that sensors have within their accuracy:
    a gain of the ambient's vapour, an offset of its relative humidity, a scale and a response time of the
    humidity sensor.
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

    Starts are the parameters' own and the least free-run error; of their maxima the one of the greatest
    likelihood counts among those whose free run errs no more than the readings vary.
    """
    heat, vapour = base_designs(record, library)
    scene = scene_of(record, heat, vapour)
    limits = {RESPONSE: (SHORTEST_RESPONSE_H, LONGEST_RESPONSE_H)}
    simulator = Simulator(scene, heat, vapour, limits=limits, work=SimulationWork())
    quantities = tuple(scene.readings)
    guess = simulator.vector({p.name: p.start for p in simulator.parameters})
    begun = errors_of(simulator, guess, quantities)
    plain = fitted(estimate_at(simulator, begun, guess, plain=True), effort=LIGHT)
    later = errors_of(simulator, plain.theta, quantities)
    found = min(
        (_best(simulator, one, (plain.theta, guess)) for one in (later, begun)), key=lambda one: one.deviance
    )
    return _driven(renewed(found))


def _best(simulator: Simulator, errors: Mapping[str, Instants], starts: Sequence[np.ndarray]) -> Calibration:
    """The best maximum of each quantity over the starts."""
    reached = [fitted(estimate_at(simulator, errors, start)) for start in starts]
    theta = reached[0].theta.copy()
    for q in errors:
        sound = [one for one in reached if free_run_error(one, q) <= np.sqrt(errors[q].largest)]
        best = min(sound or reached, key=lambda one: one.deviances[q] if sound else free_run_error(one, q))
        mine = [i for i, name in enumerate(simulator.names) if q in simulator.affects(name)]
        theta[mine] = best.theta[mine]
    return fitted(estimate_at(simulator, errors, theta))


def free_run_error(one: Calibration, quantity: str) -> float:
    """Root mean squared error of the simulation in the identification period."""
    return float(np.sqrt(np.nanmean(one.residual(quantity) ** 2)))


def _driven(one: Calibration) -> Calibration:
    """The estimate whose vapour runs on the smoothed temperature."""
    simulator = one.simulator
    if "vapour" not in one.quantities:
        return one
    scene = driven(simulator.scene, smoothed_temperature(one))
    return renewed(replace(one, simulator=replace(simulator, scene=scene, _cells={})))


def renewed(one: Calibration, moved: Collection[str] | None = None) -> Calibration:
    """The estimate at its maximum, under error models with its own time constants where these are likelier.

    moved: quantities to which this is done (all).  A time constant that ends at a limit is no low pass of
    the disturbances.
    """
    mine = [q for q in one.quantities if moved is None or q in moved]
    own, free = errors_of(one.simulator, one.theta, one.quantities), acting(one, mine)

    def under(courses: Mapping[str, Instants], theta: np.ndarray) -> Calibration:
        errors = {**one.errors, **courses}
        return fitted(estimate_at(one.simulator, errors, theta, one.linear, one.variances), free)

    both = [under({}, one.theta), under({q: own[q] for q in mine}, one.theta)]
    better = {q: int(both[1].deviances[q] < both[0].deviances[q]) for q in mine}
    if len(set(better.values())) == 1:
        return both[better[mine[0]]]
    theta = both[0].theta.copy()
    for i, name in enumerate(one.simulator.names):
        if all(better.get(q) for q in one.simulator.affects(name)):
            theta[i] = both[1].theta[i]
    return under({q: both[i].errors[q] for q, i in better.items()}, theta)


def smoothed_temperature(one: Calibration) -> np.ndarray:
    """(F,) [K] the simulated temperature plus its smoothed error, at the edges of parts of cells.

    Up to the end of the identification period it uses identification readings only.  The readings' noise is
    at most that of their sensor: what varies faster, such as a heater's cycles, is temperature.
    """
    scene: Scene = one.simulator.scene
    readings = scene.readings["temperature"]
    series = scene.record[TEMPERATURE]
    own = series.resolution**2 / 12.0 + (ACCURACY_SHARE * accuracy_of(series)) ** 2
    variances = one.variances["temperature"].copy()
    variances[0] = min(variances[0], own) if own > 0.0 else variances[0]
    course = one.errors["temperature"]
    error = readings.value - one.simulated["temperature"]
    early = filtered(course, variances, np.where(readings.identified, error, np.nan)).smoothed()
    whole = filtered(course, variances, error).smoothed()
    shown = one.simulator.shown(one.theta[:, None], "temperature")[:, 0]
    at_edges = np.interp(scene.edges_s, scene.edges_s[::PARTS], np.append(shown[:1], shown))
    middle = 0.5 * (readings.begin + readings.end) * (3600.0 * scene.cell_h) + scene.first_s
    return at_edges + np.interp(scene.edges_s, middle, np.where(readings.identified, early, whole))
