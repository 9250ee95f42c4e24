"""An effect hidden by hand in the errors is named first and once; where nothing is hidden nothing is
named."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from plants import plant
from plants.as_record import to_record
from plants.saturation import saturation_pressure

import hygrokf
from hygrokf.data.record import Record
from hygrokf.data.structured import plain
from hygrokf.discovery.conditions import LONG_STOPS, conditions
from hygrokf.discovery.discovery_results import Finding
from hygrokf.discovery.findings import MATERIAL_SHARE, findings
from hygrokf.discovery.residuals import Residuals, binned, closed, duration_h, residuals, run_lengths
from hygrokf.identification.fit import Fit
from hygrokf.report.figures.drawing import NothingToShow, inline_svg, png
from hygrokf.report.figures.lead import figure_episodes
from hygrokf.report.figures.residual_structure import figure_day_hour, figure_drivers
from hygrokf.texts.discovery_codes import ConditionCode, DiscoveryCode

STEP_H = 0.25
ORIGIN_S = 1594771200.0
"""15 July 2020, midnight UTC."""


# --- residuals made by hand ------------------------------------------------------------------


def memory(random: np.random.Generator, size: int, time_h: float) -> np.ndarray:
    """Ornstein–Uhlenbeck series of variance 1 at 15 min."""
    from scipy.signal import lfilter

    gain = math.exp(-STEP_H / time_h)
    kicks = math.sqrt(1.0 - gain**2) * random.standard_normal(size)
    kicks[0] = random.standard_normal()
    return lfilter([1.0], [1.0, -gain], kicks)


def inert(values: np.ndarray, time_h: float = 1.5) -> np.ndarray:
    """A series behind a first-order lag, of variance 1 again: as smooth as a cabinet's temperature."""
    from scipy.signal import lfilter

    gain = math.exp(-STEP_H / time_h)
    late = lfilter([1.0 - gain], [1.0, -gain], values)
    return late / late.std()


@cache
def made(seed: int, days: int = 60) -> Residuals:
    """Errors with a memory of half a day that owe nothing to weather, operation or calendar."""
    random = np.random.default_rng(seed)
    size = int(days * 24 / STEP_H)
    time_h = STEP_H * np.arange(size)
    hour = time_h % 24.0
    sun = np.maximum(0.0, np.sin((hour - 6.0) / 12.0 * math.pi)) * 500.0
    ambient = 283.0 + 4.0 * memory(random, size, 60.0) + 3.0 * np.sin((hour - 9.0) / 24.0 * 2.0 * math.pi)
    wind = np.maximum(0.0, 7.0 + 3.5 * memory(random, size, 20.0))
    power = np.clip((wind - 3.0) / 9.0, 0.0, 1.0) ** 2
    preheating = np.zeros(size, bool)
    for start in (9.0, 27.0, 45.0):
        stop = slice(int(start * 96), int((start + 3.0) * 96))
        power[stop] = 0.0
        preheating[int((start + 3.0) * 96) - 24 : stop.stop] = True
    errors = {
        "temperature": 1.5 * inert(memory(random, size, 7.0)) + 0.05 * random.standard_normal(size),
        "humidity": 0.42 * memory(random, size, 5.0) + 0.03 * random.standard_normal(size),
    }
    for values in errors.values():
        values[random.random(size) < 0.01] = np.nan
    simulated = {"temperature": ambient + 8.0, "humidity": np.full(size, 9.0)}
    return Residuals(
        time_h=time_h,
        origin_s=ORIGIN_S,
        error=errors,
        drivers={
            "ambient_temperature": ambient,
            "ambient_absolute_humidity": 7.0 + memory(random, size, 40.0),
            "power": power,
            "wind_speed": wind,
            "global_horizontal_irradiance": sun,
            "preheating": preheating.astype(float),
            "cabinet_relative_humidity": np.clip(0.6 + 0.1 * memory(random, size, 30.0), 0.0, 1.0),
        },
        operating=power > 0,
        preheating=preheating,
        validation=np.zeros(size, bool),
        sensor_error={"temperature": np.full(size, 0.2), "humidity": np.full(size, 0.15)},
        time_constants={"temperature": 1.5, "humidity": 3.0},
        measured={name: simulated[name] + errors[name] for name in errors},
        simulated=simulated,
        sd={"temperature": np.full(size, 1.5), "humidity": np.full(size, 0.42)},
    )


