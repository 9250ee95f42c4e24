"""Values of payloads: numbers, numbers with a unit, flags and times, of which the ambiguous are refused; and
where in a record they stand: paths, levels of the topic, and patterns of tags.

    a.b          field b of the object a; also a field named "a.b"
    {1}          second level of the topic; {-1}: the last one
    {name}       name of the value: its field, or the key of its object
    {name}_q     the field beside the value that has its name followed by _q
    {received}   time of arrival (times only)
    a | b        the first of these that is there
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, tzinfo
from functools import lru_cache
from typing import NamedTuple

from hygrokf.data.numbers import POINT, Marks, Meaning, Unread, number_in, value_in
from hygrokf.data.structured import Json
from hygrokf.data.timestamps import DAY_S, EXCEL, midnight_of
from hygrokf.live.sources.payload_formats import Order, PayloadRecord, Refused, Scopes

NAME, RECEIVED = "{name}", "{received}"
TURBINE, FIELD, ANY = "{turbine}", "{field}", "*"
KNOWN_TAGS = 65_536
"""Tags whose meaning is remembered."""
LONGEST = 200
"""Longest name or time [characters]."""
_LEVEL = re.compile(r"\{(-?[0-9]{1,3})\}")
_BRACES = re.compile(r"\{[^{}]*\}?|\}")
Reader = Callable[[PayloadRecord], Json]
"""Gives the value at a path of a record, None if there is none."""


def at(scopes: Scopes, path: str) -> Json:
    """The value at a path, of the innermost object that has it; None if there is none."""
    for scope in scopes:
        if path in scope:
            return scope[path]
    if "." in path:
        first, *names = path.split(".")
        for scope in scopes:
            if first in scope:
                value = scope[first]
                for name in names:
                    if not isinstance(value, Mapping) or name not in value:
                        break
                    value = value[name]
                else:
                    return value
    return None


def alternatives(text: str) -> list[str]:
    """The alternative paths of a text, of which the first that is present counts."""
    return [path.strip() for path in text.split("|")]


def has(scopes: Scopes, text: str) -> bool:
    """Whether one of the paths stands in a record, even with null."""
    return any(
        one in scope or one.partition(".")[0] in scope for one in alternatives(text) for scope in scopes
    )


def reader(text: str) -> Reader:
    """The reader of a path."""
    readers = [_reader(one) for one in alternatives(text) if one and one != RECEIVED]
    if len(readers) == 1:
        return readers[0]

    def first(record: PayloadRecord) -> Json:
        return next((value for value in (one(record) for one in readers) if value is not None), None)

    return first


def _reader(path: str) -> Reader:
    level = _LEVEL.fullmatch(path)
    if level is not None:
        place = int(level[1])

        def of_topic(record: PayloadRecord) -> Json:
            levels = record.topic.split("/")
            return levels[place] if -len(levels) <= place < len(levels) else None

        return of_topic
    if path == NAME:
        return lambda record: record.name
    if NAME in path:
        return lambda record: at(record.scopes, path.replace(NAME, record.name))
    return lambda record: at(record.scopes, path)


def path_fault(text: str, *extra_placeholders: str) -> str | None:
    """An error message for an invalid path, else None; `extra_placeholders` are allowed besides the usual."""
    for path in alternatives(text):
        if text and not path:
            return f"expected a path on both sides of |, found {text!r}"
        if _LEVEL.fullmatch(path) or path in extra_placeholders:
            continue
        invalid = [brace for brace in _BRACES.findall(path) if brace != NAME]
        if invalid:
            allowed = ", ".join(("{1} (a level of the topic, alone)", NAME, *extra_placeholders))
            return f"expected a field, or one of {allowed}; found {invalid[0]!r} in {text!r}"
    return None


# -- tags ----------------------------------------------------------------------------------------------------
class Tag(NamedTuple):
    """What a tag says: turbine (None if the pattern has none) and field, as they stand in payloads.

    `known`: whether both are; else these are guesses.
    """

    turbine: str | None
    field: str
    known: bool


def pattern_fault(text: str) -> str | None:
    """An error message for an invalid pattern of tags, else None."""
    braces = _BRACES.findall(text)
    if any(one not in (TURBINE, FIELD) for one in braces) or braces.count(FIELD) != 1:
        return f'expected a pattern with {FIELD}, such as "{TURBINE}.{FIELD}" or "*.{TURBINE}_{FIELD}"'
    if braces.count(TURBINE) > 1 or text.count(ANY) > 1:
        return f"expected {TURBINE} and {ANY} at most once, found {text!r}"
    return None


def tag_reader(
    pattern: str, turbines: Collection[str], fields: Collection[str]
) -> Callable[[str], Tag | None]:
    """The reader of tags of a pattern; it gives None for a tag that is not of its form.

    A tag is read so that turbine and field are known ones, even if their names contain the text between
    them.
    """
    turbine, field, some = _any_of(turbines), _any_of(fields), ".+?"
    # guesses with one known part tell best why a tag is not known
    kinds = ((turbine, field), (turbine, some), (some, field), (some, some))
    readings = [_pattern(pattern, *one) for one in kinds]

    @lru_cache(maxsize=KNOWN_TAGS)
    def read(tag: str) -> Tag | None:
        found = (one.fullmatch(tag) for one in readings if len(tag) <= LONGEST)
        number, match = next(((k, one) for k, one in enumerate(found) if one is not None), (-1, None))
        if match is None:
            return None
        parts = match.groupdict()
        return Tag(parts.get("turbine"), parts["field"], number == 0)

    return read


def _any_of(names: Collection[str]) -> str:
    return "|".join(re.escape(one) for one in sorted(names, key=len, reverse=True)) or "(?!)"


def _pattern(text: str, turbine: str, field: str) -> re.Pattern[str]:
    pieces = {TURBINE: f"(?P<turbine>{turbine})", FIELD: f"(?P<field>{field})", ANY: ".*?"}
    split = re.split(r"(\{turbine\}|\{field\}|\*)", text)
    return re.compile("".join(pieces.get(one, re.escape(one)) for one in split), re.DOTALL)


AHEAD_S = 900.0
"""[s] a stamp may be ahead of this machine's clock."""
NEXT = 1.5
"""Steps of a series within which a stamp is its next one."""
UNIX_UNITS = ((1e11, 1.0), (1e14, 1e3), (1e17, 1e6), (math.inf, 1e9))
"""(below this number, units per second) of Unix times in s, ms, µs and ns.

From 1990 to 5138 the sizes of the four do not overlap.
"""


