"""An MQTT 5 broker as a source: messages are acknowledged after their batch is committed; alarms are
published retained.

The broker keeps the session and repeats unacknowledged messages; the store recognises readings that it
already has.  This source publishes nothing but alarms.

A link is one connection to the broker; a lost link is never reused.  A late acknowledgement goes to the link
that delivered the message; if that link is lost, it has no effect, and the broker delivers the message again.
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
from hygrokf.live.sources.broker import Broker, alarm_topic, reason_text, tls_error_text, unreachable_text
from hygrokf.live.sources.payload import PayloadMapping
from hygrokf.live.sources.payload_formats import LARGEST_PAYLOAD, Content
from hygrokf.live.sources.stream import Delivery, SourceFault, SourceState, Stream

if TYPE_CHECKING:
    from paho.mqtt.client import Client, ConnectFlags, DisconnectFlags, MQTTMessage, MQTTMessageInfo
    from paho.mqtt.properties import Properties
    from paho.mqtt.reasoncodes import ReasonCode

LOG = logging.getLogger("hygrokf.track")
RESUBSCRIBE_S = 60.0
"""Time [s] after which the source subscribes to denied filters again."""
LINGER_S = 10.0
"""Longest time [s] that a stopped source waits for its deliveries to be committed."""


class Mqtt(Stream):
    """The messages of some topics of a broker; reconnects indefinitely, with pauses that grow to a minute.

    The place that the store keeps is the list of filters, so that after a change of the configuration the
    session is unsubscribed from the filters that were removed.
    """

    is_server = True
    largest = LARGEST_PAYLOAD
    """Largest payload [bytes]."""

    def __init__(self, broker: Broker, mapping: PayloadMapping) -> None:
        super().__init__(mapping)
        self.broker = broker
        self.url = broker.session_url
        self._place = "\n".join(broker.topics)
        self._link: BrokerLink | None = None
        self._had_session = False
        self._uncommitted = 0
        self._alarms: dict[str, tuple[bytes, MQTTMessageInfo | None]] = {}
        self._lock = threading.Lock()
        self._closing = threading.Event()

    def start(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        for caution in self.broker.cautions():
            LOG.warning(f"{caution.text}: {caution.remedy}", extra={"source": self.url})
        self._had_session = bool(place)
        super().start(place, put)

    def acknowledge(self, deliveries: Iterable[Delivery]) -> None:
        count = 0
        for delivery in deliveries:
            if delivery.acknowledge is not None:
                delivery.acknowledge()
            count += 1
        with self._lock:
            self._uncommitted -= count

    def tell(self, alarms: Iterable[Alarm]) -> None:
        """Publish each alarm as a retained message under its own topic, at once or when connected; a later
        state of an alarm replaces an earlier one."""
        if not self.broker.alarms:
            return
        with self._lock:
            for alarm in alarms:
                payload = json.dumps(alarm.served(), ensure_ascii=False).encode()
                self._alarms[alarm_topic(self.broker.alarms, alarm)] = (payload, None)
            if self._link is not None:
                self._publish(self._link)

    def stop(self) -> None:
        """Stop delivering; the connection ends when all deliveries are acknowledged, or at once at the second
        call."""
        if self._ended.is_set() or not self._has_pending():
            self._closing.set()
        self._ended.set()
        if self._link is not None:
            self._link.arrived.put(None)
        if self._thread is not None and self._closing.is_set():
            self._thread.join(timeout=10.0)

    @property
    def state(self) -> SourceState:
        link, source_state = self._link, self._state
        if link is None or source_state.word == "stopped":
            return source_state
        link_state = link.state
        # while reconnecting, keep reporting the loss and its reason
        return source_state if (source_state.word, link_state.word) == ("lost", "waiting") else link_state

    # -- the source's own thread -----------------------------------------------------------------------------
    def _deliver(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        former_filters = (place or "").split("\n")
        dropped = [name for name in former_filters if name and name not in self.broker.topics]
        link = self._link = BrokerLink(self.broker, self.largest, dropped, self._on_accepted)
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
        session and with it its own copies of these messages.
        """
        next_retry = time.monotonic() + RESUBSCRIBE_S
        while not self._ended.is_set():
            try:
                arrival = link.arrived.get(timeout=1.0)
            except queue.Empty:
                pass
            else:
                if arrival is None:
                    break
                self._take(link, arrival, put)
            self._do_periodic_work(link, put)
            if time.monotonic() > next_retry:
                link.retry_denied_filters()
                next_retry = time.monotonic() + RESUBSCRIBE_S
        end = time.monotonic() + LINGER_S
        while (
            self._ended.is_set() and self._has_pending() and not link.lost.is_set() and time.monotonic() < end
        ):
            if self._closing.wait(0.02):
                break

    def read(self, arrival: Arrival) -> Sequence[Content]:
        """The payloads of a message that another session, such as the doctor's, has received."""
        return [arrival.payload]

    def _take(self, link: BrokerLink, arrival: Arrival, put: Callable[[Delivery], None]) -> None:
        acknowledge = partial(link.acknowledge, arrival.identifier)
        self._put([arrival.payload], arrival.time, arrival.topic, acknowledge, put)

    def _do_periodic_work(self, link: BrokerLink, put: Callable[[Delivery], None]) -> None:
        """Called after every message and at least every second, for work that no message causes."""

    def _put(
        self,
        contents: Sequence[Content],
        received: float,
        topic: str,
        acknowledge: Callable[[], None] | None,
        put: Callable[[Delivery], None],
        memories: JsonObject | None = None,
    ) -> None:
        """Put the deliveries of a message; the last one carries the acknowledgement and the memories."""
        with self._lock:
            self._uncommitted += len(contents)
        for content in contents[:-1]:
            put(Delivery(content, received, topic, self._place))
        put(Delivery(contents[-1], received, topic, self._place, memories or {}, acknowledge))

    def _has_pending(self) -> bool:
        """Whether deliveries are not committed yet, or alarms not confirmed by the broker."""
        with self._lock:
            return self._uncommitted > 0 or not all(is_confirmed(info) for _, info in self._alarms.values())

    # -- alarms ----------------------------------------------------------------------------------------------
    def _on_accepted(self, link: BrokerLink) -> None:
        """Called when the broker has accepted the link: publish the alarms that former links could not."""
        if self._had_session and not link.resumed:
            LOG.warning(
                "the broker no longer has a session of this client_id: messages of the meantime are lost",
                extra={"source": self.url},
            )
        self._had_session = True
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
MOST_UNACKNOWLEDGED = 500
"""Largest number of unacknowledged messages (MQTT's receive maximum)."""
MOST_QUEUED_QOS_0 = 5_000
"""Largest number of queued QoS 0 messages, which the receive maximum does not limit; further messages are
dropped and counted."""
LARGEST_PACKET = 2**24
"""Largest packet [bytes] that the broker may send.

This limit is far above the largest payload, because for every packet that mosquitto 2.0.11 withholds as too
large, it permanently counts one more message as unacknowledged.
"""
REST_S = 0.02
"""Pause [s] of the network thread between two rounds of processing packets; the tracker runs meanwhile."""
CLOSING_S = 3.0
"""Time [s] in which a closing link may still send its pending packets."""
SOCKET_READ_SIZE = 65_536
"""Number of bytes requested per system call."""
TLS_RECORD_SIZE = 16_384
"""Largest number of bytes in a TLS record; a read from a TLS socket returns one record."""
PACKETS_PER_ROUND = 500
"""Largest number of packets processed before the network thread sends packets and checks the keep-alive."""


