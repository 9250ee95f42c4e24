"""The page of a discovery: every number where it belongs, every text escaped, every missing piece said."""

from __future__ import annotations

import copy
import math
import pickle
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builders.damage import EVIL, at, expect_alone, expect_escaped, expect_narrow, nodes, put
from builders.discovery_case import (
    ORIGIN_S,
    ambiguous_case,
    discovery_case,
    empty_case,
    long_class_case,
    refuted_case,
    residuals_case,
    two_causes_case,
    typed,
    unexplained_case,
    unfinished_case,
)
from builders.html_page import Page
from builders.report_case import report_case, results
from plants import plant
from plants.as_record import to_record

import hygrokf
from hygrokf.commands.main import main
from hygrokf.data.clocks import sources
from hygrokf.data.result_file import ResultFault
from hygrokf.data.structured import StructureFault, plain
from hygrokf.discovery.forms import Form, Ground, Setting
from hygrokf.discovery.library import LIBRARY
from hygrokf.discovery.procedure import chosen
from hygrokf.discovery.results import (
    CauseFound,
    Discovery,
    DiscoveryResults,
    Rejected,
    read_discovery,
    write_discovery,
)
from hygrokf.identification.fit import Fit, write_fit
from hygrokf.report.blocks import Card, Cards
from hygrokf.report.discovery_page import (
    discovery_blocks,
    evidence_table,
    findings_table,
    gains_table,
    held_out_table,
    parameters_table,
    scores_tables,
    write_discovery_report,
)
from hygrokf.report.discovery_text import (
    chosen_words,
    formed,
    held_out_sentence,
    held_out_sentences,
    line_sentence,
    verdict_of,
)
from hygrokf.report.figures.drawing import NothingToShow
from hygrokf.report.figures.residual_structure import figure_error_course, telling_drivers
from hygrokf.report.page import page_html
from hygrokf.report.terminal import page_text


@pytest.fixture(scope="module")
def whole() -> str:
    """The page with all its drawings."""
    return page_html(discovery_blocks(typed(discovery_case()), residuals_case(), residuals_case(0.2)))


def words(found: dict) -> str:
    """The text of a page without drawings."""
    return Page(page_html(discovery_blocks(typed(found)))).text


def verdict(found: dict) -> Card:
    """The card with the verdict."""
    (cards,) = [block for block in discovery_blocks(typed(found)).lead if isinstance(block, Cards)]
    return cards.cards[0]


def fit_of(found: dict) -> Fit:
    """A fit that can be written, with the fixture's numbers."""
    data, series = report_case()
    return Fit(found["name"], None, {}, results(data), series)  # type: ignore[arg-type]


# --- the whole ---------------------------------------------------------------------------------


def test_the_page_needs_nothing_else(whole: str) -> None:
    page = expect_alone(whole)
    assert [attributes["href"] for tag, attributes in page.tags if tag == "a"] == ["fit_report.html"]
    drawn = [attributes for tag, attributes in page.tags if tag == "svg"]
    assert len(drawn) == 5 and all(one["role"] == "img" and one["aria-label"] for one in drawn)


def test_the_verdict_and_its_picture_come_first_and_what_was_tried_last(whole: str) -> None:
    headings = re.findall(r"<h2>(.*?)</h2>", whole)
    assert headings == [
        "What the simulation gets wrong",
        "The cause",
        "Errors before and after",
        "The time constants without and with the cause",
        "Where the errors are",
        "What is left",
        "Causes and their evidence",
        "Data and method",
    ]
    assert whole.index("Verdict") < whole.index('id="episodes-1-') < whole.index(headings[0])


def test_the_card_names_the_cause_its_forms_and_what_to_check() -> None:
    card = verdict(discovery_case())
    assert (card.value, card.bounds, card.tone) == ("Solar gain (on the roof)", "confidence 87 %", "plain")
    assert card.lines == (
        "The sun heats the cabinet or the tower around it; in this form or on a wall: this record cannot "
        "tell these apart.",
        "Check in the turbine for solar gain: shade or paint the wall.",
    )