def with_effect(base: Residuals, quantity: str, effect: np.ndarray) -> Residuals:
    """Readings that are higher by an effect (T,)."""
    return replace(
        base,
        error={**base.error, quantity: base.error[quantity] + effect},
        measured={**base.measured, quantity: base.measured[quantity] + effect},
    )


def single(found: list[Finding]) -> Finding:
    assert len(found) == 1, [one.statement for one in found]
    return found[0]


def test_nothing_hidden_hardly_anything_found() -> None:
    """At a level of 5 %, one of 16 records is expected to have a finding at most."""
    assert sum(bool(findings(made(seed))) for seed in range(100, 116)) <= 1


@pytest.mark.slow
def test_at_most_one_in_twenty_records_without_an_effect_has_a_finding() -> None:
    assert np.mean([bool(findings(made(seed))) for seed in range(100, 250)]) <= 0.05


def named(found: list[Finding], quantity: str, kinds: tuple[str, ...], driver: str = "") -> bool:
    """Whether the first finding is of a quantity, a kind and a driver."""
    if not found:
        return False
    one = found[0]
    return one.quantity == quantity and one.kind in kinds and one.driver == driver


def behind(values: np.ndarray, time_h: float) -> np.ndarray:
    """Values at 15 min behind a first-order lag."""
    from scipy.signal import lfilter

    gain = math.exp(-STEP_H / time_h)
    return lfilter([1.0 - gain], [1.0, -gain], values)


@pytest.mark.parametrize(
    ("name", "quantity", "kinds", "driver"),
    [
        ("pre-heating", "humidity", ("episode",), ""),
        ("hour", "temperature", ("hour",), ""),
        ("standstill", "temperature", ("regime", "episode", "since"), ""),
        ("wind", "temperature", ("level", "lag"), "wind_speed"),
        ("slow wind", "temperature", ("level", "lag"), "wind_speed"),
        ("step", "temperature", ("step",), ""),
        ("drift", "temperature", ("step", "drift", "season"), ""),
    ],
)
def test_what_is_hidden_is_named_first_in_five_of_six_records(
    name: str, quantity: str, kinds: tuple[str, ...], driver: str
) -> None:
    count = 0
    for seed in range(60, 66):
        base = made(seed)
        wind = base.drivers["wind_speed"]
        effect = {
            "pre-heating": 0.8 * base.preheating,
            "hour": 1.0 * np.exp(-0.5 * ((base.time_h % 24.0 - 14.5) / 2.0) ** 2),
            "standstill": 2.0 * behind((~base.operating).astype(float), 1.5),
            "wind": 0.2 * (wind - wind.mean()),
            "slow wind": 0.4 * behind(wind - wind.mean(), 4.0),
            "step": -1.0 * (base.time_h >= 600.0),
            "drift": 5.0 * (base.time_h / base.time_h[-1] - 0.5),
        }[name]
        count += named(findings(with_effect(base, quantity, effect)), quantity, kinds, driver)
    assert count >= 5


def test_a_peak_at_pre_heating_is_told_in_full() -> None:
    base = made(10)
    one = single(findings(with_effect(base, "humidity", 1.1 * base.preheating)))
    assert one.quantity == "humidity" and one.size == pytest.approx(1.1, abs=0.35)
    assert one.condition == ConditionCode.PREHEATED_AFTER_STOPS(stops=LONG_STOPS)
    assert one.side == "low" and one.lasting_h == pytest.approx(6.0, abs=2.0)
    assert one.statement == DiscoveryCode.SIMULATED_TOO_LOW_FOR(
        condition=one.condition, quantity="absolute humidity", size=one.size, unit="g/m³", hours=one.lasting_h
    )
    assert (one.n_episodes, one.n_possible) == (3, 3)
    assert one.sensor_share == pytest.approx((0.15 / one.size) ** 2)
    assert one.p_adjusted < 0.01
    json.dumps(plain(one))


