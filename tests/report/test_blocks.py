"""Blocks drawn as a page and as text: every kind is there, escaped, folded or struck as it should be."""

from __future__ import annotations

import re

import pytest
from builders.html_page import Page as Parsed

from hygrokf.data.record import Provenance, least_measured
from hygrokf.report.blocks import (
    OF_RECORD,
    OF_RECORDS,
    Banner,
    Block,
    Card,
    Cards,
    Details,
    Figure,
    Heading,
    Items,
    Line,
    Link,
    Page,
    Prose,
    Table,
    Verdicts,
    section,
    unmeasured,
)
from hygrokf.report.climate_page import OF_CLIMATE
from hygrokf.report.figures.drawing import NothingToShow
from hygrokf.report.figures.panels import Curve, Panel, Picture
from hygrokf.report.fleet_page import OF_FLEET
from hygrokf.report.page import page_html
from hygrokf.report.terminal import block_text, cells, page_text, table_text

EVIL = "<img src=x onerror=alert(1)>\"'&amp;\x00\u202e"
BELIEVED = Card("thermal", "1.46 h", "believe", "1.37 … 1.55", symbol="R_AT·C")
REJECTED = Card("hygric", "0.3 h", "reject", "0.2 … 0.4", "It drifts.")


def drawing() -> Picture:
    return Picture((Panel((Curve((0.0, 1.0), (1.0, 2.0), "black"),)),), 1.0)


def nothing():
    raise NothingToShow("There are no readings.")


def page(*blocks: Block, lead: tuple[Block, ...] = ()) -> str:
    return page_html(Page("Report", "T07", ("about it",), lead, blocks))


EVERY = (
    Heading("Section"), Prose("Text with 3 K in it.", "note"), Link("The other page:", "fit_report.html"),
    Items(("one", "two")), Banner("SYNTHETIC", "Made by a computer."),
    Verdicts((Line("believe", "It holds.", head=True), Line("reject", "number", struck="3.0 h"))),
    Cards((BELIEVED, REJECTED)),
    Table("Errors", ("", "a", "b"), (("model", "1", "2"),), marked=(0,), groups=(("", 1), ("both", 2))),
    Figure("one", "A picture", "Look at the line.", drawing),
    Details("All of it", (Prose("inside"),), printed=True), Details("More", (Prose("folded"),)),
)  # fmt: skip


def test_every_kind_of_block_is_drawn_and_printed() -> None:
    text = page(*EVERY)
    parsed = Parsed(text)
    tags = {tag for tag, _ in parsed.tags}
    assert {"h1", "h2", "p", "a", "ul", "table", "figure", "svg", "details", "summary", "s"} <= tags
    for words in ("Section", "Look at the line.", "SYNTHETIC", "All of it", "inside", "It holds."):
        assert words in parsed.text, words
    assert "3\xa0K" in text and "R<sub>AT</sub>·C" in text and 'href="fit_report.html"' in text
    printed = [block_text(block) for block in EVERY]
    assert [bool(one) for one in printed] == [not isinstance(block, Figure) for block in EVERY]
    assert "- one\n- two" in printed[3] and printed[-2:] == ["All of it\n\ninside", "More: on the page."]


def test_a_rejected_number_is_struck_through_and_is_no_headline() -> None:
    believed, rejected = re.findall(
        r'<div class="card (\w+)">(.*?)</div>', page(Cards((BELIEVED, REJECTED))), re.S
    )
    assert believed[0] == "believe" and '<p class="value">1.46\xa0h</p>' in believed[1]
    assert rejected[0] == "reject" and "<s>0.3\xa0h (0.2 … 0.4)</s>" in rejected[1]
    assert "not reliable" in re.findall(r'<p class="value words">(.*?)</p>', rejected[1], re.S)[0]
    assert "It drifts." in rejected[1]


def test_every_text_is_escaped() -> None:
    blocks = (
        Heading(EVIL), Prose(EVIL), Link(EVIL, EVIL), Items((EVIL,)),
        Banner(EVIL, EVIL), Verdicts((Line("caution", EVIL, struck=EVIL),), EVIL),
        Cards((Card(EVIL, EVIL, "", EVIL, EVIL, EVIL),)),
        Table(EVIL, (EVIL,), ((EVIL,),), groups=((EVIL, 1),), note=EVIL), Figure("x", EVIL, EVIL, drawing),
        Figure("y", EVIL, EVIL, nothing), Details(EVIL, (Prose(EVIL),)),
    )  # fmt: skip
    parsed = Parsed(page_html(Page(EVIL, EVIL, (EVIL,), blocks, blocks, blocks)))
    assert "img" not in {tag for tag, _ in parsed.tags}
    assert all(not name.startswith("on") for _, attributes in parsed.tags for name in attributes)
    assert max(cells(line) for block in blocks for line in block_text(block).splitlines()) <= 100