def test_tables_and_sentences_carry_the_numbers() -> None:
    found = typed(discovery_case())
    assert findings_table(found.findings).rows == (
        (
            "From 10 to 15 h UTC, simulated temperature is 1.4 K too low",
            "1.4 K",
            "27 of 30",
            "2 %",
            "< 0.001",
        ),
    )
    assert parameters_table(found.causes[0]).rows == (
        ("solar_heat", "6.1", "5.5 … 6.9", "K/(kW/m²)", "heat of the sun"),
        ("solar_time", "0.690", "open … 1.01", "h", "lag"),
    )
    errors = gains_table(found)
    assert errors.columns[0] == "free-run error on held-out readings, after selection"
    assert errors.rows == (
        ("temperature", "1.85 K", "1.57 K", "−15 %", "0.13 … 0.31 K",
         "2.10 K (“heat release without heat storage”)"),
        ("absolute humidity", "0.42 g/m³", "0.42 g/m³", "±0 %", "–",
         "0.44 g/m³ (“c = c_amb T_amb/T_conv,a”)"),
        ("absolute humidity, on the measured temperature", "0.40 g/m³", "0.38 g/m³", "−5.0 %", "–", "–"),
    )  # fmt: skip
    assert held_out_table(found.causes[0].held_out).rows == (
        ("temperature", "1.79 K", "1.57 K", "−12 %", "−3.21", "−0.26"),
        ("absolute humidity", "0.40 g/m³", "0.40 g/m³", "±0 %", "0.40", "0.00"),
    )
    first = evidence_table(found).rows[0]
    assert first == (
        "Solar gain (on the roof)", "296.4", "0.2", "2", "12", "274.6", "81.5",
        "accepted, 33 ahead of the best rival",
    )  # fmt: skip
    tested = held_out_sentence(found, found.causes[0].held_out)
    for number in ("falls by 12 %", "grows by 45", "10 days"):
        assert number in tested, number


def test_the_time_span_is_stated(whole: str) -> None:
    text = Page(whole).text
    assert "2020-07-15T00:00Z to 2020-08-23T23:00Z; searched up to 2020-08-14T00:00Z" in text


def test_the_page_is_a_pure_function_of_its_data(whole: str) -> None:
    blocks = discovery_blocks(typed(discovery_case()), residuals_case(), residuals_case(0.2))
    assert page_html(blocks) == whole


def test_the_drivers_of_the_findings_are_drawn_first() -> None:
    errors = residuals_case()
    telling = telling_drivers(errors, ["power"])
    assert "power" in telling and "global_horizontal_irradiance" in telling
    assert telling_drivers(errors, ["no_such_driver"]) == telling_drivers(errors)


def test_an_event_is_shown_where_it_was_found() -> None:
    found = discovery_case() | {"findings": []}
    span = [ORIGIN_S + 5 * 86400.0, ORIGIN_S + 5 * 86400.0 + 7200.0]
    found["causes"][0] |= {"cause": "door_opening", "form": "single_openings", "settings": {"spans": [span]}}
    page = discovery_blocks(typed(found), residuals_case(), residuals_case(0.2))
    assert page.lead[-2].name == "episodes-1" and page.lead[-2].heading.startswith("The sun heats")
    text = page_html(discovery_blocks(typed(found), residuals_case(), residuals_case(0.2)))
    assert 'id="episodes-1-' in text and "20 Jul 2020" in text


# --- verdicts ----------------------------------------------------------------------------------


def test_nothing_found_names_no_cause_and_no_check() -> None:
    card = verdict(empty_case())
    assert card.value == "This record shows no missing cause" and card.tone == "plain"
    text = words(empty_case())
    assert "None of the 2 causes that were judged" in text and "keep the base model" in text.lower()
    assert "Check in the turbine" not in text and "after selection" not in text.lower()
    assert "What is left" not in text and "extended model" not in text


