"""Senders to every kind of source, each with a turbine of its own: what they send, and their `[[source]]`."""

from __future__ import annotations

import json
import ssl
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Protocol

from builders.brokers import Mosquitto, authority, mosquitto
from builders.databases import Server
from builders.opcua_peer import Peer
from builders.sparkplug_peer import DOUBLE, EdgeNode

from hygrokf.live.sources.local import record_messages
from validation.faults.plant import Plant

Rows = Sequence[tuple[float, dict[str, float]]]
"""(time [s], signal -> value) of a turbine's messages."""
TABLE = """CREATE TABLE reading (turbine TEXT, time DOUBLE PRECISION, tag TEXT, value DOUBLE PRECISION,
    received TIMESTAMPTZ NOT NULL DEFAULT clock_timestamp())"""
INSERT = "INSERT INTO reading (turbine, time, tag, value) VALUES (%s, %s, %s, %s)"
QUERY = "SELECT * FROM reading WHERE received > %(after)s ORDER BY received"


class Sender(Protocol):
    """What sends messages of one turbine to one source.

    `source`: the tables of the tracker's file; `heard`: whether a tracker listens, so that nothing is lost.
    """

    source: str

    def send(self, rows: Rows) -> None: ...

    def heard(self) -> bool: ...


def rows_of(plant: Plant, turbine: str) -> Rows:
    """All messages of a turbine."""
    return [
        (at, {name: value for name, value in content.items() if name not in ("turbine", "time")})
        for at, content in record_messages(plant.record, turbine)
    ]


def payload(turbine: str, at: float, values: dict[str, float]) -> bytes:
    return json.dumps({"turbine": turbine, "time": at, **values}).encode()


@dataclass
class CsvFile:
    """A growing CSV file."""

    file: Path
    turbine: str
    signals: Sequence[str]
    source: str = field(init=False)

    def __post_init__(self) -> None:
        self.source = f'[[source]]\nurl = "file:{self.file.name}"'
        self._append([["turbine", "time", *self.signals]])

    def _append(self, lines: Sequence[Sequence[str]]) -> None:
        with self.file.open("a", encoding="utf-8") as file:
            file.writelines(",".join(cells) + "\n" for cells in lines)

    def send(self, rows: Rows) -> None:
        self._append(
            [
                [self.turbine, repr(at), *(repr(values[s]) if s in values else "" for s in self.signals)]
                for at, values in rows
            ]
        )

    def heard(self) -> bool:
        return True


class Input:
    """Standard input: lines that nobody took are gone, so the sender repeats all to each new tracker."""

    def __init__(self, turbine: str) -> None:
        self.turbine, self.source = turbine, '[[source]]\nurl = "stdin"'
        self._sent: list[bytes] = []
        self._pipe: IO[bytes] | None = None

    def attach(self, pipe: IO[bytes]) -> None:
        """Send everything once more, to a tracker that has just started."""
        self._pipe = pipe
        self._write(self._sent)

    def send(self, rows: Rows) -> None:
        lines = [payload(self.turbine, at, values) + b"\n" for at, values in rows]
        self._sent += lines
        self._write(lines)

    def _write(self, lines: Sequence[bytes]) -> None:
        with suppress(BrokenPipeError, ValueError):  # it was killed
            self._pipe.write(b"".join(lines))
            self._pipe.flush()

    def heard(self) -> bool:
        return True


class Topic:
    """Messages of QoS 1 on a broker, in plain text or over TLS."""

    def __init__(self, broker: Mosquitto, turbine: str, client_id: str, ca: Path | None = None) -> None:
        self.broker, self.turbine, self.client_id, self._ca = broker, turbine, client_id, ca
        url, more = broker.url, ""
        if ca is not None:
            url, more = url.replace("mqtt:", "mqtts:"), f'\nca = "{ca}"'
        topics = f'topics = ["scada/#"]\nclient_id = "{client_id}"'
        self.source = f'[[source]]\nurl = "{url}"\n{topics}{more}'

    @contextmanager
    def connected(self) -> Iterator[Topic]:
        from paho.mqtt.client import Client, MQTTv5
        from paho.mqtt.enums import CallbackAPIVersion

        self._client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTv5)
        if self._ca is not None:
            self._client.tls_set_context(ssl.create_default_context(cafile=str(self._ca)))
        self._client.max_inflight_messages_set(500)
        self._client.connect("127.0.0.1", self.broker.port)
        self._client.loop_start()
        try:
            yield self
        finally:
            self._client.disconnect()
            self._client.loop_stop()

    def send(self, rows: Rows) -> None:
        for at, values in rows:
            self._client.publish(f"scada/{self.turbine}", payload(self.turbine, at, values), 1)

    def heard(self) -> bool:
        return f"{self.client_id} 1 scada/#" in self.broker.log()


