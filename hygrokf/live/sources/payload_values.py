"""Reads the values of payloads: numbers, numbers with a unit, flags and times; refuses ambiguous ones.  Finds
values in a record by paths, levels of the topic, and patterns of tags:

    a.b          field b of the object a; also a field named "a.b"
    {1}          second level of the topic; {-1}: last level
    {name}       name of the value: its field, or the key of its object
    {name}_q     field of the same object whose name is the value's name followed by _q
    {received}   time of arrival (times only)
    a | b        first of these paths that is present in the record
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
CACHED_TAGS = 65_536
"""Largest number of tags whose meaning is cached."""
LONGEST_TEXT = 200
"""Longest name, number or time that is read [characters]."""
_LEVEL = re.compile(r"\{(-?[0-9]{1,3})\}")
_BRACES = re.compile(r"\{[^{}]*\}?|\}")
Reader = Callable[[PayloadRecord], Json]
"""Returns the value at a path of a record, None if the record has no such path."""


def value_at(scopes: Scopes, path: str) -> Json:
    """The value at a path, taken from the innermost object that has the path; None if no object has it."""
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
    """The alternative paths of a text; the first path that is present in a record counts."""
    return [path.strip() for path in text.split("|")]


def has_any_path(scopes: Scopes, text: str) -> bool:
    """Whether a record contains one of the alternative paths of a text, even with the value null."""
    return any(
        path in scope or path.partition(".")[0] in scope for path in alternatives(text) for scope in scopes
    )


def reader(text: str) -> Reader:
    """The reader of the alternative paths of a text; it returns the first value that is not None."""
    readers = [_path_reader(path) for path in alternatives(text) if path and path != RECEIVED]
    if len(readers) == 1:
        return readers[0]

    def first_value(record: PayloadRecord) -> Json:
        return next((value for value in (read(record) for read in readers) if value is not None), None)

    return first_value


def _path_reader(path: str) -> Reader:
    level = _LEVEL.fullmatch(path)
    if level is not None:
        index = int(level[1])

        def topic_level(record: PayloadRecord) -> Json:
            levels = record.topic.split("/")
            return levels[index] if -len(levels) <= index < len(levels) else None

        return topic_level
    if path == NAME:
        return lambda record: record.name
    if NAME in path:
        return lambda record: value_at(record.scopes, path.replace(NAME, record.name))
    return lambda record: value_at(record.scopes, path)


def path_fault(text: str, *extra_placeholders: str) -> str | None:
    """An error message for an invalid path, else None.

    `extra_placeholders`: placeholders that are allowed besides `{name}` and the levels of the topic.
    """
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
    """The turbine and the field that a tag names, as payloads spell them.

    `turbine` is None if the pattern has no turbine; `is_known`: whether turbine and field are both known
    names; otherwise at least one of them is a guess.
    """

    turbine: str | None
    field: str
    is_known: bool


def pattern_fault(text: str) -> str | None:
    """An error message for an invalid pattern of tags, else None."""
    braces = _BRACES.findall(text)
    if any(brace not in (TURBINE, FIELD) for brace in braces) or braces.count(FIELD) != 1:
        return f'expected a pattern with {FIELD}, such as "{TURBINE}.{FIELD}" or "*.{TURBINE}_{FIELD}"'
    if braces.count(TURBINE) > 1 or text.count(ANY) > 1:
        return f"expected {TURBINE} and {ANY} at most once, found {text!r}"
    return None


def tag_reader(
    pattern: str, turbines: Collection[str], fields: Collection[str]
) -> Callable[[str], Tag | None]:
    """The reader of tags of a pattern; it returns None for a tag that does not match the pattern.

    Known turbines and fields are preferred, so that a tag is split correctly even if their names contain the
    pattern's text between turbine and field.
    """
    turbine, field, any_text = _any_of(turbines), _any_of(fields), ".+?"
    # if only one part is known, that part tells best why the tag is not known
    parts = ((turbine, field), (turbine, any_text), (any_text, field), (any_text, any_text))
    expressions = [_expression(pattern, *pair) for pair in parts]

    @lru_cache(maxsize=CACHED_TAGS)
    def read(tag: str) -> Tag | None:
        matches = (expression.fullmatch(tag) for expression in expressions if len(tag) <= LONGEST_TEXT)
        rank, match = next(((k, match) for k, match in enumerate(matches) if match is not None), (-1, None))
        if match is None:
            return None
        groups = match.groupdict()
        return Tag(groups.get("turbine"), groups["field"], is_known=rank == 0)

    return read


def _any_of(names: Collection[str]) -> str:
    """A regular expression that matches any of the names, the longest first; without names it fails."""
    return "|".join(re.escape(name) for name in sorted(names, key=len, reverse=True)) or "(?!)"


def _expression(pattern: str, turbine: str, field: str) -> re.Pattern[str]:
    """A pattern of tags as a regular expression, with the expressions for its turbine and its field."""
    groups = {TURBINE: f"(?P<turbine>{turbine})", FIELD: f"(?P<field>{field})", ANY: ".*?"}
    pieces = re.split(r"(\{turbine\}|\{field\}|\*)", pattern)
    return re.compile("".join(groups.get(piece, re.escape(piece)) for piece in pieces), re.DOTALL)


STAMP_AHEAD_S = 900.0
"""Largest time [s] by which a stamp may be ahead of this machine's clock."""
NEXT_STAMP_STEPS = 1.5
"""A stamp continues its series if it follows the newest one within so many steps of the series."""
UNIX_UNITS = ((1e11, 1.0), (1e14, 1e3), (1e17, 1e6), (math.inf, 1e9))
"""(upper limit of the number, units per second) of Unix times in s, ms, µs and ns.

For times from 1990 to 5138 the numbers in these four units do not overlap.
"""