def test_what_cannot_be_explained_is_a_warning_with_its_period() -> None:
    card = verdict(unexplained_case())
    assert card.value == "Something is missing; the cause is unknown" and card.tone == "open"
    assert card.lines[0].endswith("of the absolute humidity have a period of 12.4 h that no cause explains.")
    assert "2 causes" in card.lines[1] and "12.4 h" in words(unexplained_case()).split("What is left")[1]


def test_a_line_beside_a_named_cause_comes_before_the_cause() -> None:
    line = {"quantity": "temperature", "period_h": 168.0, "p": 1e-6, "cause": "solar_gain"}
    card = verdict(discovery_case() | {"verdict": "unexplained", "lines": [line]})
    assert card.value == "Something is missing beside solar gain (on the roof)" and card.tone == "open"
    assert "daily scores of solar gain in the temperature have a period of 7.00 days" in card.lines[0]
    assert card.lines[1].startswith("The sun heats")


def test_a_refuted_cause_is_told_with_its_reason_and_numbers() -> None:
    card = verdict(refuted_case())
    assert card.value == "Held-out readings refute unlogged heater (humidistat, at standstill)"
    assert card.lines[0].endswith("heater: with it the errors of the temperature on held-out readings grow.")
    text = words(refuted_case())
    assert "Refuted by held-out readings" in text and "+30 %" in text and "4.40" in text
    assert "after selection" in text and "improves the prediction" not in text
    no_gain = refuted_case()
    no_gain["refuted"][0]["held_out"]["reason"] = "no_gain"
    assert "held-out readings speak against it more strongly than the others speak for it" in words(no_gain)
    no_gain["refuted"][0]["held_out"]["reason"] = "unproven"
    assert "its evidence is small, and it lowers no held-out free-run error by 2 %" in words(no_gain)
    assert verdict(no_gain).value.startswith("Held-out readings do not bear out unlogged heater")


def test_water_is_told_with_an_error_of_the_humidity_sensor() -> None:
    card = verdict(ambiguous_case())
    assert card.value.endswith("(an offset that grows), internal moisture source or moisture sorption")
    assert card.bounds == "confidence 48 %"
    said = " ".join(card.lines)
    assert said.count("compare the humidity sensor with a second one") == 1
    assert "Check in the turbine" not in said and "The humidity sensor drifts" not in said
    assert "3.4 % of the humidity readings are at the sensor’s ceiling" in said
    row = evidence_table(typed(ambiguous_case())).rows[-1]
    assert row[0] == "Condensation" and row[-1].endswith("but saturated readings may hide it")


def test_a_class_that_is_too_long_names_nothing() -> None:
    card = verdict(long_class_case())
    assert card.value == "Not told apart: solar gain, cooling switching, unlogged heater, scheduled heat"
    assert not card.bounds and "shade or paint" not in " ".join(card.lines)
    assert "87 %" not in words(long_class_case())


def test_a_budget_that_ended_the_search_is_the_first_sentence() -> None:
    card = verdict(unfinished_case())
    assert card.value == (
        "The budget of 3,000 simulations ended the search; not judged: moisture sorption and condensation"
    )
    assert card.lines[0] == "So far: no cause is named."
    assert card.tone == "open" and "ordinary disturbances" not in " ".join(card.lines)
    text = page_text(discovery_blocks(typed(unfinished_case())))
    assert text.split("\n\n")[1].startswith("Verdict: The budget of 3,000 simulations")
    named = verdict(discovery_case() | {"work": unfinished_case()["work"]})
    assert named.lines[0] == "So far: solar gain (on the roof)."