def test_a_bump_of_the_day_is_told_by_its_hours_once() -> None:
    base = made(2)
    bump = 1.0 * np.exp(-0.5 * ((base.time_h % 24.0 - 14.5) / 2.0) ** 2)
    one = single(findings(with_effect(base, "temperature", bump)))
    assert (one.kind, one.quantity, one.side) == ("hour", "temperature", "low")
    assert one.condition.code is ConditionCode.HOURS_OF_THE_DAY and math.isnan(one.lasting_h)
    first, last = one.condition.values["first"], one.condition.values["last"]
    assert 11 <= first <= 14 < last <= 18
    assert one.n_possible == pytest.approx(60, abs=1)


def test_a_step_of_the_readings_is_dated_to_the_reading() -> None:
    base = made(3)
    at = 2400
    one = single(findings(with_effect(base, "temperature", -0.6 * (np.arange(len(base.time_h)) >= at))))
    assert one.kind == "step" and one.side == "high"
    assert one.size == pytest.approx(0.6, abs=0.25)
    assert one.condition == ConditionCode.SINCE_DATE(date=one.spans[0][0])
    assert one.statement.text.startswith("since 2020-08-09T00:00Z, simulated temperature is")
    assert one.spans[0][0] == pytest.approx(base.time_s[at], abs=3600.0)


@pytest.mark.parametrize("lag_h", [0.0, 6.0])
def test_an_error_that_follows_the_wind_is_told_by_the_wind(lag_h: float) -> None:
    base = made(4)
    wind = base.drivers["wind_speed"]
    effect = 0.4 * (np.roll(wind, int(lag_h / STEP_H)) - wind.mean())
    one = single(findings(with_effect(base, "temperature", effect)))
    assert (one.driver, one.quantity) == ("wind_speed", "temperature")
    assert one.kind in (("level",) if lag_h == 0 else ("lag",))
    below = one.condition.values["range"].code is ConditionCode.DRIVER_BELOW
    assert one.side == ("high" if below else "low")


def test_a_large_lasting_change_is_not_hidden_by_the_memory_that_it_feigns() -> None:
    base = made(5)
    slow = 1.0 / (1.0 + np.exp(-(base.time_h - 800.0) / 10.0))
    found = findings(with_effect(base, "temperature", 4.0 * slow))
    assert found
    assert found[0].kind in ("step", "drift", "season")
    assert found[0].size > 2.0


def test_two_effects_are_told_both_the_worse_first() -> None:
    base = made(6)
    two = with_effect(base, "humidity", 1.2 * base.preheating)
    bump = 1.2 * np.exp(-0.5 * ((base.time_h % 24.0 - 3.0) / 2.0) ** 2)
    found = findings(with_effect(two, "temperature", bump))
    assert [one.quantity for one in found] == ["humidity", "temperature"]
    rates = [one.size / two.rmse(one.quantity) for one in found]
    assert rates == sorted(rates, reverse=True)


def test_what_is_significant_but_small_is_not_told() -> None:
    """A clock of a twelfth of the RMSE over two years: sure, and not worth having."""
    base = made(7, days=240)
    wave = 0.14 * MATERIAL_SHARE * 1.5 * 4.0 * np.sin(base.time_h / 12.0 * math.pi)
    assert findings(with_effect(base, "temperature", wave)) == []
    assert findings(with_effect(base, "temperature", 5.0 * wave))


def test_what_the_sensors_explain_is_theirs() -> None:
    base = made(8)
    rough = replace(
        base,
        sensor_error={
            "temperature": np.full(len(base.time_h), 2.0),
            "humidity": base.sensor_error["humidity"],
        },
    )
    bump = 1.2 * np.exp(-0.5 * ((base.time_h % 24.0 - 14.5) / 2.0) ** 2)
    assert findings(with_effect(base, "temperature", bump))
    assert findings(with_effect(rough, "temperature", bump)) == []


