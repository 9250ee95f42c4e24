"""Stamps, zones, durations, steps, summer time."""

from __future__ import annotations

import math
from datetime import UTC, datetime, timedelta
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hygrokf.data.timestamps import (
    duration,
    modal_step,
    moment,
    read_stamps,
    summer_time_holes,
    time_format_fault,
    zone_in_header,
    zone_named,
)
from hygrokf.texts.wording import duration_text, period_text, stamp_text

BERLIN = ZoneInfo("Europe/Berlin")


def column(*stamps) -> pd.Series:
    return pd.Series(list(stamps), dtype=object)


def local_stamps(start: str, count: int, step_min: int, form: str = "%Y-%m-%d %H:%M", zone=BERLIN):
    """UTC seconds and the wall-clock text that a logger with summer time writes for them."""
    first = datetime.fromisoformat(start).replace(tzinfo=UTC)
    moments = [first + timedelta(minutes=step_min * one) for one in range(count)]
    text = [one.astimezone(zone).strftime(form) for one in moments]
    return np.array([one.timestamp() for one in moments]), column(*text)


@pytest.mark.parametrize(
    ("text", "expected"),
    [("30s", 30.0), ("10min", 600.0), ("1h", 3600.0), (" 1.5 h", 5400.0), ("2d", 172800.0)],
)
def test_durations(text, expected):
    assert duration(text) == expected


@pytest.mark.parametrize("text", ["10", "10 minutes", "", "min", "-5min", 600, None, "1h30min"])
def test_bad_durations_say_what_is_expected(text):
    with pytest.raises(ValueError, match="10min"):
        duration(text)


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(600, "10 min"), (3600, "1 h"), (86400, "1 d"), (30, "30 s"), (5400, "90 min"), (302400, "3.5 d")],
)
def test_durations_in_words(seconds, text):
    assert duration_text(seconds) == text


def test_stamp_and_period_in_words():
    assert stamp_text(0.0) == "1970-01-01T00:00Z"
    assert stamp_text(1.0) == "1970-01-01T00:00:01Z"
    assert stamp_text(math.nan) == "-"
    assert period_text(0.0, 0.0) == "1970-01-01T00:00Z"
    assert period_text(0.0, 60.0) == "1970-01-01T00:00Z to 1970-01-01T00:01Z"


@pytest.mark.parametrize(
    ("name", "hours"), [("UTC", 0), ("Z", 0), ("+02:00", 2), ("-0330", -3.5), ("Etc/GMT-2", 2)]
)
def test_zones(name, hours):
    offset = datetime(2020, 7, 1, tzinfo=zone_named(name)).utcoffset()
    assert offset == timedelta(hours=hours)


@pytest.mark.parametrize(
    ("name", "word"), [("Europe/Berln", "Europe/Berlin"), ("+25:00", "14 hours"), ("", "Berlin"), (2, "text")]
)
def test_bad_zones_are_explained(name, word):
    with pytest.raises(ValueError, match=word):
        zone_named(name)


def test_moments_need_an_offset():
    assert moment("1970-01-01T01:00:00+01:00") == 0.0
    assert moment(datetime(1970, 1, 1, tzinfo=UTC)) == 0.0
    with pytest.raises(ValueError, match="no offset"):
        moment("2020-01-01T00:00:00")
    with pytest.raises(ValueError, match="ISO 8601"):
        moment("last week")
    with pytest.raises(ValueError, match="ISO 8601"):
        moment(5)


@pytest.mark.parametrize(
    "text",
    [
        "2020-03-01T12:00:00Z",
        "2020-03-01 12:00Z",
        "2020-03-01T13:00+01:00",
        "2020-03-01 13:00:00 +0100",
        "2020-03-01T13:00:00.000+01",
        "2020-03-01 12:00:00 UTC",
        "20200301T1200Z",
    ],
)
def test_stamps_with_offsets(text):
    stamps = read_stamps(column(text))
    assert stamps.time[0] == datetime(2020, 3, 1, 12, tzinfo=UTC).timestamp()
    assert not stamps.naive.any()


@pytest.mark.parametrize(
    "text", ["2016/1/11 17:00", "2016-01-11 17:00:00", "2016-01-11T17:00", "2016/01/11 17:00:00.0"]
)
def test_stamps_without_offset_need_a_zone(text):
    expected = datetime(2016, 1, 11, 15, tzinfo=UTC).timestamp()
    assert read_stamps(column(text), zone_named("+02:00")).time[0] == expected
    assert read_stamps(column(text)).naive.all()


