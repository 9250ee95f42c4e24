"""The page of a discovery: every number where it belongs, every text escaped, every missing piece said."""

from __future__ import annotations

import copy
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

from hygrokf.commands.main import main
from hygrokf.data.result_file import ResultFault
from hygrokf.data.shared_clocks import sources
from hygrokf.data.structured import StructureFault, plain
from hygrokf.discovery.discover import chosen
from hygrokf.discovery.discovery_results import (
    CauseFound,
    Discovery,
    DiscoveryResults,
    Rejected,
    read_discovery,
    write_discovery,
)
from hygrokf.identification.fit import Fit, write_fit
from hygrokf.modelling.causes.forms import Form, Ground, Setting
from hygrokf.modelling.library import CAUSES
from hygrokf.report.blocks import Card, Cards
from hygrokf.report.discovery_page import (
    cause_parameters_table,
    discovery_blocks,
    evidence_table,
    findings_table,
    gains_table,
    held_out_table,
    scores_tables,
    write_discovery_report,
)
from hygrokf.report.discovery_text import (
    cause_with_form,
    chosen_words,
    discovery_verdict,
    form_words,
    held_out_sentences,
    held_out_text,
)
from hygrokf.report.figures.drawing import NothingToShow
from hygrokf.report.figures.residual_structure import figure_error_course, telling_drivers
from hygrokf.report.page import page_html
from hygrokf.report.terminal import page_text


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a discovery with both of its pages."""
    folder = tmp_path_factory.mktemp("made") / "deep"
    fit, found = fit_of(discovery_case()), typed(discovery_case())
    made = Discovery(found, residuals_case(), residuals_case(0.2), base=fit, extended=fit)
    assert write_discovery_report(made, folder) == folder / "report.html"
    return folder


@pytest.fixture(scope="module")
def whole(written: Path) -> str:
    """The page with all its drawings."""
    return (written / "report.html").read_text(encoding="utf-8")


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
    assert "2020-07-15T00:00Z to 2020-08-23T23:00Z; searched up to 2020-08-14T00:00Z" in page.text


def test_the_verdict_and_its_picture_come_first_and_what_was_tried_last(whole: str) -> None:
    headings = re.findall(r"<h2>(.*?)</h2>", whole)
    assert len(headings) == 8 and headings[-1] == "Data and method"
    assert whole.index("Verdict") < whole.index('id="episodes-1-') < whole.index(headings[0])


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
    assert cause_parameters_table(found.causes[0]).rows == (
        ("solar_heat", "6.13", "5.47 … 6.88", "K/(kW/m²)", "heat of the sun"),
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
    tested = held_out_text(found, found.causes[0].held_out)
    assert all(number in tested for number in ("12 %", "45", "10 days"))


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
    assert page.lead[-2].name == "episodes-1" and page.lead[-2].heading == "The door stood open."
    text = page_html(page)
    assert 'id="episodes-1-' in text and "20 Jul 2020" in text


# --- verdicts ----------------------------------------------------------------------------------


LINE = {"quantity": "temperature", "period_h": 168.0, "p": 1e-6, "cause": "solar_gain"}
SHADE = "shade or paint the wall; check the ventilation of the tower base"
COMPARE = "compare the humidity sensor with a second one"
VERDICTS = [
    # case, changes to it, words of the verdict, words below it, words that must not stand there, confidence
    (discovery_case, {}, "Solar gain (on the roof)", [SHADE], [], "87 %"),
    (empty_case, {}, "no missing cause", ["None of the 2 causes"], ["Check"], ""),
    (unexplained_case, {}, "unknown", ["12.4 h", "2 causes"], [], ""),
    (discovery_case, {"verdict": "unexplained", "lines": [LINE]}, "beside solar gain (on the roof)",
        ["solar gain in the temperature", "7.00 days", SHADE], [], ""),
    (refuted_case, {}, "refute unlogged heater (humidistat, at standstill)", ["temperature"], [], ""),
    (ambiguous_case, {}, "(an offset that grows), internal moisture source or moisture sorption",
        ["3.4 % of the humidity readings", COMPARE], ["Check", "The humidity sensor drifts"], "48 %"),
    (long_class_case, {}, "solar gain, cooling switching, unlogged heater, scheduled heat", [],
        ["shade or paint", "87 %"], ""),
    (unfinished_case, {}, "3,000 simulations ended the search; not judged: moisture sorption",
        ["no cause is named", "--budget"], ["ordinary disturbances"], ""),
    (discovery_case, {"work": unfinished_case()["work"]}, "3,000 simulations",
        ["So far: solar gain (on the roof)."], [], ""),
    (two_causes_case, {}, "Solar gain (on the roof) + exchange step (from a date on)",
        ["confidence 87 %", "confidence 61 %", SHADE, "ask what was done on that date"], [], ""),
    (discovery_case, {"repeated": {"cabinet_temperature": [[ORIGIN_S, ORIGIN_S + 7200.0]]}}, "Solar gain",
        ["cabinet temperature repeat", "2 h in all"], [], "87 %"),
]  # fmt: skip
OPEN = (unexplained_case, unfinished_case)


@pytest.mark.parametrize(("case", "changes", "value", "told", "not_told", "confidence"), VERDICTS)
def test_the_verdict_names_causes_numbers_and_what_to_do(
    case, changes, value, told, not_told, confidence
) -> None:
    found = case() | changes
    card = verdict(found)
    below = " ".join(card.lines)
    assert value in card.value and card.bounds == (confidence and f"confidence {confidence}")
    assert all(below.count(one) == 1 for one in told) and not any(one in below for one in not_told)
    warns = case in OPEN or "verdict" in changes or "work" in changes
    assert card.tone == ("open" if warns else "plain")
    first = page_text(discovery_blocks(typed(found))).split("\n\n")[1]
    assert " ".join(first.split()).startswith(f"Verdict: {card.value}")


def test_a_refuted_cause_has_its_reason_and_its_numbers() -> None:
    text = words(refuted_case())
    assert "+30 %" in text and "4.40" in text and "after selection" in text
    said = {verdict(refuted_case()).value}
    for reason in ("no_gain", "unproven"):
        found = refuted_case()
        found["refuted"][0]["held_out"]["reason"] = reason
        said.add(words(found))
    assert len(said) == 3


@pytest.mark.parametrize("days", [0, 1, 13, 14])
def test_what_the_held_out_part_can_show_is_told(days: int) -> None:
    found = typed(discovery_case() | {"held_out_days": days})
    text = " ".join(held_out_sentences(found)).lower()
    assert ("too short" in text) == (0 < days < 14)
    assert ("after selection" in text) == ("after selection" in gains_table(found).columns[0]) == (days > 0)
    assert held_out_sentences(replace(found, estimator="likelihood"))[0] not in held_out_sentences(found)


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
    made = [form for cause in CAUSES for form in cause.forms(ground)]
    assert {form.cause for form in made} == {cause.name for cause in CAUSES}
    assert all(form.code for form in made)
    clocks = {form.code for form in made if form.cause == "clock_shift"}
    assert clocks and {code.partition(":")[2] for code in clocks} <= set(sources(record))
    assert all(form_words(form.code) for form in made)


def test_a_form_is_told_with_its_cause() -> None:
    assert cause_with_form(Rejected("unlogged_heater", "humidistat__at_standstill")) == (
        "unlogged heater (humidistat, at standstill)"
    )
    assert cause_with_form(Rejected("clock_shift", "in_summer_time:cabinet_log")) == (
        "clock shift (cabinet_log, in summer time)"
    )
    assert cause_with_form(Rejected("oven")) == "oven"


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
    (row,) = cause_parameters_table(typed(found).causes[0]).rows
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
    change = {"condition": {"code": "preheating", "values": {}}, "side": "high", "lasting_h": 5.0}
    left = discovery_case()["findings"][0] | change
    found = discovery_case() | {"left": [left]}
    statement = "during pre-heating, simulated temperature is 1.4 K too high for 5 h"
    assert statement[1:] in words(found).split("What is left")[1]
    assert statement in verdict(found).lines[-2] and statement[1:] not in words(discovery_case())


def test_results_come_back_from_their_data_under_the_key_of_now() -> None:
    found = typed(discovery_case())
    data = plain(found)
    assert data["findings"][0]["p_adjusted"] == 1e-7
    again = typed(data)
    assert plain(again) == data and again.findings == found.findings
    assert plain(pickle.loads(pickle.dumps(found))) == data
    assert found.to_frame().loc["wall_thermal_mass", "verdict"] == "weak"


DOUBT = {"code": "same_files", "values": {}}


def test_a_doubt_about_the_record_comes_before_any_cause() -> None:
    found = typed(discovery_case() | {"doubts": [DOUBT]})
    doubt = found.doubts[0].text
    reasons = discovery_verdict(found).reasons
    assert doubt in reasons[0] and len(reasons) > 1
    assert doubt in " ".join(page_text(discovery_blocks(found)).split())
    assert doubt in Page(page_html(discovery_blocks(found))).text


def test_the_text_is_narrow_and_says_what_the_page_says() -> None:
    found = typed(discovery_case() | {"name": "東京のタービン " * 20})
    text = page_text(discovery_blocks(found))
    expect_narrow(text)
    joined = " ".join(text.split())
    for part in (
        "temperature 1.85 K 1.57 K −15 %", "solar_heat 6.13 5.47 … 6.88 K/(kW/m²)", SHADE,
        "1.36 h (1.31 … 1.41)", "1.20 h (1.15 … 1.25)", "Door opening (single openings)", "SYNTHETIC",
    ):  # fmt: skip
        assert part in joined, part


# --- what is missing or hostile ----------------------------------------------------------------


CODES = ("verdict", "quantity", "kind", "reason", "code", "side", "estimator", "provenance")
"""Keys whose values are codes, checked on reading."""


def full_case() -> dict:
    """The plain data of a discovery that has a bit of everything."""
    return discovery_case() | {
        "refuted": refuted_case()["refuted"], "lines": unexplained_case()["lines"],
        "left": discovery_case()["findings"], "work": unfinished_case()["work"], "saturated": 0.05,
        "doubts": [DOUBT],
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


@pytest.mark.parametrize("value", [None, {}, -1, "x"])
def test_any_piece_that_is_wrong_is_a_fault_or_a_page(value: object) -> None:
    base = full_case()
    refused = 0
    for path in list(nodes(base, most=1)):
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


FILES = ["discovery.json", "discovery.npz", "fit.json", "fit_report.html", "report.html", "series.npz"]


def test_a_discovery_is_kept_with_both_pages(written: Path) -> None:
    assert sorted(file.name for file in written.iterdir()) == FILES
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
    for name in ("report.html", "fit_report.html"):
        (written / name).unlink()
    assert main(["report", str(written / "fit.json")]) == 0
    assert (written / "report.html").read_text(encoding="utf-8") == whole
    assert (written / "fit_report.html").is_file()
    assert capsys.readouterr().out.strip().endswith("report.html")


def test_without_an_extended_model_nothing_of_it_is_kept(tmp_path: Path) -> None:
    write_discovery(Discovery(typed(empty_case()), residuals_case(), base=fit_of(empty_case())), tmp_path)
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
    for words in ("discovery.json: no such file", "discovery.npz: no such file", "hygrokf discover"):
        assert words in str(fault.value)


@pytest.mark.parametrize(
    ("file", "content"),
    [("discovery.json", b"[1]"), ("discovery.json", b"{}"), ("discovery.npz", b"PK\x03\x04 broken")],
)
def test_damaged_files_are_faults(written: Path, tmp_path: Path, file: str, content: bytes) -> None:
    for name in ("discovery.json", "discovery.npz"):
        (tmp_path / name).write_bytes((written / name).read_bytes())
    (tmp_path / file).write_bytes(content)
    with pytest.raises(ResultFault, match=f"{file}: expected"):
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