def test_a_figure_without_data_says_why() -> None:
    parsed = Parsed(page(Figure("one", "The picture", "", nothing)))
    assert "The picture is left out. There are no readings." in " ".join(parsed.text.split())


def test_the_page_needs_nothing_from_elsewhere_and_folds_its_details() -> None:
    text = page(*EVERY)
    assert "http" not in text and "<script" not in text and "@import" not in text
    assert text.count("<details>") == 2 and "details::details-content" in text
    assert text.count("<!DOCTYPE html>") == 1 and text.endswith("</html>\n")


def test_the_terminal_prints_the_name_the_warnings_and_the_sections_that_hold_text() -> None:
    warnings = (Banner("SYNTHETIC", "x"), Banner("NOT CONVERGED", "stopped."))
    lead = (*warnings, Cards((BELIEVED, REJECTED)), Figure("one", "A picture", "", drawing))
    body = (
        *section("Pictures", Figure("two", "A picture", "", drawing)),
        *section("Numbers", Table("T", ("a", "b", "c"), (("1", "2", "3"),), brief=(0, 2))),
    )
    made = Page("Report", "T07", (), lead, body, (Prose("how it was computed"),))
    assert page_text(made) == (
        "T07 (SYNTHETIC: nothing measured)\n\nNOT CONVERGED: stopped.\n\n"
        "thermal: 1.46 h (1.37 … 1.55), reliable.\nhygric, not reliable: 0.3 h (0.2 … 0.4). It drifts.\n\n"
        "Numbers\n\nT\na  c\n1  3"
    )


def test_a_table_with_a_cell_too_many_is_refused() -> None:
    with pytest.raises(ValueError, match="Parameters: expected a cell for each of 2 columns, found"):
        Table("Parameters", ("name", "value"), (("a", "1"), ("b", "group", "2")))


def test_the_name_of_a_row_is_wrapped_and_never_cut() -> None:
    table = Table("", ("", "value"), (("  a name that needs more than its room", "1.234567890123"),))
    rows = table_text(table, 34).splitlines()[1:]
    assert " ".join(row[:18].strip() for row in rows) == "a name that needs more than its room"
    assert all(row.startswith("  ") for row in rows) and rows[0].endswith(" 1.234567890123")


@pytest.mark.parametrize("width", [100, 60, 40])
def test_no_name_and_no_number_of_a_table_is_cut_at_any_width(width: int) -> None:
    """A narrow terminal gets a paragraph for each row; names stand in one piece, to be copied."""
    names = ("absolute_humidity_measurement_noise", "thermal_time_constant")
    columns = ("parameter", "value", "standard error", "lower bound", "upper bound", "unit")
    rows = tuple((name, "0.1234", "0.0123", "0.1001", "0.1467", "g/m³") for name in names)
    text = table_text(Table("Parameters", columns, rows, left=(0,)), width)
    assert all(cells(line) <= width for line in text.splitlines())
    assert "…" not in text
    for part in (*names, "0.1234", "0.1467"):
        assert any(part in line for line in text.splitlines())
    assert ("value: 0.1234" in text) == (width < 100)


def test_a_group_of_columns_is_named_in_a_narrow_table() -> None:
    rows = (("model_of_the_cabinet_air", "1" * 20, "2"),)
    table = Table("", ("", "a", "b"), rows, groups=(("", 1), ("both", 2)))
    assert table_text(table, 40).splitlines() == [
        "model_of_the_cabinet_air", f"  both, a: {'1' * 20}", "  both, b: 2",
    ]  # fmt: skip


@pytest.mark.parametrize("texts", [OF_RECORD, OF_RECORDS, OF_CLIMATE, OF_FLEET])
def test_everything_that_was_not_measured_has_its_warning(texts) -> None:
    said = {kind: [one.word for one in unmeasured(kind, texts)] for kind in Provenance}
    assert said == {
        Provenance.MEASURED: [], Provenance.SIMULATED: ["SIMULATED"], Provenance.SYNTHETIC: ["SYNTHETIC"],
    }  # fmt: skip


def test_a_result_is_as_measured_as_the_least_measured_of_its_records() -> None:
    measured, simulated, synthetic = Provenance
    assert least_measured(()) is measured
    assert least_measured((simulated, measured)) is simulated
    assert least_measured((measured, synthetic, simulated)) is synthetic
