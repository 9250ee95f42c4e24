"""A result on one page: what stands on it, that it fits, and how it is written."""

from __future__ import annotations

import re
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from builders.climate_case import small_study as study
from builders.discovery_case import (
    ambiguous_case,
    discovery_case,
    empty_case,
    long_class_case,
    residuals_case,
    two_causes_case,
    typed,
    unexplained_case,
    unfinished_case,
)
from builders.documents import document
from builders.report_case import report_case, results, write_case

from hygrokf.climate.limits import Exceedance
from hygrokf.climate.study import RegionClimate, Study, write_climate
from hygrokf.data.files import SUMMARIES
from hygrokf.data.structured import plain
from hygrokf.report.page import page_html
from hygrokf.report.summary.contents import (
    MOST_ACTIONS,
    MOST_ROWS,
    REASON_REMEDIES,
    Summary,
    summary_blocks,
    summary_of_climate,
    summary_of_discovery,
    summary_of_fit,
)
from hygrokf.report.summary.writing import SummaryFault, plan_summaries, write_pdf, write_summary
from hygrokf.texts.fit_codes import FitCode
from hygrokf.texts.reasons import ReasonCode

LONG = "Windpark Nordfriesland Süd – Umrichterschrank WEA-17/B (Nachrüstung, Prüfstand) " + "x" * 90


def fitted(**changes: object) -> Summary:
    data, series = report_case()
    return summary_of_fit(results(data | changes), series)


@cache
def rejected() -> Summary:
    """An estimation that did not converge, of a record with a long name."""
    return fitted(converged=False, messages=plain((FitCode.PASSES_SPENT(passes=200),)), name=LONG)


@cache
def temperature_only() -> Summary:
    data, series = report_case()
    del data["time_constants"]["hygric"]
    for quantities in (*data["rmse"].values(), *data["sensor_share"].values()):
        del quantities["absolute_humidity_g_m3"]
    dry = {n: np.full_like(v, np.nan) if "humidity" in n else v for n, v in series.items()}
    return summary_of_fit(results(data | {"provenance": "measured"}), dry)


@cache
def caused() -> Summary:
    return summary_of_discovery(typed(discovery_case()), residuals_case(), residuals_case(0.2))


@cache
def unexplained() -> Summary:
    return summary_of_discovery(typed(unexplained_case()), residuals_case(), None)


@cache
def nothing_found() -> Summary:
    return summary_of_discovery(typed(empty_case()), residuals_case(0.0), None)


def with_region(**changes: object) -> Study:
    return replace(study(), regions=(replace(study().regions[0], **changes),))


@cache
def limited() -> Summary:
    return summary_of_climate(study())


@cache
def unlimited() -> Summary:
    return summary_of_climate(with_region(limits=(), joint=None, test_profile=None))


def of_regions(count: int = 9) -> Summary:
    (region,) = study().regions
    regions = tuple(replace(region, name=f"{place} {LONG[:20]}", limits=()) for place in range(count))
    return summary_of_climate(replace(study(), regions=regions))


MADE: tuple[Callable[[], Summary], ...] = (
    fitted, rejected, temperature_only, caused, unexplained, nothing_found, limited, unlimited, of_regions,
)  # fmt: skip
every = pytest.mark.parametrize("make", MADE, ids=lambda make: make.__name__)


# --- what stands on it -----------------------------------------------------------------------


@every
def test_a_summary_asks_answers_and_says_what_to_do(make) -> None:
    made = make()
    assert made.question.endswith("?") and made.answer.endswith(".") and made.picture is not None
    assert made.actions and all(text.endswith(".") for text in (*made.actions, *made.reasons))
    assert made.bounds and {term for term, _ in made.foot} >= {"Made by"}
    assert bool(made.banners) == (make not in (temperature_only, limited, unlimited, of_regions))


def test_the_verdict_of_a_fit_is_its_worst_one() -> None:
    assert (fitted().verdict, rejected().verdict) == ("caution", "reject")
    assert [row[0] for row in fitted().bounds.rows[:2]] == ["thermal time constant", "hygric time constant"]
    assert fitted().reasons[0].startswith("Hygric") and len(rejected().reasons) == 2
    assert "must not be used" in rejected().actions[0]
    assert [row[0] for row in temperature_only().bounds.rows] == [
        "thermal time constant", "error of the simulated temperature, on new data",
    ]  # fmt: skip


