"""Payloads as they arrive to records: JSON, a plain value or line protocol, packed or not, within limits.

A record is an object that holds values, and the objects around it: what a record does not say itself (a time,
a turbine) is looked up in those.
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
"""A record, and the objects around it from the inside out."""
LARGEST = 65_536
"""Largest payload [bytes]."""
UNPACKED = 4 * LARGEST
"""Largest gzip payload after unpacking [bytes]."""
DEEPEST = 6
"""Largest nesting depth of a payload."""
JSON, PLAIN, INFLUX = "json", "plain", "influx"
FORMATS = (JSON, PLAIN, INFLUX)
EACH = "*"
"""Step of a path that stands for every member of an object."""
PLAIN_NAME = "value"
"""Name of the value of a plain payload."""
_GZIP = b"\x1f\x8b"
_NO_BRACKETS = bytes(set(range(256)) - set(b"{}[]"))


class Refused(Unread):
    """A payload or record that is not used."""


Order = dict[tuple[str, ...], tuple[float, float]]
"""The order in which a source brings its local stamps: series (a turbine, or one tag of it) -> its newest
stamp, and the step to it [s].  Nothing is known after a restart until stamps are unambiguous again."""


@dataclass(frozen=True)
class Unreadable:
    """Content that a source could not split into a payload, such as a damaged row; it is always refused."""

    kind: str
    words: str


Content = bytes | str | Payload | Unreadable
"""What a source delivers: text, cells by column name, or a row that cannot be read."""


class PayloadRecord(NamedTuple):
    """A record of a payload, without `scopes` if it is no object.

    `name`: its key in the object around it; `topic` at which it arrived, and when it was `received` [s];
    `order`: of its source's local stamps.
    """

    scopes: Scopes
    name: str = ""
    topic: str = ""
    received: float = math.inf
    order: Order | None = None


def records(
    content: Content, form: str, steps: Sequence[str], topic: str = "", received: float = math.inf
) -> Iterable[PayloadRecord]:
    """The records of a payload: itself, the objects of its array, or those at the end of a path.

    form: one of `FORMATS`, for content that is still text.  Raises Refused for a payload without the path.
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
    content: Json, steps: Sequence[str], at: int, around: Scopes, name: str
) -> Iterator[tuple[Scopes, str]]:
    if isinstance(content, list):  # wherever an array is met, each of its elements is taken
        for one in content:
            yield from _walk(one, steps, at, around, name)
    elif not isinstance(content, Mapping):
        yield (), name
    elif at == len(steps):
        yield (content, *around), name
    elif steps[at] == EACH:
        for key, member in content.items():
            if isinstance(member, Mapping | list):
                yield from _walk(member, steps, at + 1, (content, *around), key)
    elif steps[at] in content:
        yield from _walk(content[steps[at]], steps, at + 1, (content, *around), name)
    else:
        raise Refused("no records", f"there is no {steps[at]!r} of records = {'.'.join(steps)!r}")


def parsed_text(content: bytes | str | Unreadable, form: str) -> Json:
    """The content of a payload's text, which may be packed by gzip.  Raises Refused."""
    if isinstance(content, Unreadable):
        raise Refused(content.kind, content.words)
    if len(content) > LARGEST:
        raise Refused("too large", f"a payload of {len(content)} bytes; at most {LARGEST} are read")
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
    unpacking = zlib.decompressobj(zlib.MAX_WBITS | 16)
    try:
        found = unpacking.decompress(packed, UNPACKED + 1)
    except zlib.error as fault:
        raise Refused("malformed", f"gzip that cannot be unpacked: {fault}") from None
    if len(found) > UNPACKED:
        raise Refused("too large", f"a payload of more than {UNPACKED} bytes after unpacking")
    if not unpacking.eof:
        raise Refused("malformed", "gzip that ends too early")
    return found


# -- JSON ----------------------------------------------------------------------------------------------------
def _json(text: bytes) -> Json:
    if _depth(text) > DEEPEST:
        raise Refused("too deep", f"a payload nested deeper than {DEEPEST} levels")
    try:
        return decoded(text)
    except (ValueError, RecursionError) as fault:
        raise Refused("malformed", f"no JSON: {str(fault)[:80]}") from None


_NOT_FINITE = re.compile(
    r'"(?:[^"\\]|\\.)*+(?:"|\\?\Z)|(?P<one>[+-]?(?:nan|inf(?:inity)?|\d\.#\w+)\b(?:\(\w*\))?)',
    re.IGNORECASE | re.DOTALL,
)
"""A text of JSON (to the end if it is open), or a number that is not finite: -nan, nan(ind), inf, 1.#QNAN."""


def decoded(text: bytes) -> Json:
    """What a JSON text holds; a bare nan or inf of any spelling is NaN, which no field takes for a number.

    Raises ValueError and RecursionError.
    """
    plain = text.decode(json.detect_encoding(text))
    try:
        found: Json = _DECODER.decode(plain)
    except ValueError as fault:
        finite = _NOT_FINITE.sub(lambda one: "NaN" if one["one"] else one[0], plain)
        if finite == plain:
            raise fault
        found = _DECODER.decode(finite)
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
    if text.count(b"{") + text.count(b"[") <= DEEPEST:
        return 0  # most payloads are flat
    deepest = level = 0
    for byte in text.translate(None, _NO_BRACKETS):
        if byte in b"{[":
            level += 1
            deepest = max(deepest, level)
            if deepest > DEEPEST:
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
    """One object for each line: its tags and fields, `measurement`, and `time` where it has one; None for a
    line that is none."""
    lines = (line.strip() for line in text.splitlines())
    return [_line(line) for line in lines if line and not line.startswith("#")]


def _line(line: str) -> JsonObject | None:
    whole = _LINE.fullmatch(line)
    if whole is None:
        return None
    measurement, *tags = re.split(r"(?<!\\),", whole["head"])
    found: JsonObject = {"measurement": _plain(measurement)}
    if whole["time"] is not None:
        found["time"] = int(whole["time"])
    for one in tags:
        tag = _TAG.fullmatch(one)
        if tag is None:
            return None
        found[_plain(tag[1])] = _plain(tag[2])
    at, fields = 0, whole["fields"]
    while at < len(fields):
        field = _FIELD.match(fields, at)
        if field is None:
            return None
        found[_plain(field[1])] = _field_value(field[2])
        at = field.end()
    return found


def _field_value(text: str) -> Json:
    if text.startswith('"'):
        return _plain(text[1:-1])
    if _INTEGER.fullmatch(text):
        return int(text[:-1])
    return _FLAGS.get(text, text)


def _plain(text: str) -> str:
    return _ESCAPED.sub(r"\1", text)
