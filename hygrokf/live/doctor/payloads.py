"""Trial of payloads on the mappings of a tracker's file: the readings of each payload, or why it has none.

The payloads come from a file or, for some seconds, from a topic of a broker.  Nothing is written, and at the
broker the trial uses its own temporary session, so that the tracker's session keeps its messages.
"""

from __future__ import annotations

import gzip
import time
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, Any, cast

from hygrokf.data.signals import from_si, signal_named
from hygrokf.data.structured import JsonObject, plain
from hygrokf.live.doctor.sources import arrivals, doctor_session, listen
from hygrokf.live.sources.broker import filter_fault
from hygrokf.live.sources.local import Lines, TailedFile, contents
from hygrokf.live.sources.mqtt import Mqtt
from hygrokf.live.sources.payload import UNCERTAIN_QUALITY, PayloadMapping, PayloadStatistics
from hygrokf.live.sources.payload_formats import JSON, UNPACKED, Content, Unreadable, decoded
from hygrokf.live.sources.stream import Delivery, SourceFault, Stream
from hygrokf.live.tracker import Reading
from hygrokf.texts.statement import Statement
from hygrokf.texts.wording import one_line, stamp_text

MOST_SHOWN = 20
"""Largest number of payloads shown; further ones are only counted."""
MOST_READ = 10_000
"""Largest number of payloads read."""
MOST_VALUES = 40
"""Largest number of readings, and of rejections, shown for a payload."""
SHOWN_CHARACTERS = 100
"""Largest number of characters shown of a payload."""


@dataclass(frozen=True)
class Trial:
    """The result of reading payloads by the mapping that some `sources` share.

    `payloads`: the first payloads, each with its shortened text (`payload`), `readings` (turbine, signal,
    time in ISO 8601, value and unit) and `rejections` (turbine, kind and why).  `count`: number of all
    payloads; `used`: number of those that gave readings; `rejected`: the reasons of all rejections.
    """

    sources: tuple[str, ...]
    payloads: tuple[dict[str, Any], ...]
    count: int
    used: int
    rejected: tuple[Statement | str, ...]


# -- reading payloads ----------------------------------------------------------------------------------------
def try_payloads(streams: Sequence[Stream], what: str, wait_s: float) -> list[Trial]:
    """Try the payloads of a file, or those that arrive at a topic within `wait_s` [s].

    A source's own file is read by the mapping of that source, any other file by each mapping.  Raises
    SourceFault.
    """
    path = Path(what)
    if path.exists() or not any(isinstance(stream, Mqtt) for stream in streams):
        return _try_file(streams, path)
    if (fault := filter_fault(what)) is not None:
        raise SourceFault(f"expected a file or a topic; there is no file {what!r}, and {fault}")
    brokers = [stream for stream in streams if isinstance(stream, Mqtt)]
    return [
        read_trial((broker.url,), broker.mapping, topic_payloads(broker, what, wait_s)) for broker in brokers
    ]


def _try_file(streams: Sequence[Stream], path: Path) -> list[Trial]:
    readers = [s for s in streams if isinstance(s, TailedFile) and s.path.absolute() == path.absolute()]
    urls_of: list[tuple[PayloadMapping, list[str]]] = []
    for stream in readers or streams:
        urls = next((urls for mapping, urls in urls_of if mapping == stream.mapping), None)
        if urls is None:
            urls_of.append((stream.mapping, [stream.url]))
        else:
            urls.append(stream.url)
    try:
        return [read_trial(tuple(urls), mapping, file_payloads(path, mapping)) for mapping, urls in urls_of]
    except FileNotFoundError:
        raise SourceFault(f"{path}: no such file; a topic needs a [[source]] that is a broker") from None
    except (OSError, EOFError, zlib.error) as fault:
        raise SourceFault(f"{path}: cannot be read: {getattr(fault, 'strerror', None) or fault}") from None


def file_payloads(path: Path, mapping: PayloadMapping) -> Iterator[Delivery]:
    """The payloads of a file, which may be packed by gzip: one JSON text, or one payload or row per line.

    Where the mapping reads levels of the topic, each line is `TOPIC PAYLOAD`, as `mosquitto_sub -v` prints
    it.
    """
    now = time.time()
    with path.open("rb") as unpacked:
        is_packed = unpacked.read(2) == b"\x1f\x8b"
    file: IO[bytes]
    with cast(IO[bytes], gzip.open(path)) if is_packed else path.open("rb") as file:
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


