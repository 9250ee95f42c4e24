"""Weather files and sources to compare with, in a case file."""

from __future__ import annotations

import json
from datetime import datetime, timedelta
from pathlib import Path

import builders.weather_case as made
import numpy as np
import pytest
from builders.faults import faults_of

from hygrokf.cases.case_file import read_case
from hygrokf.cases.summary import describe
from hygrokf.commands.main import main
from hygrokf.data.prepared import prepare
from hygrokf.physics.psychrometrics import saturation_pressure_water
from hygrokf.report.record_text import describe_text
from hygrokf.texts.record_codes import DoubtCode

SITE = "[site]\nlatitude_deg = 48.48\nlongitude_deg = 5.57\naltitude_m = 411.0\n"
CABINET = """[[source]]
file = "cabinet.csv"
time = "time"
signals.cabinet_temperature = { column = "T", unit = "degC" }
signals.cabinet_relative_humidity = { column = "RH", unit = "%" }
"""
ERA5 = '[[source]]\nfile = "era5.nc"\nformat = "era5"\n'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    rows = ["time,T,RH,outside"]
    for k in range(made.HOURS * 6):
        stamp = datetime(2021, 3, 1) + timedelta(minutes=10 * k)
        rows.append(
            f"{stamp:%Y-%m-%dT%H:%MZ},{20 + np.sin(k / 20):.2f},"
            f"{50 + 5 * np.cos(k / 31):.1f},{6 + np.sin(k / 23):.1f}"
        )
    (tmp_path / "cabinet.csv").write_text("\n".join(rows) + "\n")
    made.streams(tmp_path / "era5.nc")
    return tmp_path


def case(folder: Path, *parts: str):
    path = folder / "case.toml"
    path.write_text("".join(parts))
    return read_case(path)


def faults(folder: Path, *parts: str) -> str:
    return "\n".join(faults_of(case, folder, *parts))


def test_a_weather_file_brings_its_signals(folder: Path) -> None:
    record = case(folder, SITE, CABINET, ERA5)
    assert {"cabinet_temperature", "ambient_temperature", "ambient_dew_point_temperature", "rain"} <= set(
        record.signals
    )
    assert record["ambient_temperature"].value == pytest.approx(made.truth("t2m"), rel=1e-6)
    assert record["global_horizontal_irradiance"].interval_s == 3600.0
    assert dict(record.files).keys() == {"cabinet.csv", "era5.nc"} and record.compared == ()
    humidity = prepare(record).ambient_vapour
    expected = saturation_pressure_water(made.truth("d2m")) / (461.5 * made.truth("t2m"))
    assert humidity.value == pytest.approx(expected, rel=1e-5)


def test_corrections_and_heights_of_a_weather_file(folder: Path) -> None:
    plain = case(folder, SITE, CABINET, ERA5)
    more = (
        'clock_correction = "-30min"\nclock_uncertainty = "2min"\naltitude_m = 311.0\nto_site_altitude = '
        "true\n"
    )
    moved = case(folder, SITE, CABINET, ERA5, more)
    one, other = moved["ambient_temperature"], plain["ambient_temperature"]
    assert one.time == pytest.approx(other.time - 1800.0) and one.clock_uncertainty_s == 120.0
    assert one.value == pytest.approx(other.value - 0.65)
    steep = case(folder, SITE, CABINET, ERA5, more, "lapse_rate_K_per_km = 10\n")
    assert steep["ambient_temperature"].value == pytest.approx(other.value - 1.0)
    assert any("converted from 311 m to 411 m" in said for said in moved.warnings)


def test_a_signal_of_both_is_taken_from_the_table_and_compared(folder: Path) -> None:
    own = CABINET + 'signals.ambient_temperature = { column = "outside", unit = "degC" }\n'
    record = case(folder, SITE, own, ERA5)
    assert record["ambient_temperature"].source.startswith("cabinet.csv")
    assert [one.signal for one in record.compared] == ["ambient_temperature"]
    assert record.compared[0].source.startswith("era5.nc")
    assert record["ambient_dew_point_temperature"].source.startswith("era5.nc")
    inside = record.window(record.start_s, record.start_s + 86400.0)
    assert len(inside.compared[0]) == 24  # the first hour of rain begins an hour before


def test_one_file_a_year_is_one_weather(folder: Path) -> None:
    half = made.HOURS // 2
    dataset = made.new_dataset(("t2m", "d2m", "ssrd"))
    for name, part in (("early.nc", slice(None, half)), ("late.nc", slice(half, None))):
        (folder / name).write_bytes(made.netcdf4(dataset.isel(valid_time=part)))
    early, late = (ERA5.replace("era5.nc", name) for name in ("early.nc", "late.nc"))
    for order in ((early, late), (late, early)):
        record = case(folder, SITE, CABINET, *order)
        assert record["ambient_temperature"].value == pytest.approx(made.truth("t2m"), rel=1e-6)
        assert len(record["global_horizontal_irradiance"]) == made.HOURS and record.compared == ()
        assert dict(record.files).keys() == {"cabinet.csv", "early.nc", "late.nc"}
    # two opinions on the same time are not put together: the second is compared
    record = case(folder, SITE, CABINET, ERA5, early)
    assert len(record["ambient_temperature"]) == made.HOURS
    assert {one.signal: len(one) for one in record.compared}["ambient_temperature"] == half
    # both halves are compared with a station
    outside = 'signals.ambient_temperature = { column = "outside", unit = "degC" }\n'
    record = case(folder, SITE, CABINET + outside, early, late)
    assert {one.signal: len(one) for one in record.compared}["ambient_temperature"] == made.HOURS


