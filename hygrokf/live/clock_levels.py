"""Comparison of stamps with this machine's clock: readings ahead of the clock, wrong clocks, and backlogs.

A reading that is ahead by more than `STAMP_AHEAD_S` is acknowledged and held back in the store until the
clock reaches its stamp minus `STAMP_AHEAD_S` or is set right.

A backlog consists of readings that were kept while source or tracker were away.  While a backlog is
delivered, a turbine whose readings have not come yet looks silent although it is not.  A source delivers a
backlog while its stamps advance faster than the clock: by `GAINED_S` more than the clock within `WINDOW_S`.
A source whose readings are always late by the same time delivers no backlog.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence

from hygrokf.data.timestamps import DAY_S, MINUTE_S
from hygrokf.live.alarms import CLOCK, Level
from hygrokf.live.batch import Batch, Observation
from hygrokf.live.sources.payload_values import STAMP_AHEAD_S
from hygrokf.live.storage.store import Store
from hygrokf.live.tracker import Reading
from hygrokf.texts.live_codes import AlarmCode
from hygrokf.texts.statement import Statement

HELD_MOST = 200_000
"""Largest number of readings that are held back for one turbine; further ones are counted and discarded, so
that a sender with stamps of the next century cannot fill the disk."""
ALIKE_S = 300.0
"""[s] within which turbines are ahead by the same time."""
AHEAD_SHARE = 0.5
"""Share of the turbines that must be ahead by the same time for this machine's clock to be the suspect."""
MACHINE = ""
"""Turbine name of alarms about this machine's clock."""


class Ahead:
    """Readings that are ahead of this machine's clock: readings that are held back in the store, if there is
    one, and the times by which the newest readings of each turbine were ahead when they arrived."""

    def __init__(self, store: Store | None) -> None:
        self._store = store
        self._ahead_s: dict[str, dict[str, float]] = defaultdict(dict)
        for turbine, signal, ahead_s in () if store is None else store.held_ahead():
            self._ahead_s[turbine][signal] = ahead_s
        self._held = set(self._ahead_s)

    @property
    def turbines(self) -> tuple[str, ...]:
        """Turbines of which readings are held back."""
        return tuple(sorted(self._held))

    def note(self, turbine: str, observations: Iterable[Observation]) -> None:
        """Note readings of a turbine, in the order of their arrival."""
        for observed in observations:
            ahead_s = observed.reading.time - observed.received
            self._ahead_s[turbine][observed.reading.signal] = ahead_s if ahead_s > STAMP_AHEAD_S else 0.0

    def hold(self, turbine: str, ahead: Sequence[Observation], batch: Batch) -> None:
        """Put readings that are ahead into the batch; count and discard those beyond `HELD_MOST`."""
        if not ahead:
            return
        held_count = sum(held.turbine == turbine for held in batch.held)
        if self._store is not None:
            held_count += self._store.held_count(turbine)
        kept = ahead[: max(HELD_MOST - held_count, 0)]
        if len(kept) < len(ahead):
            batch.counters[turbine, "too many ahead"] += len(ahead) - len(kept)
        batch.held += kept
        self._held.add(turbine)

    def release(self, turbine: str, now: float, batch: Batch) -> list[Observation]:
        """Return the held readings of a turbine that are due at `now` [s]; the batch releases them."""
        if self._store is None or turbine not in self._held:
            return []
        due = self._store.held(turbine, now + STAMP_AHEAD_S)
        batch.released += due
        if self._store.held_count(turbine) == len(due) and all(
            observed.turbine != turbine for observed in batch.held
        ):
            self._held.discard(turbine)
        return due

    def by_turbine(self) -> dict[str, float]:
        """Return turbine → time [s] by which its newest readings were ahead, 0 up to `STAMP_AHEAD_S`."""
        return {turbine: max(by_signal.values()) for turbine, by_signal in self._ahead_s.items()}


