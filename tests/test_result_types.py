"""All results alike: each is copied between processes, and its frames have times in UTC and units."""

from __future__ import annotations

import json
import lzma
import pickle
import re
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import pandas as pd
import pytest
from builders.climate_case import small_study as study
from builders.comparison_case import made_column
from builders.discovery_case import discovery_case, residuals_case, typed
from builders.report_case import report_case

from hygrokf.cases.case_file import CaseFault
from hygrokf.cases.frames import read_frames
from hygrokf.cases.summary import RecordSummary, describe
from hygrokf.data.record import Record, Series
from hygrokf.data.result_file import result_text
from hygrokf.data.signals import SIGNALS
from hygrokf.data.structured import structured
from hygrokf.discovery.discovery_results import Discovered, Discovery, DiscoveryResults
from hygrokf.evaluation.prediction import Course
from hygrokf.evaluation.scoring import Errors
from hygrokf.fleet.fleet_results import FleetResults
from hygrokf.identification.fit import Fit
from hygrokf.identification.fit_on_record import Evaluation, SimulationSummary
from hygrokf.identification.fit_results import FitResults
from hygrokf.identification.turbine_type import TurbineType, pool_types
from hygrokf.transfer.comparison import ComparisonColumn, ComparisonResults, compare
from hygrokf.transfer.transfer_results import Transfer, TransferResult, TransferResults

GOLDEN = Path(__file__).parent / "golden" / "references" / "demo.json.xz"
START_S = 1594771200.0


@cache
def _golden() -> dict[str, Any]:
    return json.loads(lzma.decompress(GOLDEN.read_bytes()))["json"]


def fit() -> Fit:
    return Fit.from_json(_golden()["fit/fit.json"])


def fit_results() -> FitResults:
    return fit().results


@cache
def record() -> Record:
    time = START_S + 600.0 * np.arange(200)
    wave = np.sin(time / 9000.0)
    return Record(
        "tower 7",
        (
            Series("cabinet_temperature", time + 30.0, 300.0 + wave, source="cabinet.csv"),
            Series("ambient_temperature", time, np.where(wave > 0.9, np.nan, 285.0 + wave)),
            Series("active_power", time + 600.0, 1e6 * (1.0 + wave), hold="mean", interval_s=600.0),
        ),
        until_s=float(time[150]),
    )


def record_summary() -> RecordSummary:
    return describe(record())


def course() -> Course:
    value = np.linspace(290.0, 300.0, 5)
    one = "cabinet_temperature"
    return Course(
        0.25 * np.arange(5.0), START_S, {one: value}, {one: 0.1 * value}, {one: value}, units={one: "K"}
    )


def evaluation() -> Evaluation:
    return Evaluation(fit="demo", record="tower 7", rmse={"validation": {"temperature_K": Errors(total=1.0)}})


def simulation_summary() -> SimulationSummary:
    return SimulationSummary("demo", "tower 7", "2020-07-15T00:00:00Z", "2020-07-16T00:00:00Z", 144)


def discovery_results() -> DiscoveryResults:
    return typed(discovery_case())


def discovered() -> Discovered:
    return Discovered(discovery_results(), residuals_case(), residuals_case(0.2))


def discovery() -> Discovery:
    return Discovery(discovery_results(), residuals_case(), base=fit())


def fleet() -> FleetResults:
    stamps = {"start": "2020-07-15T00:00:00Z", "end": "2020-08-15T00:00:00Z"}
    done = {"turbine": "W1", "status": "done", **stamps, "thermal_value_h": 1.5, "thermal_lower_h": 1.4}
    failed = {"turbine": "W2", "status": "failed", "reason": "no such file"}
    return FleetResults("fit", (done, failed), "Park")


def transfer_results() -> TransferResults:
    return structured(TransferResults, _golden()["transferred/transfer.json"])


def transfer_result() -> TransferResult:
    return transfer_results().records[0]