def test_two_causes_have_a_check_each_and_one_without_use_is_marked() -> None:
    card, text = verdict(two_causes_case()), words(two_causes_case())
    assert card.value == "Solar gain (on the roof) + exchange step (from a date on)" and "The causes" in text
    assert card.lines[:2] == (
        "Solar gain (on the roof), confidence 87 %: the sun heats the cabinet or the tower around it; in "
        "this form or on a wall: this record cannot tell these apart.",
        "Exchange step (from a date on), confidence 61 %: the exchange of air changed at a date; it does not "
        "improve the prediction of held-out readings.",
    )
    assert "shade or paint the wall." in text and "ask what was done on that date." in text
    assert text.count("it does not improve the prediction of held-out readings") == 1


def test_a_cause_of_which_held_out_readings_show_nothing_is_told_as_such() -> None:
    found = discovery_case()
    found["causes"][0]["held_out"] = {"gain": 0.1, "days": 0}
    text = words(found)
    assert "held-out readings show nothing of it" in verdict(found).lines[0]
    assert "days with" not in text
    nothing = words(found | {"held_out_days": 0})
    assert "show nothing of it" not in nothing and "No readings were held out." in nothing


def test_repeated_readings_that_were_set_aside_are_told() -> None:
    spans = {"cabinet_temperature": [[ORIGIN_S, ORIGIN_S + 7200.0]]}
    said = " ".join(verdict(discovery_case() | {"repeated": spans}).lines)
    assert "readings of cabinet temperature repeat those of the day before, 2 h in all" in said.lower()
    assert "Find out why the logger repeats readings." in said


@pytest.mark.parametrize(
    ("days", "said"),
    [(0, "no readings were held out"), (1, "1 day were"), (13, "too short a part to refute much"), (14, "")],
)
def test_what_the_held_out_part_can_show_is_told(days: int, said: str) -> None:
    found = typed(discovery_case() | {"held_out_days": days})
    text = " ".join(held_out_sentences(found)).lower()
    assert said in text and ("too short" in text) == (0 < days < 14)
    assert ("after selection" in text) == ("after selection" in gains_table(found).columns[0]) == (days > 0)
    assert "minimise the error of the free run" in text
    likely = held_out_sentences(replace(found, estimator="likelihood"))
    assert "maximise the likelihood" in likely[0]


def test_a_loss_is_told_as_one() -> None:
    found = typed(discovery_case())
    worse = replace(found.gains[0], rmse_after=1.9, period="identification")
    table = gains_table(replace(found, gains=(worse,), held_out_days=0))
    assert table.columns[0] == "free-run error on identification readings"
    assert table.rows[0][:4] == ("temperature", "1.85 K", "1.90 K", "+2.7 %")


@pytest.mark.parametrize(("confidence", "said"), [(1.0, "> 99 %"), (None, "not stated"), (0.5, "50 %")])
def test_no_name_is_said_to_be_certain(confidence: float | None, said: str) -> None:
    found = discovery_case()
    found["causes"][0]["confidence"] = confidence
    assert verdict(found).bounds == f"confidence {said}"


# --- the course of the error -------------------------------------------------------------------


def _steps(line) -> tuple[np.ndarray, np.ndarray]:
    """Edges (n + 1,) and levels (n,) of a line of steps without gaps between them."""
    x, y = (np.asarray(one, float) for one in line.get_data())
    np.testing.assert_array_equal(x[1:-1:2], x[2::2])
    np.testing.assert_array_equal(y[::2], y[1::2])
    return np.append(x[::2], x[-1]), y[::2]