def test_mixed_offsets_and_missing_stamps():
    stamps = read_stamps(
        column("2020-10-25T02:30+02:00", None, "2020-10-25T02:30+01:00", "2020-10-25 00:30Z")
    )
    base = datetime(2020, 10, 25, 0, 30, tzinfo=UTC).timestamp()
    np.testing.assert_array_equal(stamps.time, [base, np.nan, base + 3600, base])
    assert not stamps.unreadable.any()


def test_one_naive_stamp_among_others_is_found():
    stamps = read_stamps(column("2020-10-25T02:30+02:00", "2020-10-25T02:40", "2020-10-25T02:50Z"))
    np.testing.assert_array_equal(stamps.naive, [False, True, False])


@pytest.mark.parametrize(
    "text", ["yesterday", "2020-13-01", "1577836800", "43831.5", "2020", "01.02.2020 00:00", "12:00"]
)
def test_what_is_no_stamp(text):
    stamps = read_stamps(column("2020-01-01T00:00Z", text))
    np.testing.assert_array_equal(stamps.unreadable, [False, True])
    assert np.isnan(stamps.time[1])


def test_midnight_at_the_end_of_a_day():
    stamps = read_stamps(column("2020-01-01T23:00Z", "2020-01-01T24:00Z", "2020-01-02T01:00Z"))
    np.testing.assert_array_equal(np.diff(stamps.time), 3600.0)
    naive = read_stamps(column("2020-01-01 23:00", "2020-01-01 24:00:00"), UTC)
    np.testing.assert_array_equal(np.diff(naive.time), 3600.0)


@pytest.mark.parametrize(
    ("form", "texts"),
    [
        ("%d.%m.%Y %H:%M", ("01.01.2020 23:00", "01.01.2020 24:00", "02.01.2020 01:00")),
        ("%Y%m%d%H", ("2020010123", "2020010124", "2020010201")),
        ("%H:%M:%S %d/%m/%y", ("23:00:00 01/01/20", "24:00:00 01/01/20", "01:00:00 02/01/20")),
        ("%Y-%m-%d %H:%M%z", ("2020-01-01 23:00Z", "2020-01-01 24:00+0000", "2020-01-02 01:00Z")),
        ("excel", ("43831.9583333", "43832", "43832.0416667")),
        ("excel", ("43831,9583333", "43832,0", "43832,0416667")),
        ("excel", (43831.9583333, 43832, 43832.0416667)),
    ],
)
def test_midnight_at_the_end_of_a_day_in_any_form(form, texts):
    stamps = read_stamps(column(*texts), UTC, time_format=form)
    assert stamps.time[0] == datetime(2020, 1, 1, 23, tzinfo=UTC).timestamp()
    np.testing.assert_array_equal(np.diff(stamps.time), 3600.0)


def test_24_10_is_no_time():
    assert read_stamps(column("01.01.2020 24:10"), UTC, time_format="%d.%m.%Y %H:%M").unreadable.all()
    assert read_stamps(column("300", "2020-01-01"), UTC, time_format="excel").unreadable.all()


def test_months_carry_no_offset():
    stamps = read_stamps(column("2022-01", "2022-02"), UTC)
    assert not stamps.aware
    np.testing.assert_array_equal(np.diff(stamps.time), 31 * 86400.0)
    assert read_stamps(column("2022-01-01T00Z")).aware


@pytest.mark.parametrize(
    ("header", "zone"),
    [("Time (UTC)", "UTC"), ("Time (UTC+1)", "+01:00"), ("time_utc", "UTC"), ("Zeit [GMT-03:30]", "-03:30"),
     ("Time (CEST)", "+02:00"), ("Zeit MEZ", "+01:00"), ("time", None), ("price_cent", None)],
)  # fmt: skip
def test_a_zone_in_a_header(header, zone):
    assert zone_in_header(header) == zone


@pytest.mark.parametrize(
    ("form", "word"), [("%m/%d/%Y %H:%M %p", "%I for %H"), ("%d.%m.%Y %I:%M", "%H for %I"), ("%H:%M", None)]
)
def test_hours_of_a_form_that_would_be_read_wrongly(form, word):
    fault = time_format_fault(form)
    assert fault is None if word is None else word in fault


def test_stated_form():
    stamps = read_stamps(column("31.12.2020 23:00"), UTC, time_format="%d.%m.%Y %H:%M")
    assert stamps.time[0] == datetime(2020, 12, 31, 23, tzinfo=UTC).timestamp()
    aware = read_stamps(column("31.12.2020 23:00 +0100"), time_format="%d.%m.%Y %H:%M %z")
    assert aware.time[0] == datetime(2020, 12, 31, 22, tzinfo=UTC).timestamp()
    assert read_stamps(column("2020"), UTC, time_format="%d.%m.%Y").unreadable.all()


