"""Splits payloads into records: JSON, a plain value or line protocol, compressed or not, up to limited sizes.

A record is an object that holds values, together with the objects around it, where a time or a turbine is
looked up that the object itself does not state.
"""

from __future__ import annotations

import json
import math
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from hygrokf.data.numbers import Unread
from hygrokf.data.structured import Json, JsonObject

Payload = Mapping[str, Json]
"""A parsed object: names with plain values."""
Scopes = tuple[Payload, ...]
"""The object of a record, and the objects around it from the innermost to the outermost."""
LARGEST_PAYLOAD = 65_536
"""Largest payload [bytes]."""
UNPACKED = 4 * LARGEST_PAYLOAD
"""Largest gzip payload after unpacking [bytes]."""
DEEPEST_NESTING = 6
"""Largest nesting depth of a payload."""
JSON, PLAIN, INFLUX = "json", "plain", "influx"
PAYLOAD_FORMATS = (JSON, PLAIN, INFLUX)
EACH = "*"
"""Step of the path to the records that stands for every member of an object."""
PLAIN_NAME = "value"
"""Name of the value of a plain payload."""
_GZIP = b"\x1f\x8b"
_NO_BRACKETS = bytes(set(range(256)) - set(b"{}[]"))


class Refused(Unread):
    """Raised for a payload or record that cannot be used; it is counted by its kind."""


Order = dict[tuple[str, ...], tuple[float, float]]
"""Order in which local stamps arrive: series (a turbine, or one of its tags) -> (newest stamp, step from
its predecessor) [s].  After a restart the order is unknown until stamps are unambiguous again."""


@dataclass(frozen=True)
class Unreadable:
    """Content that a source could not read as a payload, such as a damaged row; it is always refused, by the
    `kind` and with the `reason`."""

    kind: str
    reason: str


Content = bytes | str | Payload | Unreadable
"""Content of a delivery: text, cells by column name, or a row that cannot be read."""


class PayloadRecord(NamedTuple):
    """A record of a payload; `scopes` is empty if the record is not an object.

    `name`: key of the record in the object around it, or name of the value that is read; `topic`: topic of
    its arrival; `received`: time of its arrival [s]; `order`: order of its source's local stamps.
    """

    scopes: Scopes
    name: str = ""
    topic: str = ""
    received: float = math.inf
    order: Order | None = None


def records(
    content: Content, form: str, steps: Sequence[str], topic: str = "", received: float = math.inf
) -> Iterable[PayloadRecord]:
    """Return the records of a payload: itself, the objects of its array, or the objects at the path `steps`.

    form: format of content that is text, one of `PAYLOAD_FORMATS`. Raises Refused for a payload without the
    path.
    """
    parsed: Json = content if isinstance(content, Mapping) else parsed_text(content, form)
    if isinstance(parsed, Mapping):
        if not steps:
            return (PayloadRecord((parsed,), "", topic, received),)
    elif not isinstance(parsed, list):
        raise Refused(
            "malformed", f"expected a JSON object or an array of objects, found {type(parsed).__name__}"
        )
    return (PayloadRecord(scopes, name, topic, received) for scopes, name in _walk(parsed, steps, 0, (), ""))


def _walk(
    content: Json, steps: Sequence[str], index: int, around: Scopes, name: str
) -> Iterator[tuple[Scopes, str]]:
    """Yield the scopes and the name of each record below `content`, along the path from step `index` on.

    around: the objects around `content`, from the innermost to the outermost.  name: key of `content`.
    """
    if isinstance(content, list):  # an array stands for each of its elements
        for element in content:
            yield from _walk(element, steps, index, around, name)
    elif not isinstance(content, Mapping):
        yield (), name
    elif index == len(steps):
        yield (content, *around), name
    elif steps[index] == EACH:
        for key, member in content.items():
            if isinstance(member, Mapping | list):
                yield from _walk(member, steps, index + 1, (content, *around), key)
    elif steps[index] in content:
        yield from _walk(content[steps[index]], steps, index + 1, (content, *around), name)
    else:
        raise Refused(
            "no records", f"the payload has no {steps[index]!r} on the path records = {'.'.join(steps)!r}"
        )


def parsed_text(content: bytes | str | Unreadable, form: str) -> Json:
    """Parse the text of a payload, which may be compressed by gzip.  Raises Refused."""
    if isinstance(content, Unreadable):
        raise Refused(content.kind, content.reason)
    if len(content) > LARGEST_PAYLOAD:
        raise Refused("too large", f"a payload of {len(content)} bytes; at most {LARGEST_PAYLOAD} are read")
    text = content.encode("utf-8", "replace") if isinstance(content, str) else content
    if text.startswith(_GZIP):
        text = _unpacked(text)
    if form == JSON:
        return _json(text)
    try:
        plain = text.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise Refused("malformed", "expected text in UTF-8") from None
    return {PLAIN_NAME: plain.strip().strip('"')} if form == PLAIN else _lines(plain)