def test_the_course_of_the_error_shows_each_day_of_both_models() -> None:
    before, after = residuals_case(), residuals_case(0.2)
    warm, damp = figure_error_course(before, after).figure().axes
    for one, residuals in zip(warm.get_lines(), (before, after), strict=True):
        edges, values = _steps(one)
        late = residuals.validation
        expected = [
            np.sqrt(np.nanmean(residuals.error["temperature"][late & (residuals.time_h // 24 == day)] ** 2))
            for day in range(30, 40)
        ]
        np.testing.assert_allclose(values, expected, rtol=1e-12)
        assert edges[0] == ORIGIN_S / 86400.0 + 30.0 and len(edges) == 11
    assert damp.get_ylabel() == "RMS [g/m³]"


def test_days_without_readings_are_gaps_and_no_held_out_part_is_told() -> None:
    before, after = residuals_case(), residuals_case(0.2)
    error = before.error["temperature"].copy()
    error[24 * 33 : 24 * 34] = np.nan
    holed = replace(before, error={**before.error, "temperature": error})
    warm, _ = figure_error_course(holed, after).figure().axes
    _, values = _steps(warm.get_lines()[0])
    assert np.flatnonzero(np.isnan(values)).tolist() == [3]
    nothing = np.zeros(len(error), bool)
    with pytest.raises(NothingToShow, match="held out"):
        figure_error_course(replace(before, validation=nothing), replace(after, validation=nothing)).figure()
    alone = discovery_blocks(
        typed(discovery_case()), replace(before, validation=nothing), replace(after, validation=nothing)
    )
    assert 'id="error-course-' not in page_html(alone)


# --- tables and words --------------------------------------------------------------------------


def test_every_form_of_the_library_has_words() -> None:
    record = to_record(plant(1, days=30.0, weather="fronts", operation="turbine"))
    rain = replace(record["wind_speed"], signal="rain")
    record = replace(record, series=(*record.series, rain))
    ground = Ground(record, frozenset(), True, 1, True)
    made = [form for cause in LIBRARY for form in cause.forms(ground)]
    assert {form.cause for form in made} == {cause.name for cause in LIBRARY}
    assert all(form.code for form in made)
    clocks = {form.code for form in made if form.cause == "clock_shift"}
    assert clocks and clocks <= set(sources(record))


def test_a_form_is_told_with_its_cause() -> None:
    assert formed(Rejected("unlogged_heater", "humidistat__at_standstill")) == (
        "unlogged heater (humidistat, at standstill)"
    )
    assert formed(Rejected("clock_shift", "cabinet_log.csv")) == "clock shift (cabinet_log.csv)"
    assert formed(Rejected("oven")) == "oven"


def test_what_the_search_chose_is_told_in_words() -> None:
    found = {"date_s": ORIGIN_S + 86400.0, "azimuth_deg": 135.0, "start_h": 6, "hours": 8.0, "days": 8.0,
             "half_life_h": 3.0, "spans": [[ORIGIN_S, ORIGIN_S + 3600.0]], "shift_s": -3600.0,
             "relative_to": "b.csv"}  # fmt: skip
    names = tuple(name for name in found if name != "relative_to")
    assert list(chosen_words(CauseFound("own", settings=found, chosen=names))) == [
        "date 2020-07-16T00:00Z", "azimuth 135°", "from 6 h UTC", "for 8 h", "over 8 days",
        "half_life_h = 3.0", "2020-07-15T00:00Z to 2020-07-15T01:00Z",
        "stamps moved by −60.0 min against b.csv",
    ]  # fmt: skip


def test_the_search_chose_what_differs_from_a_point_of_the_grid() -> None:
    point = {"azimuth_deg": 135.0, "hours": 8.0, "given": 1}
    form = Form("own", "", grid=(Setting({"own": {**point, "hours": 0.0}}),))
    assert list(chosen(form, Setting({"own": point}))) == ["hours"]
    level = Form("own", "", grid=(Setting({"venting": {"start": 1.0}}),))
    assert list(chosen(level, Setting({"venting": {"start": 2.0}}))) == []  # it is a parameter
    clock = Form("clock_shift", "a.csv", clock="a.csv")
    assert list(chosen(clock, Setting(shift_s=-3600.0))) == ["shift_s"]


def test_levels_of_controllers_are_told_in_degrees() -> None:
    found = discovery_case()
    level = {"value": 288.15, "unit": "K", "lower": 287.15, "upper": 289.15}
    found["causes"][0]["parameters"] = {"throttled_heating_first": level}
    (row,) = parameters_table(typed(found).causes[0]).rows
    assert row[1:4] == ("15.0", "14.0 … 16.0", "°C")


def test_scores_of_both_models_stand_with_the_rules() -> None:
    found = typed(discovery_case())
    base, wider = scores_tables(found, "validation")
    assert base.heading.endswith("validation, base model") and wider.heading.endswith("extended model")
    rows, after = ({row[0]: row[1:] for row in table.rows} for table in (base, wider))
    assert (rows["model, free run"][2], after["model, free run"][2]) == ("1.85", "1.57")
    assert rows["c = c_amb"][5] == "0.50" and rows["readings"][2] == "900"
    assert len(scores_tables(replace(found, extended=None), "validation")) == 1
    nothing = discovery_case() | {"baseline": {}, "extended": {}}
    assert scores_tables(typed(nothing), "validation") == ()


def test_what_was_judged_stands_in_order_of_its_evidence_with_its_outcome() -> None:
    table = evidence_table(typed(discovery_case()))
    assert table.marked == (0,)
    assert table.rows[1] == (
        "Wall thermal mass (a second mass beside the converter)", "17.7", "0.0", "3", "12", "−5.5", "−5.5",
        "too little evidence",
    )  # fmt: skip
    assert [(row[0], row[-1]) for row in table.rows[2:]] == [
        ("Door opening (single openings)", "the screening finds no effect"),
        ("Rain ingress", "this record cannot show it"),
    ]
    assert set(table.rows[3][1:-1]) == {"–"}


def test_what_is_left_is_told_of_the_extended_model() -> None:
    assert "The errors of the extended model show no structure" in words(discovery_case())
    statement = "when it rains, simulated humidity is too low"
    left = discovery_case()["findings"][0] | {"statement": statement}
    found = discovery_case() | {"left": [left]}
    text = words(found).split("What is left")[1]
    assert "When it rains, simulated humidity is too low" in text
    assert verdict(found).lines[-2] == f"The extended model still errs: {statement}."
    line = {"quantity": "vapour", "period_h": 12.42, "p": 1e-9}
    assert "12.4 h" in line_sentence(typed(discovery_case() | {"lines": [line]}).lines[0])


def test_results_come_back_from_their_data_under_the_key_of_now() -> None:
    found = typed(discovery_case())
    data = plain(found)
    assert data["findings"][0]["p_adjusted"] == 1e-7
    again = typed(data)
    assert plain(again) == data and again.findings == found.findings
    assert plain(pickle.loads(pickle.dumps(found))) == data
    assert found.to_frame().loc["wall_thermal_mass", "verdict"] == "weak"


def test_a_doubt_about_the_record_comes_before_any_cause() -> None:
    doubt = "the clock of a.csv seems 2 h fast: if so, state it"
    found = typed(discovery_case() | {"doubts": [doubt]})
    reasons = verdict_of(found).reasons
    assert doubt in reasons[0] and len(reasons) > 1
    assert doubt in " ".join(page_text(discovery_blocks(found)).split())
    assert doubt in Page(page_html(discovery_blocks(found))).text


def test_the_text_is_narrow_and_says_what_the_page_says() -> None:
    found = typed(discovery_case() | {"name": "東京のタービン " * 20})
    text = page_text(discovery_blocks(found))
    expect_narrow(text)
    joined = " ".join(text.split())
    for part in (
        "temperature 1.85 K 1.57 K −15 %",
        "solar_heat 6.1 5.5 … 6.9 K/(kW/m²)",
        "Check in the turbine for solar gain: shade or paint the wall",
        "+ thermal time constant 1.36 h (1.31 … 1.41): reliable",
        "+ thermal time constant 1.20 h (1.15 … 1.25): reliable",
        "Door opening (single openings)",
        "SYNTHETIC",
    ):
        assert part in joined, part


# --- what is missing or hostile ----------------------------------------------------------------


CODES = ("verdict", "quantity", "kind", "reason")
"""Keys whose values are codes, checked on reading."""


def full_case() -> dict:
    """The plain data of a discovery that has a bit of everything."""
    return discovery_case() | {
        "refuted": refuted_case()["refuted"], "lines": unexplained_case()["lines"],
        "left": discovery_case()["findings"], "work": unfinished_case()["work"], "saturated": 0.05,
        "doubts": ["a doubt"],
        "repeated": {"cabinet_temperature": [[ORIGIN_S, ORIGIN_S + 7200.0]]},
        "causes": [*discovery_case()["causes"], *ambiguous_case()["causes"]],
    }  # fmt: skip


def test_every_text_is_escaped() -> None:
    found = full_case()
    for path in list(nodes(found)):
        if isinstance(at(found, path), str) and path[-1] not in CODES:
            put(found, path, EVIL)
    one = found["causes"][0]
    one["parameters"] = {f"{EVIL}{i}": row for i, row in enumerate(one["parameters"].values())}
    one["settings"] = {EVIL: EVIL, f"{EVIL}_K": 3.0}
    one["evidence"]["gains"] = {EVIL: 0.2}
    one["held_out"] |= {"before": {EVIL: 0.2}, "after": {EVIL: 0.1}, "z": {EVIL: 9.0}}
    found["repeated"] = {EVIL: found["repeated"]["cabinet_temperature"]}
    page = discovery_blocks(typed(found), residuals_case(), residuals_case(0.2))
    expect_escaped(page_html(page), page_text(page))


@pytest.mark.parametrize("value", [None, {}, [], -1, "x", True, math.nan])
def test_any_piece_that_is_wrong_is_a_fault_or_a_page(value: object) -> None:
    base = full_case()
    refused = 0
    for path in list(nodes(base)):
        changed = copy.deepcopy(base)
        put(changed, path, value)
        try:
            found = typed(changed)
        except StructureFault as fault:
            refused += 1
            assert fault.faults
            continue
        try:
            blocks = discovery_blocks(found)
            Page(page_html(blocks))
            expect_narrow(page_text(blocks))
        except Exception as fault:
            raise AssertionError(f"{path}: {fault!r}") from fault
    assert refused > 10


def test_a_discovery_of_nothing_gives_a_page_that_says_so() -> None:
    found = DiscoveryResults("", "", "none", typed(discovery_case() | {"baseline": {}}).baseline, findings=())
    assert "unnamed record" in Page(page_html(discovery_blocks(found))).text
    assert page_text(discovery_blocks(found)).startswith("unnamed record")


def test_a_record_without_humidity_leaves_its_pictures_out() -> None:
    nothing = np.full(len(residuals_case().time_h), np.nan)
    before = residuals_case()
    before = replace(before, error={**before.error, "humidity": nothing})
    found = discovery_case()
    for which in ("baseline", "extended"):
        del found[which]["time_constants"]["hygric"]
        for period in ("identification", "validation"):
            del found[which]["rmse"][period]["absolute_humidity_g_m3"]
    after = replace(before, time_h=before.time_h + 0.5)
    text = Page(page_html(discovery_blocks(typed(found), before, after))).text
    assert "There are no errors of the absolute humidity to show" in text
    assert len(figure_error_course(before, after).figure().axes) == 1


# --- on disk -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made") / "deep"
    fit, found = fit_of(discovery_case()), typed(discovery_case())
    made = Discovery(found, residuals_case(), residuals_case(0.2), base=fit, extended=fit)
    assert write_discovery_report(made, folder) == folder / "report.html"
    return folder


FILES = ["discovery.json", "discovery.npz", "fit.json", "fit_report.html", "report.html", "series.npz"]


def test_a_discovery_is_kept_with_both_pages(written: Path, whole: str) -> None:
    assert sorted(file.name for file in written.iterdir()) == FILES
    assert (written / "report.html").read_text(encoding="utf-8") == whole
    assert "Identification report" in (written / "fit_report.html").read_text(encoding="utf-8")


def test_residuals_come_back_as_they_were(written: Path) -> None:
    read = read_discovery(written)
    assert plain(read.results) == plain(typed(discovery_case()))
    assert read.before is not None and read.after is not None
    made = residuals_case()
    for name in ("time_h", "validation"):
        np.testing.assert_array_equal(getattr(read.before, name), getattr(made, name))
    assert read.before.origin_s == made.origin_s
    for name in ("drivers", "error", "measured", "simulated", "sd", "sensor_error"):
        assert set(getattr(read.before, name)) == set(getattr(made, name))
    np.testing.assert_array_equal(read.before.drivers["power"], made.drivers["power"])
    np.testing.assert_array_equal(read.before.error["humidity"], made.error["humidity"])


def test_report_makes_both_pages_again(written: Path, whole: str, capsys: pytest.CaptureFixture) -> None:
    for argument in (written, written / "fit.json"):
        for name in ("report.html", "fit_report.html"):
            (written / name).unlink()
        assert main(["report", str(argument)]) == 0
        assert (written / "report.html").read_text(encoding="utf-8") == whole
        assert (written / "fit_report.html").is_file()
    assert capsys.readouterr().out.strip().endswith("report.html")


def test_without_an_extended_model_nothing_of_it_is_kept(tmp_path: Path) -> None:
    write_discovery(
        Discovery(typed(empty_case()), residuals_case(), base=fit_of(empty_case())), tmp_path
    )
    read = read_discovery(tmp_path)
    assert read.before is not None and read.after is None


def test_a_fit_in_the_same_directory_takes_the_discovery_away(tmp_path: Path) -> None:
    for name in ("discovery.json", "discovery.npz", "fit_report.html", "report.html"):
        (tmp_path / name).write_text("of earlier numbers")
    write_fit(fit_of(discovery_case()), tmp_path)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["fit.json", "series.npz"]


def test_missing_files_are_listed_together(tmp_path: Path) -> None:
    with pytest.raises(ResultFault) as fault:
        read_discovery(tmp_path)
    assert "discovery.json: no such file; run `hygrokf discover`" in str(fault.value)
    assert "discovery.npz: no such file" in str(fault.value) and "hygrokf discover" in str(fault.value)


@pytest.mark.parametrize("text", ["", "{", "[1]", "{}", "[" * 100_000])
def test_damaged_results_are_faults(written: Path, tmp_path: Path, text: str) -> None:
    (tmp_path / "discovery.json").write_text(text)
    (tmp_path / "discovery.npz").write_bytes((written / "discovery.npz").read_bytes())
    with pytest.raises(ResultFault, match=r"discovery\.json: expected"):
        read_discovery(tmp_path)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 broken", b"text"])
def test_damaged_residuals_are_faults(written: Path, tmp_path: Path, content: bytes) -> None:
    (tmp_path / "discovery.json").write_text((written / "discovery.json").read_text())
    (tmp_path / "discovery.npz").write_bytes(content)
    with pytest.raises(ResultFault, match=r"discovery\.npz: expected"):
        read_discovery(tmp_path)


@pytest.mark.parametrize(
    "arrays",
    [
        {"before/time_h": np.zeros(3)},
        {"before/origin_s": np.array(0.0), "before/unheard_of": np.zeros(3)},
        {"before/origin_s": np.array([{"a": 1}], dtype=object)},
    ],
)
def test_other_arrays_are_no_residuals(written: Path, tmp_path: Path, arrays: dict) -> None:
    (tmp_path / "discovery.json").write_text((written / "discovery.json").read_text())
    np.savez(tmp_path / "discovery.npz", **arrays)
    with pytest.raises(ResultFault, match=r"discovery\.npz: expected arrays"):
        read_discovery(tmp_path)


def test_the_face_has_the_names() -> None:
    from hygrokf.discovery import procedure as module

    assert hygrokf.discover is module.discover
