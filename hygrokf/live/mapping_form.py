"""The table [mapping] of the tracker's file, common or of one [[source]]: how payloads are read."""

from __future__ import annotations

import datetime
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from hygrokf.cases.form import HOLD_HELP, LONGEST_HELP, STAMPS, StatedSensor, longest_hold, stated_signal
from hygrokf.data.numbers import stated_marks
from hygrokf.data.quality import UNSTATED, QualityVocabulary, stated_vocabulary
from hygrokf.data.signals import SWITCHED, Signal
from hygrokf.data.timestamps import EXCEL, duration, time_format_fault, zone_in_header, zone_named
from hygrokf.data.toml_form import Place, across, entry_name, read_form, setting
from hygrokf.live.plan import Form
from hygrokf.live.sources.payload import Field, PayloadMapping
from hygrokf.live.sources.payload_formats import FORMATS, JSON, PLAIN
from hygrokf.live.sources.payload_values import RECEIVED, Clock, alternatives, path_fault, pattern_fault
from hygrokf.physics.holds import MEAN, PREVIOUS, hold_named

PATHS = ("turbine", "time", "quality", "tag", "value")
ON_CHANGE = ("mqtt", "opc.tcp:")
"""Beginnings of the URLs of sources that report a value when it changes."""
SAMPLE = datetime.datetime(2026, 11, 23, 17, 48)
"""A time whose parts differ, to try a form of stamps on."""


def texts(value: object) -> tuple[str, ...]:
    """A list as texts.  Raises ValueError."""
    if not isinstance(value, list):
        raise ValueError(f"expected a list, found {value!r}")
    return tuple(str(one) for one in value)


def _time_form(value: object) -> str:
    """A strptime form that holds a date and a time to the minute; empty for ISO 8601.  Raises ValueError."""
    if value in ("", EXCEL):
        return str(value)
    if isinstance(value, str):
        if fault := time_format_fault(value):
            raise ValueError(fault)
        try:
            found = datetime.datetime.strptime(SAMPLE.astimezone().strftime(value), value)
            if found.replace(tzinfo=None) == SAMPLE:
                return value
        except ValueError:
            pass
    example = '"%d.%m.%Y %H:%M:%S"'
    raise ValueError(f"expected a strptime form of date and time such as {example}, found {value!r}")


@dataclass(frozen=True, kw_only=True)
class SignalForm(StatedSensor):
    """A row of [mapping.signals]."""

    field: str = entry_name()
    signal: Signal = setting(help="a signal of docs/reference/signals.md", read=stated_signal)
    stamp: str = setting("instant", "an instant, or a position in the interval", choices=STAMPS)
    interval_s: float = setting(0.0, "length averaged over", read=duration)
    hold: str | None = setting(None, HOLD_HELP, read=hold_named)
    longest_hold_s: float | None = setting(None, LONGEST_HELP, read=longest_hold, above=0.0)
    scale: float = setting(
        1.0, "by which the number is multiplied", fits=bool, expected="a number other than 0"
    )
    offset: float = setting(0.0, "added to the scaled number [unit]")

    @across("stamp", "interval")
    def mean(self) -> str | None:
        if (self.stamp == "instant") == (self.interval_s == 0.0):
            return None
        return 'a mean needs both, stamp = "start", "middle" or "end" and its interval'

    @across("hold", "stamp", "interval")
    def hold_of_stamp(self) -> str | None:
        if self.hold is None or (self.hold == MEAN) == (self.stamp != "instant"):
            return None
        return f'hold = "{self.hold}" with stamp = "{self.stamp}": a mean has both, "mean" and its stamp'

    def to_field(self) -> Field:
        """The field of a payload."""
        hold = self.hold or (MEAN if self.interval_s > 0 else self.signal.hold)
        form = Form(hold, self.interval_s, **self.settings, longest_hold_s=self.longest_hold_s)
        return Field(self.signal.name, self.unit, form, self.stamp, self.scale, self.offset, self.one or "")


