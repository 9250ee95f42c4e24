"""Every page in a browser: the answer and its picture come first, nothing is too wide, print is whole."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from builders.browser import needs_chromium
from builders.climate_case import study_of
from builders.comparison_case import made_column
from builders.discovery_case import discovery_case, residuals_case
from builders.discovery_case import typed as discovered
from builders.fit_case import typed
from builders.report_case import report_case
from golden.difference import read
from playwright.sync_api import Browser, Page

from hygrokf.climate.limits import ClimateLimit
from hygrokf.data.record import Provenance
from hygrokf.data.structured import structured
from hygrokf.fleet.fleet_results import FleetResults
from hygrokf.report.climate_page import climate_blocks
from hygrokf.report.comparison_page import comparison_blocks
from hygrokf.report.discovery_page import discovery_blocks
from hygrokf.report.fit_page import fit_blocks
from hygrokf.report.fleet_page import fleet_blocks
from hygrokf.report.page import page_html
from hygrokf.report.transfer_page import transfer_blocks
from hygrokf.transfer.comparison import compare
from hygrokf.transfer.transfer_results import TransferResults

pytestmark = needs_chromium
WIDE, NARROW = {"width": 1280, "height": 800}, {"width": 390, "height": 844}


def fit() -> str:
    results, series = report_case()
    return page_html(fit_blocks(typed(results), series))


def comparison() -> str:
    columns = [made_column("first", 1), made_column("second", 2, scale=1.4)]
    return page_html(comparison_blocks(compare(columns), [one.course for one in columns]))


def transfer() -> str:
    found = structured(TransferResults, read("demo")["json"]["transferred/transfer.json"])
    course = made_column("any", 1).course
    simulated = dict.fromkeys(("as_is", "own_loggers"), course.simulated["simulated"])
    return page_html(transfer_blocks(found, [replace(course, simulated=simulated)]))


def climate() -> str:
    study = study_of(limits=[ClimateLimit("temperature_degC", above=10.0, name="hot")])
    return page_html(climate_blocks(replace(study, provenance=Provenance.SYNTHETIC)))


def discovery() -> str:
    return page_html(discovery_blocks(discovered(discovery_case()), residuals_case(), residuals_case(0.2)))


def fleet() -> str:
    rows = tuple(
        {
            "turbine": f"W{place}", "status": "done", "provenance": "synthetic", "thermal_verdict": "caution",
            "thermal_value_h": 1.5 + 0.1 * place, "thermal_lower_h": 1.3, "thermal_upper_h": 3.0,
            "temperature_rmse_K": 1.0 + 0.1 * place,
        }
        for place in range(8)
    )  # fmt: skip
    failed = {"turbine": "W9", "status": "failed", "reason": "cabinet.csv: no such file " * 5}
    return page_html(fleet_blocks(FleetResults("fit", (*rows, failed), "Park")))


MADE: dict[Callable[[], str], int] = {
    fit: 1_200_000, comparison: 400_000, transfer: 400_000, climate: 600_000,
    discovery: 900_000, fleet: 300_000,
}  # fmt: skip
"""How each page is made, and the most bytes that it may have."""


UNFOLD = "document.querySelectorAll('details').forEach((d) => { d.open = true; })"
WIDTH = "document.documentElement.scrollWidth"
SHOWN = "(all) => all.map((e) => [...e.children].slice(1).some((c) => c.checkVisibility()))"
NAMED = "(all) => all.map((e) => [e.tabIndex, e.getAttribute('aria-label')])"
TOO_WIDE = """(all) => all.filter((e) => e.scrollWidth > e.clientWidth + 1)
    .map((e) => e.getAttribute('aria-label'))"""
OUTSIDE = """(all) => all.filter((e) => e.getBoundingClientRect().right > 391
    && !e.closest('.scroll, .drawing')).map((e) => e.tagName + ' ' + e.className)"""
CUE = "(all) => all.every((e) => getComputedStyle(e).backgroundImage.includes('radial-gradient'))"


def expect_answer_first(page: Page) -> None:
    """The first screen is the answer and its picture; tables come after."""
    card, figure = page.locator(".card").first.bounding_box(), page.locator("figure svg").first.bounding_box()
    assert card and card["y"] + card["height"] < 450
    assert figure and card["y"] < figure["y"] and figure["y"] + figure["height"] <= 800
    assert page.locator("table").first.bounding_box()["y"] > 800


def expect_fold(page: Page) -> None:
    """Long sections are folded on the screen and open in print."""
    folded = page.eval_on_selector_all("details", SHOWN)
    assert folded and not any(folded)
    page.emulate_media(media="print")
    assert all(page.eval_on_selector_all("details", SHOWN))
    page.emulate_media(media="screen")


@pytest.mark.parametrize("make", MADE, ids=lambda make: make.__name__)
def test_a_page_on_a_screen_on_paper_and_on_a_telephone(make, browser: Browser, tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    file.write_text(make(), encoding="utf-8")
    assert file.stat().st_size <= MADE[make]
    page = browser.new_page(viewport=WIDE)
    page.goto(file.as_uri())
    expect_answer_first(page)
    expect_fold(page)
    # parts that scroll are reached by the keyboard and named
    scrolling = page.eval_on_selector_all(".scroll, .drawing", NAMED)
    assert scrolling and all(place == 0 and name for place, name in scrolling)
    page.evaluate(UNFOLD)
    assert page.evaluate(WIDTH) <= 1280
    assert page.eval_on_selector_all(".scroll, .drawing", TOO_WIDE) == []
    # on a telephone only tables and drawings scroll
    page.set_viewport_size(NARROW)
    assert page.evaluate(WIDTH) <= 390
    assert page.eval_on_selector_all("body *", OUTSIDE) == []
    assert page.eval_on_selector_all(".scroll", CUE)
    page.close()
