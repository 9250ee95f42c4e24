"""Converts payloads to readings: names, units, times, quality.  Impossible values are counted, never
corrected.

A payload is one JSON object or a row of a table.  A `PayloadMapping` states which of its fields hold
turbine, time and values:

    {"turbine": "T07", "time": "2026-03-01T12:10:00Z", "quality": "good", "Tcab": 31.2, "RHcab": 41.0}

or, with `tag` and `value`, one reading per payload: {"turbine": "T07", "time": …, "tag": "Tcab", "value":
31.2}.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np

from hygrokf.data.signals import signal_named, to_si
from hygrokf.data.structured import Json, JsonObject
from hygrokf.data.timestamps import DAY_S
from hygrokf.live.plan import Form
from hygrokf.live.tracker import Reading

Payload = Mapping[str, Json]
"""A parsed payload: names with plain values."""
LARGEST = 65_536
"""Largest payload [bytes]."""
DEEPEST = 6
"""Largest nesting depth of a payload."""
LONGEST = 200
"""Longest name or time [characters]."""
EARLIEST_S = 631_152_000.0
"""1990 [s since 1970]: earlier stamps are not times of a turbine."""
AHEAD_S = 900.0
"""[s] a stamp may be ahead of this machine's clock; readings that are further ahead are held back."""
LATEST_S = 4_102_444_800.0
"""2100 [s since 1970]: later stamps are not times of a turbine."""
FORECAST_S = 20 * DAY_S
"""[s] a weather forecast's stamp may be ahead of this machine's clock."""
EVERYONE = ""
"""Turbine name of a weather forecast that applies to all turbines."""
GOOD = ("good", "ok", "valid", "true", "0", "192")
"""Default quality marks of a good reading; 192 is OPC's."""


class Refused(Exception):
    """A payload that is not used; `kind` is the name under which it is counted."""

    def __init__(self, kind: str, words: str) -> None:
        super().__init__(words)
        self.kind = kind


@dataclass(frozen=True)
class Field:
    """A value in a payload: its signal, its unit, the form of its readings, and what its stamp marks.

    `stamp`: "instant", or "start", "middle" or "end" of the averaging interval.
    """

    signal: str
    unit: str
    form: Form = field(default_factory=Form)
    stamp: str = "instant"

    @property
    def scale(self) -> tuple[float, float]:
        """(factor, offset) of the conversion to the SI unit."""
        zero, one = to_si(np.array([0.0, 1.0]), self.unit, self.signal).tolist()
        return one - zero, zero

    @property
    def shift_s(self) -> float:
        """[s] from the stamp to the end of the interval."""
        return {"start": 1.0, "middle": 0.5}.get(self.stamp, 0.0) * self.form.interval_s


class Conversion(NamedTuple):
    """Converts a field to a reading: value = factor * number + offset [SI unit], valid within `low` … `high`.

    `shift_s` [s] is added to the stamp.
    """

    signal: str
    factor: float
    offset: float
    shift_s: float
    low: float
    high: float


class TurbineReadings(NamedTuple):
    """Readings of one turbine from a payload, and counts of its rejected values by kind."""

    turbine: str
    readings: tuple[Reading, ...]
    counts: Counter[str]


