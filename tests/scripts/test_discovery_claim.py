"""The claim about discover: its cases, a line, the table on lines made by hand; and its constants."""

from __future__ import annotations

import json
import re
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from builders.documents import document
from plants.as_record import to_record
from plants.hidden import FORMS, LIBRARY, OUT_OF_LIBRARY, hidden_plant
from validation import constants, discovery, frame, records
from validation.discovery_tables import calibrated, table, told_names

from hygrokf.discovery import candidates, error_model, estimate, search


# -- lines made by hand --------------------------------------------------------------------------------------
def name(cause: str, *rivals: str, worth: float = 0.2, **more: object) -> dict:
    told = {"cause": cause, "form": "roof", "evidence": 90.0, "evidence_in_days": 50.0, "lead": 40.0}
    return {**told, "rivals": list(rivals), "worth": worth, **more}


def line(group: str, asked: tuple[str, ...] = (), *names: dict, key: str = "", **more: object) -> dict:
    """A line of results; `key` tells lines apart that are otherwise alike."""
    return {
        "key": f"{group}:{asked}:{names}:{key}",
        "group": group,
        "asked": [[cause, 0] for cause in asked],
        "failure": None,
        "hidden": [{"reached": 1.0} for _ in asked],
        "verdict": "named" if names else "none",
        "names": list(names),
        "refuted": [],
        "lines": [],
        "last_fifth": {},
        "simulations": 3000,
        "cpu_s": 8.0,
        **more,
    }


def failed(group: str, *asked: str) -> dict:
    """A case that raised."""
    case = line(group, asked, key="failed")
    return {key: case[key] for key in ("key", "group", "asked")} | {"failure": "ValueError: broken"}


def figures(lines: list[dict]) -> dict[str, str]:
    """Figures of the table by what they are."""
    rows = table(lines).split("\n\n")[0].splitlines()[2:]
    return {cells[1].strip(): cells[2].strip() for cells in (row.split("|") for row in rows)}


# -- the table -----------------------------------------------------------------------------------------------
def test_first_means_first_and_a_class_counts_apart() -> None:
    sun = ("solar_gain",)
    some = [
        line("causes", sun, name("solar_gain", "clock_shift", "scheduled_heat")),
        line("causes", sun, name("wall_thermal_mass", "solar_gain")),
        line("causes", sun, name("condensation"), name("solar_gain")),
        line("causes", sun, name("solar_gain", "a", "b", "c")),  # a class of four names nothing
        line("causes", sun),
        failed("causes", "solar_gain"),
    ]
    found = figures(some)
    assert found["causes: first by name"].startswith("1/6 ")
    assert found["causes: or in a class"].startswith("2/6 ")
    assert found["failures"].startswith("1/6 ")


def test_two_causes_need_two_names() -> None:
    two = ("solar_gain", "condensation")
    some = [
        line("pairs", two, name("condensation"), name("solar_gain")),
        line("pairs", two, name("solar_gain", "condensation")),
        line("pairs", two, name("solar_gain"), name("rain_ingress")),
        failed("pairs", *two),
    ]
    assert figures(some)["pairs: both named"].startswith("1/4 ")


def test_false_names_count_beside_right_ones_alone() -> None:
    sun = ("solar_gain",)
    some = [
        line("causes", sun, name("solar_gain"), name("rain_ingress", worth=0.01), name("clock_shift")),
        line("causes", sun, name("solar_gain"), name("clock_shift", "solar_gain"), verdict="unexplained"),
        line("causes", sun, name("wall_thermal_mass", "solar_gain")),  # the truth is in its class
        line("causes", sun, name("rain_ingress")),  # a wrong name beside no right one
        line("half", sun, name("solar_gain"), name("rain_ingress")),  # not counted
    ]
    found = figures(some)
    assert found["false names beside right ones"].startswith("3/6 ")
    assert found["unexplained beside a right name"].startswith("1/3 ")


