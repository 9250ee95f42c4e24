"""The order in which a source brings local stamps: tells the two passes of the hour apart that comes twice."""

from __future__ import annotations

import math
from collections.abc import Hashable

NEXT = 1.5
"""Steps of a series within which a stamp is its next one."""


class LocalOrder:
    """The newest stamp of each series of one source, and the step to it [s].

    A series is what comes in the order of its stamps: the records of a turbine, or one tag of it.  It is kept
    in memory alone: after a restart nothing is known until stamps are unambiguous again.
    """

    def __init__(self) -> None:
        self._newest: dict[Hashable, tuple[float, float]] = {}

    def note(self, series: Hashable, time: float) -> None:
        """Note a stamp [s] whose place is known."""
        before, _ = self._newest.get(series, (math.nan, math.nan))
        if not time <= before:
            self._newest[series] = time, time - before

    def continues(self, series: Hashable, time: float) -> bool:
        """Whether a time [s] repeats the newest stamp of the series, or is the next one after it."""
        newest, step = self._newest.get(series, (math.nan, math.nan))
        return time == newest or 0.0 < time - newest <= NEXT * step
