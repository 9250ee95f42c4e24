"""The decoder of Sparkplug payloads against another schema of protobuf, and against bytes that are none."""

from __future__ import annotations

import gzip
import math
import random
import zlib

import pytest
from builders.sparkplug_peer import (
    BOOLEAN,
    BYTES,
    DATASET,
    DATETIME,
    DOUBLE,
    FLOAT,
    INT8,
    INT16,
    INT32,
    INT64,
    STRING,
    TEMPLATE,
    UINT8,
    UINT32,
    UINT64,
    metric,
    payload,
    payload_class,
)

from hygrokf.live.sources.payload_formats import Refused
from hygrokf.live.sources.sparkplug_payload import (
    COMPRESSED,
    LARGEST_MESSAGE,
    Metric,
    decode,
    rebirth_request,
)

AT = 1_772_366_400.25


@pytest.mark.parametrize(
    ("kind", "value"),
    [
        (INT8, -1), (INT8, 127), (INT16, -300), (INT32, -(2**31)), (INT64, -(2**63)), (INT64, 5),
        (UINT8, 255), (UINT32, 2**32 - 1), (UINT64, 2**64 - 1), (DATETIME, 1_772_366_400_000),
        (FLOAT, 21.5), (DOUBLE, -273.15), (DOUBLE, math.inf), (BOOLEAN, 1), (BOOLEAN, 0), (STRING, "Tür"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("typed", [True, False])
def test_values_of_every_type_come_back(kind: int, value: object, typed: bool) -> None:
    """The data type stands in the message or, for data, only in the birth certificate."""
    (found,) = decode(payload([metric("a", value, kind, at=AT, typed=typed)], 3, AT)).metrics
    assert found.reading(kind) == value
    assert (found.name, found.time, found.datatype) == ("a", AT, kind if typed else 0)


def test_a_message_keeps_its_order_time_and_number() -> None:
    message = decode(payload([metric(alias=k, value=k, kind=INT32) for k in range(300)], 255, AT))
    assert [one.alias for one in message.metrics] == list(range(300))
    assert (message.time, message.sequence) == (AT, 255)


@pytest.mark.parametrize("flag", ["is_historical", "is_transient"])
def test_flags(flag: str) -> None:
    (plain, flagged) = decode(payload([metric("a", 1, INT8), metric("a", 1, INT8, **{flag: True})])).metrics
    assert not getattr(plain, flag) and getattr(flagged, flag)


def test_null_quality_and_what_has_no_single_value() -> None:
    null, bad, good, table, template, raw = decode(
        payload([
            metric("null"), metric("bad", 1.0, FLOAT, quality=0), metric("good", 1.0, FLOAT, quality=192),
            metric("table", {}, DATASET), metric("template", {}, TEMPLATE), metric("raw", b"\xff", BYTES),
        ])
    ).metrics  # fmt: skip
    assert null.is_null and null.reading(FLOAT) is None
    assert (bad.quality, good.quality, null.quality) == (0, 192, None)
    assert [one.is_scalar for one in (good, table, template, raw)] == [True, False, False, False]


@pytest.mark.parametrize("pack", [gzip.compress, zlib.compress])
def test_a_compressed_payload_is_unpacked_within_its_limit(pack) -> None:
    made = payload_class()(timestamp=1, seq=7, uuid=COMPRESSED, body=pack(payload([metric("a", 2, INT8)])))
    message = decode(made.SerializeToString())
    assert message.sequence == 7 and [one.name for one in message.metrics] == ["a"]
    made.body = pack(made.SerializeToString())
    with pytest.raises(Refused, match="compressed"):
        decode(made.SerializeToString())
    made.body = pack(bytes(LARGEST_MESSAGE + 1))
    with pytest.raises(Refused) as refused:
        decode(made.SerializeToString())
    assert refused.value.kind == "too large"


def test_fields_of_a_later_schema_are_skipped() -> None:
    later = b"\xa2\x06\x03abc" + b"\xad\x06\x01\x02\x03\x04" + b"\xb1\x06" + bytes(8) + b"\xb8\x06\x05"
    assert decode(later + payload([metric("a", 1, INT8)], 4)).sequence == 4


@pytest.mark.parametrize(
    "content",
    [
        b"\x00",  # the field 0
        b"\x08",  # an integer without an end
        b"\x08" + b"\xff" * 11,
        b"\x12\x05ab",  # longer than the message
        b"\x0b",  # a group
        b"\x12\x03\x0a\x01\xff",  # a name that is not in UTF-8
        b'{"Tcab": 21.5}',
    ],
)
def test_bytes_that_are_no_payload_are_refused(content: bytes) -> None:
    with pytest.raises(Refused):
        decode(content)


def test_an_oversized_message_is_refused() -> None:
    with pytest.raises(Refused) as refused:
        decode(bytes(LARGEST_MESSAGE + 1))
    assert refused.value.kind == "too large"


def test_10_000_damaged_payloads_are_read_or_refused_and_nothing_else() -> None:
    draw = random.Random(18)
    whole = payload(
        [
            metric("Cabinet/Temperature", 21.5, FLOAT, 3, AT, quality=192),
            metric("Counter", -3, INT32, 4, AT, is_historical=True),
            metric("Table", {}, DATASET),
        ],
        9, AT,
    )  # fmt: skip
    read = 0
    for number in range(10_000):
        content = bytearray(draw.randbytes(draw.randrange(60)) if number % 4 == 0 else whole)
        for _ in range(draw.randrange(1, 6)):
            if content:
                content[draw.randrange(len(content))] = draw.randrange(256)
        del content[draw.randrange(len(content) + 1) if number % 3 == 0 else len(content) :]
        try:
            message = decode(bytes(content))
        except Refused:
            continue
        read += 1
        for one in message.metrics:
            assert isinstance(one, Metric)
            for kind in range(36):
                one.reading(kind)
    assert 500 < read < 9_000


def test_a_rebirth_request_is_what_protobuf_reads_and_nothing_more() -> None:
    found = payload_class().FromString(rebirth_request(AT))
    (one,) = found.metrics
    assert (one.name, one.datatype, one.boolean_value) == ("Node Control/Rebirth", BOOLEAN, True)
    assert found.timestamp == one.timestamp == 1_772_366_400_250
    assert found.SerializeToString() == rebirth_request(AT)
