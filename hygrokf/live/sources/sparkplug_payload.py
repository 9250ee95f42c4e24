"""Decodes Sparkplug B payloads, which are protobuf messages with metrics, up to a limited size.

The field numbers are those of the Sparkplug specification 3.0, chapter 6.4.  Only the fields used here are
declared; protobuf skips the others.
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
"""Data type of a signed integer -> its number of bits."""
UNSIGNED = {5: 8, 6: 16, 7: 32, 8: 64, 13: 64}
"""Data type of an unsigned integer, or of a date [ms] -> its number of bits."""
BOOLEAN = 11
NO_SCALAR = frozenset({16, 17, 18, 19, *range(22, 35)})
"""Data types without a single value: data sets, bytes, files, templates, arrays."""
QUALITY = "Quality"
"""Name of the property that holds a metric's quality."""
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
        # not single values: their bytes are not decoded
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
"""Message -> number, name and type of each of its fields.

Texts are declared as bytes, because the protobuf runtimes differ in how they treat bytes that are not UTF-8.
"""
_NO_SCALAR_FIELDS = ("bytes_value", "dataset_value", "template_value", "extension_value")
_REPEATED = ("keys", "values", "metrics")
_VALUE = "value"
"""Suffix of the fields that form a protobuf `oneof`: a message keeps only the last of them that was sent."""


@dataclass(frozen=True)
class Metric:
    """A metric of a message; a field that the message omits is None.

    `time`: time stamp [s]; `datatype`: number of the data type, 0 if not stated; `value`: number, text or
    None; an integer is kept as sent, without its sign (see `reading`); `is_scalar`: False for templates, data
    sets, bytes and arrays; `quality`: value of the property Quality.
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
        """Return the value as its data type demands: an integer with its sign, a boolean as 1 or 0."""
        value = None if self.is_null else self.value
        if isinstance(value, int):
            if datatype in SIGNED:
                half = 1 << SIGNED[datatype] - 1
                return (value + half) % (2 * half) - half
            return value % (1 << UNSIGNED.get(datatype, 64))
        return value


@dataclass(frozen=True)
class SparkplugMessage:
    """A decoded payload: its time stamp [s], its sequence number and its metrics."""

    time: float | None = None
    sequence: int | None = None
    metrics: tuple[Metric, ...] = ()

    @property
    def session(self) -> int | None:
        """The session number (bdSeq, 0 … 255) in a birth or death certificate; None without one."""
        number = next(
            (metric.reading(metric.datatype) for metric in self.metrics if metric.name == "bdSeq"), None
        )
        return number % 256 if isinstance(number, int) else None


def decode(payload: bytes) -> SparkplugMessage:
    """Decode a payload.  Raises Refused for bytes that are not a Sparkplug B payload."""
    message, uuid, body = _decode(payload)
    if uuid != COMPRESSED:
        return message
    inner, uuid, _ = _decode(_decompressed(body))
    if uuid == COMPRESSED:
        raise Refused("malformed", "a compressed payload within a compressed payload")
    sequence = message.sequence if inner.sequence is None else inner.sequence
    return replace(inner, sequence=sequence)


def rebirth_request(now: float) -> bytes:
    """Return the payload that asks an edge node for its birth certificates, sent at `now` [s]."""
    command = _payload_class()(timestamp=int(1000.0 * now))
    command.metrics.add(
        name=REBIRTH.encode(), timestamp=command.timestamp, datatype=BOOLEAN, boolean_value=True
    )
    return bytes(command.SerializeToString())


# -- messages ------------------------------------------------------------------------------------------------
@cache
def _payload_class() -> Any:
    """The protobuf class of payloads, built from `_FIELDS`."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    kinds = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="hygrokf_sparkplug", package="hygrokf", syntax="proto2")
    for message, fields in _FIELDS.items():
        message_type = file.message_type.add(name=message)
        for number, name, kind in fields:
            label = kinds.LABEL_REPEATED if name in _REPEATED else kinds.LABEL_OPTIONAL
            field = message_type.field.add(name=name, number=number, label=label)
            if kind in _FIELDS:
                field.type, field.type_name = kinds.TYPE_MESSAGE, f".hygrokf.{kind}"
            else:
                field.type = getattr(kinds, f"TYPE_{kind.upper()}")
            if name.endswith(f"_{_VALUE}"):
                if not message_type.oneof_decl:
                    message_type.oneof_decl.add(name=_VALUE)
                field.oneof_index = 0
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("hygrokf.Payload"))


def _decode(payload: bytes) -> tuple[SparkplugMessage, str, bytes]:
    """Decode a payload; returns the message, `uuid`, and `body`, which may be a compressed payload."""
    from google.protobuf.message import DecodeError

    if len(payload) > LARGEST_MESSAGE:
        raise Refused("too large", f"a message of {len(payload)} bytes; at most {LARGEST_MESSAGE} are read")
    try:
        decoded = _payload_class().FromString(payload)
        if len(decoded.metrics) > MOST_METRICS:
            raise Refused("too large", f"a message with more than {MOST_METRICS} metrics")
        metrics = tuple(_metric(raw) for raw in decoded.metrics)
        message = SparkplugMessage(
            decoded.timestamp / 1e3 if decoded.HasField("timestamp") else None,
            decoded.seq % 256 if decoded.HasField("seq") else None,
            metrics,
        )
        return message, decoded.uuid.decode(), decoded.body
    except DecodeError:
        raise Refused("malformed", "not protobuf, or cut short") from None
    except UnicodeDecodeError:
        raise Refused("malformed", "a text that is not in UTF-8") from None


def _metric(raw: Any) -> Metric:
    """Convert a protobuf metric."""
    kind = raw.WhichOneof(_VALUE)
    is_scalar = kind not in _NO_SCALAR_FIELDS and raw.datatype not in NO_SCALAR
    return Metric(
        name=raw.name.decode() if raw.HasField("name") else None,
        alias=raw.alias if raw.HasField("alias") else None,
        time=raw.timestamp / 1e3 if raw.HasField("timestamp") else None,
        datatype=raw.datatype,
        value=_scalar(getattr(raw, kind)) if is_scalar and kind is not None else None,
        quality=_quality(raw.properties) if raw.HasField("properties") else None,
        is_historical=raw.is_historical,
        is_transient=raw.is_transient,
        is_null=raw.is_null,
        is_scalar=is_scalar,
    )


def _scalar(value: bool | float | bytes) -> int | float | str:
    """Convert a protobuf value: bytes to text, a boolean to 1 or 0."""
    if isinstance(value, bytes):
        return value.decode()
    return int(value) if isinstance(value, bool) else value


def _quality(properties: Any) -> int | None:
    """Return the value of the property `QUALITY`; None without one."""
    names = [key.decode() for key in properties.keys]
    for name, value in zip(names, properties.values, strict=False):
        if name == QUALITY and (kind := value.WhichOneof(_VALUE)) is not None:
            return int(getattr(value, str(kind)))
    return None


def _decompressed(body: bytes) -> bytes:
    """Decompress zlib or gzip, up to one byte beyond `LARGEST_MESSAGE`."""
    try:
        # wbits 47: the header decides between zlib and gzip; one byte too many shows that a limit is exceeded
        decompressed = zlib.decompressobj(wbits=47).decompress(body, LARGEST_MESSAGE + 1)
    except zlib.error:
        raise Refused("malformed", "a compressed payload that cannot be decompressed") from None
    return decompressed
