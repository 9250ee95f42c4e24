"""The page of a discovery: every number where it belongs, every text escaped, every missing piece said."""

from __future__ import annotations

import copy
import json
import math
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from builders.discovery_case import (
    BIAS_K,
    ORIGIN_S,
    discovery_case,
    empty_case,
    residuals_case,
    unexplained_case,
)
from builders.html_page import Page
from builders.report_case import report_case, results

import hygrokf
from hygrokf.commands.main import main
from hygrokf.discovery.findings import Misfit
from hygrokf.discovery.procedure import Discovery
from hygrokf.discovery.repeats import REPEATED
from hygrokf.discovery.results import read_discovery, write_discovery
from hygrokf.identification.fit import Fit
from hygrokf.identification.results import ResultFault, write_fit
from hygrokf.report.discovery_page import discovery_page, write_discovery_report
from hygrokf.report.discovery_tables import constants_sentences, constants_table, rejected_table, scores_table
from hygrokf.report.discovery_text import discovery_text, gain_sentence, settings_words, signed_percent
from hygrokf.report.figures.residual_structure import telling_drivers
from hygrokf.report.terminal import cells


@pytest.fixture(scope="module")
def whole() -> str:
    """The page with all its drawings."""
    return discovery_page(discovery_case(), residuals_case(), residuals_case(0.2))


def words(found: dict) -> str:
    """The text of a page without drawings."""
    return Page(discovery_page(found)).text


def fit_of(found: dict) -> Fit:
    """A fit that can be written, with the fixture's numbers."""
    data, series = report_case()
    return Fit(found["name"], None, {}, results(data), series)  # type: ignore[arg-type]


# --- the whole ---------------------------------------------------------------------------------


def test_the_page_needs_nothing_else(whole: str) -> None:
    page = Page(whole)
    plain = re.sub(r"data:image/png;base64,[^\"]*", "", re.sub(r"<style>.*?</style>", "", whole, flags=re.S))
    assert "http" not in plain and "//" not in plain
    assert "<script" not in whole and "@import" not in whole and "url(" not in re.sub(r"url\(#", "", whole)
    names = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
    assert len(names) == len(set(names)) > 100
    used = {a or b for a, b in re.findall(r'href="#([^"]*)"|url\(#([^)]*)\)', whole)}
    assert used and used <= set(names)
    links = [attributes["href"] for tag, attributes in page.tags if tag == "a"]
    assert links == ["fit_report.html"]
    drawn = [attributes for tag, attributes in page.tags if tag == "svg"]
    assert len(drawn) == 5 and all(one["role"] == "img" and one["aria-label"] for one in drawn)
    assert "is left out" not in page.text
    assert len(whole.encode()) < 3_000_000


def test_the_contents_stand_in_the_order_in_which_they_are_read(whole: str) -> None:
    headings = re.findall(r"<h2>(.*?)</h2>", whole)
    assert headings == [
        "What the simulation gets wrong",
        "The cause",
        "Before and after",
        "What the wrong model did to the time constants",
        "Errors before and after",
        "What was tried and left out",
        "What is left unexplained",
        "Data and method",
    ]
    assert whole.index("Verdict") < whole.index("What the simulation gets wrong")


def test_headline_and_tables_carry_the_numbers(whole: str) -> None:
    text = Page(whole).text
    for part in (
        "SYNTHETIC",
        "2020-07-15 00:00 to 2020-08-23 23:00 UTC; searched up to 2020-08-14 00:00",
        "Verdict a cause is named Solar gain confidence 87 %",
        "temperature error of the free run falls from 1.79 to 1.57 K, by 12 % (95 % bounds of the fall: 0.13 "
        "… 0.31 K)",
        "1.85 → 1.57 K −15 % as the better simulators that both can be: 1.79 → 1.57 K, falls by 0.13 … 0.31 "
        "K (95 %)",
        "as they were identified, they err by 1.85 and 1.57 K, and these are the numbers of the tables and "
        "of the fit's page",
        "25 % below the rule “heat release without heat storage” (2.10 K)",
        "5 % below the rule “c = c_amb T_amb/T_conv,a” (0.44 g/m³)",
        "Check in the turbine: shade or paint the wall.",
        "From 10 to 15 h UTC, simulated temperature is 1.4 K too low 1.4 K 27 of 30 2 % < 0.001",
        "2 ln L grows by 296 for 2 parameters; tempered by the base’s misfit and less the price of what was "
        "searched, that is evidence of 275",
        "score statistic 15.5",
        "p = 0.020, corrected for all that was tried",
        "28 % of the squared temperature error is gone (25 % without the best days)",
        "Cooling switching; to tell them apart: irradiance measured at the tower",
        "solar_heat 6.1 5.5 … 6.9 K/(kW/m²) heat of the sun",
        "solar_time 0.690 open … 1.01 h lag",
        "the thermal time constant was 13 % too long, and its bounds did not hold",
        "thermal 1.36 h 1.31 … 1.41 to be believed 1.20 h 1.15 … 1.25 to be believed −12 %",
        "The numbers of the base model ✓ thermal time constant 1.36 h (1.31 … 1.41) , to be believed",
        "The hygric time constant stays as it was",
        "base model, free run 1.76 2.04 1.85",
        "extended model, free run 1.49 1.73 1.57 0.40 0.46 0.42",
        "Wall thermal mass 77.7 3 55.5 4 % – the free run gains too little",
        "Door opening (2 openings) 0.0 4 −40.0 −3 % – it gains no likelihood",
        "Nothing: the errors of the extended model show no structure",
        "3 causes were tried",
    ):
        assert part in text, part


