"""The tables of the experiments: this project's numbers beside the paper's."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict

from hygrokf.texts.parts import SCORED
from hygrokf.texts.wording import fixed, percent
from validation.counts import markdown
from validation.paper.cabinets import LocalAir
from validation.paper.models import CRITERIA, FREE_RUN, LIKELIHOOD
from validation.paper.published import PERIODS, SISTER, WHOLE

SIMULATED_NOTE = (
    "Cabinet and local air are simulated; only the drivers (ERA5 air and turbine power) are measured. "
    "The paper's cabinet was measured."
)
"""Stands under the table."""
PUBLISHED = {"periods": PERIODS, "whole": WHOLE, "sister": SISTER}
UNITS = {"temperature_K": "K", "absolute_humidity_g_m3": "g/m³"}
WORDS = {LIKELIHOOD: "likelihood", FREE_RUN: "free run's least error"}


def constants_table(seeds: Sequence[Mapping]) -> str:
    """In how many seeds the bounds of the time constants hold the truth, and estimates over the truth."""
    rows = []
    for air, words in (("local", "local air"), ("era5", "ERA5's air")):
        for criterion in CRITERIA:
            cells = []
            for part in ("thermal", "hygric"):
                ratios = [
                    one["time_constants"][air][part][criterion]["value_h"] / one["truth"][f"{part}_h"]
                    for one in seeds
                ]
                held = f"{holding(seeds, air, part, criterion)} of {len(seeds)}"
                cells.append(f"{held}; {_range(ratios)}")
            rows.append((f"{words}, {WORDS[criterion]}", *cells))
    return markdown(("", "thermal: held; over the truth", "hygric"), rows)


def holding(seeds: Sequence[Mapping], air: str, part: str, criterion: str) -> int:
    """In how many seeds the bounds hold the truth."""
    count = 0
    for one in seeds:
        entry, truth = one["time_constants"][air][part][criterion], one["truth"][f"{part}_h"]
        count += entry["lower_h"] <= truth <= (math.inf if entry["upper_h"] is None else entry["upper_h"])
    return count


SPREAD = (
    ("local", "identification", "local air, identification", ("periods", "identification")),
    ("local", "validation", "local air, validation", ("periods", "validation")),
    ("local", "whole", "local air, whole record", ("whole", "measured")),
    ("era5", "whole", "ERA5's air, whole record", ("whole", "era5")),
    ("sister", "whole", "sister, ERA5's air", ("sister",)),
)
"""(run, period, words, where the paper's number stands)."""


def published_total(path: Sequence[str], quantity: str) -> float:
    """The paper's total of a quantity."""
    there: object = PUBLISHED
    for name in (*path, quantity):
        there = there[name]  # type: ignore[index]
    return float(there)  # type: ignore[arg-type]


def totals(seeds: Sequence[Mapping], run: str, period: str, quantity: str, criterion: str) -> list[float]:
    """Totals of all seeds."""
    return [one["rmse"][run][criterion][period][quantity]["total"] for one in seeds]


def spread_rows(seeds: Sequence[Mapping]) -> list[tuple[str, ...]]:
    """All three experiments over all seeds, the heading first."""
    rows = [("", "paper, measured cabinet", *(f"here, {WORDS[c]}" for c in CRITERIA))]
    for quantity in SCORED:
        unit = UNITS[quantity]
        for run, period, words, path in SPREAD:
            found = (_range(totals(seeds, run, period, quantity, c)) for c in CRITERIA)
            rows.append((f"{words} [{unit}]", fixed(published_total(path, quantity)), *found))
        era5, local = (published_total(("whole", air), quantity) for air in ("era5", "measured"))
        cells = [fixed(era5 - local)]
        for criterion in CRITERIA:
            pair = (totals(seeds, run, "whole", quantity, criterion) for run in ("era5", "local"))
            cells.append(_range([a - b for a, b in zip(*pair, strict=True)]))
        rows.append((f"what ERA5's air adds, whole record [{unit}]", *cells))
    return rows


def spread_note(seeds: Sequence[Mapping]) -> str:
    numbers = [one["seed"] for one in seeds]
    said = f"Seeds {numbers[0]} to {numbers[-1]}" if numbers[1:] else f"Seed {numbers[0]}"
    return (
        f"Root mean squared errors of the free run, operation and standstill together. {said}. "
        f"{SIMULATED_NOTE}"
    )


def _range(values: Sequence[float]) -> str:
    """The value of one seed, the range of several."""
    return fixed(values[0]) if len(values) == 1 else f"{fixed(min(values))} … {fixed(max(values))}"


def air_table(shown: Mapping) -> str:
    """How local air differs from ERA5's or from a weather station: what was measured, what is put in, and
    what came out."""
    apart, put, reached = shown["deviation"], asdict(LocalAir()), shown["local_air"]
    nacelle = apart["nacelle"]
    rows = [
        ("nacelle sensor in France minus ERA5", f"{nacelle['n']:,}", fixed(nacelle["sd_K"]),
         fixed(nacelle["time_h"], 1), "", ""),
        *((f"logger outside house {one['house']} in Finland, to the weather station", f"{one['n']:,}", "", "",
           percent(one["sd"], 1), fixed(one["time_h"], 1)) for one in apart["eaves"]),
        ("put into the local air here", "", fixed(put["temperature_sd_K"]),
         fixed(put["temperature_time_h"], 1), percent(put["vapour_sd"], 1), fixed(put["vapour_time_h"], 1)),
    ]  # fmt: skip
    head = ("", "values", "temperature: sd [K]", "time [h]", "absolute humidity: sd", "time [h]")
    return (
        f"{markdown(head, rows)}\n\nLeft out of the nacelle's sensor: the mean ({nacelle['mean_K']:+.2f} K) "
        f"and the mean course of the day ({nacelle['day_K']:.2f} K). The local air came out "
        f"{reached['temperature_sd_K']:.2f} K and {reached['vapour_sd_g_m3']:.2f} g/m³ from ERA5's."
    )


def table(lines: Sequence[Mapping]) -> str:
    """All tables; what is said of the local air is that of the first seed."""
    seeds = sorted(lines, key=lambda line: line["seed"])
    head, *rows = spread_rows(seeds)
    parts = {
        "Time constants": constants_table(seeds),
        "All experiments over the seeds": f"{markdown(head, rows)}\n\n{spread_note(seeds)}",
        "How the local air was made": air_table(seeds[0]),
    }
    return "\n\n".join(f"## {name}\n\n{text}" for name, text in parts.items())