def clock_levels(ahead_s: Mapping[str, float]) -> dict[str, list[Level]]:
    """Return turbine → levels of alarms about wrong clocks; `MACHINE` stands for this machine's clock.

    ahead_s: turbine → time [s] by which its stamps are ahead of this machine's clock.

    Several turbines that are ahead by the same time share the cause, this machine's clock, if they are at
    least the share `AHEAD_SHARE` of all turbines; the clock of any other turbine that is ahead is fast.
    """
    levels: dict[str, list[Level]] = {name: [] for name in (*ahead_s, MACHINE)}
    positive = sorted(seconds for seconds in ahead_s.values() if seconds > 0.0)
    if not positive:
        return levels
    median = positive[(len(positive) - 1) // 2]
    alike = {name for name, seconds in ahead_s.items() if seconds > 0.0 and abs(seconds - median) <= ALIKE_S}
    if len(alike) < max(2.0, AHEAD_SHARE * len(ahead_s)):
        alike = set()
    else:
        shared = AlarmCode.MACHINE_CLOCK_SLOW(count=len(alike), of=len(ahead_s), ahead=_rounded(median))
        levels[MACHINE] = [Level(CLOCK.kind, 1.0, (shared,))]
    code = AlarmCode.SENDER_OR_MACHINE_CLOCK if len(ahead_s) == 1 else AlarmCode.SENDER_CLOCK_FAST
    for name, seconds in ahead_s.items():
        if seconds > 0.0 and name not in alike:
            levels[name] = [Level(CLOCK.kind, 1.0, (code(ahead=_rounded(seconds)),))]
    return levels


def _rounded(seconds: float) -> float | Statement:
    """Return a duration [s] rounded to minutes, or a statement in years from one year on."""
    years = seconds / (365.25 * DAY_S)
    return AlarmCode.YEARS(count=years) if years >= 1.0 else 60.0 * round(seconds / 60.0)


GAINED_S = 2.0 * MINUTE_S
"""[s] by which stamps must advance more than the clock."""
WINDOW_S = 10.0 * MINUTE_S
"""[s] within which stamps must advance by `GAINED_S` more than the clock."""
QUIET_S = 5.0 * MINUTE_S
"""[s] after the last such advance at which the backlog counts as delivered."""


class Backlogs:
    """The backlogs by source, from the stamps and arrivals of readings."""

    def __init__(self) -> None:
        self._anchors: dict[tuple[str, str, str], tuple[float, float]] = {}
        """(source, turbine, signal) -> stamp and arrival [s] from which the advance of stamps is measured."""
        self._gained: dict[str, float] = {}
        """Source -> time [s] at which its stamps last advanced faster than the clock."""
        self._sources: dict[str, set[str]] = defaultdict(set)
        """Turbine -> sources that have delivered its readings."""

    def note(self, source: str, turbine: str, readings: Iterable[Reading], received: float) -> None:
        """Note readings of a turbine that a source delivered up to the time `received` [s]."""
        self._sources[turbine].add(source)
        stamps: dict[str, list[float]] = defaultdict(list)
        for reading in readings:
            stamps[reading.signal].append(reading.time)
        for signal, times in stamps.items():
            key, stamp = (source, turbine, signal), max(times)
            anchor_stamp, anchor_received = self._anchors.setdefault(key, (min(times), received))
            passed_s = max(received - anchor_received, 0.0)  # negative if the clock was set back
            if stamp - anchor_stamp - passed_s >= GAINED_S:
                self._gained[source] = received
            elif passed_s <= WINDOW_S and received >= anchor_received:
                continue
            self._anchors[key] = (max(stamp, anchor_stamp), received)

    def delivering(self, source: str, now: float) -> bool:
        """Return whether a source is delivering a backlog at `now` [s]."""
        return abs(now - self._gained.get(source, -math.inf)) < QUIET_S

    def awaited(self, turbine: str, now: float) -> bool:
        """Return whether a backlog may still bring readings of a turbine at `now` [s]: from a source that has
        delivered readings of the turbine or, if none has, from any source."""
        sources = self._sources.get(turbine) or set(self._gained)
        return any(self.delivering(source, now) for source in sources)
