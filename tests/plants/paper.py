"""The paper's own case: a six-day standstill, pre-heating, a moisture peak; and cases that only
look like it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from plants.cabinet import Forcing
from plants.causes_moisture import lumped_sorption, slab_sorption
from plants.drivers import HOUR_S, Drivers
from plants.hidden import HIDDEN_OPTIONS, Search, finish, make_scene
from plants.loggers import Logging
from plants.operation import planned_standstill
from plants.plant import Plant, ingredients, plant
from plants.scene import Change, Form, Law, Scene, coarse_change, states
from plants.strength import find_amplitude

STANDSTILL_AFTER_DAYS = 71.0
STANDSTILL_DAYS = 6.0
PREHEATING_H = 24.0
DECOYS = ("film", "source")
_DRAWS = 8


def _film(begin: int, heated: int, end: int) -> Form:
    """A plate that coolant keeps warm except in the standstill, when a radiator under the sky
    cools it.
    """

    def form(random: np.random.Generator, scene: Scene) -> Law:
        undercooling, warm = random.uniform(2.5, 6.0), random.uniform(8.0, 15.0)
        terms = {
            "film_m_s": 1e-3 * random.uniform(2.0, 5.0),
            "surface_s": HOUR_S * random.uniform(1.0, 4.0),
            "surface_share": random.uniform(0.0, 0.1),
        }
        tends = np.full(scene.drivers.time.size, warm)
        tends[begin:heated] = -undercooling

        def change(area: float) -> Change:
            parameters = {"area_m2": area, "undercooling_K": undercooling, **terms}
            dates = (float(scene.drivers.time[begin]), float(scene.drivers.time[end]))
            given = {"film_m2": area, **terms}
            return Change(terms=given, surface_K=tends, parameters=parameters, dates=dates)

        return Law("film that forms in one standstill only", 0.05, 40.0, change)

    return form


def _source(begin: int, heated: int, end: int) -> Form:
    """Vapour from somewhere else, from a time in the standstill to the end of the pre-heating."""

    def form(random: np.random.Generator, scene: Scene) -> Law:
        first = begin + round(random.uniform(0.0, 0.6) * (heated - begin))
        on = np.zeros(scene.drivers.time.size - 1)
        on[first:end] = 1.0

        def change(rate: float) -> Change:
            dates = (float(scene.drivers.time[first]), float(scene.drivers.time[end]))
            vapour = 1e-3 * rate / HOUR_S * on
            return Change(vapour_kg_s=vapour, parameters={"rate_g_h": rate}, dates=dates)

        return Law("vapour source in one standstill only", 0.5, 200.0, change)

    return form


def _peak(search: Search, heated: int, end: int) -> Callable[[Change], float]:
    """Height of the moisture peak in the pre-heating that a change adds [kg/m3], without
    disturbances.
    """
    calm = replace(
        search.coarse, forcing=Forcing(search.coarse.release_W, np.zeros(search.coarse.release_W.size))
    )
    bare = states(calm, ())[0].cabinet_kg_m3
    every = round(calm.step_s / search.fine.step_s)
    inside = slice(heated // every, end // every)

    def peak(change: Change) -> float:
        run, _ = states(calm, (coarse_change(change, every),))
        return float(np.max(run.cabinet_kg_m3[inside] - bare[inside]))

    return peak


def _build(
    name: str,
    seed: int,
    drivers: Drivers,
    logging: Logging,
    *,
    decoy: str | None,
    form: int,
    **options: object,
) -> Plant:
    drivers, begin, end = planned_standstill(
        drivers,
        after_days=STANDSTILL_AFTER_DAYS,
        days=STANDSTILL_DAYS + PREHEATING_H / 24.0,
        preheating_h=PREHEATING_H,
    )
    heated = end - round(60.0 * PREHEATING_H)
    made = ingredients(seed, drivers, **options)  # type: ignore[arg-type]
    scene = make_scene(made, seed, drivers)
    search = Search(scene)
    peak = _peak(search, heated, end)
    random = np.random.default_rng(
        np.random.SeedSequence([seed, 8, form, DECOYS.index(decoy) + 1 if decoy else 0])
    )
    wanted = 1e-3 * random.uniform(1.0, 2.2)
    cause, make = {
        None: ("moisture_sorption", (lumped_sorption, slab_sorption)[form]),
        "film": ("condensation", _film(begin, heated, end)),
        "source": ("internal_moisture_source", _source(begin, heated, end)),
    }[decoy]
    best: tuple[float, bool, Law, float] | None = None
    for _ in range(_DRAWS):
        law = make(random, scene)
        amplitude, limited = find_amplitude(
            lambda one, law=law: peak(law.change(one)) / wanted, law.low, law.high, 1.0
        )
        height = peak(law.change(amplitude))
        if best is None or abs(height - wanted) < abs(best[3] - wanted):
            best = (amplitude, limited, law, height)
        if not best[1]:
            break
    assert best is not None
    amplitude, limited, law, height = best
    sized = replace(
        law,
        size=lambda _: amplitude,
        measure="moisture peak in the pre-heating above the bare model [g/m3], `peak_g_m3`",
    )
    change, hidden = search.settle(cause, form, sized, 1.0, amplitude, limited)
    parameters = {**hidden.parameters, "peak_g_m3": 1e3 * height, "wanted_peak_g_m3": 1e3 * wanted}
    account = replace(hidden, reached=height / wanted, limited=limited, parameters=parameters)
    return finish(name, seed, made, scene, logging, [change], (account,))


def paper_case(
    seed: int, *, decoy: str | None = None, form: int = 1, days: float = 180.0, **options: object
) -> Plant:
    """The plant of the paper's open end: sorbed moisture that pre-heating drives out after a
    six-day standstill.

    From mid-July on; the standstill begins on 24 September, its last day is followed by 24 h of
    pre-heating, and there is no other standstill of days. Time constants are the paper's, 1.5 h
    and 0.3 h. The peak is 1 to 2.2 g/m3. decoy: None for sorption; "film" for condensate that
    only this standstill brings, "source" for a leak that only it has. form: of the sorption, 0
    lumped, 1 slab. options: those of `plant`.
    """
    if decoy is not None and decoy not in DECOYS:
        raise ValueError(f"decoy must be None or one of {DECOYS}, found {decoy!r}")
    least = STANDSTILL_AFTER_DAYS + STANDSTILL_DAYS + PREHEATING_H / 24.0 + 2.0
    if days < least:
        raise ValueError(
            f"the standstill ends {least - 2.0:g} days after the start: ask for {least:g} days at least"
        )
    build = partial(_build, decoy=decoy, form=form)
    given: dict[str, object] = {
        **HIDDEN_OPTIONS,
        "operation": "plain",
        "preheating": False,
        "faults": 0,
        "tau_h": 1.5,
        "hygric_h": 0.3,
    }
    return plant(seed, days=days, build=build, **{**given, **options})
