"""A playback that remembers its acknowledgements, and a service in a thread of its own."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager

import pytest

from builders.live_case import Halting
from hygrokf.data.record import Record
from hygrokf.live import service as module
from hygrokf.live.service import Service
from hygrokf.live.sources.local import delay_and_repeat, record_mapping, record_messages
from hygrokf.live.sources.stream import Delivery
from hygrokf.live.storage.store import Store, open_store


class Acknowledging(Halting):
    """A playback that remembers what it was told, and may have `halts`."""

    def __init__(
        self, record: Record, speed: float = 0.0, halts: Sequence[float] = (), **disturbances: float
    ) -> None:
        messages = delay_and_repeat(record_messages(record, "T1"), **disturbances)
        super().__init__("replay:", messages, record_mapping(record, "T1"), speed, halts=halts)
        self.acknowledged: list[str] = []

    def acknowledge(self, deliveries: Iterable[Delivery]) -> None:
        super().acknowledge(deliveries)
        self.acknowledged += [one.place for one in deliveries]

    def expect_acknowledged(self) -> None:
        """Every message was acknowledged once, in its order."""
        assert self.acknowledged == [str(number + 1) for number in range(len(self.messages))]


def in_small_rounds(monkeypatch: pytest.MonkeyPatch, most: int, retry_s: float = 0.01) -> None:
    """Services take at most so many deliveries a round, and reopen a failed store without delay."""
    monkeypatch.setattr(module, "MOST_PER_ROUND", most)
    monkeypatch.setattr(module, "REOPEN_S", (retry_s, retry_s))


def with_every_store(monkeypatch: pytest.MonkeyPatch, change: Callable[[Store], None]) -> None:
    """Services change each store once it is open; `change` may raise."""

    def opened(url: str) -> Store:
        store = open_store(url)
        change(store)
        return store

    monkeypatch.setattr(module, "open_store", opened)


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
