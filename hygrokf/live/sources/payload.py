"""Converts payloads to readings: names, units, times, quality.  Impossible values are counted, never
corrected.

A payload has one or more records (`payload_formats`).  A `PayloadMapping` states where in them turbine, time
and values stand, and how these are written (`payload_values`); `PayloadStatistics` counts what they give:

    {"turbine": "T07", "time": "2026-03-01T12:10:00Z", "quality": "good", "Tcab": 31.2, "RHcab": 41.0}

or, with `tag` and `value`, one reading per record:

    {"time": …, "values": [{"tag": "T07.Tcab", "value": 31.2}, …]}
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from hygrokf.data.numbers import PARTED, POINT, Marks, Meaning, Unread
from hygrokf.data.quality import (
    BAD,
    GOOD,
    UNCERTAIN,
    UNSTATED,
    QualityVocabulary,
    misfit,
    quality_columns,
    unstated,
)
from hygrokf.data.signals import signal_named, to_si
from hygrokf.data.structured import Json
from hygrokf.data.timestamps import DAY_S
from hygrokf.live.plan import Form
from hygrokf.live.sources.payload_formats import JSON, Content, Order, Record, Refused, Scopes, records
from hygrokf.live.sources.payload_values import (
    LONGEST,
    NAME,
    RECEIVED,
    STATED_OFFSETS,
    Clock,
    Reader,
    Tag,
    alternatives,
    at,
    has,
    measured,
    number,
    quoted,
    reader,
    seconds,
    tag_reader,
)
from hygrokf.live.tracker import Reading

EARLIEST_S = 631_152_000.0
"""1990 [s since 1970]: earlier stamps are not times of a turbine."""
LATEST_S = 4_102_444_800.0
"""2100 [s since 1970]: later stamps are not times of a turbine."""
FORECAST_S = 20 * DAY_S
"""[s] a weather forecast's stamp may be ahead of this machine's clock."""
EVERYONE = ""
"""Turbine name of a weather forecast that applies to all turbines."""
NOBODY = ""
"""Turbine name of what is rejected before its turbine is known."""
USED_THOUGH = f"{UNCERTAIN} quality"
"""Kind under which values are counted that are used."""


@dataclass(frozen=True)
class Field:
    """A value in a payload: its signal, its unit, the form of its readings, and what its stamp marks.

    `stamp`: "instant", or "start", "middle" or "end" of the averaging interval.  The value in `unit` is
    `scale` times the number in the payload plus `offset`.  `one`: the text of a flag that is 1.
    """

    signal: str
    unit: str
    form: Form = field(default_factory=Form)
    stamp: str = "instant"
    scale: float = 1.0
    offset: float = 0.0
    one: str = ""

    @property
    def shift_s(self) -> float:
        """[s] from the stamp to the end of the interval."""
        return {"start": 1.0, "middle": 0.5}.get(self.stamp, 0.0) * self.form.interval_s

    @property
    def conversion(self) -> Conversion:
        """The conversion of its numbers.  Raises ValueError for a unit that does not fit the signal."""
        zero, one = to_si(np.array([self.offset, self.scale + self.offset]), self.unit, self.signal).tolist()
        row = signal_named(self.signal)
        slack = 1e-9 * (row.high - row.low)
        meaning = Meaning(self.signal, self.unit, self.one)
        return Conversion(
            self.signal, one - zero, zero, self.shift_s, row.low - slack, row.high + slack, meaning
        )


class Conversion(NamedTuple):
    """Converts a field to a reading: value = factor * number + offset [SI unit], valid within `low` … `high`.

    `shift_s` [s] is added to the stamp; `meaning`: of texts.
    """

    signal: str
    factor: float
    offset: float
    shift_s: float
    low: float
    high: float
    meaning: Meaning


class Rejection(NamedTuple):
    """Something in a payload that is counted, not used unless it is `USED_THOUGH`: its `kind`, and why."""

    kind: str
    words: str


class TurbineReadings(NamedTuple):
    """What a payload says of one turbine (`NOBODY`: of none that is known)."""

    turbine: str
    readings: list[Reading]
    rejections: list[Rejection]


class Found(dict[str, TurbineReadings]):
    """What a payload says, by turbine."""

    def __missing__(self, turbine: str) -> TurbineReadings:
        made = self[turbine] = TurbineReadings(turbine, [], [])
        return made


@dataclass(frozen=True)
class PayloadMapping:
    """Describes the layout of payloads.

    `fields`: name → field; `turbine`, `time`, `quality`, `tag`, `value`: where they stand (`payload_values`);
    `vocabulary` of the quality, and whether to `use_uncertain` readings; `turbines`: name in the payload →
    turbine.  If `turbine` is "", all payloads belong to the only turbine.  With `weather` the payloads are
    weather forecasts, which apply to all turbines unless they name one.  `form`: one of
    `payload_formats.FORMATS`; `records`: path to the records; `tag_pattern`: of tags or, without `tag`, of
    the names of values; `clock`: how times are written; `marks`: of numbers in texts, None where
    they are not stated; `names`: turbine → its own names of fields; `revision`: which of several values of a
    stamp counts, "last" or "neither".
    """

    fields: Mapping[str, Field]
    turbine: str = "turbine"
    time: str = "time"
    quality: str = ""
    tag: str = ""
    value: str = ""
    vocabulary: QualityVocabulary = UNSTATED
    use_uncertain: bool = True
    turbines: Mapping[str, str] = field(default_factory=dict)
    weather: bool = False
    form: str = JSON
    records: str = ""
    tag_pattern: str = ""
    clock: Clock = STATED_OFFSETS
    marks: Marks | None = None
    names: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    revision: str = "last"
    layout: Layout = field(init=False, repr=False, compare=False)
    """The same, prepared for reading."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "layout", _layout(self))

    def of_own_payloads(self, use_uncertain: bool, turbines: Mapping[str, str]) -> PayloadMapping:
        """The mapping for a source that makes its payloads itself, one flat object each: `turbine`, `time`,
        `quality` as a word, and the fields by their common names."""
        return PayloadMapping(
            self.fields,
            quality="quality",
            use_uncertain=use_uncertain,
            turbines=turbines,
            weather=self.weather,
            revision=self.revision,
        )

    @property
    def needs_topic(self) -> bool:
        """Whether a level of the topic is read."""
        return any("{" in text.replace(NAME, "") for text in (self.turbine, self.quality, self.tag)) or any(
            one.startswith("{") and one not in (NAME, RECEIVED) for one in alternatives(self.time)
        )

    def read(
        self, content: Content, received: float, topic: str = "", order: Order | None = None
    ) -> Sequence[TurbineReadings]:
        """The readings of a payload received at a time [s], by turbine.

        order: of the source's local stamps, which is carried on; None: nothing is known of it.

        Raises Refused if the payload cannot be read, or if it has one record and none of that can be used.
        Stamps before `EARLIEST_S` or after `LATEST_S` are refused, and those of a weather forecast that are
        ahead of the arrival by more than `FORECAST_S`.
        """
        found, fault = Found(), None
        for record in records(content, self.form, self.layout.steps, topic, received):
            try:
                self._read_record(record if order is None else record._replace(order=order), found)
            except Refused as refusal:
                fault = refusal
                found[NOBODY].rejections.append(Rejection(refusal.kind, str(refusal)))
        if fault is not None and len(found) == 1:
            ((_, readings, rejections),) = found.values()
            if not readings and len(rejections) == 1:
                raise fault
        return list(found.values())

    def stamp(self, content: Content) -> float | None:
        """The first time [s] that a payload states; None if it states none that can be read."""
        try:
            for record in records(content, self.form, self.layout.steps):
                found = seconds(self.layout.time(record), self.clock) if record.scopes else None
                if found is not None:
                    return found
        except Refused:
            pass
        return None

    # -- one record ------------------------------------------------------------------------------------------
    def _read_record(self, record: Record, found: Found) -> None:
        """Add what a record says to what is found.  Raises Refused if none of it can be used."""
        if not record.scopes:
            raise Refused("malformed", "expected an object as a record, found something else")
        if self.tag:
            self._read_tag(record, found)
        elif self.layout.split is not None:
            self._read_names(record, self.layout.split, found)
        else:
            self._read_fields(record, found)

    def _read_fields(self, record: Record, found: Found) -> None:
        """Read every field that a record of one turbine has."""
        layout = self.layout
        turbine = self._turbine(layout.turbine(record))
        time, own = 0.0 if layout.own_time else self._time(record, turbine), layout.own
        of = found[turbine]
        _, readings, rejections = of
        if layout.quality is not None and not self._has_quality(layout.quality(record), rejections):
            return
        before = len(readings) + len(rejections)
        scopes, table = record.scopes, layout.table(turbine)
        for name, conversion in table.items():
            raw = at(scopes, name)
            if raw is None or raw == "":
                continue
            of_value = self._own_time(record, turbine, name, time, rejections) if own else time
            if of_value is not None:
                self._convert(name, raw, conversion, of_value, of)
        if len(readings) + len(rejections) == before and not any(has(scopes, name) for name in table):
            rejections.append(Rejection("no known field", f"no field is among {_names(scopes)}"))

    def _read_names(self, record: Record, split: Callable[[str], Tag | None], found: Found) -> None:
        """Read every value of a record whose names say field and perhaps turbine."""
        layout = self.layout
        spoken, own = layout.turbine(record), layout.own
        time = 0.0 if layout.own_time else self._time(record, str(spoken))
        if layout.quality is not None:
            marked: list[Rejection] = []
            if not self._has_quality(layout.quality(record), marked):
                raise Refused(marked[0].kind, marked[0].words)
            if marked:
                found[NOBODY if layout.only is None else layout.only].rejections.extend(marked)
        seen = False
        for name, raw in record.scopes[0].items():
            tag = split(name)
            if tag is None or not tag.known:
                continue
            turbine = self._turbine(spoken if tag.turbine is None else tag.turbine)
            conversion = layout.table(turbine).get(tag.field)
            if conversion is None:
                continue
            seen = True
            if raw is None or raw == "":
                continue
            of = found[turbine]
            of_value = self._own_time(record, turbine, name, time, of.rejections) if own else time
            if of_value is not None:
                self._convert(name, raw, conversion, of_value, of)
        if not seen:
            said = f"no field like {self.tag_pattern} is among {_names(record.scopes)}"
            raise Refused("no known field", said)

    def _read_tag(self, record: Record, found: Found) -> None:
        """Read the only value of a record, whose field a tag names."""
        layout = self.layout
        # tag and value belong together: those of the objects around it are not this record's
        inner = record if len(record.scopes) == 1 else record._replace(scopes=record.scopes[:1])
        stated, spoken = layout.tag(inner), layout.turbine(record)
        name = str(stated)[: LONGEST + 1]
        if layout.split is not None:
            tag = layout.split(name)
            if tag is None:
                raise Refused("unknown tag", f"tag {quoted(stated)} is not like {self.tag_pattern}")
            name, spoken = tag.field, spoken if tag.turbine is None else tag.turbine
        turbine = self._turbine(spoken)
        time, of = self._time(record, turbine, name), found[turbine]
        if layout.quality is not None:
            mark = layout.quality(record)
            if not self._has_quality(mark, of.rejections, f"{quoted(stated)}: "):
                return
        conversion = layout.table(turbine).get(name)
        if conversion is None:
            of.rejections.append(Rejection("unknown tag", f"tag {quoted(stated)} is no field"))
            return
        raw = layout.value(inner)
        if raw is not None and raw != "":
            self._convert(name, raw, conversion, time, of)
        elif raw is None and not has(inner.scopes, self.value):
            said = f"no {self.value} is among {_names(record.scopes)}"
            of.rejections.append(Rejection("no known field", said))

    # -- parts of a record -----------------------------------------------------------------------------------
    def _convert(
        self, name: str, raw: Json, conversion: Conversion, time: float, of: TurbineReadings
    ) -> None:
        """Add the reading of a value, or why it is none."""
        signal, factor, offset, shift_s, low, high, meaning = conversion
        found = number(raw, self.marks or POINT)
        try:
            if found is None:
                found = measured(raw, meaning, self.marks or POINT)
            if self.marks is None and isinstance(raw, str) and PARTED.match(raw):
                # the point may divide thousands: the signal's range tells, where it allows one of the two
                either = [one for one in (found, 1e3 * found) if low <= factor * one + offset <= high]
                if len(either) > 1:
                    said = f'{quoted(raw)} may be {found:g} or {1e3 * found:g}: state decimal = "." or ","'
                    raise Refused("ambiguous number", said)
                found = either[0] if either else found
        except Unread as refusal:
            of.rejections.append(Rejection(refusal.kind, f"{name}: {refusal}"))
            return
        value = factor * found + offset
        if low <= value <= high:
            of.readings.append(Reading(signal, time + shift_s, value))
        else:
            said = f"{name}: {quoted(raw)} is outside the range of {signal}"
            of.rejections.append(Rejection("impossible value", said))

    def _turbine(self, name: Json) -> str:
        if name is None and self.weather:
            return EVERYONE
        if not self.turbine and self.layout.only is not None:
            return self.layout.only
        turbine = self.turbines.get(str(name)[: LONGEST + 1]) if name is not None else None
        if turbine is None:
            raise Refused("unknown turbine", f"turbine {quoted(name)} is not tracked")
        return turbine

    def _time(self, record: Record, *series: str) -> float:
        stamp = self.layout.time(record)
        if stamp is None and self.layout.on_receipt:
            return record.received
        time = seconds(stamp, self.clock, record.received, record.order, series)
        if time is None:
            raise Refused("no time", f"expected a time as {self.clock.words}, found {quoted(stamp)}")
        if not EARLIEST_S <= time <= (record.received + FORECAST_S if self.weather else LATEST_S):
            late = "more than 20 days ahead of this machine's clock" if self.weather else "after 2100"
            raise Refused("impossible time", f"time {quoted(stamp)} is before 1990 or {late}")
        return time

    def _own_time(
        self, record: Record, turbine: str, name: str, time: float, rejections: list[Rejection]
    ) -> float | None:
        """The time of one value, the common one or its own; None if its own time or quality is refused."""
        own = record._replace(name=name)
        try:
            time = self._time(own, turbine, name) if self.layout.own_time else time
        except Refused as refusal:
            rejections.append(Rejection(refusal.kind, f"{name}: {refusal}"))
            return None
        quality = self.layout.own_quality
        usable = quality is None or self._has_quality(quality(own), rejections, f"{name}: ")
        return time if usable else None

    def _has_quality(self, mark: Json, rejections: list[Rejection], what: str = "") -> bool:
        """Whether what bears a mark of quality is used; adds its count where the mark is not good."""
        outcome = GOOD if mark is None else self.vocabulary.judge(mark)
        if outcome == UNCERTAIN and not self.use_uncertain:
            outcome = BAD
        if outcome != GOOD:
            rejections.append(Rejection(f"{outcome} quality", f"{what}quality {quoted(mark)}"))
        return outcome in (GOOD, UNCERTAIN)