# -- numbers -------------------------------------------------------------------------------------------------
def number(raw: Json, marks: Marks = POINT) -> float | None:
    """A finite number; a text is read with the decimal and thousands `marks`.  None for anything else, even
    a boolean."""
    if isinstance(raw, float):
        return raw if math.isfinite(raw) else None
    if isinstance(raw, str):
        return number_in(raw, marks) if len(raw) <= LONGEST_TEXT else None
    if isinstance(raw, bool) or not isinstance(raw, int):
        return None
    try:
        return float(raw)
    except OverflowError:
        return None


def quantity_or_flag(raw: Json, meaning: Meaning, marks: Marks = POINT) -> float:
    """The value of a number with its unit, or of a flag, which `number` does not read.  Raises Unread."""
    text = raw if isinstance(raw, str) else str(raw) if isinstance(raw, bool) else ""
    if not text or len(text) > LONGEST_TEXT:
        raise Unread("no number", f"{quoted(raw)} is no number")
    return value_in(text, marks, meaning)


# -- times ---------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Clock:
    """How times are written.

    `zone`: time zone of stamps without an offset (None: every stamp needs an offset); `form`: strptime format
    of stamps that are not in ISO 8601, "" for ISO 8601.
    """

    zone: tzinfo | None = None
    form: str = ""

    @property
    def expected(self) -> str:
        """The expected notation of a stamp, for messages."""
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
    """Seconds since 1970 of a stamp; None if the stamp is not a time.

    A stamp is written in ISO 8601, in the clock's own form, or as a Unix time in s, ms, µs or ns.  In the
    hour that occurs twice at the end of summer time, the `order` of its `series` and the time of arrival
    `received` [s] decide which of the two a stamp means.  Raises Refused for a local time that does not
    exist, or that remains ambiguous.
    """
    if not clock.form and not (isinstance(stamp, str) and ":" in stamp):
        unix = number(stamp)
        if unix is not None:
            return unix if unix < 1e11 else unix / next(units for limit, units in UNIX_UNITS if unix < limit)
    elif clock.form and isinstance(stamp, int) and not isinstance(stamp, bool):
        stamp = str(stamp)  # such as 20260301121000
    days = number(stamp) if clock.form == EXCEL else None
    if days is not None and 0.0 < days < 1e5:
        time = datetime(1899, 12, 30) + timedelta(seconds=round(days * DAY_S))
        return None if clock.zone is None else _local_seconds(time, clock.zone, received, order, series)
    if clock.form == EXCEL or not isinstance(stamp, str) or len(stamp) > LONGEST_TEXT:
        return None
    try:
        time = _parsed_time(stamp.strip(), clock.form)
        if time.tzinfo is not None:
            return time.astimezone(UTC).timestamp()
        return None if clock.zone is None else _local_seconds(time, clock.zone, received, order, series)
    except (ValueError, OverflowError):
        return None


def _parsed_time(text: str, form: str) -> datetime:
    """The time that a text states; 24:00 is 00:00 of the next day.  Raises ValueError."""
    try:
        return datetime.strptime(text, form) if form else datetime.fromisoformat(text)
    except ValueError:
        midnight = midnight_of(text, form)
        if midnight is None:
            raise
        return _parsed_time(midnight, form) + timedelta(days=1)


def _local_seconds(
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
    if first < second <= received + STAMP_AHEAD_S:  # else the second occurrence is still to come
        # the stamp repeats the newest stamp of its series, or follows it by one step
        within_s = NEXT_STAMP_STEPS * step
        continuing = [time for time in (first, second) if time == newest or 0.0 < time - newest <= within_s]
        if len(continuing) != 1:
            raise Refused(
                "ambiguous time",
                f"{local} comes twice in {zone}, and the order of its source does not tell which: stamps "
                "with an offset would",
            )
        first = continuing[0]
    if order is not None and not first <= newest:
        order[series] = first, first - newest
    return first


def quoted(value: Json) -> str:
    """A value from outside for a message, shortened to 40 characters and quoted."""
    return repr(str(value)[:40])
