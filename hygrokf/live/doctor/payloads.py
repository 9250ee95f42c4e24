"""Payloads tried on the mappings of a tracker's file: what each gives, or why not.

They come from a file or, for some seconds, from a topic of a broker.  Nothing is written, and at the broker a
temporary session of its own is used, so that the tracker's session keeps its messages.
"""

from __future__ import annotations

import gzip
import time
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import IO, Any, cast

from hygrokf.data.signals import from_si, signal_named
from hygrokf.data.structured import JsonObject
from hygrokf.live.doctor.sources import arrivals, doctor_session, listening
from hygrokf.live.sources.broker import filter_fault
from hygrokf.live.sources.local import Lines, TailedFile, contents
from hygrokf.live.sources.mqtt import Mqtt
from hygrokf.live.sources.payload import USED_THOUGH, PayloadMapping, PayloadStatistics
from hygrokf.live.sources.payload_formats import JSON, UNPACKED, Content, Unreadable, decoded
from hygrokf.live.sources.stream import Delivery, SourceFault, Stream
from hygrokf.live.tracker import Reading
from hygrokf.texts.wording import one_line, stamp_text

MOST = 20
"""Payloads that are shown; further ones are only counted."""
MOST_READ = 10_000
"""Payloads that are read."""
MOST_VALUES = 40
"""Readings and rejections of a payload that are shown."""
WIDTH = 100
"""Characters of a payload that are shown."""


@dataclass(frozen=True)
class Trial:
    """What the payloads gave by the mapping of some `sources`.

    `payloads`: the first ones, each its shortened text as `payload`, with `readings` (turbine, signal, time
    in ISO 8601, value and unit) and `rejections` (turbine, kind and why).
    """

    sources: tuple[str, ...]
    payloads: tuple[dict[str, Any], ...]
    count: int
    used: int
    rejected: str


# -- where the payloads come from ----------------------------------------------------------------------------
def try_payloads(streams: Sequence[Stream], what: str, wait_s: float) -> list[Trial]:
    """Try the payloads of a file, or those that arrive at a topic within `wait_s` [s].

    A file is read by the mapping of the source whose file it is, otherwise by each mapping.  Raises
    SourceFault.
    """
    path = Path(what)
    if path.exists() or not any(isinstance(one, Mqtt) for one in streams):
        return _try_file(streams, path)
    if (wrong := filter_fault(what)) is not None:
        raise SourceFault(f"expected a file or a topic; there is no file {what!r}, and {wrong}")
    brokers = [one for one in streams if isinstance(one, Mqtt)]
    return [trial((one.url,), one.mapping, heard(one, what, wait_s)) for one in brokers]


def _try_file(streams: Sequence[Stream], path: Path) -> list[Trial]:
    own = [one for one in streams if isinstance(one, TailedFile) and one.path.absolute() == path.absolute()]
    found: list[tuple[PayloadMapping, list[str]]] = []
    for stream in own or streams:
        known = next((urls for mapping, urls in found if mapping == stream.mapping), None)
        if known is None:
            found.append((stream.mapping, [stream.url]))
        else:
            known.append(stream.url)
    try:
        return [trial(tuple(urls), mapping, filed(path, mapping)) for mapping, urls in found]
    except FileNotFoundError:
        raise SourceFault(f"{path}: no such file; a topic needs a [[source]] that is a broker") from None
    except (OSError, EOFError, zlib.error) as fault:
        raise SourceFault(f"{path}: cannot be read: {getattr(fault, 'strerror', None) or fault}") from None


def filed(path: Path, mapping: PayloadMapping) -> Iterator[Delivery]:
    """The payloads of a file, perhaps packed: one JSON text, or one payload or row a line.

    Where the mapping reads levels of the topic, each line is `TOPIC PAYLOAD`, as `mosquitto_sub -v` prints
    it.
    """
    now = time.time()
    with path.open("rb") as plain:
        packed = plain.read(2) == b"\x1f\x8b"
    file: IO[bytes]
    with cast(IO[bytes], gzip.open(path)) if packed else path.open("rb") as file:
        start = file.read(UNPACKED + 1)
        if len(start) <= UNPACKED and mapping.form == JSON and start.lstrip()[:1] in (b"{", b"["):
            with suppress(ValueError, RecursionError):
                decoded(start)
                yield Delivery(start, now)
                return
        file.seek(0)
        lines = Lines(mapping.form if not mapping.needs_topic else "line")
        for content in contents(file, lines):
            topic = ""
            if mapping.needs_topic and isinstance(content, str):
                topic, _, content = content.partition(" ")
            yield Delivery(content, now, topic)