def topic_payloads(source: Mqtt, topic: str, wait_s: float) -> Iterator[Delivery]:
    """The messages at a topic within `wait_s` [s], retained ones included.  Raises SourceFault."""
    session = replace(doctor_session(source.broker), topics=(topic,), alarms="")
    with listen(session, source.largest) as link:
        if link.lost.is_set() or not link.answered or link.denied:
            reason = link.reason or f"{source.broker.where} has not answered"
            raise SourceFault(f"{source.url}: {'; '.join(link.denied.values()) or reason}")
        for arrival in arrivals(link, wait_s):
            for content in source.read(arrival):
                yield Delivery(content, arrival.time, arrival.topic)
        if link.lost.is_set():
            raise SourceFault(f"{source.url}: {link.reason}")


# -- trial ---------------------------------------------------------------------------------------------------
def read_trial(sources: tuple[str, ...], mapping: PayloadMapping, payloads: Iterable[Delivery]) -> Trial:
    """Read payloads by a mapping."""
    statistics = PayloadStatistics(mapping)
    shown: list[dict[str, Any]] = []
    for delivery in payloads:
        parts = statistics.take(delivery.content, delivery.received, delivery.topic)
        if len(shown) < MOST_SHOWN:
            readings = [_reading_row(part.turbine, reading) for part in parts for reading in part.readings]
            rejections = [
                {"turbine": turbine, "kind": kind, "why": why}
                for turbine, _, refused in parts
                for kind, why in refused
            ]
            text = f"{delivery.topic} {_text(delivery.content)}".strip()
            values = {"readings": readings[:MOST_VALUES], "rejections": rejections[:MOST_VALUES]}
            shown.append({"payload": text, **values})
        if statistics.payloads == MOST_READ:
            break
    return Trial(sources, tuple(shown), statistics.payloads, statistics.used, statistics.rejected)


def _reading_row(turbine: str, reading: Reading) -> dict[str, Any]:
    row = signal_named(reading.signal)
    unit = row.display or row.unit
    value = float(from_si(reading.value, unit, reading.signal))
    return {
        "turbine": turbine, "signal": reading.signal, "time": stamp_text(reading.time), "value": value,
        "unit": unit,
    }  # fmt: skip


def _text(content: Content) -> str:
    if isinstance(content, Unreadable):
        return "(no payload)"
    if isinstance(content, Mapping):
        text = ", ".join(f"{name}={value}" for name, value in content.items())
    elif isinstance(content, bytes):
        text = (
            "(gzip)"
            if content[:2] == b"\x1f\x8b"
            else content[: 4 * SHOWN_CHARACTERS].decode("utf-8", "replace")
        )
    else:
        text = content
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[: SHOWN_CHARACTERS - 1]}…"


def trials_text(trials: Sequence[Trial]) -> str:
    """Each payload with its readings and rejections, and a summary for each mapping."""
    lines = []
    for trial in trials:
        lines.append(f"by the mapping of {', '.join(trial.sources)}:")
        for payload in trial.payloads:
            lines.append(f"  {payload['payload']}")
            for row in payload["readings"]:
                shown = row | {"turbine": row["turbine"] or "all"}
                lines.append("      {turbine}  {signal}  {time}  {value:.6g} {unit}".format_map(shown))
            for row in payload["rejections"]:
                used = "used" if row["kind"] == UNCERTAIN_QUALITY else "not used"
                lines.append(f"      {used}: {row['kind']}: {row['why']}")
        if trial.count > len(trial.payloads):
            lines.append(f"  … and {trial.count - len(trial.payloads)} more")
        unused = f"; not used: {', '.join(map(str, trial.rejected))}" if trial.rejected else ""
        lines.append(f"  {trial.used} of {trial.count} payloads gave readings{unused}")
    return "\n".join(map(one_line, lines))


def trials_data(trials: Sequence[Trial]) -> JsonObject:
    """The trials as JSON data."""
    return {"trials": plain(list(trials))}
