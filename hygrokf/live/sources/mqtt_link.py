"""One connection to an MQTT 5 broker: its network thread, what the broker grants and denies, and why it was lost.

A lost link is never used again: an acknowledgement that comes late goes to the link that its message came by, and so
nowhere.  The broker then delivers that message again.
"""

from __future__ import annotations

import importlib
import logging
import math
import queue
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

from hygrokf.live.reasons import reason_words, tls_words
from hygrokf.live.sources.broker import Broker
from hygrokf.live.sources.mqtt_client import piecewise_client
from hygrokf.live.sources.payload import LARGEST

LOG = logging.getLogger("hygrokf.track")
KEEPALIVE_S = 30
"""[s] of silence after which each side looks whether the other one is there."""
OPEN_MOST = 500
"""Messages that the broker sends before one is acknowledged (MQTT's receive maximum)."""
UNCONFIRMED_MOST = 5_000
"""Messages of quality 0, which no receive maximum bounds, that wait for the tracker; more are dropped and counted."""
PACKET_MOST = 2**24
"""[bytes] of one packet that the broker may send.

Far above what a payload may be, as mosquitto 2.0.11 takes one of `OPEN_MOST` away for every packet that it holds back.
"""
REST_S = 0.02
"""[s] between two turns of the network thread: what comes meanwhile is taken at once, and the tracker has time of its own."""
CLOSING_S = 3.0
"""[s] for which a link that is closed may still send what it holds."""


