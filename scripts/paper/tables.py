"""The tables of the experiments, made from `paper.json` alone: this project's numbers beside the paper's."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence

from hygrokf.evaluation.scoring import SCORED
from hygrokf.identification.wording import NONE, fixed, percent, plain_number
from hygrokf.report.blocks import Table
from hygrokf.report.fit_tables import REGIMES
from paper.models import CRITERIA, FREE_RUN, LIKELIHOOD

SIMULATED_NOTE = (
    "Cabinet and local air are simulated; only the drivers (ERA5 air and turbine power) are measured. "
    "The paper's cabinet was measured."
)
"""Stands on every table and on the page."""
PAPER, OURS = "measured", "simulated"
UNITS = {"temperature_K": "K", "absolute_humidity_g_m3": "g/m³"}
WORDS = {LIKELIHOOD: "likelihood", FREE_RUN: "free run's least error"}
GROUPS = (("", 2), ("temperature [K]", 3), ("absolute humidity [g/m³]", 3))


def periods_table(found: Mapping) -> Table:
    """Experiment 1: errors of the identification and of the validation period."""
    stated = found["published"]["periods"]
    rows = [("paper", PAPER, *(fixed(stated[p][q]) for q in SCORED for p in stated))]
    for criterion in CRITERIA:
        own = found["shown"]["rmse"]["local"][criterion]
        rows.append(
            (f"here, {WORDS[criterion]}", OURS, *(_rmse(own[p][q], "total") for q in SCORED for p in stated))
        )
    return Table(
        "Experiment 1: identification and validation, local air",
        ("", "cabinet", *("identification", "validation") * 2),
        tuple(rows),
        left=(0, 1),
        groups=(("", 2), ("temperature [K]", 2), ("absolute humidity [g/m³]", 2)),
        note=f"Root mean squared errors of the free run. {SIMULATED_NOTE}",
    )


def constants_table(found: Mapping) -> Table:
    """The time constants: the paper's, those put in, and the estimates with their bounds."""
    shown, stated = found["shown"], found["published"]["time_constants_h"]
    rows = [
        ("paper", PAPER, *(f"≈ {stated[part]:g}" for part in ("thermal", "hygric"))),
        (
            "put into the simulation",
            OURS,
            *(f"{shown['truth'][f'{part}_h']:.3f}" for part in ("thermal", "hygric")),
        ),
    ]
    for air, words in (("local", "local air"), ("era5", "ERA5's air")):
        for criterion in CRITERIA:
            entry = shown["time_constants"][air]
            rows.append((f"{words}, {WORDS[criterion]}", OURS,
                         *(_bounds((entry[part] or {}).get(criterion)) for part in ("thermal",
                             "hygric"))))  # fmt: skip
    return Table(
        "Time constants",
        ("", "cabinet", "thermal [h]", "hygric [h]"),
        tuple(rows),
        left=(0, 1),
        note=f"In brackets 95 % bounds. {_holding(found)} {SIMULATED_NOTE}",
    )


def _holding(found: Mapping) -> str:
    """In how many seeds the bounds hold the truth."""
    parts = []
    for air, words in (("local", "local air"), ("era5", "ERA5's air")):
        held = {part: _held(found["seeds"], air, part) for part in ("thermal", "hygric")}
        n = len(found["seeds"])
        parts.append(f"with {words} {held['thermal']} of {n} thermal and {held['hygric']} of {n} hygric ones")
    return f"Bounds of the likelihood that hold the truth, over all seeds: {'; '.join(parts)}."


def _held(seeds: Sequence[Mapping], air: str, part: str) -> int:
    count = 0
    for one in seeds:
        entry, truth = one["time_constants"][air][part][LIKELIHOOD], one["truth"][f"{part}_h"]
        count += entry["lower_h"] <= truth <= (math.inf if entry["upper_h"] is None else entry["upper_h"])
    return count


