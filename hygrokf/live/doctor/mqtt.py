"""An MQTT broker as the tracker would find it: connection, rights, and what comes within a stated time.

It listens in a session of its own, which ends with it: the tracker's session is neither taken over nor read from.
"""

from __future__ import annotations

import queue
import secrets
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from hygrokf.live.doctor.check import Check, doubt, fault, lasting, ok
from hygrokf.live.doctor.clock import stamp_check
from hygrokf.live.doctor.files import SECRETS, validity_check
from hygrokf.live.payload_statistics import Tally
from hygrokf.live.reasons import unreached
from hygrokf.live.sources.broker import Broker
from hygrokf.live.sources.certificates import validity
from hygrokf.live.sources.mqtt_link import Link
from hygrokf.live.sources.payload import LARGEST, Mapping
from hygrokf.live.sources.streams import SourceFault

ANSWER_S = 10.0
"""[s] within which a broker accepts a client and says what it grants."""
REACH = "check url, user, password and certificates of this [[source]], and that the broker runs"
SILENT = "check topic, publisher and the rights of this user; wait longer (--wait 10min) for what is seldom published"


@dataclass
class Heard:
    """Messages under one filter: `live` ones, of these `unkept` that were published at QoS 0, and `retained` ones."""

    live: int = 0
    unkept: int = 0
    retained: int = 0


class Listener(Link):
    """A link that hands on each message as it is; acknowledged at once, as nobody else hears of this session."""

    def _on_message(self, client: Any, userdata: Any, message: Any) -> None:
        self.acknowledge(message.mid if message.qos else None)
        with suppress(UnicodeDecodeError):
            if not self.is_own(message.topic):
                self.arrived.put((message, time.time()))


def mqtt_checks(
    broker: Broker, mapping: Mapping, tally: Tally, wait_s: float, lateness_s: float
) -> Iterator[Check]:
    """Connect, subscribe and listen for `wait_s` [s]; what comes and is not retained goes into the tally as well."""
    about = f"source {broker.url}"
    for caution in broker.cautions():
        if not caution.startswith(SECRETS):  # files are looked at with all others
            yield doubt(about, *caution.split(": ", 1))
    link = Listener(listening(broker), (), lambda link: None)
    try:
        try:
            link.open()
        except SourceFault as error:
            link.lose(str(error))
        except Exception as error:  # whatever it was: it is told
            link.lose(unreached(error, broker.where))
        _answered(link)
        if link.lost.is_set() or not link.answered:
            found = link.reason or f"{broker.where} has not answered within {ANSWER_S:g} s"
            yield fault(about, found, REACH)
            return
        yield ok(
            about,
            f"connected{' by TLS' if broker.tls else ''}{f' as user {broker.user}' if broker.user else ''}",
        )
        yield from _certificate(link, about)
        retained = Tally(mapping)
        heard = _listened(link, tally, retained, wait_s)
        if link.lost.is_set():
            yield fault(about, f"the connection did not last: {link.reason}", REACH)
        denied = link.denied
    finally:
        link.close()
    for topics, one in heard.items():
        yield _filter_check(f"{about} {topics}", one, denied.get(topics), wait_s)
    if retained.payloads and not tally.payloads:
        yield from tally_checks(f"{about} retained messages", retained)
    yield from tally_checks(about, tally)
    late = stamp_check(about, tally.lag_s, lateness_s)
    if late is not None and not mapping.weather:
        yield late


def listening(broker: Broker) -> Broker:
    """The broker with a session of the doctor's own, which no longer exists when it is closed.

    A shared subscription is made a plain one: what it is dealt nobody else would get.
    """
    topics = tuple(dict.fromkeys(plain(one) for one in broker.topics))
    return replace(broker, client_id=f"hygrokf-doctor-{secrets.token_hex(4)}", expiry_s=0.0, topics=topics)


def plain(topics: str) -> str:
    """A filter without its share: FILTER of $share/GROUP/FILTER."""
    return topics.split("/", 2)[2] if topics.startswith("$share/") else topics


def _answered(link: Link) -> None:
    """Wait until the broker has said what it grants, or has sent the link away."""
    end = time.monotonic() + ANSWER_S
    while not (link.answered or link.lost.is_set()) and time.monotonic() < end:
        link.lost.wait(0.02)


def _certificate(link: Link, about: str) -> Iterator[Check]:
    """How long the certificate lasts that the broker has shown."""
    socket = link.client.socket()
    shown = socket.getpeercert(binary_form=True) if hasattr(socket, "getpeercert") else None
    if shown:
        yield validity_check(about, validity(shown), "the broker's certificate")


def _listened(link: Link, tally: Tally, retained: Tally, wait_s: float) -> dict[str, Heard]:
    """Take what comes for `wait_s` [s]: how much of it came under each filter."""
    from paho.mqtt.client import topic_matches_sub

    heard = {topics: Heard() for topics in link.broker.topics}
    end = time.monotonic() + wait_s
    while (left := end - time.monotonic()) > 0.0:
        with suppress(queue.Empty):
            found = link.arrived.get(timeout=left)
            if found is None:
                break
            message, came = found
            for topics, one in heard.items():
                if topic_matches_sub(topics, message.topic):
                    one.retained += message.retain
                    one.live += not message.retain
                    one.unkept += not message.retain and message.qos == 0
            (retained if message.retain else tally).take(
                bytes(message.payload[: LARGEST + 1]), came, message.topic
            )
    return heard


def _filter_check(about: str, one: Heard, denied: str | None, wait_s: float) -> Check:
    within = f"within {lasting(wait_s)}"
    if denied is not None:
        return fault(about, f"the broker denies it: {denied}", "give this user the right to read the topic")
    if one.live and one.unkept:
        return doubt(
            about,
            f"{one.live} messages {within}, {one.unkept} of them published at QoS 0, which nobody keeps while the tracker is away",
            "publish at QoS 1",
        )
    if one.live:
        return ok(about, f"granted; {one.live} messages {within}")
    if one.retained:
        return doubt(about, f"granted; nothing new {within}, only {one.retained} retained messages", SILENT)
    return doubt(about, f"granted, but nothing came {within}: a broker may grant and deliver nothing", SILENT)


def tally_checks(about: str, tally: Tally, what: str = "payloads") -> Iterator[Check]:
    """Whether payloads became readings; nothing where none came."""
    if not tally.payloads:
        return
    found = f"{tally.used} of {tally.payloads} {what} gave readings"
    if tally.aside:
        found += f"; set aside: {tally.aside}"
    remedy = "compare [mapping] and known_as of each [[turbine]] with what is delivered"
    if not tally.used:
        yield fault(about, found, remedy)
    elif tally.aside:
        yield doubt(about, found, remedy)
    else:
        yield ok(about, found)