def test_nulls_want_none_and_the_others_no_name() -> None:
    def three(group: str) -> list[dict]:
        named = line(group, (), name("rain_ingress", "a", "b", "c"))
        beside = line(group, (), name("rain_ingress"), key="u", verdict="unexplained")
        return [line(group), beside, named, failed(group)]

    groups = (*discovery.NULL_KINDS, "outside")
    found = figures([one for group in groups for one in three(group)])
    assert found["nulls: none"].startswith("1/4 ") and found["sensor_nulls: none"].startswith("1/4 ")
    for group in ("fluctuating_nulls", "burst_nulls", "apart_burst_nulls"):
        assert found[f"{group}: no name, or unexplained"].startswith("2/4 ")
    assert found["outside: none or unexplained"].startswith("2/4 ")


def test_confidence_is_held_against_what_was_right_in_thirds() -> None:
    some = [
        line("confidence", ("solar_gain",), name(told, confidence=share), key=str(place))
        for place, (told, share) in enumerate(
            [("rain_ingress", 0.4), ("solar_gain", 0.6), ("solar_gain", 0.8), ("rain_ingress", 0.8),
             ("solar_gain", 0.9), ("solar_gain", 1.0)]
        )
    ]  # fmt: skip
    found = [figures(some)[f"confidence, third {n}: stated − observed"] for n in (1, 2, 3)]
    assert found == ["+0.000 of 2", "+0.300 of 2", "-0.050 of 2"]


def test_coefficients_of_the_confidence_come_back() -> None:
    random = np.random.default_rng(3)
    some = []
    for place in range(2000):
        in_days, lead = float(np.exp(random.uniform(2.3, 6.0))), float(random.exponential(40.0))
        chance = 1.0 / (1.0 + np.exp(-(-3.0 + 0.8 * np.log(in_days) + 0.03 * lead)))
        cause = "solar_gain" if random.random() < chance else "rain_ingress"
        told = name(cause, evidence_in_days=in_days, lead=lead)
        some.append(line("causes", ("solar_gain",), told, key=str(place)))
    others = [failed("causes", "solar_gain"), line("nulls")]
    others += [line(kind, ("rain_ingress",), told, key=kind) for kind in ("confidence", "measured")]
    text = calibrated(told_names([*some, *others]))
    found = [float(one) for one in text.partition("(")[2].partition(")")[0].split(", ")]
    assert found == pytest.approx([-3.0, 0.8, 0.03], rel=0.25) and "2000 names" in text
    assert all(abs(float(one.split()[5])) < 0.03 for one in text.splitlines()[1:])
    with pytest.raises(ValueError, match="at least 30 names to calibrate by, found 1"):
        calibrated(told_names(some[:1]))


def test_the_told_model_is_held_against_readings_that_were_cut_off() -> None:
    """The sun in a dry record: the told model errs less on a fifth that `discover` never saw."""
    record = to_record(hidden_plant(9101, "solar_gain", days=40.0))
    record = replace(record, series=tuple(one for one in record.series if "humidity" not in one.signal))
    cut, whole = records.before_the_last_fifth(record)
    made = discovery.found(cut, whole)
    assert [one["cause"] for one in made["names"]][:1] == ["solar_gain"] and made["cpu_s"] > 0.0
    ((quantity, (before, after)),) = made["last_fifth"].items()
    assert quantity == "temperature_K" and 0.2 < after < before
    # the cut part is no part of the errors that the discovery itself tells
    assert made["errors"]["temperature"][0] != pytest.approx(before, rel=1e-3)