def test_on_the_whole_the_simulation_is_said_to_be_too_high_where_it_is(whole: str) -> None:
    errors = residuals_case()
    rms = errors.rmse("temperature")
    assert f"temperature by {rms:.2f} K, {BIAS_K:.2f} K too high on average" in Page(whole).text


def test_the_page_is_a_pure_function_of_its_data(whole: str) -> None:
    found = discovery_case()
    assert discovery_page(found, residuals_case(), residuals_case(0.2)) == whole
    assert found == discovery_case()


def test_the_drivers_of_the_misfits_are_drawn_first() -> None:
    errors = residuals_case()
    telling = telling_drivers(errors, ["power"])
    assert "power" in telling and "global_horizontal_irradiance" in telling
    assert telling_drivers(errors, ["no_such_driver"]) == telling_drivers(errors)


def test_what_the_extension_leaves_alone_is_drawn_once() -> None:
    before, after = residuals_case(), residuals_case(0.2)
    text = discovery_page(discovery_case(), before, after)
    assert "Temperature, after" in text and "Absolute humidity, after" not in text
    assert Page(text).text.count("leaves these errors as they are") == 1


def test_an_event_is_shown_where_it_was_found() -> None:
    found = discovery_case()
    span = [ORIGIN_S + 5 * 86400.0, ORIGIN_S + 5 * 86400.0 + 7200.0]
    found["causes"][0] |= {"cause": "door_opening", "settings": {"spans": [span, [None, 3.0], "x"]}}
    text = discovery_page(found, residuals_case(), residuals_case(0.2))
    assert "Door opening: when" in text and 'id="event-1-' in text and ">20 Jul<" in text
    assert "event-1" not in discovery_page(discovery_case(), residuals_case())


# --- verdicts ----------------------------------------------------------------------------------


def test_nothing_found_is_said_plainly() -> None:
    found = empty_case()
    text = Page(discovery_page(found, residuals_case())).text
    assert "Nothing is missing that this record shows None of 2 causes of the library is both" in text
    assert "1.85 K 12 % below the rule" in text and "→" not in text
    assert "Nothing that is significant, material" in text
    assert "Before and after" not in text and "Check in the turbine:" not in text
    assert "the errors of the base model show no structure" in text
    assert "did to the time constants" not in text
    assert "nothing that is both significant and worth having" in discovery_text(found)


def test_what_cannot_be_explained_is_said_plainly() -> None:
    found = unexplained_case()
    text = words(found)
    assert "Something is missing; its cause is not known" in text
    assert "None of 2 causes of the library explains it, so none is named" in text
    assert text.count("In 14 episodes simulated temperature is up to 4.1 K too low") == 2
    assert "goes most with the wind speed (correlation −0.31, 3.0 h later)" in text
    assert "class='card wide open'" in discovery_page(found)
    assert "structure remains" in discovery_text(found) and "wind speed" in discovery_text(found)


def test_a_part_explained_is_not_told_as_the_whole() -> None:
    left = {"statement": "readings repeat", "quantity": "readings", "driver": None, "correlation": 0.0}
    found = discovery_case() | {"unexplained": left}
    assert "That is not all: readings repeat" in words(found)
    partly = found | {"verdict": "unexplained"}
    text = words(partly)
    assert (
        "Something is missing; its cause is not known Readings repeat. Solar gain (confidence 87 %): the "
        "temperature error falls" in text
    )


def test_a_logger_that_repeats_itself_is_what_the_page_says_first() -> None:
    left = {"statement": "readings repeat those of the day before", "kind": REPEATED, "quantity": "readings"}
    found = discovery_case() | {"verdict": "unexplained", "unexplained": left}
    text = words(found)
    assert "A logger writes readings again that are a day old" in text
    assert "Solar gain (confidence 87 %): the temperature error falls" in text
    alone = words(found | {"causes": []})
    assert "see to that first." in alone and "found in the others" not in alone


