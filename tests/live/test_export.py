"""Files of a store's history: complete, readable, whole or not there at all, from either database."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from builders.command_line import run
from builders.store_case import T0, a_condition, observed, queried

from hygrokf.live.batch import Alarm, Batch, Estimates, Observation
from hygrokf.live.properties import Property
from hygrokf.live.storage import export as module
from hygrokf.live.storage.export import ExportFault, export
from hygrokf.live.storage.store import StoreFault, open_store
from hygrokf.live.tracker import Reading

BEGAN = "2023-11-14T22:13:20.000Z"
"""T0."""


@pytest.fixture
def filled(store_url: str) -> str:
    """Two turbines, with what a spreadsheet may stumble over."""
    store = open_store(store_url)
    store.add_turbines({"T1": "a", "T2, the second": "b"})
    store.commit(
        Batch(
            observations=[
                observed("cabinet_temperature", T0 + 0.25, 290.1),
                observed("cabinet_relative_humidity", T0, 0.1 + 0.2),
                observed("cabinet_temperature", T0 + 600.0, 1.0 / 3.0, late=True),
                Observation("T2, the second", Reading("cabinet_temperature", T0, 280.0), T0),
            ],
            estimates={"T1": Estimates(a_condition([T0, T0 + 600.0]), 1, T0)},
            properties=[("T1", T0, [Property("hygric_k", "h", None, None, None, 0.3, False)])],
            alarms=[
                Alarm("a", "T1", "condensation", "alarm", T0, 'wet, "very"\nwet', "dry it", T0 + 60.0,
                    T0 + 1.0, "Ä"),
                Alarm("b", "T1", "condensation", "notice", T0 + 300.0, "damp", "wait"),
            ],
        )
    )  # fmt: skip
    store.close()
    return store_url


def frame(folder: Path, name: str) -> pd.DataFrame:
    return pd.read_csv(folder / f"{name}.csv", keep_default_na=False, dtype=str)


def test_csv_says_times_units_and_flags(filled: str, tmp_path: Path) -> None:
    said = run(f"export --store {filled} --out {tmp_path / 'out'} --json")
    assert (said.status, said.err) == (0, "")
    rows = {"observation": 4, "connection": 0, "estimate": 2, "property": 1, "alarm": 2}
    assert json.loads(said.out) == {"rows": rows}
    rows = frame(tmp_path / "out", "observation")
    assert list(rows) == [
        "turbine", "signal", "time_utc", "value_si", "unit", "received_utc", "late", "contradicted"
    ]  # fmt: skip
    assert rows.values.tolist() == [
        ["T1", "cabinet_relative_humidity", BEGAN, "0.30000000000000004", "1", "2023-11-14T22:13:23.000Z",
            "false", "false"],
        ["T1", "cabinet_temperature", "2023-11-14T22:13:20.250Z", "290.1", "K", "2023-11-14T22:13:23.250Z",
            "false", "false"],
        ["T1", "cabinet_temperature", "2023-11-14T22:23:20.000Z", "0.3333333333333333", "K",
            "2023-11-14T22:23:23.000Z", "true", "false"],
        ["T2, the second", "cabinet_temperature", BEGAN, "280.0", "K", BEGAN, "false", "false"],
    ]  # fmt: skip
    estimates = frame(tmp_path / "out", "estimate")
    assert list(estimates["time_utc"]) == [BEGAN, "2023-11-14T22:23:20.000Z"]
    assert list(estimates["final"]) == ["true", "false"] and set(estimates["frost_point_celsius"]) == {""}
    first = {
        name: float(text)
        for name, text in estimates.iloc[0].items()
        if "_" in name and text and "utc" not in name
    }
    assert first["temperature_celsius"] == pytest.approx(16.85)
    assert first["temperature_upper_celsius"] == pytest.approx(16.85 + 0.98, abs=1e-3)
    assert first["condensation_percent"] == 25.0
    (prop,) = frame(tmp_path / "out", "property").values.tolist()
    assert prop == ["T1", "hygric_k", BEGAN, "", "", "", "0.3", "h", "false"]
    alarms = frame(tmp_path / "out", "alarm")
    assert alarms["statement"][0] == 'wet, "very"\nwet' and alarms["acknowledged_by"][0] == "Ä"
    assert list(alarms["ended_utc"]) == ["2023-11-14T22:14:20.000Z", ""]


def test_parquet_holds_the_same_as_csv(filled: str, tmp_path: Path) -> None:
    for form in module.EXPORT_FORMATS:
        said = run(f"export --store {filled} --out {tmp_path / form} --format {form}")
        assert said.status == 0 and said.out.count(" rows written: ") == 5
    for table in module.EXPORTED_TABLES:
        typed = pd.read_parquet(tmp_path / "parquet" / f"{table.name}.parquet")
        text = frame(tmp_path / "csv", table.name)
        assert list(typed) == list(text) == [one.name for one in table.columns]
        for column in table.columns:
            if column.kind == "time":
                assert str(typed[column.name].dtype) == "datetime64[ms, UTC]"
                assert pd.to_datetime(text[column.name], utc=True).tolist() == typed[column.name].tolist()
            elif column.kind == "number":
                assert typed[column.name].dtype == float
                assert np.array_equal(pd.to_numeric(text[column.name]), typed[column.name], equal_nan=True)
            elif column.kind == "flag":
                assert [str(v).lower() for v in typed[column.name]] == list(text[column.name])
            else:
                assert ["" if pd.isna(v) else v for v in typed[column.name]] == list(text[column.name])


def test_one_turbine_and_a_span_of_time(filled: str, tmp_path: Path) -> None:
    run(
        f"export --store {filled} --out {tmp_path} --turbine T1 --since {BEGAN} --until "
        "2023-11-14T22:13:20.250Z"
    )
    assert list(frame(tmp_path, "observation")["signal"]) == ["cabinet_relative_humidity"]
    assert len(frame(tmp_path, "estimate")) == 1 and list(frame(tmp_path, "alarm")["id"]) == ["a"]
    # an alarm that began before and still stood
    run(f"export --store {filled} --out {tmp_path} --since 2023-11-15T00:00:00+01:00")
    assert list(frame(tmp_path, "alarm")["id"]) == ["b"] and len(frame(tmp_path, "observation")) == 0


def test_rows_are_read_in_chunks_and_none_twice(
    filled: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run(f"export --store {filled} --out {tmp_path / 'one'}")
    for size in (1, 3):
        monkeypatch.setattr(module, "ROWS_AT_ONCE", size)
        run(f"export --store {filled} --out {tmp_path / 'more'}")
        for table in module.EXPORTED_TABLES:
            name = f"{table.name}.csv"
            assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "more" / name).read_bytes()


def test_memory_does_not_grow_with_the_store(
    store_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "ROWS_AT_ONCE", 300)
    store = open_store(store_url)
    store.add_turbines({"T1": "a"})
    export(store, tmp_path / "out", "parquet")  # loads its library
    peaks = []
    for count in (2_000, 8_000):
        store.commit(Batch(observations=[observed("rain", T0 + i, 0.1 * i) for i in range(count)]))
        tracemalloc.start()
        assert export(store, tmp_path / "out", "parquet" if peaks else "csv")["observation"] == count
        export(store, tmp_path / "out", "csv")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.5 * peaks[0]
    store.close()


def test_a_store_that_fails_on_the_way_leaves_the_old_files(
    filled: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "ROWS_AT_ONCE", 1)
    run(f"export --store {filled} --out {tmp_path}")
    before = {one.name: one.read_bytes() for one in tmp_path.iterdir() if one.suffix == ".csv"}
    assert len(before) == 5
    store = open_store(filled)
    with store.transaction():
        queried(store, "DELETE FROM observation")
        queried(store, "DROP VIEW turbine_now")
        queried(store, "DROP VIEW estimate_readable")
    with pytest.raises(store.database.errors, match="estimate_readable"):
        export(store, tmp_path, "csv")
    store.close()
    assert {one.name: one.read_bytes() for one in tmp_path.iterdir() if one.name in before} == before
    assert [one.name for one in tmp_path.iterdir() if one.name.endswith(".part")] == []


def test_mistakes_are_told(filled: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    for line, words in (
        (f"--store {filled} --turbine T9", "expected a turbine of T1, T2, the second, found 'T9'"),
        (f"--store {filled} --since 2024-01-01 --until 2023-01-01", "since must be earlier than until"),
        (f"--store sqlite:{tmp_path / 'none.db'}", "there is no such store"),
        ("--store live.db", "expected a store as sqlite:PATH"),
        ("--store postgresql://me:geheim@127.0.0.1/x", "the password does not belong"),
    ):
        said = run(f"export --out {out} {line}")
        assert said.status == 2 and words in said.err and "Traceback" not in said.err, said.err
        assert "geheim" not in said.err and not out.exists()
    assert not (tmp_path / "none.db").exists()
    assert run(f"export --out {out} --store {filled} --since yesterday").status == 2
    store = open_store(filled, read_only=True)
    with pytest.raises(ExportFault, match=r"csv, parquet.*'xlsx'"):
        export(store, out, "xlsx")
    with pytest.raises(StoreFault, match=r"(?i)read.?only"):
        store.commit(Batch(counters={("", "x"): 1}))
    store.close()
