"""Plants that hide nothing to be named, though their disturbances are no flow with one correlation time."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np

from plants.cabinet import Trajectory
from plants.causes_outside import warmer_probe
from plants.chance import log_uniform, ornstein_uhlenbeck
from plants.drivers import HOUR_S, MINUTE_S, Drivers
from plants.hidden import HIDDEN_OPTIONS, finish, make_scene
from plants.loggers import Logging
from plants.outdoors import MINUTE_H
from plants.plant import Plant, ingredients, plant
from plants.scene import Change, Scene

PROBE_K, PROBE_HUMIDITY, PROBE_H = 0.3, 0.02, (1.0, 6.0)
"""[K], [-] and [h]: how far the air at the probe and the humidity sensor wander, and how slowly."""
FLUCTUATION, FLUCTUATION_H = 0.2, (2.0, 12.0)
"""[-] and [h]: how far the resistances wander about their means, and how slowly."""
BURST_EVERY_D, BURST_H = 2.0, (0.5, 3.0)
"""[d] and [h]: time between bursts on average, and their lengths."""
BURST_K, BURST_KG_M3 = (3.0, 10.0), (5e-4, 2e-3)
"""[K] and [kg/m3] that bursts would lead to if they lasted: as a lamp or a steaming visitor does."""


def _wander(random: np.random.Generator, size: int, hours: tuple[float, float]) -> tuple[np.ndarray, float]:
    """Wandering of unit variance at minutes, and its correlation time [h]."""
    correlation_h = log_uniform(random, *hours)
    return ornstein_uhlenbeck(random, size, MINUTE_H, correlation_h), correlation_h


def probe_wanders(random: np.random.Generator, scene: Scene) -> Change:
    """The air at the probe is now warmer, now colder than the cabinet's and holds the same vapour; the
    humidity sensor errs by a wandering of its own.
    """
    size = scene.drivers.time.size
    warmth, warmth_h = _wander(random, size, PROBE_H)
    error, error_h = _wander(random, size, PROBE_H)

    def sees(drivers: Drivers, run: Trajectory) -> tuple[Drivers, Trajectory]:
        return drivers, warmer_probe(run, PROBE_K * warmth, PROBE_HUMIDITY * error)

    return Change(sees=sees, parameters={"warmth_h": warmth_h, "error_h": error_h})


def resistances_fluctuate(random: np.random.Generator, scene: Scene) -> Change:
    """R_AT and R_D fluctuate independently, each with a lognormal factor."""
    size = scene.drivers.time.size - 1
    heat, heat_h = _wander(random, size, FLUCTUATION_H)
    vapour, vapour_h = _wander(random, size, FLUCTUATION_H)
    conductance = np.expm1(-FLUCTUATION * heat) / scene.cabinet.outer_resistance
    parameters = {"heat_h": heat_h, "vapour_h": vapour_h}
    return Change(conductance_W_K=conductance, exchange=np.exp(-FLUCTUATION * vapour), parameters=parameters)


def heat_and_vapour_burst(random: np.random.Generator, scene: Scene) -> Change:
    """Rare bursts at any time of day, each of both heat and vapour in sizes of its own.

    Vapour that comes with warmth looks like sorption that warmth drives out.
    """
    time, cabinet = scene.drivers.time, scene.cabinet
    count = int(random.poisson(scene.days / BURST_EVERY_D))
    begins = np.sort(random.uniform(time[0], time[-1] - HOUR_S * BURST_H[1], count))
    heat, vapour = np.zeros(time.size - 1), np.zeros(time.size - 1)
    resistance = float(cabinet.diffusion_resistance(np.array(scene.drivers.ambient_K.mean())))
    for begin in begins:
        first = int((begin - time[0]) / MINUTE_S)
        last = first + round(random.uniform(*BURST_H) * HOUR_S / MINUTE_S)
        heat[first:last] += log_uniform(random, *BURST_K) / cabinet.outer_resistance
        vapour[first:last] += log_uniform(random, *BURST_KG_M3) / resistance
    dates = tuple(float(begin) for begin in begins)
    return Change(heat_W=heat, vapour_kg_s=vapour, parameters={"bursts": float(count)}, dates=dates)


def heat_or_vapour_burst(random: np.random.Generator, scene: Scene) -> Change:
    """Rare bursts of heat, and as many of vapour at times of their own."""
    heat, vapour = heat_and_vapour_burst(random, scene), heat_and_vapour_burst(random, scene)
    return replace(heat, vapour_kg_s=vapour.vapour_kg_s)


NULLS = {
    "two_times": None,
    "probe": probe_wanders,
    "resistances": resistances_fluctuate,
    "bursts": heat_and_vapour_burst,
    "apart_bursts": heat_or_vapour_burst,
}
"""Kinds of plants without a cause; "two_times" has a fast and a slow flow each of heat and of vapour."""
QUIET = 1.0 / 3.0
"""[-] share of the usual flows that plants of odd seeds have beside the other kinds of disturbance."""


def change_of(kind: str, seed: int, scene: Scene) -> Change:
    """What a kind of disturbance does to a plant; nothing where all of it is flow."""
    make = NULLS[kind]
    if make is None:
        return Change()
    place = list(NULLS).index(kind)
    return make(np.random.default_rng(np.random.SeedSequence([seed, 9, place])), scene)


def _build(
    name: str,
    seed: int,
    drivers: Drivers,
    logging: Logging,
    *,
    kind: str,
    **options: object,
) -> Plant:
    made = ingredients(seed, drivers, **options)  # type: ignore[arg-type]
    scene = make_scene(made, seed, drivers)
    changes = [change_of(kind, seed, scene)]
    if NULLS[kind] is not None and seed % 2:
        release = scene.release_W
        fewer_W = (QUIET - 1.0) * (made.forcing.heat_W - release)
        changes.append(Change(heat_W=fewer_W, vapour_kg_s=(QUIET - 1.0) * made.forcing.vapour_kg_s))
    return finish(name, seed, made, scene, logging, changes)


def null_plant(seed: int, kind: str, *, days: float = 180.0, **options: object) -> Plant:
    """A random plant without a cause; its disturbances are of a kind of `NULLS`.

    Weather, cabinet and loggers are those of `hidden_plant` of that seed.
    """
    if kind not in NULLS:
        raise ValueError(f"kind must be one of {', '.join(NULLS)}, found {kind!r}")
    flows = {"disturbance": "two-scale"} if kind == "two_times" else {}
    return plant(seed, days=days, build=partial(_build, kind=kind), **{**HIDDEN_OPTIONS, **flows, **options})
