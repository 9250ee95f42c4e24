"""Converts payloads to readings: names, units, times, quality.  Impossible values are counted, never
corrected.

A payload has one or more records (`payload_formats`).  A `PayloadMapping` states where in a record turbine,
time and values stand, and how they are written (`payload_values`); `PayloadStatistics` counts the readings
and the rejected values.  A record may hold several values:

    {"turbine": "T07", "time": "2026-03-01T12:10:00Z", "quality": "good", "Tcab": 31.2, "RHcab": 41.0}

or, with `tag` and `value`, a single reading:

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
    UNSTATED_VOCABULARY,
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

EARLIEST_STAMP_S = 631_152_000.0
"""1990 [s since 1970]: earlier stamps are not times of a turbine."""
LATEST_STAMP_S = 4_102_444_800.0
"""2100 [s since 1970]: later stamps are not times of a turbine."""
FORECAST_S = 20 * DAY_S
"""Largest time [s] by which a stamp of a weather forecast may be ahead of this machine's clock."""
EVERYONE = ""
"""Turbine name of a weather forecast that applies to all turbines."""
NOBODY = ""
"""Turbine name under which a rejection is counted whose turbine is not known yet."""
UNCERTAIN_QUALITY = f"{UNCERTAIN} quality"
"""The only kind of rejection whose values are used: it is counted as a warning."""


