"""Payloads that are none: each is made to be set aside for a reason, which is the kind under which it must be
counted."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
from builders.brokers import peer, publish

from hygrokf.live.sources.payload_formats import DEEPEST_NESTING, LARGEST_PAYLOAD
from validation.faults.plant import Message, Outcome, Plant, counted, stored
from validation.faults.tracker import broker_of, mqtt_source, tracking, unacknowledged, until

NAMES = (
    "<script>alert(1)</script>", "T1<img src=x onerror=alert(1)>", "T1\x00", "T1\r\n", "\x1b[31mT1",
    "T1\u202e", "t1", " T1", "T1 ",
    "", "../T1", "'; DROP TABLE turbine; --", "T" * 300, "\ud800T1", "T1\udfff", "\U0010ffff", "%s%n", "{1}",
    None, True, 1, -0.0, [],
    ["T1"], {"name": "T1"}, 10**300, "T１",
)  # fmt: skip
"""What stands for no turbine that is tracked."""
TIMES = (
    None, True, False, [], {}, [1.6e9], {"time": 1.6e9}, "", "soon", "<b>now</b>", "2026-03-01T12:00:00",
    "2026-13-01T12:00:00Z",
    "9999-12-31T23:59:59-23:00", "0000-00-00T00:00:00Z", "\ud800", "\x00", "1" * 300, float("nan"),
    float("inf"), float("-inf"), 10**400,
    "nan", "Infinity", "2026-03-01T12:00:00Z; DROP TABLE observation",
)  # fmt: skip
"""What is no time."""
IMPOSSIBLE = (0, -1, 1e-300, -1e308, 1e300, 631_151_999, 4.2e9, 1e13, 10**17, "0", "-5", "9e18",
    "9999-12-31T23:59:59Z", "0001-01-01T00:00:00+00:00")  # fmt: skip
"""Times that are none of a turbine."""
NO_NUMBERS = (
    True, False, [], {}, [290.0], {"value": 290.0}, "warm", "<b>290</b>", "290 Kelvins", "1_000", "2,9e2",
    "\ud800", "\x00", "9" * 300, "0x122",
    float("nan"), float("inf"), float("-inf"), 10**400, "nan", "-Infinity", "290\ud800",
)  # fmt: skip
"""What is no number."""
BEYOND = (-1.0, 0.0, 1e300, -1e300, 10**300, 1e-320, "1e9", 1e9, 2000, "0")
"""Temperatures [K] that no cabinet has."""
SIGNAL = "cabinet_temperature"


def _stated(random: np.random.Generator, at: float, **changes: object) -> bytes:
    content = {"turbine": "T1", "time": at, SIGNAL: 290.0 + float(random.normal()), **changes}
    return json.dumps(content).encode()


def _any(random: np.random.Generator, of: tuple) -> object:
    return of[int(random.integers(0, len(of)))]


def _cut(random: np.random.Generator, at: float) -> bytes:
    whole = _stated(random, at, note="a few words in between, äöü")
    return whole[: int(random.integers(0, len(whole) - 1))]


def _bytes(random: np.random.Generator, at: float) -> bytes:
    """Whatever; without brackets, which could be too deep instead."""
    return b"\xff" + random.bytes(int(random.integers(0, 400))).translate(None, b"[]{}")


def _flipped(random: np.random.Generator, at: float) -> bytes:
    """Brackets, quotes and colons of a payload that are something else."""
    whole = bytearray(_stated(random, at))
    places = [i for i, byte in enumerate(whole) if byte in b'{}":']
    whole[_any(random, tuple(places))] = int(_any(random, (0, 1, 31, 91, 127, 128, 255)))
    return bytes(whole)


def _huge(random: np.random.Generator, at: float) -> bytes:
    return _stated(random, at, note="x" * (LARGEST_PAYLOAD + int(random.integers(0, 30_000))))


def _deep(random: np.random.Generator, at: float) -> bytes:
    levels = DEEPEST_NESTING + int(random.integers(1, 8_000))
    opening, closing = (b'{"a":', b"}") if random.random() < 0.5 else (b"[", b"]")
    return b'{"turbine": "T1", "note": ' + opening * levels + b"1" + closing * levels + b"}"


def _no_object(random: np.random.Generator, at: float) -> bytes:
    whole = _stated(random, at)
    return bytes(_any(random,
        (b"[" + whole + b", 1", b"null", b"true", b'"T1"', b"290", whole + whole, b"NaN", b"9" * 5_000,
            whole + b"\x00")))  # fmt: skip


def _twice(random: np.random.Generator, at: float) -> bytes:
    """A key that stands there twice: nobody can say which one is meant."""
    key, value = _any(random, (("turbine", b'"T1"'), ("time", b"1"), (SIGNAL, b"250.0")))
    whole = _stated(random, at)
    pair = b'"%s": %s' % (key.encode(), value)
    return whole[:-1] + b", " + pair + b"}" if random.random() < 0.5 else b"{" + pair + b", " + whole[1:]


KINDS: dict[str, tuple[str, Callable[[np.random.Generator, float], bytes]]] = {
    "cut": ("malformed", _cut),
    "bytes": ("malformed", _bytes),
    "flipped": ("malformed", _flipped),
    "no object": ("malformed", _no_object),
    "a key twice": ("malformed", _twice),
    "giant": ("malformed", lambda random,
        at: b'{"turbine": "T1", "time": ' + b"9" * int(random.integers(4_400, 60_000)) + b"}"),
    "huge": ("too large", _huge),
    "deep": ("too deep", _deep),
    "unknown": ("unknown turbine", lambda random, at: _stated(random, at, turbine=_any(random, NAMES))),
    "no time": ("no time", lambda random, at: _stated(random, at, time=_any(random, TIMES))),
    "impossible time": ("impossible time", lambda random,
        at: _stated(random, at, time=_any(random, IMPOSSIBLE))),
    "no number": ("no number", lambda random, at: _stated(random, at, **{SIGNAL: _any(random, NO_NUMBERS)})),
    "beyond": ("impossible value", lambda random, at: _stated(random, at, **{SIGNAL: _any(random, BEYOND)})),
}  # fmt: skip
"""What is wrong -> (the kind under which it is counted, how it is made from a random generator and a time
[s])."""


def spoiled(random: np.random.Generator, count: int, at: float) -> list[tuple[str, bytes]]:
    """(kind under which it must be counted, payload) of so many payloads that are none, of all sorts."""
    found = []
    for _ in range(count):
        kind, make = KINDS[_any(random, tuple(KINDS))]
        found.append((kind, make(random, at)))
    return found


def malformed(folder: Path, seed: int, count: int = 1_000) -> Outcome:
    """Payloads that are none among those of a turbine, through a broker into a tracker: it is as if they were
    not there."""
    random, plant = np.random.default_rng(seed), Plant(folder)
    store, messages = plant.store, plant.messages()
    rows = plant.timed()
    rubbish = spoiled(random, count, 0.5 * (rows[0][0] + rows[-1][0]))
    order = random.permutation(len(messages) + count)
    # the turbine's own stay in their order: what they lead to is compared bit for bit
    mixed: list[Message] = [("", b"")] * len(order)
    for place, message in zip(np.sort(order[: len(messages)]), messages, strict=True):
        mixed[place] = message
    for place, (_, payload) in zip(order[len(messages) :], rubbish, strict=True):
        mixed[place] = ("scada/T1", payload)
    with broker_of(plant) as broker:
        with tracking(broker, plant.config(mqtt_source(broker), store)) as tracker:
            with peer(broker) as client:
                for first in range(0, len(mixed), 1_000):
                    publish(client, mixed[first : first + 1_000])
            until(lambda: stored(store) >= len(messages), tracker.said)
            until(lambda: counted(store).total() >= count, lambda: (counted(store).total(), count))
            tracker.stop()
        fault = unacknowledged(broker)
    expected, found = Counter(kind for kind, _ in rubbish), counted(store)
    if found != expected:
        fault = f"expected {dict(expected)}, counted {dict(found)}"
    words = ", ".join(f"{n:,} {kind}" for kind, n in sorted(found.items()))
    return plant.judged(count, len(mixed), store, words=words, fault=fault)