def whole_table(found: Mapping) -> Table:
    """Experiment 2: the paper's Table III."""
    shown, stated = found["shown"], found["published"]["whole"]
    rows, marked = [], []
    for air, words, names in (
        ("measured", "local air", (("local", ""),)),
        ("era5", "ERA5's air", (("era5", ""), ("local_on_era5", ", model of the local air"))),
    ):
        marked.append(len(rows))
        rows.append((f"paper, {'measured air' if air == 'measured' else words}", PAPER, *_cells(stated[air])))
        for name, more in names:
            rows += [
                (f"here, {words}{more}: {WORDS[c]}", OURS, *_cells(shown["rmse"][name][c]["whole"]))
                for c in CRITERIA
            ]
        base = shown["baselines"]["local" if air == "measured" else "era5"]
        rows.append((f"no heat storage; c = c_amb, {words}", OURS,
                     *_cells({**base.get("no_dynamics", {}), **base.get("ambient", {})})))  # fmt: skip
    n = shown["rmse"]["local"][FREE_RUN]["whole"]
    rows.append(("readings", "", *(f"{n[q]['n'][r]:,}" for q in SCORED for r in REGIMES)))
    return Table(
        "Experiment 2: local air and ERA5's air (the paper's Table III)",
        ("", "cabinet", *REGIMES, *REGIMES),
        tuple(rows),
        left=(0, 1),
        marked=tuple(marked),
        groups=GROUPS,
        note=f"Root mean squared errors of the free run over the whole record. {SIMULATED_NOTE}",
    )


SISTERS = (
    ("sister", "identified with ERA5's air in the UK"),
    ("sister_of_local", "identified with the local air in the UK"),
    ("sister_own", "identified on the sister itself"),
    ("sister_outdoor", "identified with ERA5's air in the UK; sister in the air of its nacelle's sensor"),
)


def sister_table(found: Mapping) -> Table:
    """Experiment 3: the model on the sister."""
    rows = [("paper (sister in Germany)", PAPER, *_cells(found["published"]["sister"]))]
    for name, words in SISTERS:
        rows += [
            (f"{words}: {WORDS[c]}", OURS, *_cells(found["shown"]["rmse"][name][c]["whole"]))
            for c in CRITERIA
        ]
    return Table(
        "Experiment 3: the model on its sister elsewhere, ERA5's air",
        ("", "cabinet", *REGIMES, *REGIMES),
        tuple(rows),
        left=(0, 1),
        marked=(0,),
        groups=GROUPS,
        note=(
            "The sister stands in France and has properties of its own (each 10 % about those of the type); "
            f"ERA5 humidity there is that of the UK. {SIMULATED_NOTE}"
        ),
    )


SPREAD = (
    ("local", "identification", "local air, identification", ("periods", "identification")),
    ("local", "validation", "local air, validation", ("periods", "validation")),
    ("local", "whole", "local air, whole record", ("whole", "measured")),
    ("era5", "whole", "ERA5's air, whole record", ("whole", "era5")),
    ("sister", "whole", "sister, ERA5's air", ("sister",)),
)
"""(run, period, words, where the paper's number stands)."""


def published_total(found: Mapping, path: Sequence[str], quantity: str) -> float:
    """The paper's total of a quantity."""
    there: object = found["published"]
    for name in (*path, quantity):
        there = there[name]  # type: ignore[index]
    return float(there["total"]) if isinstance(there, Mapping) else float(there)  # type: ignore[arg-type]


def totals(found: Mapping, run: str, period: str, quantity: str, criterion: str) -> list[float]:
    """Totals of all seeds, the shown one first."""
    return [one["rmse"][run][criterion][period][quantity]["total"] for one in found["seeds"]]


def spread_table(found: Mapping) -> Table:
    """All three experiments over all seeds."""
    rows = []
    for quantity in SCORED:
        for run, period, words, path in SPREAD:
            cells = [fixed(published_total(found, path, quantity))]
            for criterion in CRITERIA:
                cells.append(_spread(totals(found, run, period, quantity, criterion)))
            rows.append((f"{words} [{UNITS[quantity]}]", *cells))
        gain = published_total(found, ("whole", "era5"), quantity) - published_total(
            found, ("whole", "measured"), quantity
        )
        cells = [fixed(gain)]
        for criterion in CRITERIA:
            pair = (totals(found, run, "whole", quantity, criterion) for run in ("era5", "local"))
            cells.append(_spread([a - b for a, b in zip(*pair, strict=True)]))
        rows.append((f"what ERA5's air adds, whole record [{UNITS[quantity]}]", *cells))
    seeds = [one["seed"] for one in found["seeds"]]
    said = f"Seeds {seeds[0]} to {seeds[-1]}" if seeds[1:] else f"Seed {seeds[0]}"
    return Table(
        "All experiments over the seeds",
        ("", "measured cabinet", *(WORDS[c] for c in CRITERIA)),
        tuple(rows),
        groups=(("", 1), ("paper", 1), ("here", len(CRITERIA))),
        note=(
            f"Root mean squared errors of the free run, operation and standstill together. {said}. "
            f"{SIMULATED_NOTE}"
        ),
    )


