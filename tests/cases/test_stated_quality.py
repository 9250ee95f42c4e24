"""Quality beside values in case files and frames: bad readings are left out, unstated quality is doubted."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from builders.faults import faults_of

from hygrokf.cases.case_file import read_case
from hygrokf.cases.frames import read_frames
from hygrokf.cases.summary import describe
from hygrokf.commands.main import main
from hygrokf.data.record import Record
from hygrokf.texts.record_codes import DoubtCode, RecordCode, touched

COUNT = 900
BAD, UNSURE = [0, 90, 450], [7]
UNITS = {"cabinet_temperature": "degC", "ambient_temperature": "degC"}


def table() -> pd.DataFrame:
    """Readings with a quality in OPC DA's codes; bad rows hold what the system put there."""
    index = pd.date_range("2024-01-05", periods=COUNT, freq="10min", tz="UTC", name="time")
    noise = np.random.default_rng(7).normal(0.0, 0.2, (2, COUNT))
    day = np.round(5.0 * np.sin(np.arange(COUNT) / 22.9) + noise[0], 1)
    warm, marks = np.round(15.0 + day + noise[1], 1), np.full(COUNT, 192)
    warm[BAD], marks[BAD], marks[UNSURE] = 0.0, [0, 24, 0], 64
    rows = {"cabinet_temperature": warm, "cabinet_temperature_quality": marks, "ambient_temperature": day}
    return pd.DataFrame(rows, index=index)


def write(folder: Path, kind: str, of_source: str, of_signal: str) -> Path:
    """A case file and its export."""
    frame = table().reset_index()
    if kind == "parquet":
        frame.to_parquet(folder / "export.parquet")
    else:
        cells = frame.astype({"cabinet_temperature": object})
        cells.loc[BAD[1], "cabinet_temperature"] = "Comm Fail"  # text in a bad row is no fault
        cells.to_csv(folder / f"export.{kind}", index=False)
    (folder / "case.toml").write_text(
        f'[[source]]\nfile = "export.{kind}"\ntime = "time"\n{of_source}\n'
        f'signals.cabinet_temperature = {{ column = "cabinet_temperature", unit = "degC"{of_signal} }}\n'
        'signals.ambient_temperature = { column = "ambient_temperature", unit = "degC" }\n'
    )
    return folder / "case.toml"


def of_file(*arguments: Any) -> Record:
    return read_case(write(*arguments))


@pytest.mark.parametrize("kind", ["csv", "parquet", "frame"])
@pytest.mark.parametrize(
    ("vocabulary", "use_uncertain", "missing", "said", "doubt"),
    [
        ("opc-da", True, BAD, "3 bad left out, 1 uncertain used", ""),
        ("opc-da", False, [*BAD, *UNSURE], "3 bad left out, 1 uncertain left out", ""),
        ([192, 64], True, BAD, "3 bad left out", ""),
        (None, True, BAD, "1 bad left out, 1 uncertain used, 2 ambiguous left out", 'vocabulary = "opc-da"'),
    ],
)  # fmt: skip
def test_readings_of_bad_quality_are_left_out_and_counted(
    kind: str, vocabulary: Any, use_uncertain: bool, missing: list, said: str, doubt: str, tmp_path: Path
) -> None:
    if kind == "frame":
        quality = {"cabinet_temperature": "cabinet_temperature_quality"}
        options = {"quality": quality, "vocabulary": vocabulary, "use_uncertain": use_uncertain}
        record = read_frames(table(), units=UNITS, **options)
    else:
        keys = f"use_uncertain = {json.dumps(use_uncertain)}\n"
        keys += "" if vocabulary is None else f"vocabulary = {json.dumps(vocabulary)}"
        record = of_file(tmp_path, kind, keys, ', quality = "cabinet_temperature_quality"')
    series = record["cabinet_temperature"]
    assert np.flatnonzero(series.missing).tolist() == sorted(missing)
    assert not record["ambient_temperature"].missing.any()
    shown = describe(record)
    assert [one for one in shown.warnings if one.endswith(said)]
    doubts = " ".join(map(str, shown.doubts))
    assert doubt in doubts and ("vocabulary" in doubts) is bool(doubt)


