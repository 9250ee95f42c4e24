"""How often the bounds of a simulated climate hold: docs/validation/coverage.md and real_input.md.

A plant (tests/plants: other equations, integrator and units than the package's) stands under the measured
weather and power of a UK wind farm, 2018 and 2019.  The model is identified on 120 days of 2018; the climate
of 2019 is simulated from weather and power alone, with bounds; both are held against what the plant itself
did in 2019.  About 15 s a plant on one core.

Measured attics: identified up to a date, their air is simulated for the year after it, or what there is of
it, and held against the readings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from other_make.moist_air import saturation_pressure

from hygrokf import identify
from hygrokf.climate.bounds import bounded
from hygrokf.climate.chamber import Acceleration
from hygrokf.climate.climate_profile import SHARES as LEVELS
from hygrokf.climate.climate_profile import reduced
from hygrokf.climate.ensemble import course, draw_members, shots_of, simulate_years
from hygrokf.climate.region import driven
from hygrokf.data.record import Record
from hygrokf.physics.psychrometrics import Surface, condenses
from validation.counts import markdown
from validation.frame import Claim, by_variant
from validation.records import expect, measured

NAMES = (
    "mean_temperature_degC", "mean_relative_humidity_percent", "mean_absolute_humidity_g_m3", "wetness_h",
    "condensation_h", "ageing_h", "humidity_above_80_number", "temperature_rate_99_K_per_h",
    "relative_humidity_rate_99_percent_per_h", "temperature_cycles_from_5_K_number",
    "temperature_cycles_from_10_K_number", "temperature_cycles_from_20_K_number",
)  # fmt: skip
SHARES = (0.01, 0.1, 0.5, 0.9, 0.99)
DAY_S = 86400.0
FIT_DAYS = 120.0
ATTICS = ("attic R2", "attic R4", "attic R7")
UNTIL = "2011-11-25"
"""End of the attics' identification."""
Truth = Callable[[object], tuple[np.ndarray, ...]]
"""A simulated year -> whether each instant is known (T,), temperatures [K] and vapour pressures [Pa] of the
air (1, T), and the temperature outside [K] (T,)."""


def one(variant: str, seed: int, *, members: int = 50) -> dict:
    """Truth and bounds of every statistic of a plant or an attic."""
    early, later, power, truth = _attic(variant) if variant in ATTICS else _plant(variant, seed)
    fit = identify(early, starts=1, profiles=False)
    whole, _ = driven(fit, later, power)
    drawn, surface, made = draw_members(fit, members, seed), Surface(), course(fit, whole)
    (year,) = simulate_years(fit, *made, drawn, seed, surface, rare=shots_of(fit, *made))
    known, air, pressure, outside = truth(year)
    year = replace(year, known=year.known & known)
    true = replace(
        year,
        temperature_K=air,
        relative_humidity=pressure / saturation_pressure(air),
        absolute_humidity_g_m3=1e3 * pressure / (461.5 * air),
        condensing=condenses(pressure, surface.temperature(outside, air)),
    )
    rows = held_against(year, true)
    return {
        "statistics": rows,
        "said": f"{sum(row['held'] for row in rows.values())} of {len(rows)}",
    }


def _plant(disturbance: str, seed: int) -> tuple[Record, Record, Record, Truth]:
    """Records to identify and of weather and power, and the truth, of a plant under measured drivers."""
    from plants import uk_plant
    from plants.as_record import to_record

    expect("kelmarsh_2018_2019_era5_power_hourly.csv.gz")
    made = uk_plant(seed, days=715.0, start="2018-01-10T00:00:00", disturbance=disturbance)
    record = to_record(made)
    begin = record.start_s + DAY_S * np.random.default_rng([seed, 9]).integers(5, 225)
    later = _seconds("2019-01-01")
    weather = record.window(later, later + 400 * DAY_S)

    def truth(year) -> tuple[np.ndarray, ...]:
        place = np.searchsorted(made.drivers.time, year.time_s)
        air, vapour = (
            course[place][None, :] for course in (made.trajectory.cabinet_K, made.trajectory.cabinet_kg_m3)
        )
        return np.ones(len(place), bool), air, vapour * 461.5 * air, made.drivers.ambient_K[place]

    return record.window(begin, begin + DAY_S * FIT_DAYS), weather, weather, truth


def _attic(name: str) -> tuple[Record, Record, None, Truth]:
    """The same of a measured attic, where nothing but readings is known of the air."""
    record, cut = replace(measured(name), until_s=None), _seconds(UNTIL)

    def truth(year) -> tuple[np.ndarray, ...]:
        read = []
        for signal in ("cabinet_temperature", "cabinet_relative_humidity"):
            series = record[signal]
            place = np.minimum(np.searchsorted(series.time, year.time_s - 1.0), len(series.time) - 1)
            there = np.abs(series.time[place] - year.time_s) < 1.0
            read.append(np.where(there, series.value[place], np.nan))
        known = np.isfinite(read[0]) & np.isfinite(read[1])
        # what is not known is not counted; these only stand in
        air, humidity = np.where(known, read[0], 280.0)[None, :], np.where(known, read[1], 0.5)[None, :]
        return known, air, humidity * saturation_pressure(air), year.ambient["temperature_K"]

    return record.window(record.start_s, cut), record.window(cut, cut + 366 * DAY_S), None, truth


def _seconds(date: str) -> float:
    return float(np.datetime64(date, "s").astype(int))


def held_against(year, truth) -> dict:
    """Bounds of every statistic of an ensemble's year beside what it truly was."""
    law = Acceleration()
    found, true = reduced(year, law), reduced(truth, law)
    rows = {name: _row(bounded(found["all", name][None]), true["all", name][0]) for name in NAMES}
    for (kind, quantity), values in found.items():
        for share in SHARES if kind == "duration" else ():
            i = int(np.argmin(np.abs(np.array(LEVELS) - share)))
            found_i = bounded(values[None, :, i])
            rows[f"{quantity} beyond {100 * share:g} %"] = _row(found_i, true[kind, quantity][0, i])
    return rows


def _row(found, truth: float) -> dict:
    low, value, high = (float(x) for x in (found.lower, found.value, found.upper))
    return {
        "truth": float(truth), "value": value, "lower": low, "upper": high,
        "held": bool(low - 1e-9 <= truth <= high + 1e-9),
    }  # fmt: skip


def table(lines: Sequence[Mapping]) -> str:
    """How often each statistic's bounds held, by variant."""
    parts = []
    for variant, some in by_variant(lines).items():
        these = [line["statistics"] for line in some]
        held = {name: sum(one[name]["held"] for one in these) for name in these[0]}
        rows = [(name.replace("_", " "), count, len(these)) for name, count in held.items()]
        rows.append(("all", sum(held.values()), len(these) * len(held)))
        parts.append(f"{variant}: {len(these)}\n\n{markdown(('statistic', 'held', 'of'), rows)}\n")
    return "\n".join(parts)


CLAIM = Claim(
    "climate",
    {
        **dict.fromkeys(("ou", "shot"), range(2561, 2576)),
        **dict.fromkeys(("power-law", "two-scale", "diurnal-modulated"), range(2581, 2587)),
        **dict.fromkeys(ATTICS, range(1, 2)),
    },
    one,
    table,
)