class Link:
    """One connection to a broker, from its beginning to its loss.

    Its network thread only queues what arrives, so that keep-alives go out however long the tracker takes; the tracker takes
    from `arrived`: (payload, topic, arrival [s], packet identifier or None), and None where the link was lost.  `dropped`
    filters are those of former runs that the session is to forget; `ready` is called when the broker has accepted.
    """

    def __init__(self, broker: Broker, dropped: Sequence[str], ready: Callable[[Link], None]) -> None:
        self.broker = broker
        self.arrived: queue.SimpleQueue = queue.SimpleQueue()
        self.lost = threading.Event()
        self.reason = ""
        self.accepted = False
        self.resumed = False
        self.overrun = 0
        self._dropped = tuple(dropped)
        self._ready = ready
        self._asked: tuple[str, ...] = broker.topics
        self._granted = False
        self._denied: dict[str, str] = {}
        self._alarms_denied = ""
        self._heard = False
        self._until = math.inf
        self._last_words = _LastWords()
        self._thread: threading.Thread | None = None
        self.client = self._client()

    def _client(self) -> Any:
        from paho.mqtt.client import MQTTv5
        from paho.mqtt.enums import CallbackAPIVersion

        client = piecewise_client()(
            CallbackAPIVersion.VERSION2,
            client_id=self.broker.client_id,
            protocol=MQTTv5,
            manual_ack=True,
            reconnect_on_failure=False,
        )
        client.on_connect = self._on_connect
        client.on_subscribe = self._on_subscribe
        client.on_message = self._on_message
        client.on_publish = self._on_publish
        client.on_disconnect = self._on_disconnect
        # with it set only the network thread writes, whichever thread acknowledges or publishes
        client.on_socket_register_write = lambda *_: None
        logger = logging.Logger("paho", logging.ERROR)
        logger.addHandler(self._last_words)
        client.enable_logger(logger)
        return client

    # -- what the source does -------------------------------------------------------------------------------------
    def open(self) -> None:
        """Connect and begin to receive.  Raises SourceFault, OSError or ValueError where there is no connection."""
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        broker = self.broker
        if broker.user:
            self.client.username_pw_set(broker.user, broker.password())
        context = broker.context()
        if context is not None:
            self.client.tls_set_context(context)
        wanted = Properties(PacketTypes.CONNECT)
        wanted.SessionExpiryInterval = int(broker.expiry_s)
        wanted.ReceiveMaximum = OPEN_MOST
        wanted.MaximumPacketSize = PACKET_MOST
        self.client.connect(
            broker.host, broker.port, keepalive=KEEPALIVE_S, clean_start=False, properties=wanted
        )
        self._thread = threading.Thread(target=self._run, name=f"{broker.url} network", daemon=True)
        self._thread.start()

    def acknowledge(self, identifier: int | None) -> None:
        """Tell the broker that a message is committed; nothing where the link is lost.  From any thread."""
        if identifier is not None and not self.lost.is_set():
            self.client.ack(identifier, 1)

    def publish(self, topic: str, payload: bytes) -> Any:
        """Publish a retained message; what it gives is asked by `published`.  From any thread."""
        return self.client.publish(topic, payload, qos=1, retain=True)

    @property
    def answered(self) -> bool:
        """Whether the broker has said which filters it grants."""
        return self._granted

    @property
    def denied(self) -> dict[str, str]:
        """Filters that the broker denied, with the reason in words."""
        return dict(self._denied)

    def is_own(self, topic: str) -> bool:
        """Whether a topic is one that alarms are told at."""
        own = self.broker.alarms
        return bool(own) and (topic == own or topic.startswith(own + "/"))

    def ask_again(self) -> None:
        """Ask once more for the filters that were denied."""
        if self._denied and not self.lost.is_set():
            self._subscribe(tuple(self._denied))

    def close(self) -> None:
        """Send what is still to be sent, and end the connection; the session stays."""
        self._until = time.monotonic() + CLOSING_S
        self.client.disconnect()
        if self._thread is not None:
            self._thread.join(timeout=2.0 * CLOSING_S)

    @property
    def state(self) -> tuple[str, str]:
        where = self.broker.where
        if self.lost.is_set():
            return "lost", self.reason
        if self._denied:
            said = "; ".join(f"{one}: {words}" for one, words in self._denied.items())
            return "lost", f"{where} denies a subscription ({said}): give its user the right to read it"
        if not self._granted:
            return "waiting", f"connecting to {where}"
        said = f"connected to {where} as {self.broker.client_id}"
        if not self._heard:
            said += (
                "; nothing has come yet: where that lasts, check topics and rights, as a broker may grant a subscription "
                "and deliver nothing"
            )
        if self.overrun:
            said += f"; {self.overrun} messages of QoS 0 came faster than they are taken and were dropped: publish at QoS 1"
        if self._alarms_denied:
            said += f"; alarms below {self.broker.alarms} are not taken: {self._alarms_denied}"
        return "connected", said

    # -- the network thread -------------------------------------------------------------------------------------------
    def _run(self) -> None:
        words = ""
        try:
            while self.client.turn(1.0) and time.monotonic() < self._until:
                time.sleep(REST_S)
        except Exception as fault:
            # what a broker sends may be malformed in ways that paho does not name; the next link begins anew
            words = f"{self.broker.where}: {type(fault).__name__}: {fault}"
        finally:
            # a connection that did not end by itself: the broker must not send into it any more
            found = self.client.socket()
            if found is not None:
                with suppress(OSError):
                    found.close()
            self.lose(words or f"{self.broker.where}: the connection was lost")

    def lose(self, reason: str) -> None:
        """The link is lost; the first reason counts."""
        if not self.lost.is_set():
            self.reason = reason
            self.lost.set()
            self.arrived.put(None)

    def _subscribe(self, filters: tuple[str, ...]) -> None:
        from paho.mqtt.subscribeoptions import SubscribeOptions

        self._asked = filters
        # retained values come with a new subscription only, not again at every connection
        options = SubscribeOptions(qos=1, retainHandling=SubscribeOptions.RETAIN_SEND_IF_NEW_SUB)
        self.client.subscribe([(one, options) for one in filters])

    def _on_connect(self, client: Any, userdata: Any, flags: Any, reason_code: Any, properties: Any) -> None:
        if reason_code.is_failure:
            self.lose(f"{self.broker.where}: {reason_words(reason_code.value, str(reason_code))}")
            return
        self.accepted, self.resumed = True, flags.session_present
        kept = getattr(properties, "SessionExpiryInterval", None)
        if kept is not None and kept < int(self.broker.expiry_s):
            LOG.warning(
                "the broker keeps the session for less than was asked",
                extra={"source": self.broker.url, "asked_s": int(self.broker.expiry_s), "kept_s": kept},
            )
        if self._dropped and self.resumed:
            client.unsubscribe(list(self._dropped))
        self._subscribe(self.broker.topics)
        self._ready(self)

    def _on_subscribe(
        self, client: Any, userdata: Any, identifier: Any, reason_codes: Any, properties: Any
    ) -> None:
        for one, code in zip(self._asked, reason_codes, strict=False):
            if code.is_failure:
                self._denied[one] = reason_words(code.value, str(code))
            else:
                self._denied.pop(one, None)
        self._granted = True

    def _on_message(self, client: Any, userdata: Any, message: Any) -> None:
        identifier = message.mid if message.qos else None
        try:
            topic = message.topic
        except UnicodeDecodeError:
            topic = ""
        if self.is_own(topic):
            self.acknowledge(identifier)  # what a tracker told is never a reading
        elif identifier is None and self.arrived.qsize() >= UNCONFIRMED_MOST:
            self.overrun += 1
        else:
            self._heard = True
            # of what is too large one byte too many is kept: it is refused and counted with the other payloads
            self.arrived.put((bytes(message.payload[: LARGEST + 1]), topic, time.time(), identifier))

    def _on_publish(
        self, client: Any, userdata: Any, identifier: Any, reason_code: Any, properties: Any
    ) -> None:
        self._alarms_denied = (
            reason_words(reason_code.value, str(reason_code)) if reason_code.is_failure else ""
        )

    def _on_disconnect(
        self, client: Any, userdata: Any, flags: Any, reason_code: Any, properties: Any
    ) -> None:
        where = self.broker.where
        if flags.is_disconnect_packet_from_server:
            self.lose(f"{where}: {reason_words(reason_code.value, str(reason_code))}")
        elif (words := tls_words(self._last_words.text)) is not None:
            self.lose(f"{where}: {words}")
        elif not self.accepted:
            self.lose(
                f"{where}: the connection was closed before an answer came: is this the port of an MQTT broker, "
                f"and does it expect {'no TLS (mqtt://)' if self.broker.tls else 'TLS (mqtts://)'}?"
            )
        elif reason_code.getName() == "Keep alive timeout":
            self.lose(f"{where}: it has not answered for {KEEPALIVE_S} s")
        else:
            self.lose(
                f"{where}: the connection was lost; where this goes on, look for another process with the client_id "
                f"{self.broker.client_id}"
            )


class _LastWords(logging.Handler):
    """The last error that paho wrote to its log: the only place where it tells what went wrong with a socket."""

    text = ""

    def emit(self, record: logging.LogRecord) -> None:
        self.text = record.getMessage()


def published(info: Any) -> bool:
    """Whether the broker has confirmed what `Link.publish` sent."""
    try:
        return info is not None and info.is_published()
    except (ValueError, RuntimeError):
        return False  # it was not sent at all


def paho_fault() -> str | None:
    """What is to be installed before a link can be made, in words; None where all is there."""
    try:
        importlib.import_module("paho.mqtt.enums")  # version 2 has it
    except ImportError:
        return "MQTT needs paho-mqtt 2.1 or newer: pip install 'hygrokf[mqtt]'"
    return None