def _spread(values: Sequence[float]) -> str:
    """The value of one seed, the range of several."""
    return fixed(values[0]) if len(values) == 1 else f"{fixed(min(values))} … {fixed(max(values))}"


def air_table(found: Mapping) -> Table:
    """How local air differs from ERA5's or from a weather station: what was measured, and what the simulation
    uses."""
    apart, reached = found["deviation"], found["shown"]["local_air"]
    used = apart["used"]
    rows = [
        ("nacelle sensor in France minus ERA5", "measured", f"{apart['nacelle']['n']:,}",
         fixed(apart["nacelle"]["sd_K"]), fixed(apart["nacelle"]["time_h"], 1), "", "")
    ]  # fmt: skip
    rows += [
        (f"logger outside house {one['house']} in Finland, to the weather station", "measured",
            f"{one['n']:,}", "", "",
         percent(one["sd"], 1), fixed(one["time_h"], 1))
        for one in apart["eaves"]
    ]  # fmt: skip
    rows.append(
        ("put into the local air here", "simulated", "", fixed(used["temperature_sd_K"]),
            fixed(used["temperature_time_h"], 1),
         percent(used["vapour_sd"], 1), fixed(used["vapour_time_h"], 1))
    )  # fmt: skip
    mean, day = apart["nacelle"]["mean_K"], apart["nacelle"]["day_K"]
    return Table(
        "How the local air was made",
        ("", "", "values", "sd [K]", "time [h]", "sd", "time [h]"),
        tuple(rows),
        left=(0, 1),
        marked=(len(rows) - 1,),
        groups=(("", 3), ("temperature", 2), ("absolute humidity", 2)),
        note=(
            "Standard deviation, and the lag at which the autocorrelation has fallen to 1/e. Of the "
            f"nacelle's sensor the mean ({mean:+.2f} K) and the mean course of the day ({day:.2f} K from "
            "least to greatest) are left out: it hangs high above the ground on a warm machine. Humidity is "
            "cut off at saturation. With the shown seed the local air came out "
            f"{reached['temperature_sd_K']:.2f} K and {reached['vapour_sd_g_m3']:.2f} g/m³ from ERA5's "
            f"(standard deviations). {SIMULATED_NOTE}"
        ),
    )


def all_tables(found: Mapping) -> dict[str, Table]:
    """Name of the file -> table."""
    return {
        "periods": periods_table(found),
        "time_constants": constants_table(found),
        "table_3": whole_table(found),
        "sister": sister_table(found),
        "seeds": spread_table(found),
        "local_air": air_table(found),
    }


# -- cells ---------------------------------------------------------------------------------------------------
def _rmse(entry: Mapping, regime: str) -> str:
    value = entry.get(regime)
    return NONE if value is None else fixed(value)


def _cells(by_quantity: Mapping) -> list[str]:
    return [_rmse(by_quantity.get(quantity, {}), regime) for quantity in SCORED for regime in REGIMES]


def _bounds(entry: Mapping | None) -> str:
    if entry is None:
        return NONE
    if entry["upper_h"] is None:
        return f"{plain_number(entry['value_h'])} (from {plain_number(entry['lower_h'])})"
    return (
        f"{plain_number(entry['value_h'])} ({plain_number(entry['lower_h'])} … "
        f"{plain_number(entry['upper_h'])})"
    )


# -- as text -------------------------------------------------------------------------------------------------
def _heads(table: Table) -> list[str]:
    """One heading a column: its group's and its own."""
    groups = [heading for heading, count in table.groups for _ in range(count)] or [""] * len(table.columns)
    return [", ".join(part for part in pair if part) for pair in zip(groups, table.columns, strict=True)]


def csv_text(table: Table) -> str:
    """The table as CSV; the last column of every row says what is simulated."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow([head or "row" for head in _heads(table)] + ["note"])
    writer.writerows([*row, table.note] for row in table.rows)
    return buffer.getvalue()


def markdown(table: Table) -> str:
    """The table as Markdown with its note."""
    heads = _heads(table)
    lines = ["| " + " | ".join(heads) + " |", "|" + " --- |" * len(heads)]
    lines += ["| " + " | ".join(row) + " |" for row in table.rows]
    return "\n".join(lines) + f"\n\n*{table.note}*"
