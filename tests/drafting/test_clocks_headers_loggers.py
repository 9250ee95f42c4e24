"""Exports whose zone, header, names or folders once misled a draft."""

from __future__ import annotations

import json
from datetime import datetime, timedelta
from pathlib import Path

import builders.weather_services as services
import numpy as np
import pytest
from builders.command_line import run
from builders.vendor_exports import ROWS, TIMES, TRUTH, rotronic

from hygrokf.cases.case_file import read_case
from hygrokf.drafting.draft import DraftFault, draft_case
from hygrokf.drafting.vocabulary import name_says

STAMPS = [f"{moment:%Y-%m-%d %H:%M}" for moment in TIMES]


def written(path, header, columns, above="", stamps=STAMPS, separator=","):
    """A table of columns of TRUTH below a header."""
    rows = [
        separator.join([stamp, *(f"{TRUTH[key][row]:g}" for key in columns)])
        for row, stamp in enumerate(stamps)
    ]
    path.parent.mkdir(exist_ok=True)
    path.write_text(above + "\n".join([header, *rows]) + "\n")
    return path


def drafted(folder, *exports):
    draft = draft_case(exports, folder / "case.toml")
    return draft, {one.signal: one for one in draft.signals if one.active}


@pytest.mark.parametrize(
    ("stated", "offset_h"),
    [("UTC+01:00", 1.0), ("GMT-6", -6.0), ("UTC+05:30", 5.5), ("(UTC+02:00) Athens", 2.0), ("UTC", 0.0),
     ("+03:00", 3.0)],
)  # fmt: skip
def test_the_offset_above_a_header_is_kept(stated, offset_h, tmp_path):
    above = f"Logger: 7\nTime zone: {stated}\n\n"
    export = written(tmp_path / "o.csv", "time,Outside (degC)", ["ambient_temperature"], above)
    drafted(tmp_path, export)
    first = read_case(tmp_path / "case.toml", cabinet=False)["ambient_temperature"].time[0]
    assert first == TIMES[0].timestamp() - 3600.0 * offset_h


@pytest.mark.parametrize("count", [144, len(STAMPS)])
def test_the_constant_date_of_an_export_is_no_column_of_stamps(count, tmp_path):
    header = "Export date,time,Outside (degC)"
    stamps = [f"2021-06-01,{stamp}" for stamp in STAMPS[:count]]
    export = written(tmp_path / "o.csv", header, ["ambient_temperature"], stamps=stamps)
    drafted(tmp_path, export)
    assert (
        read_case(tmp_path / "case.toml", cabinet=False)["ambient_temperature"].time[0]
        == TIMES[0].timestamp()
    )


def test_the_date_of_a_single_day_is_joined_with_the_time_of_day(tmp_path):
    first_day = [stamp for stamp in STAMPS if stamp[:10] == STAMPS[0][:10]]
    stamps = [stamp.replace(" ", ",") for stamp in first_day]
    export = written(tmp_path / "o.csv", "Date,Time,Outside (degC)", ["ambient_temperature"], stamps=stamps)
    drafted(tmp_path, export)
    time = read_case(tmp_path / "case.toml", cabinet=False)["ambient_temperature"].time
    assert len(time) == len(first_day) > 1


def test_central_european_time_in_a_header_is_no_utc(tmp_path):
    export = written(tmp_path / "o.csv", "Zeit (MEZ),Outside (degC)", ["ambient_temperature"])
    draft, _ = drafted(tmp_path, export)
    first = read_case(tmp_path / "case.toml", cabinet=False)["ambient_temperature"].time[0]
    assert first == TIMES[0].timestamp() - 3600.0
    assert draft.doubts == ()  # the record goes over the change of clocks and shows none


@pytest.mark.parametrize(
    ("name", "signal"),
    [
        ("WTUR1.W.mag.f", "active_power"),
        ("WTG07/WTUR1.W.mag.f", "active_power"),
        ("WTG07/WNAC1$MX$IntlTmp$instMag$f", "nacelle_temperature"),
        ("WCNV2.CabTmp.mag.f [°C]", "cabinet_temperature"),
        ("WMET1.EnvTmp", "ambient_temperature"),
        ("WTUR_W", "active_power"),
    ],
)
def test_names_of_iec_61400_25_with_instances_and_attributes(name, signal):
    assert name_says(name).signal == signal


