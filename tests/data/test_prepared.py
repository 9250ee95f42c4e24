"""A prepared record: what is derived from its series is computed once, and anew where series change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from hygrokf.data import prepared as module
from hygrokf.data.ambient import reading_noise, smoothed
from hygrokf.data.input_paths import input_path, without_response
from hygrokf.data.prepared import VAPOUR, PreparedRecord, prepare
from hygrokf.data.record import Record, Series

START_S = 1.6e9
STEP_S = 600.0


def series(signal: str, value: np.ndarray, **more: object) -> Series:
    return Series(signal, START_S + STEP_S * np.arange(len(value)), value, **more)


@pytest.fixture
def record() -> Record:
    random = np.random.default_rng(5)
    warm = 280.0 + np.cumsum(0.05 * random.normal(size=900)) + 0.2 * random.normal(size=900)
    moist = 0.7 + 0.05 * np.sin(np.arange(900) / 20.0)
    return Record(
        "made",
        (
            series("ambient_temperature", warm, response_time_s=300.0),
            series("ambient_relative_humidity", moist),
            series("cabinet_temperature", warm + 5.0, hold="mean", interval_s=STEP_S),
            series("wind_speed", 5.0 + np.sin(np.arange(900.0)), hold="mean", interval_s=STEP_S),
        ),
        until_s=START_S + 400 * STEP_S,
        warnings=("a value was masked",),
    )


def test_a_prepared_record_is_the_record_and_stays_itself(record):
    made = prepare(record)
    assert made.series == record.series and made.until_s == record.until_s
    assert made.warnings == record.warnings and repr(made) == repr(record)
    assert prepare(made) is made
    assert isinstance(made.identification(), PreparedRecord)


def test_each_thing_is_computed_once(record, monkeypatch):
    made, calls = prepare(record), []

    def counted(name):
        own = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *given: (calls.append(name), own(*given))[1])

    names = ("absolute_humidity_at", "input_path", "reading_noise")
    for name in names:
        counted(name)
    for _ in range(3):
        _ = made.ambient_vapour, made.cabinet_vapour, made.noise
        _ = made.path("wind_speed"), made.course("wind_speed"), made.course(VAPOUR, (1e-9, 1e-9))
    assert [calls.count(name) for name in names] == [2, 3, 2]


def test_a_course_is_without_response_and_noise_and_a_path_is_as_read(record):
    made, warm = prepare(record), record["ambient_temperature"]
    noise = made.noise["ambient_temperature"]
    assert noise == reading_noise(warm)
    assert_array_equal(made.path("ambient_temperature").value, warm.value)
    bare = without_response(warm)
    assert_array_equal(made.course("ambient_temperature").value, bare.value)
    assert_array_equal(made.course("ambient_temperature", noise).value, smoothed(bare, noise).value)
    cabinet = record["cabinet_temperature"]
    assert_array_equal(made.course("cabinet_temperature").value, input_path(cabinet).value)
    assert made.course(VAPOUR) is made.ambient_vapour  # instants need no path


def test_a_record_with_other_series_has_its_own_courses(record):
    made = prepare(record)
    before, vapour = made.course("ambient_temperature"), made.ambient_vapour
    warmer = replace(record["ambient_temperature"], value=record["ambient_temperature"].value + 10.0)
    other = made.replace_series(warmer)
    assert other.course("ambient_temperature").value[7] == pytest.approx(before.value[7] + 10.0)
    assert (other.ambient_vapour.value > 1.5 * vapour.value).all()
    assert made.course("ambient_temperature") is before
    early = made.identification()
    assert early.course("ambient_temperature").time[-1] == record.until_s


def test_without_humidity_there_is_no_vapour(record):
    dry = prepare(Record("dry", tuple(one for one in record.series if "humidity" not in one.signal)))
    assert dry.ambient_vapour is None and dry.cabinet_vapour is None
    assert VAPOUR not in dry.noise
    with pytest.raises(KeyError, match="has no ambient_absolute_humidity"):
        dry.path(VAPOUR)