def test_two_causes_have_a_remedy_each() -> None:
    found = discovery_case()
    second = copy.deepcopy(found["causes"][0])
    second |= {"cause": "exchange_step", "statement": "the exchange changed", "remedy": "ask what was done"}
    found["causes"].append(second)
    text = words(found)
    assert "Solar gain + exchange step" in text and "The causes" in text
    assert "Shade or paint the wall." in text and "Ask what was done." in text
    assert "with all of them together" in text


@pytest.mark.parametrize(
    "gain", [None, {"quantity": "temperature_K", "rmse_before": None, "rmse_after": None}]
)
def test_a_cause_without_a_gain_says_why(gain: dict | None) -> None:
    found = discovery_case()
    found["causes"][0]["gain"] = gain
    text = words(found)
    assert text.count("No gain is stated: what was seen in one episode only") == 1
    assert "Seen once, or an event: no gain can be held against other data." in text
    assert "the confidence is capped" in text and "None" not in text.replace("None of", "")
    assert "1.85 → 1.57 K" in text  # the card falls back on the tables' errors
    assert "no gain is stated" in discovery_text(found)


def test_a_gain_that_may_be_none_and_a_loss_are_said() -> None:
    cause = discovery_case()["causes"][0]
    cause["gain"] |= {"lower": -0.02}
    assert "the gain is not certain" in gain_sentence(cause)
    cause["gain"] |= {"rmse_after": 1.9, "lower": None, "upper": None, "period": "identification"}
    said = gain_sentence(cause)
    assert "rises from 1.79 to 1.90 K, by 6 %" in said and "there is no held-out period" in said


def test_surely_is_not_said_of_a_name() -> None:
    found = discovery_case()
    found["causes"][0]["confidence"] = 1.0
    assert "confidence > 99 %" in words(found) and "100 %" not in words(found)
    found["causes"][0]["confidence"] = None
    assert "confidence not stated" in words(found)


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
    assert settings_words(None) == [] and settings_words({"date_s": 1e300}) == ["date unknown date"]


@pytest.mark.parametrize(
    ("after", "said"),
    [
        (1.19, "14 % too long, and its bounds did not hold the value that the extended model finds."),
        (1.70, "20 % too short, and its bounds did not hold the value that the extended model finds."),
        (1.40, "2.9 % too short, within its own bounds."),
    ],
)
def test_the_time_constants_tell_by_how_much_the_base_was_wrong(after: float, said: str) -> None:
    found = discovery_case()
    found["extended"]["time_constants"]["thermal"]["value_h"] = after
    assert constants_sentences(found)[0].endswith(said)


def test_open_bounds_have_no_change() -> None:
    found = discovery_case()
    found["extended"]["time_constants"]["thermal"] |= {"upper_h": None, "verdict": "caution"}
    table = constants_table(found)
    assert table is not None and table.rows[0][4:] == ("≥ 1.15 h", "–", "with caution", "–")
    assert constants_table(found | {"extended": None}) is None


def test_scores_name_the_change_and_the_rules() -> None:
    table = scores_table(discovery_case(), "validation")
    assert table is not None
    rows = {row[0]: row[1:] for row in table.rows}
    assert rows["  change"][2] == signed_percent(1.57 / 1.85 - 1.0) == "−15 %"
    assert rows["  change"][5] == "±0.0 %"
    assert rows["c = c_amb"][5] == "0.50" and rows["readings"][2] == "900"
    for which in ("baseline", "extended"):
        found = discovery_case()
        found[which] = None
        assert scores_table(found, "validation") is None or which == "extended"


def test_what_was_left_out_stands_in_order_of_its_evidence() -> None:
    table = rejected_table(discovery_case())
    assert table is not None
    assert [row[0] for row in table.rows] == ["Wall thermal mass", "Door opening (2 openings)"]


def test_a_misfit_comes_back_from_its_data() -> None:
    data = json.loads(json.dumps(discovery_case()["misfits"][0]))
    assert Misfit.from_json(data).to_json() == data


def test_the_text_is_narrow_and_says_what_the_page_says() -> None:
    found = discovery_case()
    found["name"] = "東京のタービン " * 20
    text = discovery_text(found)
    assert max(cells(line) for line in text.splitlines()) <= 100
    joined = " ".join(text.split())
    for part in (
        gain_sentence(found["causes"][0]),
        "solar_heat = 6.1 (5.5 … 6.9) K/(kW/m²)",
        "check: shade or paint the wall",
        "base model: + thermal time constant 1.36 h (1.31 … 1.41): to be believed",
        "extended model: + thermal time constant 1.20 h (1.15 … 1.25): to be believed",
        "change by the extension: thermal −12 %, hygric ±0.0 %",
        "tried and left out: 2 causes",
        "SYNTHETIC",
    ):
        assert part in joined, part