# -- numbers -------------------------------------------------------------------------------------------------
def number(raw: Json, marks: Marks = POINT) -> float | None:
    """A finite number, which may be written as text with these marks; None for anything else, including
    booleans."""
    if isinstance(raw, float):
        return raw if math.isfinite(raw) else None
    if isinstance(raw, str):
        return number_in(raw, marks) if len(raw) <= LONGEST else None
    if isinstance(raw, bool) or not isinstance(raw, int):
        return None
    try:
        return float(raw)
    except OverflowError:
        return None


def measured(raw: Json, meaning: Meaning, marks: Marks = POINT) -> float:
    """A number that `number` does not read: one with its unit, or a flag.  Raises Unread."""
    word = raw if isinstance(raw, str) else str(raw) if isinstance(raw, bool) else ""
    if not word or len(word) > LONGEST:
        raise Unread("no number", f"{quoted(raw)} is no number")
    return value_in(word, marks, meaning)


# -- times ---------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Clock:
    """How times are written: the `zone` of stamps without an offset (None: each must have one), and the
    strptime `form` of stamps that are not ISO 8601."""

    zone: tzinfo | None = None
    form: str = ""

    @property
    def words(self) -> str:
        """What is expected of a stamp, for messages."""
        if self.form:
            return repr(self.form)
        offset = "" if self.zone is not None else " with offset"
        return f"ISO 8601{offset} or as a Unix time in s, ms, µs or ns"


STATED_OFFSETS = Clock()
"""ISO 8601 with an offset, or Unix times."""


def seconds(
    stamp: Json,
    clock: Clock = STATED_OFFSETS,
    received: float = math.inf,
    order: Order | None = None,
    series: tuple[str, ...] = (),
) -> float | None:
    """Seconds since 1970 of a stamp; None if it is none.

    ISO 8601, the clock's own form, or a Unix time in s, ms, µs or ns.  In the hour that comes twice at the
    end of summer time a stamp is placed by the `order` of its `series`; none lies ahead of `received` [s].
    Raises Refused for a local time that does not exist, or that these do not tell apart.
    """
    if not clock.form and not (isinstance(stamp, str) and ":" in stamp):
        unix = number(stamp)
        if unix is not None:
            return unix if unix < 1e11 else unix / next(units for most, units in UNIX_UNITS if unix < most)
    elif clock.form and isinstance(stamp, int) and not isinstance(stamp, bool):
        stamp = str(stamp)  # such as 20260301121000
    days = number(stamp) if clock.form == EXCEL else None
    if days is not None and 0.0 < days < 1e5:
        at = datetime(1899, 12, 30) + timedelta(seconds=round(days * DAY_S))
        return None if clock.zone is None else _of_local(at, clock.zone, received, order, series)
    if clock.form == EXCEL or not isinstance(stamp, str) or len(stamp) > LONGEST:
        return None
    try:
        at = _read(stamp.strip(), clock.form)
        if at.tzinfo is not None:
            return at.astimezone(UTC).timestamp()
        return None if clock.zone is None else _of_local(at, clock.zone, received, order, series)
    except (ValueError, OverflowError):
        return None


def _read(text: str, form: str) -> datetime:
    """The time of a text; 24:00 is the next day's 00:00.  Raises ValueError."""
    try:
        return datetime.strptime(text, form) if form else datetime.fromisoformat(text)
    except ValueError:
        midnight = midnight_of(text, form)
        if midnight is None:
            raise
        return _read(midnight, form) + timedelta(days=1)


def _of_local(
    local: datetime, zone: tzinfo, received: float, order: Order | None, series: tuple[str, ...]
) -> float:
    """Seconds since 1970 of a local time in a zone.  Raises Refused."""
    first, second = (local.replace(tzinfo=zone, fold=fold).timestamp() for fold in (0, 1))
    if first > second:
        raise Refused(
            "no time",
            f"{local} does not exist in {zone}: summer time begins; if the clock does not follow it, "
            'state its fixed offset, such as timezone = "+01:00"',
        )
    newest, step = (order or {}).get(series, (math.nan, math.nan))
    if first < second <= received + AHEAD_S:  # else the second is still to come
        # the stamp repeats the newest of its series, or is the next one
        continued = [one for one in (first, second) if one == newest or 0.0 < one - newest <= NEXT * step]
        if len(continued) != 1:
            raise Refused(
                "ambiguous time",
                f"{local} comes twice in {zone}, and the order of its source does not tell which: stamps "
                "with an offset would",
            )
        first = continued[0]
    if order is not None and not first <= newest:
        order[series] = first, first - newest
    return first


def quoted(value: Json) -> str:
    """An external value for a message: shortened and quoted."""
    return repr(str(value)[:40])