class Arrival(NamedTuple):
    """A received message.

    `time`: time of arrival [s]; `identifier`: packet identifier, None if the message needs no acknowledgement
    (QoS 0); `repeated`: the broker may have sent the message before; `retained`: the broker had kept the
    message and sends it for a new subscription.
    """

    payload: bytes
    topic: str
    time: float
    identifier: int | None
    repeated: bool = False
    retained: bool = False


class BrokerLink:
    """One connection to a broker, from its beginning to its loss.

    Its network thread only queues messages, so that it sends keep-alives in time however busy the tracker is.
    The tracker reads the messages from `arrived`, which ends with None when the link is lost.

    dropped: filters of former runs from which the session is unsubscribed. on_accepted: called when the
    broker has accepted the connection. largest: largest payload [bytes]; a longer one is cut off.

    `answered`: whether the broker has answered the subscription; `denied`: filter that the broker denied ->
    its reason; `overrun`: number of dropped messages of QoS 0.
    """

    def __init__(
        self,
        broker: Broker,
        largest: int = LARGEST_PAYLOAD,
        dropped: Sequence[str] = (),
        on_accepted: Callable[[BrokerLink], None] = lambda link: None,
    ) -> None:
        self.broker = broker
        self.arrived: queue.SimpleQueue[Arrival | None] = queue.SimpleQueue()
        self.lost = threading.Event()
        self.reason = ""
        self.accepted = False
        self.resumed = False
        self.overrun = 0
        self._dropped = tuple(dropped)
        self._on_accepted = on_accepted
        self._largest = largest
        self._requested_filters: tuple[str, ...] = broker.topics
        self.answered = False
        self.denied: dict[str, str] = {}
        self._alarms_denied = ""
        self._has_received = False
        self._close_by = math.inf
        self._last_error = _LastError()
        self._thread: threading.Thread | None = None
        self.client, self._process_packets = self._new_client()

    def _new_client(self) -> tuple[Client, Callable[[float], bool]]:
        """A client that is not connected yet, and its `process_packets`, which the network thread calls."""
        from paho.mqtt.client import MQTTv5
        from paho.mqtt.enums import CallbackAPIVersion

        piecewise_client = piecewise_client_class()(
            CallbackAPIVersion.VERSION2,
            client_id=self.broker.session,
            protocol=MQTTv5,
            manual_ack=True,
            reconnect_on_failure=False,
        )
        client: Client = piecewise_client
        client.on_connect = self._on_connect
        client.on_subscribe = self._on_subscribe
        client.on_message = self._on_message
        client.on_publish = self._on_publish
        client.on_disconnect = self._on_disconnect
        # with this callback set only the network thread writes, whichever thread acknowledges or publishes
        client.on_socket_register_write = lambda *_: None
        logger = logging.Logger("paho", logging.ERROR)
        logger.addHandler(self._last_error)
        client.enable_logger(logger)
        return client, piecewise_client.process_packets

    # -- called by the source --------------------------------------------------------------------------------
    def open(self) -> None:
        """Connect and start receiving; if the connection fails, the link is lost."""
        try:
            self._connect()
        except SourceFault as fault:
            self.lose(str(fault))
        except Exception as fault:  # whatever its type, the next attempt may succeed
            self.lose(unreachable_text(fault, self.broker.where))

    def _connect(self) -> None:
        from paho.mqtt.packettypes import PacketTypes
        from paho.mqtt.properties import Properties

        broker, address = self.broker, self.broker.address
        if broker.user_name:
            self.client.username_pw_set(broker.user_name, broker.password.read())
        context = broker.context()
        if context is not None:
            self.client.tls_set_context(context)
        requested = Properties(PacketTypes.CONNECT)
        requested.SessionExpiryInterval = int(broker.session_expiry_s)
        requested.ReceiveMaximum = MOST_UNACKNOWLEDGED
        requested.MaximumPacketSize = LARGEST_PACKET
        self.client.connect(
            address.host, address.port, keepalive=KEEPALIVE_S, clean_start=False, properties=requested
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

    def is_alarm_topic(self, topic: str) -> bool:
        """Whether the tracker itself publishes alarms under a topic."""
        prefix = self.broker.alarms
        return bool(prefix) and (topic == prefix or topic.startswith(prefix + "/"))

    def retry_denied_filters(self) -> None:
        """Subscribe again to the filters that the broker denied."""
        if self.denied and not self.lost.is_set():
            self._subscribe(tuple(self.denied))

    def close(self) -> None:
        """Send pending packets and end the connection; the broker keeps the session."""
        self._close_by = time.monotonic() + CLOSING_S
        self.client.disconnect()
        if self._thread is not None:
            self._thread.join(timeout=2.0 * CLOSING_S)

    @property
    def state(self) -> SourceState:
        where = self.broker.where
        if self.lost.is_set():
            return SourceState("lost", self.reason)
        if self.denied:
            reasons = "; ".join(f"{denied}: {reason}" for denied, reason in self.denied.items())
            text = f"{where} denies a subscription ({reasons}): give its user the right to read it"
            return SourceState("lost", text)
        if not self.answered:
            return SourceState("waiting", f"connecting to {where}")
        text = f"connected to {where} as {self.broker.session}"
        if not self._has_received:
            text += (
                "; no message has arrived yet: if this lasts, check topics and rights, because a broker may "
                "grant a subscription and deliver nothing"
            )
        if self.overrun:
            text += f"; {self.overrun} messages of QoS 0 arrived too fast and were dropped: publish at QoS 1"
        if self._alarms_denied:
            text += f"; the broker refuses alarms below {self.broker.alarms}: {self._alarms_denied}"
        return SourceState("connected", text)

    # -- the network thread ----------------------------------------------------------------------------------
    def _run(self) -> None:
        reason = ""
        try:
            while self._process_packets(1.0) and time.monotonic() < self._close_by:
                time.sleep(REST_S)
        except Exception as fault:
            # malformed packets can raise any exception in paho; the next link starts afresh
            reason = f"{self.broker.where}: {type(fault).__name__}: {fault}"
        finally:
            # close a connection that did not end by itself, so that the broker stops sending into it
            connection = self.client.socket()
            if connection is not None:
                with suppress(OSError):
                    connection.close()
            self.lose(reason or f"{self.broker.where}: the connection was lost")

    def lose(self, reason: str) -> None:
        """Mark the link as lost; the first reason is kept."""
        if not self.lost.is_set():
            self.reason = reason
            self.lost.set()
            self.arrived.put(None)

    def _subscribe(self, filters: tuple[str, ...]) -> None:
        from paho.mqtt.subscribeoptions import SubscribeOptions

        self._requested_filters = filters
        # the broker sends retained values for a new subscription only, not at every connection
        options = SubscribeOptions(qos=1, retainHandling=SubscribeOptions.RETAIN_SEND_IF_NEW_SUB)
        self.client.subscribe([(topic_filter, options) for topic_filter in filters])

    def _on_connect(
        self, client: Client, _: object, flags: ConnectFlags, code: ReasonCode, properties: Properties | None
    ) -> None:
        if code.is_failure:
            self.lose(f"{self.broker.where}: {reason_text(code)}")
            return
        self.accepted, self.resumed = True, flags.session_present
        granted_s = getattr(properties, "SessionExpiryInterval", None)
        requested_s = int(self.broker.session_expiry_s)
        if granted_s is not None and granted_s < requested_s:
            LOG.warning(
                "the broker keeps the session for less time than requested",
                extra={"source": self.broker.session_url, "requested_s": requested_s, "kept_s": granted_s},
            )
        if self._dropped and self.resumed:
            client.unsubscribe(list(self._dropped))
        self._subscribe(self.broker.topics)
        self._on_accepted(self)

    def _on_subscribe(
        self, client: Client, userdata: object, identifier: int, codes: Sequence[ReasonCode], *_: object
    ) -> None:
        for topic_filter, code in zip(self._requested_filters, codes, strict=False):
            if code.is_failure:
                self.denied[topic_filter] = reason_text(code)
            else:
                self.denied.pop(topic_filter, None)
        self.answered = True

    def _on_message(self, client: Client, userdata: object, message: MQTTMessage) -> None:
        identifier = message.mid if message.qos else None
        try:
            topic = message.topic
        except UnicodeDecodeError:
            topic = ""
        if self.is_alarm_topic(topic):
            self.acknowledge(identifier)  # the tracker's own alarms are not readings
        elif identifier is None and self.arrived.qsize() >= MOST_QUEUED_QOS_0:
            self.overrun += 1
        else:
            self._has_received = True
            # an oversized payload keeps one byte too many, so that the mapping refuses and counts it
            payload = bytes(message.payload[: self._largest + 1])
            self.arrived.put(Arrival(payload, topic, time.time(), identifier, message.dup, message.retain))

    def _on_publish(self, client: Client, _: object, identifier: int, code: ReasonCode, *__: object) -> None:
        self._alarms_denied = reason_text(code) if code.is_failure else ""

    def _on_disconnect(
        self, client: Client, userdata: object, flags: DisconnectFlags, code: ReasonCode, *_: object
    ) -> None:
        where = self.broker.where
        if flags.is_disconnect_packet_from_server:
            self.lose(f"{where}: {reason_text(code)}")
        elif (reason := tls_error_text(self._last_error.text)) is not None:
            self.lose(f"{where}: {reason}")
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


class _LastError(logging.Handler):
    """Keeps the last error in paho's log, the only place where paho reports socket errors."""

    text = ""

    def emit(self, record: logging.LogRecord) -> None:
        self.text = record.getMessage()


def is_confirmed(info: MQTTMessageInfo | None) -> bool:
    """Whether the broker has confirmed a message sent by `BrokerLink.publish`."""
    try:
        return info is not None and info.is_published()
    except (ValueError, RuntimeError):
        return False  # the message was never sent


def libraries_fault() -> str | None:
    """An error message if paho-mqtt or protobuf is missing or too old, else None."""
    try:
        importlib.import_module("paho.mqtt.enums")  # new in version 2
        importlib.import_module("google.protobuf")
    except ImportError:
        return "MQTT needs paho-mqtt 2.1 or newer, and protobuf: pip install 'hygrokf[mqtt]'"
    return None


# -- reading in large pieces ---------------------------------------------------------------------------------
@cache
def piecewise_client_class() -> type[Any]:
    """Class of paho's client with buffered reading; call its `process_packets` instead of `loop`.

    Each system call releases the interpreter lock to another thread and has to regain it afterwards.  Paho's
    client reads the first byte, the length and the rest of every packet separately; a busy tracker and such
    a client would therefore slow each other down.
    """
    from paho.mqtt.client import Client

    class PiecewiseClient(Client):
        _buffer, _position = b"", 0

        def process_packets(self, timeout: float) -> bool:
            """Wait up to `timeout` [s] for incoming or outgoing packets and process them; returns whether the
            connection still exists."""
            if self.loop(timeout if self._position == len(self._buffer) else 0.0) != 0:
                return False
            for _ in range(PACKETS_PER_ROUND):
                if self._position == len(self._buffer):
                    break
                if self.loop_read() != 0:
                    return False
            return True

        def _sock_recv(self, bufsize: int) -> bytes:
            if self._position == len(self._buffer):
                read = self._read_records if isinstance(self._sock, ssl.SSLSocket) else super()._sock_recv
                self._buffer, self._position = read(max(bufsize, SOCKET_READ_SIZE)), 0
            piece = self._buffer[self._position : self._position + bufsize]
            self._position += len(piece)
            return piece

        def _read_records(self, wanted: int) -> bytes:
            """Read TLS records until they contain at least `wanted` bytes or no record is left.

            A broker often sends each packet in a record of its own, so that reading one record would yield
            only one packet per round of the network thread.
            """
            records = [super()._sock_recv(TLS_RECORD_SIZE)]
            size = len(records[0])
            while records[-1] and size < wanted:
                try:
                    records.append(super()._sock_recv(TLS_RECORD_SIZE))
                except OSError:
                    break  # no record is left; the next read reports a lost connection again
                size += len(records[-1])
            return b"".join(records)

    return PiecewiseClient
