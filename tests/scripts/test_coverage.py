"""Bounds that cover as often as they say: `scripts/coverage` in small by default, in full with the slow
marker."""

from __future__ import annotations

import json
import math
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from other_make import ROWS, make_plant
from recovery import command, rows, tables
from recovery import one as one_plant
from scipy.stats import binom


def entry(value: float, lower: float | None, upper: float | None, **further: object) -> dict:
    """One of a fit's time constants."""
    return {"value_h": value, "lower_h": lower, "upper_h": upper, **further}


def quantity(value: float, lower: float, upper: float | None, **further: object) -> dict:
    """A quantity whose truth is 1 h, as a line has it."""
    return one_plant.compared(rows.Quantity("thermal", lambda _: 1.0), entry(value, lower, upper, **further))


def made_line(seed: int, thermal: dict | None, row: str = "clock", **further: object) -> dict:
    found = {"row": row, "seed": seed, "days": 9.0, "sources": "a", "cpu_s": 2.0 + seed, "wall_s": 1.0}
    found |= {"failure": None if thermal else "ValueError: too short", "quantities": {"thermal": thermal}}
    found["free_run"] = {"temperature_K": 1.0 + seed, "absolute_humidity_g_m3": 0.25}
    return found | further


# -- one plant -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("row", ["convection", "ou"])
def test_a_plant_becomes_a_line(row: str) -> None:
    line = json.loads(json.dumps(one_plant.line(row, 4000, 20.0)))
    assert line["failure"] is None and line["cpu_s"] > 0.0 and line["wall_s"] > 0.0
    wanted = {"thermal", "hygric", *(["thermal R·C"] if row == "convection" else [])}
    assert set(line["quantities"]) == wanted
    for found in line["quantities"].values():
        assert 0.5 < found["value"] / found["truth"] < 2.0
        assert found["lower"] < found["value"] < found["upper"]
        assert found["covered"] == (found["lower"] <= found["truth"] <= found["upper"])
    assert 0.3 < line["free_run"]["temperature_K"] < 3.0


def test_what_a_fit_raises_is_a_line(monkeypatch: pytest.MonkeyPatch) -> None:

    def broken(record: object) -> None:
        raise ValueError("nothing can be identified")

    monkeypatch.setattr(one_plant, "identify", broken)
    assert one_plant.line("instants", 3, 1.0)["failure"] == "ValueError: nothing can be identified"


def test_intervals_are_held_against_the_truth() -> None:
    assert quantity(1.2, 0.9, 1.5)["covered"] and quantity(1.2, 0.9, None)["covered"]
    assert not quantity(1.2, 1.1, 1.5)["covered"] and not quantity(1.2, 1.1, None)["covered"]
    assert quantity(0.5, None, 1.0)["covered"] and not quantity(0.5, 0.0, 0.9)["covered"]
    bare = quantity(1.2, 0.9, 1.5)
    assert bare["profile"] is bare["verdict"] is bare["simulation"] is None and not bare["disagreement"]
    full = quantity(
        1.2, 0.9, 1.5, profile=entry(1.2, 1.1, 1.3), verdict="caution", reasons=["x"],
        simulation=entry(1.4, 1.0, 2.0), disagreement="apart",
    )  # fmt: skip
    assert full["profile"] == {"lower": 1.1, "upper": 1.3, "covered": False}
    assert (full["verdict"], full["simulation"], full["disagreement"]) == ("caution", 1.4, True)


def test_truths_are_those_of_the_fits_own_references() -> None:
    compared = one_plant.compared
    scenario = ROWS["convection"]
    truth = make_plant(3, scenario, 2.0).truth
    found = rows.other_make_quantities(scenario, truth)
    cabinet = truth.cabinet
    hygric = compared(
        found["hygric"],
        entry(1.0, 0.9, 1.1, reference={"cabinet_temperature_K": 295.0, "ambient_temperature_K": 280.0}),
    )
    assert hygric["truth"] == pytest.approx(cabinet.hygric_k_h * 273.0**1.8 / (295.0 * 280.0**0.8))
    plain = entry(1.0, 0.9, 1.1, reference="(R_AT+R_IC) C", verdict="believe")
    assert compared(found["thermal"], plain)["truth"] == truth.small_signal_h
    beside = compared(found["thermal R·C"], plain)
    assert beside["truth"] == truth.thermal_h and not beside["own"]
    stated = entry(
        1.0, 0.9, 1.1, difference_K=[3.0, 5.0, 8.0], verdict="caution",
        resistance_capacity=entry(1.3, 1.2, 1.4),
    )  # fmt: skip
    assert compared(found["thermal"], stated)["truth"] == cabinet.small_signal_h(5.0)
    beside = compared(found["thermal R·C"], stated)
    assert beside["truth"] == cabinet.resistance_capacity_h(5.0) and beside["own"]
    assert (beside["value"], beside["verdict"]) == (1.3, "caution")
    second = rows.other_make_quantities(ROWS["second_mass"], make_plant(3, ROWS["second_mass"], 2.0).truth)
    assert set(second) == {"thermal", "hygric", "thermal longest"}
    assert second["thermal longest"].truth(plain) > second["thermal"].truth(plain)


