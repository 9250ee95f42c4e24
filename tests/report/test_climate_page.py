"""The page and the text of a climate: the answer first, verdicts, and what is escaped."""

from __future__ import annotations

from dataclasses import replace

import pytest
from builders.climate_case import LIMITS, known_fit, made_up_weather
from builders.climate_case import small_study as small
from builders.html_page import Page as Parsed

from hygrokf.climate.bounds import BoundedMean
from hygrokf.climate.climate_profile import climate_profile
from hygrokf.climate.region import Region
from hygrokf.climate.study import RegionClimate, Study
from hygrokf.data.record import Provenance
from hygrokf.report.blocks import Banner, Card, Cards, Details, Figure, Prose, Table
from hygrokf.report.climate_page import climate_blocks
from hygrokf.report.climate_tables import class_text, hours_text, limits_table, regions_table, span_text
from hygrokf.report.page import page_html
from hygrokf.report.terminal import page_text


def with_region(**changes: object) -> Study:
    """The small study with a changed region."""
    return replace(small(), regions=(replace(small().regions[0], **changes),))


def cards_of(study: Study) -> tuple[Card, ...]:
    return next(block for block in climate_blocks(study).lead if isinstance(block, Cards)).cards


def test_the_first_screen_is_the_answer_and_the_year() -> None:
    lead = climate_blocks(small()).lead
    assert [type(one) for one in lead] == [Cards, Figure] and lead[1].name == "r1-joint"
    limits, wet, condensation = cards_of(small())
    assert "40 days" in limits.label and limits.value == "1 undecided, 1 fail"
    assert wet.value == f"{hours_text(small().regions[0].year['wetness_h'].value)} h/a"
    assert wet.bounds.startswith("50 % of single years: ") and "40 days" in wet.lines[0]
    assert condensation.kind == ""


def test_a_made_up_climate_says_so() -> None:
    page = climate_blocks(with_region(provenance=Provenance.SYNTHETIC))
    (banner,) = (one for one in page.lead if isinstance(one, Banner))
    assert banner.word == "SYNTHETIC"


def test_a_climate_without_humidity_shows_its_temperature() -> None:
    year = {
        name: one for name, one in small().regions[0].year.items() if not name.startswith(("wet", "cond"))
    }
    dry = with_region(joint=None, test_profile=None, limits=(), scopes={"all": year})
    lead = climate_blocks(dry).lead
    assert [card.label for card in cards_of(dry)] == ["Mean temperature"] and lead[-1].name == "r1-duration"
    assert "no test profile" in Parsed(page_html(climate_blocks(dry))).text


def test_long_tables_are_folded() -> None:
    folded = [block for block in climate_blocks(small()).body if isinstance(block, Details)]
    tables = [inner.heading for block in folded for inner in block.blocks if isinstance(inner, Table)]
    assert tables == ["Excursions, rates of change and cycles", "What the test profile reproduces"]


def test_regions_stand_side_by_side() -> None:
    weather = made_up_weather(40)
    places = [Region(name, weather) for name in ("north", "<b>&")]
    study = climate_profile(known_fit(), places, members=3, limits=LIMITS)
    page = climate_blocks(study)
    assert [card.label for card in cards_of(study)] == ["north: time of wetness", "<b>&: time of wetness"]
    assert page.lead[-1].name == "regions"
    table = regions_table(study.regions)
    assert table.columns == ("", "unit", "north", "<b>&") and regions_table(study.regions[:1]) is None
    assert table.rows[-1] == ("limit: broken", "", "fail", "fail")
    many = replace(study, regions=study.regions * 3)
    assert not any(isinstance(block, Cards) for block in climate_blocks(many).lead)


def test_names_are_escaped_on_the_page() -> None:
    page = page_html(climate_blocks(with_region(name="<b>&", files=("<i>.csv",))))
    Parsed(page)
    assert "<b>&" not in page and "<i>.csv" not in page


def test_a_part_of_a_year_is_told() -> None:
    assert "1 year" not in Parsed(page_html(climate_blocks(small()))).text
    assert "undecided (of 40 days" in page_text(climate_blocks(small()))
    assert limits_table(small().regions[0]).marked == (1,)


@pytest.mark.parametrize(
    ("bounds", "shown"),
    [(("τ1", "τ2"), "τ1 (bounds τ1 … τ2)"), (("τ1", "τ1"), "τ1"), (None, "τ1")],
)
def test_the_class_of_wetness_has_those_of_its_bounds(bounds: tuple[str, str] | None, shown: str) -> None:
    region: RegionClimate = replace(small().regions[0], wetness_class="τ1", wetness_class_bounds=bounds)
    assert class_text(region) == shown


def test_less_than_an_hour_has_no_digits() -> None:
    one = BoundedMean(0.114, 0.0, 2.5, 0.0, 2.5, 0.0)
    assert span_text(one, hours_text) == "< 1 (0 … 2.50)" and span_text(one) == "0.114 (0 … 2.50)"
    assert span_text(BoundedMean(*[0.0] * 6), hours_text) == "0" and span_text(None) == "–"


@pytest.mark.parametrize(("share", "advice"), [(0.5, "a hotter chamber"), (2.0, "a colder chamber")])
def test_years_out_of_reach_are_told_with_a_remedy(share: float, advice: str) -> None:
    profile = small().regions[0].test_profile
    ageing = replace(profile.closeness.ageing, test_h=share * profile.closeness.ageing.service_h)
    close = replace(profile.closeness, ageing=ageing)
    changed = with_region(test_profile=replace(profile, reached=False, closeness=close))

    def said(study: Study) -> str:
        return " ".join(one.text for one in climate_blocks(study).body if isinstance(one, Prose))

    assert advice in said(changed) and advice not in said(small())


def test_a_climate_states_one_share_for_its_bounds() -> None:
    assert small().regions[0].bounds_hold == pytest.approx(2 / 4)
    for words in (Parsed(page_html(climate_blocks(small()))).text, page_text(climate_blocks(small()))):
        assert "50 % of single years" in words and "95 % of single years" not in words
        assert "95 % bounds" not in words and "in 50 % of cases" in " ".join(words.split())