def test_a_source_that_is_only_compared(folder: Path) -> None:
    second = (
        '[[source]]\nfile = "cabinet.csv"\ntime = "time"\ncompare = true\n'
        'signals.ambient_temperature = { column = "outside", unit = "degC" }\n'
    )
    record = case(folder, SITE, CABINET, ERA5, second)
    assert record["ambient_temperature"].source.startswith("era5.nc")
    assert [one.source[:11] for one in record.compared] == ["cabinet.csv"]
    said = faults(
        folder, SITE, CABINET, second.replace("compare = true\n", ""), second.replace("compare = true\n", "")
    )
    assert "to compare the two, state compare = true in one of the sources" in said
    said = faults(folder, SITE, CABINET, ERA5 + "compare = true\n")
    assert "no source names ambient_temperature" in said


def test_a_typical_year_in_a_case_is_a_stated_choice(folder: Path) -> None:
    (folder / "site.epw").write_text(made.epw_text((2006, *(2011,) * 11)))
    epw = '[[source]]\nfile = "site.epw"\nformat = "epw"\n'
    said = faults(folder, SITE, CABINET, epw)
    assert said.startswith("site.epw: is a typical year composed of months from 2006 … 2011")
    record = case(folder, SITE, CABINET, epw, "year = 2021\n")
    assert any("a typical year, not the weather of 2021" in one for one in record.warnings)
    assert any("its height is 250 m, the site's 411 m" in one for one in record.warnings)


def test_all_faults_of_the_form_at_once(folder: Path) -> None:
    wrong = (
        '[[source]]\nfile = "era5.nc"\nformat = "era6"\ntime = "valid_time"\nyear = 2019\naltitude_m = '
        '"high"\n'
        'lapse_rate_K_per_km = 65\nto_site_altitude = 1\ncompare = "yes"\nclock_correction = "soon"\nheight '
        "= 3\n"
        'signals.ambient_temperature = { column = "t2m", unit = "K" }\n'
    )
    said = faults(folder, SITE, CABINET, wrong)
    for words in (
        "case.toml, line 12, [[source]] 2: format must be one of era5, epw, merra2, open_meteo, try, "
        'found "era6"; did you mean "era5"',
        "line 13, [[source]] 2: a source with format needs no time; remove it",
        "line 15, [[source]] 2: altitude_m must be a number within -500 … 9000",
        "line 16, [[source]] 2: lapse_rate_K_per_km must be a number within -20 … 20",
        "line 17, [[source]] 2: to_site_altitude must be true or false",
        "line 18, [[source]] 2: compare must be true or false",
        "line 19, [[source]] 2: clock_correction",
        'unknown key "height" in a [[source]] with format',
        "a source with format supplies all signals of its file",
    ):
        assert words in said, said
    assert "year is for typical years" in faults(folder, SITE, CABINET, ERA5, "year = 2019\n")
    assert "to_site_altitude needs altitude_m in [site]" in faults(
        folder, CABINET, ERA5, "to_site_altitude = true\n"
    )
    assert "with to_site_altitude = true only" in faults(
        folder, SITE, CABINET, ERA5, "lapse_rate_K_per_km = 5\n"
    )
    assert "[[source]] 2: needs file" in faults(folder, SITE, CABINET, '[[source]]\nformat = "epw"\n')
    assert "compare must be true or false" in faults(folder, SITE, CABINET + "compare = 1\n", ERA5)


def test_faults_of_the_file_name_it(folder: Path) -> None:
    assert faults(folder, CABINET, ERA5).startswith("era5.nc: ")
    assert "no site is given" in faults(folder, CABINET, ERA5)
    (folder / "era5.nc").write_bytes(b"PK\x03\x04 cut short")
    assert "era5.nc: is a damaged ZIP archive" in faults(folder, SITE, CABINET, ERA5)


def test_check_shows_the_comparison_and_stays_quiet_on_right_clocks(tmp_path: Path, capsys) -> None:
    """A station's table and a reanalysis' file, right and then stamped an hour early; seed 5990."""
    for late_s, wrong in ((0.0, False), (-3600.0, True)):
        one, other = made.weather_pair(5990, 60, late_s, sun=0.1)
        for name, series in (("scada.csv", one), ("era5.csv", other)):
            stamps = series.time.astype("datetime64[s]")
            rows = [f"{stamp}Z,{value:.3f}" for stamp, value in zip(stamps, series.value, strict=True)]
            (tmp_path / name).write_text("time,T\n" + "\n".join(rows) + "\n")
        path = tmp_path / "case.toml"
        table = (
            '[[source]]\nfile = "{}"\ntime = "time"\nsignals.ambient_temperature = {{ column = "T", unit '
            '= "K" }}\n'
        )
        second = table.format("era5.csv").replace('time = "time"', 'time = "time"\ncompare = true')
        path.write_text(table.format("scada.csv") + second)
        assert main(["check", str(path), "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert ("clock_runs" in [one["code"] for one in found["doubts"]]) == wrong
        (row,) = found["comparisons"]
        assert row["kind"] == ("constant" if wrong else "right")
        (alignment,) = row["alignments"]
        assert alignment["whole"]["weather"]["value"] == pytest.approx(late_s, abs=400.0)
        shown = describe_text(describe(read_case(path, cabinet=False)))
        assert "lag in winter" in shown and "daily wave" in shown


def test_check_says_that_two_files_have_too_little_in_common(folder: Path) -> None:
    outside = 'signals.ambient_temperature = { column = "outside", unit = "degC" }\n'
    record = case(folder, SITE, CABINET + outside, ERA5)
    doubt = DoubtCode.NOT_COMPARED(file="era5.nc", signals=("ambient_temperature",), fewest_d=20.0)
    assert doubt in describe(record).doubts
    others = describe(case(folder, SITE, CABINET, ERA5)).doubts
    assert DoubtCode.NOT_COMPARED not in [one.code for one in others]
