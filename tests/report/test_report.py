"""The report: every number where it belongs, every text escaped, every missing piece said, nothing from
outside."""

from __future__ import annotations

import copy
import math
import re

import numpy as np
import pytest
from builders.damage import EVIL, at, expect_alone, expect_escaped, expect_narrow, nodes, put
from builders.html_page import Page as _Page
from builders.report_case import report_case, results, write_case

from hygrokf.data.structured import StructureFault, plain
from hygrokf.identification.verdict import with_verdicts
from hygrokf.report.blocks import Figure
from hygrokf.report.figures.drawing import NothingToShow
from hygrokf.report.figures.fit_figures import FIGURES
from hygrokf.report.fit_page import ReportFault, fit_blocks, read_results, write_report
from hygrokf.report.fit_tables import rmse_table
from hygrokf.report.fit_text import judgements
from hygrokf.report.page import page_html
from hygrokf.report.terminal import MARKS_KEY, cells, page_text, shortened
from hygrokf.texts.fit_codes import FitCode
from hygrokf.texts.record_codes import DoubtCode
from hygrokf.texts.wording import decimals_for, percent, plain_number


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages without their drawings, where a test is about words."""

    def nothing() -> None:
        raise NothingToShow("Not drawn.")

    monkeypatch.setattr(
        "hygrokf.report.fit_page.figure_of",
        lambda name, fit, series: Figure(name, FIGURES[name][0], "", nothing),
    )


def _page(fit: dict, series: dict | None = None) -> _Page:
    return _Page(page_html(fit_blocks(results(fit), series or {})))


# --- the whole ---------------------------------------------------------------------------------


def test_the_report_is_one_file_of_a_page_that_needs_nothing_else(tmp_path) -> None:
    folder = write_case(tmp_path, *report_case())
    path = write_report(folder)
    assert path == folder / "report.html"
    text = path.read_text(encoding="utf-8")
    assert len(text.encode()) < 1_500_000
    page = expect_alone(text)
    assert sum(tag == "svg" for tag, _ in page.tags) == 10 and page.text.count("is left out") == 0
    assert sorted(p.name for p in folder.iterdir()) == ["fit.json", "report.html", "series.npz"]


def test_headline_tables_and_footer_carry_the_numbers(quick) -> None:
    fit, series = report_case()
    text = _page(fit, series).text
    for words in (
        "SYNTHETIC", "1.45 h 1.40 … 1.50, 95 %", "0.30 h 0.27 … 0.33, 95 %", "1.52 h (1.29 … 1.75)",
        "23.1 °C inside and 15.0 °C outside", "12345.60", "hygrokf 0.1.0 on 2024-05-01 12:00 UTC",
        "0f0f0f0f", "at its bound", "prior 0 ± 0.15", "not determined", "8.40",
    ):  # fmt: skip
        assert words in text, words
    for period in ("identification", "validation"):
        found = fit["rmse"][period]["temperature_K"]
        row = " ".join(f"{found[regime]:.2f}" for regime in ("operation", "standstill", "total"))
        assert f"model, free run {row}" in text
        assert str(found["n"]["total"]) in text
    assert "NOT CONVERGED" not in text


def test_a_fit_that_did_not_converge_is_red_on_top(quick) -> None:
    fit, series = report_case()
    fit |= {"converged": False, "messages": plain((FitCode.NO_STEP_IMPROVES(),))}
    text = page_html(fit_blocks(results(fit), series))
    assert '<p class="banner severe"><b>NOT CONVERGED</b> no step improves' in text
    assert "NOT CONVERGED: no step improves" in page_text(fit_blocks(results(fit), {}))
    first = judgements(results(fit))[0]
    assert (first.verdict, first.reasons[0].code.key) == ("reject", "not_converged")


def test_a_disagreement_of_the_criteria_stands_under_its_number(quick) -> None:
    fit, series = report_case()
    fit["time_constants"]["hygric"]["criteria_disagree"] = True
    text = page_html(fit_blocks(results(fit), series)).replace("\xa0", " ")
    (hygric,) = (one for one in judgements(results(fit)) if one.about == "hygric")
    pair = re.compile(r"0\.300 h[^<.]*0\.330 h")
    assert hygric.verdict == "caution" and any(pair.search(one.text) for one in hygric.reasons)
    assert pair.search(text.partition("<h2>")[0])  # under its number
    assert len(pair.findall(text)) == 2  # and once more as a reason


# --- escaping ----------------------------------------------------------------------------------


def test_every_text_of_the_files_is_escaped() -> None:
    fit, series = report_case()
    for path in list(nodes(fit)):
        names = ("code", "test", "end", "effect", "provenance")
        coded = path[-1] in names or path[-2:] == ("response", "kind")
        if isinstance(at(fit, path), str) and not coded:
            put(fit, path, EVIL)
    for place in ("parameters", "bands", "warnings"):
        if isinstance(fit[place], dict):
            fit[place] = {f"{EVIL}{i}": value for i, value in enumerate(fit[place].values())}
    outputs = fit["innovations"]["outputs"]
    for one in outputs.values():
        one["cross_correlation"] = {f"{EVIL}{i}": v for i, v in enumerate(one["cross_correlation"].values())}
    remark = plain(FitCode.CONSTANT_INNOVATIONS(output=EVIL))
    fit["innovations"]["outputs"] = {**outputs, EVIL: {"n": 3, "remark": remark}}
    expect_escaped(page_html(fit_blocks(results(fit), series)), page_text(fit_blocks(results(fit), {})))


# --- missing pieces ----------------------------------------------------------------------------


def _trimmed(data: object, length: int) -> object:
    """The data with shorter lists, so that many copies are cheap."""
    if isinstance(data, dict):
        return {key: _trimmed(value, length) for key, value in data.items()}
    return [_trimmed(value, length) for value in data[:length]] if isinstance(data, list) else data


@pytest.mark.parametrize(
    "value", [None, {}, *(pytest.param(v, marks=pytest.mark.slow) for v in (-1, [], "x", True))]
)
def test_a_piece_that_is_wrong_leaves_a_page_or_is_a_fault_with_its_place(quick, value: object) -> None:
    fit = _trimmed(report_case()[0], 5)
    seen: set[tuple] = set()
    for path in nodes(fit, most=1):
        # one parameter and one regime stand for all
        kind = tuple("*" if part in fit["parameters"] or isinstance(part, int) else part for part in path)
        if kind in seen:
            continue
        seen.add(kind)
        changed = copy.deepcopy(fit)
        put(changed, path, value)
        try:
            blocks = fit_blocks(results(changed), {})
            _Page(page_html(blocks))
            expect_narrow(page_text(blocks))
        except StructureFault as fault:
            assert all(one.startswith(str(path[0])) for one in fault.faults), path
        except Exception as fault:
            raise AssertionError(f"{path}: {fault!r}") from fault
    assert len(seen) > 250


@pytest.mark.parametrize(
    "value", [None, *(pytest.param(v, marks=pytest.mark.slow) for v in (-1.0, [], {}, "x"))]
)
@pytest.mark.parametrize("piece", ["heat_release", "time_constants", "innovations", "parameters", "design"])
def test_figures_take_a_fit_with_holes(piece: str, value: object) -> None:
    from hygrokf.report.figures.fit_figures import figure_heat_release, figure_innovations, figure_profiles

    fit, series = report_case()
    fit = _trimmed(fit, 9)
    m = len(series["time_s"])
    series = {name: value[::20] if value.shape == (m,) else value for name, value in series.items()}
    draw = {"time_constants": figure_profiles, "innovations": figure_innovations}.get(
        piece, figure_heat_release
    )
    seen = set()
    for path in ((), *nodes(fit[piece], most=2)):
        inputs = fit["innovations"]["outputs"]["temperature"]["cross_correlation"]
        kind = tuple("*" if isinstance(part, int) or part in inputs else part for part in path)
        if kind in seen or (len(kind) > 2 and kind[0] == "outputs" and kind[1] == "humidity"):
            continue
        if piece == "parameters" and not (path and path[0].startswith("heat_release")):
            continue
        seen.add(kind)
        changed = copy.deepcopy(fit)
        put(changed, (piece, *path), value)
        try:
            draw(results(changed), series)
        except (NothingToShow, StructureFault):
            pass
        except Exception as fault:
            raise AssertionError(f"{path}: {fault!r}") from fault


def test_an_empty_fit_gives_a_page_that_says_so() -> None:
    page = _page({})
    assert (
        page.text.count("left out") >= 8
        and "unnamed record" in page.text
        and "CONVERGENCE UNKNOWN" in page.text
    )
    assert "not identified" in page.text
    assert page_text(fit_blocks(results({}), {})).startswith("unnamed record")


def test_without_humidity_the_reason_is_given(quick) -> None:
    fit, series = report_case()
    del fit["time_constants"]["hygric"]
    fit["design"]["statements"] = plain((FitCode.NO_HUMIDITY(),))
    for period in ("identification", "validation"):
        del fit["rmse"][period]["absolute_humidity_g_m3"]
        fit["baselines"][period] = {"no_dynamics": fit["baselines"][period]["no_dynamics"]}
    text = _page(fit, series).text
    assert "not identified no humidity readings of both inside and outside" in text
    assert "c = c_amb " not in text.split("How this was computed")[0]


def test_without_validation_that_is_said(quick) -> None:
    fit, series = report_case()
    fit["rmse"]["validation"] = {
        q: {"operation": None, "standstill": None, "total": None, "n": {}} for q in fit["rmse"]["validation"]
    }
    fit["period"]["until"] = None
    assert "No validation period" in _page(fit, series).text
    assert rmse_table(results(fit), "validation") is None


def test_one_reading() -> None:
    fit, series = report_case()
    m = len(series["time_s"])
    k = int(np.flatnonzero(np.isfinite(series["temperature_innovation"]))[0])
    one = {name: value[k : k + 1] if value.shape == (m,) else value for name, value in series.items()}
    few = FitCode.TOO_FEW_INNOVATIONS(output="temperature", n=1, fewest=30)
    fit["innovations"] = {
        "outputs": {"temperature": {"n": 1, "remark": plain(few)}},
        "tests": [],
    }
    page = _page(fit, one)
    assert "is left out" in page.text and "too few" in page.text


# --- faults ------------------------------------------------------------------------------------


def test_missing_files_are_listed_together(tmp_path) -> None:
    with pytest.raises(ReportFault) as fault:
        write_report(tmp_path / "nowhere")
    assert all(words in str(fault.value) for words in ("fit.json", "series.npz", "hygrokf fit"))


@pytest.mark.parametrize("text", ["", "[1, 2]", "\x00", "[" * 100_000])
def test_damaged_results_are_faults(tmp_path, text: str) -> None:
    folder = write_case(tmp_path, *report_case())
    (folder / "fit.json").write_text(text)
    with pytest.raises(ReportFault, match=r"fit\.json: expected"):
        write_report(folder)
    assert not (folder / "report.html").exists()


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 broken", b"\x93NUMPY", b"text"])
def test_damaged_series_are_faults(tmp_path, content: bytes) -> None:
    folder = write_case(tmp_path, *report_case())
    (folder / "series.npz").write_bytes(content)
    with pytest.raises(ReportFault, match=r"series\.npz: expected"):
        read_results(folder)


def test_objects_in_the_series_are_refused(tmp_path) -> None:
    folder = write_case(tmp_path, *report_case())
    np.savez(folder / "series.npz", time_s=np.array([{"a": 1}], dtype=object))
    with pytest.raises(ReportFault, match="series"):
        read_results(folder)
    np.savez(folder / "series.npz", time_s=np.array(["a"]))
    with pytest.raises(ReportFault, match="found text or objects in time_s"):
        read_results(folder)


# --- words -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("found", "sentence"),
    [
        ((1.4823, 1.4411, 1.5312), "1.48 h (1.44 … 1.53, 95 %, profile likelihood)"),
        ((0.1, 0.0, 0.35), "≤ 0.350 h (best 0.100 h, 95 %, profile likelihood)"),
        ((9.0, 6.04, None), "≥ 6.04 h (best 9.00 h, 95 %, profile likelihood)"),
        ((9.0, 0.0, math.inf), "not identifiable (best 9.00 h, 95 %, profile likelihood)"),
        ((12.0, 7.0, 25.0), "12 h (7 … 25, 95 %, profile likelihood)"),
    ],
)
def test_time_constants_in_words(found: tuple, sentence: str) -> None:
    row = dict(zip(("value_h", "lower_h", "upper_h"), found, strict=True))
    fit = {"time_constants": {"thermal": {"level": 0.95, "method": "profile", **row}}, "converged": True}
    assert sentence in " ".join(page_text(fit_blocks(results(fit), {})).split())


def judged(fit: dict, about: str) -> tuple[str, str]:
    """The verdict on a subject, and all that is said of it."""
    one = next(one for one in judgements(results(fit)) if one.about == about)
    return one.verdict, " ".join((one.head, *(why.text for why in one.reasons)))


@pytest.mark.parametrize(
    ("validation_K", "kind"),
    [(0.5, "believe"), (1.5, "believe"), (2.9, "caution"), (3.1, "caution"), (9.9, "reject")],
)
def test_the_error_is_judged_against_identification_and_the_rule(validation_K: float, kind: str) -> None:
    fit, _ = report_case()
    fit["rmse"]["validation"]["temperature_K"].update(total=validation_K)
    verdict, said = judged(fit, "temperature_K")
    rule = fit["baselines"]["validation"]["no_dynamics"]["temperature_K"]["total"]
    assert verdict == kind
    assert f"{validation_K:.2f} K in validation" in said and ("new data" in said or f"{rule:.2f} K" in said)


def test_judgements_follow_the_numbers() -> None:
    fit, _ = report_case()
    verdict, said = judged(fit, "bands")
    assert verdict == "caution" and "87 to 93 %" in said and "1 h ahead absolute" in said
    for band in fit["bands"].values():
        band["absolute_humidity_g_m3"]["coverage"] = 0.95
    assert judged(fit, "bands")[0] == "believe"
    assert judged(fit, "innovations")[0] == "caution"
    fit["time_constants"]["thermal"].update({"lower_h": 0.5, "upper_h": 4.0})
    verdict, said = judged(fit, "thermal")
    assert verdict == "caution" and said.count("a factor of 2.8") == 2


def test_doubts_come_first_and_old_results_have_none(quick) -> None:
    fit, _ = report_case()
    old = fit_blocks(results(fit), {})
    assert "Doubt about the record" not in page_text(old) + page_html(old)
    doubts = DoubtCode.MANY_MISSING(signal="the wrong <column>", share=0.5), DoubtCode.NO_RATED_POWER()
    fit["doubts"] = plain(doubts)
    text, page = page_text(fit_blocks(results(fit), {})), page_html(fit_blocks(results(fit), {}))
    first, second = text.partition(f"{MARKS_KEY}\n")[2].splitlines()[:2]
    assert first.startswith("! ") and "the wrong <column>" in first
    assert second.startswith("! ") and "no rated power" in second
    first = page.partition('<ul class="judgements">')[2].partition("</li>")[0]
    assert first.startswith('<li class="caution">') and "the wrong &lt;column&gt;" in first


def test_a_free_run_that_fails_gets_no_good_mark() -> None:
    fit, _ = report_case()
    fit["readings_sd"] = {"validation": {"temperature_K": 4.0, "absolute_humidity_g_m3": 2.0}}
    assert judged(fit, "temperature_K")[0] == "believe"
    fit["readings_sd"]["validation"]["temperature_K"] = 0.1
    fit["bands"]["free_run"] = {"absolute_humidity_g_m3": {"coverage": 0.31, "n": 250}}
    for quantity, part, number in (
        ("temperature_K", "thermal", "(0.10 K)"),
        ("absolute_humidity_g_m3", "hygric", "31 % of the readings"),
    ):
        assert judged(fit, quantity)[0] == "reject" and judged(fit, part)[0] != "believe"
        assert number in judged(fit, quantity)[1] and number in judged(fit, part)[1]
    del fit["readings_sd"]
    assert judged(fit, "temperature_K")[0] == "believe"


@pytest.mark.parametrize(
    ("bounds", "verdict", "numbers"),
    [
        ((0.6, 1.7), "believe", ""),
        ((0.0, 7.0), "caution", "(1.00 h, without bounds)"),
        ((0.5, 1.6), "caution", "(1.00 h, 0.500 … 1.60 h)"),
        ((0.5, None), "caution", "(1.00 h, without bounds)"),
    ],
)
def test_the_criteria_agree_only_where_the_free_run_informs_something(bounds, verdict, numbers) -> None:
    fit, _ = report_case()
    row = {"value_h": 1.0, "lower_h": bounds[0], "upper_h": bounds[1]}
    fit["time_constants"]["thermal"]["simulation"] = row
    found, said = judged(fit, "thermal")
    assert found == verdict and numbers in said


def test_tests_that_fail_are_named_by_kind() -> None:
    fit, _ = report_case()
    for row in fit["innovations"]["tests"]:
        row["rejected"] = (row["output"], row["test"]) == ("temperature", "mean")
    verdict, said = judged(fit, "innovations")
    count = len(fit["innovations"]["tests"])
    assert verdict == "caution" and f"{count - 1} of {count} tests" in said and said.endswith(": mean")


def test_numbers_in_words() -> None:
    assert [plain_number(v) for v in (1.5, 0.0123456, -1234.5, 0.0, 4.3e-5, 2e-9, 1e9, math.nan)] == [
        "1.50", "0.0123", "−1234", "0", "0.0000430", "2.00e-09", "1.00e+09", "–",
    ]  # fmt: skip
    assert [decimals_for(v) for v in (0.05, 0.166, 0.0066, 3.0, 40.0, 0.0, math.nan)] == [2, 2, 3, 0, 0, 2, 2]
    assert percent(0.0123, 1) == "1.2 %"


# --- text --------------------------------------------------------------------------------------


def test_the_text_is_at_most_a_hundred_columns_wide_and_lines_up() -> None:
    fit, _ = report_case()
    fit["name"] = "東京のタービン " * 30
    fit["parameters"]["a_parameter_with_quite_a_long_name_that_nobody_would_choose_" * 3] = fit["parameters"][
        "hygric_k"
    ]
    text = page_text(fit_blocks(results(fit), {}))
    assert max(cells(line) for line in text.splitlines()) <= 100
    assert "SYNTHETIC" in text and "Root mean squared error, validation" in text
    rows = [
        line for line in text.splitlines() if line.startswith(("model, free run", "c = c_amb  ", "readings"))
    ]
    assert len({len(line) for line in rows}) == 1 and len(rows) == 6
    for row in fit["parameters"]:
        assert shortened(row, 30).rstrip("…") in text


def test_the_page_reads_what_the_results_hold(tmp_path) -> None:
    fit, series = report_case()
    folder = write_case(tmp_path, fit, series)
    again, arrays = read_results(folder)
    assert plain(again) == plain(with_verdicts(results(fit))) and set(arrays) == set(series)
