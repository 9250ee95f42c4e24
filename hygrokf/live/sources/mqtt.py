"""An MQTT 5 broker as a source: messages are acknowledged after their batch is committed; alarms are
published retained.

The broker keeps the session and repeats unacknowledged messages; the store recognises readings that it
already has. This source publishes nothing but alarms.
"""

from __future__ import annotations

import json
import logging
import queue
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from functools import partial
from typing import TYPE_CHECKING

from hygrokf.data.structured import JsonObject
from hygrokf.live.batch import Alarm
from hygrokf.live.sources.broker import Broker, alarm_topic, unreachable
from hygrokf.live.sources.mqtt_link import Arrival, Link, is_confirmed
from hygrokf.live.sources.payload import PayloadMapping
from hygrokf.live.sources.payload_formats import LARGEST, Content
from hygrokf.live.sources.stream import Delivery, SourceFault, SourceState, Stream

if TYPE_CHECKING:
    from paho.mqtt.client import MQTTMessageInfo

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
        self._link: Link | None = None
        self._known = False
        self._uncommitted = 0
        self._alarms: dict[str, tuple[bytes, MQTTMessageInfo | None]] = {}
        self._lock = threading.Lock()
        self._closing = threading.Event()

    def start(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        for caution in self.broker.cautions():
            LOG.warning(caution, extra={"source": self.url})
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
                payload = json.dumps(asdict(alarm), ensure_ascii=False).encode()
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
        link = self._link = Link(self.broker, self.largest, former, self._ready)
        try:
            link.open()
            self._hand_over(link, put)
        except SourceFault as fault:
            link.lose(str(fault))
        except Exception as fault:  # of any kind: the next attempt may succeed
            link.lose(unreachable(fault, self.broker.where))
        link.close()
        if not self._ended.is_set():
            raise SourceFault(link.reason)

    def _hand_over(self, link: Link, put: Callable[[Delivery], None]) -> None:
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

    def _take(self, link: Link, found: Arrival, put: Callable[[Delivery], None]) -> None:
        self._put([found.payload], found.time, found.topic, partial(link.acknowledge, found.identifier), put)

    def _look_after(self, link: Link, put: Callable[[Delivery], None]) -> None:
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
    def _ready(self, link: Link) -> None:
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

    def _publish(self, link: Link) -> None:
        """Publish pending alarms and drop confirmed ones.  The caller holds the lock."""
        if not link.accepted or link.lost.is_set():
            return
        for topic, (payload, info) in list(self._alarms.items()):
            if info is None:
                self._alarms[topic] = (payload, link.publish(topic, payload))
            elif is_confirmed(info):
                del self._alarms[topic]
