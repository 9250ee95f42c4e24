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


def made_line(seed: int, thermal: dict | None, row: str = "clock", sources: str = "a") -> dict:
    return {
        "key": f"{row}:{seed}", "variant": row, "seed": seed, "sources": sources, "cpu_s": 2.0 + seed,
        "failure": None if thermal else "ValueError: too short", "quantities": {"thermal": thermal},
    }  # fmt: skip


# -- one plant -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("row", ["convection", "ou"])
def test_a_plant_becomes_a_line(row: str) -> None:
    line = json.loads(json.dumps(line_of(coverage.CLAIM, (row, 4000), {"days": 20.0})))
    assert line["failure"] is None and line["cpu_s"] > 0.0
    wanted = {"thermal", "hygric", *(["thermal R·C"] if row == "convection" else [])}
    assert set(line["quantities"]) == wanted
    for found in line["quantities"].values():
        assert 0.5 < found["value"] / found["truth"] < 2.0
        assert found["lower"] < found["value"] < found["upper"]
        assert found["covered"] == (found["lower"] <= found["truth"] <= found["upper"])


def test_intervals_are_held_against_the_truth() -> None:
    assert quantity(1.2, 0.9, 1.5)["covered"] and quantity(1.2, 0.9, None)["covered"]
    assert not quantity(1.2, 1.1, 1.5)["covered"] and not quantity(1.2, 1.1, None)["covered"]
    assert quantity(0.5, None, 1.0)["covered"] and not quantity(0.5, 0.0, 0.9)["covered"]
    assert quantity(1.2, 0.9, 1.5)["verdict"] is None


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
    assert (beside["truth"], beside["value"]) == (truth.thermal_h, 1.0)
    stated = entry(
        1.0, 0.9, 1.1, difference_K=[3.0, 5.0, 8.0], verdict="caution",
        resistance_capacity=entry(1.3, 1.2, 1.4),
    )  # fmt: skip
    assert compared(found["thermal"], stated)["truth"] == cabinet.small_signal_h(5.0)
    beside = compared(found["thermal R·C"], stated)
    assert beside["truth"] == cabinet.resistance_capacity_h(5.0)
    assert (beside["value"], beside["verdict"]) == (1.3, "caution")
    second = coverage.other_make_quantities(
        ROWS["second_mass"], make_plant(3, ROWS["second_mass"], 2.0).truth
    )
    assert set(second) == {"thermal", "hygric", "thermal longest"}
    assert second["thermal longest"].truth(plain) > second["thermal"].truth(plain)


# -- sums and tables -----------------------------------------------------------------------------------------
def test_sums_of_a_row() -> None:
    found = [
        quantity(1.1, 0.9, 1.3, verdict="believe"),
        quantity(1.2, 1.1, 1.3, verdict="caution"),
        quantity(1.4, 1.3, 1.5, verdict="believe"),
        quantity(0.8, 0.7, 0.9, verdict="reject"),
    ]
    s = coverage.sums(found)
    logs = np.log([1.1, 1.2, 1.4, 0.8])
    assert s.error == pytest.approx(logs.mean()) and s.spread == pytest.approx(logs.std(ddof=1))
    widths = [0.5 * math.log(one["upper"] / one["lower"]) for one in found]
    assert s.half_width == pytest.approx(np.median(widths))
    assert (s.plants, s.covered, s.misses, s.told) == (4, 1, 3, 2)
    assert s.verdicts == {"believe": 2, "caution": 1, "reject": 1}


def test_the_table_has_a_line_a_row_and_quantity() -> None:
    lines = [
        made_line(0, quantity(1.1, 0.9, 1.3, verdict="believe")),
        made_line(1, quantity(1.1, 1.05, 1.2, verdict="caution")),
        made_line(2, None),
        made_line(0, quantity(1.0, 0.5, None), row="noise"),
        made_line(9, None, sources="b"),
    ]
    _, _, clock, noise, failed, _, versions = printed(coverage.CLAIM, lines).splitlines()
    assert clock == "| clock | 2 | thermal | +10.0 % | 0.0 % | ±12.5 % | 1/2 | 1 / 1 / 0 | 1/1 | 2.5 s |"
    assert noise == "| noise | 1 | thermal | +0.0 % | 0.0 % | open | 1/1 | – | – | 2.0 s |"
    assert failed == "clock:2: ValueError: too short"
    assert versions == "(results of 2 versions of the package's sources)"


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
