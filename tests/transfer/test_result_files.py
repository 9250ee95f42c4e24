"""compare.json and transfer.json: files are read whole, and faults are reported with their places."""

from __future__ import annotations

import copy
import json
import math
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from builders.comparison_case import made_column
from golden.difference import read

from hygrokf.data.result_file import ResultFault, read_result, result_text
from hygrokf.data.structured import plain
from hygrokf.transfer.comparison import ComparisonResults, compare
from hygrokf.transfer.transfer_results import RecordCourse, TransferResults, read_courses, write_courses

MADE = {
    ComparisonResults: lambda: plain(compare([made_column("a", 1), made_column("b", 2)])),
    TransferResults: lambda: read("demo")["json"]["transferred/transfer.json"],
}


@pytest.fixture(params=MADE, ids=lambda kind: kind.__name__)
def kept(request: pytest.FixtureRequest, tmp_path: Path) -> tuple[type, dict, Path]:
    """The class of a result, its data, and a file to write to."""
    data = MADE[request.param]() | {"created": "2024-05-01T12:00:00"}
    return request.param, data, tmp_path / "result.json"


def test_a_file_is_read_whole_also_without_what_was_added_later(kept: tuple[type, dict, Path]) -> None:
    kind, data, path = kept
    path.write_text(json.dumps(data))
    found = read_result(kind, path, "command")
    assert json.loads(result_text(found)) == data
    (data["columns"] if "columns" in data else data["records"])[0].pop("verdicts")
    path.write_text(json.dumps(data))
    assert read_result(kind, path, "command").version == found.version
    assert plain(pickle.loads(pickle.dumps(found))) == plain(found)


def test_a_damaged_file_is_refused_with_every_fault_and_its_place(
    kept: tuple[type, dict, Path],
) -> None:
    kind, data, path = kept
    spoilt = copy.deepcopy(data) | {"version": "0.0.7"}
    if kind is ComparisonResults:
        spoilt["rows"][3]["n"] = "many"
        del spoilt["columns"][1]["fit"]
        places = ("rows[3].n", "columns[1]")
    else:
        spoilt["records"][0]["verdict"] = "maybe"
        spoilt["records"][0]["parameters"]["hygric_k"]["own"] = "large"
        places = ("records[0].verdict", "records[0].parameters.hygric_k.own")
    path.write_text(json.dumps(spoilt))
    with pytest.raises(ResultFault, match=r"hygrokf 0\.0\.7; run it again") as fault:
        read_result(kind, path, "command")
    assert all(f"{place}" in str(fault.value) for place in places)


@pytest.mark.parametrize("content", ["{}", "[1]", "not JSON", ""])
def test_other_files_are_refused(kept: tuple[type, dict, Path], content: str) -> None:
    kind, _, path = kept
    with pytest.raises(ResultFault, match="no such file"):
        read_result(kind, path, "command")
    path.write_text(content)
    with pytest.raises(ResultFault, match="run it again"):
        read_result(kind, path, "command")


def test_results_become_frames(kept: tuple[type, dict, Path]) -> None:
    kind, data, path = kept
    path.write_text(json.dumps(data))
    found = read_result(kind, path, "command")
    if kind is ComparisonResults:
        frame = found.to_frame()
        assert set(frame.kind) == {"rmse", "rule", "skill", "difference"} and frame.n.min() > 0
        return
    (one,) = found.records
    frame = one.to_frame()
    assert list(frame.index) == list(one.parameters)
    assert frame.loc["hygric_k", "own"] == one.parameters["hygric_k"].own
    assert math.isnan(frame.loc["hygric_diffusion", "difference"])
    assert str(one) == "synthetic-turbine-31 on synthetic-turbine-32: transfers"


def course() -> RecordCourse:
    time = 1e9 + 3600.0 * np.arange(5)
    on = np.array([True, False, True, True, True])
    value = {"temperature_K": np.array([280.0, np.nan, 281.0, 282.0, 283.0])}
    return RecordCourse(time, math.nan, on, ~on, value, {"as_is": value, "simulated": {}})


def test_courses_come_back_and_damaged_ones_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "courses.npz"
    write_courses([course(), course()], path)
    again = read_courses(path, 2, "command")[1]
    np.testing.assert_array_equal(
        again.simulated["as_is"]["temperature_K"], course().measured["temperature_K"]
    )
    assert again.scored.tolist() == course().scored.tolist() and math.isnan(again.until_s)
    with pytest.raises(ResultFault, match="2 records where 3"):
        read_courses(path, 3, "command")
    with pytest.raises(ValueError, match=r"scored: .*; as_is temperature_K: expected .*; time_s: "):
        replace(
            course(),
            time_s=np.zeros(5),
            scored=np.zeros(2),
            simulated={"as_is": {"temperature_K": np.zeros(3)}},
        )
    np.savez(path, **{"0/time_s": course().time_s})
    with pytest.raises(ResultFault, match=r"missing .*'scored'"):
        read_courses(path, 1, "command")
    write_courses([course(), course()], path)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ResultFault, match="run it again"):
        read_courses(path, 2, "command")
