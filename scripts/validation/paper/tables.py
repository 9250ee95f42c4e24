"""The tables of the experiments: this project's numbers beside the paper's."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict

from hygrokf.evaluation.scoring import SCORED
from hygrokf.identification.wording import NONE, fixed, percent, plain_number
from hygrokf.report.fit_tables import REGIMES
from validation.counts import markdown
from validation.paper.cabinets import LocalAir
from validation.paper.models import CRITERIA, FREE_RUN, LIKELIHOOD
from validation.paper.published import PERIODS, SISTER, TIME_CONSTANTS_H, WHOLE

SIMULATED_NOTE = (
    "Cabinet and local air are simulated; only the drivers (ERA5 air and turbine power) are measured. "
    "The paper's cabinet was measured."
)
"""Stands under every table."""
PUBLISHED = {"periods": PERIODS, "whole": WHOLE, "sister": SISTER}
UNITS = {"temperature_K": "K", "absolute_humidity_g_m3": "g/m³"}
WORDS = {LIKELIHOOD: "likelihood", FREE_RUN: "free run's least error"}
REGIME_HEAD = tuple(f"{q}, {r}" for q in ("temperature [K]", "absolute humidity [g/m³]") for r in REGIMES)


def constants_table(seeds: Sequence[Mapping]) -> str:
    """The time constants: the paper's, those put in, the first seed's estimates with their bounds, and in how
    many seeds these hold."""
    shown, parts = seeds[0], ("thermal", "hygric")
    rows = [
        ("paper", *(f"≈ {TIME_CONSTANTS_H[part]:g}" for part in parts)),
        ("put into the simulation", *(f"{shown['truth'][f'{part}_h']:.3f}" for part in parts)),
    ]
    for air, words in (("local", "local air"), ("era5", "ERA5's air")):
        entry = shown["time_constants"][air]
        for criterion in CRITERIA:
            cells = (_bounds((entry[part] or {}).get(criterion)) for part in parts)
            rows.append((f"{words}, {WORDS[criterion]}", *cells))
        held = (f"{holding(seeds, air, part, LIKELIHOOD)} of {len(seeds)}" for part in parts)
        rows.append((f"{words}: bounds of the likelihood that hold the truth", *held))
    return markdown(("", "thermal [h]", "hygric [h]"), rows)


def holding(seeds: Sequence[Mapping], air: str, part: str, criterion: str) -> int:
    """In how many seeds the bounds hold the truth."""
    count = 0
    for one in seeds:
        entry, truth = one["time_constants"][air][part][criterion], one["truth"][f"{part}_h"]
        count += entry["lower_h"] <= truth <= (math.inf if entry["upper_h"] is None else entry["upper_h"])
    return count


def whole_table(shown: Mapping) -> str:
    """Experiment 2: the paper's Table III."""
    rows = []
    for published, air, words, runs in (
        ("measured", "local", "local air", (("local", ""),)),
        ("era5", "era5", "ERA5's air", (("era5", ""), ("local_on_era5", ", model of the local air"))),
    ):
        rows.append((f"paper, {words}", *_cells(WHOLE[published])))
        for run, more in runs:
            rows += [
                (f"here, {words}{more}: {WORDS[c]}", *_cells(shown["rmse"][run][c]["whole"]))
                for c in CRITERIA
            ]
        rules = shown["baselines"][air]
        cells = _cells({**rules.get("no_dynamics", {}), **rules.get("ambient", {})})
        rows.append((f"no heat storage; c = c_amb, {words}", *cells))
    return markdown(("", *REGIME_HEAD), rows)


SISTERS = (
    ("sister", "identified with ERA5's air in the UK"),
    ("sister_of_local", "identified with the local air in the UK"),
    ("sister_own", "identified on the sister itself"),
    ("sister_outdoor", "identified with ERA5's air in the UK; sister in the air of its nacelle's sensor"),
)


def sister_table(shown: Mapping) -> str:
    """Experiment 3: the model on the sister."""
    rows = [("paper (sister in Germany)", *_cells(SISTER))]
    for run, words in SISTERS:
        rows += [(f"{words}: {WORDS[c]}", *_cells(shown["rmse"][run][c]["whole"])) for c in CRITERIA]
    return markdown(("", *REGIME_HEAD), rows)


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
    return float(there["total"]) if isinstance(there, Mapping) else float(there)  # type: ignore[arg-type]


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
    """All tables; the first seed is the one that is shown."""
    seeds = sorted(lines, key=lambda line: line["seed"])
    head, *rows = spread_rows(seeds)
    parts = {
        "Time constants": constants_table(seeds),
        "Experiment 2: local air and ERA5's air (the paper's Table III)": whole_table(seeds[0]),
        "Experiment 3: the model on its sister elsewhere, ERA5's air": sister_table(seeds[0]),
        "All experiments over the seeds": f"{markdown(head, rows)}\n\n{spread_note(seeds)}",
        "How the local air was made": air_table(seeds[0]),
    }
    return "\n\n".join([*(f"## {name}\n\n{text}" for name, text in parts.items()), SIMULATED_NOTE])


def _cells(by_quantity: Mapping) -> list[str]:
    entries = [by_quantity.get(quantity, {}).get(regime) for quantity in SCORED for regime in REGIMES]
    return [NONE if value is None else fixed(value) for value in entries]


def _bounds(entry: Mapping | None) -> str:
    if entry is None:
        return NONE
    value, lower = (plain_number(entry[key]) for key in ("value_h", "lower_h"))
    if entry["upper_h"] is None:
        return f"{value} (from {lower})"
    return f"{value} ({lower} … {plain_number(entry['upper_h'])})"
