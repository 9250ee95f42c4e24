"""Exports whose zone, header, names or folders once misled a draft."""

from __future__ import annotations

from pathlib import Path

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


def test_what_a_fit_would_miss_is_told(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "o.csv", "time (UTC),Nacelle (degC)", ["nacelle_temperature"])
    draft, _ = drafted(tmp_path, tmp_path / "o.csv")
    assert len(draft.lacks) == 3  # outside, cabinet, power
    said = run("init o.csv --out other.toml")
    assert all(lack.split(":")[0] in said.out for lack in draft.lacks)


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
