"""Features that mechanisms read: by hand, by published numbers, and through a design that drives another
record."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plants import plant
from plants.as_record import to_record

from hygrokf.data.prepared import PreparedRecord, prepare
from hygrokf.data.record import Record, Series, Site
from hygrokf.modelling.derived_inputs import FEATURES, clear_sky, feature, feature_faults
from hygrokf.modelling.design import Design, design, extended
from hygrokf.modelling.inputs import model_inputs
from hygrokf.physics.switches import CONTROLLED

HOUR = 3600.0
START = 1.6e9


def series(name: str, value: np.ndarray, step: float = 600.0, **more: object) -> Series:
    return Series(name, START + step * np.arange(1, len(value) + 1), value, **more)


@pytest.fixture(scope="module")
def record() -> Record:
    return to_record(plant(77, days=12.0))


def test_dates_windows_and_the_calendar() -> None:
    nothing = prepare(Record("none", ()))
    time = START + HOUR * np.arange(6.0)
    middle = START + HOUR * np.array([0.0, 0.5, 1.5, 2.5, 3.5, 4.5])
    after = feature(nothing, "after_step", {"date_s": START + 2 * HOUR}, time)
    assert after.tolist() == (middle > START + 2 * HOUR).astype(float).tolist()
    ramp = feature(nothing, "after_step", {"date_s": START + HOUR, "days": 2.0 / 24.0}, time)
    np.testing.assert_allclose(ramp, [0.0, 0.0, 0.25, 0.75, 1.0, 1.0])
    door = feature(nothing, "door_open", {"spans": [[START + HOUR, START + 2 * HOUR]]}, time)
    assert door.tolist() == [0, 0, 1, 0, 0, 0]
    share = feature(nothing, "elapsed", {"start_s": START, "end_s": START + 10 * HOUR}, time)
    np.testing.assert_allclose(share, np.arange(6) / 10.0)


@pytest.mark.parametrize(
    ("reads", "value", "start", "full", "expected"),
    [
        ("cabinet_temperature", [290.0, 284.0, 286.0, 289.0, 284.0, 284.0], 289.0, 285.0,
         [0, 1, 0.75, 0, 1, 0]),
        ("cabinet_relative_humidity", [0.5, 1.0, 0.75, 0.5, 1.0, 1.0], 0.5, 1.0, [0, 1, 0.5, 0, 1, 0]),
    ],
)  # fmt: skip
def test_a_heater_runs_at_standstill_alone(
    reads: str, value: list[float], start: float, full: float, expected: list[float]
) -> None:
    power = series("active_power", np.array([0.0] * 5 + [1e6] * 3), hold="mean", interval_s=600.0)
    made = prepare(Record("made", (series(reads, np.array(value)), power)))
    time = np.concatenate([[START], made[reads].time + 300.0])  # steps whose middles are the readings
    settings = {"reads": reads, "start": start, "full": full, "idle": True}
    assert feature(made, "throttled_heating", settings, time)[1:].tolist() == expected


def test_the_clear_sky_is_haurwitzs() -> None:
    """Noon at the equator on an equinox: the sun within a degree of the zenith, 1098 exp(−0.057) W/m²."""
    site = Site(0.0, 0.0)
    day = np.datetime64("2021-03-20T00:00").astype("datetime64[s]").astype(float)
    time = day + np.arange(0, 86400, 60.0)
    found = clear_sky(time, site)
    assert found.max() == pytest.approx(1098.0 * np.exp(-0.057), rel=2e-3)
    noon = time[np.argmax(found)] - day
    assert noon == pytest.approx(43200 + 7.5 * 60, abs=120)  # the equation of time on that day is −7.5 min
    assert np.sum(found > 0) / 60.0 == pytest.approx(12.0, abs=0.2)
    east = clear_sky(time, Site(0.0, 90.0))
    assert time[np.argmax(east)] - day == pytest.approx(noon - 6 * HOUR, abs=120)
    summer = np.datetime64("2021-06-21T00:00").astype("datetime64[s]").astype(float) + np.arange(
        0, 86400, 60.0
    )
    assert np.sum(clear_sky(summer, Site(52.4, -0.95)) > 0) / 60.0 == pytest.approx(16.6, abs=0.3)


def test_a_design_brings_its_features_to_any_record(record: Record) -> None:
    base = design(record, kind="thermal")
    date = record.start_s + 5 * 86400.0
    wider = extended(base, [("stepped_loss", {})], features={"after_step": {"date_s": date}})
    again = Design.from_json(wider.to_json())
    made = model_inputs(again, record)
    seconds = made.timeline.origin_s + HOUR * made.timeline.time
    flag = made.timeline.input("after_step")
    assert set(flag) == {0.0, 1.0}
    assert abs(seconds[np.argmax(flag)] - date) < 1800.0
    assert len(made.timeline) == len(model_inputs(base, record).timeline)


def test_what_a_record_lacks_is_named(record: Record) -> None:
    base = design(record, kind="thermal")
    bare = replace(
        record,
        site=None,
        series=tuple(
            s
            for s in record.series
            if s.signal in ("active_power", *base.model.outputs, "ambient_temperature")
        ),
    )
    for name, mechanism, words in (
        ("sunshine", "solar_gain", "expected global_horizontal_irradiance or"),
        ("wind_tenth", "wind_loss", "the model reads wind_speed, which the record does not have"),
    ):
        with pytest.raises(ValueError, match=words):
            model_inputs(extended(base, [(mechanism, {})], features={name: {}}), bare)
    assert set(FEATURES) >= {
        "elapsed",
        "sunshine",
        "wind_tenth",
        "after_step",
        "door_open",
        *CONTROLLED,
    }


def test_features_of_a_damaged_file_are_named() -> None:
    good = {"sunshine": {}, "after_step": {"date_s": 1.0}, "scheduled": {"start_h": 8.0, "hours": 2.0}}
    assert feature_faults(good) == []
    faults = feature_faults({"moon": {}, "scheduled": {"start_h": 8.0}, "wind_tenth": {"a": 1}})
    for fault, words in zip(
        faults, (["moon:", "elapsed"], ["scheduled:", "hours"], ["wind_tenth:", "none", "'a'"]), strict=True
    ):
        assert all(word in fault for word in words)


def test_a_sunlit_wall_is_that_of_other_code() -> None:
    """Within 3 % of the plants' wall, whose sun follows a simpler clock; beam and sky are split alike."""
    from plants.hidden import hidden_plant
    from plants.outdoors import wall_irradiance

    plant = hidden_plant(3, "none", days=60.0)
    drivers = plant.drivers
    record = record_with_sun(drivers)
    time = drivers.time[::60][1:-1]
    for azimuth in (90.0, 180.0, 250.0):
        own = 1e3 * feature(record, "sunlit_wall", {"azimuth_deg": azimuth}, time)
        known = wall_irradiance(drivers, np.radians(azimuth))[::60][1:-1]
        assert np.corrcoef(own, known)[0, 1] > 0.98
        assert own.mean() == pytest.approx(known.mean(), rel=0.05)