def test_the_validation_period_is_left_alone() -> None:
    base = made(9)
    late = base.time_h > 40 * 24.0
    split = replace(base, validation=late)
    assert findings(with_effect(split, "temperature", 5.0 * late)) == []
    assert len(binned(split).time_h) == 40 * 24 + 1


def test_hardly_any_reading_gives_no_misfit() -> None:
    base = made(10)
    nothing = np.full(len(base.time_h), np.nan)
    few = np.where(base.time_h < 20.0, base.error["temperature"], np.nan)
    assert findings(replace(base, error={"temperature": few, "humidity": nothing})) == []


def test_errors_do_not_choose_their_own_condition() -> None:
    """No condition may be made from readings: other errors, the same conditions."""
    base = made(11)
    other = with_effect(base, "humidity", np.sin(base.time_h))
    for one, two in zip(conditions(binned(base)), conditions(binned(other)), strict=True):
        assert np.array_equal(one.bins, two.bins)
        assert np.array_equal(one.basis, two.basis, equal_nan=True)


# --- pieces ----------------------------------------------------------------------------------


def test_bins_of_an_hour_are_means() -> None:
    base = made(0)
    hours = binned(base)
    first = base.error["temperature"][:4]
    assert hours.error["temperature"][0] == pytest.approx(np.nanmean(first))
    assert hours.time_s[:3] == pytest.approx(ORIGIN_S + 3600.0 * np.array([0.5, 1.5, 2.5]))


def test_runs_and_durations() -> None:
    flag = np.array([0, 1, 1, 0, 1, 0, 0, 0, 0, 1], bool)
    assert run_lengths(flag) == [(1, 3), (4, 5), (9, 10)]
    assert run_lengths(closed(flag, 1.0)) == [(1, 5), (9, 10)]
    course = np.array([0.0, 0.2, 1.0, 0.8, 0.6, 0.1])
    assert duration_h(np.tile(course, 2), [(0, 6), (6, 12)], 0.5) == 1.5
    assert duration_h(np.ones(100), [(0, 100)], 1.0) != 0.0


def test_wind_from_north_belongs_to_both_ends_of_the_scale() -> None:
    base = made(13)
    random = np.random.default_rng(13)
    direction = (2.0 * math.pi + 1.5 * memory(random, len(base.time_h), 15.0)) % (2.0 * math.pi)
    blown = replace(base, drivers={**base.drivers, "wind_direction": direction})
    north = np.cos(direction) > math.cos(math.radians(40.0))
    one = findings(with_effect(blown, "temperature", 2.0 * north))[0]
    assert one.driver == "wind_direction"
    assert one.condition.code is ConditionCode.DIRECTION_OF_DRIVER
    assert one.condition.values["lower"] > 180.0 > one.condition.values["upper"]


# --- fitted plants ---------------------------------------------------------------------------


def saturated(record: Record) -> np.ndarray:
    """Vapour [kg/m³] of saturated air at the instants of the humidity readings."""
    humidity, temperature = record["cabinet_relative_humidity"], record["cabinet_temperature"]
    known = ~temperature.missing
    kelvin = np.interp(humidity.time, temperature.time[known], temperature.value[known])
    return saturation_pressure(kelvin) / (461.5 * kelvin)


def heated(record: Record, kelvin: np.ndarray) -> Record:
    """Cabinet readings that are warmer [K] and hold the same vapour."""
    old, humidity = record["cabinet_temperature"], record["cabinet_relative_humidity"]
    warm = record.replace_series(replace(old, value=old.value + kelvin))
    damp = humidity.value * saturated(record) / saturated(warm)
    return warm.replace_series(replace(humidity, value=np.clip(damp, 0.005, 1.05)))


