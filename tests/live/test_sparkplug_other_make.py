"""Sparkplug B from an edge node by pysparkplug, installed into an environment of its own."""

from __future__ import annotations

import os
import subprocess
import venv
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from builders.brokers import Mosquitto, mosquitto, needs_mosquitto
from builders.waiting import eventually

from hygrokf.live.sources import sparkplug, sparkplug_node
from hygrokf.live.sources.broker import Broker
from hygrokf.live.sources.payload import Field, PayloadMapping
from hygrokf.live.sources.payload_formats import Refused
from hygrokf.live.sources.sparkplug import Sparkplug
from hygrokf.live.sources.stream import Delivery

pytestmark = [needs_mosquitto, pytest.mark.slow]

PLAIN = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
NODE = Path(__file__).resolve().parents[1] / "builders" / "pysparkplug_node.py"
MAPPING = PayloadMapping(
    {"Cabinet/Temperature": Field("cabinet_temperature", "degC")},
    turbine="{4}",
    turbines={"W01": "T1", "W02": "T2"},
)


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The interpreter of an environment with pysparkplug."""
    place = tmp_path_factory.mktemp("make") / "environment"
    venv.create(place, with_pip=True)
    program = place / "bin" / "python"
    command = [program, "-m", "pip", "install", "pysparkplug==0.6.1"]
    made = subprocess.run(command, capture_output=True, text=True, timeout=300.0, env=PLAIN)
    assert made.returncode == 0, made.stderr
    return program


class OtherNode:
    """The edge node in its process; `commands`: names of the commands that reached it."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        self.commands: list[str] = []

    def do(self, *lines: str) -> None:
        for line in lines:
            self._process.stdin.write(line + "\n")
            self._process.stdin.flush()
            while (answer := self._process.stdout.readline().strip()) != "done":
                assert answer.startswith("command "), answer
                self.commands.append(answer.removeprefix("command "))


@contextmanager
def other_node(python: Path, broker: Mosquitto) -> Iterator[OtherNode]:
    process = subprocess.Popen(
        [python, NODE, str(broker.port)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=PLAIN
    )
    try:
        yield OtherNode(process)
    finally:
        process.kill()
        process.communicate()


class Read:
    """What the mapping reads from the deliveries of a stream: [°C] by turbine; the memories of all."""

    def __init__(self, stream: Sparkplug) -> None:
        self.stream = stream
        self.values: dict[str, list[float]] = {"T1": [], "T2": []}
        self.memories: dict[str, object] = {}

    def __call__(self, one: Delivery) -> None:
        self.memories |= one.memories
        self.stream.acknowledge([one])
        try:
            found = self.stream.mapping.read(one.content, one.received, one.topic)
        except Refused:
            return
        for turbine, readings, _ in found:
            self.values[turbine] += [round(r.value - 273.15, 3) for r in readings]


@contextmanager
def followed(broker: Mosquitto, rebirth_requests: bool, memories: dict[str, object]) -> Iterator[Read]:
    session = Broker(broker.url, ("spBv1.0/Farm/#",), rebirth_requests=rebirth_requests)
    stream = Sparkplug(session, MAPPING)
    stream.recall(memories)
    read = Read(stream)
    stream.start(None, read)
    try:
        eventually(lambda: stream.state.word in ("connected", "lost"), lambda: stream.state)
        yield read
    finally:
        stream.stop()
        stream.stop()


def test_an_edge_node_of_another_make(tmp_path: Path, python: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sparkplug, "CHECK_INTERVAL_S", 0.05)
    monkeypatch.setattr(sparkplug_node, "REORDER_S", 0.2)
    with mosquitto(tmp_path) as broker, other_node(python, broker) as node:
        with followed(broker, False, {}) as read:
            node.do("connect", "named W01 21.5", "alias W02 22.5", "alias W01 23.5")
            eventually(
                lambda: read.values == {"T1": [20.0, 21.5, 23.5], "T2": [20.0, 22.5]}, lambda: read.values
            )
            node.do("lose", "alias W01 24.5", "named W01 25.5")
            eventually(lambda: read.values["T1"][3:] == [25.5], lambda: read.values)
            assert "Farm/N1" in read.stream.state.explanation and not node.commands
        with followed(broker, True, read.memories) as read:
            node.do("alias W01 26.5")
            eventually(lambda: node.do("lose") or node.commands)
            assert node.commands == ["Node Control/Rebirth"]
            node.do("disconnect")
            eventually(lambda: read.stream.state.word == "lost", lambda: read.stream.state)
            node.do("connect")
            # the last known value is born anew, and what was held is read
            eventually(lambda: sorted(read.values["T1"]) == [25.5, 26.5], lambda: read.values)
            node.do("leave W02")
            eventually(lambda: set(read.stream.departed_senders()) == {"T2"}, read.stream.departed_senders)
