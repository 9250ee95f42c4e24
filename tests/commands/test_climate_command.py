"""`hygrokf climate` from files to page, table and test profile."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
from builders.climate_case import known_fit, made_up_weather
from builders.command_line import Said, run
from builders.html_page import Page
from builders.weather_case import epw_text

from hygrokf.data.result_file import result_text
from hygrokf.version import __version__

LIMITS = (
    '[[limit]]\nquantity = "temperature_degC"\nabove = 60\n[[limit]]\nquantity = '
    '"temperature_degC"\nabove = 10\n'
)


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
        "covariance": fit.to_json()["covariance"], "time_constants": {},
    }  # fmt: skip
    file = folder / "fit.json"
    file.write_text(result_text(data))
    return file


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("climate")
    write_known_fit(made)
    write_weather(made)
    write_weather(made, 40, "short")
    write_weather(made, 40, "warm", 6.0)
    (made / "limits.toml").write_text(LIMITS)
    (made / "curve.toml").write_text(
        "rated_power_kW = 2000\nwind_speed_m_s = [0, 3, 12, 25]\npower_kW = [0, 0, 2000, 2000]\nhub_height_m "
        "= 80\n"
        'wind_height_m = 10\nshear = { law = "power", exponent = 0.15 }\n'
    )
    return made


def climate(folder: Path, out: str, *more: str | Path) -> Said:
    """`hygrokf climate` on the known fit, with results in `out`."""
    return run(f"climate {folder}/fit.json --out {folder}/{out} --members 12 {' '.join(map(str, more))}")


def test_a_climate_is_written_whole(folder: Path) -> None:
    weather, curve, limits = (folder / f"{name}.toml" for name in ("weather", "curve", "limits"))
    said = climate(folder, "one", "--weather", weather, "--power-curve", curve, "--limits", limits)
    assert said.status == 0
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
    assert "pass" in said.out and "in operation" in said.out
    profile = np.genfromtxt(out / "test_profile.csv", delimiter=",", names=True)
    assert len(profile) == 1000 and profile["temperature_degC"].max() <= 85.0
    page = (out / "report.html").read_text(encoding="utf-8")
    Page(page)
    assert page.count("<svg") == 3 and "NaN" not in page and "power law" in page
    # the page is a function of climate.json alone
    (out / "report.html").unlink()
    assert run(f"report {out}").status == 0
    assert (out / "report.html").read_text(encoding="utf-8") == page


def test_regions_stand_side_by_side(folder: Path) -> None:
    regions = f"--region north={folder}/short.toml --region so/uth={folder}/warm.toml"
    assert climate(folder, "two", regions, "--standstill", "--json").status == 0
    out = folder / "two"
    assert {p.name for p in out.iterdir()} >= {"test_profile_north.csv", "test_profile_so_uth.csv"}
    data = json.loads((out / "climate.json").read_text())
    means = [r["scopes"]["all"]["mean_temperature_degC"]["value"] for r in data["regions"]]
    assert 4.0 < means[1] - means[0] < 7.0  # the model's own slope of the heat release takes a part
    page = (out / "report.html").read_text(encoding="utf-8")
    assert page.count("<svg") == 7


def test_a_typical_year_of_an_epw_file(folder: Path) -> None:
    """Months of twelve years in the published layout are one year, of which nothing is left out."""
    file = folder / "site.epw"
    file.write_text(epw_text(years=tuple(range(2007, 2019))), encoding="latin-1")
    curve = folder / "curve.toml"
    assert climate(folder, "typical", "--weather", file, "--power-curve", curve).status == 0
    (region,) = json.loads((folder / "typical" / "climate.json").read_text())["regions"]
    assert region["files"] == ["site.epw"]
    (year,) = region["years"]
    assert (year["start"], year["end"]) == ("2001-01-01T00:00Z", "2001-12-31T23:00Z")
    assert 8740.0 < year["hours_known"] < 8760.0  # what follows a gap is not counted before it has settled
    assert region["outside"]["mean_temperature_degC"] == pytest.approx(10.0, abs=0.02)
    said = {one["code"]: one["values"] for one in region["statements"]}
    curve_of = said["power_by_curve"]
    assert (curve_of["wind_height_m"], curve_of["hub_height_m"]) == (10.0, 80.0)
    assert said["operates"]["share"] == pytest.approx(year["operating_share"])
    assert "not the weather of 2001" in (folder / "typical" / "report.html").read_text("utf-8")


def test_the_same_seed_gives_the_same_files(folder: Path) -> None:
    for out in ("first", "again"):
        weather = folder / "short.toml"
        assert climate(folder, out, "--weather", weather, "--standstill", "--seed 7").status == 0
    for name in ("climate.json", "climate.csv", "report.html", "test_profile.csv"):
        assert (folder / "first" / name).read_bytes() == (folder / "again" / name).read_bytes()


@pytest.mark.parametrize(
    ("more", "told"),
    [
        ("", "expected --weather FILE"),
        ("--weather W", "expected --power, --power-curve or --standstill"),
        ("--region no-file --standstill", "expected NAME=FILE"),
        ("--region a=W --region a=W --standstill", "found twice: a"),
        ("--weather W --power W", "active_power"),
        ("--weather W year.epw --standstill", "one case file (.toml) alone"),
        ("--weather W --standstill --limits none.toml", "check the path"),
    ],
)
def test_mistakes_are_told_and_nothing_is_written(folder: Path, more: str, told: str) -> None:
    said = climate(folder, "refused", re.sub(r"\bW\b", str(folder / "weather.toml"), more))
    assert said.status == 2
    assert told in said.err and "Traceback" not in said.err
    assert not (folder / "refused").exists()


def test_the_faults_of_all_inputs_are_told_at_once(folder: Path) -> None:
    said = run(
        f"climate {folder}/no-fit --weather {folder}/none.csv {folder}/none.epw "
        f"--limits {folder}/no-limits.toml --power-curve {folder}/no-curve.toml --out {folder}/refused"
    )
    assert said.status == 2 and "Traceback" not in said.err
    for name in ("no-fit", "none.csv", "none.epw", "no-limits.toml", "no-curve.toml"):
        assert name in said.err
    assert not (folder / "refused").exists()


@pytest.mark.parametrize(
    "text",
    [
        "{}", "[]", '{"regions": []}', '{"regions": [{"scopes": {}}]}',
        '{"regions": [{"scopes": {"all": 3}, "test_profile": null, "name": 3, "years": [], "limits": null}], '
        '"members": 3}',
    ],
)  # fmt: skip
def test_a_damaged_result_is_told(text: str, tmp_path: Path) -> None:
    (tmp_path / "climate.json").write_text(text)
    (tmp_path / "test_profile.png").write_text("of before")
    said = run(f"report {tmp_path}")
    assert said.status == 2
    assert "again" in said.err and "climate.json" in said.err and "Traceback" not in said.err
    assert (tmp_path / "test_profile.png").exists() and not (tmp_path / "report.html").exists()


def test_weather_that_does_not_suffice_is_named(folder: Path) -> None:
    text = (folder / "weather.csv").read_text().splitlines()
    (folder / "single.csv").write_text("\n".join(text[:2]) + "\n")
    case = (folder / "weather.toml").read_text().replace("weather.csv", "single.csv")
    (folder / "single.toml").write_text(case)
    said = climate(folder, "refused", "--weather", folder / "single.toml", "--standstill")
    assert said.status == 2 and "site (single.toml)" in said.err
    assert not (folder / "refused").exists()


def test_a_class_as_limits(folder: Path) -> None:
    weather = folder / "short.toml"
    said = climate(folder, "class", "--weather", weather, "--standstill", "--limits", "3K3")
    assert said.status == 0
    limits = json.loads((folder / "class" / "climate.json").read_text())["regions"][0]["limits"]
    assert [one["above"] or one["below"] for one in limits] == [40.0, 5.0, 85.0, 5.0]
    assert all(one["name"].startswith("IEC 60721-3-3 3K3: ") for one in limits)
    unknown = climate(folder, "none", "--weather", weather, "--standstill", "--limits", "3K22")
    assert unknown.status == 2 and "IEC 60721-3-3 3K3" in unknown.err