@dataclass(frozen=True)
class Field:
    """A value in a payload: its signal, its unit, and the form of its readings.

    `stamp`: what the time stamp marks: "instant", or "start", "middle" or "end" of the averaging interval.
    The value in `unit` is `scale` times the number in the payload plus `offset`.  `one`: text of a flag that
    stands for 1, such as "open".
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
        """Time [s] from a stamp to the end of its averaging interval."""
        return {"start": 1.0, "middle": 0.5}.get(self.stamp, 0.0) * self.form.interval_s

    @property
    def conversion(self) -> Conversion:
        """The conversion to SI units.  Raises ValueError for a unit that does not fit the signal."""
        # the conversion is affine, so that its values at the numbers 0 and 1 determine it
        at_0, at_1 = to_si(np.array([self.offset, self.scale + self.offset]), self.unit, self.signal).tolist()
        limits = signal_named(self.signal)
        slack = 1e-9 * (limits.high - limits.low)  # rounding must not reject a value at the limit
        meaning = Meaning(self.signal, self.unit, self.one)
        return Conversion(
            self.signal, at_1 - at_0, at_0, self.shift_s, limits.low - slack, limits.high + slack, meaning
        )


class Conversion(NamedTuple):
    """Converts a number in a payload to a reading: factor * number + offset [SI unit], valid in `low` …
    `high`.

    `shift_s` [s] is added to the stamp; `meaning`: how a text with a unit or a flag is interpreted.
    """

    signal: str
    factor: float
    offset: float
    shift_s: float
    low: float
    high: float
    meaning: Meaning


class Rejection(NamedTuple):
    """A part of a payload that is counted and, unless its `kind` is `UNCERTAIN_QUALITY`, not used."""

    kind: str
    reason: str


class TurbineReadings(NamedTuple):
    """The readings and rejections of a turbine in a payload (`NOBODY`: rejections of no known turbine)."""

    turbine: str
    readings: list[Reading]
    rejections: list[Rejection]


class ReadingsByTurbine(dict[str, TurbineReadings]):
    """Turbine → readings and rejections of a payload; looking up a new turbine adds it with empty lists."""

    def __missing__(self, turbine: str) -> TurbineReadings:
        empty = self[turbine] = TurbineReadings(turbine, [], [])
        return empty


@dataclass(frozen=True)
class PayloadMapping:
    """Describes the layout of payloads.

    `fields`: name → field; `turbine`, `time`, `quality`, `tag`, `value`: their paths (`payload_values`);
    `vocabulary`: meaning of the quality marks; `use_uncertain`: whether uncertain readings are used;
    `turbines`: name in the payload → turbine.  If `turbine` is "", all payloads belong to the only turbine.
    With `weather` the payloads are weather forecasts, which apply to all turbines unless they name one.
    `form`: one of `payload_formats.FORMATS`; `records`: path to the records; `tag_pattern`: pattern of the
    tags or, without `tag`, of the names of values; `clock`: how times are written; `marks`: decimal and
    thousands marks of numbers in texts, None if they are not stated; `names`: turbine → its own name of a
    field → common name; `revision`: which of several values of one stamp counts, "last" or "neither".
    """

    fields: Mapping[str, Field]
    turbine: str = "turbine"
    time: str = "time"
    quality: str = ""
    tag: str = ""
    value: str = ""
    vocabulary: QualityVocabulary = UNSTATED_VOCABULARY
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
        self.table(EVERYONE)  # refuses a unit that does not fit its signal

    # -- prepared for reading --------------------------------------------------------------------------------
    @cached_property
    def steps(self) -> tuple[str, ...]:
        """The steps of the path to the records."""
        return tuple(self.records.split(".")) if self.records else ()

    @cached_property
    def readers(self) -> Mapping[str, Reader]:
        """Key of the mapping, such as "time" → reader of the path that the key states."""
        return {key: reader(getattr(self, key)) for key in ("turbine", "time", "quality", "tag", "value")}

    @cached_property
    def value_has_time_and_quality(self) -> tuple[bool, bool]:
        """Whether each value of a record has a time of its own, and whether it has a quality of its own."""
        return NAME in self.time and not self.tag, NAME in self.quality and not self.tag

    @cached_property
    def only_turbine(self) -> str | None:
        """The turbine if the mapping has exactly one, else None."""
        turbines = set(self.turbines.values())
        return turbines.pop() if len(turbines) == 1 else None

    @cached_property
    def conversions(self) -> Mapping[str, Mapping[str, Conversion]]:
        """Turbine → name in its payloads → conversion; turbines without an entry use that of `EVERYONE`."""
        common = {name: field.conversion for name, field in self.fields.items()}
        tables = {EVERYONE: common}
        for turbine, own_names in self.names.items():
            kept = {name: conversion for name, conversion in common.items() if name not in own_names.values()}
            renamed = {name: common[field] for name, field in own_names.items() if field in common}
            tables[turbine] = kept | renamed
        return tables

    def table(self, turbine: str) -> Mapping[str, Conversion]:
        """Return name in the payloads of a turbine → conversion."""
        return self.conversions.get(turbine, self.conversions[EVERYONE])

    @cached_property
    def read_tag(self) -> Callable[[str], Tag | None] | None:
        """Function that reads a tag by the pattern; None if the mapping has no pattern."""
        field_names = {name for table in self.conversions.values() for name in table}
        return tag_reader(self.tag_pattern, self.turbines, field_names) if self.tag_pattern else None

    def for_flat_payloads(self, use_uncertain: bool, turbines: Mapping[str, str]) -> PayloadMapping:
        """Return the mapping for a source that composes its payloads itself: flat objects with `turbine`,
        `time`, `quality` ("good", "uncertain" or "bad") and the fields by their common names."""
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
        """Whether the mapping reads a level of the topic."""
        return any("{" in text.replace(NAME, "") for text in (self.turbine, self.quality, self.tag)) or any(
            path.startswith("{") and path not in (NAME, RECEIVED) for path in alternatives(self.time)
        )

    def read(
        self, content: Content, received: float, topic: str = "", order: Order | None = None
    ) -> Sequence[TurbineReadings]:
        """Return the readings and rejections of a payload that was received at a time [s], by turbine.

        order: order of the source's local stamps so far, updated by this payload; None: unknown.

        Raises Refused if the payload cannot be read, or if nothing of its only record can be used.  Stamps
        before `EARLIEST_STAMP_S` or after `LATEST_STAMP_S` are refused; stamps of weather forecasts are
        refused if they are ahead of the arrival by more than `FORECAST_S`.
        """
        result, fault = ReadingsByTurbine(), None
        for record in records(content, self.form, self.steps, topic, received):
            try:
                self._read_record(record if order is None else record._replace(order=order), result)
            except Refused as refusal:
                fault = refusal
                result[NOBODY].rejections.append(Rejection(refusal.kind, str(refusal)))
        if fault is not None and len(result) == 1:  # perhaps the payload has nothing but this fault
            ((_, readings, rejections),) = result.values()
            if not readings and len(rejections) == 1:
                raise fault
        return list(result.values())

    def stamp(self, content: Content) -> float | None:
        """Return the first time [s] in a payload; None if the payload has no readable time."""
        try:
            for record in records(content, self.form, self.steps):
                time = seconds(self.readers["time"](record), self.clock) if record.scopes else None
                if time is not None:
                    return time
        except Refused:
            pass
        return None

    # -- one record ------------------------------------------------------------------------------------------
    def _read_record(self, record: PayloadRecord, result: ReadingsByTurbine) -> None:
        """Add the readings and rejections of a record.  Raises Refused if nothing of it can be used."""
        if not record.scopes:
            raise Refused("malformed", "expected a JSON object as a record")
        if self.tag:
            self._read_tagged_value(record, result)
        elif self.read_tag is not None:
            self._read_tagged_fields(record, self.read_tag, result)
        else:
            self._read_fields(record, result)

    def _read_fields(self, record: PayloadRecord, result: ReadingsByTurbine) -> None:
        """Read the values of a record whose fields have the names of the mapping."""
        turbine = self._turbine(self.readers["turbine"](record))
        has_own_time, has_own_quality = self.value_has_time_and_quality
        time, target = 0.0 if has_own_time else self._time(record, turbine), result[turbine]
        _, readings, rejections = target
        if not has_own_quality and not self._has_usable_quality(record, rejections):
            return
        count_before = len(readings) + len(rejections)
        scopes, table = record.scopes, self.table(turbine)
        for name, conversion in table.items():
            raw = value_at(scopes, name)
            if raw is not None and raw != "":
                self._convert(record, name, raw, conversion, time, target)
        if len(readings) + len(rejections) == count_before and not any(
            has_any_path(scopes, name) for name in table
        ):
            rejections.append(Rejection("no known field", f"no field is among {_names(scopes)}"))

    def _read_tagged_fields(
        self, record: PayloadRecord, read_tag: Callable[[str], Tag | None], result: ReadingsByTurbine
    ) -> None:
        """Read the values of a record whose names are tags, with the field and perhaps the turbine."""
        has_own_time, has_own_quality = self.value_has_time_and_quality
        stated_turbine = self.readers["turbine"](record)
        time = 0.0 if has_own_time else self._time(record, str(stated_turbine))
        rejections: list[Rejection] = []
        if not has_own_quality and not self._has_usable_quality(record, rejections):
            raise Refused(*rejections[0])
        if rejections:
            result[NOBODY if self.only_turbine is None else self.only_turbine].rejections.extend(rejections)
        has_field = False
        for name, raw in record.scopes[0].items():
            tag = read_tag(name)
            if tag is None or not tag.is_known:
                continue
            turbine = self._turbine(stated_turbine if tag.turbine is None else tag.turbine)
            conversion = self.table(turbine).get(tag.field)
            if conversion is None:
                continue
            has_field = True
            if raw is not None and raw != "":
                self._convert(record, name, raw, conversion, time, result[turbine])
        if not has_field:
            reason = f"no field matching {self.tag_pattern} is among {_names(record.scopes)}"
            raise Refused("no known field", reason)

    def _read_tagged_value(self, record: PayloadRecord, result: ReadingsByTurbine) -> None:
        """Read the only value of a record, whose field is named by a tag."""
        # tag and value must stand in the same object: an outer object's tag or value is not this record's
        inner = record if len(record.scopes) == 1 else record._replace(scopes=record.scopes[:1])
        stated_tag, stated_turbine = self.readers["tag"](inner), self.readers["turbine"](record)
        name = str(stated_tag)[: LONGEST_TEXT + 1]
        if self.read_tag is not None:
            tag = self.read_tag(name)
            if tag is None:
                raise Refused("unknown tag", f"tag {quoted(stated_tag)} does not match {self.tag_pattern}")
            name, stated_turbine = tag.field, stated_turbine if tag.turbine is None else tag.turbine
        turbine = self._turbine(stated_turbine)
        time, target = self._time(record, turbine, name), result[turbine]
        if not self._has_usable_quality(record, target.rejections, f"{quoted(stated_tag)}: "):
            return
        conversion = self.table(turbine).get(name)
        if conversion is None:
            target.rejections.append(
                Rejection("unknown tag", f"tag {quoted(stated_tag)} is not a field of the mapping")
            )
            return
        raw = self.readers["value"](inner)
        if raw is not None and raw != "":
            self._convert(record, name, raw, conversion, time, target)
        elif raw is None and not has_any_path(inner.scopes, self.value):
            reason = f"no {self.value} is among {_names(record.scopes)}"
            target.rejections.append(Rejection("no known field", reason))

    # -- parts of a record -----------------------------------------------------------------------------------
    def _convert(
        self,
        record: PayloadRecord,
        name: str,
        raw: Json,
        conversion: Conversion,
        time: float,
        target: TurbineReadings,
    ) -> None:
        """Convert the value `raw` named `name` in a record, and add the reading or the rejection to `target`.

        time: time [s] of the record, for values without a time of their own.
        """
        signal, factor, offset, shift_s, low, high, meaning = conversion
        has_own_time, has_own_quality = self.value_has_time_and_quality
        try:
            if has_own_time or has_own_quality:
                record = record._replace(name=name)
                time = self._time(record, target.turbine, name) if has_own_time else time
                if has_own_quality and not self._has_usable_quality(record, target.rejections, f"{name}: "):
                    return
            parsed = number(raw, self.marks or POINT)
            if parsed is None:
                parsed = quantity_or_flag(raw, meaning, self.marks or POINT)
            if self.marks is None and isinstance(raw, str) and PARTED.match(raw):
                # the point may divide thousands: the signal's range decides if only one of the two is in it
                in_range = [
                    candidate
                    for candidate in (parsed, 1e3 * parsed)
                    if low <= factor * candidate + offset <= high
                ]
                if len(in_range) > 1:
                    reason = (
                        f'{quoted(raw)} may be {parsed:g} or {1e3 * parsed:g}: state decimal = "." or ","'
                    )
                    raise Refused("ambiguous number", reason)
                parsed = in_range[0] if in_range else parsed
        except Unread as refusal:
            target.rejections.append(Rejection(refusal.kind, f"{name}: {refusal}"))
            return
        value = factor * parsed + offset
        if low <= value <= high:
            target.readings.append(Reading(signal, time + shift_s, value))
        else:
            reason = f"{name}: {quoted(raw)} is outside the range of {signal}"
            target.rejections.append(Rejection("impossible value", reason))

    def _turbine(self, name: Json) -> str:
        """Return the turbine that payloads call `name`.  Raises Refused for an unknown name."""
        if name is None and self.weather:
            return EVERYONE
        if not self.turbine and self.only_turbine is not None:
            return self.only_turbine
        turbine = self.turbines.get(str(name)[: LONGEST_TEXT + 1]) if name is not None else None
        if turbine is None:
            raise Refused("unknown turbine", f"turbine {quoted(name)} is not tracked")
        return turbine

    def _time(self, record: PayloadRecord, *series: str) -> float:
        """Return the time [s] of a record or of one of its values.  Raises Refused.

        series: name of the series of stamps to which this one belongs, for the order of local times.
        """
        stamp = self.readers["time"](record)
        if stamp is None and RECEIVED in alternatives(self.time):
            return record.received
        time = seconds(stamp, self.clock, record.received, record.order, series)
        if time is None:
            raise Refused("no time", f"expected a time as {self.clock.expected}, found {quoted(stamp)}")
        if not EARLIEST_STAMP_S <= time <= (record.received + FORECAST_S if self.weather else LATEST_STAMP_S):
            too_late = "more than 20 days ahead of this machine's clock" if self.weather else "after 2100"
            raise Refused("impossible time", f"time {quoted(stamp)} is before 1990 or {too_late}")
        return time

    def _has_usable_quality(
        self, record: PayloadRecord, rejections: list[Rejection], prefix: str = ""
    ) -> bool:
        """Whether the quality of a record or value allows its use; a quality that is not good is added to
        `rejections`, with `prefix` before its text."""
        if not self.quality:
            return True
        mark = self.readers["quality"](record)
        outcome = GOOD if mark is None else self.vocabulary.judge(mark)
        if outcome == UNCERTAIN and not self.use_uncertain:
            outcome = BAD
        if outcome != GOOD:
            rejections.append(Rejection(f"{outcome} quality", f"{prefix}quality {quoted(mark)}"))
        return outcome in (GOOD, UNCERTAIN)


def _names(scopes: Scopes) -> str:
    """Return the first three names of a record, for messages."""
    return ", ".join(quoted(name) for name in list(scopes[0])[:3]) or "nothing"


# -- counts --------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class _RecordingVocabulary(QualityVocabulary):
    """A vocabulary that records the marks that it judges, in the order of their first occurrence."""

    wrapped: QualityVocabulary = UNSTATED_VOCABULARY
    marks: dict[str, None] = field(default_factory=dict)

    def judge(self, mark: object) -> str:
        """Record a mark and return what it means: "good", "uncertain" or "bad"."""
        self.marks[str(mark)] = None
        return self.wrapped.judge(mark)


class PayloadStatistics:
    """Counts the payloads that a mapping reads.

    `payloads`: number of payloads received; `used`: number of payloads with readings; `newest`: (turbine,
    signal) -> time [s] of the newest reading; `counts`: kind of rejection -> its number; `reasons`: kind of
    rejection -> the reason of the first one; `lag_s`: smallest delay [s] from stamp to arrival, negative if
    the stamp is ahead, NaN without a stamp.
    """

    def __init__(self, mapping: PayloadMapping) -> None:
        self._vocabulary = _RecordingVocabulary("", {}, wrapped=mapping.vocabulary)
        self._unstated_marks: dict[tuple[str, str], dict[str, None]] = {}
        """(field, field that seems to hold its quality) -> distinct marks in the latter."""
        self.mapping = replace(mapping, vocabulary=self._vocabulary)
        self.payloads = self.used = 0
        self.newest: dict[tuple[str, str], float] = {}
        self.counts: Counter[str] = Counter()
        self.reasons: dict[str, str] = {}
        self.lag_s = math.nan
        self._order: Order = {}

    def take(self, content: Content, received: float, topic: str = "") -> Sequence[TurbineReadings]:
        """Count a payload received at a time [s]; returns its readings and rejections by turbine."""
        self.payloads += 1
        if not self.mapping.quality:
            self._record_unstated_quality(content, topic)
        try:
            results = self.mapping.read(content, received, topic, self._order)
        except Refused as fault:
            results = [TurbineReadings(NOBODY, [], [Rejection(fault.kind, str(fault))])]
            if fault.kind == "impossible time":
                self._update_lag(self.mapping.stamp(content), received)
        if not any(result.readings or result.rejections for result in results):
            # a pausing sensor sends empty payloads, but a check of the mapping must not take them as success
            results = [TurbineReadings(NOBODY, [], [Rejection("no value", "its fields are empty")])]
        self.used += any(result.readings for result in results)
        for turbine, readings, rejections in results:
            for kind, reason in rejections:
                self.counts[kind] += 1
                self.reasons.setdefault(kind, f"{reason}, used" if kind == UNCERTAIN_QUALITY else reason)
            for reading in readings:
                key = (turbine, reading.signal)
                self.newest[key] = max(reading.time, self.newest.get(key, -math.inf))
                self._update_lag(reading.time, received)
        return results

    def _update_lag(self, stamp: float | None, received: float) -> None:
        """Keep the smallest delay from a stamp [s] to its arrival `received` [s]."""
        if stamp is not None:
            lag_s = received - stamp
            self.lag_s = lag_s if math.isnan(self.lag_s) else min(lag_s, self.lag_s)

    def _record_unstated_quality(self, content: Content, topic: str) -> None:
        """Record the marks in fields that, judging by their names, hold the quality of other fields."""
        mapping = self.mapping
        with suppress(Refused):
            for record in records(content, mapping.form, mapping.steps, topic):
                payload = record.scopes[0] if record.scopes else {}
                columns = (
                    [mapping.value] if mapping.tag else [name for name in payload if name in mapping.fields]
                )
                for column, quality_column in quality_columns(list(payload), columns).items():
                    marks = self._unstated_marks.setdefault((column, quality_column), {})
                    marks[str(payload[quality_column])] = None

    @property
    def rejected(self) -> tuple[Statement, ...]:
        """How many values were rejected, by kind, and doubts about quality marks."""
        kinds = self.counts.most_common()
        counts = (
            ExaminedCode.REFUSED(count=count, kind=kind, why=self.reasons[kind]) for kind, count in kinds
        )
        doubts = [misfit(self._vocabulary.wrapped, list(self._vocabulary.marks))]
        doubts += [unstated(*columns, list(marks)) for columns, marks in self._unstated_marks.items()]
        return (*counts, *filter(None, doubts))