def test_measured_records_count_by_what_is_known_of_them() -> None:
    known, withheld, given = (getattr(records, row) for row in ("KNOWN", "WITHHELD", "GIVEN"))

    def one(row: str, *names: dict, right: tuple = (), wrong: tuple = ()) -> dict:
        return line("measured", (), *names, key=row, known={"row": row, "right": right, "wrong": wrong})

    doors = ("cooling_switching", "door_opening")
    some = [
        one(known, name("clock_shift"), name("wall_thermal_mass", "solar_gain"), right=("solar_gain",)),
        one(known, name("clock_shift"), right=("solar_gain",)),
        one(withheld, name("door_opening"), right=doors),
        one(given, name("door_opening"), wrong=doors),
        one(given, name("solar_gain", "door_opening"), wrong=doors),
        one("", name("solar_gain")),
    ]
    for each, (before, after) in zip(some, ((2.0, 1.0), (2.0, 2.0), (1.0, 1.05), (1.0, 1.2)), strict=False):
        each["last_fifth"] = {"temperature_K": [before, after]}
    found = figures(some)
    assert found["last fifth, cut off before: worse by more than 2 %"].startswith("2/4 ")
    assert found["last fifth: worse by more than 10 %"].startswith("1/4 ")
    assert found["last fifth: geometric mean after/before"] == f"{(0.5 * 1.05 * 1.2) ** 0.25:.2f}"
    assert found["measured: names a record, median"] == "1"
    assert found[f"measured, {known}: named or in a class"].startswith("1/2 ")
    assert found[f"measured, {withheld}: named or in a class"].startswith("1/1 ")
    assert found[f"measured, {given}: a name of their kind"].startswith("1/2 ")
    assert found["measured: s CPU, median and most"] == "8, 8 s CPU"


def test_costs_are_of_what_ran_and_wrong_cases_are_listed() -> None:
    some = [
        line("nulls", (), cpu_s=4.0, key="a"),
        line("nulls", (), name("rain_ingress", worth=-0.01), cpu_s=20.0, simulations=7000),
        failed("outside", "tide"),
    ]
    found = figures(some)
    assert found["plants: s CPU, median and most"] == "12, 20 s CPU"
    assert found["plants: simulations, median and most"] == "5,000, 7,000 simulations"
    text = table([*some, {**some[1], "cpu_s": 1.0}])
    assert text.count("rain_ingress/roof (90, 50; -1%) | a name") == 1
    assert "ValueError: broken | failure" in text and "1/3" in text


def chosen(groups: list[str], seeds) -> list[discovery.Case]:
    """The cases of some groups and seeds."""
    return [discovery.case_of(*case) for case in discovery.CLAIM.chosen(groups, seeds)]


# -- cases ---------------------------------------------------------------------------------------------------
def test_every_group_has_its_cells() -> None:
    causes = chosen(["causes"], range(4))
    assert len(causes) == 60 and set(Counter(one.cell for one in causes).values()) == {4}
    assert {one.causes[0] for one in causes} == {
        discovery.hidden_form(cause, turn) for cause in discovery.CAUSES for turn in range(2)
    }
    half = chosen(["half"], range(4))
    assert [(one.plant_seed, one.causes) for one in half] == [(one.plant_seed, one.causes) for one in causes]
    assert all(one.halved for one in half) and not any(one.halved for one in causes)
    pairs = chosen(["pairs"], range(18))
    assert len({one.cell for one in pairs}) == 18
    assert Counter(word for one in pairs for word in one.cell.split(" + ")) == dict.fromkeys(
        (*discovery.THERMAL, *discovery.HYGRIC), 3
    )
    outside = chosen(["outside"], range(2))
    assert len(outside) == 16 and {one.cell for one in outside} == set(OUT_OF_LIBRARY)
    assert [len(chosen([group], range(20))) for group in discovery.NULL_KINDS] == [20] * 5
    assert [one.known for one in chosen(["measured"], range(3))] == list(records.CASES)


def test_no_two_cells_share_a_plant_and_no_two_cases_a_key() -> None:
    some = chosen([group for group in discovery.GROUPS if group not in ("half", "measured")], range(30))
    assert len({one.plant_seed for one in some}) == len(some)
    assert len({frame.key_of(one) for one in discovery.CLAIM.chosen(discovery.GROUPS, range(30))}) == len(
        some
    ) + 15 * 30 + len(records.CASES)


def test_confidence_draws_any_form_and_nothing_in_one_of_six() -> None:
    drawn = chosen(["confidence"], range(600))
    nothing = [one for one in drawn if one.null]
    assert len(nothing) / 600 == pytest.approx(1.0 / 6.0, abs=0.05)
    seen = {one.causes[0] for one in drawn if one.causes}
    assert seen == {(cause, form) for cause in LIBRARY for form in range(len(FORMS[cause]))}
    assert 0.4 < sum(one.halved for one in drawn) / (600 - len(nothing)) < 0.6


