"""Bounds that cover as often as they say: `scripts/coverage` in small by default, in full with the slow marker."""

from __future__ import annotations

import importlib.util
import json
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType

import pytest
from scipy.stats import binom

SCRIPT = Path(__file__).resolve().parents[1] / "scripts" / "coverage"


@pytest.fixture(scope="module")
def script() -> ModuleType:
    loader = SourceFileLoader("coverage_script", str(SCRIPT))
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader("coverage_script", loader))
    loader.exec_module(module)
    return module


def one_plant(seed: int, days: float, disturbance: str) -> dict:
    """In a process of its own: the script is read anew there."""
    loader = SourceFileLoader("coverage_script", str(SCRIPT))
    module = importlib.util.module_from_spec(importlib.util.spec_from_loader("coverage_script", loader))
    loader.exec_module(module)
    return module.one(seed, days, {"disturbance": disturbance, "sensor_errors": "cabinet"}, None)


def test_a_plant_becomes_a_row(script: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    row = script.one(4000, 20.0, {"disturbance": "ou", "sensor_errors": "cabinet"}, None)
    for part in ("thermal", "hygric"):
        found = row[part]
        assert 0.5 < found["value"] / found["truth"] < 2.0
        assert found["lower"] < found["value"] < found["upper"]
        assert found["covered"] == (found["lower"] <= found["truth"] <= found["upper"])
    other = row | {"seed": 4001}
    other["thermal"] = row["thermal"] | {"covered": not row["thermal"]["covered"]}
    found = script.summary([row, other])
    assert (found["n"], found["thermal"]["covered"], found["hygric"]["covered"]) == (
        2,
        1,
        2 * row["hygric"]["covered"],
    )
    (tmp_path / "two.jsonl").write_text("".join(json.dumps(r) + "\n" for r in (row, other)))
    assert script.table([tmp_path / "two.jsonl"]).startswith("| two | 2 | ")


@pytest.mark.slow
def test_bounds_cover_where_the_class_is_right(script: ModuleType) -> None:
    """200 plants: mean errors within 5 % and 20 %, coverage within the 95 % band of a binomial with p = 0.95."""
    with ProcessPoolExecutor(2) as pool:
        rows = list(pool.map(partial(one_plant, days=90.0, disturbance="ou"), range(1000, 1200)))
    found = script.summary(rows)
    least, most = binom.interval(0.95, len(rows), 0.95)
    assert abs(found["thermal"]["mean_bias_pct"]) < 5.0
    assert abs(found["hygric"]["mean_bias_pct"]) < 20.0
    for part in ("thermal", "hygric"):
        assert least <= found[part]["covered"] <= most, found[part]
    assert 1.0 < found["free_run_temperature_K"] < 2.0
    assert 0.3 < found["free_run_absolute_humidity_g_m3"] < 0.5
