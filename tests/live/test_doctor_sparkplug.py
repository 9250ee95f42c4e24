"""The table of a Sparkplug source, and what the doctor says of its edge nodes."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import count
from pathlib import Path

import pytest
from builders.brokers import Mosquitto, needs_mosquitto
from builders.sparkplug_peer import FLOAT, EdgeNode
from builders.track_case import write_model
from builders.waiting import eventually, repeating

from hygrokf.data.numbers import stated_marks
from hygrokf.data.toml_form import Place
from hygrokf.live.config import read_config, stream_of
from hygrokf.live.doctor import check as doctor_check
from hygrokf.live.doctor.check import Check
from hygrokf.live.doctor.examination import examine
from hygrokf.live.doctor.payloads import try_payloads
from hygrokf.live.sources import sparkplug_node
from hygrokf.live.sources.mqtt import Mqtt
from hygrokf.live.sources.payload import Field, PayloadMapping
from hygrokf.live.sources.sparkplug import Sparkplug

NAME = "Cabinet/Temperature"
MAPPING = PayloadMapping(
    {NAME: Field("cabinet_temperature", "degC")},
    turbine="{4}",
    tag="tag",
    value="value",
    turbines={"W01": "T1"},
)
TABLE = 'url = "mqtt://h"\nformat = "sparkplug-b"\n'
TRACK = f"""\
store = "sqlite:live.db"
page = "127.0.0.1:0"
[[turbine]]
name = "W01"
fit = "W01"
[mapping]
turbine = "{{4}}"
[mapping.signals]
"{NAME}" = {{ signal = "cabinet_temperature", unit = "degC" }}
"""


def read(text: str) -> tuple[object, list[str]]:
    place = Place("[[source]] 1")
    return stream_of(tomllib.loads(text), place, Path(), MAPPING), place.faults


@pytest.mark.parametrize("topics", ["spBv1.0/#", "spBv1.0/+/+/N1/#", "spBv1.0/Farm/+/N1", "spBv1.0/Farm/+"])
def test_a_sparkplug_table(topics: str) -> None:
    stream, faults = read(f'{TABLE}topics = ["{topics}"]')
    assert faults == [] and isinstance(stream, Sparkplug) and not stream.broker.rebirth_requests
    # the layout of its payloads is its own; turbines and signals are those of the mapping
    assert (stream.mapping.tag, stream.mapping.quality, stream.mapping.turbine) == ("", "quality", "{4}")
    assert stream.signals("T1") == {"cabinet_temperature"}


def test_a_metric_s_name_may_contain_the_turbine() -> None:
    mapping = replace(
        MAPPING,
        turbine="",
        tag="",
        value="",
        tag_pattern="{turbine}/{field}",
        marks=stated_marks(",", None),
        records="values",
    )
    place = Place("[[source]] 1")
    stream = stream_of(tomllib.loads(f'{TABLE}topics = ["spBv1.0/#"]'), place, Path(), mapping)
    names = {f"W01/{NAME}": 21.5, f"W09/{NAME}": 22.5, "Load": 1.0}
    (found,) = [
        one for one in stream.mapping.read({**names, "time": 1.7e9, "quality": "good"}, 1.7e9) if one.readings
    ]
    assert found.turbine == "T1" and [one.value for one in found.readings] == [21.5 + 273.15]


def test_messages_are_mapped_unless_a_format_is_stated() -> None:
    assert type(read('url = "mqtt://h"\ntopics = ["a"]')[0]) is Mqtt


PLAIN = 'url = "mqtt://h"\ntopics = ["a"]\n'


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        (TABLE + 'topics = ["spBv1.0/Farm/DDATA/#"]', "must include births, data and deaths"),
        (TABLE + 'topics = ["scada/#"]', "spBv1.0/GROUP/#"),
        (TABLE + 'topics = ["$share/g/spBv1.0/#"]', "a shared subscription misses messages"),
        (TABLE + 'topics = ["spBv1.0/#"]\nweather = true', "weather: not with format"),
        (TABLE + 'topics = ["spBv1.0/#"]\nrebirth_requests = "yes"', "rebirth_requests"),
        (PLAIN + "rebirth_requests = true", 'only with format = "sparkplug-b"'),
        (PLAIN + 'format = "sparkplug"', "sparkplug-b"),
    ],
)
def test_faults_of_a_table(text: str, fault: str) -> None:
    _, (found,) = read(text)
    assert fault in found


# -- the doctor ----------------------------------------------------------------------------------------------
@pytest.fixture
def look(
    tmp_path: Path, broker: Mosquitto, monkeypatch: pytest.MonkeyPatch
) -> Callable[[str], dict[str, Check]]:
    monkeypatch.setattr(doctor_check, "is_synchronised", lambda: True)
    monkeypatch.setattr(sparkplug_node, "REORDER_S", 0.2)
    write_model(tmp_path / "W01")
    file = tmp_path / "track.toml"
    file.write_text(
        f'{TRACK}[[source]]\nurl = "{broker.url}"\nformat = "sparkplug-b"\ntopics = ["spBv1.0/Farm/#"]\n'
    )

    def looked(words: str) -> dict[str, Check]:
        """What the doctor finds once that is among it: a busy machine may deliver nothing within a second."""

        def examined() -> dict[str, Check] | None:
            found = examine(read_config(file), file, 1.0, False)
            checks = {one.text: one for one in found if broker.url in one.about}
            return checks if any(re.search(words, text) for text in checks) else None

        return eventually(examined)

    return looked


@contextmanager
def publishing(node: EdgeNode, act: Callable[[int], None], **born: float) -> Iterator[None]:
    """An edge node, born with some values, that acts every tenth of a second as long as the block lasts."""
    numbers = count()
    with node.connected():
        node.bear(None, **born)
        with repeating(lambda: act(next(numbers))):
            yield


def found(checks: dict[str, Check], words: str) -> Check:
    (one,) = (check for text, check in checks.items() if words in text)
    return one


@needs_mosquitto
def test_the_doctor_examines_edge_nodes(broker: Mosquitto, look: Callable[[str], dict[str, Check]]) -> None:
    node = EdgeNode(broker, devices={"W01": {NAME: FLOAT}})

    def by_name(number: int) -> None:
        node.send_named("W01", NAME, 21.0 + number % 2)

    def by_alias(number: int) -> None:
        node.send("W01", {NAME: 21.0 + number % 2})

    def with_births(number: int) -> None:
        if number % 4 == 0:
            node.bear()
        by_alias(number)

    def with_gaps(number: int) -> None:
        node.lose = number % 6 == 5
        by_name(number)

    with publishing(node, by_name):
        checks = look("payloads gave readings")
    assert found(checks, "can be read").level == "ok"
    assert found(checks, "payloads gave readings").level == "ok"
    assert "queue_qos0_messages" in found(checks, "published at QoS 0").remedy
    with publishing(node, by_alias):
        checks = look("no birth certificate")
    assert "Node Control/Rebirth" in found(checks, "no birth certificate").remedy
    assert not any("gave readings" in text for text in checks)
    with publishing(node, with_births):
        look(r"^[1-9]\d* of .* payloads gave readings")
    with publishing(node, with_gaps):
        checks = look("missing in the sequence")
    assert found(checks, "messages are missing in the sequence").level == "doubt"
    assert not node.rebirths


@needs_mosquitto
def test_messages_of_edge_nodes_can_be_tried(broker: Mosquitto) -> None:
    text = f'url = "{broker.url}"\nformat = "sparkplug-b"\ntopics = ["spBv1.0/Farm/#"]'
    stream, _ = read(text)
    node = EdgeNode(broker, devices={"W01": {NAME: FLOAT}})
    values = {"Cabinet_Temperature": 21.5}
    with publishing(node, lambda number: node.bear(None, **values), **values):
        (found,) = try_payloads([stream], "spBv1.0/Farm/+/N1/W01", 2.0)
    assert found.used == found.count > 0
    assert {(one["turbine"], one["value"], one["unit"]) for p in found.payloads for one in p["readings"]} == {
        ("T1", 21.5, "degC")
    }
