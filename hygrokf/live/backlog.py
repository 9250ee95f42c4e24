"""Which sources are delivering a backlog: readings that were kept while source or tracker were away.

While a backlog comes, a turbine whose part of it is still to come looks silent and is not.  A source delivers
a backlog while stamps advance faster than the clock: by `GAINED_S` more than the clock within `WINDOW_S`.
A source whose readings are always late by the same time delivers none.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable

from hygrokf.data.timestamps import MINUTE_S
from hygrokf.live.tracker import Reading

GAINED_S = 2.0 * MINUTE_S
"""[s] by which stamps must advance more than the clock."""
WINDOW_S = 10.0 * MINUTE_S
"""[s] within which they must."""
QUIET_S = 5.0 * MINUTE_S
"""[s] after the last such advance at which the backlog counts as delivered."""


class Backlogs:
    """The backlogs by source, from the stamps and arrivals of readings."""

    def __init__(self) -> None:
        self._anchors: dict[tuple[str, str, str], tuple[float, float]] = {}
        self._gained: dict[str, float] = {}
        self._sources: dict[str, set[str]] = defaultdict(set)

    def note(self, source: str, turbine: str, readings: Iterable[Reading], received: float) -> None:
        """Note readings of a turbine that a source delivered up to the time `received` [s]."""
        self._sources[turbine].add(source)
        stamps: dict[str, list[float]] = defaultdict(list)
        for one in readings:
            stamps[one.signal].append(one.time)
        for signal, times in stamps.items():
            key, stamp = (source, turbine, signal), max(times)
            known_stamp, known_received = self._anchors.setdefault(key, (min(times), received))
            passed = max(received - known_received, 0.0)  # negative if the clock was set back
            if stamp - known_stamp - passed >= GAINED_S:
                self._gained[source] = received
            elif passed <= WINDOW_S and received >= known_received:
                continue
            self._anchors[key] = (max(stamp, known_stamp), received)

    def delivering(self, source: str, now: float) -> bool:
        """Whether a source delivers a backlog at `now` [s]."""
        return abs(now - self._gained.get(source, -math.inf)) < QUIET_S

    def awaited(self, turbine: str, now: float) -> bool:
        """Whether a backlog may still bring readings of a turbine: one of a source that has delivered the
        turbine's readings or, if none has yet, of any source."""
        sources = self._sources.get(turbine) or set(self._gained)
        return any(self.delivering(one, now) for one in sources)
