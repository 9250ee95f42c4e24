"""Decodes Sparkplug B payloads: protobuf messages with metrics, read with bounds and without a library.

The numbers of fields and data types are those of the public schema of Sparkplug B (Eclipse Tahu).  Unknown
fields are skipped, as protobuf demands; a message that does not follow the wire format is refused.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace

from hygrokf.live.sources.payload_formats import Refused

LARGEST_MESSAGE = 2**20
"""Largest message [bytes], also after decompression: a birth certificate lists every metric of an edge
node."""
MOST_METRICS = 20_000
COMPRESSED = "SPBV1.0_COMPRESSED"
"""`uuid` of a payload whose body is another payload, compressed by zlib or gzip."""
SIGNED = {1: 8, 2: 16, 3: 32, 4: 64}
"""Data type of a signed integer -> its bits."""
UNSIGNED = {5: 8, 6: 16, 7: 32, 8: 64, 13: 64}
"""Data type of an unsigned integer, or of a date [ms] -> its bits."""
BOOLEAN = 11
NO_SCALAR = frozenset({16, 17, 18, 19, *range(22, 35)})
"""Data types without a single value: data sets, bytes, files, templates, arrays."""
QUALITY = "Quality"
"""Name of the property with a metric's quality."""
REBIRTH = "Node Control/Rebirth"
"""The metric that asks an edge node for its birth certificates."""
_VARINT, _EIGHT, _BYTES, _FOUR = 0, 1, 2, 5
"""Wire types."""
_MOST_VARINT = 10
"""Longest varint [bytes]."""


WireField = tuple[int, int, int | memoryview]
"""A field of a message: its number, its wire type, and its value (an integer, or its bytes)."""


@dataclass(frozen=True)
class Metric:
    """A metric of a message; what a message leaves out is None.

    `time` [s]; `datatype`: number of its data type, 0 if not stated; `value`: an integer as sent, before its
    sign is known, a number, a text, None for none; `is_scalar`: False for templates, data sets, bytes and
    arrays; `quality`: the property of that name.
    """

    name: str | None = None
    alias: int | None = None
    time: float | None = None
    datatype: int = 0
    value: int | float | str | None = None
    quality: int | None = None
    is_historical: bool = False
    is_transient: bool = False
    is_null: bool = False
    is_scalar: bool = True

    def reading(self, datatype: int) -> int | float | str | None:
        """The value as its data type reads it: integers with their sign, booleans as 1 and 0."""
        value = None if self.is_null else self.value
        if isinstance(value, int):
            if datatype in SIGNED:
                half = 1 << SIGNED[datatype] - 1
                return (value + half) % (2 * half) - half
            return value % (1 << UNSIGNED.get(datatype, 64))
        return value


@dataclass(frozen=True)
class Message:
    """A decoded payload: its `time` [s], its sequence number, its metrics."""

    time: float | None = None
    sequence: int | None = None
    metrics: tuple[Metric, ...] = ()

    def value_of(self, name: str) -> int | float | str | None:
        """The value of the metric with a name; None without one."""
        return next((one.reading(one.datatype) for one in self.metrics if one.name == name), None)


def decode(payload: bytes) -> Message:
    """The message of a payload.  Raises Refused for anything that is no Sparkplug B payload."""
    message, uuid, body = _decode(payload)
    if uuid != COMPRESSED:
        return message
    inner, uuid, _ = _decode(_decompressed(body))
    if uuid == COMPRESSED:
        raise Refused("malformed", "a compressed payload within a compressed payload")
    sequence = message.sequence if inner.sequence is None else inner.sequence
    return replace(inner, sequence=sequence)


def rebirth_request(now: float) -> bytes:
    """The payload of a command that asks an edge node for its birth certificates, sent at a time [s]."""
    stamp = _varint(int(1000.0 * now))
    name = REBIRTH.encode()
    metric = (
        b"\x0a" + _varint(len(name)) + name  # 1: name
        + b"\x18" + stamp  # 3: timestamp
        + b"\x20" + _varint(BOOLEAN)  # 4: data type
        + b"\x70\x01"  # 14: the value, true
    )  # fmt: skip
    return b"\x08" + stamp + b"\x12" + _varint(len(metric)) + metric


# -- messages ------------------------------------------------------------------------------------------------
def _decode(payload: bytes) -> tuple[Message, str, bytes]:
    """A message with its uuid and body."""
    if len(payload) > LARGEST_MESSAGE:
        raise Refused("too large", f"a message of {len(payload)} bytes; at most {LARGEST_MESSAGE} are read")
    time = sequence = None
    uuid, body = "", b""
    metrics: list[Metric] = []
    for number, wire, value in _fields(memoryview(payload)):
        match number, wire, value:
            case 1, 0, int():
                time = value / 1e3
            case 2, 2, memoryview():
                metrics.append(_metric(value))
                if len(metrics) > MOST_METRICS:
                    raise Refused("too large", f"a message with more than {MOST_METRICS} metrics")
            case 3, 0, int():
                sequence = value % 256
            case 4, 2, memoryview():
                uuid = _text(value)
            case 5, 2, memoryview():
                body = bytes(value)
    return Message(time, sequence, tuple(metrics)), uuid, body