def test_a_named_cause_stands_with_its_confidence_errors_and_check() -> None:
    made = caused()
    assert made.answer == "Solar gain (on the roof), confidence 87 %." and made.verdict == ""
    assert made.tone == "plain" and made.bounds.columns[0].endswith("after selection")
    assert made.bounds.rows[0][:5] == ("temperature", "1.85 K", "1.57 K", "−15 %", "0.13 … 0.31 K")
    assert [action.partition(": ")[2] for action in made.actions] == [
        "shade or paint the wall; check the ventilation of the tower base."
    ]
    assert unexplained().tone == "open" and len(nothing_found().bounds.rows) == 3
    assert "12.4 h" in unexplained().reasons[0]


@pytest.mark.parametrize(
    ("case", "answer", "reasons", "actions"),
    [
        (two_causes_case, ["Solar gain (on the roof) + exchange step"], ["87 %", "61 %"],
            ["shade or paint", "ask what was done"]),
        (ambiguous_case, ["moisture sorption, confidence 48 %"], ["condensation"],
            ["compare the humidity sensor"]),
        (long_class_case, ["solar gain, cooling"], [], []),
        (unfinished_case, ["3,000 simulations"], [], ["--budget"]),
    ],
)  # fmt: skip
def test_other_verdicts_of_a_discovery_are_told_to_a_manager_too(case, answer, reasons, actions) -> None:
    made = summary_of_discovery(typed(case()), residuals_case(), None)
    for said, words in ((made.answer, answer), (made.reasons, reasons), (made.actions, actions)):
        assert all(one in " ".join([said] if isinstance(said, str) else said) for one in words), said
    assert (made.tone == "open") == (case is unfinished_case)
    assert ("confidence" in made.answer) == (case is ambiguous_case)


def test_a_wrong_model_without_a_cause_has_something_to_do_too() -> None:
    data = empty_case()
    text = "not even its order of magnitude is known"
    data["baseline"]["time_constants"]["thermal"] |= {
        "verdict": "reject", "reasons": [plain(ReasonCode.UNDETERMINED(spread="a factor of 9"))],
    }  # fmt: skip
    made = summary_of_discovery(typed(data), residuals_case(0.0), None)
    assert made.tone == "open" and "not right" in made.answer and text in " ".join(made.reasons)
    (longer,) = (action for action, codes in REASON_REMEDIES.items() if ReasonCode.RECORD_SHORT in codes)
    assert longer in made.actions
    data = discovery_case()
    data["causes"][0] |= {"remedy": "", "separate_by": ""}
    assert len(summary_of_discovery(typed(data), residuals_case(), None).actions) == 1


def test_limits_are_kept_exceeded_or_undecided() -> None:
    (region,) = study().regions

    def answer(*verdicts: str) -> tuple[str, str]:
        limits = tuple(
            replace(region.limits[0], name=f"{place}", verdict=one) for place, one in enumerate(verdicts)
        )
        made = summary_of_climate(with_region(limits=limits))
        return made.answer, made.tone

    assert answer("pass", "pass") == ("Limits: 2 kept.", "plain")
    assert answer("pass", "fail", "fail") == ("Limits: 1 kept and 2 exceeded.", "reject")
    assert answer("undecided", "pass") == ("Limits: 1 kept and 1 undecided.", "open")


def test_the_worst_limits_come_first_and_the_rest_is_counted() -> None:
    kept, broken = study().regions[0].limits
    limits: tuple[Exceedance, ...] = (replace(kept, verdict="pass"),) * MOST_ROWS + (broken,) * MOST_ROWS
    made = summary_of_climate(with_region(limits=limits))
    assert {row[0] for row in made.bounds.rows} == {"broken"} and len(made.bounds.rows) == MOST_ROWS
    assert f"{MOST_ROWS} more rows" in made.bounds.note and len(made.actions) == MOST_ACTIONS + 1