def heard(source: Mqtt, topic: str, wait_s: float) -> Iterator[Delivery]:
    """The messages at a topic within `wait_s` [s], retained ones included.  Raises SourceFault."""
    session = replace(doctor_session(source.broker), topics=(topic,), alarms="")
    with listening(session, source.largest) as link:
        if link.lost.is_set() or not link.answered or link.denied:
            words = link.reason or f"{source.broker.where} has not answered"
            raise SourceFault(f"{source.url}: {'; '.join(link.denied.values()) or words}")
        for arrival in arrivals(link, wait_s):
            for content in source.read(arrival):
                yield Delivery(content, arrival.time, arrival.topic)
        if link.lost.is_set():
            raise SourceFault(f"{source.url}: {link.reason}")


# -- what they give ------------------------------------------------------------------------------------------
def trial(sources: tuple[str, ...], mapping: PayloadMapping, payloads: Iterable[Delivery]) -> Trial:
    """Read payloads by a mapping."""
    statistics = PayloadStatistics(mapping)
    shown: list[dict[str, Any]] = []
    for one in payloads:
        found = statistics.take(one.content, one.received, one.topic)
        if len(shown) < MOST:
            readings = [_tried(of.turbine, reading) for of in found for reading in of.readings]
            rejections = [
                {"turbine": turbine, "kind": kind, "why": why}
                for turbine, _, refused in found
                for kind, why in refused
            ]
            text = f"{one.topic} {_text(one.content)}".strip()
            those = {"readings": readings[:MOST_VALUES], "rejections": rejections[:MOST_VALUES]}
            shown.append({"payload": text, **those})
        if statistics.payloads == MOST_READ:
            break
    return Trial(sources, tuple(shown), statistics.payloads, statistics.used, statistics.rejected)


def _tried(turbine: str, one: Reading) -> dict[str, Any]:
    row = signal_named(one.signal)
    unit = row.display or row.unit
    value = float(from_si(one.value, unit, one.signal))
    return {
        "turbine": turbine, "signal": one.signal, "time": stamp_text(one.time), "value": value, "unit": unit,
    }  # fmt: skip


def _text(content: Content) -> str:
    if isinstance(content, Unreadable):
        return "(no payload)"
    if isinstance(content, Mapping):
        text = ", ".join(f"{name}={value}" for name, value in content.items())
    elif isinstance(content, bytes):
        text = "(gzip)" if content[:2] == b"\x1f\x8b" else content[: 4 * WIDTH].decode("utf-8", "replace")
    else:
        text = content
    return text if len(text) <= WIDTH else f"{text[: WIDTH - 1]}…"


def as_text(trials: Sequence[Trial]) -> str:
    """Each payload with what it gave, and a summary for each mapping."""
    lines = []
    for one in trials:
        lines.append(f"by the mapping of {', '.join(one.sources)}:")
        for payload in one.payloads:
            lines.append(f"  {payload['payload']}")
            for row in payload["readings"]:
                shown = row | {"turbine": row["turbine"] or "all"}
                lines.append("      {turbine}  {signal}  {time}  {value:.6g} {unit}".format_map(shown))
            for row in payload["rejections"]:
                used = "used" if row["kind"] == USED_THOUGH else "not used"
                lines.append(f"      {used}: {row['kind']}: {row['why']}")
        if one.count > len(one.payloads):
            lines.append(f"  … and {one.count - len(one.payloads)} more")
        unused = f"; not used: {one.rejected}" if one.rejected else ""
        lines.append(f"  {one.used} of {one.count} payloads gave readings{unused}")
    return "\n".join(map(one_line, lines))


def as_data(trials: Sequence[Trial]) -> JsonObject:
    """The same as JSON data."""
    return {"trials": [asdict(one) for one in trials]}