def test_ignored_offsets():
    stamps = read_stamps(
        column("2020-07-01T12:00:00+02:00", "2020-12-01 12:00+0100"), UTC, ignore_offset=True
    )
    expected = [datetime(2020, month, 1, 12, tzinfo=UTC).timestamp() for month in (7, 12)]
    np.testing.assert_array_equal(stamps.time, expected)


def test_datetime_columns():
    aware = pd.Series(pd.to_datetime(["2020-01-01T01:00+01:00"]))
    base = datetime(2020, 1, 1, tzinfo=UTC).timestamp()
    assert read_stamps(aware).time[0] == base
    assert read_stamps(aware, UTC, ignore_offset=True).time[0] == base + 3600.0
    naive = pd.Series(pd.to_datetime(["2020-01-01T00:00", None]))
    assert read_stamps(naive).naive.tolist() == [True, False]
    assert read_stamps(naive, UTC).time[0] == base


@pytest.mark.parametrize("step", [1, 10, 30, 60])
@pytest.mark.parametrize("newest_first", [False, True])
@pytest.mark.parametrize("start", ["2020-10-24T00:00", "2020-03-28T00:00"])
def test_a_local_clock_is_followed_through_both_changes(step, newest_first, start):
    expected, text = local_stamps(start, 3 * 1440 // step, step)
    if newest_first:
        expected, text = expected[::-1], text[::-1].reset_index(drop=True)
    stamps = read_stamps(text, BERLIN)
    np.testing.assert_array_equal(stamps.time, expected)
    autumn = start.startswith("2020-10")
    assert [one.startswith("summer-time hole") for one in stamps.warnings] == [True] * autumn
    if autumn:
        assert "2020-10-25" in stamps.warnings[0]


@given(st.integers(0, 8760), st.sampled_from(["Europe/Berlin", "America/New_York", "Asia/Tokyo"]))
def test_local_stamps_agree_with_zoneinfo(hours, name):
    zone = ZoneInfo(name)
    instant = datetime(2021, 1, 1, tzinfo=UTC) + timedelta(hours=hours)
    local = instant.astimezone(zone)
    if local.replace(fold=0).utcoffset() != local.replace(fold=1).utcoffset():
        return
    stamps = read_stamps(column(local.strftime("%Y-%m-%dT%H:%M")), zone)
    assert stamps.time[0] == instant.timestamp()


def test_a_doubled_hour_shown_once_is_left_out():
    expected, text = local_stamps("2020-10-24T12:00", 144, 10)
    once = np.ones(144, dtype=bool)
    once[78:84] = False
    stamps = read_stamps(text[once].reset_index(drop=True), BERLIN)
    assert np.isnan(stamps.time).sum() == 6
    kept = np.isfinite(stamps.time)
    np.testing.assert_array_equal(stamps.time[kept], expected[once][kept])
    assert "left out" in stamps.warnings[0]


def test_a_doubled_hour_in_pairs_is_left_out():
    text = column(*[f"2020-10-25 02:{10 * k:02d}" for k in range(6) for _ in range(2)])
    assert np.isnan(read_stamps(text, BERLIN).time).all()


def test_a_repeated_row_is_no_return_of_the_clock():
    """One pass of the repeated hour with one row twice: nothing tells the pass."""
    expected, text = local_stamps("2021-10-30T23:40", 6, 10)
    later = [f"2021-10-31 {hour}" for hour in ("04:00", "04:10")]
    rows = column(*text[:3], text[2], *text[3:], "2021-10-31 02:40", "2021-10-31 02:50", *later)
    stamps = read_stamps(rows, BERLIN)
    inside = rows.str.contains(" 02:").to_numpy()
    assert inside.sum() == 7
    assert np.isnan(stamps.time[inside]).all()
    np.testing.assert_array_equal(stamps.time[:2], expected[:2])
    assert np.isfinite(stamps.time[~inside]).all()


@pytest.mark.parametrize("newest_first", [False, True])
def test_a_repeated_row_between_two_passes_stays_in_its_own(newest_first):
    expected, text = local_stamps("2021-10-30T23:00", 24, 10)
    order = np.repeat(np.arange(24), np.where(np.isin(np.arange(24), (8, 14)), 2, 1))
    order = order[::-1] if newest_first else order
    stamps = read_stamps(text[order].reset_index(drop=True), BERLIN)
    np.testing.assert_array_equal(stamps.time, expected[order])


def test_hours_tell_their_passes_by_new_readings():
    text = column("2021-10-31 01:00", "2021-10-31 02:00", "2021-10-31 02:00", "2021-10-31 03:00")
    base = datetime(2021, 10, 30, 23, tzinfo=UTC).timestamp()
    new = read_stamps(text, BERLIN, repeated=np.zeros(4, bool))
    np.testing.assert_array_equal(new.time, base + 3600.0 * np.arange(4))
    same = read_stamps(text, BERLIN, repeated=np.array([False, False, True, False]))
    np.testing.assert_array_equal(same.time, [base, np.nan, np.nan, base + 3 * 3600.0])


@pytest.mark.parametrize("step", [15, 30, 60])
@pytest.mark.parametrize("newest_first", [False, True])
def test_ends_of_intervals_within_the_repeated_hour(step, newest_first):
    """The last end of the first pass is written 03:00, before the stamps step back."""
    before, within = ["2021-10-31 01:00", "2021-10-31 02:00"], range(step, 61, step)
    one = [f"2021-10-31 {2 + minute // 60:02d}:{minute % 60:02d}" for minute in within]
    rows = column(*before, *one, *one, "2021-10-31 04:00")
    ends = [-60.0, 0.0, *within, *(60.0 + minute for minute in within), 180.0]
    expected = datetime(2021, 10, 31, tzinfo=UTC).timestamp() + 60.0 * np.array(ends)
    if newest_first:
        rows, expected = rows[::-1].reset_index(drop=True), expected[::-1]
    np.testing.assert_array_equal(read_stamps(rows, BERLIN).time, expected)


def test_a_clock_without_summer_time_is_noticed_in_spring():
    _, text = local_stamps("2020-03-28T12:00", 144, 10, zone=zone_named("+01:00"))
    stamps = read_stamps(text, BERLIN)
    assert np.isnan(stamps.time).sum() == 6
    assert "does not exist" in stamps.warnings[0]
    assert "2020-03-29" in stamps.warnings[0]


def test_modal_step():
    assert modal_step(np.array([0.0, 600.0, 1200.0, 5000.0])) == (600.0, pytest.approx(2 / 3))
    assert math.isnan(modal_step(np.array([1.0]))[0])
    jitter = np.cumsum(600.0 + np.random.default_rng(1).uniform(-2, 2, 500))
    step, share = modal_step(jitter)
    assert step == pytest.approx(600.0, abs=1.0)
    assert share > 0.9


def regular(start: str, days: int, step: float = 600.0) -> np.ndarray:
    return datetime.fromisoformat(start + "+00:00").timestamp() + step * np.arange(days * 86400 / step)


def test_a_record_without_change_of_clocks_is_quiet():
    assert summer_time_holes(regular("2020-01-01T00:00", 365)) == ()
    # The same hole on any other day is a gap like others.
    time = regular("2020-05-01T00:00", 20)
    assert summer_time_holes(np.delete(time, slice(1000, 1006))) == ()


def test_a_record_that_loses_single_hours_says_nothing_by_losing_one_on_a_date_of_change():
    time = regular("2020-02-01T00:00", 120, 3600.0)
    march = np.searchsorted(time, datetime(2020, 3, 29, 2, tzinfo=UTC).timestamp())
    (warning,) = summer_time_holes(np.delete(time, march))
    assert "missing on 2020-03-29" in warning
    often = np.random.default_rng(3).choice(len(time) - 2, 30, replace=False) + 1
    assert summer_time_holes(np.delete(time, [*often, march])) == ()


@pytest.mark.parametrize("step", [600.0, 3600.0])
def test_local_stamps_read_at_a_fixed_offset_show(step):
    count = round(300 * 86400 / step)
    _, text = local_stamps("2020-02-01T00:00", count, round(step / 60))
    time = np.sort(read_stamps(text, zone_named("+01:00")).time)
    (warning,) = summer_time_holes(time)
    assert "missing on 2020-03-29" in warning
    assert "twice on 2020-10-25" in warning
    assert "Europe/Berlin" in warning


def test_offsets_on_a_clock_without_summer_time_show():
    # As a converter writes them: naive 02:xx pushed to 03:xx in spring, taken as the first in
    # autumn.
    local = regular("2020-02-01T00:00", 300)
    spring = datetime(2020, 3, 29, 2, tzinfo=UTC).timestamp()
    autumn = datetime(2020, 10, 25, 3, tzinfo=UTC).timestamp()
    summer = (local >= spring + 3600.0) & (local < autumn)
    utc = np.where(summer, local - 7200.0, local - 3600.0)
    (warning,) = summer_time_holes(np.sort(utc))
    assert "twice on 2020-03-29" in warning
    assert "missing on 2020-10-25" in warning
    assert "ignore_offset" in warning


def test_an_hour_moved_by_the_export_shows():
    time = regular("2020-03-01T00:00", 60)
    spring = datetime(2020, 3, 29, 2, tzinfo=UTC).timestamp()
    moved = np.where((time >= spring) & (time < spring + 3600.0), time + 3600.0, time)
    (warning,) = summer_time_holes(np.sort(moved))
    assert "moved" in warning
