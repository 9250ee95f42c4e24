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
from validation.frame import Claim
from validation.records import AS_IT_IS, SOURCES, case_of, expect

UNTIL_S = float(np.datetime64("2013-05-15", "s").astype(int))
"""End of the identification [s]."""
INSIDE = ("controller", "nacelle")
"""Whose temperature is the cabinet's."""
FEWEST = 60
"""Readings below which a mean error is not drawn."""


def record(inside: str) -> Record:
    expect(*SOURCES["controller"].files)
    with tempfile.TemporaryDirectory() as folder:
        case = case_of("controller", AS_IT_IS, Path(folder))
        text = case.read_text(encoding="utf-8").replace("controller_temperature", f"{inside}_temperature")
        case.write_text(text, encoding="utf-8")
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
        "lines": results["lines"], "findings": [one.statement.text for one in found.results.findings],
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
    from illustrations.pages import save

    from hygrokf.report.figures.drawing import INK, MEASURED, QUIET, SIMULATED_COLOUR, new_figure, styled

    shown = next(line["courses"] for line in lines if line["variant"] == "controller")
    run = {n: np.array([math.nan if v is None else v for v in c]) for n, c in shown["run"].items()}
    time = np.array(run["time_s"] * 1e3, dtype="datetime64[ms]")
    with styled():
        course, errors = new_figure(3.0), new_figure(3.0)
        axes = course.add_subplot()
        band = (run["simulated"] - 1.96 * run["sd"], run["simulated"] + 1.96 * run["sd"])
        axes.fill_between(time, *band, color=MEASURED, alpha=0.15, lw=0, label="95 % band")
        axes.plot(time, run["simulated"], color=MEASURED, lw=1.4, label="free run")
        axes.plot(time, run["measured"], ".", color=INK, ms=2.5, label="readings (whole degrees)")
        axes.set_ylabel("cabinet temperature [°C]")
        axes.legend(loc="upper left")
        axes.xaxis.set_major_formatter(matplotlib.dates.DateFormatter("%-d %b"))
        axes = errors.add_subplot()
        for name, colour in (("in operation", MEASURED), ("at standstill", SIMULATED_COLOUR)):
            axes.plot(shown[name]["outside"], shown[name]["error"], "o-", color=colour, label=name)
        axes.axhline(0.0, color=QUIET, lw=0.8)
        axes.set_xlabel("outside temperature [°C]")
        axes.set_ylabel("reading − free run [K], mean")
        axes.legend()
        save(course, "measured_cabinet_run")
        save(errors, "measured_cabinet_error")


CLAIM = Claim("cabinet", dict.fromkeys(INSIDE, range(1)), one, table, docs=docs)
