"""Decodes Sparkplug B payloads, which are messages of protobuf with metrics, within bounds.

The numbers of the fields are those of the Sparkplug specification 3.0, chapter 6.4; of the fields only those
that are used here have a type.  Protobuf skips the others.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

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
_FIELDS = {
    "PropertyValue": ((3, "int_value", "uint32"), (4, "long_value", "uint64")),
    "PropertySet": ((1, "keys", "bytes"), (2, "values", "PropertyValue")),
    "Metric": (
        (1, "name", "bytes"),
        (2, "alias", "uint64"),
        (3, "timestamp", "uint64"),
        (4, "datatype", "uint32"),
        (5, "is_historical", "bool"),
        (6, "is_transient", "bool"),
        (7, "is_null", "bool"),
        (9, "properties", "PropertySet"),
        (10, "int_value", "uint32"),
        (11, "long_value", "uint64"),
        (12, "float_value", "float"),
        (13, "double_value", "double"),
        (14, "boolean_value", "bool"),
        (15, "string_value", "bytes"),
        # these are no single values and are not looked into
        (16, "bytes_value", "bytes"),
        (17, "dataset_value", "bytes"),
        (18, "template_value", "bytes"),
        (19, "extension_value", "bytes"),
    ),
    "Payload": (
        (1, "timestamp", "uint64"),
        (2, "metrics", "Metric"),
        (3, "seq", "uint64"),
        (4, "uuid", "bytes"),
        (5, "body", "bytes"),
    ),
}
"""Message -> numbers, names and types of its fields.

Texts are bytes, because the runtimes of protobuf differ in what they make of other bytes than UTF-8.
"""
_NO_SCALAR_FIELDS = ("bytes_value", "dataset_value", "template_value", "extension_value")
_REPEATED = ("keys", "values", "metrics")
_VALUE = "value"
"""Of the fields whose names end so, a message holds the last that was sent."""


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
class SparkplugMessage:
    """A decoded payload: its `time` [s], its sequence number, its metrics."""

    time: float | None = None
    sequence: int | None = None
    metrics: tuple[Metric, ...] = ()

    @property
    def session(self) -> int | None:
        """The number of the edge node's session (bdSeq) of a birth or death certificate."""
        number = next((one.reading(one.datatype) for one in self.metrics if one.name == "bdSeq"), None)
        return number % 256 if isinstance(number, int) else None


def decode(payload: bytes) -> SparkplugMessage:
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
    made = _payload_class()(timestamp=int(1000.0 * now))
    made.metrics.add(name=REBIRTH.encode(), timestamp=made.timestamp, datatype=BOOLEAN, boolean_value=True)
    return bytes(made.SerializeToString())


# -- messages ------------------------------------------------------------------------------------------------
@cache
def _payload_class() -> Any:
    """The class of payloads, which protobuf makes from `_FIELDS`."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    kinds = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="hygrokf_sparkplug", package="hygrokf", syntax="proto2")
    for message, fields in _FIELDS.items():
        made = file.message_type.add(name=message)
        for number, name, kind in fields:
            many = name in _REPEATED
            label = kinds.LABEL_REPEATED if many else kinds.LABEL_OPTIONAL
            field = made.field.add(name=name, number=number, label=label)
            if kind in _FIELDS:
                field.type, field.type_name = kinds.TYPE_MESSAGE, f".hygrokf.{kind}"
            else:
                field.type = getattr(kinds, f"TYPE_{kind.upper()}")
            if name.endswith(f"_{_VALUE}"):
                if not made.oneof_decl:
                    made.oneof_decl.add(name=_VALUE)
                field.oneof_index = 0
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("hygrokf.Payload"))


def _decode(payload: bytes) -> tuple[SparkplugMessage, str, bytes]:
    from google.protobuf.message import DecodeError

    if len(payload) > LARGEST_MESSAGE:
        raise Refused("too large", f"a message of {len(payload)} bytes; at most {LARGEST_MESSAGE} are read")
    try:
        found = _payload_class().FromString(payload)
        if len(found.metrics) > MOST_METRICS:
            raise Refused("too large", f"a message with more than {MOST_METRICS} metrics")
        metrics = tuple(_metric(one) for one in found.metrics)
        message = SparkplugMessage(
            found.timestamp / 1e3 if found.HasField("timestamp") else None,
            found.seq % 256 if found.HasField("seq") else None,
            metrics,
        )
        return message, found.uuid.decode(), found.body
    except DecodeError:
        raise Refused("malformed", "no protobuf, or cut short") from None
    except UnicodeDecodeError:
        raise Refused("malformed", "a text that is not in UTF-8") from None


def _metric(found: Any) -> Metric:
    kind = found.WhichOneof(_VALUE)
    is_scalar = kind not in _NO_SCALAR_FIELDS and found.datatype not in NO_SCALAR
    return Metric(
        name=found.name.decode() if found.HasField("name") else None,
        alias=found.alias if found.HasField("alias") else None,
        time=found.timestamp / 1e3 if found.HasField("timestamp") else None,
        datatype=found.datatype,
        value=_scalar(getattr(found, kind)) if is_scalar and kind is not None else None,
        quality=_quality(found.properties) if found.HasField("properties") else None,
        is_historical=found.is_historical,
        is_transient=found.is_transient,
        is_null=found.is_null,
        is_scalar=is_scalar,
    )


def _scalar(value: bool | float | bytes) -> int | float | str:
    if isinstance(value, bytes):
        return value.decode()
    return int(value) if isinstance(value, bool) else value


def _quality(properties: Any) -> int | None:
    names = [one.decode() for one in properties.keys]
    for name, one in zip(names, properties.values, strict=False):
        if name == QUALITY and (kind := one.WhichOneof(_VALUE)) is not None:
            return int(getattr(one, str(kind)))
    return None


def _decompressed(body: bytes) -> bytes:
    try:
        found = zlib.decompressobj(wbits=47).decompress(body, LARGEST_MESSAGE + 1)
    except zlib.error:
        raise Refused("malformed", "a compressed payload that cannot be decompressed") from None
    return found
