"""The synthetic turbine that most tests of the live tracker use; a module may bring a record of its own."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from builders.brokers import Mosquitto, mosquitto
from builders.live_case import live_record, live_turbine

from hygrokf.data.record import Record
from hygrokf.live.sources.local import record_mapping
from hygrokf.live.sources.payload import PayloadMapping
from hygrokf.live.storage.store import Store, open_store
from hygrokf.live.turbine import Turbine


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The turbine's case file."""
    folder = tmp_path_factory.mktemp("turbine")
    live_record(folder, seed=7, days=3.0)
    return folder / "case.toml"


@pytest.fixture(scope="module")
def record(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Record:
    """Three days, or what the module states as RECORD."""
    given = getattr(request.module, "RECORD", {"seed": 7, "days": 3.0})
    return live_record(tmp_path_factory.mktemp("record"), **given)


@pytest.fixture(scope="module")
def mapping(record: Record) -> PayloadMapping:
    return record_mapping(record, "T1")


@pytest.fixture(scope="module")
def turbine(record: Record) -> Turbine:
    return live_turbine(record)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with closing(open_store(f"sqlite:{tmp_path / 'live.db'}")) as made:
        yield made


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Mosquitto]:
    folder = tmp_path / "broker"
    folder.mkdir()
    with mosquitto(folder) as made:
        yield made
