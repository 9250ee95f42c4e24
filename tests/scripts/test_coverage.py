"""Bounds that cover as often as they say: a small run by default, a full one with the slow marker."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from other_make import ROWS, make_plant
from scipy.stats import binom
from validation import coverage
from validation.frame import line_of, printed, run


def entry(value: float, lower: float | None, upper: float | None, **further: object) -> dict:
    """One of a fit's time constants."""
    return {"value_h": value, "lower_h": lower, "upper_h": upper, **further}


def quantity(value: float, lower: float, upper: float | None, **further: object) -> dict:
    """A quantity whose truth is 1 h, as a line has it."""
    return coverage.compared(
        coverage.Quantity("thermal", lambda _: 1.0), entry(value, lower, upper, **further)
    )


def made_line(seed: int, thermal: dict | None, row: str = "clock", **further: object) -> dict:
    found = {
        "key": f"{row}:{seed}",
        "row": row,
        "seed": seed,
        "sources": "a",
        "cpu_s": 2.0 + seed,
        "wall_s": 1.0,
    }
    found |= {"failure": None if thermal else "ValueError: too short", "quantities": {"thermal": thermal}}
    found["free_run"] = {"temperature_K": 1.0 + seed, "absolute_humidity_g_m3": 0.25}
    return found | further


# -- one plant -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("row", ["convection", "ou"])
def test_a_plant_becomes_a_line(row: str) -> None:
    line = json.loads(json.dumps(line_of(coverage.CLAIM, (row, 4000), {"days": 20.0})))
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

    monkeypatch.setattr(coverage, "identify", broken)
    line = line_of(coverage.CLAIM, ("instants", 3), {"days": 1.0})
    assert line["failure"] == "ValueError: nothing can be identified"


def test_intervals_are_held_against_the_truth() -> None:
    assert quantity(1.2, 0.9, 1.5)["covered"] and quantity(1.2, 0.9, None)["covered"]
    assert not quantity(1.2, 1.1, 1.5)["covered"] and not quantity(1.2, 1.1, None)["covered"]
    assert quantity(0.5, None, 1.0)["covered"] and not quantity(0.5, 0.0, 0.9)["covered"]
    bare = quantity(1.2, 0.9, 1.5)
    assert bare["profile"] is bare["verdict"] is bare["simulation"] is None and not bare["disagreement"]
    full = quantity(
        1.2, 0.9, 1.5, composition=[entry(1.2, 1.1, 1.3)], verdict="caution", reasons=["x"],
        simulation=entry(1.4, 1.0, 2.0), criteria_disagree=True,
    )  # fmt: skip
    assert full["profile"] == {"lower": 1.1, "upper": 1.3, "covered": False}
    assert (full["verdict"], full["simulation"], full["disagreement"]) == ("caution", 1.4, True)


def test_truths_are_those_of_the_fits_own_references() -> None:
    compared = coverage.compared
    scenario = ROWS["convection"]
    truth = make_plant(3, scenario, 2.0).truth
    found = coverage.other_make_quantities(scenario, truth)
    cabinet = truth.cabinet
    kelvin = {"cabinet_temperature_K": 295.0, "ambient_temperature_K": 280.0}
    hygric = compared(found["hygric"], entry(1.0, 0.9, 1.1, mean_temperatures=kelvin))
    assert hygric["truth"] == pytest.approx(cabinet.hygric_k_h * 273.0**1.8 / (295.0 * 280.0**0.8))
    plain = entry(1.0, 0.9, 1.1, verdict="believe")
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
    second = coverage.other_make_quantities(
        ROWS["second_mass"], make_plant(3, ROWS["second_mass"], 2.0).truth
    )
    assert set(second) == {"thermal", "hygric", "thermal longest"}
    assert second["thermal longest"].truth(plain) > second["thermal"].truth(plain)


# -- sums and tables -----------------------------------------------------------------------------------------
def test_sums_of_a_row() -> None:
    plain = {"composition": [entry(1.0, 0.99, 1.01)]}
    found = [
        quantity(1.1, 0.9, 1.3, verdict="believe", **plain),
        quantity(1.2, 1.1, 1.3, verdict="caution", **plain),
        quantity(1.4, 1.3, 1.5, verdict="believe", simulation=entry(1.1, 1.0, 1.2), **plain),
        quantity(0.8, 0.7, 0.9, verdict="reject", composition=[entry(0.8, 0.75, 0.85)]),
    ]
    s = coverage.sums(found)
    logs = np.log([1.1, 1.2, 1.4, 0.8])
    assert s.error == pytest.approx(logs.mean()) and s.spread == pytest.approx(logs.std(ddof=1))
    widths = [0.5 * math.log(one["upper"] / one["lower"]) for one in found]
    assert s.half_width == pytest.approx(np.median(widths))
    assert (s.plants, s.covered, s.misses, s.told, s.profile) == (4, 1, 3, 2, 3)
    assert s.verdicts == {"believe": 2, "caution": 1, "reject": 1}
    assert s.free_run_error == pytest.approx(math.log(1.1)) and s.free_run_spread == pytest.approx(
        math.log(1.1)
    )
    bare = coverage.sums([quantity(1.0, 0.9, None), quantity(1.0, 0.9, None)])
    assert bare.half_width == math.inf and bare.profile is None and not bare.verdicts
    assert bare.free_run_error is None


def test_the_table_has_a_line_a_row_and_quantity() -> None:
    lines = [
        made_line(0, quantity(1.1, 0.9, 1.3, verdict="believe")),
        made_line(1, quantity(1.1, 1.05, 1.2, verdict="caution")),
        made_line(2, None),
        made_line(0, quantity(1.0, 0.5, None), row="noise"),
    ]
    text = printed(coverage.CLAIM, lines)
    head, rule, clock, noise, empty, free, _, failed = text.splitlines()
    assert head.count("|") == rule.count("|") == clock.count("|") == noise.count("|")
    assert clock == (
        "| clock | 2 | thermal | +10.0 % | 0.0 % | ±12.5 % | 1/2 | – | 1 / 1 / 0 | 1/1 | – | 2.5 s | 1.0 s |"
    )
    assert noise == "| noise | 1 | thermal | +0.0 % | 0.0 % | open | 1/1 | – | – | – | – | 2.0 s | 1.0 s |"
    assert (empty, failed) == ("", "clock:2: ValueError: too short")
    assert free.startswith("clock: free-run errors 1.50 K, 0.250 g/m³")
    text = printed(coverage.CLAIM, [*lines, made_line(9, None, sources="b")])
    assert text.endswith("(results of 2 versions of the package's sources)")


# -- in full -------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_bounds_cover_where_the_class_is_right() -> None:
    """200 plants: mean errors within 5 % and 20 %, coverage within the 95 % band of a binomial with p =
    0.95."""
    lines = list(run(coverage.CLAIM, coverage.CLAIM.chosen(["ou"]), coverage.CLAIM.settings, 2))
    least, most = binom.interval(0.95, len(lines), 0.95)
    found = {
        name: coverage.sums([line["quantities"][name] for line in lines]) for name in ("thermal", "hygric")
    }
    assert abs(found["thermal"].error) < 0.05 and abs(found["hygric"].error) < 0.2
    for s in found.values():
        assert least <= s.covered <= most, s
    assert 1.0 < np.mean([line["free_run"]["temperature_K"] for line in lines]) < 2.0
    assert 0.3 < np.mean([line["free_run"]["absolute_humidity_g_m3"] for line in lines]) < 0.5