@pytest.mark.parametrize("name", ["Temp. top box (°C)", "Cont_Top_Temp_Avg", "Temperatur Topbox"])
def test_the_top_box_is_read_but_to_confirm(name, tmp_path):
    columns = ["active_power", "ambient_temperature", "cabinet_temperature"]
    export = written(tmp_path / "s.csv", f"time,Power (kW),Outside (°C),{name}", columns)
    _, found = drafted(tmp_path, export)
    assert found["cabinet_temperature"].column == name and found["cabinet_temperature"].doubts


def test_the_panel_of_the_converter_comes_before_the_top_box(tmp_path):
    columns = ["active_power", "ambient_temperature", "oil", "cabinet_temperature"]
    header = "time,Grd_Prod_Pwr_Avg,Amb_Temp_Avg,Cont_Top_Temp_Avg,Cont_VCP_Temp_Avg"
    _, found = drafted(tmp_path, written(tmp_path / "s.csv", header, columns))
    assert found["cabinet_temperature"].column == "Cont_VCP_Temp_Avg"


def test_a_title_of_several_cells_is_no_header(tmp_path):
    columns = ["active_power", "ambient_temperature", "cabinet_temperature", "oil", "nacelle_temperature"]
    header = "Zeit;Wirkleistung;Außentemperatur;Schaltschranktemperatur;Öltemperatur;Gondeltemperatur"
    above = "Windpark;WEA 07;10-Minuten-Mittelwerte\n"
    units = "\nTT.MM.JJJJ hh:mm;[kW];[°C];[°C];[°C];[°C]"
    export = written(tmp_path / "s.csv", header + units, columns, above, separator=";")
    _, found = drafted(tmp_path, export)
    assert found.keys() == {*columns} - {"oil"}
    read_case(tmp_path / "case.toml")


def test_a_weather_file_of_dwd_is_read(tmp_path):
    stamps = [f"  2932;{moment:%Y%m%d%H%M};    3; -999" for moment in TIMES]
    columns = ["ambient_temperature", "ambient_relative_humidity"]
    header = "STATIONS_ID;MESS_DATUM;  QN;PP_10;TT_10;RF_10"
    export = written(tmp_path / "produkt_tu.txt", header, columns, stamps=stamps, separator=";")
    draft, found = drafted(tmp_path, export)
    assert found.keys() == {*columns} and draft.doubts == ()
    record = read_case(tmp_path / "case.toml", cabinet=False)
    assert record["ambient_temperature"].time[0] == TIMES[0].timestamp()
    assert len(record["ambient_temperature"].value) == ROWS


def test_files_of_weather_services_are_named_with_their_formats(tmp_path):
    scada = written(tmp_path / "s.csv", "time (UTC),Cabinet Temp (degC)", ["cabinet_temperature"])
    answer = services.open_meteo_json(tmp_path / "a.json", services.open_meteo())
    days = services.merra2_file(tmp_path)
    draft_case([scada, answer, days, services.try_file(tmp_path / "TRY.dat")], tmp_path / "case.toml")
    text = (tmp_path / "case.toml").read_text()
    for file, form in (("a.json", "open_meteo"), (days.name, "merra2"), ("TRY.dat", "try")):
        assert f'file = "{file}"\nformat = "{form}"\n' in text
    assert text.count("year = ") == 1  # of the typical year alone


def test_what_a_fit_would_miss_is_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "o.csv", "time (UTC),Nacelle (degC)", ["nacelle_temperature"])
    draft, _ = drafted(tmp_path, tmp_path / "o.csv")
    assert len(draft.lacks) == 3  # outside, cabinet, power
    said = run("init o.csv --out other.toml")
    assert all(lack.split(":")[0] in said.out for lack in draft.lacks)


