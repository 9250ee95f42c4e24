"""Standstills with pre-heating after each: was the air at the cold surface dry when the advice said so:
docs/validation/live_trials.md."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from plants import Logging, build_plant, own_drivers
from plants.drivers import Drivers
from plants.operation import turbine_operation
from plants.outdoors import with_fronts

from hygrokf.data.record import Record
from hygrokf.live.forecast import LONGEST_HEATING_H, STAYS_H, restart
from hygrokf.live.scenarios import NoScenarios
from validation.counts import markdown, rate
from validation.frame import Claim, by_variant
from validation.tracked import DAY_S, SURFACE, tracked, truth

LIMIT = 0.6
HEATED_MIN = 26 * 60
"""Minutes of heating after each standstill: longer than any advice."""
STANDSTILL_DAYS = (1.5, 4.5)
PAUSE_DAYS = (1.0, 2.5)
"""Days of operation between a pre-heating's end and the next standstill."""
COLD = 0.25
"""Share of the time in which the outside air is so cold that the thermostat of a logged heater is closed."""
COLUMNS = ("hours", "probability", "humidity", "wettest", "needed", "before")


def one(variant: str, seed: int, *, days: float = 62.0, learnt: float = 60.0) -> dict:
    """Advices at the ends of a plant's standstills, and how long it truly took; the `heater` plant logs the
    duty of a heater with a thermostat instead of a flag of pre-heating.

    hours advised (−1: none is enough) with their probability, surface humidity [1] at that time, and the
    highest of the hour after it; hours needed until it is below the limit and stays there for as long as an
    advice says (−1: not within the longest); humidity before.
    """
    heater, random = variant == "heater", np.random.default_rng([seed, 99])
    drivers, ends = _drivers(seed, random, days, learnt, heater)
    if not drivers.preheating[: round(learnt * 1440)].any():
        return {"columns": COLUMNS, "rows": [], "without": "pre-heating in the identification period"}
    made = build_plant(f"plant-{seed}", seed, drivers, Logging())
    minutes = made.drivers.time
    case = tracked(made, float(minutes[0]) + learnt * DAY_S, _as_heater if heater else lambda record: record)
    wet = truth(made, minutes).at_surface
    rows, silent = [], 0
    for end in ends:
        point = case.point(float(minutes[end]))
        try:
            ahead = case.scenarios(float(minutes[end]))
            advice = restart(case.plan, point, ahead, SURFACE, LIMIT, case.heating_sd_K)
        except NoScenarios:
            silent += 1
            continue
        here = wet[end : end + HEATED_MIN]
        hours = -1.0 if advice.hours is None else advice.hours
        # the advice counts from the newest estimate, which may be some minutes old
        after = max(round(60.0 * hours - (minutes[end] - point.time) / 60.0), 0)
        then = here[after : after + round(60 * STAYS_H) + 1]
        rows.append((hours, advice.probability, then[0], then.max(), _needed(here), here[0]))
    return {"columns": COLUMNS, "silent": silent, "rows": np.round(rows, 4)}


def _needed(humidity: np.ndarray) -> float:
    """Hours of heating after which the humidity (minutes) is below the limit for `STAYS_H`."""
    stays = round(60 * STAYS_H)
    for minute in range(round(60 * LONGEST_HEATING_H) + 1):
        if np.all(humidity[minute : minute + stays] < LIMIT):
            return minute / 60.0
    return -1.0


def _as_heater(record: Record) -> Record:
    """The record in which the duty of a heater is logged in place of the pre-heating."""
    duty = replace(record["preheating"], signal="heater_duty")
    return replace(record, series=tuple(duty if s.signal == "preheating" else s for s in record.series))


def _drivers(
    seed: int, random: np.random.Generator, days: float, learnt: float, heater: bool
) -> tuple[Drivers, list[int]]:
    """Weather and operation with planned standstills after the identification period, and the minutes of
    their ends.

    A `heater` is also on while it is cold outside, but off at the standstills until their ends.
    """
    drivers = own_drivers(np.random.default_rng(np.random.SeedSequence([seed, 0])), days=learnt + days + 8.0)
    drivers = with_fronts(np.random.default_rng(np.random.SeedSequence([seed, 7])), drivers)
    drivers = turbine_operation(
        np.random.default_rng(np.random.SeedSequence([seed, 5])), drivers, 2.05e6, True
    )
    power, heaters, ends = drivers.power_W.copy(), drivers.preheating.copy(), []
    heaters[round(learnt * 1440) :] = 0.0
    if heater:
        heaters = np.maximum(heaters, drivers.ambient_K < np.quantile(drivers.ambient_K, COLD))
    at = learnt + 2.0
    while at < learnt + days:
        begin = 10 * round(at * 144)
        end = begin + 10 * round(random.uniform(*STANDSTILL_DAYS) * 144)
        power[begin : end + HEATED_MIN] = -3.0e3
        heaters[begin:end] = 0.0
        heaters[end : end + HEATED_MIN] = 1.0
        ends.append(end)
        at = (end + HEATED_MIN) / 1440.0 + random.uniform(*PAUSE_DAYS)
    return replace(drivers, power_W=power, preheating=heaters), ends


def table(lines: Sequence[Mapping]) -> str:
    """Of each variant what came of the advice."""
    return "\n\n".join(f"{variant}: {_table(some)}" for variant, some in by_variant(lines).items())


def _table(lines: Sequence[Mapping]) -> str:
    values = np.array([row for line in lines for row in line["rows"]]).reshape(-1, len(COLUMNS))
    plants = sum(1 for line in lines if line["rows"])
    c = dict(zip(COLUMNS, values.T, strict=True))
    advised, dry, never = c["hours"] > 0.0, c["hours"] == 0.0, c["hours"] < 0.0
    rows = []
    for name, here in (("pre-heat for … h", advised), ("no pre-heating is needed", dry)):
        said = f"{100 * c['probability'][here].mean():.0f} %" if here.any() else ""
        seen = (c["humidity"] < LIMIT, c["wettest"] < LIMIT, c["needed"] > 0.0)
        now, later, needed = (rate(one[here]) for one in seen)
        rows.append((name, int(here.sum()), now, said, later, needed))
    more = f"more than {LONGEST_HEATING_H:.0f} h in {int((c['needed'][never] < 0).sum())}"
    rows.append((f"{LONGEST_HEATING_H:.0f} h are not enough", int(never.sum()), "", "", "", more))
    head = ("advice", "n", "dry at that time", "probability said", "and for the hour after", "needed truly")
    parts = [
        f"{plants} plants with a pre-heating in their identification period (of {len(lines)}), {len(values)} "
        f"restarts, limit {100 * LIMIT:.0f} %.",
        markdown(head, rows),
    ]
    if (known := advised & (c["needed"] >= 0.0)).any():
        hours, needed = c["hours"][known], c["needed"][known]
        parts.append(
            f"Advised {hours.mean():.1f} h on average (median {np.median(hours):.1f} h); truly needed "
            f"{needed.mean():.1f} h (median {np.median(needed):.1f} h) in the same {int(known.sum())} cases."
        )
    return "\n\n".join(parts)


CLAIM = Claim("restart", {"flag": range(200, 230), "heater": range(9001, 9013)}, one, table)