@dataclass(frozen=True)
class MappingForm:
    """The table [mapping]."""

    format: str = setting(JSON, "of payloads that are no rows of a table", choices=FORMATS)
    records: str = setting("", "path to the objects that hold the values")
    turbine: str = setting("turbine", "field with the turbine's name", empty=True)
    time: str = setting("time", "field with the time")
    timezone: datetime.tzinfo | None = setting(None, "of stamps without an offset", read=zone_named)
    time_format: str = setting("", "strptime form of stamps that are not ISO 8601", read=_time_form)
    quality: str = setting("", "field with a quality")
    vocabulary: QualityVocabulary = setting(UNSTATED, "of quality, or its good marks", read=stated_vocabulary)
    good: QualityVocabulary | None = setting(
        None, "good marks, in place of a vocabulary", read=stated_vocabulary
    )
    use_uncertain: bool = setting(True, "use readings of uncertain quality")
    tag: str = setting("", "field with the name, where a record is one reading")
    value: str = setting("", "field with the value, where a record is one reading")
    tag_pattern: str = setting("", "of tags or, without tag, of the names of the fields")
    decimal: str | None = setting(None, "mark of numbers in texts", choices=(".", ","))
    signals: Mapping[str, SignalForm] = setting(dict, "fields that are signals")

    @across("tag", "value")
    def one_reading(self) -> str | None:
        if bool(self.tag) == bool(self.value):
            return None
        return "tag and value belong together: one reading a record needs both"

    @across(*PATHS)
    def paths(self) -> Iterator[str]:
        for key in PATHS:
            wrong = path_fault(getattr(self, key), *((RECEIVED,) if key == "time" else ()))
            if wrong is not None:
                yield f"{key}: {wrong}"

    @across("records")
    def path_of_records(self) -> str | None:
        steps = self.records.split(".")
        if not self.records or (all(steps) and "{" not in self.records):
            return None
        return f'records: expected names with points between, "*" for every one, found {self.records!r}'

    @across("tag_pattern", "turbine")
    def pattern(self) -> str | None:
        wrong = pattern_fault(self.tag_pattern) if self.tag_pattern else None
        return None if wrong is None else f"tag_pattern: {wrong}"

    @across("format", "time")
    def time_of_plain(self) -> str | None:
        if self.format != PLAIN or any("{" in one for one in alternatives(self.time)):
            return None
        return f'a plain value has no field {self.time!r}: state time = "{RECEIVED}", the time of arrival'

    @across("signals")
    def rows(self) -> Iterator[str]:
        taken: dict[str, str] = {}
        for name, one in self.signals.items():
            if one.signal.name in taken:
                yield f"{name} and {taken[one.signal.name]} are both {one.signal.name}"
            taken[one.signal.name] = name

    def to_mapping(self) -> PayloadMapping:
        """The mapping, without rows that cannot be used and without turbines yet."""
        valid = {name: one for name, one in self.signals.items() if one.signal and not one.unit_of_signal()}
        zone = zone_in_header(self.time) if self.timezone is None else None
        return PayloadMapping(
            {name: one.to_field() for name, one in valid.items()},
            turbine=self.turbine,
            time=self.time,
            quality=self.quality,
            tag=self.tag,
            value=self.value,
            vocabulary=self.good or self.vocabulary,
            use_uncertain=self.use_uncertain,
            form=self.format,
            records=self.records,
            tag_pattern="" if pattern_fault(self.tag_pattern) else self.tag_pattern,
            clock=Clock(self.timezone if zone is None else zone_named(zone), self.time_format),
            marks=stated_marks(self.decimal, None),
        )


def source_mappings(
    common: MappingForm, stated: object, sources: Sequence[Mapping[str, object]], place: Place
) -> tuple[PayloadMapping, ...]:
    """The mapping of each [[source]]: the common one, with the keys that its own table has instead.

    stated: the common table as it stands in the file, whose faults are in `place` already.
    """
    said = {_without_place(one) for one in place.faults}
    base = stated if isinstance(stated, Mapping) else {}
    forms = []
    for number, source in enumerate(sources):
        own, inside, form = source.get("mapping"), place.inside("source", number), common
        if isinstance(own, Mapping):
            apart = replace(inside.inside("mapping"), faults=[])
            form = read_form(MappingForm, {**base, **own}, apart)
            place.faults.extend(one for one in apart.faults if _without_place(one) not in said)
        elif own is not None:
            inside.fault(f"mapping must be a table [source.mapping], found {own!r}")
        forms.append(form)
    if not all(one.signals for one in forms or [common]):
        place.inside("mapping").fault(
            "no signals: add [mapping.signals] with rows such as "
            'Tcab = { signal = "cabinet_temperature", unit = "degC" }'
        )
    return tuple(one.to_mapping() for one in forms)


def _without_place(fault: str) -> str:
    """A fault of a mapping without the table that it is in."""
    return fault.partition("mapping")[2].lstrip("] ")


def expect_one_place(
    mappings: Iterable[PayloadMapping], sources: Sequence[Mapping[str, Any]], place: Place
) -> None:
    """Faults of tags of one server or file that two [[source]] tables read as different signals."""
    taken: dict[tuple[str, ...], tuple[str, int]] = {}
    for number, (mapping, source) in enumerate(zip(mappings, sources, strict=True)):
        nodes, topics = source.get("nodes"), source.get("topics")
        tags: dict[tuple[str, ...], str] = {}
        for name, one in mapping.fields.items():
            for topic in topics if isinstance(topics, list) else [""]:
                tags[str(topic), name] = one.signal
        if isinstance(nodes, Mapping):
            tags = {
                (name,): f"{mapping.fields[one['field']].signal} of {one.get('turbine')}"
                for name, one in nodes.items()
                if isinstance(one, Mapping) and one.get("field") in mapping.fields
            }
        for tag, said in tags.items():
            of = (str(source.get("url")), str(source.get("query")), str(source.get("weather")), *tag)
            other, first = taken.setdefault(of, (said, number))
            if other != said:
                there = place.inside("source", first).at()
                place.inside("source", number).fault(
                    f"{tag[-1]} of {of[0]} is {said} here and {other} in {there}: a tag has one place; name "
                    "the right one alone"
                )


def source_forms(
    mappings: Iterable[PayloadMapping], sources: Sequence[Mapping[str, object]], place: Place
) -> dict[str, Form]:
    """Signal → how its sources report it, which must be the same for all but weather forecasts.

    What only switches and comes from a source that reports changes holds while connected by default.
    """
    found: dict[str, Form] = {}
    on_change: set[str] = set()
    for number, mapping in enumerate(mappings):
        if number < len(sources) and sources[number].get("weather") is True:
            continue
        for name, one in mapping.fields.items():
            if found.setdefault(one.signal, one.form) != one.form:
                place.inside("source", number).fault(
                    f"mapping: {name} is {one.signal} of another interval, accuracy, resolution or response "
                    "time than that of an earlier source; state the same in both"
                )
            if str(sources[number].get("url")).startswith(ON_CHANGE) and one.signal in SWITCHED:
                on_change.add(one.signal)
    for signal in on_change:
        if found[signal].hold == PREVIOUS and found[signal].longest_hold_s is None:
            found[signal] = replace(found[signal], longest_hold_s=math.inf)
    return found
