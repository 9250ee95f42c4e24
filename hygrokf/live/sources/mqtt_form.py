"""The [[source]] of an MQTT broker: payloads for the mapping, or Sparkplug B."""

from __future__ import annotations

import hashlib
import socket
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from hygrokf.data.timestamps import duration
from hygrokf.data.toml_form import Place, across, setting
from hygrokf.live.sources.broker import EXPIRY_S, Broker, filter_fault
from hygrokf.live.sources.endpoint import Address, PasswordKeys, address_of
from hygrokf.live.sources.mqtt import Mqtt
from hygrokf.live.sources.mqtt_link import libraries_fault
from hygrokf.live.sources.payload import PayloadMapping
from hygrokf.live.sources.sparkplug import Sparkplug
from hygrokf.live.sources.sparkplug_node import NAMESPACE
from hygrokf.live.sources.stream import SourceFault, SourceKeys

PORTS = {"mqtt": 1883, "mqtts": 8883}
"""Scheme of a URL -> default port."""
LEAST_EXPIRY_S, MOST_EXPIRY_S = 60.0, 2.0**32 - 2.0
LONGEST_NAME = 100
_TLS = ("ca", "certificate", "key")
_TOPICS = 'a list of topic filters such as ["scada/+/cabinet"]'
MAPPED, SPARKPLUG = "mapped", "sparkplug-b"
FORMATS = (MAPPED, SPARKPLUG)
"""Payloads that the mapping reads as they are, or messages of Sparkplug B."""


@dataclass(frozen=True)
class MqttForm(PasswordKeys, SourceKeys):
    """A [[source]] of `mqtt://[USER@]HOST[:PORT]`, or `mqtts://` for TLS."""

    url: str = setting(help="mqtt://[USER@]HOST[:PORT], or mqtts:// for TLS; never with a password")
    topics: tuple[str, ...] = setting((), "topic filters", expected=_TOPICS, empty=True)
    alarms: str = setting("", "topic below which alarms are published")
    client_id: str | None = setting(
        None,
        "name of the session at the broker",
        fits=lambda name: len(name) <= LONGEST_NAME and name.isprintable(),
        expected=f"text of 1 to {LONGEST_NAME} printable characters",
    )
    session_expiry_s: float = setting(
        EXPIRY_S,
        "for how long the broker keeps the session of an absent tracker",
        read=duration,
        least=LEAST_EXPIRY_S,
        most=MOST_EXPIRY_S,
        expected="1 min or more (and fit into 32 bits): for so long the broker keeps what comes while the "
        "tracker is away",
    )
    user: str | None = setting(None, "if it is not in the url", empty=True)
    ca: str = setting("", "certificates of the CAs to trust, PEM")
    certificate: str = setting("", "of this client, PEM")
    key: str = setting("", "of the certificate, PEM, without a passphrase")

    format: str = setting(MAPPED, "of the messages", choices=FORMATS)
    rebirth_requests: bool = setting(False, "whether edge nodes are asked for their birth certificates")

    @across("url")
    def url_form(self) -> str | None:
        return self.address.fault

    @across("topics")
    def filters(self) -> Iterator[str]:
        if not self.topics:
            yield f"topics must be {_TOPICS}, found none"
        for one in self.topics:
            if (wrong := filter_fault(one)) is not None:
                yield f"topics: {wrong}, found {one!r}"

    @across("alarms")
    def alarms_topic(self) -> str | None:
        wrong, own = filter_fault(self.alarms) if self.alarms else None, self.alarms
        if own.startswith(("$", "/")) or own.endswith("/") or "+" in own or "#" in own:
            wrong = (
                'expected a topic such as "hygrokf/alarms", without +, #, a $ or / in front and a / behind'
            )
        return None if wrong is None else f"alarms: {wrong}, found {self.alarms!r}"

    @across("user", "url")
    def one_user(self) -> str | None:
        if self.user is None or not self.address.user:
            return None
        return "user stands in the url and as a key: keep one"

    @across("password_file", "password_env", "user")
    def password_of_user(self) -> str | None:
        if not self.has_password or self.user or self.address.user:
            return None
        return "a password needs its user: add user, or mqtt://USER@HOST"

    @across(*_TLS)
    def tls(self) -> Iterator[str]:
        if not self.url.startswith("mqtts:") and (given := [key for key in _TLS if getattr(self, key)]):
            yield f"{', '.join(given)}: only with TLS; write mqtts:// or take this away"
        if bool(self.certificate) != bool(self.key):
            yield "certificate and key belong together: both, or neither"

    @across("format", "rebirth_requests")
    def requests_of_sparkplug(self) -> str | None:
        if self.format == SPARKPLUG or not self.rebirth_requests:
            return None
        return f'rebirth_requests: only with format = "{SPARKPLUG}"'

    @across("format", "weather")
    def readings_of_sparkplug(self) -> str | None:
        wrong = self.format == SPARKPLUG and self.weather
        return f'weather: not with format = "{SPARKPLUG}"' if wrong else None

    @across("format", "topics")
    def topics_of_sparkplug(self) -> Iterator[str]:
        for one in self.topics if self.format == SPARKPLUG else ():
            levels = one.split("/")
            if levels[0] == "$share":
                yield f"topics: a share has gaps in the sequence of every edge node, found {one!r}"
            elif levels[0] != NAMESPACE or ("#" not in levels[1:3] and levels[2:3] != ["+"]):
                yield (
                    f"topics: births, data and deaths are needed: write {NAMESPACE}/GROUP/# or "
                    f"{NAMESPACE}/GROUP/+/NODE/#, found {one!r}"
                )

    @property
    def address(self) -> Address:
        """The parts of the url."""
        return address_of(self.url, PORTS)

    def broker(self, folder: Path, place: Place) -> Broker:
        """The broker; secrets and certificates that cannot be read are faults.  Nothing is connected yet."""
        scheme, host, port, user, _, _ = self.address
        files = {name: getattr(self, name) for name in _TLS}
        broker = Broker(
            host,
            port,
            scheme == "mqtts",
            tuple(dict.fromkeys(self.topics)),
            self.client_id or default_client_id(f"{scheme}:{host}:{port}", folder),
            self.session_expiry_s,
            self.alarms,
            self.user or user,
            self.password(folder),
            **{name: folder / file if file else None for name, file in files.items()},
        )
        if not place.faults:
            for look in (broker.password.read, broker.context):
                try:
                    look()
                except SourceFault as fault:
                    place.fault(str(fault))
        return broker

    def stream(self, folder: Path, mapping: PayloadMapping, place: Place) -> Mqtt | None:
        """The stream, or None with faults."""
        missing = libraries_fault()
        if missing is not None:
            place.fault(missing)
        broker = self.broker(folder, place)
        if missing is not None:
            return None
        if self.format == SPARKPLUG:
            return Sparkplug(broker, mapping, self.rebirth_requests)
        return Mqtt(broker, mapping)


def default_client_id(broker: str, folder: Path) -> str:
    """`hygrokf-HOST-DIGEST`: stable across restarts on this machine, but different for each folder and
    broker."""
    host = "".join(c for c in socket.gethostname().partition(".")[0] if c.isalnum() and c.isascii())[:20]
    digest = hashlib.sha256(f"{broker} {folder.resolve()}".encode()).hexdigest()[:8]
    return f"hygrokf-{host}-{digest}"