def _names(scopes: Scopes) -> str:
    """The first names of a record for a message."""
    return ", ".join(quoted(name) for name in list(scopes[0])[:3]) or "nothing"


# -- prepared for reading ------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Layout:
    """A mapping prepared for reading: readers of its paths, and conversions by turbine.

    `steps`: of the path to the records; `on_receipt`: whether the time of arrival stands in for a missing
    one; `quality`: of all values of a record, `own_quality`: of each; `own_time`: whether each has its own
    time; `own`: one of the two; `split`: reads tags by their pattern; `only`: the only turbine.
    """

    steps: tuple[str, ...]
    turbine: Reader
    time: Reader
    quality: Reader | None
    tag: Reader
    value: Reader
    on_receipt: bool
    own_time: bool
    own_quality: Reader | None
    own: bool
    split: Callable[[str], Tag | None] | None
    only: str | None
    conversions: Mapping[str, Conversion]
    of_turbines: Mapping[str, Mapping[str, Conversion]]

    def table(self, turbine: str) -> Mapping[str, Conversion]:
        """Name in the payloads of a turbine → conversion."""
        return self.of_turbines.get(turbine, self.conversions)


def _layout(mapping: PayloadMapping) -> Layout:
    conversions = {name: one.conversion for name, one in mapping.fields.items()}
    of_turbines = {}
    for turbine, own in mapping.names.items():
        kept = {name: one for name, one in conversions.items() if name not in own.values()}
        renamed = {name: conversions[common] for name, common in own.items() if common in conversions}
        of_turbines[turbine] = kept | renamed
    turbines = set(mapping.turbines.values())
    known = {name for table in (conversions, *of_turbines.values()) for name in table}
    pattern = mapping.tag_pattern
    own_time, own_quality = (NAME in path and not mapping.tag for path in (mapping.time, mapping.quality))
    quality = reader(mapping.quality) if mapping.quality else None
    return Layout(
        steps=tuple(mapping.records.split(".")) if mapping.records else (),
        turbine=reader(mapping.turbine),
        time=reader(mapping.time),
        quality=None if own_quality else quality,
        tag=reader(mapping.tag),
        value=reader(mapping.value),
        on_receipt=RECEIVED in alternatives(mapping.time),
        own_time=own_time,
        own_quality=quality if own_quality else None,
        own=own_time or own_quality,
        split=tag_reader(pattern, mapping.turbines, known) if pattern else None,
        only=next(iter(turbines)) if len(turbines) == 1 else None,
        conversions=conversions,
        of_turbines=of_turbines,
    )


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