def transfer() -> Transfer:
    return Transfer(transfer_result(), made_column("any", 1).course, fit())


def column() -> ComparisonColumn:
    return made_column("first", 1)


@cache
def comparison_results() -> ComparisonResults:
    return compare([column(), made_column("second", 2, scale=1.4)])


def turbine_type() -> TurbineType:
    return pool_types([fit(), replace(fit(), name="second")])


MADE: tuple[Callable[[], Any], ...] = (
    fit, fit_results, record, record_summary, course, evaluation, simulation_summary, discovery_results,
    discovered, discovery, study, fleet, transfer_results, transfer_result, transfer, column,
    comparison_results, turbine_type,
)  # fmt: skip
FRAMES: dict[Callable[[], Any], Callable[[Any], pd.DataFrame]] = {
    record: lambda one: one["active_power"].to_frame(),
}
"""How a frame is made where it needs an argument."""


@pytest.mark.parametrize("make", MADE, ids=lambda make: make.__name__)
def test_a_result_is_copied_between_processes(make) -> None:
    one = make()
    again = pickle.loads(pickle.dumps(one))
    assert type(again) is type(one) and result_text(again) == result_text(one)


def _framed() -> list[Callable[[], Any]]:
    return [make for make in MADE if make in FRAMES or hasattr(get_type_hints(make)["return"], "to_frame")]


STAMP = re.compile(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d")
UNITLESS = {"readings", "gaps", "n", "fixed", "at_bound", "warnings", "converged"}
"""Counts and flags."""


@pytest.mark.parametrize("make", _framed(), ids=lambda make: make.__name__)
def test_a_frame_has_times_in_utc_and_a_unit_for_every_number(make) -> None:
    frame = FRAMES.get(make, lambda one: one.to_frame())(make())
    assert len(frame)
    for name, kind in [("index", frame.index.dtype), *frame.dtypes.items()]:
        values = frame.index if name == "index" else frame[name]
        if pd.api.types.is_datetime64_any_dtype(kind):
            assert str(kind.tz) == "UTC", name
        elif not pd.api.types.is_numeric_dtype(kind):
            assert not any(isinstance(one, str) and STAMP.match(one) for one in values), name
        elif name != "index" and name not in UNITLESS:
            stated = frame.attrs.get("units", {}).get(name) or re.search(r"\[.+\]$", str(name))
            assert stated or "unit" in frame.columns, f"{name} has no unit"


def test_a_record_goes_through_frames_and_back() -> None:
    frames = record().to_frames()
    again = read_frames(frames, stamp={"active_power": "end"}, interval={"active_power": "600s"})
    for one in record().series:
        other = again[one.signal]
        np.testing.assert_array_equal(other.time, one.time)
        np.testing.assert_allclose(other.value, one.value, rtol=1e-12)
        assert (other.hold, other.interval_s) == (one.hold, one.interval_s)
        assert frames[one.signal].attrs["units"] == {one.signal: SIGNALS[one.signal].unit}


def test_units_that_contradict_those_of_a_frame_are_refused() -> None:
    cabinet, ambient = (record()[f"{place}_temperature"].to_frame() for place in ("cabinet", "ambient"))
    frame = cabinet.join(ambient, how="outer")
    frame.attrs["units"] = {"cabinet_temperature": "degC", "ambient_temperature": "degC"}
    with pytest.raises(CaseFault, match="is in degC as the frame itself states, units says K"):
        read_frames(frame, units=dict.fromkeys(frame.columns, "K"))


def test_the_series_of_a_fit_are_copied_with_it() -> None:
    _, series = report_case()
    one = Fit.from_json(_golden()["fit/fit.json"])
    again = pickle.loads(pickle.dumps(Fit(one.name, one.design, one.values, one.results, series)))
    assert set(again.series) == set(series)
    assert all(np.array_equal(again.series[name], series[name], equal_nan=True) for name in series)
