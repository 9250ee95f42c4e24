"""From what a source delivers to readings: names, units, times, quality; what cannot be true is counted, never guessed.

A payload is one JSON object or a row of a table.  A `Mapping` says where turbine, time and values stand in it:

    {"turbine": "T07", "time": "2026-03-01T12:10:00Z", "quality": "good", "Tcab": 31.2, "RHcab": 41.0}

or, with `tag` and `value` stated, one reading a payload: {"turbine": "T07", "time": …, "tag": "Tcab", "value": 31.2}.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Collection
from collections.abc import Mapping as MappingOf
from dataclasses import dataclass, field
from datetime import UTC, datetime

from hygrokf.data.signals import signal_named, to_si
from hygrokf.live.plan import Form
from hygrokf.live.tracker import Reading

LARGEST = 65_536
"""[bytes] of one payload."""
DEEPEST = 6
"""Levels of one payload."""
LONGEST = 200
"""Characters of a name or a time."""
EARLIEST_S = 631_152_000.0
"""[s] 1990: stamps before it are no time of a turbine."""
AHEAD_S = 900.0
"""[s] by which a stamp may be ahead of the clock here."""
FORECAST_S = 20 * 86400.0
"""[s] by which that of a weather forecast may."""
EVERYONE = ""
"""Turbine of a weather forecast that is for all."""
GOOD = ("good", "ok", "valid", "true", "0", "192")
"""What marks a good reading where nothing else is stated; 192 is OPC's."""


class Refused(Exception):
    """A payload that is not used, with the name under which it is counted."""

    def __init__(self, kind: str, words: str) -> None:
        super().__init__(words)
        self.kind = kind


@dataclass(frozen=True)
class Field:
    """A value of the payload: the signal that it is, its unit, how it is averaged, and what its stamp marks."""

    signal: str
    unit: str
    form: Form = field(default_factory=Form)
    stamp: str = "instant"

    @property
    def scale(self) -> tuple[float, float]:
        """(factor, offset) to the SI unit."""
        zero, one = (float(to_si(v, self.unit, self.signal)) for v in (0.0, 1.0))
        return one - zero, zero

    @property
    def shift_s(self) -> float:
        """[s] from the stamp to the end of the interval."""
        return {"start": 1.0, "middle": 0.5}.get(self.stamp, 0.0) * self.form.interval_s


@dataclass(frozen=True)
class Mapping:
    """Where things stand in a payload.

    `fields` name → field; `turbine`, `time`, `quality`, `tag`, `value` names of fields ("a.b" goes one level down, and of a
    topic "{1}" is the second level); `good` marks of quality that count; `turbines` name in the payload → turbine.
    Without a name of the field (`turbine` "") all is the only turbine's.  `weather`: what comes is a weather forecast, which
    is for all turbines where it names none.
    """

    fields: MappingOf[str, Field]
    turbine: str = "turbine"
    time: str = "time"
    quality: str = ""
    tag: str = ""
    value: str = ""
    good: Collection[str] = GOOD
    turbines: MappingOf[str, str] = field(default_factory=dict)
    weather: bool = False

    def __post_init__(self) -> None:
        rows = {}
        for name, one in self.fields.items():
            factor, offset = one.scale
            row = signal_named(one.signal)
            slack = 1e-9 * (row.high - row.low)
            rows[name] = (one.signal, factor, offset, one.shift_s, row.low - slack, row.high + slack)
        object.__setattr__(self, "_rows", rows)


@dataclass(frozen=True)
class Taken:
    """Readings of one turbine, and what was set aside of the payload, by kind."""

    turbine: str
    readings: tuple[Reading, ...]
    counts: Counter


def parsed(text: bytes | str) -> dict:
    """A JSON object of bounded size and depth.  Raises Refused."""
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


def _object(pairs: list[tuple[str, object]]) -> dict:
    """An object of which every key stands there once: of two values nobody can say which one is meant."""
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key stands there twice")
    return found


_DECODER = json.JSONDecoder(object_pairs_hook=_object)