@dataclass(frozen=True)
class PayloadMapping:
    """Describes the layout of payloads.

    `fields`: name → field; `turbine`, `time`, `quality`, `tag`, `value`: names of fields ("a.b" descends one
    level, "{1}" is the second level of the topic); `good`: accepted quality marks; `turbines`: name in the
    payload → turbine.  If `turbine` is "", all payloads belong to the only turbine.  With `weather` the
    payloads are weather forecasts, which apply to all turbines unless they name one.
    """

    fields: Mapping[str, Field]
    turbine: str = "turbine"
    time: str = "time"
    quality: str = ""
    tag: str = ""
    value: str = ""
    good: Collection[str] = GOOD
    turbines: Mapping[str, str] = field(default_factory=dict)
    weather: bool = False
    conversions: Mapping[str, Conversion] = field(init=False, repr=False, compare=False)
    """Name of a field → its conversion, derived from `fields`."""

    def __post_init__(self) -> None:
        rows = {}
        for name, one in self.fields.items():
            factor, offset = one.scale
            row = signal_named(one.signal)
            slack = 1e-9 * (row.high - row.low)
            rows[name] = Conversion(
                one.signal, factor, offset, one.shift_s, row.low - slack, row.high + slack
            )
        object.__setattr__(self, "conversions", rows)

    def read(self, content: bytes | str | Payload, received: float, topic: str = "") -> TurbineReadings:
        """The readings of a payload received at a time [s].  Raises Refused if none of it can be used.

        Stamps before `EARLIEST_S` or after `LATEST_S` are refused, and those of a weather forecast that are
        ahead of the arrival by more than `FORECAST_S`.
        """
        payload = parse_payload(content)
        turbine = self._turbine(payload, topic)
        stamp = _value_at(payload, self.time, topic)
        time = seconds(stamp)
        if time is None:
            raise Refused(
                "no time",
                f"expected a time as ISO 8601 with offset or as seconds since 1970, found {_quoted(stamp)}",
            )
        if not EARLIEST_S <= time <= (received + FORECAST_S if self.weather else LATEST_S):
            raise Refused(
                "impossible time", f"time {_quoted(stamp)} is before 1990, after 2100, or too far ahead"
            )
        if self.quality:
            mark = _value_at(payload, self.quality, topic)
            if mark is not None and str(mark).strip().lower() not in self.good:
                return TurbineReadings(turbine, (), Counter({"bad quality": 1}))
        counts: Counter[str] = Counter()
        readings = []
        for name, raw in self._values(payload, topic, counts):
            if raw is None or raw == "":
                continue
            signal, factor, offset, shift, low, high = self.conversions[name]
            number = _number(raw)
            if number is None:
                counts["no number"] += 1
                continue
            value = factor * number + offset
            if not low <= value <= high:
                counts["impossible value"] += 1
                continue
            readings.append(Reading(signal, time + shift, value))
        return TurbineReadings(turbine, tuple(readings), counts)

    def stamp(self, content: bytes | str | Payload) -> float | None:
        """The time [s] stated by a payload; None if it has no readable time."""
        try:
            return seconds(_value_at(parse_payload(content), self.time, ""))
        except Refused:
            return None

    def _turbine(self, payload: Payload, topic: str) -> str:
        name = _value_at(payload, self.turbine, topic) if self.turbine else None
        if name is None and self.weather:
            return EVERYONE
        if not self.turbine and len(set(self.turbines.values())) == 1:
            return next(iter(self.turbines.values()))
        turbine = self.turbines.get(str(name)[:LONGEST]) if name is not None else None
        if turbine is None:
            raise Refused("unknown turbine", f"turbine {_quoted(name)} is not tracked")
        return turbine

    def _values(self, payload: Payload, topic: str, counts: Counter[str]) -> list[tuple[str, Json]]:
        """(field, value) of every field, or of the only one that a payload with a tag holds."""
        if not self.tag:
            return [(name, _value_at(payload, name, topic)) for name in self.conversions]
        tag = str(_value_at(payload, self.tag, topic))
        if tag in self.conversions:
            return [(tag, _value_at(payload, self.value, topic))]
        counts["unknown tag"] += 1
        return []


def parse_payload(text: bytes | str | Payload) -> Payload:
    """A payload that may still be text: a JSON object of limited size and depth.  Raises Refused."""
    if isinstance(text, Mapping):
        return text
    if len(text) > LARGEST:
        raise Refused("too large", f"a payload of {len(text)} bytes; at most {LARGEST} are read")
    if isinstance(text, str):
        text = text.encode("utf-8", "replace")
    if _depth(text) > DEEPEST:
        raise Refused("too deep", f"a payload nested deeper than {DEEPEST} levels")
    try:
        found = _DECODER.decode(text.decode(json.detect_encoding(text)))
    except (ValueError, RecursionError) as fault:
        raise Refused("malformed", f"no JSON: {str(fault)[:80]}") from None
    if not isinstance(found, dict):
        raise Refused("malformed", f"expected a JSON object, found {type(found).__name__}")
    return found


