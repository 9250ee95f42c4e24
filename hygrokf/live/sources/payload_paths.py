"""Where in a record something stands: paths, levels of the topic, and patterns of tags.

    a.b          field b of the object a; also a field named "a.b"
    {1}          second level of the topic; {-1}: the last one
    {name}       name of the value: its field, or the key of its object
    {name}_q     the field beside the value whose name ends so
    {received}   time of arrival (times only)
    a | b        the first of these that is there
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping
from functools import lru_cache
from typing import NamedTuple

from hygrokf.data.structured import Json
from hygrokf.live.sources.payload_formats import Record, Scopes

NAME, RECEIVED = "{name}", "{received}"
TURBINE, FIELD, ANY = "{turbine}", "{field}", "*"
KNOWN_TAGS = 65_536
"""Tags whose meaning is remembered."""
LONGEST = 200
"""Longest name or time [characters]."""
_LEVEL = re.compile(r"\{(-?[0-9]{1,3})\}")
_BRACES = re.compile(r"\{[^{}]*\}?|\}")
Reader = Callable[[Record], Json]
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
    """The paths of which the first that is there counts."""
    return [one.strip() for one in text.split("|")]


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

    def first(record: Record) -> Json:
        return next((value for value in (one(record) for one in readers) if value is not None), None)

    return first


def _reader(path: str) -> Reader:
    level = _LEVEL.fullmatch(path)
    if level is not None:
        place = int(level[1])

        def of_topic(record: Record) -> Json:
            levels = record.topic.split("/")
            return levels[place] if -len(levels) <= place < len(levels) else None

        return of_topic
    if path == NAME:
        return lambda record: record.name
    if NAME in path:
        return lambda record: at(record.scopes, path.replace(NAME, record.name))
    return lambda record: at(record.scopes, path)


def path_fault(text: str, *also: str) -> str | None:
    """An error message for an invalid path, else None; `also`: further placeholders that may stand here."""
    for one in alternatives(text):
        if text and not one:
            return f"expected a path on both sides of |, found {text!r}"
        if _LEVEL.fullmatch(one) or one in also:
            continue
        wrong = [brace for brace in _BRACES.findall(one) if brace != NAME]
        if wrong:
            known = ", ".join(("{1} (a level of the topic, alone)", NAME, *also))
            return f"expected a field, or one of {known}; found {wrong[0]!r} in {text!r}"
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