def _depth(text: bytes) -> int:
    """Largest number of brackets that are open at once; brackets within strings count, which does no harm."""
    deepest = level = 0
    if text.count(b"{") + text.count(b"[") <= DEEPEST:
        return 0  # the usual payload is flat
    for byte in text:
        if byte in b"{[":
            level += 1
            deepest = max(deepest, level)
            if deepest > DEEPEST:
                break
        elif byte in b"}]":
            level -= 1
    return deepest


def taken(content: MappingOf, mapping: Mapping, now: float, topic: str = "") -> Taken:
    """Readings of a payload.  Raises Refused where none of it can be used.

    `now` [s] the clock here: stamps ahead of it by more than `AHEAD_S` are refused.
    """
    turbine = _turbine(content, mapping, topic)
    stamp = _found(content, mapping.time, topic)
    time = seconds(stamp)
    if time is None:
        raise Refused(
            "no time",
            f"expected a time as ISO 8601 with offset or as seconds since 1970, found {_shown(stamp)}",
        )
    if not EARLIEST_S <= time <= now + (FORECAST_S if mapping.weather else AHEAD_S):
        raise Refused("impossible time", f"time {_shown(stamp)} is before 1990 or ahead of the clock here")
    counts: Counter = Counter()
    if mapping.quality:
        mark = _found(content, mapping.quality, topic)
        if mark is not None and str(mark).strip().lower() not in mapping.good:
            return Taken(turbine, (), Counter({"bad quality": 1}))
    rows = mapping._rows  # type: ignore[attr-defined]
    if mapping.tag:
        tag = _found(content, mapping.tag, topic)
        pairs = [(str(tag), _found(content, mapping.value, topic))] if str(tag) in rows else []
        if not pairs:
            counts["unknown tag"] += 1
    else:
        pairs = [(name, _found(content, name, topic)) for name in rows]
    readings = []
    for key, raw in pairs:
        if raw is None or raw == "":
            continue
        signal, factor, offset, shift, low, high = rows[key]
        number = _number(raw)
        if number is None:
            counts["no number"] += 1
            continue
        value = factor * number + offset
        if not low <= value <= high:
            counts["impossible value"] += 1
            continue
        readings.append(Reading(signal, time + shift, value))
    return Taken(turbine, tuple(readings), counts)


def _turbine(content: MappingOf, mapping: Mapping, topic: str) -> str:
    name = _found(content, mapping.turbine, topic) if mapping.turbine else None
    if name is None and mapping.weather:
        return EVERYONE
    if not mapping.turbine and len(set(mapping.turbines.values())) == 1:
        return next(iter(mapping.turbines.values()))
    turbine = mapping.turbines.get(str(name)[:LONGEST]) if name is not None else None
    if turbine is None:
        raise Refused("unknown turbine", f"turbine {_shown(name)} is not among those that are tracked")
    return turbine


def stamp_of(content: MappingOf | bytes | str, mapping: Mapping) -> float | None:
    """The time [s] that a payload states; None where it states none that can be read."""
    try:
        found = parsed(content) if isinstance(content, bytes | str) else content
    except Refused:
        return None
    return seconds(_found(found, mapping.time, ""))


def _found(content: MappingOf, path: str, topic: str) -> object:
    """The value at a path of names, or a level of the topic; None where there is none."""
    if path.startswith("{") and path.endswith("}"):
        levels = topic.split("/")
        place = int(path[1:-1])
        return levels[place] if 0 <= place < len(levels) else None
    if path in content or "." not in path:
        return content.get(path)
    value: object = content
    for name in path.split("."):
        if not isinstance(value, dict) or name not in value:
            return None
        value = value[name]
    return value


def _number(raw: object) -> float | None:
    """A finite number, also one that was written as text; None for all else, truth values included."""
    if isinstance(raw, bool) or not isinstance(raw, int | float | str):
        return None
    if isinstance(raw, str) and len(raw) > LONGEST:
        return None
    try:
        number = float(raw)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) else None


def seconds(stamp: object) -> float | None:
    """Seconds since 1970 of a stamp: ISO 8601 with an offset, seconds or milliseconds; None for all else."""
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


def _shown(value: object) -> str:
    """A value from outside in a message: short, in one line, and quoted."""
    return repr(str(value)[:40])