# -- one case ------------------------------------------------------------------------------------------------
def test_a_line_holds_what_the_table_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    answer = {
        "verdict": "named", "names": [name("solar_gain")], "refuted": [], "simulations": 10,
        "errors": {"temperature": [2.0, 1.5]},
    }  # fmt: skip
    monkeypatch.setattr(discovery, "DAYS", 30.0)
    monkeypatch.setattr(discovery, "found", lambda record, whole: seen.append(record) or answer)
    made = frame.line_of(discovery.CLAIM, ("half", "solar_gain", 1), {})
    assert json.loads(json.dumps(made)) == made
    assert (made["key"], made["asked"], made["strength"]) == ("half:solar_gain:1", [["solar_gain", 1]], 0.5)
    assert made["hidden"][0]["cause"] == "solar_gain" and made["failure"] is None
    record = seen[0]
    assert record.until_s - record.start_s == pytest.approx(2.0 / 3.0 * (record.end_s - record.start_s))
    assert figures([made])["half: first by name"].startswith("1/1 ")
    null = frame.line_of(discovery.CLAIM, ("burst_nulls", "nothing", 1), {})
    assert null["hidden"] == [] and figures([null])["burst_nulls: no name, or unexplained"].startswith("0/1 ")


def test_what_is_raised_is_part_of_the_line(monkeypatch: pytest.MonkeyPatch) -> None:

    def broken(case: object) -> None:
        raise ValueError("no plant")

    monkeypatch.setattr(discovery, "make", broken)
    made = frame.line_of(discovery.CLAIM, ("causes", "solar_gain", 1), {})
    assert made["failure"] == "ValueError: no plant" and "broken" in made["trace"]
    assert made["asked"] == [["solar_gain", 1]] and figures([made])["causes: first by name"].startswith(
        "0/1 "
    )


def test_a_constant_is_varied_wherever_it_stands_and_comes_back() -> None:
    with constants.varied(constants.Variant("error_model", "HUBER", 2.0)):
        assert (error_model.HUBER, estimate.HUBER) == (8.0, 8.0)
        assert error_model.loss(np.array([6.0]))[0] == 36.0
    assert (error_model.HUBER, estimate.HUBER) == (4.0, 4.0)
    assert error_model.loss(np.array([6.0]))[0] == 32.0  # 8 · 6 − 16 beyond 4
    with constants.varied(constants.Variant("candidates", "ACCEPTED_EVIDENCE", 0.5)):
        assert (candidates.ACCEPTED_EVIDENCE, search.ACCEPTED_EVIDENCE) == (5.0, 5.0)
    assert (candidates.ACCEPTED_EVIDENCE, search.ACCEPTED_EVIDENCE) == (10.0, 10.0)


def test_every_constant_that_decides_is_varied_but_the_one_of_a_remark() -> None:
    page = document("discover_constants.md").read_text(encoding="utf-8").split("## ")[1]
    stated = set(re.findall(r"^\| `(\w+)`: `(\w+)=", page, re.M))
    assert stated - set(constants.CONSTANTS) == {("discovery_text", "MOST_SATURATED")}
    assert set(constants.CONSTANTS) <= stated
    cells = {cell for _, cell, _ in constants.CLAIM.chosen(constants.CLAIM.seeds)}
    assert cells == {*constants.CELLS, "nothing"}


def test_the_table_of_constants_counts_names_and_silence() -> None:
    told = {"first": True, "false": 1, "verdict": "named"}
    plants = [{"asked": [["solar_gain", 0]], "variants": {"HUBER x 2": one}}
              for one in (told, told | {"first": False, "false": 0})]  # fmt: skip
    null = {"asked": [], "variants": {"HUBER x 2": told | {"false": 0, "verdict": "none"}}}
    row = constants.table([*plants, null]).splitlines()[-1]
    assert row == "| HUBER x 2 | 1 of 2 | 1 | 1 of 1 |"
