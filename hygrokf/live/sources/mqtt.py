"""An MQTT 5 broker as a source: messages are acknowledged after their batch is committed; alarms are
published retained.

The broker keeps the session and repeats unacknowledged messages; the store recognises readings that it
already has. This source publishes nothing but alarms.

A lost link is never reused.  A late acknowledgement goes to the link that delivered the message, where it has
no effect, and the broker then delivers the message again.
"""

from __future__ import annotations

import importlib
import json
import logging
import math
import queue
import ssl
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import cache, partial
from typing import TYPE_CHECKING, Any, NamedTuple

from hygrokf.data.structured import JsonObject
from hygrokf.live.batch import Alarm
from hygrokf.live.sources.broker import Broker, alarm_topic, reason_words, tls_words, unreachable
from hygrokf.live.sources.payload import PayloadMapping
from hygrokf.live.sources.payload_formats import LARGEST, Content
from hygrokf.live.sources.stream import Delivery, SourceFault, SourceState, Stream

if TYPE_CHECKING:
    from paho.mqtt.client import Client, ConnectFlags, DisconnectFlags, MQTTMessage, MQTTMessageInfo
    from paho.mqtt.properties import Properties
    from paho.mqtt.reasoncodes import ReasonCode

LOG = logging.getLogger("hygrokf.track")
AGAIN_S = 60.0
"""[s] after which a denied filter is requested again."""
LINGER_S = 10.0
"""[s] a stopped source waits for its deliveries to be committed."""


