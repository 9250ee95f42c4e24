"""What weather and operation may come: members begin where the readings end, spread, stay physical, and never
guess."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from builders.forecast_case import DAY_S, RATED_W, START_S, cabinet_record
from builders.record_edits import changed, without

from hygrokf.data.ambient import at_times
from hygrokf.data.prepared import prepare
from hygrokf.data.record import Record, Series
from hygrokf.live.scenarios import (
    ERROR_H,
    FEWEST_PAST_DAYS,
    FINE_S,
    FORECAST_MEMBERS,
    HORIZON_S,
    NoScenarios,
    Scenarios,
    grid,
    persistence,
    weather_forecast,
)
from hygrokf.physics.psychrometrics import relative_humidity
from hygrokf.texts.live_codes import BasisCode

DAYS = 20
NOW_S = START_S + DAYS * DAY_S
HOUR_S = 3600.0
AMBIENT = ("ambient_temperature", "ambient_absolute_humidity")


@pytest.fixture(scope="module")
def record() -> Record:
    return cabinet_record(DAYS)


def courses(scenarios: Scenarios, signal: str) -> np.ndarray:
    """Values (members, H)."""
    return np.array([member[signal] for member in scenarios.members])


def coming(record: Record, hours: float = 60.0, step_h: float = 3.0) -> dict[str, Series]:
    """A weather forecast from twelve hours ago on: 10 °C with a swing of 3 K, 7 g/m³ with one of 1 g/m³."""
    time = NOW_S + HOUR_S * np.arange(-12.0, hours + 0.1, step_h)
    swing = np.sin(2.0 * np.pi * time / DAY_S)
    return {
        "temperature": Series("ambient_temperature", time, 283.15 + 3.0 * swing),
        "vapour": Series("ambient_absolute_humidity", time, 7e-3 + 1e-3 * swing),
    }


# -- persistence ---------------------------------------------------------------------------------------------
def test_members_are_the_readings_up_to_now_and_go_on_from_them(record: Record) -> None:
    found = persistence(record, NOW_S)
    assert found.now_s == NOW_S and np.array_equal(found.time_s, grid(NOW_S))
    assert len(found.members) == DAYS - 2  # the oldest day's beginning lies three hours before it
    past = found.time_s <= NOW_S
    sources = (record["ambient_temperature"], prepare(record).ambient_vapour)
    for signal, series in zip(AMBIENT, sources, strict=True):
        read = at_times(series, found.time_s[past], 6.0)
        values = courses(found, signal)
        assert values[:, past] == pytest.approx(np.tile(read, (len(values), 1)), rel=1e-12)
        # the first half hour after now moves no more than any other does
        steps = np.abs(np.diff(values, axis=1))
        here = int(past.sum()) - 1
        assert steps[:, here].max() <= 1.5 * steps[:, here + 1 :].max()
        assert steps[:, here].mean() < 1.5 * steps[:, here + 1 :].mean()


def test_spread_grows_and_holds_the_deviation_of_today(record: Record) -> None:
    found = persistence(record, NOW_S)
    for signal in AMBIENT:
        spread = courses(found, signal).std(axis=0)
        at = [spread[np.searchsorted(found.time_s, NOW_S + HOUR_S * h)] for h in (0, 1, 6, 24)]
        assert at[0] < 1e-9 * abs(courses(found, signal)).max()
        assert at[1] < 0.5 * min(at[2], at[3])
    # a day that is 6 K too warm stays so for the next hours and is forgotten in a day or two
    warm = changed(
        record, "ambient_temperature", record["ambient_temperature"].value + 6.0, NOW_S - 0.6 * DAY_S
    )
    more = courses(persistence(warm, NOW_S), AMBIENT[0]).mean(axis=0) - courses(found, AMBIENT[0]).mean(
        axis=0
    )
    ahead = (found.time_s - NOW_S) / HOUR_S
    assert more[ahead == 0] == pytest.approx(6.0, abs=1e-9)
    assert more[ahead == 2] > 4.0 and more[ahead == 48] < 3.0


def test_no_member_is_moister_than_saturated() -> None:
    moist = cabinet_record(DAYS, moisture=0.35)
    found = persistence(moist, NOW_S)
    kelvin, vapour = (courses(found, signal) for signal in AMBIENT)
    humidity = relative_humidity(vapour, kelvin)
    assert humidity.max() == pytest.approx(1.0, abs=1e-9)  # some would be
    assert (humidity > 1.0 - 1e-9).any(axis=1).sum() > 5


def test_air_that_is_never_saturated_is_not_expected_to_be() -> None:
    """Air that is half of the time between 93 and 97 % relative humidity, and never above: members know it.

    Drawn as vapour and cut at saturation, 8 % of them were above 99 %.
    """
    moist = cabinet_record(DAYS + 40.0, moisture=0.35)
    series = moist["ambient_relative_humidity"]
    never = moist.replace_series(replace(series, value=0.97 * np.minimum(series.value, 1.0)))
    near, above = [], []
    for day in range(40):
        found = persistence(never, NOW_S + day * DAY_S)
        ahead = found.time_s > NOW_S + day * DAY_S
        kelvin, vapour = (courses(found, signal)[:, ahead] for signal in AMBIENT)
        humidity = relative_humidity(vapour, kelvin)
        near.append((humidity > 0.93).mean())
        above.append((humidity > 0.99).mean())
    came = series.time > NOW_S
    share = (0.97 * series.value[came] > 0.93).mean()
    assert 0.3 < share and np.mean(near) == pytest.approx(share, abs=0.1)
    assert np.mean(above) < 0.02


def test_what_comes_after_now_is_not_looked_at(record: Record) -> None:
    early = NOW_S - 2.3 * DAY_S  # between two readings
    known = persistence(record.window(START_S, early), early)
    leaked = persistence(record, early)
    for one, other in zip(known.members, leaked.members, strict=True):
        for name in one:
            assert one[name] == pytest.approx(other[name], abs=1e-9), name


@pytest.mark.parametrize(
    ("days", "known"), [(1, 0), (3, 1), (FEWEST_PAST_DAYS + 11 / 12, FEWEST_PAST_DAYS - 1)]
)
def test_too_little_history_gives_words(days: float, known: int) -> None:
    short = cabinet_record(days)
    with pytest.raises(NoScenarios, match=rf"needs {FEWEST_PAST_DAYS} complete days .* found {known}$"):
        persistence(short, START_S + days * DAY_S)


def test_what_is_not_known_gives_words(record: Record) -> None:
    for absent in ("ambient_temperature", "ambient_relative_humidity"):
        with pytest.raises(NoScenarios, match="ambient's temperature and humidity"):
            persistence(without(record, absent), NOW_S)
    with pytest.raises(NoScenarios, match="rain, wind_speed"):
        persistence(record, NOW_S, ("wind_speed", "rain"))
    for signal in ("ambient_temperature", "ambient_relative_humidity"):
        with pytest.raises(NoScenarios, match=r"found 0$"):
            persistence(changed(record, signal, np.nan), NOW_S)
        with pytest.raises(NoScenarios, match="ambient within the last 6 h"):
            persistence(changed(record, signal, np.nan, NOW_S - 7 * HOUR_S), NOW_S)
    with pytest.raises(NoScenarios, match="within the last 6 h"):
        persistence(record, NOW_S + 3 * DAY_S)


def test_an_outage_of_some_hours_is_bridged(record: Record) -> None:
    found = persistence(changed(record, "ambient_temperature", np.nan, NOW_S - 4 * HOUR_S), NOW_S)
    last = record["ambient_temperature"].value[record["ambient_temperature"].time <= NOW_S - 4 * HOUR_S][-1]
    assert courses(found, AMBIENT[0])[:, found.time_s == NOW_S] == pytest.approx(last)


def test_gaps_take_their_days_out(record: Record) -> None:
    whole = len(persistence(record, NOW_S).members)
    gap = changed(record, "ambient_relative_humidity", np.nan, NOW_S - 9.5 * DAY_S, NOW_S - 9.1 * DAY_S)
    assert whole - 4 <= len(persistence(gap, NOW_S).members) <= whole - 2
    short = changed(record, "ambient_relative_humidity", np.nan, NOW_S - 9.5 * DAY_S, NOW_S - 9.3 * DAY_S)
    assert len(persistence(short, NOW_S).members) == whole


@pytest.mark.parametrize("humidity", [-0.3, 0.0, 1.4])
def test_odd_humidities_stay_physical(record: Record, humidity: float) -> None:
    found = persistence(changed(record, "ambient_relative_humidity", humidity), NOW_S)
    kelvin, vapour = (courses(found, signal) for signal in AMBIENT)
    assert np.all(vapour > 0.0) and np.all(relative_humidity(vapour, kelvin) <= 1.0 + 1e-9)


def test_means_of_the_ambient_stand_in_the_middle_of_their_interval() -> None:
    time = START_S + HOUR_S * np.arange(1, 24 * DAYS + 1)
    middle = time - 0.5 * HOUR_S
    kelvin = 283.0 + 3.0 * np.sin(2.0 * np.pi * middle / DAY_S)
    means = {"hold": "mean", "interval_s": HOUR_S}
    hourly = Record(
        "hourly",
        (
            Series("ambient_temperature", time, kelvin, **means),
            Series("ambient_absolute_humidity", time, np.full(len(time), 6e-3), **means),
        ),
    )
    found = persistence(hourly, NOW_S)
    expected = 283.0 + 3.0 * np.sin(2.0 * np.pi * found.time_s / DAY_S)
    # the last mean is half an hour old
    assert courses(found, AMBIENT[0]) == pytest.approx(np.tile(expected, (len(found.members), 1)), abs=0.5)
    assert found.basis.values["operation"] == BasisCode.OPERATION_UNKNOWN()


# -- operation -----------------------------------------------------------------------------------------------
def daily(record: Record, now_s: float) -> Record:
    """A turbine that runs from six to six."""
    hour = np.mod(record["active_power"].time - 1.0, DAY_S) / HOUR_S
    return changed(
        record, "active_power", np.where((hour > 6.0) & (hour <= 18.0), 0.5 * RATED_W, -5e3)
    ).window(START_S, now_s)


def test_operation_is_that_of_days_that_began_alike(record: Record) -> None:
    noon = NOW_S - 0.5 * DAY_S
    found = persistence(daily(record, noon), noon)
    assert found.basis.values["operation"] == BasisCode.OPERATION_OF_ALIKE_DAYS()
    power = courses(found, "active_power")
    hour = np.mod(found.time_s - 1.0, DAY_S) / HOUR_S
    assert np.all((power > 0.0) == ((hour > 6.0) & (hour <= 18.0)))
    # today it feeds more: that goes on for a while
    more = persistence(changed(daily(record, noon), "active_power", 0.8 * RATED_W, noon - 2 * HOUR_S), noon)
    after = courses(more, "active_power")[:, more.time_s > noon]
    assert np.all(np.abs(after[:, 0] - 0.8 * RATED_W) < 0.05 * RATED_W)
    assert np.all(after <= RATED_W) and np.all(after[:, 49] == pytest.approx(0.5 * RATED_W, rel=0.01))


def test_what_runs_low_now_does_not_stand_still_later(record: Record) -> None:
    noon = NOW_S - 0.5 * DAY_S
    low = persistence(changed(daily(record, noon), "active_power", 2e3, noon - 2 * HOUR_S), noon)
    hour = np.mod(low.time_s - 1.0, DAY_S) / HOUR_S
    power = courses(low, "active_power")
    assert np.all(power[:, (hour > 6.0) & (hour <= 18.0)] > 0.0)


def test_a_standstill_that_no_other_was_like_may_last_as_long_again(record: Record) -> None:
    """Nobody knows when it ends: half of those that have lasted for some hours last for as many more."""
    steady = changed(changed(record, "active_power", 0.5 * RATED_W), "preheating", 0.0)
    stands = changed(steady, "active_power", -5e3, NOW_S - 5 * HOUR_S)
    found = persistence(stands, NOW_S)
    assert found.basis.values["operation"] == BasisCode.STANDSTILL_MAY_END(count=0)
    ahead = (found.time_s - NOW_S) / HOUR_S
    still = (courses(found, "active_power") <= 0.0).mean(axis=0)
    for hours in (0.5, 5.0, 20.0, 48.0):
        assert still[ahead == hours] == pytest.approx(5.0 / (5.0 + hours), abs=0.06)
    assert np.all(np.diff(still[ahead > 0.0]) <= 0.0)
    power = courses(found, "active_power")[:, ahead > 0.0]
    assert np.all((power == 0.0) | (power == 0.5 * RATED_W))
    # one that has lasted for days goes on, all but surely, for the next hours
    longer = persistence(changed(steady, "active_power", -5e3, NOW_S - 6 * DAY_S), NOW_S)
    assert (courses(longer, "active_power")[:, ahead == 3.0] <= 0.0).all()


def test_a_standstill_ends_as_others_did(record: Record) -> None:
    """Every night from six to six: at midnight it will last six hours more."""
    found = persistence(daily(record, NOW_S), NOW_S)
    assert found.basis.values["operation"] == BasisCode.STANDSTILL_MAY_END(count=18)
    hour = np.mod(found.time_s - 1.0, DAY_S) / HOUR_S
    runs = (hour > 6.0) & (hour <= 18.0)
    agree = ((courses(found, "active_power") > 0.0) == runs).all(axis=1)
    assert agree.all()
    # a standstill that had ended by then is no example for one that has lasted longer
    longer = changed(daily(record, NOW_S), "active_power", -5e3, NOW_S - 0.9 * DAY_S)
    assert persistence(longer, NOW_S).basis.values["operation"] == BasisCode.STANDSTILL_MAY_END(count=0)


def test_a_pre_heating_that_followed_a_standstill_may_follow_again(record: Record) -> None:
    steady = changed(changed(record, "active_power", 0.5 * RATED_W), "preheating", 0.0)
    for days in (4, 7, 11):  # standstills of ten hours, heated in their last two
        begin = NOW_S - days * DAY_S
        steady = changed(steady, "active_power", -5e3, begin, begin + 10 * HOUR_S)
        steady = changed(steady, "preheating", 1.0, begin + 8 * HOUR_S, begin + 10 * HOUR_S)
    found = persistence(changed(steady, "active_power", -5e3, NOW_S - 5 * HOUR_S), NOW_S)
    ahead = (found.time_s - NOW_S) / HOUR_S
    heated = courses(found, "preheating")[:, (ahead > 3.4) & (ahead < 4.9)].all(axis=1)
    assert heated.mean() == pytest.approx(0.75, abs=0.06)  # three such, and one that nobody knows
    assert not courses(found, "preheating")[:, ahead > 24.0].all(axis=1).any()


def test_operation_goes_on_where_too_few_days_say_more(record: Record) -> None:
    stood = changed(changed(record, "active_power", -5e3), "active_power", 0.3 * RATED_W, NOW_S - DAY_S / 4)
    found = persistence(stood, NOW_S)
    assert found.basis.values["operation"] == BasisCode.OPERATION_AS_NOW()
    assert np.all(courses(found, "active_power")[:, found.time_s > NOW_S] == 0.3 * RATED_W)


def test_an_unknown_power_is_no_standstill(record: Record) -> None:
    gap = NOW_S - 9.5 * DAY_S, NOW_S - 8.0 * DAY_S
    steady = changed(record, "active_power", 0.5 * RATED_W)
    found = persistence(changed(steady, "active_power", np.nan, *gap), NOW_S)
    assert np.all(courses(found, "active_power") > 0.0)
    lost = persistence(changed(steady, "active_power", np.nan, NOW_S - 2 * DAY_S), NOW_S)
    assert lost.basis.values["operation"] == BasisCode.PRESENT_POWER_UNKNOWN()
    assert np.all(courses(lost, "active_power") == 0.5 * RATED_W)
    for never in (changed(record, "active_power", np.nan), without(record, "active_power")):
        found = persistence(never, NOW_S)
        assert found.basis.values["operation"] == BasisCode.OPERATION_UNKNOWN()
        assert all(set(member) == {*AMBIENT, "preheating"} for member in found.members)


@pytest.mark.parametrize("power", [0.5 * RATED_W, -5e3, np.nan])
@pytest.mark.parametrize("since_s", [-np.inf, NOW_S - DAY_S])
def test_a_pre_heating_that_is_not_known_is_off(record: Record, power: float, since_s: float) -> None:
    never = changed(record, "preheating", 0.0)
    unknown = changed(never, "preheating", np.nan, since_s)
    found = persistence(changed(unknown, "active_power", power, NOW_S - 7 * HOUR_S), NOW_S)
    for member in found.members:
        assert all(np.isfinite(values).all() for values in member.values())
        assert not member.get("preheating", np.zeros(1)).any()


def test_other_signals_are_those_of_the_same_days(record: Record) -> None:
    time = record["active_power"].time
    wind = Series("wind_speed", time, np.floor((time - START_S) / DAY_S) + 1.0)
    rain = Series("rain", time, np.where(time < NOW_S - 5 * DAY_S, np.nan, 0.2))
    more = replace(record, series=(*record.series, wind, rain))
    found = persistence(more, NOW_S, ("wind_speed",))
    first = found.time_s == NOW_S + 12 * HOUR_S
    assert sorted({int(v) for v in courses(found, "wind_speed")[:, first].ravel()}) == list(range(2, DAYS))
    assert np.all(
        courses(found, "rain") == pytest.approx(0.2)
    )  # where unknown, the mean: as the features have it
    with pytest.raises(NoScenarios, match=r"found 3$"):
        persistence(more, NOW_S, ("rain",))


def test_heating_from_now_on(record: Record) -> None:
    for given in (record, without(record, "preheating", "active_power")):
        found = persistence(given, NOW_S).with_preheating(25.0)
        assert np.all(np.diff(found.time_s) == FINE_S) and found.time_s[-1] == NOW_S + 25 * HOUR_S
        after = found.time_s > NOW_S
        for member in found.members:
            assert np.all(member["active_power"][after] == 0.0) and np.all(member["preheating"][after] == 1.0)
            assert np.all(member["preheating"][~after] == 0.0)


# -- around a weather forecast -------------------------------------------------------------------------------
def test_a_weather_forecast_is_followed_and_its_present_error_fades(record: Record) -> None:
    told = coming(record)
    exact = weather_forecast(record, NOW_S, told, error={"temperature_K": 0.0, "vapour": 0.0})
    assert exact.basis.code is BasisCode.WEATHER_FORECAST and len(exact.members) == FORECAST_MEMBERS
    assert exact.time_s[-1] == NOW_S + HORIZON_S
    kelvin = courses(exact, AMBIENT[0])
    assert np.ptp(kelvin, axis=0).max() == 0.0
    off = record["ambient_temperature"].value[-1] - at_times(told["temperature"], np.array([NOW_S]), 6.0)
    assert abs(off) > 0.5
    for hours in (0.0, 3.0, 24.0, 48.0):
        here = exact.time_s == NOW_S + HOUR_S * hours
        expected = at_times(told["temperature"], exact.time_s[here], 6.0) + off * np.exp(-hours / ERROR_H)
        assert kelvin[0, here] == pytest.approx(expected, abs=0.02)


def test_its_errors_are_as_large_as_stated(record: Record) -> None:
    told = coming(record)
    error = {"temperature_K": 2.0, "vapour": 0.1}
    drawn = [weather_forecast(record, NOW_S, told, error=error, seed=seed) for seed in range(20)]
    kelvin = np.concatenate([courses(one, AMBIENT[0]) for one in drawn])
    vapour = np.log(np.concatenate([courses(one, AMBIENT[1]) for one in drawn]))
    ahead = (drawn[0].time_s - NOW_S) / HOUR_S
    for values, sd in ((kelvin, 2.0), (vapour, 0.1)):
        assert values[:, ahead == 0].std() < 1e-9
        assert values[:, ahead == 48].std() == pytest.approx(sd, rel=0.1)
        early = values[:, ahead == 3].std()
        assert early == pytest.approx(sd * np.sqrt(1.0 - np.exp(-6.0 / ERROR_H)), rel=0.1)


def test_the_same_seed_draws_the_same(record: Record) -> None:
    one, same, other = (
        courses(weather_forecast(record, NOW_S, coming(record), seed=s), AMBIENT[0]) for s in (3, 3, 4)
    )
    assert np.array_equal(one, same) and not np.array_equal(one, other)


def test_a_forecast_that_is_of_no_use_gives_words(record: Record) -> None:
    with pytest.raises(NoScenarios, match="ends within a day"):
        weather_forecast(record, NOW_S, coming(record, hours=18.0))
    with pytest.raises(NoScenarios, match="has no vapour"):
        weather_forecast(record, NOW_S, {"temperature": coming(record)["temperature"]})
    with pytest.raises(NoScenarios, match="has no temperature and no vapour"):
        weather_forecast(record, NOW_S, {})
    late = NOW_S + 2 * DAY_S
    with pytest.raises(NoScenarios, match="nor the ambient readings cover the present"):
        weather_forecast(
            record, late, {n: replace(s, value=s.value * np.nan) for n, s in coming(record).items()}
        )
    shorter = weather_forecast(record, NOW_S, coming(record, hours=30.0))
    assert shorter.time_s[-1] == NOW_S + 30 * HOUR_S
    assert all(len(values) == len(shorter.time_s) for member in shorter.members for values in member.values())


def test_a_forecast_serves_where_the_ambient_is_not_read(record: Record) -> None:
    """Readings that end ten hours ago: from then on the forecast says what it is, less and less surely."""
    told = coming(record)
    lost = record
    for signal in ("ambient_temperature", "ambient_relative_humidity"):
        lost = changed(lost, signal, np.nan, NOW_S - 10 * HOUR_S)
    found = weather_forecast(lost, NOW_S, told)
    assert courses(found, AMBIENT[0])[:, found.time_s == NOW_S].std() > 0.5
    assert (
        weather_forecast(
            cabinet_record(1.0),
            START_S + DAY_S,
            {name: replace(series, time=series.time - (DAYS - 1) * DAY_S) for name, series in told.items()},
        ).basis.values["operation"]
        == BasisCode.OPERATION_AS_NOW()
    )  # needs no history
