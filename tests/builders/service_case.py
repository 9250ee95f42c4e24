"""A playback that remembers its acknowledgements, and a service in a thread of its own."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager

from builders.live_case import Halting
from hygrokf.data.record import Record
from hygrokf.live.service import Service
from hygrokf.live.sources.local import disturbed, record_mapping, record_messages
from hygrokf.live.sources.stream import Delivery


class Acknowledging(Halting):
    """A playback that remembers what it was told, and may have `halts`."""

    def __init__(
        self, record: Record, speed: float = 0.0, halts: Sequence[float] = (), **disturbances: float
    ) -> None:
        messages = disturbed(record_messages(record, "T1"), **disturbances)
        super().__init__("replay:", messages, record_mapping(record, "T1"), speed, halts=halts)
        self.acknowledged: list[str] = []

    def acknowledge(self, deliveries: Iterable[Delivery]) -> None:
        super().acknowledge(deliveries)
        self.acknowledged += [one.place for one in deliveries]


@contextmanager
def running(service: Service, until_ended: bool = False) -> Iterator[None]:
    """A service in a thread of its own, which ends with the block: by itself or because it is stopped."""
    runner = threading.Thread(target=service.run, args=(until_ended,), daemon=True)
    runner.start()
    try:
        yield
    finally:
        if not until_ended:
            service.stop()
        runner.join(timeout=60.0)
    assert not runner.is_alive()
