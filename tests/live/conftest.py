"""The synthetic turbine that most tests of the live tracker use; a module may bring a record of its own."""

from __future__ import annotations

from pathlib import Path

import pytest
from builders.live_case import live_record, live_turbine

from hygrokf.data.record import Record
from hygrokf.live.turbines import Turbine


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The turbine's case file."""
    folder = tmp_path_factory.mktemp("turbine")
    live_record(folder, seed=7, days=3.0)
    return folder / "case.toml"


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Record:
    return live_record(tmp_path_factory.mktemp("record"), seed=7, days=3.0)


@pytest.fixture(scope="module")
def turbine(record: Record) -> Turbine:
    return live_turbine(record)
