"""The measured controller's cabinet of a 660 kW turbine, identified and searched for causes; and with the
nacelle's air as the cabinet: docs/validation/measured_cabinet.md."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from hygrokf import discover, identify, read_case
from hygrokf.data.record import Record
from validation.frame import DATA, ROOT, Claim
from validation.records import CONTROLLER, SOURCES, expect

UNTIL_S = float(np.datetime64("2013-05-15", "s").astype(int))
"""End of the identification [s]."""
COLUMNS = {"controller": "controller_temperature_degC", "nacelle": "nacelle_temperature_degC"}
FEWEST = 60
"""Readings below which a mean error is not drawn."""


def record(inside: str) -> Record:
    file = SOURCES["controller"].file
    expect(file)
    with tempfile.TemporaryDirectory() as folder:
        case = Path(folder) / "case.toml"
        text = CONTROLLER.format(name="controller's cabinet", file=(DATA / file).resolve())
        case.write_text(text.replace(COLUMNS["controller"], COLUMNS[inside]), encoding="utf-8")
        return replace(read_case(case), until_s=UNTIL_S)


def one(variant: str, seed: int) -> dict:
    """What is identified and, of the controller's cabinet, discovered."""
    if variant == "nacelle":
        return _identified(identify(record(variant), starts=2, profiles=False).to_json())
    found = discover(record(variant))
    results = found.to_json()
    told = {
        name: [[one["cause"], one["form"], one["held_out"]] for one in results[name]]
        for name in ("causes", "refuted")
    }
    left_out = [
        [one["cause"], one["form"], one["evidence"]["evidence"], one["reason"]] for one in results["rejected"]
    ]
    return {
        **_identified(results["baseline"]), **told, "rejected": left_out, "verdict": results["verdict"],
        "lines": results["lines"], "findings": [one["statement"] for one in results["findings"]],
        "gains": results["gains"], "courses": courses(found.before),
    }  # fmt: skip


def _identified(results: Mapping) -> dict:
    """Time constant, errors of the free run and of the rule without heat storage in the held-out period."""
    return {
        "constant": results["time_constants"]["thermal"],
        "free_run": results["rmse"]["validation"]["temperature_K"],
        "rule": results["baselines"]["validation"]["no_dynamics"]["temperature_K"],
    }


def table(lines: Sequence[Mapping]) -> str:
    text = []
    for line in lines:
        own = line["constant"]
        text += [
            f"{line['variant']}: {own['value_h']:.2f} h ({own['lower_h']:.2f} … {own['upper_h']:.2f}), "
            f"{own['verdict']}; profile {own.get('profile')}",
            f"free run {line['free_run']}, rule {line['rule']}",
        ]
        if line["variant"] == "controller":
            text += [f"{line['verdict']} | {line['lines']}", *(f"finding: {one}" for one in line["findings"])]
            text += [f"{name} {line[name]}" for name in ("causes", "refuted", "gains")]
            text += [f"left out: {', '.join(map(str, one))}" for one in line["rejected"]]
    return "\n".join(text)


# -- pictures ------------------------------------------------------------------------------------------------
def courses(before) -> dict[str, dict[str, np.ndarray]]:
    """What the pictures show: readings and free run over the first two weeks of the held-out period, and mean
    errors by outside temperature [°C] and state."""
    held = before.validation & np.isfinite(before.error["temperature"])
    first = np.flatnonzero(held)[0]
    weeks = held & (before.time_s < before.time_s[first] + 14 * 86400.0)
    simulated = before.simulated["temperature"] - 273.15
    # no line through the days without readings
    simulated = np.where(np.diff(before.time_h, append=np.inf) > 6.0, np.nan, simulated)
    run = {
        "time_s": before.time_s,
        "simulated": simulated,
        "sd": before.sd["temperature"],
        "measured": before.measured["temperature"] - 273.15,
    }
    found = {"run": {name: course[weeks] for name, course in run.items()}}
    outside = before.drivers["ambient_temperature"] - 273.15
    edges = np.arange(-6.0, 16.0, 2.0)
    for name, state in (("in operation", before.operating), ("at standstill", ~before.operating)):
        chosen = state & np.isfinite(before.error["temperature"])
        bins = [before.error["temperature"][chosen & (outside >= a) & (outside < a + 2.0)] for a in edges]
        kept = [(a + 1.0, b.mean()) for a, b in zip(edges, bins, strict=True) if len(b) >= FEWEST]
        found[name] = dict(zip(("outside", "error"), np.array(kept).T, strict=True))
    return found


def docs(lines: Sequence[Mapping]) -> None:
    """The pictures of the page."""
    import matplotlib.dates
    import matplotlib.pyplot as plt

    shown = next(line["courses"] for line in lines if line["variant"] == "controller")
    folder = ROOT / "docs" / "pictures"
    run = {n: np.array([math.nan if v is None else v for v in c]) for n, c in shown["run"].items()}
    time = np.array(run["time_s"] * 1e3, dtype="datetime64[ms]")
    figure, axes = plt.subplots(figsize=(9.0, 3.4), layout="constrained")
    band = (run["simulated"] - 1.96 * run["sd"], run["simulated"] + 1.96 * run["sd"])
    axes.fill_between(time, *band, color="#1b5fa8", alpha=0.15, lw=0, label="95 % band")
    axes.plot(time, run["simulated"], color="#1b5fa8", lw=1.4, label="free run")
    axes.plot(time, run["measured"], ".", color="#222222", ms=2.5, label="readings (whole degrees)")
    axes.set_ylabel("cabinet temperature [°C]")
    axes.legend(loc="upper left", frameon=False, fontsize=9)
    axes.xaxis.set_major_formatter(matplotlib.dates.DateFormatter("%-d %b"))
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(folder / "measured_cabinet_run.png", dpi=110)
    figure, axes = plt.subplots(figsize=(6.2, 3.4), layout="constrained")
    for name, colour in (("in operation", "#1b5fa8"), ("at standstill", "#c2570c")):
        axes.plot(shown[name]["outside"], shown[name]["error"], "o-", color=colour, label=name)
    axes.axhline(0.0, color="#888888", lw=0.8)
    axes.set_xlabel("outside temperature [°C]")
    axes.set_ylabel("reading − free run [K], mean")
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(folder / "measured_cabinet_error.png", dpi=110)


CLAIM = Claim("cabinet", dict.fromkeys(COLUMNS, range(1)), one, table, docs=docs)
