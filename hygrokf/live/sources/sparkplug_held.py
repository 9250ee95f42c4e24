"""Messages of an edge node whose aliases await a birth certificate, kept as they came."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

from hygrokf.live.sources.sparkplug_metrics import Arrived
from hygrokf.live.sources.sparkplug_payload import Message, decode

MOST_HELD = 8 * 2**20
"""[bytes] of messages held of an edge node; the oldest are dropped."""
BESIDE = 500
"""[bytes] that a held message takes beside its payload."""


class HeldMessages:
    """Held messages in the order of their arrival.

    They are held encoded, which takes much less space: a backlog after an outage is long.
    """

    def __init__(self) -> None:
        self._messages: deque[Arrived] = deque()
        self._size = 0

    def add(self, one: Arrived) -> None:
        """Hold a message, and drop the oldest ones that have no place beside it."""
        self._messages.append(one._replace(message=Message(), receipt=None))
        self._size += len(one.payload) + BESIDE
        while self._size > MOST_HELD:
            self._size -= len(self._messages.popleft().payload) + BESIDE

    def release(self, device: str) -> Iterator[Arrived]:
        """The messages of a device, which are held no longer."""
        those = [one for one in self._messages if one.address.device == device]
        self._messages = deque(one for one in self._messages if one.address.device != device)
        self._size -= sum(len(one.payload) + BESIDE for one in those)
        return (one._replace(message=decode(one.payload)) for one in those)
