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
    BIAS_K,
    ORIGIN_S,
    discovery_case,
    empty_case,
    residuals_case,
    typed,
    unexplained_case,
)
from builders.html_page import Page
from builders.report_case import report_case, results

import hygrokf
from hygrokf.commands.main import main
from hygrokf.data.result_file import ResultFault
from hygrokf.data.structured import StructureFault, plain
from hygrokf.discovery.discovery_results import DiscoveryResults
from hygrokf.discovery.procedure import Discovery
from hygrokf.discovery.repeats import REPEATED
from hygrokf.discovery.results import read_discovery, write_discovery
from hygrokf.identification.fit import Fit, write_fit
from hygrokf.report.blocks import Card, Cards
from hygrokf.report.discovery_page import (
    discovery_blocks,
    write_discovery_report,
)
from hygrokf.report.discovery_tables import (
    constants_sentences,
    constants_table,
    findings_table,
    parameters_table,
    rejected_table,
    scores_table,
)
from hygrokf.report.discovery_text import (
    error_sentences,
    evidence_sentence,
    gain_sentence,
    settings_words,
    signed_percent,
    verdict_sentences,
)
from hygrokf.report.figures.residual_structure import telling_drivers
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
        "Unexplained errors",
        "Causes tried and rejected",
        "Data and method",
    ]
    assert whole.index("Verdict") < whole.index('id="episodes-1-') < whole.index(headings[0])


def test_the_card_names_the_cause_its_gain_its_rivals_and_what_to_check() -> None:
    card = verdict(discovery_case())
    assert (card.value, card.bounds, card.tone) == ("Solar gain", "confidence 87 %", "plain")
    meaning, gain, rivals, check = card.lines
    assert "sun" in meaning and "1.79" in gain and "1.57 K" in gain and "held-out" in gain
    assert "cooling switching" in rivals and "irradiance measured" in rivals and "shade or paint" in check


