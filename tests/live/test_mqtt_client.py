"""paho's client with fewer calls to the system, against a peer that cuts its packets anywhere."""

from __future__ import annotations

import socket
import struct
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from paho.mqtt.client import Client, MQTTv5
from paho.mqtt.enums import CallbackAPIVersion

from hygrokf.live.sources.mqtt import SOCKET_READ_SIZE, piecewise_client_class

ACCEPTED = bytes([0x20, 3, 0, 0, 0])
"""CONNACK: no session, success, no properties."""


def packet(payload: bytes) -> bytes:
    """A PUBLISH of quality 0 to the topic "t"."""
    body = struct.pack(">H", 1) + b"t" + b"\x00" + payload
    length, left = [], len(body)
    while True:
        left, digit = left >> 7, left & 127
        length.append(digit | (128 if left else 0))
        if not left:
            return bytes([0x30, *length]) + body


@contextmanager
def connected(pieces: list[bytes]) -> Iterator[tuple[Client, list[bytes]]]:
    """A client whose peer accepts it, sends pieces of bytes and then ends; and the payloads that come."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            peer, _ = server.accept()
            with peer:
                peer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                peer.recv(65_536)
                for piece in [ACCEPTED, *pieces]:
                    peer.sendall(piece)
                peer.shutdown(socket.SHUT_WR)
                while peer.recv(65_536):
                    pass

        thread = threading.Thread(target=serve)
        thread.start()
        client = piecewise_client_class()(
            CallbackAPIVersion.VERSION2, client_id="one", protocol=MQTTv5, reconnect_on_failure=False
        )
        found: list[bytes] = []
        client.on_message = lambda *given: found.append(given[2].payload)
        client.connect("127.0.0.1", server.getsockname()[1])
        try:
            yield client, found
        finally:
            if client.socket() is not None:
                client.socket().close()
            thread.join(timeout=20.0)


@pytest.mark.parametrize("seed", range(4))
def test_packets_come_whole_and_in_order_wherever_they_are_cut(seed: int) -> None:
    random = np.random.default_rng(seed)
    payloads = [bytes([i % 256]) * int(2 ** random.uniform(0.0, 12.0)) for i in range(300)]
    payloads.insert(100, b"x" * (2 * SOCKET_READ_SIZE + 7))
    stream = b"".join(map(packet, payloads))
    cuts = np.sort(random.integers(0, len(stream), 400))
    pieces = [stream[a:b] for a, b in zip([0, *cuts], [*cuts, len(stream)], strict=True)]
    with connected(pieces) as (client, found):
        while client.process_packets(5.0):
            pass
    assert found == payloads


def test_many_packets_take_few_calls_to_the_system(monkeypatch: pytest.MonkeyPatch) -> None:
    calls = []
    original = Client._sock_recv
    monkeypatch.setattr(Client, "_sock_recv", lambda self, n: calls.append(n) or original(self, n))
    payloads = [b"%d" % i for i in range(2_000)]
    stream = b"".join(map(packet, payloads))
    with connected([stream]) as (client, found):
        while client.process_packets(5.0):
            pass
    assert found == payloads
    # paho alone asks three times or more for each
    assert len(calls) < len(payloads) / 10
    assert set(calls) == {SOCKET_READ_SIZE}