def test_init_names_the_readings_that_depart(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    export = written(tmp_path / "s.csv", "time (UTC),Cabinet Temp (degC)", ["cabinet_temperature"])
    lines = export.read_text().splitlines()
    stamp, _ = lines[1000].split(",")
    lines[1000] = f"{stamp},85.0"
    export.write_text("\n".join(lines))
    at = f"{stamp.replace(' ', 'T')}Z"
    said = f"1 reading that leaves its course and returns within 30 min masked: 85 degC at {at}"
    assert said in run("init s.csv").out
    doubts = json.loads(run("init s.csv --out other.toml --json").out)["doubts"]
    assert [said in one for one in doubts].count(True) == 1


@pytest.mark.parametrize("names", ["cabinet/174.csv outside/174.csv", "cabinet_174.csv outside_174.csv"])
def test_two_loggers_started_together_are_two_places(names, tmp_path):
    places = ("cabinet", "ambient")
    exports = []
    for path, place in zip(map(tmp_path.joinpath, names.split()), places, strict=True):
        columns = [f"{place}_temperature", f"{place}_relative_humidity"]
        stamps = [f"{row + 1},{m:%d.%m.%Y},{m:%H:%M:%S}" for row, m in enumerate(TIMES)]
        header = "Nr.,Datum,Uhrzeit,Temperatur [°C],Feuchte [%rF]"
        exports.append(written(path, header, columns, stamps=stamps))
    draft, found = drafted(tmp_path, *exports)
    assert found.keys() == {f"{p}_{q}" for p in places for q in ("temperature", "relative_humidity")}
    assert len(set(draft.copies)) == 2
    record = read_case(tmp_path / "case.toml")
    for place in places:
        shown = record[f"{place}_temperature"].value - 273.15
        np.testing.assert_allclose(shown, TRUTH[f"{place}_temperature"], atol=1e-6)


def test_the_folder_tells_two_turbines_of_one_file_name_apart(tmp_path):
    columns = ["active_power", "ambient_temperature", "cabinet_temperature"]
    header = "time,Power (kW),Outside (°C),Cabinet (°C)"
    exports = [written(tmp_path / name / "s.csv", header, columns) for name in ("T07", "T08")]
    with pytest.raises(DraftFault, match="T08") as raised:
        draft_case(exports, tmp_path / "case.toml")
    assert str(tmp_path / "T07" / "s.csv") in str(raised.value)


def test_an_assumed_zone_is_doubted_beside_a_stated_one(tmp_path):
    cabinet = written(tmp_path / "cabinet.csv", "Date Time GMT+01:00,Temp (°C)", ["cabinet_temperature"])
    columns = ["active_power", "ambient_temperature"]
    scada = written(tmp_path / "scada.csv", "time,Power (kW),Outside (°C)", columns)
    alone, _ = drafted(tmp_path, scada)
    beside, _ = drafted(tmp_path, scada, cabinet)
    assert not any("+01:00" in doubt for doubt in alone.doubts)
    assert len([doubt for doubt in beside.doubts if "cabinet.csv" in doubt and "+01:00" in doubt]) == 1


def test_a_zone_named_in_central_europe_is_a_stated_one(tmp_path):
    short, columns = STAMPS[:500], ["active_power", "ambient_temperature"]
    scada = written(tmp_path / "scada.csv", "time,Power (kW),Outside (°C)", columns)
    cabinet = tmp_path / "cabinet.csv"
    written(cabinet, "Zeit (MEZ),Temperatur (°C)", ["cabinet_temperature"], stamps=short)
    draft, _ = drafted(tmp_path, scada, cabinet)
    assert len([doubt for doubt in draft.doubts if doubt.startswith("scada.csv: cabinet.csv")]) == 1
    assert any("summer time" in doubt for doubt in draft.doubts if doubt.startswith("cabinet.csv"))


def test_two_loggers_without_a_place_name_each_other(tmp_path):
    columns = ["ambient_temperature", "ambient_relative_humidity"]
    exports = [
        written(tmp_path / name / "log.csv", "time (UTC),Temp (°C),Hum (%rF)", columns)
        for name in ("left", "right")
    ]
    draft, _ = drafted(tmp_path, *exports)
    assert any("right/log.csv" in doubt for one in draft.signals for doubt in one.doubts)


def test_the_copy_of_an_earlier_draft_is_no_export(tmp_path):
    (path,) = rotronic().write(tmp_path)
    draft = draft_case([path], tmp_path / "case.toml")
    (copy,) = draft.copies
    (tmp_path / "case.toml").unlink()
    before = Path(copy).read_bytes()
    with pytest.raises(DraftFault, match="leave it out"):
        draft_case([path, Path(copy)], tmp_path / "case.toml")
    assert Path(copy).read_bytes() == before


CLIMATE = {"Outside (degC)": "ambient_temperature", "Cabinet (degC)": "cabinet_temperature"}


def climate(path, header, stamps, separator=",", decimal="."):
    """A table of both temperatures whose stamps are texts, perhaps of two columns."""
    rows = [f"{separator.join([header, *CLIMATE])}"]
    for row, stamp in enumerate(stamps):
        cells = [f"{TRUTH[key][row]:g}".replace(".", decimal) for key in CLIMATE.values()]
        rows.append(separator.join([stamp, *cells]))
    path.write_text("\n".join(rows) + "\n")
    return path


def hourly(form):
    """Stamps of hours as a make writes them, the first at midnight."""
    first = TIMES[0].replace(hour=0, minute=0)
    return [f"{first + k * timedelta(hours=1):{form}}" for k in range(len(TIMES) // 3)]


def excel_day(moment):
    return (moment.replace(tzinfo=None) - datetime(1899, 12, 30)) / timedelta(days=1)


@pytest.mark.parametrize(
    ("header", "stamps", "separator", "decimal"),
    [
        ("Time (UTC+1)", hourly("%Y%m%d%H"), ",", "."),
        ("Zeit (MEZ)", hourly("%d.%m.%Y %H:%M"), ";", ","),
        ("Time (UTC+1),Hour", hourly("%Y-%m-%d,%-H"), ",", "."),
        ("Time (CET)", [f"{excel_day(datetime.fromisoformat(one)):.6f}" for one in hourly("%Y-%m-%d %H:%M")],
            ",", "."),
        ("Zeit MEZ", [f"{excel_day(datetime.fromisoformat(one)):.6f}".replace(".", ",")
                      for one in hourly("%Y-%m-%d %H:%M")], ";", ","),
    ],
)  # fmt: skip
def test_stamps_of_many_forms(header, stamps, separator, decimal, tmp_path):
    export = climate(tmp_path / "o.csv", header, stamps, separator, decimal)
    _, found = drafted(tmp_path, export)
    if "Hour" in header:  # a copy names its column "time": the zone is to state
        text = (tmp_path / "case.toml").read_text()
        (tmp_path / "case.toml").write_text(text.replace('timezone = "UTC"', 'timezone = "+01:00"'))
    assert set(found) == set(CLIMATE.values())
    time = read_case(tmp_path / "case.toml")["ambient_temperature"].time
    begin = TIMES[0].replace(hour=0, minute=0).timestamp() - 3600.0
    np.testing.assert_array_equal(time, begin + 3600.0 * np.arange(len(stamps)))


def test_hours_from_1_to_24_are_ends_of_intervals(tmp_path):
    days = len(TIMES) // 72
    first = TIMES[0].replace(hour=0, minute=0)
    stamps = [f"{first + timedelta(days=day):%Y%m%d},{hour}" for day in range(days) for hour in range(1, 25)]
    export = climate(tmp_path / "o.csv", "YYYYMMDD,HH", stamps)
    drafted(tmp_path, export)
    text = (tmp_path / "case.toml").read_text()
    assert 'stamp = "end"' in text
    series = read_case(tmp_path / "case.toml")["ambient_temperature"]
    np.testing.assert_array_equal(series.time, first.timestamp() + 3600.0 * np.arange(1, 24 * days + 1))


def test_a_day_that_ends_at_24_is_read_in_any_form(tmp_path):
    first = TIMES[0].replace(hour=0, minute=0)
    days = [first + timedelta(days=day) for day in range(12)]
    stamps = [f"{day:%d.%m.%Y} {hour:02d}:00" for day in days for hour in range(1, 25)]
    drafted(tmp_path, climate(tmp_path / "o.csv", "time", stamps))
    time = read_case(tmp_path / "case.toml")["ambient_temperature"].time
    np.testing.assert_array_equal(time, first.timestamp() + 3600.0 * np.arange(1, len(stamps) + 1))


# -- numbers -------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("separator", "mark"), [(";", "."), (";", ","), (",", "'")])
def test_whole_numbers_with_thousands_marks_are_drafted_as_they_are(separator, mark, tmp_path):
    power = np.round(900.0 + 700.0 * np.sin(np.arange(len(TIMES)) / 40.0))
    rows = [f"{stamp}{separator}{one:,.0f}".replace(",", mark if separator != "," else ",")
            for stamp, one in zip(STAMPS, power, strict=True)]  # fmt: skip
    if separator == ",":
        rows = [f'{stamp},"{one:,.0f}"' for stamp, one in zip(STAMPS, power, strict=True)]
    (tmp_path / "p.csv").write_text("\n".join([f"time{separator}Active power (kW)", *rows]) + "\n")
    draft, found = drafted(tmp_path, tmp_path / "p.csv")
    assert "active_power" in found and not any("thousands" in one for one in draft.doubts)
    series = read_case(tmp_path / "case.toml", cabinet=False, ambient=False)["active_power"]
    np.testing.assert_array_equal(series.value, 1e3 * power)


def test_marks_that_both_readings_allow_are_a_doubt(tmp_path):
    power = ["30" if k % 3 else "1.003" for k in range(len(TIMES))]
    rows = [f"{stamp};{one}" for stamp, one in zip(STAMPS, power, strict=True)]
    (tmp_path / "p.csv").write_text("\n".join(["time;Active power (kW)", *rows]) + "\n")
    draft, _ = drafted(tmp_path, tmp_path / "p.csv")
    assert any('thousands = "."' in one and "divide thousands" in one for one in draft.doubts)


def test_an_export_of_grafana_with_units_in_its_cells(tmp_path):
    keys = [*CLIMATE.values(), "cabinet_relative_humidity", "active_power"]
    rows = [
        f"{stamp},{TRUTH[keys[0]][k]:g} °C,{TRUTH[keys[1]][k]:g} °C,{TRUTH[keys[2]][k]:g}%,"
        + (f"{TRUTH[keys[3]][k] / 1e3:g} MW" if TRUTH[keys[3]][k] >= 1e3 else f"{TRUTH[keys[3]][k]:g} kW")
        for k, stamp in enumerate(STAMPS)
    ]
    header = "Time,Outside temperature,Cabinet temperature,Cabinet humidity,Active power"
    (tmp_path / "g.csv").write_text("\n".join([header, *rows]) + "\n")
    _, found = drafted(tmp_path, tmp_path / "g.csv")
    assert set(found) == set(keys)
    record = read_case(tmp_path / "case.toml")
    np.testing.assert_allclose(record["cabinet_temperature"].value, TRUTH[keys[1]] + 273.15)
    read = np.isfinite(record["active_power"].value)
    assert read.mean() > 0.9
    power = 1e3 * TRUTH["active_power"]
    np.testing.assert_allclose(record["active_power"].value[read], power[read], rtol=1e-12)


def test_a_history_of_home_assistant_has_one_row_a_value(tmp_path):
    entities = {"sensor.outdoor_temperature": "ambient_temperature",
                "sensor.cabinet_temperature": "cabinet_temperature",
                "sensor.cabinet_humidity": "cabinet_relative_humidity"}  # fmt: skip
    rows = [
        f"{name},{TRUTH[key][k] if k % 50 else 'unavailable'},{moment:%Y-%m-%dT%H:%M}:{k % 60:02d}.{place}16Z"
        for place, (name, key) in enumerate(entities.items())
        for k, moment in enumerate(TIMES)
    ]
    (tmp_path / "h.csv").write_text("\n".join(["entity_id,state,last_changed", *rows]) + "\n")
    _, found = drafted(tmp_path, tmp_path / "h.csv")
    assert {one.column: signal for signal, one in found.items()} == entities
    series = read_case(tmp_path / "case.toml")["cabinet_temperature"]
    kept = np.arange(len(TIMES)) % 50 > 0
    np.testing.assert_allclose(series.value, TRUTH["cabinet_temperature"][kept] + 273.15)


def test_flags_in_words_are_drafted_and_an_unstated_polarity_is_not_used(tmp_path):
    rows = [
        f"{stamp},{TRUTH['ambient_temperature'][k]:g},{'open' if k % 90 < 5 else 'closed'},"
        f"{'ON' if k % 40 < 9 else 'OFF'},{'open' if k % 30 < 9 else 'closed'}"
        for k, stamp in enumerate(STAMPS)
    ]
    (tmp_path / "f.csv").write_text("\n".join(["time,Outside (degC),Door,Heater,Fan on", *rows]) + "\n")
    draft, found = drafted(tmp_path, tmp_path / "f.csv")
    assert {"door_open", "heater_duty"} <= set(found) and "fan_duty" not in found
    (fan,) = [one for one in draft.signals if one.signal == "fan_duty"]
    assert any('one = "open"' in doubt for doubt in fan.doubts)
    path = tmp_path / "case.toml"
    record = read_case(path, cabinet=False)
    number = np.arange(len(TIMES))
    np.testing.assert_array_equal(record["door_open"].value, number % 90 < 5)
    np.testing.assert_array_equal(record["heater_duty"].value, number % 40 < 9)
    line = '# signals.fan_duty = { column = "Fan on", unit = "1"'
    assert line in path.read_text()
    path.write_text(path.read_text().replace(line, line[2:] + ', one = "closed"'))
    np.testing.assert_array_equal(read_case(path, cabinet=False)["fan_duty"].value, number % 30 >= 9)


def a_logger(path, header="Date-Time (UTC),Temperature (°C),RH (%),Dew Point (°C)"):
    """A logger in the cabinet that exports a dew point of its own readings."""
    warm, moist = TRUTH["cabinet_temperature"], TRUTH["cabinet_relative_humidity"]
    gamma = np.log(moist / 100.0) + 17.62 * warm / (243.12 + warm)
    dew = 243.12 * gamma / (17.62 - gamma)
    rows = [f"{s},{a:.2f},{b:.1f},{c:.2f}" for s, a, b, c in zip(STAMPS, warm, moist, dew, strict=True)]
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


@pytest.mark.parametrize("name", ["cabinet.csv", "20457722.csv"])
def test_a_logger_s_dew_point_is_the_logger_s(tmp_path, name):
    outside = written(tmp_path / "mast.csv", "time (UTC),Outside (°C)", ["ambient_temperature"])
    draft, found = drafted(tmp_path, a_logger(tmp_path / name), outside)
    assert found["cabinet_dew_point_temperature"].column == "Dew Point (°C)"
    assert not [one for one in draft.signals if one.signal == "ambient_dew_point_temperature"]
    assert any("humidity of the air outside" in one for one in draft.lacks)


def test_a_dew_point_computed_inside_is_not_read_as_the_outside_s(tmp_path):
    outside = written(tmp_path / "mast.csv", "time (UTC),Outside (°C)", ["ambient_temperature"])
    header = "Date-Time (UTC),Temperature (°C),RH (%),Ambient dew point (°C)"
    draft, found = drafted(tmp_path, a_logger(tmp_path / "cabinet.csv", header), outside)
    assert "ambient_dew_point_temperature" not in found
    (left,) = [one for one in draft.left if "computed from the cabinet's own" in one.why]
    assert left.column == "Ambient dew point (°C)"


def test_the_temperature_of_a_place_is_of_its_humidity_s_probe(tmp_path):
    columns = ["active_power", "ambient_temperature", "oil"]
    header = "time,Power (kW),Outside (°C),Ambient temperature (converter) (°C)"
    scada = written(tmp_path / "scada.csv", header, columns)
    draft, _ = drafted(tmp_path, a_logger(tmp_path / "cabinet.csv"), scada)
    used = {one.signal: one for one in draft.signals if one.active and not one.compare}
    assert used["cabinet_temperature"].column == "Temperature (°C)"
    assert used["cabinet_relative_humidity"].file == used["cabinet_temperature"].file