def test_regions_are_ranked_or_told_by_their_limits() -> None:
    (here,) = study().regions
    wet = here.year["wetness_h"]
    there: RegionClimate = replace(
        here, name="there", scopes={"all": {**here.year, "wetness_h": replace(wet, value=9.0 * wet.value)}}
    )
    dry = [replace(one, limits=()) for one in (there, here)]
    made = summary_of_climate(replace(study(), regions=tuple(dry)))
    assert re.fullmatch(r"Wet for \S+ h a year \(here\) to \S+ h a year \(there\)\.", made.answer)
    kept = replace(there, limits=tuple(replace(one, verdict="pass") for one in there.limits))
    assert summary_of_climate(replace(study(), regions=(here, kept))).answer == (
        "The limits are kept in there and exceeded in here."
    )


def test_every_reason_against_a_time_constant_has_a_remedy() -> None:
    codes = re.findall(r"^\| `(\w+)` \| (?:caution|reject)", document("verdict.md").read_text(), re.M)
    assert sorted(code.key for asking in REASON_REMEDIES.values() for code in asking) == sorted(codes)


# --- on paper --------------------------------------------------------------------------------


def crowded() -> Summary:
    """As many limits as the page lists, each with a long sentence, and more that it counts."""
    kept, broken = study().regions[0].limits
    named = replace(broken, name=LONG[:70])
    return summary_of_climate(with_region(limits=(kept,) * MOST_ROWS + (named,) * MOST_ROWS))


def bare() -> Summary:
    return replace(caused(), bounds=replace(caused().bounds, rows=()), picture=None, reasons=())


PRINTED = (fitted, rejected, unexplained, of_regions, crowded, bare)
on_paper = pytest.mark.parametrize("make", PRINTED, ids=lambda make: make.__name__)


def write_page(folder: Path, directory: Path | None = None) -> Path:
    ((make, place, stem),) = plan_summaries([folder], directory)
    return write_summary(make(), place, stem)


@pytest.fixture
def printed(tmp_path) -> Callable[[Summary], tuple[Path, str]]:
    """Writes a summary as PDF; returns its path and the text on it."""

    def made(summary: Summary) -> tuple[Path, str]:
        file = write_pdf(write_summary(summary, tmp_path, "summary"))
        return file, _said("pdftotext", "-layout", file, "-")

    return made


def _said(*command: str | Path) -> str:
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout


class _Texts(HTMLParser):
    """Collects the letters of a page's body."""

    def __init__(self) -> None:
        super().__init__()
        self.letters: Counter[str] = Counter()
        self.inside = False

    def handle_starttag(self, tag: str, attrs: object) -> None:
        self.inside |= tag == "body"

    def handle_data(self, data: str) -> None:
        if self.inside:
            self.letters.update("".join(data.split()))


@on_paper
def test_the_pdf_is_one_page_with_every_letter_of_the_html(make, printed) -> None:
    file, text = printed(make())
    about = _said("pdfinfo", file)
    assert re.search(r"Pages: +1\n", about) and re.search(r"Page size: +59\d.* x 84\d.* \(A4\)", about)
    page = _Texts()
    page.feed(file.with_suffix(".html").read_text(encoding="utf-8"))
    shown = Counter("".join(text.replace("•", "").split()))
    assert shown == page.letters


def test_the_same_result_gives_the_same_bytes(tmp_path) -> None:
    folder = write_case(tmp_path / "made", *report_case())
    pages = [write_page(folder), write_page(folder, tmp_path / "again")]
    file, again = map(write_pdf, pages)
    assert (pages[0], file) == (folder / "summary.html", folder / "summary.pdf")
    assert pages[0].read_bytes() == pages[1].read_bytes() and file.read_bytes() == again.read_bytes()
    assert "Date" not in _said("pdfinfo", file)
    fonts = _said("pdffonts", file).splitlines()[2:]
    assert fonts and all(font.split()[-5:-2] == ["yes", "yes", "yes"] for font in fonts)  # embedded


def test_a_name_in_signs_of_markup_is_printed_as_it_is(printed) -> None:
    assert "<b> $x_1$ {0} \\alpha" in printed(replace(caused(), name="<b> $x_1$ {0} \\alpha"))[1]


