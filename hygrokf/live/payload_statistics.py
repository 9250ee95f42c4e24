"""What becomes of payloads, without a filter: which readings they give, and what is set aside and why."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping as MappingOf

from hygrokf.live.sources.payload import Mapping, Refused, parsed, stamp_of, taken


class Tally:
    """Payloads read by a mapping.

    `payloads` came, `used` gave readings; `newest` (turbine, signal) -> time [s] of its newest reading; `counts` what was set
    aside, by kind, and one of the `reasons` for each; `lag_s` [s] from the newest stamp to its arrival, below 0 where the
    stamp is ahead, NaN without any.
    """

    def __init__(self, mapping: Mapping) -> None:
        self.mapping = mapping
        self.payloads = self.used = 0
        self.newest: dict[tuple[str, str], float] = {}
        self.counts: Counter[str] = Counter()
        self.reasons: dict[str, str] = {}
        self.lag_s = math.nan

    def take(self, content: bytes | str | MappingOf, received: float, topic: str = "") -> None:
        """Take a payload that came at a time [s]."""
        self.payloads += 1
        try:
            content = parsed(content) if isinstance(content, bytes | str) else content
            found = taken(content, self.mapping, received, topic)
        except Refused as fault:
            self.counts[fault.kind] += 1
            self.reasons.setdefault(fault.kind, str(fault))
            stamp = stamp_of(content, self.mapping) if fault.kind == "impossible time" else None
            self._note(stamp, received)
            return
        self.counts += found.counts
        self.used += bool(found.readings)
        for one in found.readings:
            key = (found.turbine, one.signal)
            self.newest[key] = max(one.time, self.newest.get(key, -math.inf))
            self._note(one.time, received)
        if not found.readings and not found.counts:
            self.counts["no known field"] += 1

    def _note(self, time: float | None, received: float) -> None:
        if time is not None:
            self.lag_s = min(received - time, self.lag_s) if self.lag_s == self.lag_s else received - time

    @property
    def aside(self) -> str:
        """What was set aside, in words; empty where nothing was."""
        said = (f"{n} {kind}" + self._reason(kind) for kind, n in self.counts.most_common())
        return ", ".join(said)

    def _reason(self, kind: str) -> str:
        return f" ({self.reasons[kind]})" if kind in self.reasons else ""