def moistened(record: Record, kg_m3: np.ndarray) -> Record:
    """Humidity readings with more vapour [kg/m³]."""
    humidity = record["cabinet_relative_humidity"]
    damp = humidity.value + kg_m3 / saturated(record)
    return record.replace_series(replace(humidity, value=np.clip(damp, 0.005, 1.05)))


@cache
def bare(seed: int) -> Record:
    return to_record(plant(seed, days=75.0, sensor_errors="all", preheating=True))


def fitted(record: Record) -> tuple[Fit, Residuals]:
    fit = hygrokf.identify(record, starts=1, profiles=False)
    return fit, residuals(fit, record)


@cache
def peaked() -> tuple[Fit, Residuals, Record]:
    """A plant with 1 g/m³ more vapour in the readings while it is pre-heated."""
    record = bare(300)
    duty = record["preheating"]
    at = record["cabinet_relative_humidity"].time
    on = np.interp(at, duty.time[~duty.missing], duty.value[~duty.missing]) > 0.5
    record = moistened(record, 1e-3 * on)
    record = replace(record, until_s=record.start_s + 65.0 * 86400.0)
    return *fitted(record), record


def test_residuals_are_readings_less_the_free_run_where_it_is_scored() -> None:
    fit, found, record = peaked()
    series = fit.series
    scored = (series["scored"] > 0) & np.isfinite(series["temperature_measured"])
    assert np.array_equal(np.isfinite(found.error["temperature"]), scored)
    assert found.error["temperature"][scored] == pytest.approx(
        (series["temperature_measured"] - series["temperature_simulated"])[scored]
    )
    stated = fit.results.rmse
    assert found.rmse("temperature") == pytest.approx(stated["identification"]["temperature_K"].total)
    late = found.error["humidity"][found.validation]
    held_out = math.sqrt(np.nanmean(late**2))
    assert held_out == pytest.approx(stated["validation"]["absolute_humidity_g_m3"].total)
    assert found.time_s[found.validation].min() > record.until_s >= found.time_s[~found.validation].max()
    assert {"wind_speed", "global_horizontal_irradiance", "ambient_relative_humidity"} <= set(found.drivers)
    assert not any(
        name.startswith("cabinet_")
        for name in set(found.drivers) - {"cabinet_temperature", "cabinet_relative_humidity"}
    )
    speed = record["wind_speed"]
    place = np.searchsorted(found.time_s, speed.time[100:200])
    assert found.drivers["wind_speed"][place] == pytest.approx(speed.value[100:200])
    # 0.3 K inside and outside; 2 % of about 15 g/m³ inside and 9 g/m³ outside, as standard deviations
    assert found.sensor_error["temperature"] == pytest.approx(math.hypot(0.3, 0.3) / 1.96)
    assert 0.1 < math.sqrt(np.nanmean(found.sensor_error["humidity"] ** 2)) < 0.4


def test_residuals_of_a_fit_without_series_are_refused() -> None:
    fit, _, record = peaked()
    with pytest.raises(ValueError, match="identify again"):
        residuals(replace(fit, series={}), record)


def test_a_peak_at_pre_heating_survives_the_fit() -> None:
    one = findings(peaked()[1])[0]
    assert one.quantity == "humidity"
    assert one.side == "low"
    assert one.condition.code in (ConditionCode.PREHEATING, ConditionCode.PREHEATED_AFTER_STOPS)
    assert one.size == pytest.approx(1.0, abs=0.4)


def test_a_bump_of_the_day_survives_the_fit() -> None:
    record = bare(301)
    hour = (record["cabinet_temperature"].time / 3600.0) % 24.0
    _, found = fitted(heated(record, 0.8 * np.exp(-0.5 * ((hour - 14.5) / 2.2) ** 2)))
    one = findings(found)[0]
    assert (one.kind, one.quantity, one.side) == ("hour", "temperature", "low")