def record_with_sun(drivers) -> PreparedRecord:
    sun = Series("global_horizontal_irradiance", drivers.time[::10], drivers.irradiance_W_m2[::10])
    return prepare(Record("sun", (sun,), site=Site(drivers.latitude_deg, drivers.longitude_deg, None)))


def test_the_night_sky_draws_at_night_and_most_after_clear_days() -> None:
    from plants.hidden import hidden_plant

    drivers = hidden_plant(3, "none", days=60.0).drivers
    record = record_with_sun(drivers)
    time = drivers.time[::60][30:-1]
    value = feature(record, "night_sky", {}, time)
    assert ((value >= 0.0) & (value <= 1.0)).all()
    bright = np.interp(time, drivers.time, drivers.irradiance_W_m2) > 50.0
    assert value[bright].max() < 1e-9
    day = np.floor(time / 86400.0)
    before = {
        d: drivers.irradiance_W_m2[(drivers.time >= 86400.0 * (d - 1)) & (drivers.time < 86400.0 * d)].mean()
        for d in np.unique(day)
    }
    night = (time % 86400.0 < 7200.0) & ~bright
    sums = np.array([before[d] for d in day[night]])
    ok = np.isfinite(sums)
    assert np.corrcoef(value[night][ok], sums[ok])[0, 1] > 0.5
    dark = feature(replace(record, series=()), "night_sky", {}, time)
    assert set(np.unique(dark)) <= {0.0, 1.0}


def test_effects_that_fade_and_that_settle_sum_to_the_step() -> None:
    time = np.arange(0.0, 40 * 86400.0, 3600.0)
    settings = {"date_s": 10 * 86400.0, "days": 5.0}
    nothing = prepare(Record("none", (Series("cabinet_temperature", time, 0.0 * time + 290.0),)))
    since, fading = (feature(nothing, name, settings, time) for name in ("since", "fading"))
    assert (since[time < settings["date_s"]] == 0).all() and since[-1] == pytest.approx(1.0, abs=5e-3)
    assert (fading[time < settings["date_s"]] == 0).all() and 0.99 < fading.max() <= 1.0
    after = time > settings["date_s"] + 7200.0
    assert (since + fading)[after] == pytest.approx(np.ones(after.sum()), abs=0.01)
