"""What a stream delivers, collected."""

from __future__ import annotations

from builders.waiting import eventually
from hygrokf.live.sources.stream import Delivery


class Collected:
    """What a stream put, and a way to wait for it."""

    def __init__(self) -> None:
        self.found: list[Delivery] = []

    def __call__(self, one: Delivery) -> None:
        self.found.append(one)

    def wait(self, count: int) -> list[Delivery]:
        eventually(lambda: len(self.found) >= count, lambda: self.found)
        assert len(self.found) == count, self.found
        return self.found