def test_a_quality_that_nobody_stated_is_a_doubt(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    record = read_frames(table(), units=UNITS)
    (doubt,) = record.doubts
    assert doubt.code is DoubtCode.QUALITY_DOUBTED and touched(doubt) == ("thermal", "hygric")
    unstated = doubt.values["doubt"]
    assert unstated.code is RecordCode.QUALITY_UNSTATED
    assert unstated.values["name"] == "cabinet_temperature_quality" and '"opc-da"' in doubt.text
    main(["check", str(write(tmp_path, "parquet", "", ""))])
    said = capsys.readouterr().out
    assert said.index("doubts:") < said.index("seems to hold its quality")
    denied = of_file(tmp_path, "parquet", "", ', quality = ""')
    assert DoubtCode.QUALITY_DOUBTED not in [one.code for one in describe(denied).doubts]
    clean = table().assign(cabinet_temperature_quality=192)
    # where all is good nothing is ignored
    assert not read_frames(clean, units=UNITS).doubts


def test_a_vocabulary_that_does_not_fit_is_doubted(tmp_path: Path) -> None:
    of_signal = ', quality = "cabinet_temperature_quality"'
    record = of_file(tmp_path, "parquet", 'vocabulary = "opc-ua"', of_signal)
    assert 'state vocabulary = "opc-da"' in " ".join(map(str, describe(record).doubts))


def test_wrong_statements_are_told_together(tmp_path: Path) -> None:
    given = faults_of(
        lambda: of_file(tmp_path, "csv", 'vocabulary = "opc"\nuse_uncertain = 1', ', quality = "Q"')
    )
    assert any("vocabulary: expected one of" in one for one in given)
    assert any("use_uncertain must be true or false" in one for one in given)
    given = faults_of(lambda: of_file(tmp_path, "csv", "", ', quality = "Q"'))
    assert any('no column "Q"' in one for one in given)
    given = faults_of(lambda: read_frames(table(), units=UNITS, quality={"cabinet_temperature": "Q"}))
    assert any('no column "Q"' in one for one in given)


# -- units that a frame states itself ------------------------------------------------------------------------
class Degree:
    """A unit as pint formats it."""

    def __format__(self, form: str) -> str:
        return {"~P": "°F"}[form]


class PintLike(pd.Float64Dtype):
    """A type of numbers with a unit, as that of pint-pandas."""

    units = Degree()


class PintArray(pd.arrays.FloatingArray):
    @property
    def dtype(self) -> PintLike:
        return PintLike()


def test_a_frame_s_own_units_are_kept_or_contradicted() -> None:
    frame = table()[list(UNITS)]
    stated = frame.copy()
    stated.attrs["units"] = {"cabinet_temperature": "°F", "ambient_temperature": "degC"}
    pint = frame.copy()
    values = pint["cabinet_temperature"].to_numpy()
    pint["cabinet_temperature"] = pd.Series(PintArray(values, np.zeros(COUNT, dtype=bool)), index=pint.index)
    for own in (stated, pint):
        found = read_frames(own, units={"ambient_temperature": "degC"})
        expected = (values[1] + 459.67) / 1.8
        assert found["cabinet_temperature"].value[1] == pytest.approx(expected)
        read_frames(own, units={**UNITS, "cabinet_temperature": "degF"})
        (fault,) = faults_of(lambda own=own: read_frames(own, units=UNITS))
        assert 'column "cabinet_temperature" is in °F as the frame itself states, units says degC' in fault


def test_rows_of_impossible_stamps_are_passed_and_counted(tmp_path: Path) -> None:
    case = write(tmp_path, "csv", "", "")
    lines = (tmp_path / "export.csv").read_text().splitlines()
    lines[3] = lines[3].replace("2024-01-05 00:20:00+00:00", "infinity")
    lines[4] = lines[4].replace("2024-", "2924-")
    lines[91] = lines[91].replace("Comm Fail", "-nan")
    (tmp_path / "export.csv").write_text("\n".join(lines) + "\n")
    record = read_case(case)
    assert len(record["ambient_temperature"]) == COUNT - 2
    said = " ".join(record.warnings)
    assert "1 row without a stamp left out: line 4" in said
    assert "rows with an impossible stamp left out: 1 before 1850 or after 2200: line 5" in said