# -- sums and tables -----------------------------------------------------------------------------------------
def test_sums_of_a_row() -> None:
    plain = {"profile": entry(1.0, 0.99, 1.01)}
    found = [
        quantity(1.1, 0.9, 1.3, verdict="believe", **plain),
        quantity(1.2, 1.1, 1.3, verdict="caution", **plain),
        quantity(1.4, 1.3, 1.5, verdict="believe", simulation=entry(1.1, 1.0, 1.2), **plain),
        quantity(0.8, 0.7, 0.9, verdict="reject", profile=entry(0.8, 0.75, 0.85)),
    ]
    s = tables.sums(found)
    logs = np.log([1.1, 1.2, 1.4, 0.8])
    assert s.error == pytest.approx(logs.mean()) and s.spread == pytest.approx(logs.std(ddof=1))
    widths = [0.5 * math.log(one["upper"] / one["lower"]) for one in found]
    assert s.half_width == pytest.approx(np.median(widths))
    assert (s.plants, s.covered, s.misses, s.told, s.profile) == (4, 1, 3, 2, 3)
    assert s.verdicts == {"believe": 2, "caution": 1, "reject": 1}
    assert s.free_run_error == pytest.approx(math.log(1.1)) and s.free_run_spread == pytest.approx(
        math.log(1.1)
    )
    bare = tables.sums([quantity(1.0, 0.9, None), quantity(1.0, 0.9, None)])
    assert bare.half_width == math.inf and bare.profile is None and not bare.verdicts
    assert bare.free_run_error is None


def test_the_table_has_a_line_a_row_and_quantity() -> None:
    lines = [
        made_line(0, quantity(1.1, 0.9, 1.3, verdict="believe")),
        made_line(1, quantity(1.1, 1.05, 1.2, verdict="caution")),
        made_line(2, None),
        made_line(0, quantity(1.0, 0.5, None), row="noise"),
    ]
    head, rule, clock, noise, empty, failed = tables.table(lines).splitlines()
    assert head.count("|") == rule.count("|") == clock.count("|") == noise.count("|")
    assert clock == (
        "| clock | 3 | thermal | +10.0 % | 0.0 % | ±12.5 % | 1/2 | – | 1 / 1 / 0 | 1/1 | – | 2.5 s | 1.0 s |"
    )
    assert noise == "| noise | 1 | thermal | +0.0 % | 0.0 % | open | 1/1 | – | – | – | – | 2.0 s | 1.0 s |"
    assert (empty, failed) == ("", "clock, seed 2: ValueError: too short")
    assert tables.free_runs(lines).startswith("clock: free-run errors 1.50 K, 0.250 g/m³")
    printed = command.printed([*lines, made_line(9, None, sources="b")])
    assert printed.endswith("(fits of 2 versions of the package's sources)")


def test_a_study_goes_on_where_it_ended(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    asked: list[int] = []

    def one(row: str, seed: int, days: float) -> dict:
        asked.append(seed)
        return made_line(seed, quantity(1.0, 0.9, 1.1), row, days=days)

    file = tmp_path / "lines.jsonl"
    command.run_into(file, "clock", range(2), 9.0, 1, one)
    with file.open("a") as out:
        out.write('{"row": "clock", "se')  # cut off in writing
    command.run_into(file, "noise", range(1), 9.0, 1, one)
    command.run_into(file, "clock", range(4), 9.0, 1, one)
    assert asked == [0, 1, 0, 2, 3]
    lines = [json.loads(text) for text in file.read_text().splitlines()]
    assert [(line["row"], line["seed"]) for line in lines] == [
        ("clock", 0), ("clock", 1), ("noise", 0), ("clock", 2), ("clock", 3),
    ]  # fmt: skip
    with pytest.raises(SystemExit, match="holds records of 9 days: expected 30"):
        command.run_into(file, "clock", range(4), 30.0, 1, one)
    assert command.main(["--table", str(file)]) == 0
    assert "| clock | 4 | thermal |" in capsys.readouterr().out
    for wrong in (["--row", "clock"], ["--row", "clock", "--table", str(file)], []):
        with pytest.raises(SystemExit):
            command.main(wrong)
        assert "expected --row, --seeds and --out, or --table" in capsys.readouterr().err


# -- in full -------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_bounds_cover_where_the_class_is_right() -> None:
    """200 plants: mean errors within 5 % and 20 %, coverage within the 95 % band of a binomial with p =
    0.95."""
    with ProcessPoolExecutor(2) as pool:
        lines = list(pool.map(partial(one_plant.line, "ou", days=90.0), range(1000, 1200)))
    least, most = binom.interval(0.95, len(lines), 0.95)
    found = {
        name: tables.sums([line["quantities"][name] for line in lines]) for name in ("thermal", "hygric")
    }
    assert abs(found["thermal"].error) < 0.05 and abs(found["hygric"].error) < 0.2
    for s in found.values():
        assert least <= s.covered <= most, s
    assert 1.0 < np.mean([line["free_run"]["temperature_K"] for line in lines]) < 2.0
    assert 0.3 < np.mean([line["free_run"]["absolute_humidity_g_m3"] for line in lines]) < 0.5