def _object(pairs: list[tuple[str, Json]]) -> JsonObject:
    """A JSON object with unique keys; a repeated key is an error, because its value is ambiguous."""
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key occurs twice")
    return found


_DECODER = json.JSONDecoder(object_pairs_hook=_object)


def _depth(text: bytes) -> int:
    """Largest number of simultaneously open brackets; brackets within strings count too, which is
    harmless."""
    deepest = level = 0
    if text.count(b"{") + text.count(b"[") <= DEEPEST:
        return 0  # most payloads are flat
    for byte in text:
        if byte in b"{[":
            level += 1
            deepest = max(deepest, level)
            if deepest > DEEPEST:
                break
        elif byte in b"}]":
            level -= 1
    return deepest


def _value_at(content: Payload, path: str, topic: str) -> Json:
    """The value at a path of names or at a level of the topic; None if there is none."""
    if path.startswith("{") and path.endswith("}"):
        levels = topic.split("/")
        place = int(path[1:-1])
        return levels[place] if 0 <= place < len(levels) else None
    if path in content or "." not in path:
        return content.get(path)
    value: Json = content
    for name in path.split("."):
        if not isinstance(value, Mapping) or name not in value:
            return None
        value = value[name]
    return value


def _number(raw: Json) -> float | None:
    """A finite number, which may be written as text; None for anything else, including booleans."""
    if isinstance(raw, bool) or not isinstance(raw, int | float | str):
        return None
    if isinstance(raw, str) and len(raw) > LONGEST:
        return None
    try:
        number = float(raw)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def seconds(stamp: Json) -> float | None:
    """Seconds since 1970 of a stamp in ISO 8601 with an offset, in seconds or in milliseconds; None for
    anything else."""
    if isinstance(stamp, str) and len(stamp) <= LONGEST and _number(stamp) is None:
        try:
            at = datetime.fromisoformat(stamp.strip())
            return at.astimezone(UTC).timestamp() if at.tzinfo is not None else None
        except (ValueError, OverflowError):
            return None
    number = _number(stamp)
    if number is None:
        return None
    return number / 1e3 if number > 1e11 else number


def _quoted(value: Json) -> str:
    """An external value for a message: shortened and quoted."""
    return repr(str(value)[:40])


# -- statistics ----------------------------------------------------------------------------------------------
class PayloadStatistics:
    """Counts payloads that are read by a mapping.

    `payloads`: number received; `used`: number that gave readings; `newest`: (turbine, signal) -> time [s] of
    the newest reading; `counts`: rejected items by kind, with one example of each in `reasons`; `lag_s`:
    smallest delay [s] from stamp to arrival, negative if the stamp is ahead, NaN without payloads.
    """

    def __init__(self, mapping: PayloadMapping) -> None:
        self.mapping = mapping
        self.payloads = self.used = 0
        self.newest: dict[tuple[str, str], float] = {}
        self.counts: Counter[str] = Counter()
        self.reasons: dict[str, str] = {}
        self.lag_s = math.nan

    def take(self, content: bytes | str | Payload, received: float, topic: str = "") -> None:
        """Count a payload received at a time [s]."""
        self.payloads += 1
        try:
            found = self.mapping.read(content, received, topic)
        except Refused as fault:
            self.counts[fault.kind] += 1
            self.reasons.setdefault(fault.kind, str(fault))
            stamp = self.mapping.stamp(content) if fault.kind == "impossible time" else None
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
    def rejected(self) -> str:
        """Text about the rejected items; empty if there are none."""
        said = (f"{n} {kind}" + self._example(kind) for kind, n in self.counts.most_common())
        return ", ".join(said)

    def _example(self, kind: str) -> str:
        return f" ({self.reasons[kind]})" if kind in self.reasons else ""
