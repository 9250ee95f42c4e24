"""Power in a climate: by wind, by season, none; and files of it that are wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builders.climate_case import BEGIN_S, known_fit, made_up_weather
from builders.documents import document

from hygrokf.climate.chamber import ProfilePlan
from hygrokf.climate.limits import limits_of
from hygrokf.climate.region import (
    PowerCurve,
    PowerFault,
    driven,
    power_by_season,
    power_from_wind,
    read_power,
    standstill,
)
from hygrokf.data.record import Record, Series
from hygrokf.data.toml_form import FormFault, read_toml_form
from hygrokf.texts.climate_codes import ClimateCode
from hygrokf.texts.statement import Statement
from hygrokf.texts.wording import day_text

CURVE = """\
rated_power_kW = 2000
wind_speed_m_s = [0, 3, 12, 25]
power_kW = [0, 0, 2000, 2000]
hub_height_m = 80
wind_height_m = 10
shear = { law = "log", roughness_m = 0.03 }
"""


def curve_file(folder: Path, text: str = CURVE) -> Path:
    file = folder / "curve.toml"
    file.write_text(text)
    return file


def test_wind_is_brought_to_hub_height(tmp_path: Path) -> None:
    """ln(80/0.03)/ln(10/0.03) = 1.35797; (80/10)^0.2 = 1.51572."""
    curve = read_toml_form(PowerCurve, curve_file(tmp_path))
    assert curve.factor == pytest.approx(1.35797, rel=1e-5)
    law = ClimateCode.LOGARITHMIC_LAW(roughness_m=0.03)
    assert curve.statement == ClimateCode.POWER_BY_CURVE(
        wind_height_m=10.0, hub_height_m=80.0, law=law, factor=curve.factor
    )
    hub = np.array([7.5, 26.0]) / curve.factor
    assert curve.power(hub) == pytest.approx([1e6, 0.0])
    assert np.isnan(curve.power(np.array([np.nan]))).all()
    power = CURVE.replace('{ law = "log", roughness_m = 0.03 }', '{ law = "power", exponent = 0.2 }')
    assert read_toml_form(PowerCurve, curve_file(tmp_path, power)).factor == pytest.approx(1.51572, rel=1e-5)


def test_power_follows_the_wind_of_the_same_hour(tmp_path: Path) -> None:
    weather = made_up_weather()
    curve = read_toml_form(PowerCurve, curve_file(tmp_path))
    found = power_from_wind(curve, weather)
    wind = weather["wind_speed"]
    hour = 1000
    end = BEGIN_S + 3600.0 * (hour + 1)
    place = int(np.searchsorted(found.time, end))
    middle = 0.5 * (wind.value[hour] + wind.value[hour + 1])
    assert found.value[place] == pytest.approx(curve.power(np.array([middle]))[0])
    still = replace(weather, series=weather.series[:2])
    with pytest.raises(PowerFault, match="expected a wind speed"):
        power_from_wind(curve, still)


def test_a_curve_for_wind_at_another_height_is_refused(tmp_path: Path) -> None:
    weather = made_up_weather()

    def at(height_m: float | None) -> Record:
        return replace(
            weather, series=(*weather.series[:2], replace(weather["wind_speed"], height_m=height_m))
        )

    curve = read_toml_form(PowerCurve, curve_file(tmp_path))
    for same in (10.0, None):
        assert power_from_wind(curve, at(same)) == power_from_wind(curve, weather)
    with pytest.raises(PowerFault, match=r"at 100 m, .* wind_height_m = 10; write wind_height_m = 100 into"):
        power_from_wind(curve, at(100.0))
    with pytest.raises(ValueError, match="height_m must be"):
        at(0.0)
    with pytest.raises(FormFault, match=r"found 90; are they in km/h\? divide by 3.6"):
        read_toml_form(PowerCurve, curve_file(tmp_path, CURVE.replace("12, 25]", "43, 90]")))


def test_a_curve_that_is_wrong_tells_all_faults(tmp_path: Path) -> None:
    text = "rated_power_kW = -1\nwind_speed_m_s = [3, 2]\npower_kW = [0]\nhub_height_m = 80\nspeed = 1\n"
    with pytest.raises(FormFault) as told:
        read_toml_form(PowerCurve, curve_file(tmp_path, text))
    assert len(told.value.faults) >= 5 and "wind_height_m" in str(told.value) and "shear" in str(told.value)
    with pytest.raises(FormFault, match="expected rising"):
        read_toml_form(PowerCurve, curve_file(tmp_path, CURVE.replace("[0, 3, 12, 25]", "[0, 12, 3, 25]")))
    for wrong in ("roughness_m = 12", 'roughness_m = "a"', "exponent = 0.1"):
        with pytest.raises(FormFault, match="roughness_m"):
            read_toml_form(PowerCurve, curve_file(tmp_path, CURVE.replace("roughness_m = 0.03", wrong)))
    with pytest.raises(FormFault, match="law must be one of power, log"):
        read_toml_form(PowerCurve, curve_file(tmp_path, CURVE.replace('"log"', '["log"]')))
    for megawatts in ("[0, 0, 2, 2]", "[0, 0, 4000, 4000]"):
        with pytest.raises(FormFault, match="are both in kW"):
            read_toml_form(PowerCurve, curve_file(tmp_path, CURVE.replace("[0, 0, 2000, 2000]", megawatts)))
    with pytest.raises(FormFault, match="check the path"):
        read_toml_form(PowerCurve, tmp_path / "none.toml")


def hourly_power(first: str, days: int, value: np.ndarray | None = None) -> Series:
    begin = float(np.datetime64(first, "s").astype(int))
    time = begin + 3600.0 * np.arange(1, 24 * days + 1)
    return Series(
        "active_power",
        time,
        np.arange(24.0 * days) if value is None else value,
        "mean",
        3600.0,
        source="p.csv",
    )


def test_power_of_the_same_time_is_taken_as_it_is() -> None:
    power = hourly_power("2020-12-30T00:00:00", 400)
    found, statement = power_by_season(power, made_up_weather())
    assert found is power and statement == ClimateCode.POWER_BY_RECORD()


def test_power_of_another_year_is_taken_by_day_and_hour_of_the_year() -> None:
    power = hourly_power("2018-01-01T00:00:00", 365)
    found, statement = power_by_season(power, made_up_weather())
    assert statement.code is ClimateCode.POWER_BY_SEASON
    # 1 July 2021, 12 … 13 o'clock: the 182nd day, give or take the leap day that lies between
    at = float(np.datetime64("2021-07-01T13:00:00", "s").astype(int))
    value = found.value[np.searchsorted(found.time, at)]
    assert (value % 24, value // 24) == (12, 181)
    with pytest.raises(PowerFault, match="use --power-curve, or a longer record"):
        power_by_season(hourly_power("2018-01-01T00:00:00", 100), made_up_weather())


def test_which_part_of_the_power_was_used_is_said() -> None:
    """731 days of power for one year of weather: the arithmetic of whole years takes the second."""

    def used(first: str, days: int) -> Statement:
        return power_by_season(hourly_power(first, days), made_up_weather())[1].values["used"]

    one = used("2018-01-01T00:00:00", 731)
    assert one.code is ClimateCode.POWER_PARTLY_USED
    assert [span.text for span in one.values["spans"]] == ["2019-01-01 … 2020-01-01"]
    assert [day_text(one.values[end]) for end in ("first", "last")] == ["2018-01-01", "2020-01-02"]
    assert used("2018-01-01T00:00:00", 365).code is ClimateCode.POWER_ALL_USED
    # begun in summer: the first half of the weather's year has the power of one year, the second that of
    # another
    two = used("2017-07-01T00:00:00", 731)
    assert two.code is ClimateCode.POWER_PARTLY_USED and len(two.values["spans"]) == 2


@pytest.mark.parametrize("year", [1981, 2001, 2018, 2041])
def test_the_day_of_the_year_stays_however_far_the_power_is(year: int) -> None:
    """Its value is the day that it stands for; the calendar's leap days move it by one at most, and no hour
    is held."""
    days = np.repeat(np.arange(365.0), 24)
    found, _ = power_by_season(hourly_power(f"{year}-01-01T00:00:00", 365, days), made_up_weather())
    wanted = np.floor((found.time - 1.0 - BEGIN_S) / 86400.0)
    inside = (wanted >= 1) & (wanted <= 363)
    assert np.abs(found.value - wanted)[inside].max() <= 1
    assert np.unique(found.value, return_counts=True)[1].max() <= 48


def test_days_that_a_power_lacks_are_unknown() -> None:
    """A record of 348 days says nothing of the last fortnight; its last hour must not stand for them."""
    power = hourly_power("2018-01-01T00:00:00", 348, np.full(24 * 348, 2e6))
    found, _ = power_by_season(power, made_up_weather())
    assert 15 * 24 <= np.isnan(found.value).sum() <= 18 * 24
    assert np.isfinite(found.value[: 24 * 345]).all()


def test_what_drives_a_cabinet_is_said() -> None:
    weather, fit = made_up_weather(), known_fit()
    record, said = driven(fit, weather, None)
    assert (record["active_power"].value == 0).all() and said == [ClimateCode.NO_POWER_ALL_YEAR()]
    assert np.array_equal(record["active_power"].value, standstill(weather).value)
    power = Record("p", (hourly_power("2020-12-30T00:00:00", 400),), rated_power_W=3e6)
    record, said = driven(fit, weather, power)
    assert said[0] == ClimateCode.POWER_BY_RECORD()
    assert said[1] == ClimateCode.RATED_DIFFERENTLY(rated_kW=3000.0, scale_kW=2000.0)
    blind = replace(fit, design=replace(fit.design, power_scale_W=None))
    record, said = driven(blind, weather, power)
    assert "active_power" not in record and said[0] == ClimateCode.NO_POWER_INPUT()


def test_pre_heating_goes_with_its_power() -> None:
    weather, fit = made_up_weather(), known_fit()
    mechanisms = tuple(
        (name, {**more, "preheating": True}) if name == "heat_release" else (name, more)
        for name, more in fit.design.mechanisms
    )
    fit = replace(fit, design=replace(fit.design, mechanisms=mechanisms))
    assert "preheating" in fit.design.model.inputs

    def power(first: str, *, heated: bool = True) -> Record:
        one = hourly_power(first, 400, np.full(24 * 400, 2e6))
        duty = replace(one, signal="preheating", value=np.arange(24 * 400) % 24 < 2)
        return Record("p", (one, duty) if heated else (one,), rated_power_W=2e6)

    record, said = driven(fit, weather, power("2020-12-30T00:00:00"))
    assert record["preheating"].value.sum() == 800 and any(
        one == ClimateCode.ACTUATOR_BY_RECORD(actuator="pre-heating") for one in said
    )
    for other, code in (
        (power("2016-12-30T00:00:00"), ClimateCode.ACTUATOR_NOT_COVERED),
        (power("2020-12-30T00:00:00", heated=False), ClimateCode.ACTUATOR_NOT_RECORDED),
        (None, ClimateCode.ACTUATOR_NOT_RECORDED),
    ):
        record, said = driven(fit, weather, other)
        assert not record["preheating"].value.any()
        assert any(one == code(actuator="pre-heating") for one in said)


def test_weather_every_three_hours_becomes_hourly() -> None:
    weather = made_up_weather()
    coarse = replace(
        weather, series=tuple(replace(s, time=s.time[::3], value=s.value[::3]) for s in weather.series)
    )
    record, _ = driven(known_fit(), coarse, None)
    series = record["ambient_temperature"]
    assert np.all(np.diff(series.time) == 3600.0)
    assert series.value[::3] == pytest.approx(coarse["ambient_temperature"].value)


def test_a_case_file_of_power_alone_is_read(tmp_path: Path) -> None:
    rows = "\n".join(f"2021-01-{d:02d}T{h:02d}:00Z,{100 * h}" for d in range(1, 5) for h in range(24))
    (tmp_path / "power.csv").write_text("time,P\n" + rows + "\n")
    case = tmp_path / "power.toml"
    case.write_text(
        'rated_power_kW = 2400\n[[source]]\nfile = "power.csv"\ntime = "time"\nstamp = "start"\n'
        'signals.active_power = { column = "P", unit = "kW" }\n'
    )
    record = read_power(case)
    assert record.signals == ("active_power",) and record["active_power"].interval_s == 3600.0
    assert record["active_power"].value[:3] == pytest.approx([0.0, 1e5, 2e5])


def test_limits_are_read_and_all_faults_told(tmp_path: Path) -> None:
    file = tmp_path / "limits.toml"
    file.write_text(
        '[[limit]]\nquantity = "temperature_degC"\nabove = 45\nduring = "operation"\n'
        '[[limit]]\nname = "damp"\nquantity = "relative_humidity_percent"\nabove = 95\nhours_a_year = 50\n'
    )
    hot, damp = limits_of(file)
    assert hot.name == "temperature above 45 °C in operation" and damp.hours_a_year == 50.0
    file.write_text(
        '[[limit]]\nquantity = "heat"\nabove = 1\nbelow = 2\n[[limit]]\nquantity = '
        '"temperature_rate_K_per_h"\nbelow = 1\nhours_a_year = -1\nduring = "night"\nwhen = 3\n'
    )
    with pytest.raises(FormFault) as told:
        limits_of(file)
    assert len(told.value.faults) == 6, told.value
    file.write_text("limits = 3\n")
    with pytest.raises(FormFault, match="at least one"):
        limits_of(file)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ('[[limit]]\nquantity = ["temperature_degC"]\nabove = 4\n', "quantity must be one of"),
        ("[[limit]]\nquantity = { a = 1 }\nabove = 4\n", "quantity must be one of"),
        (
            f'[[limit]]\nquantity = "temperature_degC"\nabove = 1{"0" * 400}\n',
            "above must be a number, found 1000",
        ),
        ('[[limit]]\nquantity = "temperature_degC"\nabove = inf\n', "above must be a number, found inf"),
        ('[[limit]]\nquantity = "relative_humidity_percent"\nabove = 0.85\n', "write above = 85"),
        (f"x = {'9' * 5000}\n", "not valid TOML"),
        (f"x = {'[' * 20000}{']' * 20000}\n", "not valid TOML"),
        (
            '[[limit]]\nname = "a"\nquantity = "temperature_degC"\nabove = 4\n'
            '[[limit]]\nname = "a"\nquantity = "temperature_degC"\nabove = 5\n',
            'two limits are called "a"',
        ),
    ],
)
def test_whatever_stands_in_a_file_of_limits_is_told(text: str, told: str, tmp_path: Path) -> None:
    file = tmp_path / "limits.toml"
    file.write_text(text)
    with pytest.raises(FormFault, match=told) as found:
        limits_of(file)
    assert len(found.value.faults) == 1 and found.value.file == str(file)


def test_the_example_files_of_the_docs_are_read() -> None:
    assert len(limits_of(document("climate_limits.toml"))) == 5
    assert read_toml_form(ProfilePlan, document("climate_test.toml")) == ProfilePlan()