def test_tables_and_sentences_carry_the_numbers() -> None:
    found = typed(discovery_case())
    assert findings_table(found).rows == (
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
    believed = "reliable"
    assert constants_table(found).rows[0] == (
        "thermal", "1.36 h", "1.31 … 1.41", believed, "1.20 h", "1.15 … 1.25", believed, "−12 %",
    )  # fmt: skip
    warm, damp = error_sentences(found)
    for number in ("1.85 → 1.57 K", "−15 %", "25 % below", "2.10 K"):
        assert number in warm
    assert "5 % below" in damp and "0.44 g/m³" in damp
    gain = gain_sentence(found.causes[0].gain)
    for number in ("from 1.79 to 1.57 K", "by 12 %", "0.13 … 0.31 K", "1.85 and 1.57 K"):
        assert number in gain
    evidence = evidence_sentence(found.causes[0].evidence)
    for number in ("grows by 296 for 2", "evidence 275", "15.5", "p = 0.020", "falls by 28 %", "25 %"):
        assert number in evidence


def test_the_time_span_and_the_mean_error_are_stated(whole: str) -> None:
    text = Page(whole).text
    assert "2020-07-15T00:00Z to 2020-08-23T23:00Z; searched up to 2020-08-14T00:00Z" in text
    rms = residuals_case().rmse("temperature")
    assert f"temperature by {rms:.2f} K (RMSE), {BIAS_K:.2f} K too high on average" in text


def test_the_page_is_a_pure_function_of_its_data(whole: str) -> None:
    blocks = discovery_blocks(typed(discovery_case()), residuals_case(), residuals_case(0.2))
    assert page_html(blocks) == whole


def test_the_drivers_of_the_findings_are_drawn_first() -> None:
    errors = residuals_case()
    telling = telling_drivers(errors, ["power"])
    assert "power" in telling and "global_horizontal_irradiance" in telling
    assert telling_drivers(errors, ["no_such_driver"]) == telling_drivers(errors)


def test_what_the_extension_leaves_alone_is_drawn_once(whole: str) -> None:
    assert "Temperature, after" in whole and "Absolute humidity, after" not in whole
    assert Page(whole).text.count("leaves these errors as they are") == 1


def test_an_event_is_shown_where_it_was_found() -> None:
    found = discovery_case() | {"misfits": []}
    span = [ORIGIN_S + 5 * 86400.0, ORIGIN_S + 5 * 86400.0 + 7200.0]
    found["causes"][0] |= {"cause": "door_opening", "settings": {"spans": [span]}}
    page = discovery_blocks(typed(found), residuals_case(), residuals_case(0.2))
    assert page.lead[-1].name == "event-1" and page.lead[-1].heading == "Door opening: when"
    text = page_html(discovery_blocks(typed(found), residuals_case(), residuals_case(0.2)))
    assert 'id="event-1-' in text and ">20 Jul<" in text


# --- verdicts ----------------------------------------------------------------------------------


def test_nothing_found_names_no_cause_and_no_check() -> None:
    card = verdict(empty_case())
    assert card.value == "This record shows no missing cause" and card.tone == "plain"
    assert "none of 2 causes" in card.lines[0].lower()
    text = Page(page_html(discovery_blocks(typed(empty_case()), residuals_case()))).text
    assert "→" not in text and "Check in the turbine" not in text and "The cause" not in text
    assert "without and with the cause" in text  # the verdicts of the base model stand there


def test_what_cannot_be_explained_is_a_warning_with_its_driver() -> None:
    card = verdict(unexplained_case())
    assert card.value == "Something is missing; the cause is unknown" and card.tone == "open"
    assert "4.1 K too low" in card.lines[0] and "2 causes" in card.lines[1]
    printed = page_text(discovery_blocks(typed(unexplained_case())))
    for text in (words(unexplained_case()), " ".join(printed.split())):
        assert "the wind speed (correlation −0.31, 3.0 h later)" in text


def test_a_part_explained_is_not_told_as_the_whole() -> None:
    left = {"statement": "readings repeat", "quantity": "readings", "kind": "", "driver": None}
    found = discovery_case() | {"unexplained": left}
    assert verdict(found).lines[-1].endswith("readings repeat.")
    partly = verdict(found | {"verdict": "unexplained"})
    assert partly.value.startswith("Something is missing") and partly.lines[0] == "Readings repeat."
    assert partly.lines[1].startswith("Solar gain (confidence 87 %)")


def test_a_logger_that_repeats_itself_comes_first() -> None:
    left = {"statement": "readings repeat those of the day before", "kind": REPEATED, "quantity": "readings"}
    found = discovery_case() | {"verdict": "unexplained", "unexplained": left}
    card = verdict(found)
    assert "logger" in card.value and "repeats" in card.value and card.lines[1].startswith("Solar gain")
    alone = verdict(found | {"causes": []})
    assert "logger" in alone.lines[-1]


def test_two_causes_have_a_check_each() -> None:
    found = discovery_case()
    second = copy.deepcopy(found["causes"][0])
    second |= {"cause": "exchange_step", "statement": "the exchange changed", "remedy": "ask what was done"}
    found["causes"].append(second)
    text = words(found)
    assert verdict(found).value == "Solar gain + exchange step" and "The causes" in text
    assert "Shade or paint the wall." in text and "Ask what was done." in text


@pytest.mark.parametrize(
    "gain",
    [None, {"quantity": "temperature_K", "period": "validation", "rmse_before": None, "rmse_after": None}],
)
def test_a_cause_without_a_gain_says_why(gain: dict | None) -> None:
    found = discovery_case()
    found["causes"][0]["gain"] = gain
    text = words(found)
    assert text.count("No gain is stated: ") == 1
    assert "no gain is stated" in verdict(found).lines[1].lower()
    assert "1.85 → 1.57 K" in text and "None" not in text.replace("None of", "")


def test_a_gain_that_may_be_none_and_a_loss_are_said() -> None:
    gain = typed(discovery_case()).causes[0].gain
    assert "the gain is not certain" in gain_sentence(replace(gain, lower=-0.02))
    said = gain_sentence(
        replace(gain, rmse_after=1.9, lower=math.nan, upper=math.nan, period="identification")
    )
    assert "rises from 1.79 to 1.90 K, by 6 %" in said and "there is no held-out period" in said


@pytest.mark.parametrize(("confidence", "said"), [(1.0, "> 99 %"), (None, "not stated"), (0.5, "50 %")])
def test_no_name_is_said_to_be_certain(confidence: float | None, said: str) -> None:
    found = discovery_case()
    found["causes"][0]["confidence"] = confidence
    assert verdict(found).bounds == f"confidence {said}"


# --- tables and words --------------------------------------------------------------------------


def test_settings_are_told_in_their_own_words() -> None:
    assert settings_words(discovery_case()["causes"][0]["settings"]) == [
        "date 16 July 2020 00:00 UTC",
        "azimuth 135 °",
        "on 30.0 °C",
        "off 55 %",
        "stamps moved by −60.0 min",
    ]
    spans = {"spans": [[ORIGIN_S, ORIGIN_S + 3600.0]], "days": 0.0, "reads": "cabinet_temperature"}
    assert settings_words(spans) == ["from 15 July 2020 00:00 UTC to 15 July 2020 01:00 UTC"]
    assert settings_words({}) == [] and settings_words({"date_s": 1e300}) == ["date unknown date"]


@pytest.mark.parametrize(
    ("after", "said"),
    [
        (1.19, ("14 % too long", "did not hold")),
        (1.70, ("20 % too short", "did not hold")),
        (1.40, ("2.9 % too short", "but its bounds held")),
    ],
)
def test_the_time_constants_tell_by_how_much_the_base_was_wrong(after: float, said: tuple[str, ...]) -> None:
    found = discovery_case()
    found["extended"]["time_constants"]["thermal"]["value_h"] = after
    assert all(part in constants_sentences(typed(found))[0] for part in said)


def test_open_bounds_have_no_change() -> None:
    found = discovery_case()
    found["extended"]["time_constants"]["thermal"] |= {"upper_h": None, "verdict": "caution"}
    table = constants_table(typed(found))
    assert table is not None and table.rows[0][4:] == ("≥ 1.15 h", "–", "with caution", "–")
    assert constants_table(typed(found | {"extended": None})) is None


def test_scores_name_the_change_and_the_rules() -> None:
    table = scores_table(typed(discovery_case()), "validation")
    assert table is not None
    rows = {row[0]: row[1:] for row in table.rows}
    assert rows["  change"][2] == signed_percent(1.57 / 1.85 - 1.0) == "−15 %"
    assert rows["  change"][5] == "±0.0 %"
    assert rows["c = c_amb"][5] == "0.50" and rows["readings"][2] == "900"
    assert scores_table(typed(discovery_case() | {"extended": None}), "validation") is not None
    assert scores_table(typed(discovery_case() | {"baseline": {}}), "validation") is None


def test_what_was_left_out_stands_in_order_of_its_evidence() -> None:
    table = rejected_table(typed(discovery_case()))
    assert table is not None
    assert [row[0] for row in table.rows] == ["Wall thermal mass", "Door opening (2 openings)"]


def test_results_come_back_from_their_data_under_the_key_of_now() -> None:
    found = typed(discovery_case())
    data = plain(found)
    assert "misfits" not in data and data["findings"][0]["p_adjusted"] == 1e-7
    again = typed(data)
    assert plain(again) == data and again.findings == found.findings
    assert plain(pickle.loads(pickle.dumps(found))) == data
    assert found.to_frame().loc["wall_thermal_mass", "verdict"] == "rejected"


def test_a_doubt_about_the_record_comes_before_any_cause() -> None:
    doubt = "the clock of a.csv seems 2 h fast: if so, state it"
    found = typed(discovery_case() | {"doubts": [doubt]})
    assert doubt in verdict_sentences(found)[0] and len(verdict_sentences(found)) > 1
    assert doubt in " ".join(page_text(discovery_blocks(found)).split())
    assert doubt in Page(page_html(discovery_blocks(found))).text


def test_the_text_is_narrow_and_says_what_the_page_says() -> None:
    found = typed(discovery_case() | {"name": "東京のタービン " * 20})
    text = page_text(discovery_blocks(found))
    expect_narrow(text)
    joined = " ".join(text.split())
    for part in (
        gain_sentence(found.causes[0].gain)[2:],
        "solar_heat 6.1 5.5 … 6.9 K/(kW/m²)",
        "To check: Shade or paint the wall",
        "+ thermal time constant 1.36 h (1.31 … 1.41): reliable",
        "+ thermal time constant 1.20 h (1.15 … 1.25): reliable",
        "rejected: 2 causes",
        "SYNTHETIC",
    ):
        assert part in joined, part


# --- what is missing or hostile ----------------------------------------------------------------


def test_every_text_is_escaped() -> None:
    found = discovery_case() | {"unexplained": unexplained_case()["unexplained"]}
    for path in list(nodes(found)):
        if isinstance(at(found, path), str) and path[-1] not in ("verdict", "quantity", "kind"):
            put(found, path, EVIL)
    cause = found["causes"][0]
    cause["parameters"] = {f"{EVIL}{i}": row for i, row in enumerate(cause["parameters"].values())}
    cause["settings"] = {EVIL: EVIL, f"{EVIL}_K": 3.0}
    cause["evidence"]["free_run_gain"] = {EVIL: 0.2}
    page = discovery_blocks(typed(found), residuals_case())
    expect_escaped(page_html(page), page_text(page))


@pytest.mark.parametrize("value", [None, {}, [], -1, "x", True, math.nan])
def test_any_piece_that_is_wrong_is_a_fault_or_a_page(value: object) -> None:
    base = discovery_case() | {"unexplained": unexplained_case()["unexplained"]}
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
            Page(page_html(discovery_blocks(found)))
            expect_narrow(page_text(discovery_blocks(found)))
        except Exception as fault:
            raise AssertionError(f"{path}: {fault!r}") from fault
    assert refused > 10


def test_a_discovery_of_nothing_gives_a_page_that_says_so() -> None:
    found = DiscoveryResults("", "", "none", typed(discovery_case() | {"baseline": {}}).baseline)
    assert "unnamed record" in Page(page_html(discovery_blocks(found))).text
    assert page_text(discovery_blocks(found)).startswith("unnamed record")


def test_a_record_without_humidity_leaves_its_pictures_out() -> None:
    nothing = np.full(len(residuals_case().time_h), np.nan)
    before = replace(residuals_case(), humidity_error=nothing, humidity_innovation=nothing)
    found = discovery_case()
    for which in ("baseline", "extended"):
        del found[which]["time_constants"]["hygric"]
        for period in ("identification", "validation"):
            del found[which]["rmse"][period]["absolute_humidity_g_m3"]
    after = replace(before, time_h=before.time_h + 0.5)
    text = Page(page_html(discovery_blocks(typed(found), before, after))).text
    assert "There are no errors of the absolute humidity to show" in text
    assert len(error_sentences(typed(found))) == 1 and "misses the temperature" in text


# --- on disk -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made") / "deep"
    fit, found = fit_of(discovery_case()), typed(discovery_case())
    made = Discovery(fit, fit, found, residuals_case(), residuals_case(0.2))
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
    for name in ("time_h", "temperature_error", "humidity_innovation", "validation"):
        np.testing.assert_array_equal(getattr(read.before, name), getattr(made, name))
    assert read.before.name == made.name and read.before.origin_s == made.origin_s
    for name in ("drivers", "measured", "simulated", "sd", "sensor_error"):
        assert set(getattr(read.before, name)) == set(getattr(made, name))
    np.testing.assert_array_equal(read.before.drivers["power"], made.drivers["power"])


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
        Discovery(fit_of(empty_case()), None, typed(empty_case()), residuals_case(), None), tmp_path
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
