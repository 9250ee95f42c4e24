"""What is tracked where no file says so: from models and URLs to turbines and sources."""

from __future__ import annotations

from pathlib import Path

import pytest
from builders.fit_case import bare_fit
from builders.live_case import live_fit, live_record

from hygrokf.data.actuators import ACTUATORS
from hygrokf.data.signals import SIGNALS
from hygrokf.identification.fit import write_fit
from hygrokf.live.config import ConfigFault
from hygrokf.live.defaults import default_config, default_mapping, default_table, page_at
from hygrokf.live.web.page_settings import PageSettings
from hygrokf.modelling.design import INPUT_HOLDS


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("models")
    fit = live_fit(live_record(folder, seed=3, days=2.0))
    for name in ("T1", "T2"):
        write_fit(bare_fit(name, fit.design, fit.values), folder / name)
    return [folder / "T1" / "fit.json", folder / "T2"]


def config(models: list[Path], *sources: str):
    return default_config(models, sources, "sqlite:live.db", PageSettings())


def test_the_only_turbine_needs_no_name(models: list[Path]) -> None:
    found = config(models[:1], "stdin")
    content = {
        "time": 1.6e9,
        "cabinet_temperature": 20.0,
        "cabinet_relative_humidity": 50.0,
        "active_power": 800.0,
    }
    (readings,) = found.streams[0].mapping.read(content, 1.6e9)
    assert readings.turbine == "T1"
    assert {r.signal: r.value for r in readings.readings} == {
        "cabinet_temperature": pytest.approx(293.15), "cabinet_relative_humidity": pytest.approx(0.5),
        "active_power": pytest.approx(8e5),
    }  # fmt: skip


def test_several_are_told_apart_by_their_names(models: list[Path]) -> None:
    found = config(models, "stdin", "mqtt://user@127.0.0.1:1884/scada/+/#")
    assert set(found.turbines) == {"T1", "T2"}
    mapping = found.streams[0].mapping
    (readings,) = mapping.read({"turbine": "T2", "time": 1.6e9, "rain": 0.1}, 1.6e9)
    assert readings.turbine == "T2"
    assert found.streams[1].url.startswith("mqtt://127.0.0.1:1884")


def test_a_topic_behind_the_broker() -> None:
    assert default_table("mqtts://a.example/x/+/#") == {"url": "mqtts://a.example", "topics": ["x/+/#"]}
    assert default_table("mqtt://a.example") == {"url": "mqtt://a.example"}
    assert default_table("file:a/b.csv") == {"url": "file:a/b.csv"}


def test_all_faults_at_once(models: list[Path], tmp_path: Path) -> None:
    with pytest.raises(ConfigFault) as fault:
        config([models[0], models[0], tmp_path / "none"], "kafka://x", "mqtt://127.0.0.1")
    said = str(fault.value)
    assert len(fault.value.faults) == 4
    for word in ("a second model of 'T1'", "none", "url must begin with", "topics"):
        assert word in said
    with pytest.raises(ConfigFault, match="no source"):
        config(models)
    with pytest.raises(ConfigFault, match="other machines reach"):
        page_at("0.0.0.0:80")
    assert page_at(None).host == "127.0.0.1"


def test_every_signal_has_a_unit_and_the_hold_of_the_table() -> None:
    mapping = default_mapping()
    holds = {name: one.form.hold for name, one in mapping.fields.items()}
    assert holds == {name: s.hold for name, s in SIGNALS.items()}
    for name in (*ACTUATORS, "preheating", "rain", "cloud_cover", "active_power", "rotor_speed"):
        assert (holds[name], INPUT_HOLDS[name]) == ("previous", "mean"), (
            name
        )  # a model takes the mean of each step
    assert holds["ambient_temperature"] == holds["cabinet_relative_humidity"] == "linear"
    assert (
        mapping.fields["ambient_temperature"].unit == "degC" and mapping.fields["active_power"].unit == "kW"
    )
    assert all(one.conversion.factor > 0.0 for one in mapping.fields.values())
