"""Envelopes keep every extreme, calendars are round, SVG is well formed and stands alone."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hygrokf.report.figures.drawing import (
    INK,
    band,
    calendar_ticks,
    envelope,
    inline_svg,
    new_figure,
    png,
    stretches,
    styled,
    svg,
)
from hygrokf.report.figures.panels import Panel, Picture, point, rows


@settings(max_examples=60)
@given(
    st.integers(1, 4000),
    st.integers(2, 200),
    st.integers(0, 2**31),
)
def test_an_envelope_keeps_the_extremes_of_every_stretch(n: int, bins: int, seed: int) -> None:
    random = np.random.default_rng(seed)
    time = np.cumsum(random.uniform(1.0, 3.0, n))
    value = np.where(random.random(n) < 0.2, np.nan, random.standard_cauchy(n))
    span = (float(time[0]), float(time[-1]) + 1.0)
    x, y = envelope(time, value, span, bins)
    there = np.isfinite(value)
    assert len(x) == len(y) <= 4 * bins + 2 * there.sum() * (there.sum() <= 2 * bins)
    assert np.all(np.diff(x) >= 0)
    if not there.any():
        assert len(x) == 0
        return
    assert np.nanmin(y) == value[there].min() and np.nanmax(y) == value[there].max()
    # extremes stay within one bin of where they were
    width = (span[1] - span[0]) / bins
    place = x[np.nanargmax(y)]
    assert np.min(np.abs(time[there][value[there] == np.nanmax(y)] - place)) <= width


def test_a_short_line_is_drawn_as_it_is_and_breaks_at_gaps() -> None:
    time = np.array([0.0, 10.0, 20.0, 30.0, 300.0, 310.0])
    x, y = envelope(time, np.arange(6.0), (0.0, 310.0))
    assert np.isnan(y[4]) and 30.0 < x[4] < 300.0
    np.testing.assert_array_equal(y[[0, 1, 2, 3, 5, 6]], np.arange(6.0))


def test_a_gap_of_a_long_line_still_shows() -> None:
    time = np.concatenate([np.arange(50_000.0), np.arange(70_000.0, 120_000.0)])
    x, y = envelope(time, np.sin(time), (0.0, 120_000.0), 200)
    broken = x[np.isnan(y)]
    assert len(broken) == 1 and 50_000 < broken[0] < 70_000


@pytest.mark.parametrize("n", [50, 5000])
def test_a_thinned_band_holds_the_whole_band(n: int) -> None:
    random = np.random.default_rng(1)
    time = np.arange(float(n))
    middle = np.cumsum(random.standard_normal(n))
    low, high = middle - 1.0, middle + 2.0
    x, below, above = band(time, low, high, (0.0, float(n)), 100)
    assert below.min() == low.min() and above.max() == high.max()
    assert len(x) <= 100 and np.all(below < above)
    assert band(time, np.full(n, np.nan), high, (0.0, float(n)))[0].size == 0


def test_stretches_of_a_flag() -> None:
    time = np.arange(10.0)
    flag = np.array([1, 1, 0, 0, 1, 0, 1, 1, 0, 0])
    assert stretches(time, flag) == [(0.0, 1.0), (4.0, 4.0), (6.0, 7.0)]
    assert stretches(time, flag, shortest_gap=2.5) == [(0.0, 1.0), (4.0, 7.0)]
    assert stretches(time, np.zeros(10)) == []


@settings(max_examples=150)
@given(st.floats(0.0, 4.0e9), st.floats(60.0, 9.0e8), st.integers(3, 14))
def test_calendar_ticks_are_round_and_inside(low: float, length: float, ticks: int) -> None:
    high = low + length
    at, words = calendar_ticks(low, high, ticks)
    assert 1 <= len(at) == len(words) <= ticks
    assert np.all(at >= np.floor(low)) and np.all(at <= np.ceil(high)) and np.all(np.diff(at) > 0)
    moments = [datetime.fromtimestamp(float(v), UTC) for v in at]
    assert all(m.second == 0 for m in moments)
    assert words[0].endswith("UTC")
    for moment, word in zip(moments, words, strict=True):
        said = word.split("\n")[0]
        assert said in (f"{moment:%H:%M}", str(moment.day), f"{moment:%b}")


def test_calendar_words_name_month_and_year_where_they_change() -> None:
    start = datetime(2020, 7, 15, tzinfo=UTC).timestamp()
    assert calendar_ticks(start, start + 201 * 86400, 9)[1] == [
        "Aug\n2020 UTC", "Sep", "Oct", "Nov", "Dec", "Jan\n2021", "Feb",
    ]  # fmt: skip
    week = calendar_ticks(start + 15 * 86400, start + 21 * 86400, 7)[1]
    assert week == ["30\nJul 2020 UTC", "31", "1\nAug 2020", "2", "3", "4", "5"]


def _figure():
    with styled():
        figure = new_figure(2.0)
        axes = figure.add_axes((0.1, 0.2, 0.8, 0.7))
        axes.plot([0, 1, 2], [0.123456789, 1, 4], "o-")
        axes.fill_between([0, 1, 2], [0, 1, 2], [1, 2, 3], hatch="//")
        axes.set_title("<b>$x_1$ & “quoted”</b>")
    return figure


def test_svg_is_well_formed_repeatable_and_prefixed() -> None:
    text = svg(_figure(), "one")
    assert text == svg(_figure(), "one")
    root = ElementTree.fromstring(text)
    assert root.tag.endswith("svg")
    names = re.findall(r'\bid="([^"]*)"', text)
    assert names and len(names) == len(set(names)) and all(name.startswith("one-") for name in names)
    used = re.findall(r'href="#([^"]*)"|url\(#([^)]*)\)', text)
    assert used and all((a or b) in names for a, b in used)
    assert "<b>$x_1$ & “quoted”</b>" in "".join(root.itertext())
    assert "0.123456789" not in text and "<script" not in text and "DejaVu" not in text


def test_inline_svg_names_no_host_and_tells_what_it_shows() -> None:
    text = inline_svg(_figure(), "one", 'a "title" <x>')
    assert "http" not in text and "xmlns" not in text
    assert 'aria-label="a &quot;title&quot; &lt;x&gt;"' in text and "viewBox" in text
    assert not re.search(r"<svg[^>]* (width|height)=", text)
    ElementTree.fromstring(text)


def test_png_is_an_image_of_the_asked_size() -> None:
    data = png(_figure(), dpi=100)
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    assert int.from_bytes(data[16:20], "big") == 730 and int.from_bytes(data[20:24], "big") == 200


def test_the_users_own_style_neither_matters_nor_changes() -> None:
    import matplotlib

    with matplotlib.rc_context({"font.size": 30.0, "lines.linewidth": 9.0, "text.usetex": False}):
        loud = svg(_figure(), "one")
        assert matplotlib.rcParams["font.size"] == 30.0
    assert loud == svg(_figure(), "one")


@pytest.mark.parametrize("name", ["WT03", "WEA 14", "MW", "a turbine"])
def test_names_of_turbines_fit_beside_their_rows(name: str) -> None:
    """W and M are half as wide again as other letters, and begin the usual names of turbines."""
    figure = Picture((Panel((point(1.0, 0.0, "o", INK, 3.0),), y=rows([name])),), 2.0).figure()
    figure.draw_without_rendering()
    (label,) = figure.axes[0].get_yticklabels()
    assert label.get_text() == name and label.get_window_extent().x0 >= 0.0
