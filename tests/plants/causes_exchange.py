"""Hidden causes in the exchange of air with the outside: a change at a date, doors."""

from __future__ import annotations

import numpy as np

from plants.chance import log_uniform
from plants.drivers import DAY_S, MINUTE_S
from plants.scene import AIR_J_M3_K, Change, Law, Scene


def exchange_of(scene: Scene, factor: np.ndarray) -> dict[str, np.ndarray]:
    """Vapour exchange times a factor, and the heat that the further air carries."""
    return {"exchange": factor, "conductance_W_K": AIR_J_M3_K * scene.air_flow_m3_s * (factor - 1.0)}


def _full_factor(random: np.random.Generator) -> float:
    factor = log_uniform(random, 2.0, 4.0)
    return factor if random.random() < 0.7 else 1.0 / factor


_FACTOR = "factor of the exchange, at least 2 (or 1/2) at strength 1, its square root at 0.5"


def exchange_steps(random: np.random.Generator, scene: Scene) -> Law:
    """Exchange changes at once: a filter mat changed, a gland left open. Factor 2 to 4 or its
    inverse.
    """
    full = _full_factor(random)
    date = scene.drivers.time[0] + MINUTE_S * round(random.uniform(0.2, 0.8) * scene.days * 1440.0)
    after = scene.drivers.time[:-1] >= date

    def change(strength: float) -> Change:
        factor = full**strength
        return Change(
            **exchange_of(scene, np.where(after, factor, 1.0)), parameters={"factor": factor}, dates=(date,)
        )

    return Law("step at a date", 0.0, 2.0, change, lambda strength: strength, _FACTOR)


def exchange_ramps(random: np.random.Generator, scene: Scene) -> Law:
    """Exchange changes over 3 to 15 d: a filter clogs, a seal comes off. Factor 2 to 4 or its
    inverse.
    """
    full = _full_factor(random)
    width_d = random.uniform(3.0, 15.0) * min(scene.days / 90.0, 1.0)
    begin = scene.drivers.time[0] + MINUTE_S * round(random.uniform(0.2, 0.7) * scene.days * 1440.0)
    risen = np.clip((scene.drivers.time[:-1] - begin) / (DAY_S * width_d), 0.0, 1.0)

    def change(strength: float) -> Change:
        factor = full**strength
        return Change(
            **exchange_of(scene, factor**risen),
            parameters={"factor": factor, "ramp_d": width_d},
            dates=(begin, begin + DAY_S * width_d),
        )

    return Law("ramp over some days", 0.0, 2.0, change, lambda strength: strength, _FACTOR)


def vent_opens(random: np.random.Generator, scene: Scene) -> Law:
    """A vent that a controller opens with the warmth that the cabinet would have without it, over a band of 4
    to 10 K.

    Begins to open where 20 to 60 % of the time lies above; wide open it has 2 to 40 times the exchange.
    """
    warmth = scene.trajectory.cabinet_K[:-1]
    start = float(np.quantile(warmth, 1.0 - random.uniform(0.2, 0.6)))
    band = random.uniform(4.0, 10.0)
    position = np.clip((warmth - start) / band, 0.0, 1.0)

    def change(factor: float) -> Change:
        parameters = {"factor": factor, "start_degC": start - 273.15, "band_K": band}
        return Change(**exchange_of(scene, 1.0 + (factor - 1.0) * position), parameters=parameters)

    return Law("vent in proportion to warmth", 1.2, 40.0, change)


def doors_open(random: np.random.Generator, scene: Scene) -> Law:
    """3 to 8 periods of hours in working time with 10 to 30 times the exchange, half of them at
    standstill.

    The amplitude, 0 to 1, leads from 3 periods of 2 h with the drawn factor to 8 of 16 h.
    """
    factor = random.uniform(10.0, 30.0)
    minute = np.arange(scene.drivers.time.size - 1)
    hour = (scene.drivers.time[:-1] % DAY_S) / 3600.0
    working = (hour >= 6.0) & (hour < 13.0) & (minute > 2880) & (minute < minute.size - 1440)
    starts: list[int] = []
    for which in range(8):
        allowed = working & scene.stopped if which % 2 == 0 else working
        for start in starts:
            allowed = allowed & (np.abs(minute - start) > 2 * 1440)
        places = np.flatnonzero(allowed)
        if places.size == 0:
            break
        starts.append(int(random.choice(places)))
    spread = random.uniform(0.6, 1.4, 8)

    def change(amplitude: float) -> Change:
        count = min(3 + round(5.0 * amplitude), len(starts))
        hours = (2.0 + 14.0 * amplitude) * spread
        wide = np.ones(minute.size)
        for start, long in zip(starts[:count], hours, strict=False):
            wide[start : start + round(60.0 * long)] = factor
        dates = tuple(float(scene.drivers.time[start]) for start in sorted(starts[:count]))
        parameters = {"factor": factor, "periods": float(count), "open_h": float(hours[:count].sum())}
        return Change(**exchange_of(scene, wide), parameters=parameters, dates=dates)

    return Law("some periods of hours", 0.0, 1.0, change)


def door_left_open(random: np.random.Generator, scene: Scene) -> Law:
    """One door left open for 0.3 to 12 d with 10 to 30 times the exchange, after a standstill or
    by chance.
    """
    factor = random.uniform(10.0, 30.0)
    size = scene.drivers.time.size - 1
    begin = round(random.uniform(0.15, 0.8) * size)

    def change(days: float) -> Change:
        wide = np.ones(size)
        wide[begin : begin + round(1440.0 * days)] = factor
        first = float(scene.drivers.time[begin])
        return Change(
            **exchange_of(scene, wide),
            parameters={"factor": factor, "open_h": 24.0 * days},
            dates=(first, first + DAY_S * days),
        )

    return Law("one period of days", 0.3, min(12.0, 0.12 * scene.days), change)