def _metric(content: memoryview) -> Metric:
    found: dict[str, int | float | str | bool | None] = {}
    for number, wire, value in _fields(content):
        match number, wire, value:
            case 1, 2, memoryview():
                found["name"] = _text(value)
            case 2, 0, int():
                found["alias"] = value
            case 3, 0, int():
                found["time"] = value / 1e3
            case 4, 0, int():
                found["datatype"] = value % 2**32
            case ((5 | 6 | 7), 0, int()):
                found[("is_historical", "is_transient", "is_null")[number - 5]] = value != 0
            case 9, 2, memoryview():
                found["quality"] = _quality(value)
            case ((10 | 11 | 12 | 13 | 14 | 15), _, _):
                if (scalar := _scalar(number - 10, wire, value)) is not None:
                    found |= {"value": scalar, "is_scalar": True}
            case ((16 | 17 | 18 | 19), 2, _):
                found |= {"value": None, "is_scalar": False}
    if found.get("datatype") in NO_SCALAR:
        found |= {"value": None, "is_scalar": False}
    return Metric(**found)  # type: ignore[arg-type]


def _quality(content: memoryview) -> int | None:
    """The quality in a set of properties, which is a list of names and a list of values."""
    names: list[str] = []
    values: list[int | None] = []
    for number, wire, value in _fields(content):
        match number, wire, value:
            case 1, 2, memoryview():
                names.append(_text(value))
            case 2, 2, memoryview():
                # fields of a property's value that are an integer: 3 with 32 bits, 4 with 64
                found = [v for n, w, v in _fields(value) if n in (3, 4) and w == _VARINT]
                values.append(found[-1] if found and isinstance(found[-1], int) else None)
    return next((v for name, v in zip(names, values, strict=False) if name == QUALITY), None)


def _scalar(kind: int, wire: int, value: int | memoryview) -> int | float | str | None:
    """The value of a field of 32 bits, 64 bits, float, double, boolean, text (kinds 0 … 5); None if the wire
    type is another."""
    match kind, wire, value:
        case 0, 0, int():
            return value % 2**32
        case 1, 0, int():
            return value
        case 2, 5, memoryview():
            return float(struct.unpack("<f", value)[0])
        case 3, 1, memoryview():
            return float(struct.unpack("<d", value)[0])
        case 4, 0, int():
            return int(value != 0)
        case 5, 2, memoryview():
            return _text(value)
    return None


def _text(content: memoryview) -> str:
    try:
        return str(content, "utf-8")
    except UnicodeDecodeError:
        raise Refused("malformed", "a text that is not in UTF-8") from None


def _decompressed(body: bytes) -> bytes:
    """A body decompressed by zlib or gzip, whichever it names in its first bytes."""
    try:
        found = zlib.decompressobj(wbits=47).decompress(body, LARGEST_MESSAGE + 1)
    except zlib.error:
        raise Refused("malformed", "a compressed payload that cannot be decompressed") from None
    return found


# -- the wire format -----------------------------------------------------------------------------------------
def _fields(content: memoryview) -> Iterator[WireField]:
    """The fields of a message, in their order.  Raises Refused."""
    place, end = 0, len(content)
    while place < end:
        key, place = _read_varint(content, place)
        number, wire = key >> 3, key & 7
        if not 0 < number < 2**29:
            raise Refused("malformed", f"no protobuf: a field with the number {number}")
        if wire == _VARINT:
            value, place = _read_varint(content, place)
            yield number, wire, value
            continue
        if wire == _BYTES:
            size, place = _read_varint(content, place)
        elif wire in (_EIGHT, _FOUR):
            size = 8 if wire == _EIGHT else 4
        else:
            raise Refused("malformed", f"no protobuf: a field of the wire type {wire}")
        if size > end - place:
            raise Refused("malformed", "no protobuf: a field is longer than its message")
        yield number, wire, content[place : place + size]
        place += size


def _read_varint(content: memoryview, place: int) -> tuple[int, int]:
    """The integer of up to 64 bits at a place, and the place after it."""
    if place < len(content) and (value := content[place]) < 0x80:
        return value, place + 1
    value = 0
    for count, byte in enumerate(content[place : place + _MOST_VARINT]):
        value |= (byte & 0x7F) << 7 * count
        if byte < 0x80:
            return value % 2**64, place + count + 1
    raise Refused("malformed", "no protobuf: an integer without an end")


def _varint(value: int) -> bytes:
    """An integer that is not negative, as a varint."""
    found = bytearray()
    while value > 0x7F:
        found.append(value & 0x7F | 0x80)
        value >>= 7
    found.append(value)
    return bytes(found)