class Mqtt(Stream):
    """The messages of some topics of a broker; reconnects indefinitely, with pauses that grow to a minute.

    The place in the store is the list of filters, so that the session can be unsubscribed from filters no
    longer wanted.
    """

    is_server = True
    largest = LARGEST
    """Largest payload [bytes]."""

    def __init__(self, broker: Broker, mapping: PayloadMapping) -> None:
        super().__init__(mapping)
        self.broker = broker
        self.url = broker.session_url
        self._place = "\n".join(broker.topics)
        self._link: BrokerLink | None = None
        self._known = False
        self._uncommitted = 0
        self._alarms: dict[str, tuple[bytes, MQTTMessageInfo | None]] = {}
        self._lock = threading.Lock()
        self._closing = threading.Event()

    def start(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        for caution in self.broker.cautions():
            LOG.warning(f"{caution.text}: {caution.remedy}", extra={"source": self.url})
        self._known = bool(place)
        super().start(place, put)

    def acknowledge(self, deliveries: Iterable[Delivery]) -> None:
        count = 0
        for one in deliveries:
            if one.acknowledge is not None:
                one.acknowledge()
            count += 1
        with self._lock:
            self._uncommitted -= count

    def tell(self, alarms: Iterable[Alarm]) -> None:
        """Publish each alarm as a retained message at its own topic, now or once connected; later states
        replace earlier ones."""
        if not self.broker.alarms:
            return
        with self._lock:
            for alarm in alarms:
                payload = json.dumps(alarm.served(), ensure_ascii=False).encode()
                self._alarms[alarm_topic(self.broker.alarms, alarm)] = (payload, None)
            if self._link is not None:
                self._publish(self._link)

    def stop(self) -> None:
        """Stop delivering; the connection ends once all deliveries are acknowledged, or at once on the second
        call."""
        if self._ended.is_set() or not self._open_ends():
            self._closing.set()
        self._ended.set()
        if self._link is not None:
            self._link.arrived.put(None)
        if self._thread is not None and self._closing.is_set():
            self._thread.join(timeout=10.0)

    @property
    def state(self) -> SourceState:
        link, own = self._link, self._state
        if link is None or own.word == "stopped":
            return own
        found = link.state
        # while reconnecting, keep reporting the loss and its reason
        return own if found.word == "waiting" and own.word == "lost" else found

    # -- the source's own thread -----------------------------------------------------------------------------
    def _deliver(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        former = [one for one in (place or "").split("\n") if one and one not in self.broker.topics]
        link = self._link = BrokerLink(self.broker, self.largest, former, self._ready)
        try:
            link.open()
            self._hand_over(link, put)
        finally:
            link.close()
        if not self._ended.is_set():
            raise SourceFault(link.reason)

    def _hand_over(self, link: BrokerLink, put: Callable[[Delivery], None]) -> None:
        """Hand over messages until the link is lost or the source is told to stop; `put` may block.

        Messages that arrived before the loss are handed over too, because the broker may have lost the
        session and with it its own copies.
        """
        again = time.monotonic() + AGAIN_S
        while not self._ended.is_set():
            try:
                found = link.arrived.get(timeout=1.0)
            except queue.Empty:
                pass
            else:
                if found is None:
                    break
                self._take(link, found, put)
            self._look_after(link, put)
            if time.monotonic() > again:
                link.ask_again()
                again = time.monotonic() + AGAIN_S
        end = time.monotonic() + LINGER_S
        while (
            self._ended.is_set() and self._open_ends() and not link.lost.is_set() and time.monotonic() < end
        ):
            if self._closing.wait(0.02):
                break

    def read(self, arrival: Arrival) -> Sequence[Content]:
        """The payloads of a message that another session hears."""
        return [arrival.payload]

    def _take(self, link: BrokerLink, found: Arrival, put: Callable[[Delivery], None]) -> None:
        self._put([found.payload], found.time, found.topic, partial(link.acknowledge, found.identifier), put)

    def _look_after(self, link: BrokerLink, put: Callable[[Delivery], None]) -> None:
        """Does what is due without a message, at least every second: nothing here."""

    def _put(
        self,
        contents: Sequence[Content],
        received: float,
        topic: str,
        acknowledge: Callable[[], None] | None,
        put: Callable[[Delivery], None],
        memories: JsonObject | None = None,
    ) -> None:
        """Put the deliveries of a message; with its last one it is acknowledged, and the data are kept."""
        with self._lock:
            self._uncommitted += len(contents)
        for content in contents[:-1]:
            put(Delivery(content, received, topic, self._place))
        put(Delivery(contents[-1], received, topic, self._place, memories or {}, acknowledge))

    def _open_ends(self) -> bool:
        with self._lock:
            return self._uncommitted > 0 or not all(is_confirmed(info) for _, info in self._alarms.values())

    # -- alarms ----------------------------------------------------------------------------------------------
    def _ready(self, link: BrokerLink) -> None:
        """Called when the broker has accepted the link: publish the alarms that former links could not."""
        if self._known and not link.resumed:
            LOG.warning(
                "the broker no longer has a session of this client_id: messages of the meantime are lost",
                extra={"source": self.url},
            )
        self._known = True
        with self._lock:
            for topic, (payload, info) in self._alarms.items():
                if not is_confirmed(info):
                    self._alarms[topic] = (payload, None)
            self._publish(link)

    def _publish(self, link: BrokerLink) -> None:
        """Publish pending alarms and drop confirmed ones.  The caller holds the lock."""
        if not link.accepted or link.lost.is_set():
            return
        for topic, (payload, info) in list(self._alarms.items()):
            if info is None:
                self._alarms[topic] = (payload, link.publish(topic, payload))
            elif is_confirmed(info):
                del self._alarms[topic]


# -- one connection ------------------------------------------------------------------------------------------
KEEPALIVE_S = 30
"""[s] of silence after which each side checks the connection (MQTT's keep-alive)."""
OPEN_MOST = 500
"""Largest number of unacknowledged messages (MQTT's receive maximum)."""
UNCONFIRMED_MOST = 5_000
"""Largest number of waiting QoS 0 messages, which the receive maximum does not limit; more are dropped and
counted."""
PACKET_MOST = 2**24
"""Largest packet [bytes] that the broker may send.

It is far above the largest payload, because mosquitto 2.0.11 loses one of the `OPEN_MOST` places for every
packet that it withholds as too large.
"""
REST_S = 0.02
"""[s] between two turns of the network thread, which then takes all packets at once and leaves the tracker
time to run."""
CLOSING_S = 3.0
"""[s] a closing link may still send its pending packets."""
AT_ONCE = 65_536
"""[bytes] requested per system call."""
RECORD = 16_384
"""[bytes] that one TLS record carries at most; a read from a TLS socket returns one record."""
MOST = 500
"""Packets processed before sending and keep-alive get their turn."""


class Arrival(NamedTuple):
    """A received message, its arrival `time` [s] and its packet `identifier`, None if it needs no
    acknowledgement (QoS 0); `repeated`: the broker may have sent it before; `retained`: it sends what it had
    kept."""

    payload: bytes
    topic: str
    time: float
    identifier: int | None
    repeated: bool = False
    retained: bool = False


class BrokerLink:
    """One connection to a broker, from its beginning to its loss.

    Its network thread only queues messages, so that keep-alives go out however long the tracker takes.  The
    tracker reads them from `arrived`, which ends with None once the link is lost.  `dropped`: filters of
    former runs from which the session is unsubscribed; `ready` is called when the broker has accepted the
    connection; `largest`: payload [bytes] from which the rest is cut off.  `answered`: whether the broker has
    answered the subscription; `denied`: filters that it denied, with the reason.
    """

    def __init__(
        self,
        broker: Broker,
        largest: int = LARGEST,
        dropped: Sequence[str] = (),
        ready: Callable[[BrokerLink], None] = lambda link: None,
    ) -> None:
        self.broker = broker
        self.arrived: queue.SimpleQueue[Arrival | None] = queue.SimpleQueue()
        self.lost = threading.Event()
        self.reason = ""
        self.accepted = False
        self.resumed = False
        self.overrun = 0
        self._dropped = tuple(dropped)
        self._ready = ready
        self._largest = largest
        self._asked: tuple[str, ...] = broker.topics
        self.answered = False
        self.denied: dict[str, str] = {}
        self._alarms_denied = ""
        self._heard = False
        self._until = math.inf
        self._last_words = _LastWords()
        self._thread: threading.Thread | None = None
        self.client, self._turn = self._client()

    def _client(self) -> tuple[Client, Callable[[float], bool]]:
        """A client that is not connected yet, and its `turn`, which the network thread calls."""
        from paho.mqtt.client import MQTTv5
        from paho.mqtt.enums import CallbackAPIVersion

        made = piecewise_client()(
            CallbackAPIVersion.VERSION2,
            client_id=self.broker.session,
            protocol=MQTTv5,
            manual_ack=True,
            reconnect_on_failure=False,
        )
        client: Client = made
        client.on_connect = self._on_connect
        client.on_subscribe = self._on_subscribe
        client.on_message = self._on_message
        client.on_publish = self._on_publish
        client.on_disconnect = self._on_disconnect
        # with this callback set only the network thread writes, whichever thread acknowledges or publishes
        client.on_socket_register_write = lambda *_: None
        logger = logging.Logger("paho", logging.ERROR)
        logger.addHandler(self._last_words)
        client.enable_logger(logger)
        return client, made.turn

    # -- called by the source --------------------------------------------------------------------------------
    def open(self) -> None:
        """Connect and start receiving; a link that cannot be made is lost."""
        try:
            self._connect()
        except SourceFault as fault:
            self.lose(str(fault))
        except Exception as fault:  # of any kind: the next attempt may succeed
            self.lose(unreachable(fault, self.broker.where))

    def _connect(self) -> None:
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        broker, address = self.broker, self.broker.address
        if broker.user_name:
            self.client.username_pw_set(broker.user_name, broker.password.read())
        context = broker.context()
        if context is not None:
            self.client.tls_set_context(context)
        wanted = Properties(PacketTypes.CONNECT)
        wanted.SessionExpiryInterval = int(broker.session_expiry_s)
        wanted.ReceiveMaximum = OPEN_MOST
        wanted.MaximumPacketSize = PACKET_MOST
        self.client.connect(
            address.host, address.port, keepalive=KEEPALIVE_S, clean_start=False, properties=wanted
        )
        self._thread = threading.Thread(target=self._run, name=f"{broker.session_url} network", daemon=True)
        self._thread.start()

    def acknowledge(self, identifier: int | None) -> None:
        """Acknowledge a committed message to the broker, unless the link is lost.  Callable from any
        thread."""
        if identifier is not None and not self.lost.is_set():
            self.client.ack(identifier, 1)

    def publish(self, topic: str, payload: bytes) -> MQTTMessageInfo:
        """Publish a retained message; see `is_confirmed`.  Callable from any thread."""
        return self.client.publish(topic, payload, qos=1, retain=True)

    def request(self, topic: str, payload: bytes) -> None:
        """Publish a message at QoS 0 that is not retained.  Callable from any thread."""
        self.client.publish(topic, payload)

    def is_own(self, topic: str) -> bool:
        """Whether a topic is one to which the tracker publishes alarms."""
        own = self.broker.alarms
        return bool(own) and (topic == own or topic.startswith(own + "/"))

    def ask_again(self) -> None:
        """Subscribe once more to the denied filters."""
        if self.denied and not self.lost.is_set():
            self._subscribe(tuple(self.denied))

    def close(self) -> None:
        """Send pending packets and end the connection; the broker keeps the session."""
        self._until = time.monotonic() + CLOSING_S
        self.client.disconnect()
        if self._thread is not None:
            self._thread.join(timeout=2.0 * CLOSING_S)

    @property
    def state(self) -> SourceState:
        where = self.broker.where
        if self.lost.is_set():
            return SourceState("lost", self.reason)
        if self.denied:
            said = "; ".join(f"{one}: {words}" for one, words in self.denied.items())
            words = f"{where} denies a subscription ({said}): give its user the right to read it"
            return SourceState("lost", words)
        if not self.answered:
            return SourceState("waiting", f"connecting to {where}")
        said = f"connected to {where} as {self.broker.session}"
        if not self._heard:
            said += (
                "; no message has arrived yet: if this lasts, check topics and rights, because a broker may "
                "grant a subscription and deliver nothing"
            )
        if self.overrun:
            said += f"; {self.overrun} messages of QoS 0 arrived too fast and were dropped: publish at QoS 1"
        if self._alarms_denied:
            said += f"; the broker refuses alarms below {self.broker.alarms}: {self._alarms_denied}"
        return SourceState("connected", said)

    # -- the network thread ----------------------------------------------------------------------------------
    def _run(self) -> None:
        words = ""
        try:
            while self._turn(1.0) and time.monotonic() < self._until:
                time.sleep(REST_S)
        except Exception as fault:
            # malformed packets can raise any exception in paho; the next link starts afresh
            words = f"{self.broker.where}: {type(fault).__name__}: {fault}"
        finally:
            # close a connection that did not end by itself, so that the broker stops sending into it
            found = self.client.socket()
            if found is not None:
                with suppress(OSError):
                    found.close()
            self.lose(words or f"{self.broker.where}: the connection was lost")

    def lose(self, reason: str) -> None:
        """Mark the link as lost; the first reason is kept."""
        if not self.lost.is_set():
            self.reason = reason
            self.lost.set()
            self.arrived.put(None)

    def _subscribe(self, filters: tuple[str, ...]) -> None:
        from paho.mqtt.subscribeoptions import SubscribeOptions

        self._asked = filters
        # the broker sends retained values for a new subscription only, not at every connection
        options = SubscribeOptions(qos=1, retainHandling=SubscribeOptions.RETAIN_SEND_IF_NEW_SUB)
        self.client.subscribe([(one, options) for one in filters])

    def _on_connect(
        self, client: Client, _: object, flags: ConnectFlags, code: ReasonCode, properties: Properties | None
    ) -> None:
        if code.is_failure:
            self.lose(f"{self.broker.where}: {reason_words(code)}")
            return
        self.accepted, self.resumed = True, flags.session_present
        kept, asked = getattr(properties, "SessionExpiryInterval", None), int(self.broker.session_expiry_s)
        if kept is not None and kept < asked:
            LOG.warning(
                "the broker keeps the session for less time than requested",
                extra={"source": self.broker.session_url, "requested_s": asked, "kept_s": kept},
            )
        if self._dropped and self.resumed:
            client.unsubscribe(list(self._dropped))
        self._subscribe(self.broker.topics)
        self._ready(self)

    def _on_subscribe(
        self, client: Client, userdata: object, identifier: int, codes: Sequence[ReasonCode], *_: object
    ) -> None:
        for one, code in zip(self._asked, codes, strict=False):
            if code.is_failure:
                self.denied[one] = reason_words(code)
            else:
                self.denied.pop(one, None)
        self.answered = True

    def _on_message(self, client: Client, userdata: object, message: MQTTMessage) -> None:
        identifier = message.mid if message.qos else None
        try:
            topic = message.topic
        except UnicodeDecodeError:
            topic = ""
        if self.is_own(topic):
            self.acknowledge(identifier)  # the tracker's own alarms are not readings
        elif identifier is None and self.arrived.qsize() >= UNCONFIRMED_MOST:
            self.overrun += 1
        else:
            self._heard = True
            # an oversized payload keeps one byte too many, so that it is refused and counted with the others
            payload = bytes(message.payload[: self._largest + 1])
            self.arrived.put(Arrival(payload, topic, time.time(), identifier, message.dup, message.retain))

    def _on_publish(self, client: Client, _: object, identifier: int, code: ReasonCode, *__: object) -> None:
        self._alarms_denied = reason_words(code) if code.is_failure else ""

    def _on_disconnect(
        self, client: Client, userdata: object, flags: DisconnectFlags, code: ReasonCode, *_: object
    ) -> None:
        where = self.broker.where
        if flags.is_disconnect_packet_from_server:
            self.lose(f"{where}: {reason_words(code)}")
        elif (words := tls_words(self._last_words.text)) is not None:
            self.lose(f"{where}: {words}")
        elif not self.accepted:
            self.lose(
                f"{where}: the connection was closed before the broker answered: is this the port of an MQTT "
                f"broker, and does it expect {'no TLS (mqtt://)' if self.broker.tls else 'TLS (mqtts://)'}?"
            )
        elif code.getName() == "Keep alive timeout":
            self.lose(f"{where}: it has not answered for {KEEPALIVE_S} s")
        else:
            self.lose(
                f"{where}: the connection was lost; if this repeats, look for another process with the "
                f"client_id {self.broker.session}"
            )


class _LastWords(logging.Handler):
    """Keeps the last error in paho's log, the only place where paho reports socket errors."""

    text = ""

    def emit(self, record: logging.LogRecord) -> None:
        self.text = record.getMessage()


def is_confirmed(info: MQTTMessageInfo | None) -> bool:
    """Whether the broker has confirmed a message sent by `BrokerLink.publish`."""
    try:
        return info is not None and info.is_published()
    except (ValueError, RuntimeError):
        return False  # the message was not sent at all


def libraries_fault() -> str | None:
    """An error message if paho-mqtt or protobuf is missing or too old, else None."""
    try:
        importlib.import_module("paho.mqtt.enums")  # version 2 has it
        importlib.import_module("google.protobuf")
    except ImportError:
        return "MQTT needs paho-mqtt 2.1 or newer, and protobuf: pip install 'hygrokf[mqtt]'"
    return None


# -- reading in large pieces ---------------------------------------------------------------------------------
@cache
def piecewise_client() -> type[Any]:
    """The client class: paho's own with buffered reading; call its `turn` instead of `loop`.

    Each system call releases the interpreter lock to another thread and has to regain it afterwards.  A
    client that reads every packet's first byte, length and rest separately therefore slows down a busy
    tracker and waits for it.
    """
    from paho.mqtt.client import Client

    class PiecewiseClient(Client):
        _held, _place = b"", 0

        def turn(self, timeout: float) -> bool:
            """Wait for incoming or outgoing packets and process them; returns whether the connection still
            stands."""
            if self.loop(timeout if self._place == len(self._held) else 0.0) != 0:
                return False
            for _ in range(MOST):
                if self._place == len(self._held):
                    break
                if self.loop_read() != 0:
                    return False
            return True

        def _sock_recv(self, bufsize: int) -> bytes:
            if self._place == len(self._held):
                read = self._records if isinstance(self._sock, ssl.SSLSocket) else super()._sock_recv
                self._held, self._place = read(max(bufsize, AT_ONCE)), 0
            found = self._held[self._place : self._place + bufsize]
            self._place += len(found)
            return found

        def _records(self, wanted: int) -> bytes:
            """Read TLS records until they amount to `wanted` bytes or none is left.

            A broker often sends each packet in a record of its own, so that a single read would yield a
            single packet per turn of the network thread.
            """
            found = [super()._sock_recv(RECORD)]
            size = len(found[0])
            while found[-1] and size < wanted:
                try:
                    found.append(super()._sock_recv(RECORD))
                except OSError:
                    break  # no record is left; the next read meets a lost connection again
                size += len(found[-1])
            return b"".join(found)

    return PiecewiseClient
