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
from functools import cached_property
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
from hygrokf.live.plan import SignalReporting
from hygrokf.live.sources.payload_formats import JSON, Content, Order, PayloadRecord, Refused, Scopes, records
from hygrokf.live.sources.payload_values import (
    LONGEST_TEXT,
    NAME,
    RECEIVED,
    STATED_OFFSETS,
    Clock,
    Reader,
    Tag,
    alternatives,
    has_any_path,
    number,
    quantity_or_flag,
    quoted,
    reader,
    seconds,
    tag_reader,
    value_at,
)
from hygrokf.live.tracker import Reading
from hygrokf.texts.doctor_codes import ExaminedCode
from hygrokf.texts.statement import Statement

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
    form: SignalReporting = field(default_factory=SignalReporting)
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

    def __post_init__(self) -> None:
        self.table(EVERYONE)  # a unit that does not fit is refused at once

    # -- prepared for reading --------------------------------------------------------------------------------
    @cached_property
    def steps(self) -> tuple[str, ...]:
        """Of the path to the records."""
        return tuple(self.records.split(".")) if self.records else ()

    @cached_property
    def readers(self) -> Mapping[str, Reader]:
        """Key of the mapping → reader of its path."""
        return {key: reader(getattr(self, key)) for key in ("turbine", "time", "quality", "tag", "value")}

    @cached_property
    def own(self) -> tuple[bool, bool]:
        """Whether each value of a record has its own time, and its own quality."""
        return NAME in self.time and not self.tag, NAME in self.quality and not self.tag

    @cached_property
    def only(self) -> str | None:
        """The only turbine; None of several."""
        turbines = set(self.turbines.values())
        return turbines.pop() if len(turbines) == 1 else None

    @cached_property
    def conversions(self) -> Mapping[str, Mapping[str, Conversion]]:
        """Turbine with names of its own, or `EVERYONE` → name in its payloads → conversion."""
        common = {name: one.conversion for name, one in self.fields.items()}
        tables = {EVERYONE: common}
        for turbine, own in self.names.items():
            kept = {name: one for name, one in common.items() if name not in own.values()}
            renamed = {name: common[field] for name, field in own.items() if field in common}
            tables[turbine] = kept | renamed
        return tables

    def table(self, turbine: str) -> Mapping[str, Conversion]:
        """Name in the payloads of a turbine → conversion."""
        return self.conversions.get(turbine, self.conversions[EVERYONE])

    @cached_property
    def split(self) -> Callable[[str], Tag | None] | None:
        """Reads tags by their pattern; None without one."""
        known = {name for table in self.conversions.values() for name in table}
        return tag_reader(self.tag_pattern, self.turbines, known) if self.tag_pattern else None

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
        for record in records(content, self.form, self.steps, topic, received):
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
            for record in records(content, self.form, self.steps):
                found = seconds(self.readers["time"](record), self.clock) if record.scopes else None
                if found is not None:
                    return found
        except Refused:
            pass
        return None

    # -- one record ------------------------------------------------------------------------------------------
    def _read_record(self, record: PayloadRecord, found: Found) -> None:
        """Add what a record says to what is found.  Raises Refused if none of it can be used."""
        if not record.scopes:
            raise Refused("malformed", "expected an object as a record, found something else")
        if self.tag:
            self._read_tag(record, found)
        elif self.split is not None:
            self._read_names(record, self.split, found)
        else:
            self._read_fields(record, found)

    def _read_fields(self, record: PayloadRecord, found: Found) -> None:
        turbine = self._turbine(self.readers["turbine"](record))
        own_time, own_quality = self.own
        time, of = 0.0 if own_time else self._time(record, turbine), found[turbine]
        _, readings, rejections = of
        if not own_quality and not self._has_quality(record, rejections):
            return
        before = len(readings) + len(rejections)
        scopes, table = record.scopes, self.table(turbine)
        for name, conversion in table.items():
            raw = value_at(scopes, name)
            if raw is not None and raw != "":
                self._convert(record, name, raw, conversion, time, of)
        if len(readings) + len(rejections) == before and not any(
            has_any_path(scopes, name) for name in table
        ):
            rejections.append(Rejection("no known field", f"no field is among {_names(scopes)}"))

    def _read_names(self, record: PayloadRecord, split: Callable[[str], Tag | None], found: Found) -> None:
        """Read every value of a record whose names say field and perhaps turbine."""
        spoken, (own_time, own_quality) = self.readers["turbine"](record), self.own
        time = 0.0 if own_time else self._time(record, str(spoken))
        marked: list[Rejection] = []
        if not own_quality and not self._has_quality(record, marked):
            raise Refused(marked[0].kind, marked[0].words)
        if marked:
            found[NOBODY if self.only is None else self.only].rejections.extend(marked)
        seen = False
        for name, raw in record.scopes[0].items():
            tag = split(name)
            if tag is None or not tag.is_known:
                continue
            turbine = self._turbine(spoken if tag.turbine is None else tag.turbine)
            conversion = self.table(turbine).get(tag.field)
            if conversion is None:
                continue
            seen = True
            if raw is not None and raw != "":
                self._convert(record, name, raw, conversion, time, found[turbine])
        if not seen:
            said = f"no field like {self.tag_pattern} is among {_names(record.scopes)}"
            raise Refused("no known field", said)

    def _read_tag(self, record: PayloadRecord, found: Found) -> None:
        """Read the only value of a record, whose field a tag names."""
        # tag and value belong together: those of the objects around it are not this record's
        inner = record if len(record.scopes) == 1 else record._replace(scopes=record.scopes[:1])
        stated, spoken = self.readers["tag"](inner), self.readers["turbine"](record)
        name = str(stated)[: LONGEST_TEXT + 1]
        if self.split is not None:
            tag = self.split(name)
            if tag is None:
                raise Refused("unknown tag", f"tag {quoted(stated)} is not like {self.tag_pattern}")
            name, spoken = tag.field, spoken if tag.turbine is None else tag.turbine
        turbine = self._turbine(spoken)
        time, of = self._time(record, turbine, name), found[turbine]
        if not self._has_quality(record, of.rejections, f"{quoted(stated)}: "):
            return
        conversion = self.table(turbine).get(name)
        if conversion is None:
            of.rejections.append(Rejection("unknown tag", f"tag {quoted(stated)} is no field"))
            return
        raw = self.readers["value"](inner)
        if raw is not None and raw != "":
            self._convert(record, name, raw, conversion, time, of)
        elif raw is None and not has_any_path(inner.scopes, self.value):
            said = f"no {self.value} is among {_names(record.scopes)}"
            of.rejections.append(Rejection("no known field", said))

    # -- parts of a record -----------------------------------------------------------------------------------
    def _convert(
        self,
        record: PayloadRecord,
        name: str,
        raw: Json,
        conversion: Conversion,
        time: float,
        of: TurbineReadings,
    ) -> None:
        """Add the reading of a value at its own time or else this one, or why it is none."""
        signal, factor, offset, shift_s, low, high, meaning = conversion
        own_time, own_quality = self.own
        try:
            if own_time or own_quality:
                record = record._replace(name=name)
                time = self._time(record, of.turbine, name) if own_time else time
                if own_quality and not self._has_quality(record, of.rejections, f"{name}: "):
                    return
            found = number(raw, self.marks or POINT)
            if found is None:
                found = quantity_or_flag(raw, meaning, self.marks or POINT)
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
        if not self.turbine and self.only is not None:
            return self.only
        turbine = self.turbines.get(str(name)[: LONGEST_TEXT + 1]) if name is not None else None
        if turbine is None:
            raise Refused("unknown turbine", f"turbine {quoted(name)} is not tracked")
        return turbine

    def _time(self, record: PayloadRecord, *series: str) -> float:
        stamp = self.readers["time"](record)
        if stamp is None and RECEIVED in alternatives(self.time):
            return record.received
        time = seconds(stamp, self.clock, record.received, record.order, series)
        if time is None:
            raise Refused("no time", f"expected a time as {self.clock.expected}, found {quoted(stamp)}")
        if not EARLIEST_S <= time <= (record.received + FORECAST_S if self.weather else LATEST_S):
            late = "more than 20 days ahead of this machine's clock" if self.weather else "after 2100"
            raise Refused("impossible time", f"time {quoted(stamp)} is before 1990 or {late}")
        return time

    def _has_quality(self, record: PayloadRecord, rejections: list[Rejection], what: str = "") -> bool:
        """Whether a record, or a value of it, is used by its quality; adds its count where it is not good."""
        if not self.quality:
            return True
        mark = self.readers["quality"](record)
        outcome = GOOD if mark is None else self.vocabulary.judge(mark)
        if outcome == UNCERTAIN and not self.use_uncertain:
            outcome = BAD
        if outcome != GOOD:
            rejections.append(Rejection(f"{outcome} quality", f"{what}quality {quoted(mark)}"))
        return outcome in (GOOD, UNCERTAIN)


def _names(scopes: Scopes) -> str:
    return ", ".join(quoted(name) for name in list(scopes[0])[:3]) or "nothing"


# -- counted ------------------------------------------------------------------------------------------------
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
            for one in records(content, mapping.form, mapping.steps, topic):
                payload = one.scopes[0] if one.scopes else {}
                columns = [mapping.value] if mapping.tag else [n for n in payload if n in mapping.fields]
                for names in quality_columns(list(payload), columns).items():
                    self._beside.setdefault(names, {})[str(payload[names[1]])] = None

    @property
    def rejected(self) -> tuple[Statement, ...]:
        """The rejected items by kind, and doubts about quality."""
        kinds = self.counts.most_common()
        counted = (ExaminedCode.REFUSED(count=n, kind=kind, why=self.reasons[kind]) for kind, n in kinds)
        doubts = [misfit(self._noting.of, list(self._noting.seen))]
        doubts += [unstated(*names, list(marks)) for names, marks in self._beside.items()]
        return (*counted, *filter(None, doubts))