@pytest.mark.parametrize(
    "module",
    ["raise ImportError(\"No module named 'weasyprint'\")",
     "print('advice')\nraise OSError(\"cannot load library 'libpango-1.0-0': no such file\")"],
)  # fmt: skip
def test_without_the_extra_or_its_library_only_the_page_is_written(
    module, tmp_path, monkeypatch, capsys
) -> None:
    for name in [one for one in sys.modules if one.partition(".")[0] == "weasyprint"]:
        monkeypatch.delitem(sys.modules, name)
    (tmp_path / "weasyprint.py").write_text(module)
    monkeypatch.syspath_prepend(tmp_path)
    folder = write_case(tmp_path / "made", *report_case())
    (folder / "summary.pdf").write_bytes(b"of another result")
    before = {*folder.iterdir()} - {folder / "summary.pdf"}
    with pytest.raises(SummaryFault, match=r"hygrokf\[pdf\].*libpango-1\.0-0 libpangoft2") as told:
        write_pdf(write_page(folder))
    assert module.rpartition('("')[2].split(":")[0].rstrip('")') in str(told.value)
    assert {*folder.iterdir()} == before | {folder / "summary.html"} and capsys.readouterr().out == ""


# --- the page --------------------------------------------------------------------------------


@on_paper
def test_the_page_prints_on_one_sheet_and_fits_a_telephone(make, browser, tmp_path) -> None:
    file = tmp_path / "summary.html"
    file.write_text(page_html(summary_blocks(make())), encoding="utf-8")
    page = browser.new_page(viewport={"width": 390, "height": 844})
    page.goto(file.as_uri())
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    assert len(re.findall(rb"/Type /Page\b", page.pdf(prefer_css_page_size=True))) == 1
    page.close()


# --- on disk ---------------------------------------------------------------------------------


def test_the_kind_is_told_from_the_file_and_each_result_has_its_place(tmp_path) -> None:
    made = {"one": ["fit.json"], "two": ["fit.json", "discovery.json"], "three": ["climate.json"]}
    for place, names in made.items():
        (tmp_path / place).mkdir()
        for name in names:
            (tmp_path / place / name).touch()
    one, two, three = (tmp_path / place for place in ("one", "two", "three"))

    def places(*results: Path, out: Path | None = None) -> list[tuple[Path, str]]:
        return [(folder, stem) for _, folder, stem in plan_summaries(results, out)]

    assert places(one / "fit.json", two, three) == [(one, "summary"), (two, "summary"), (three, "summary")]
    assert places(two / "fit.json") == [(two, "fit_summary")]
    assert places(one, out=tmp_path / "out") == [(tmp_path / "out", "summary")]
    assert places(one, three, out=tmp_path / "out") == [
        (tmp_path / "out" / place, "summary") for place in ("one", "three")
    ]
    with pytest.raises(SummaryFault, match="found one twice"):
        plan_summaries([one, one / "fit.json"], tmp_path / "out")


def test_nothing_is_written_where_a_drawing_fails(tmp_path, monkeypatch) -> None:
    folder = write_case(tmp_path / "made", *report_case())
    before = sorted(folder.iterdir())

    def failing(_: Summary) -> str:
        raise MemoryError

    monkeypatch.setattr("hygrokf.report.summary.writing.summary_blocks", failing)
    ((make, place, stem),) = plan_summaries([folder], None)
    with pytest.raises(MemoryError):
        write_summary(make(), place, stem)
    assert sorted(folder.iterdir()) == before


def test_results_of_other_kinds_are_refused_together(tmp_path) -> None:
    (tmp_path / "compare.json").write_text("{}")
    with pytest.raises(SummaryFault) as told:
        plan_summaries([tmp_path, tmp_path / "absent"], None)
    first, second = str(told.value).splitlines()
    assert "compare.json" in first and "no such file" in second


def test_new_results_remove_the_summary_of_the_old_ones(tmp_path) -> None:
    for name in SUMMARIES:
        (tmp_path / name).write_text("old")
    write_climate(study(), tmp_path)
    assert not any((tmp_path / name).exists() for name in SUMMARIES)