def _unpacked(packed: bytes) -> bytes:
    """Unpack gzip.  Raises Refused for damaged data or more than `UNPACKED` bytes."""
    unpacking = zlib.decompressobj(zlib.MAX_WBITS | 16)
    try:
        unpacked = unpacking.decompress(packed, UNPACKED + 1)
    except zlib.error as fault:
        raise Refused("malformed", f"gzip that cannot be unpacked: {fault}") from None
    if len(unpacked) > UNPACKED:
        raise Refused("too large", f"a payload of more than {UNPACKED} bytes after unpacking")
    if not unpacking.eof:
        raise Refused("malformed", "gzip that ends too early")
    return unpacked


# -- JSON ----------------------------------------------------------------------------------------------------
def _json(text: bytes) -> Json:
    """Parse JSON up to the depth `DEEPEST_NESTING`.  Raises Refused."""
    if _depth(text) > DEEPEST_NESTING:
        raise Refused("too deep", f"a payload nested deeper than {DEEPEST_NESTING} levels")
    try:
        return decoded(text)
    except (ValueError, RecursionError) as fault:
        raise Refused("malformed", f"not valid JSON: {str(fault)[:80]}") from None


_NOT_FINITE = re.compile(
    r'"(?:[^"\\]|\\.)*+(?:"|\\?\Z)|(?P<number>[+-]?(?:nan|inf(?:inity)?|\d\.#\w+)\b(?:\(\w*\))?)',
    re.IGNORECASE | re.DOTALL,
)
"""A string in JSON (to the end if its quote is missing), or a number that is not finite, as 1.#QNAN."""


def decoded(text: bytes) -> Json:
    """Parse a JSON text; an unquoted nan or inf of any spelling becomes NaN, which no field accepts.

    Raises ValueError and RecursionError.
    """
    plain = text.decode(json.detect_encoding(text))
    try:
        parsed: Json = _DECODER.decode(plain)
    except ValueError as fault:
        corrected = _NOT_FINITE.sub(lambda match: "NaN" if match["number"] else match[0], plain)
        if corrected == plain:
            raise fault
        parsed = _DECODER.decode(corrected)
    return parsed


def _object(pairs: list[tuple[str, Json]]) -> JsonObject:
    """Return the JSON object of (key, value) pairs.  Raises ValueError for a repeated, thus ambiguous key."""
    members = dict(pairs)
    if len(members) < len(pairs):
        raise ValueError("a key occurs twice")
    return members


_DECODER = json.JSONDecoder(object_pairs_hook=_object)


def _depth(text: bytes) -> int:
    """Return the largest depth of brackets; those within strings count, too, which is harmless."""
    if text.count(b"{") + text.count(b"[") <= DEEPEST_NESTING:
        return 0  # most payloads are flat
    deepest = level = 0
    for byte in text.translate(None, _NO_BRACKETS):
        if byte in b"{[":
            level += 1
            deepest = max(deepest, level)
            if deepest > DEEPEST_NESTING:
                break
        else:
            level -= 1
    return deepest


# -- InfluxDB's line protocol --------------------------------------------------------------------------------
_LINE = re.compile(
    r"""(?P<head>(?:\\.|[^ \\])++)[ ]+
        (?P<fields>(?:\\.|"(?:\\.|[^"\\])*+"|[^ "\\])++)
        (?:[ ]+(?P<time>-?[0-9]{1,20}))?\s*""",
    re.VERBOSE,
)
_FIELD = re.compile(r'((?:\\.|[^,= "\\])++)=("(?:\\.|[^"\\])*+"|(?:\\.|[^, "\\])++)(?:,|$)')
_TAG = re.compile(r"((?:\\.|[^,= \\])++)=((?:\\.|[^,= \\])++)")
_ESCAPED = re.compile(r'\\([,= "\\])')
_INTEGER = re.compile(r"[+-]?[0-9]{1,20}[iu]")
_FLAGS = {"t": True, "T": True, "f": False, "F": False}


def _lines(text: str) -> list[Json]:
    """Parse line protocol: one object per line with its tags, its fields, `measurement` and, if stated,
    `time`; None for an invalid line."""
    lines = (line.strip() for line in text.splitlines())
    return [_line(line) for line in lines if line and not line.startswith("#")]


def _line(line: str) -> JsonObject | None:
    """Parse one line of line protocol; None if it is invalid."""
    match = _LINE.fullmatch(line)
    if match is None:
        return None
    measurement, *tags = re.split(r"(?<!\\),", match["head"])
    members: JsonObject = {"measurement": _unescaped(measurement)}
    if match["time"] is not None:
        members["time"] = int(match["time"])
    for text in tags:
        tag = _TAG.fullmatch(text)
        if tag is None:
            return None
        members[_unescaped(tag[1])] = _unescaped(tag[2])
    position, fields = 0, match["fields"]
    while position < len(fields):
        field = _FIELD.match(fields, position)
        if field is None:
            return None
        members[_unescaped(field[1])] = _field_value(field[2])
        position = field.end()
    return members


def _field_value(text: str) -> Json:
    """Return the value of a field in line protocol: text, whole number, flag, or text of a number."""
    if text.startswith('"'):
        return _unescaped(text[1:-1])
    if _INTEGER.fullmatch(text):
        return int(text[:-1])
    return _FLAGS.get(text, text)


def _unescaped(text: str) -> str:
    """Remove the backslashes before escaped characters of line protocol."""
    return _ESCAPED.sub(r"\1", text)