def test_a_step_of_a_sensor_survives_the_fit() -> None:
    record = bare(301)
    old = record["cabinet_temperature"]
    date = record.start_s + 33.0 * 86400.0
    _, found = fitted(record.replace_series(replace(old, value=old.value + 0.6 * (old.time >= date))))
    one = findings(found)[0]
    assert one.kind == "step"
    assert one.spans[0][0] == pytest.approx(date, abs=86400.0)


def test_an_error_that_follows_the_wind_survives_the_fit() -> None:
    from scipy.signal import lfilter

    record = bare(302)
    at, wind = record["cabinet_temperature"].time, record["wind_speed"]
    speed = np.interp(at, wind.time, wind.value)
    gain = math.exp(-0.25 / 3.0)
    slow = lfilter([1.0 - gain], [1.0, -gain], speed - speed.mean())
    _, found = fitted(heated(record, 0.5 * slow))
    one = findings(found)[0]
    assert (one.driver, one.quantity) == ("wind_speed", "temperature")


@pytest.mark.slow
def test_at_most_one_in_twenty_plants_without_a_cause_has_a_misfit() -> None:
    alarms = []
    for seed in range(200, 240):
        record = to_record(plant(seed, days=75.0, sensor_errors="all", preheating=seed % 2 == 0))
        _, found = fitted(record)
        if findings(found):
            alarms.append(seed)
    assert len(alarms) <= 2, alarms


# --- figures ---------------------------------------------------------------------------------


def drawn(figure, name: str) -> str:
    """The figure as text, after it has been drawn both ways."""
    assert png(figure, dpi=60).startswith(b"\x89PNG")
    return inline_svg(figure, name, name)


@pytest.mark.parametrize("overlaid", [False, True])
def test_every_figure_is_drawn_with_and_without_an_extended_model(overlaid: bool) -> None:
    base = made(10)
    hidden = with_effect(base, "humidity", 1.1 * base.preheating)
    after = base if overlaid else None
    one = single(findings(hidden))
    text = drawn(figure_episodes(hidden, one, after).figure(), "episodes")
    assert "under the condition" in text and one.condition.code is ConditionCode.PREHEATED_AFTER_STOPS
    assert ("before" in text) == overlaid
    assert len(figure_episodes(hidden, one, after).figure().axes) == 6
    panels = figure_drivers(hidden, ("wind_speed", "power"), after).figure()
    assert len(panels.axes) == 4
    assert "wind speed [m/s]" in drawn(panels, "drivers")
    assert len(figure_day_hour(hidden, "humidity", after).figure().axes) == (3 if overlaid else 2)
    drawn(figure_day_hour(hidden, "humidity", after).figure(), "map")


def test_a_lasting_misfit_is_drawn_over_the_whole_record() -> None:
    base = made(3)
    late = np.arange(len(base.time_h)) >= 2400
    hidden = with_effect(base, "temperature", 1.0 * late)
    figure = figure_episodes(hidden, single(findings(hidden))).figure()
    assert len(figure.axes) == 1
    low, high = figure.axes[0].get_xlim()
    assert high - low == pytest.approx(60.0, abs=1.0)


def test_the_map_shows_simulation_less_reading_at_its_day_and_hour() -> None:
    base = made(17)
    table = np.zeros(len(base.time_h))
    table[96 * 10 + 4 * 15 : 96 * 10 + 4 * 16] = -50.0
    shown = (
        figure_day_hour(with_effect(base, "temperature", table)).figure().axes[0].collections[0].get_array()
    )
    assert np.unravel_index(np.nanargmax(shown), shown.shape) == (15, 10)


def test_figures_without_data_say_so() -> None:
    base = made(10)
    nothing = np.full(len(base.time_h), np.nan)
    empty = replace(base, error=dict.fromkeys(base.error, nothing))
    one = single(findings(with_effect(base, "humidity", 1.1 * base.preheating)))
    for draw in (
        lambda r: figure_drivers(r, (), None), figure_day_hour,
        lambda r: figure_episodes(r, one),
    ):  # fmt: skip
        with pytest.raises(NothingToShow):
            draw(empty)
