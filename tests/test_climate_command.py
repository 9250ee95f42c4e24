"""`hygrokf climate` from files to page, table and test profile."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from climate_case import known_fit, made_up_weather
from html_page import Page
from weather_case import epw_text

from hygrokf.climate.chamber import Chamber, ProfilePlan
from hygrokf.climate.ensemble import years_of
from hygrokf.climate.limits import Limit
from hygrokf.climate.region import Region, read_region
from hygrokf.climate.results import climate_csv, profile_files
from hygrokf.climate.study import climate_profile
from hygrokf.commands.main import main
from hygrokf.data.record import Record, Series
from hygrokf.identification.results import dump
from hygrokf.report.climate_page import climate_page
from hygrokf.report.climate_tables import class_text, climate_text, hours_text, span_text
from hygrokf.version import __version__

LIMITS = '[[limit]]\nquantity = "temperature_degC"\nabove = 60\n[[limit]]\nquantity = "temperature_degC"\nabove = 10\n'


def write_weather(folder: Path, days: int = 365, stem: str = "weather", warmer: float = 0.0) -> Path:
    weather = made_up_weather(days)
    stamps = np.datetime_as_string(weather["wind_speed"].time.astype(int).astype("datetime64[s]"))
    values = [s.value for s in weather.series]
    rows = [
        f"{t}Z,{a - 273.15 + warmer:.2f},{d - 273.15 + warmer:.2f},{w:.2f}"
        for t, a, d, w in zip(stamps, *values, strict=True)
    ]
    (folder / f"{stem}.csv").write_text("time,T,Td,v\n" + "\n".join(rows) + "\n")
    case = folder / f"{stem}.toml"
    case.write_text(
        f'name = "made-up"\n[[source]]\nfile = "{stem}.csv"\ntime = "time"\n'
        'signals.ambient_temperature = { column = "T", unit = "degC" }\n'
        'signals.ambient_dew_point_temperature = { column = "Td", unit = "degC" }\n'
        'signals.wind_speed = { column = "v", unit = "m/s" }\n'
    )
    return case


def write_known_fit(folder: Path) -> Path:
    fit = known_fit()
    data = {
        "name": fit.name, "version": __version__, "design": fit.design.to_json(),
        "parameters": {name: {"value": value} for name, value in fit.values.items()},
        "covariance": fit.results["covariance"], "time_constants": {},
    }  # fmt: skip
    file = folder / "fit.json"
    file.write_text(dump(data))
    return file


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("climate")
    write_known_fit(made)
    write_weather(made)
    write_weather(made, 365, "warm", 6.0)
    (made / "limits.toml").write_text(LIMITS)
    (made / "curve.toml").write_text(
        "rated_power_kW = 2000\nwind_speed_m_s = [0, 3, 12, 25]\npower_kW = [0, 0, 2000, 2000]\nhub_height_m = 80\n"
        'wind_height_m = 10\nshear = { law = "power", exponent = 0.15 }\n'
    )
    return made


def arguments(folder: Path, out: str, *more: str) -> list[str]:
    return ["climate", str(folder / "fit.json"), "--out", str(folder / out), "--members", "12", *more]


def test_a_climate_is_written_whole(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status = main(
        arguments(
            folder,
            "one",
            "--weather",
            str(folder / "weather.toml"),
            "--power-curve",
            str(folder / "curve.toml"),
            "--limits",
            str(folder / "limits.toml"),
        )
    )
    assert status == 0
    out = folder / "one"
    assert sorted(p.name for p in out.iterdir()) == [
        "climate.csv", "climate.json", "report.html", "test_profile.csv", "test_profile.png",
    ]  # fmt: skip
    data = json.loads((out / "climate.json").read_text())
    region = data["regions"][0]
    assert [one["verdict"] for one in region["limits"]] == ["pass", "fail"]
    assert set(region["scopes"]) == {"all", "operation", "standstill", "standstill_all_year"}
    hours = {scope: region["scopes"][scope]["hours"]["value"] for scope in region["scopes"]}
    assert hours["operation"] + hours["standstill"] == pytest.approx(8766, abs=0.1)
    assert np.sum(region["joint"]["hours"]) == pytest.approx(8766, rel=1e-3)
    rows = list(csv.DictReader((out / "climate.csv").read_text(encoding="utf-8").splitlines()))
    assert {row["scope"] for row in rows} == {*region["scopes"], "limit"}
    printed = capsys.readouterr().out
    assert "pass" in printed and "in operation" in printed
    profile = np.genfromtxt(out / "test_profile.csv", delimiter=",", names=True)
    assert len(profile) == 1000 and profile["temperature_degC"].max() <= 85.0
    page = (out / "report.html").read_text(encoding="utf-8")
    Page(page)
    assert page.count("<svg") == 3 and "NaN" not in page and "power law" in page
    # the page is a function of climate.json alone
    before = page
    (out / "report.html").unlink()
    assert main(["report", str(out)]) == 0
    assert (out / "report.html").read_text(encoding="utf-8") == before


def test_regions_stand_side_by_side(folder: Path) -> None:
    status = main(
        arguments(
            folder,
            "two",
            "--region",
            f"north={folder / 'weather.toml'}",
            "--region",
            f"so/uth={folder / 'warm.toml'}",
            "--standstill",
            "--json",
        )
    )
    assert status == 0
    out = folder / "two"
    assert {p.name for p in out.iterdir()} >= {"test_profile_north.csv", "test_profile_so_uth.csv"}
    data = json.loads((out / "climate.json").read_text())
    means = [r["scopes"]["all"]["mean_temperature_degC"]["value"] for r in data["regions"]]
    assert 4.0 < means[1] - means[0] < 7.0  # the model's own slope of the heat release takes a part
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "Regions side by side" in page and page.count("<svg") == 7


def test_a_typical_year_of_an_epw_file(folder: Path) -> None:
    """Months of twelve years in the published layout are one year, of which nothing is left out."""
    file = folder / "site.epw"
    file.write_text(epw_text(years=tuple(range(2007, 2019))), encoding="latin-1")
    curve = ("--power-curve", str(folder / "curve.toml"))
    assert main(arguments(folder, "typical", "--weather", str(file), *curve)) == 0
    (region,) = json.loads((folder / "typical" / "climate.json").read_text())["regions"]
    assert region["files"] == ["site.epw"]
    (year,) = region["years"]
    assert (year["from"], year["until"]) == ("2001-01-01T00:00Z", "2001-12-31T23:00Z")
    assert 8740.0 < year["hours_known"] < 8760.0  # what follows a gap is not counted before it has settled
    assert region["outside"]["mean_temperature_degC"] == pytest.approx(10.0, abs=0.02)
    assert any("at 10 m, brought to 80 m" in words for words in region["statements"])
    assert "wind_speed is that at 10 m, not at hub height" in region["statements"]
    share = 100.0 * year["operating_share"]
    assert any(words.startswith(f"operates {share:.0f} % of the time") for words in region["statements"])
    assert "a typical year, not the weather of 2001" in (folder / "typical" / "report.html").read_text(
        "utf-8"
    )


def test_a_typical_year_is_repeated_for_each_year_of_power(folder: Path) -> None:
    """Two years of power, the first at standstill: each is a year of the climate."""
    file = folder / "repeated.epw"
    file.write_text(epw_text(years=tuple(range(2007, 2019))), encoding="latin-1")
    begin = float(np.datetime64("2018-01-01T00:00:00", "s").astype(int))
    hour = np.arange(1, 24 * 731)
    value = np.where(hour <= 24 * 365, 0.0, 2e6)
    power = Record(
        "p", (Series("active_power", begin + 3600.0 * hour, value, "zero-order", 3600.0),), rated_power_W=2e6
    )
    region = read_region("typical", [file], power)
    found = climate_profile(known_fit(), [region], power, members=3).to_json()["regions"][0]
    assert sorted(round(year["operating_share"]) for year in found["years"]) == [0, 1]
    hours = found["scopes"]["operation"]["hours"]
    assert hours["value"] == pytest.approx(4383.0, abs=60.0) and hours["between_years"] > 6000.0
    said = "\n".join(found["statements"])
    assert "repeated 2 times, once for each year of power" in said and "all of it" in said
    assert "one year of weather" not in said and len(read_region("one", [file]).weather["wind_speed"]) == 8760


def test_the_same_seed_gives_the_same_files(folder: Path) -> None:
    for out in ("first", "again"):
        assert (
            main(
                arguments(
                    folder, out, "--weather", str(folder / "weather.toml"), "--standstill", "--seed", "7"
                )
            )
            == 0
        )
    for name in ("climate.json", "climate.csv", "report.html", "test_profile.csv"):
        assert (folder / "first" / name).read_bytes() == (folder / "again" / name).read_bytes()


@pytest.mark.parametrize(
    ("more", "told"),
    [
        ([], "expected --weather FILE"),
        (["--weather", "W"], "expected --power, --power-curve or --standstill"),
        (["--region", "no-file", "--standstill"], "expected NAME=FILE"),
        (["--region", "a=W", "--region", "a=W", "--standstill"], "found twice: a"),
        (["--weather", "W", "--power", "W"], "active_power"),
        (["--weather", "none.toml", "--standstill"], "no such case file"),
        (["--weather", "year.csv", "--standstill"], "no such file: year.csv"),
        (["--weather", "W", "year.epw", "--standstill"], "one case file (.toml) alone"),
        (["--weather", "W", "--standstill", "--limits", "none.toml"], "check the path"),
    ],
)
def test_mistakes_are_told_and_nothing_is_written(
    folder: Path, more: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    weather = str(folder / "weather.toml")
    words = [one.replace("=W", f"={weather}") if one != "W" else weather for one in more]
    assert main(arguments(folder, "refused", *words)) == 2
    error = capsys.readouterr().err
    assert told in error and "Traceback" not in error
    assert not (folder / "refused").exists()


@pytest.mark.parametrize(
    "other", ["fit.json", "discovery.json", "fleet.json", "compare.json", "transfer.json"]
)
def test_other_results_are_not_written_over(
    folder: Path, other: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / other).write_text("{}")
    words = ["climate", str(folder / "fit.json"), "--out", str(tmp_path), "--weather", "x", "--standstill"]
    assert main(words) == 2
    assert f"a directory of its own, found {other}" in capsys.readouterr().err


@pytest.mark.parametrize(
    "text",
    [
        "{}", "[]", '{"regions": []}', '{"regions": [{"scopes": {}}]}',
        '{"regions": [{"scopes": {"all": 3}, "test_profile": null, "name": 3, "years": [], "limits": null}], "members": 3}',
    ],
)  # fmt: skip
def test_a_damaged_result_is_told(text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "climate.json").write_text(text)
    (tmp_path / "test_profile.png").write_text("of before")
    assert main(["report", str(tmp_path)]) == 2
    told = capsys.readouterr().err
    assert "again" in told and "climate.json" in told and "Traceback" not in told
    assert (tmp_path / "test_profile.png").exists() and not (tmp_path / "report.html").exists()


def test_a_model_of_temperature_alone_has_a_climate(folder: Path) -> None:
    fit = known_fit()
    dry = replace(
        fit.design,
        mechanisms=tuple(
            m for m in fit.design.mechanisms if not m[0].startswith(("hygric", "vapour", "humidity"))
        ),
    )
    values = {p.name: fit.values[p.name] for p in dry.model.parameters}
    covariance = {"names": ["thermal_time_constant"], "matrix": [[0.01]]}
    plain = replace(fit, design=dry, values=values, results={"covariance": covariance})
    damp = Limit("damp", "relative_humidity_percent", "above", 80.0)
    found = climate_profile(plain, [Region("here", made_up_weather(40))], members=5, limits=[damp]).to_json()
    region = found["regions"][0]
    assert region["joint"] is None and region["test_profile"] is None and region["wetness_class"] is None
    assert "mean_temperature_degC" in region["scopes"]["all"] and "wetness_h" not in region["scopes"]["all"]
    assert any("not a year" in one for one in region["statements"])
    assert region["limits"] == [] and any('"damp" is not judged' in one for one in region["statements"])
    page = climate_page(found)
    assert "The model has no humidity." in page and profile_files(found) == {}
    assert "mean_temperature_degC" in climate_csv(found)


def test_names_are_escaped_on_the_page() -> None:
    weather = replace(made_up_weather(40))
    found = climate_profile(known_fit(), [Region("<b>&", weather, ("<i>.csv",))], members=3).to_json()
    page = climate_page(json.loads(dump(found)))
    assert "<b>&<" not in page and "<i>.csv" not in page


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


def climate_of(weather: Record, **more: object) -> dict:
    return climate_profile(known_fit(), [Region("here", weather)], members=3, **more).to_json()["regions"][0]


def test_years_far_apart_are_taken_and_those_between_told() -> None:
    weather = made_up_weather()
    region = climate_of(after(weather, moved(weather, 5 * 365.25)))
    assert [year["from"][:4] for year in region["years"]] == ["2021", "2026"]
    assert any("4 of 6 years left out" in one for one in region["statements"])
    assert len(years_of(np.concatenate([np.arange(8766.0), np.arange(52600.0, 61300.0)]))) == 2
    unknown = replace(
        weather, series=tuple(replace(s, value=np.full(len(s.value), np.nan)) for s in weather.series)
    )
    with pytest.raises(ValueError, match="no reading of ambient_temperature"):
        climate_of(unknown)


def test_a_year_without_operation_counts_among_the_others() -> None:
    """Two years, the second at standstill: operation has half of its hours, at the temperature of the first."""
    weather = made_up_weather(731)
    time = weather["wind_speed"].time
    value = np.where(time < time[0] + 8766 * 3600.0, 2e6, 0.0)
    power = Record("p", (Series("active_power", time, value, "zero-order", 3600.0),), rated_power_W=2e6)
    region = climate_profile(known_fit(), [Region("here", weather)], power, members=3).to_json()["regions"][0]
    hours = {scope: region["scopes"][scope]["hours"]["value"] for scope in ("operation", "standstill")}
    assert hours["operation"] + hours["standstill"] == pytest.approx(8766.0, abs=0.1)
    assert hours["operation"] == pytest.approx(4383.0, abs=2.0)
    assert region["scopes"]["operation"]["hours"]["lower"] == 0.0
    warm = region["scopes"]["operation"]["mean_temperature_degC"]
    assert np.isfinite(warm["value"]) and warm["lower"] <= warm["value"] <= warm["upper"]


def test_what_to_do_about_years_out_of_reach() -> None:
    found = climate_of(
        made_up_weather(40), plan=ProfilePlan(20000, 0.01, chamber=Chamber(temperature_degC=(20.0, 85.0)))
    )
    assert not found["test_profile"]["reached"]
    study = climate_profile(known_fit(), [Region("here", made_up_weather(40))], members=3).to_json()
    page = climate_page(json.loads(dump({**study, "regions": [found]})))
    assert "a shorter test, more years, or a colder chamber" in page


def test_limits_of_one_name_are_refused() -> None:
    """Their hours would be taken for those of several years of one limit."""
    two = [Limit("hot", "temperature_degC", "above", level, 24.0) for level in (10.0, 60.0)]
    with pytest.raises(ValueError, match='two limits are called "hot"'):
        climate_of(made_up_weather(40), limits=two)


def test_what_a_verdict_and_bounds_do_not_say_is_told() -> None:
    limits = [
        Limit("idle", "temperature_degC", "above", -50.0, 0.0, "operation"),
        Limit("never", "temperature_degC", "above", 90.0),
    ]
    region = climate_of(made_up_weather(40), limits=limits)
    assert [one["verdict"] for one in region["limits"]] == ["undecided", "undecided"]
    assert {one["why"] for one in region["limits"]} == {"of 40 days, not a year"}
    said = "\n".join(region["statements"])
    assert 'limit "idle" has nothing beyond it for want of hours: these days have none in operation' in said
    assert "never" not in said and "on 40 days no limit passes" in said
    assert (
        "40 days of weather: the bounds say nothing of the rest" in said and "one year of weather" not in said
    )
    assert "hold a single year in 50 % of cases, not in 95 %" in said
    rare = made_up_weather(40)
    rare = replace(
        rare, series=tuple(replace(s, time=s.time[::6], value=s.value[::6]) for s in rare.series[:2])
    )
    assert any("comes every 6 h" in one for one in climate_of(rare)["statements"])
    study = climate_profile(known_fit(), [Region("here", rare)], members=3).to_json()
    page = climate_page({**study, "regions": [region]})
    assert "2 asked, of 40 days of weather, not a year" in page and "scaled up from 40 days" in page
    assert "UTC, 40 days, from" in page and "1 year" not in page
    assert "undecided (of 40 days, not a year)" in climate_text({"regions": [region]})
    broken = Limit("broken", "temperature_degC", "above", -60.0)
    assert [one["verdict"] for one in climate_of(made_up_weather(40), limits=[broken])["limits"]] == ["fail"]
    enough = climate_profile(known_fit(), [Region("here", rare)], members=39).to_json()["regions"][0]
    assert not any("members are few" in one for one in enough["statements"])


def test_the_class_of_wetness_has_those_of_its_bounds() -> None:
    region = {"wetness_class": "τ1", "wetness_class_bounds": ["τ1", "τ2"]}
    assert class_text(region) == "τ1 (bounds τ1 … τ2)"
    assert class_text({"wetness_class": "τ3", "wetness_class_bounds": ["τ3", "τ3"]}) == "τ3"
    assert class_text({"wetness_class": "τ3"}) == "τ3"  # a file of before
    assert len(climate_of(made_up_weather(40))["wetness_class_bounds"]) == 2


def test_less_than_an_hour_has_no_digits() -> None:
    one = {"value": 0.114, "lower": 0.0, "upper": 2.5}
    assert span_text(one, hours_text) == "< 1 (0 … 2.50)" and span_text(one) == "0.114 (0 … 2.50)"
    assert span_text({"value": 0.0, "lower": 0.0, "upper": 0.0}, hours_text) == "0"


def test_little_operation_is_doubted() -> None:
    weather = made_up_weather(40)
    time = weather["wind_speed"].time
    for share, doubt in ((0.2, ": check unit and sign of the power"), (0.6, "")):
        value = np.where(np.arange(len(time)) % 10 < 10 * share, 2e6, 0.0)
        power = Record("p", (Series("active_power", time, value, "zero-order", 3600.0),), rated_power_W=2e6)
        found = climate_profile(known_fit(), [Region("here", weather)], power, members=3).to_json()
        assert f"operates {100 * share:.0f} % of the time{doubt}" in found["regions"][0]["statements"]


def test_hours_beyond_what_the_model_was_identified_on_are_told() -> None:
    """Forty days of January on a fit of a summer, and a power of 5 MW on one of 2."""
    weather, fit = made_up_weather(40), known_fit()
    time = weather["wind_speed"].time
    power = Record("p", (Series("active_power", time, np.full(len(time), 5e6), "zero-order", 3600.0),))

    def said(**ranges: list) -> str:
        made = replace(fit, results={**fit.results, "identified_on": ranges} if ranges else fit.results)
        found = climate_profile(made, [Region("here", weather)], power, members=2).to_json()
        return "\n".join(one for one in found["regions"][0]["statements"] if "extrapolated" in one)

    assert said() == "" and said(ambient_temperature_K=[250.0, 300.0], power_share=[0.0, 2.4]) == ""
    told = said(ambient_temperature_K=[285.15, 305.15], power_share=[0.0, 1.0])
    assert (
        "h/a are outside of the 12.0 … 32.0 °C of ambient air on which the model was identified (here "
        in told
    )
    assert "8766 h/a are outside of the 0 … 2000 kW of power" in told and "(here 5000 … 5000)" in told
    celsius = weather["ambient_temperature"].value - 273.15
    hours = float(told.split(" h/a")[0])
    assert hours == pytest.approx(8766.0 * np.mean(celsius < 10.0), rel=0.03)
    assert "g/m³" in said(ambient_absolute_humidity_g_m3=[10.0, 20.0])


def test_what_the_model_lacks_and_what_its_noise_is_like_are_said() -> None:
    """Hours above saturation that nothing holds back, and innovations with the tails of shots."""
    regions = [Region("here", made_up_weather(40))]
    calm = climate_profile(known_fit(), regions, members=3).to_json()["regions"][0]["statements"]
    assert not any("100 %" in one or "shots" in one for one in calm)
    damp = known_fit(vapour_disturbance_sd=4.0)
    seen = {"n": 17000, "step_h": 0.25, "excess_kurtosis": 60.0}
    damp.results["innovations"] = {"outputs": {"humidity": seen}}
    found = climate_profile(damp, regions, members=3).to_json()["regions"][0]
    assert found["scopes"]["all"]["saturation_h"]["value"] > 24.0
    assert any("above 100 % for" in one for one in found["statements"])
    assert any("as shots, on average those of vapour every" in one for one in found["statements"])


def test_weather_that_does_not_suffice_is_named(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = (folder / "weather.csv").read_text().splitlines()
    (folder / "single.csv").write_text("\n".join(text[:2]) + "\n")
    case = (folder / "weather.toml").read_text().replace("weather.csv", "single.csv")
    (folder / "single.toml").write_text(case)
    words = arguments(folder, "refused", "--weather", str(folder / "single.toml"), "--standstill")
    assert main(words) == 2
    assert "site (single.toml): the ambient series have no stretch" in capsys.readouterr().err
    assert not (folder / "refused").exists()


@pytest.mark.parametrize(("share", "advice"), [(0.5, "a hotter chamber"), (2.0, "a colder chamber")])
def test_years_out_of_reach_leave_the_page_whole(share: float, advice: str) -> None:
    """What the test ages too little or too much is told, and the picture of every region keeps an id of its own."""
    found = climate_profile(known_fit(), [Region("here", made_up_weather(40))], members=3).to_json()
    found = json.loads(dump(found))
    profile = found["regions"][0]["test_profile"]
    ageing = profile["closeness"]["ageing"]
    whole = climate_page(found)
    profile["reached"], ageing["test_h"] = False, share * ageing["service_h"]
    page = climate_page(found)
    assert advice in page and advice not in whole
    assert page.count("r1-profile") == whole.count("r1-profile") > 0
