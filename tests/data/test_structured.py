"""Results to plain JSON data and back, every fault with its place."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import pytest

from hygrokf.data.structured import StructureFault, optional, plain, structured


@dataclass(frozen=True)
class Bounds:
    lower_h: float = math.nan
    upper_h: float = math.nan
    note: str | None = optional()
    scale: float = optional(math.nan)


@dataclass(frozen=True)
class Made:
    name: str
    parts: Mapping[str, Bounds] = field(default_factory=dict)
    rows: tuple[Bounds, ...] = ()
    curve: np.ndarray = field(default_factory=lambda: np.empty(0))
    verdict: Literal["believe", "reject"] = "believe"
    span: tuple[float, float] | None = None
    gain: float = math.nan
    more: Any = None


WHOLE = Made(
    "T07",
    {"thermal": Bounds(1.0, math.inf)},
    (Bounds(), Bounds(0.5, 2.0, "wide")),
    np.array([[1.0, math.nan], [2.0, 3.0]]),
    "reject",
    (1.0, 2.0),
    0.25,
    {"seen": [1, math.nan, np.float64(2.0)]},
)


def test_data_of_a_result_are_json_and_come_back() -> None:
    data = json.loads(json.dumps(plain(WHOLE), allow_nan=False))
    assert data["parts"] == {"thermal": {"lower_h": 1.0, "upper_h": None}}
    assert data["curve"] == [[1.0, None], [2.0, 3.0]] and data["more"] == {"seen": [1, None, 2.0]}
    assert data["rows"][1]["note"] == "wide" and "note" not in data["rows"][0]
    assert plain(Bounds(scale=2.0))["scale"] == 2.0 and math.isnan(structured(Bounds, {}).scale)
    again = structured(Made, data)
    assert plain(again) == data
    assert again.rows[1] == WHOLE.rows[1] and math.isnan(again.parts["thermal"].upper_h)
    np.testing.assert_array_equal(again.curve, WHOLE.curve)


def test_keys_of_later_files_are_ignored() -> None:
    assert structured(Made, {"name": "x", "gain": 0.5, "of the future": 1}).gain == 0.5


@pytest.mark.parametrize(
    ("change", "place", "words"),
    [
        ({"name": 3}, "name", "expected a text, found 3"),
        ({"parts": {"thermal": {"lower_h": "a"}}}, "parts.thermal.lower_h", "expected a number, found 'a'"),
        ({"parts": {"thermal": {"lower_h": True}}}, "parts.thermal.lower_h", "expected a number, found True"),
        ({"rows": [{}, {"note": 3}]}, "rows[1].note", "expected a text"),
        ({"rows": [3]}, "rows[0]", "expected an object (Bounds), found 3"),
        ({"curve": [[1.0], [1.0, 2.0]]}, "curve", "rows of equal length"),
        ({"verdict": "perhaps"}, "verdict", "expected one of 'believe', 'reject', found 'perhaps'"),
        ({"span": [1.0]}, "span", "expected 2 values, found [1.0]"),
    ],
)
def test_a_fault_names_its_place(change: dict, place: str, words: str) -> None:
    with pytest.raises(StructureFault) as fault:
        structured(Made, {"name": "x"} | change)
    (said,) = fault.value.faults
    assert said.startswith(f"{place}: ") and words in said


def test_all_faults_are_told_at_once() -> None:
    with pytest.raises(StructureFault) as fault:
        structured(Made, {"rows": 3, "curve": "x", "gain": "much"})
    assert [one.partition(":")[0] for one in fault.value.faults] == ["name", "rows", "curve", "gain"]


@pytest.mark.parametrize("data", [None, [1], "text", 3.0])
def test_what_is_no_object_is_refused(data: object) -> None:
    with pytest.raises(StructureFault, match="expected an object"):
        structured(Made, data)
