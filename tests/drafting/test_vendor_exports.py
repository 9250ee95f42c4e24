"""Exports in the layouts of makes and loggers: drafts are read without an edit and give the readings made."""

from __future__ import annotations

import numpy as np
import pytest
from builders.command_line import run
from builders.vendor_exports import MAKES, START, STEP, TIMES, TRUTH, greenbyte, openoa, vestas

from hygrokf.cases.case_file import read_case
from hygrokf.data.signals import from_si
from hygrokf.drafting.draft import draft_case


def named(make):
    return make.__name__


@pytest.mark.parametrize("make", MAKES, ids=named)
def test_every_column_of_a_make_is_found_and_read_without_an_edit(make, tmp_path):
    made = make()
    draft = draft_case(made.write(tmp_path), tmp_path / "case.toml")
    found = {one.signal: one for one in draft.signals if one.active}
    assert {name: one.column for name, one in found.items()} == made.expected
    assert bool(draft.doubts) is made.asked
    record = read_case(tmp_path / "case.toml", cabinet=False, ambient=False)
    for signal, one in found.items():
        series = record[signal]
        key = "ambient_relative_humidity" if signal == "nacelle_relative_humidity" else signal
        shown = from_si(series.value, one.unit, signal)
        assert len(series) == len(TRUTH[key])
        np.testing.assert_allclose(shown[~series.missing], TRUTH[key][~series.missing], atol=1e-6)
        stamped_start = series.time[0] - series.interval_s
        assert stamped_start == START.timestamp()
    assert record.rated_power_W == (2.05e6 if "active_power" in found else None)


def test_frames_of_parquet_and_of_csv_give_the_same_draft(tmp_path):
    import pandas as pd

    made = openoa()
    (path,) = made.write(tmp_path)
    frame = pd.read_csv(path)
    frame["time"] = pd.to_datetime(frame["time"])
    frame.to_parquet(tmp_path / "oa.parquet")
    drafts = [draft_case([tmp_path / name], tmp_path / f"{name}.toml") for name in ("oa.csv", "oa.parquet")]
    one, other = ([(s.signal, s.column, s.unit, s.score) for s in draft.signals] for draft in drafts)
    assert one == other and drafts[1].copies == ()
    read_case(tmp_path / "oa.parquet.toml")


def test_an_excel_table_is_copied_or_its_extra_is_named(tmp_path):
    import pandas as pd

    pytest.importorskip("openpyxl", reason='the extra "excel" is not installed')
    hours = pd.date_range("2021-01-01", periods=60, freq="h")
    frame = pd.DataFrame(
        {"Zeit": hours, "Schaltschrank [°C]": np.arange(60) / 8, "Außen [°C]": np.arange(60) / 9}
    )
    frame.to_excel(tmp_path / "export.xlsx", index=False)
    draft = draft_case([tmp_path / "export.xlsx"], tmp_path / "case.toml")
    assert {one.signal for one in draft.signals} == {"cabinet_temperature", "ambient_temperature"}
    record = read_case(tmp_path / "case.toml")
    np.testing.assert_allclose(record["cabinet_temperature"].value - 273.15, np.arange(60) / 8)


def test_consecutive_files_of_one_layout_are_joined(tmp_path):
    (path,) = vestas().write(tmp_path)
    lines = path.read_text().splitlines()
    (tmp_path / "a.csv").write_text("\n".join(lines[:1001]))
    (tmp_path / "b.csv").write_text("\n".join([lines[0], *lines[1001:]]))
    draft = draft_case([tmp_path / "a.csv", tmp_path / "b.csv"], tmp_path / "case.toml")
    assert [name.rsplit("/", 1)[1] for name in draft.copies] == ["case_a.csv"]
    assert len(read_case(tmp_path / "case.toml")["active_power"]) == len(TIMES)


def test_a_signal_of_two_files_is_compared(tmp_path):
    rows = "".join(f"{moment:%Y-%m-%dT%H:%M:%SZ},{5 + row % 7}.25\n" for row, moment in enumerate(TIMES))
    (tmp_path / "mast.csv").write_text("time,Outside temperature (°C)\n" + rows)
    draft = draft_case([*greenbyte().write(tmp_path), tmp_path / "mast.csv"], tmp_path / "case.toml")
    assert [one.file for one in draft.signals if one.compare] == ["mast.csv"]
    assert read_case(tmp_path / "case.toml").compared[0].signal == "ambient_temperature"


@pytest.mark.parametrize("place", ["cabinet", "ambient"])
def test_a_logger_without_a_name_is_paired_where_its_temperature_follows_the_cabinet(tmp_path, place):
    """Beside an export that names a temperature of the cabinet: humidity and temperature of one probe."""
    random = np.random.default_rng(8)
    warm = TRUTH[f"{place}_temperature"] + random.normal(0.4, 0.3, len(TIMES))
    rows = "".join(
        f"{moment:%Y-%m-%dT%H:%M:%SZ},{warm[row]:.2f},{55 + row % 9}\n" for row, moment in enumerate(TIMES)
    )
    (tmp_path / "logger.csv").write_text("Date,Temp (°C),RH (%)\n" + rows)
    draft = draft_case([*greenbyte().write(tmp_path), tmp_path / "logger.csv"], tmp_path / "case.toml")
    found = {one.signal: (one.file, one.column) for one in draft.signals if not one.compare}
    if place == "cabinet":
        assert found["cabinet_temperature"] == ("logger.csv", "Temp (°C)")
        assert found["cabinet_relative_humidity"] == ("logger.csv", "RH (%)")
    else:
        assert found["cabinet_temperature"][0] != "logger.csv"
        assert "cabinet_relative_humidity" not in found


def test_turbines_of_one_file_are_told_apart(tmp_path):
    rows = [
        f"{name},{moment:%d.%m.%Y %H:%M},{TRUTH['cabinet_temperature'][row] + extra:.1f},{row % 50}"
        for row, moment in enumerate(TIMES[:500])
        for name, extra in (("A1", 0.0), ("A2", 10.0))
    ]
    (tmp_path / "park.csv").write_text(
        "Turbine,Time,Cabinet temperature [°C],Outside temperature [°C]\n" + "\n".join(rows)
    )
    draft = draft_case([tmp_path / "park.csv"], tmp_path / "case.toml", turbine="A2")
    assert not any("turbine" in doubt for doubt in draft.doubts)
    record = read_case(tmp_path / "case.toml")
    assert record.name == "A2"
    np.testing.assert_allclose(
        record["cabinet_temperature"].value - 273.15, TRUTH["cabinet_temperature"][:500] + 10.0, atol=1e-9
    )


def test_day_and_month_are_told_by_the_steps(tmp_path):
    for form in ("%d/%m/%Y %H:%M", "%m/%d/%Y %H:%M"):
        name = form[1]
        rows = "".join(
            f"{m:{form}},{row % 9}.5\n" for row, m in enumerate(START + n * STEP for n in range(700))
        )
        (tmp_path / f"{name}.csv").write_text("Time,Outside temperature (°C)\n" + rows)
        draft_case([tmp_path / f"{name}.csv"], tmp_path / f"{name}.toml")
        assert f'time_format = "{form}"' in (tmp_path / f"{name}.toml").read_text()


def test_the_command_names_what_comes_next(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    greenbyte().write(tmp_path)
    said = run("init t1.csv --site=52.4,-0.95")
    assert said.status == 0 and "hygrokf check case.toml" in said.out
    assert read_case("case.toml").site.longitude_deg == -0.95
    checked = run("check case.toml")
    assert checked.status == 0
    assert run("init t1.csv --out other.toml --json").out.startswith("{")
