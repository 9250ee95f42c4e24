"""Counts what payloads give when they are read by a mapping."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

from hygrokf.data.quality import UNSTATED, QualityVocabulary, misfit, quality_columns, unstated
from hygrokf.live.sources.payload import NOBODY, USED_THOUGH, PayloadMapping, Rejection, TurbineReadings
from hygrokf.live.sources.payload_formats import Content, Order, Refused, records


@dataclass(frozen=True)
class _Noting(QualityVocabulary):
    """A vocabulary that notes the marks that it judges."""

    of: QualityVocabulary = UNSTATED
    seen: dict[str, None] = field(default_factory=dict)

    def judge(self, mark: object) -> str:
        self.seen[str(mark)] = None
        return self.of.judge(mark)


class PayloadStatistics:
    """Counts payloads that are read by a mapping.

    `payloads`: number received; `used`: number that gave readings; `newest`: (turbine, signal) -> time [s] of
    the newest reading; `counts`: rejected items by kind, with one example of each in `reasons`; `lag_s`:
    smallest delay [s] from stamp to arrival, negative if the stamp is ahead, NaN without payloads.
    """

    def __init__(self, mapping: PayloadMapping) -> None:
        self._noting = _Noting("", {}, of=mapping.vocabulary)
        self._beside: dict[tuple[str, str], dict[str, None]] = {}
        self.mapping = replace(mapping, vocabulary=self._noting)
        self.payloads = self.used = 0
        self.newest: dict[tuple[str, str], float] = {}
        self.counts: Counter[str] = Counter()
        self.reasons: dict[str, str] = {}
        self.lag_s = math.nan
        self._order: Order = {}

    def take(self, content: Content, received: float, topic: str = "") -> Sequence[TurbineReadings]:
        """Count a payload received at a time [s], and return what it gave."""
        self.payloads += 1
        if not self.mapping.quality:
            self._look_for_quality(content, topic)
        try:
            found = self.mapping.read(content, received, topic, self._order)
        except Refused as fault:
            found = [TurbineReadings(NOBODY, [], [Rejection(fault.kind, str(fault))])]
            if fault.kind == "impossible time":
                self._note(self.mapping.stamp(content), received)
        if not any(one.readings or one.rejections for one in found):
            # ordinary for a sensor that pauses, but nothing to be content with when a mapping is checked
            found = [TurbineReadings(NOBODY, [], [Rejection("no value", "its fields are empty")])]
        self.used += any(one.readings for one in found)
        for turbine, readings, rejections in found:
            for kind, words in rejections:
                self.counts[kind] += 1
                self.reasons.setdefault(kind, f"{words}, used" if kind == USED_THOUGH else words)
            for one in readings:
                key = (turbine, one.signal)
                self.newest[key] = max(one.time, self.newest.get(key, -math.inf))
                self._note(one.time, received)
        return found

    def _note(self, stamp: float | None, received: float) -> None:
        if stamp is not None:
            lag_s = received - stamp
            self.lag_s = min(lag_s, self.lag_s) if self.lag_s == self.lag_s else lag_s

    def _look_for_quality(self, content: Content, topic: str) -> None:
        """Note the marks in fields that, by their names, hold the quality of others."""
        mapping = self.mapping
        with suppress(Refused):
            for one in records(content, mapping.form, mapping.layout.steps, topic):
                payload = one.scopes[0] if one.scopes else {}
                columns = [mapping.value] if mapping.tag else [n for n in payload if n in mapping.fields]
                for names in quality_columns(list(payload), columns).items():
                    self._beside.setdefault(names, {})[str(payload[names[1]])] = None

    @property
    def rejected(self) -> str:
        """Text about the rejected items, and doubts about quality; empty if there are none."""
        counted = [f"{n} {kind} ({self.reasons[kind]})" for kind, n in self.counts.most_common()]
        beside = [unstated(*names, list(marks)) for names, marks in self._beside.items()]
        return ", ".join(filter(None, (*counted, misfit(self._noting.of, list(self._noting.seen)), *beside)))
