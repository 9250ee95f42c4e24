"""What a climate says beside its numbers: years, limits, members, power, and what the model lacks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders.climate_case import (
    climate_of,
    hourly_power,
    known_fit,
    made_up_weather,
    small_study,
    study_of,
)
from builders.weather_case import epw_text

from hygrokf.climate.chamber import Chamber, ProfileLength, ProfilePlan
from hygrokf.climate.ensemble import WHOLE_SHARE, years_of
from hygrokf.climate.limits import ClimateLimit
from hygrokf.climate.region import read_region
from hygrokf.climate.study import RegionClimate, profile_files
from hygrokf.data.record import Record, Series
from hygrokf.texts.climate_codes import ClimateCode
from hygrokf.texts.statement import Code


def codes(region: RegionClimate) -> set[Code]:
    return {one.code for one in region.statements}


def moved(weather: Record, days: float) -> Record:
    return replace(weather, series=tuple(replace(s, time=s.time + 86400.0 * days) for s in weather.series))


def after(first: Record, second: Record) -> Record:
    pairs = zip(first.series, second.series, strict=True)
    return replace(
        first,
        series=tuple(
            replace(a, time=np.append(a.time, b.time), value=np.append(a.value, b.value)) for a, b in pairs
        ),
    )


@pytest.mark.slow
def test_a_typical_year_is_repeated_for_each_year_of_power(tmp_path: Path) -> None:
    """Two years of power, the first at standstill: each is a year of the climate."""
    file = tmp_path / "repeated.epw"
    file.write_text(epw_text(years=tuple(range(2007, 2019))), encoding="latin-1")
    begin = float(np.datetime64("2018-01-01T00:00:00", "s").astype(int))
    hour = np.arange(1, 24 * 731)
    value = np.where(hour <= 24 * 365, 0.0, 2e6)
    power = Record(
        "p", (Series("active_power", begin + 3600.0 * hour, value, "mean", 3600.0),), rated_power_W=2e6
    )
    found = climate_of(read_region("typical", [file], power).weather, power)
    assert sorted(round(year.operating_share) for year in found.years) == [0, 1]
    hours = found.scopes["operation"]["hours"]
    assert hours.value == pytest.approx(4383.0, abs=60.0) and hours.between_years > 6000.0
    said = {one.code: one.values for one in found.statements}
    assert said[ClimateCode.POWER_BY_SEASON]["used"].code is ClimateCode.POWER_ALL_USED
    assert ClimateCode.BOUNDS_OF_ONE_YEAR not in said
    repeated = read_region("typical", [file], power).statements
    assert repeated == (ClimateCode.TYPICAL_YEAR_REPEATED(years=2),)
    assert len(read_region("one", [file]).weather["wind_speed"]) == 8760


def test_a_model_of_temperature_alone_has_a_climate() -> None:
    fit = known_fit()
    damp = ("hygric", "vapour", "humidity")
    dry = replace(fit.design, mechanisms=tuple(m for m in fit.design.mechanisms if not m[0].startswith(damp)))
    values = {p.name: fit.values[p.name] for p in dry.model.parameters}
    plain = replace(known_fit(free=("thermal_time_constant",)), design=dry, values=values)
    limit = ClimateLimit("relative_humidity_percent", above=80.0, name="damp")
    study = study_of(fit=plain, members=5, limits=[limit])
    (region,) = study.regions
    assert region.joint is None and region.test_profile is None and region.wetness_class is None
    assert "mean_temperature_degC" in region.year and "wetness_h" not in region.year
    assert ClimateCode.SCALED_UP in codes(region) and region.limits == ()
    assert ClimateCode.LIMIT_NOT_JUDGED(limit="damp", quantity="relative humidity") in region.statements
    assert profile_files(study) == {}


@pytest.mark.slow
def test_years_far_apart_are_taken_and_those_between_told() -> None:
    weather = made_up_weather()
    region = climate_of(after(weather, moved(weather, 5 * 365.25)))
    assert [year.start[:4] for year in region.years] == ["2021", "2026"]
    assert ClimateCode.YEARS_LEFT_OUT(left_out=4, years=6, share=WHOLE_SHARE) in region.statements
    assert len(years_of(np.concatenate([np.arange(8766.0), np.arange(52600.0, 61300.0)]))) == 2
    unknown = replace(
        weather, series=tuple(replace(s, value=np.full(len(s.value), np.nan)) for s in weather.series)
    )
    with pytest.raises(ValueError, match="no reading of ambient_temperature"):
        climate_of(unknown)


@pytest.mark.slow
def test_a_year_without_operation_counts_among_the_others() -> None:
    """Two years, the second at standstill: operation has half of its hours, at the temperature of the
    first."""
    weather = made_up_weather(731)
    time = weather["wind_speed"].time
    region = climate_of(weather, hourly_power(weather, np.where(time < time[0] + 8766 * 3600.0, 2e6, 0.0)))
    operation, standstill = (region.scopes[scope]["hours"] for scope in ("operation", "standstill"))
    assert operation.value + standstill.value == pytest.approx(8766.0, abs=0.1)
    assert operation.value == pytest.approx(4383.0, abs=2.0) and operation.lower == 0.0
    warm = region.scopes["operation"]["mean_temperature_degC"]
    assert np.isfinite(warm.value) and warm.lower <= warm.value <= warm.upper


def test_limits_of_one_name_are_refused() -> None:
    """Their hours would be taken for those of several years of one limit."""
    two = [
        ClimateLimit("temperature_degC", above=level, hours_a_year=24.0, name="hot") for level in (10.0, 60.0)
    ]
    with pytest.raises(ValueError, match='two limits are called "hot"'):
        climate_of(limits=two)


def test_limits_on_a_part_of_a_year() -> None:
    limits = [
        ClimateLimit("temperature_degC", above=-50.0, hours_a_year=0.0, during="operation", name="idle"),
        ClimateLimit("temperature_degC", above=90.0, name="never"),
        ClimateLimit("temperature_degC", above=-60.0, name="broken"),
    ]
    region = climate_of(limits=limits)
    assert [one.verdict for one in region.limits] == ["undecided", "undecided", "fail"]
    part = region.part_of_year
    assert part is not None and part.text == "40 days" and region.verdict == "fail"
    assert [one.why for one in region.limits] == [*[ClimateCode.OF_A_PART(part=part)] * 2, None]
    idle = ClimateCode.KEPT_WITHOUT_HOURS(limit="idle", regime=ClimateCode.IN_OPERATION())
    kept = [one for one in region.statements if "limit" in one.values]
    assert kept == [idle]
    assert {ClimateCode.NO_LIMIT_PASSES, ClimateCode.BOUNDS_OF_A_PART} <= codes(region)
    assert ClimateCode.BOUNDS_OF_ONE_YEAR not in codes(region)


@pytest.mark.parametrize(("members", "few"), [(3, True), (39, False)])
def test_few_members_are_told(members: int, few: bool) -> None:
    told = [one for one in climate_of(members=members).statements if one.code is ClimateCode.FEW_MEMBERS]
    assert [round(one.values["share"], 3) for one in told] == [0.5] * few


def test_weather_that_comes_rarely_is_told() -> None:
    rare = made_up_weather(40)
    rare = replace(
        rare, series=tuple(replace(s, time=s.time[::6], value=s.value[::6]) for s in rare.series[:2])
    )
    (told,) = (one for one in climate_of(rare).statements if one.code is ClimateCode.WEATHER_RARE)
    assert told.values["step_h"] == 6.0


def test_the_class_of_wetness_has_those_of_its_bounds() -> None:
    (region,) = small_study().regions
    wet = region.year["wetness_h"]
    low, high = region.wetness_class_bounds
    assert low <= region.wetness_class <= high and wet.lower <= wet.value <= wet.upper


@pytest.mark.parametrize(("share", "code"), [(0.2, ClimateCode.OPERATES_LITTLE), (0.6, ClimateCode.OPERATES)])
def test_little_operation_is_doubted(share: float, code: ClimateCode) -> None:
    weather = made_up_weather(40)
    value = np.where(np.arange(len(weather["wind_speed"].time)) % 10 < 10 * share, 2e6, 0.0)
    found = climate_of(weather, hourly_power(weather, value))
    (told,) = (one for one in found.statements if one.code is code)
    assert told.values["share"] == pytest.approx(share, abs=0.005)


def test_hours_beyond_what_the_model_was_identified_on_are_told() -> None:
    """Forty days of January on a fit of a summer, and a power of 5 MW on one of 2."""
    weather = made_up_weather(40)
    power = hourly_power(weather, np.full(len(weather["wind_speed"].time), 5e6))
    power = replace(power, rated_power_W=None)

    def said(**ranges: list[float]) -> dict[Code, Mapping[str, Any]]:
        found = climate_of(weather, power, fit=known_fit(found={"identified_on": ranges}), members=2)
        return {one.code: one.values for one in found.statements if one.code in EXTRAPOLATED}

    assert not said() and not said(ambient_temperature_K=[250.0, 300.0], power_share=[0.0, 2.4])
    told = said(ambient_temperature_K=[285.15, 305.15], power_share=[0.0, 1.0])
    warmth, power_of = (told[code] for code in (EXTRAPOLATED[0], EXTRAPOLATED[2]))
    assert (warmth["lower"], warmth["upper"]) == pytest.approx((12.0, 32.0))
    assert power_of["hours"] == pytest.approx(8766.0)
    assert [power_of[end] for end in ("lower", "upper", "least", "most")] == [0.0, 2000.0, 5000.0, 5000.0]
    celsius = weather["ambient_temperature"].value - 273.15
    assert warmth["hours"] == pytest.approx(8766.0 * np.mean(celsius < 10.0), rel=0.03)
    assert EXTRAPOLATED[1] in said(ambient_absolute_humidity_g_m3=[10.0, 20.0])


EXTRAPOLATED = (
    ClimateCode.EXTRAPOLATED_TEMPERATURE,
    ClimateCode.EXTRAPOLATED_HUMIDITY,
    ClimateCode.EXTRAPOLATED_POWER,
)


def test_what_the_model_lacks_and_what_its_noise_is_like_are_said() -> None:
    """Hours above saturation that nothing holds back, and innovations with the tails of shots."""
    lacking = {ClimateCode.AIR_ABOVE_SATURATION, ClimateCode.SHOTS}
    assert not lacking & codes(small_study().regions[0])
    seen = {"n": 17000, "step_h": 0.25, "excess_kurtosis": 60.0}
    damp = known_fit(found={"innovations": {"outputs": {"humidity": seen}}}, vapour_disturbance_sd=4.0)
    found = climate_of(fit=damp)
    assert found.year["saturation_h"].value > 24.0
    assert lacking <= codes(found)
    (shots,) = (one.values["shots"] for one in found.statements if one.code is ClimateCode.SHOTS)
    assert [one.values["balance"] for one in shots] == ["vapour"]


@pytest.mark.slow
def test_years_out_of_reach_are_told() -> None:
    plan = ProfilePlan(ProfileLength(20000, 0.01), chamber=Chamber(temperature_degC=(20.0, 85.0)))
    profile = climate_of(plan=plan).test_profile
    assert not profile.reached and profile.closeness.ageing.test_h > profile.closeness.ageing.service_h