class Node:
    """A Sparkplug edge node whose messages are of QoS 1, so that the broker keeps them for the tracker."""

    def __init__(self, node: EdgeNode, broker: Mosquitto, turbine: str) -> None:
        self.node, self.broker, self.turbine = node, broker, turbine
        self.source = (
            f'[[source]]\nurl = "{broker.url}"\nformat = "sparkplug-b"\ntopics = ["spBv1.0/Farm/#"]\n'
            'client_id = "sparkplug"\n[source.mapping]\nturbine = "{4}"'
        )
        self._born = False

    def send(self, rows: Rows) -> None:
        if not self._born:
            self.node.bear(rows[0][0])
            self._born = True
        for at, values in rows:
            self.node.send(self.turbine, values, at)

    def heard(self) -> bool:
        return "sparkplug 1 spBv1.0/Farm/#" in self.broker.log()


class Nodes:
    """An OPC UA server that keeps a history."""

    def __init__(self, server: Peer, turbine: str, signals: Sequence[str]) -> None:
        self.server, self.turbine = server, turbine
        ids = {f"ns=2;s={turbine}.{signal}": signal for signal in signals}
        rows = [f'"{id}" = {{ turbine = "{turbine}", field = "{field}" }}' for id, field in ids.items()]
        settings = (
            f'[[source]]\nurl = "{server.url}"\nsampling = "0s"\npublishing = "0.05s"\nqueue = '
            '5000\nlook_back = "9000d"'
        )
        self.source = "\n".join([settings, "[source.nodes]", *rows])
        server.prepare()
        server.add(ids)
        server.listen()

    def samples(self, rows: Rows) -> list[tuple]:
        """(node, time [s], value, status code of a good sample) of each reading."""
        return [
            (f"ns=2;s={self.turbine}.{name}", at, value, 0)
            for at, values in rows
            for name, value in values.items()
        ]

    def send(self, rows: Rows) -> None:
        self.server.write(self.samples(rows))

    def heard(self) -> bool:
        return True


class Table:
    """A narrow table of PostgreSQL."""

    def __init__(self, server: Server, turbine: str) -> None:
        import psycopg

        self.turbine, name = turbine, server.database()
        server.execute(name, TABLE)
        self._connection = psycopg.connect(server.url(name), autocommit=True)
        self.source = "\n".join(
            [
                f'[[source]]\nurl = "{server.url(name)}"\nquery = "{QUERY}"\nwatermark = "received"',
                'poll = "0.1s"\nlag = "1s"',
                '[source.mapping]\nturbine = "turbine"\ntime = "time"\ntag = "tag"\nvalue = "value"',
            ]
        )

    def send(self, rows: Rows) -> None:
        found = [(self.turbine, at, name, value) for at, values in rows for name, value in values.items()]
        with self._connection.cursor() as cursor:
            cursor.executemany(INSERT, found)

    def heard(self) -> bool:
        return True

    def close(self) -> None:
        self._connection.close()


def certified(folder: Path) -> tuple[Path, tuple[str, ...]]:
    """File of an authority, and the settings of a broker whose certificate is of that."""
    made = authority(folder)
    certificate, key = made.issue("broker", "127.0.0.1")
    return made.file, (
        "allow_anonymous true", f"cafile {made.file}", f"certfile {certificate}", f"keyfile {key}",
    )  # fmt: skip


@contextmanager
def all_senders(plant: Plant, server: Server) -> Iterator[dict[str, Sender]]:
    """A sender to each kind of source by turbine, of which the plant must have seven; they end with the
    block."""
    signals, folder = [s.signal for s in plant.record.series], plant.folder
    csv, stdin, plain, encrypted, sparkplug, opcua, table = plant.names
    with ExitStack() as stack:
        for name in ("plain", "tls"):
            (folder / name).mkdir()
        broker = stack.enter_context(mosquitto(folder / "plain"))
        ca, settings = certified(folder / "tls")
        secure = stack.enter_context(mosquitto(folder / "tls", *settings))
        node = EdgeNode(broker, devices={sparkplug: dict.fromkeys(signals, DOUBLE)}, qos=1)
        peer = stack.enter_context(Peer(folder))
        rows = Table(server, table)
        stack.callback(rows.close)
        yield {
            csv: CsvFile(folder / "readings.csv", csv, signals),
            stdin: Input(stdin),
            plain: stack.enter_context(Topic(broker, plain, "plain").connected()),
            encrypted: stack.enter_context(Topic(secure, encrypted, "encrypted", ca).connected()),
            sparkplug: Node(stack.enter_context(node.connected()), broker, sparkplug),
            opcua: Nodes(peer, opcua, signals),
            table: rows,
        }