# --- what is missing or hostile ----------------------------------------------------------------

EVIL = "<img src=x onerror=alert(1)>\"'&amp;</style></svg><script>$x_{$\u202e\x00\n"


def nodes(data: object, path: tuple = ()) -> Iterator[tuple]:
    """Paths to all nodes."""
    if path:
        yield path
    children = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    for key, value in children:
        yield from nodes(value, (*path, key))


def put(data: object, path: tuple, value: object) -> None:
    for part in path[:-1]:
        data = data[part]  # type: ignore[index]
    data[path[-1]] = value  # type: ignore[index]


def take(data: object, path: tuple) -> object:
    for part in path:
        data = data[part]  # type: ignore[index]
    return data


def test_every_text_is_escaped() -> None:
    found = discovery_case() | {"unexplained": unexplained_case()["unexplained"]}
    for path in list(nodes(found)):
        if isinstance(take(found, path), str) and path[-1] not in ("verdict", "quantity", "kind"):
            put(found, path, EVIL)
    cause = found["causes"][0]
    cause["parameters"] = {f"{EVIL}{i}": row for i, row in enumerate(cause["parameters"].values())}
    cause["settings"] = {EVIL: EVIL, f"{EVIL}_K": 3.0}
    cause["evidence"]["free_run_gain"] = {EVIL: 0.2}
    text = discovery_page(found, residuals_case())
    page = Page(text)
    assert "<img" not in text and "<script" not in text and "\x00" not in text and "\u202e" not in text
    assert {tag for tag, _ in page.tags} & {"img", "script", "iframe", "object"} == set()
    assert all(not name.startswith("on") for _, attributes in page.tags for name in attributes)
    assert text.count("</style>") == 1
    said = discovery_text(found)
    assert "\x00" not in said and "\u202e" not in said
    assert max(cells(line) for line in said.splitlines()) <= 100


@pytest.mark.parametrize("value", [None, {}, [], -1, "x", True, math.nan])
def test_any_piece_may_be_null_or_wrong(value: object) -> None:
    base = discovery_case() | {"unexplained": unexplained_case()["unexplained"]}
    for path in list(nodes(base)):
        if "spans" in path:
            continue
        changed = copy.deepcopy(base)
        put(changed, path, value)
        try:
            Page(discovery_page(changed))
            assert max(cells(line) for line in discovery_text(changed).splitlines()) <= 100
        except Exception as fault:
            raise AssertionError(f"{path}: {fault!r}") from fault


def test_no_results_at_all_give_a_page_that_says_so() -> None:
    text = words({})
    assert "unnamed record" in text and "no residuals to draw" in text and "No other cause was tried" in text
    assert discovery_text({}).startswith("unnamed record")


def test_a_record_without_humidity_leaves_its_pictures_out() -> None:
    from dataclasses import replace

    nothing = np.full(len(residuals_case().time_h), np.nan)
    before = replace(residuals_case(), humidity_error=nothing, humidity_innovation=nothing)
    found = discovery_case()
    for which in ("baseline", "extended"):
        found[which]["time_constants"]["hygric"] = None
        for period in ("identification", "validation"):
            found[which]["rmse"][period]["absolute_humidity_g_m3"] = None
    text = Page(discovery_page(found, before, replace(before, time_h=before.time_h + 0.5))).text
    assert "There are no errors of the absolute humidity to show" in text
    assert "Error of the absolute humidity free run" not in text and "in absolute humidity by" not in text


# --- on disk -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made") / "deep"
    found = discovery_case()
    fit = fit_of(found)
    made = Discovery(fit, fit, found, residuals_case(), residuals_case(0.2))
    assert write_discovery_report(made, folder) == folder / "report.html"
    return folder


FILES = ["discovery.json", "discovery.npz", "fit.json", "fit_report.html", "report.html", "series.npz"]


def test_a_discovery_is_kept_with_both_pages(written: Path, whole: str) -> None:
    assert sorted(file.name for file in written.iterdir()) == FILES
    assert (written / "report.html").read_text(encoding="utf-8") == whole
    assert "identification report" in (written / "fit_report.html").read_text(encoding="utf-8")


def test_residuals_come_back_as_they_were(written: Path) -> None:
    read = read_discovery(written)
    assert read.results == json.loads(json.dumps(discovery_case()))
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
    found = empty_case()
    write_discovery(Discovery(fit_of(found), None, found, residuals_case(), None), tmp_path)
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
    assert "discovery.json: no such file" in str(fault.value)
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
