"""The tracker as its users run it, in a process of its own that may be killed; and a broker with a
publisher."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

from builders.brokers import PATIENCE_S as CONFIRMING_S
from builders.brokers import Mosquitto, mosquitto, peer, publish
from builders.waiting import eventually

from validation.faults.plant import Message, Plant
from validation.frame import ROOT

PATIENCE_S = 120.0
CLIENT, TOPICS = "tracker", "scada/#"


until = partial(eventually, patience_s=PATIENCE_S)
"""Wait until something has happened; AssertionError with what is said where it does not in time."""


class Tracker:
    """`hygrokf track` on a tracker's file, without its page; what it says goes to `track.log` beside that
    file.  With `fed` its standard input is a pipe, `process.stdin`."""

    def __init__(self, config: Path, *arguments: str, hook: Path | None = None, fed: bool = False) -> None:
        self.log = config.with_name("track.log")
        paths = [str(one) for one in (hook, ROOT) if one is not None]
        command = [sys.executable, "-m", "hygrokf", "track", config.name, "--no-page", *arguments]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1"}
        with self.log.open("ab") as log:
            self.process = subprocess.Popen(
                command, cwd=config.parent, env=environment,
                stdin=subprocess.PIPE if fed else subprocess.DEVNULL, stdout=log, stderr=log,
            )  # fmt: skip

    def kill(self) -> None:
        """It dies where it is."""
        self.process.kill()
        assert self.process.wait(timeout=30.0) == -signal.SIGKILL, self.said()

    def stop(self) -> None:
        """It is told to end, and commits what it was given."""
        self.process.terminate()
        self.ended()

    def ended(self, patience_s: float = PATIENCE_S) -> None:
        """Wait until it has ended by itself; AssertionError where that was no good end."""
        assert self.process.wait(timeout=patience_s) == 0, self.said()
        assert "Traceback" not in self.said()

    def said(self) -> str:
        return self.log.read_text(encoding="utf-8", errors="replace")[-4000:]

    def resident_kB(self) -> int | None:
        """[kB] of memory that it holds; None where the system does not say."""
        try:
            lines = Path(f"/proc/{self.process.pid}/status").read_text().splitlines()
        except OSError:
            return None
        return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS:"))

    def __enter__(self) -> Tracker:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait(timeout=30.0)
        if self.process.stdin is not None:
            with suppress(BrokenPipeError):
                self.process.stdin.close()


@contextmanager
def later(seconds: float, what: Callable[[], None]) -> Iterator[None]:
    """While the block runs something happens after so many seconds; the block ends when it has."""
    faults: list[BaseException] = []

    def run() -> None:
        time.sleep(seconds)
        try:
            what()
        except BaseException as fault:
            faults.append(fault)

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        thread.join(timeout=PATIENCE_S)
    if faults:
        raise faults[0]


# -- MQTT ----------------------------------------------------------------------------------------------------
@contextmanager
def broker_of(plant: Plant, *settings: str) -> Iterator[Mosquitto]:
    """A broker of the plant's own."""
    (plant.folder / "broker").mkdir()
    with mosquitto(plant.folder / "broker", *settings) as broker:
        yield broker


def mqtt_source(broker: Mosquitto) -> str:
    return f'[[source]]\nurl = "{broker.url}"\ntopics = ["{TOPICS}"]\nclient_id = "{CLIENT}"'


def sessions(broker: Mosquitto) -> int:
    """How often the tracker has subscribed."""
    return broker.log().count(f"{CLIENT} 1 {TOPICS}")


@contextmanager
def tracking(broker: Mosquitto, config: Path, hook: Path | None = None) -> Iterator[Tracker]:
    """A tracker that has subscribed; it does not outlive the block."""
    before = sessions(broker)
    with Tracker(config, hook=hook) as tracker:
        until(lambda: sessions(broker) > before, tracker.said)
        yield tracker


def flow(
    broker: Mosquitto, messages: Sequence[Message], seconds: float, patience_s: float = CONFIRMING_S
) -> None:
    """Publish messages over so many seconds at least; each part is confirmed within `patience_s` [s], or
    AssertionError."""
    with peer(broker) as client:
        step = max(len(messages) // 20, 1)
        for first in range(0, len(messages), step):
            publish(client, messages[first : first + step], patience_s=patience_s)
            time.sleep(seconds / 20.0)


def unacknowledged(broker: Mosquitto) -> str:
    """What the broker still has for the tracker's session, in words: whatever comes before a message
    published now."""
    from paho.mqtt.client import Client, MQTTv5
    from paho.mqtt.enums import CallbackAPIVersion

    client = Client(CallbackAPIVersion.VERSION2, client_id=CLIENT, protocol=MQTTv5)
    found: list[bytes] = []
    client.on_message = lambda client, userdata, message: found.append(message.payload)
    client.connect("127.0.0.1", broker.port, clean_start=False)
    client.loop_start()
    try:
        each_published(broker, [("scada/last", b"the last")])
        until(lambda: b"the last" in found)
    finally:
        client.disconnect()
        client.loop_stop()
    count = found.index(b"the last")
    return f"{count} messages were not acknowledged" if count else ""


def each_published(broker: Mosquitto, messages: Iterable[Message]) -> None:
    with peer(broker) as client:
        publish(client, list(messages))
