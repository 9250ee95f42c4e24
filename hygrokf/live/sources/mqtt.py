"""MQTT 5: messages of a broker as a source, acknowledged when their batch is committed; alarms as retained messages.

The broker keeps the session: what is not acknowledged it delivers again, and the store knows what it already has.  Nothing
but alarms is ever published.
"""

from __future__ import annotations

import json
import logging
import queue
import random
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from collections.abc import Mapping as MappingOf
from dataclasses import asdict
from pathlib import Path

from hygrokf.live.reasons import unreached
from hygrokf.live.sources.broker import Broker, alarm_topic, broker_of
from hygrokf.live.sources.mqtt_link import Link, paho_fault, published
from hygrokf.live.sources.payload import Mapping
from hygrokf.live.sources.streams import SourceFault
from hygrokf.live.storage.store import Alarm
from hygrokf.live.table_reader import TableReader
from hygrokf.live.turbines import Delivery

LOG = logging.getLogger("hygrokf.track")
BACK_OFF_S = (1.0, 60.0)
"""[s] between attempts to connect, from the first to the longest; each is twice the one before."""
AGAIN_S = 60.0
"""[s] after which a filter that was denied is asked for again."""
LINGER_S = 10.0
"""[s] for which a stopped source waits for what it delivered to be committed."""


class Mqtt:
    """The messages of some topics of a broker; connects again for ever, with pauses that grow to a minute.

    The place in the store is the list of filters, so that a session forgets those that are no longer asked for.
    """

    def __init__(self, broker: Broker, mapping: Mapping) -> None:
        self.broker = broker
        self.url = broker.url
        self.mapping = mapping
        self._link: Link | None = None
        self._known = False
        self._reason = ""
        self._uncommitted = 0
        self._alarms: dict[str, tuple[bytes, object]] = {}
        self._lock = threading.Lock()
        self._ended, self._closing = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None
        self._state = ("idle", "not started")

    def start(self, place: str | None, put: Callable[[Delivery], None]) -> None:
        for caution in self.broker.cautions():
            LOG.warning(caution, extra={"source": self.url})
        self._state = ("waiting", f"connecting to {self.broker.where}")
        self._known = bool(place)
        former = [one for one in (place or "").split("\n") if one and one not in self.broker.topics]
        self._thread = threading.Thread(target=self._run, args=(former, put), name=self.url, daemon=True)
        self._thread.start()

    def acknowledge(self, deliveries: Iterable[Delivery]) -> None:
        count = 0
        for one in deliveries:
            link, identifier = one.token
            link.acknowledge(identifier)
            count += 1
        with self._lock:
            self._uncommitted -= count

    def now(self) -> float:
        """The time [s] that its data are judged by."""
        return time.time()

    def tell(self, alarms: Iterable[Alarm]) -> None:
        """Publish alarms as retained messages, each at its own topic, when there is a connection; later ones replace earlier."""
        if not self.broker.alarms:
            return
        with self._lock:
            for alarm in alarms:
                payload = json.dumps(asdict(alarm), ensure_ascii=False).encode()
                self._alarms[alarm_topic(self.broker.alarms, alarm)] = (payload, None)
            if self._link is not None:
                self._publish(self._link)

    def stop(self) -> None:
        """Deliver nothing more.  The connection ends when all that was delivered is acknowledged; the second time at once."""
        if self._ended.is_set() or not self._open_ends():
            self._closing.set()
        self._ended.set()
        if self._link is not None:
            self._link.arrived.put(None)
        if self._thread is not None and self._closing.is_set():
            self._thread.join(timeout=10.0)

    @property
    def state(self) -> tuple[str, str]:
        link = self._link
        if link is None or self._state[0] == "stopped":
            return self._state
        found = link.state
        # an attempt to connect again is no better news than the loss before it
        return ("lost", self._reason) if found[0] == "waiting" and self._reason else found

    # -- the source's own thread --------------------------------------------------------------------------------------
    def _run(self, former: Sequence[str], put: Callable[[Delivery], None]) -> None:
        pause, longest = BACK_OFF_S
        while not self._ended.is_set():
            began = time.monotonic()
            link = self._link = Link(self.broker, former, self._ready)
            try:
                link.open()
                self._hand_over(link, put)
            except SourceFault as fault:
                link.lose(str(fault))
            except Exception as fault:  # whatever it was: the next attempt may succeed
                link.lose(unreached(fault, self.broker.where))
            link.close()
            if self._ended.is_set():
                break
            if time.monotonic() - began > longest:
                pause, self._reason = BACK_OFF_S[0], ""
            if link.reason != self._reason:  # once, not at every attempt
                self._reason = link.reason
                LOG.warning("source lost", extra={"source": self.url, "reason": self._reason})
            # trackers that lost one broker together do not come back together
            self._ended.wait(pause * random.uniform(0.5, 1.0))
            pause = min(2.0 * pause, longest)
        self._state = ("stopped", "")

    def _hand_over(self, link: Link, put: Callable[[Delivery], None]) -> None:
        """Put what arrives until the link is lost or the source is told to end; `put` may wait as long as it likes.

        What arrived before the loss is put too: should the broker lose its session with it, nothing else has these messages.
        """
        place = "\n".join(self.broker.topics)
        again = time.monotonic() + AGAIN_S
        while not self._ended.is_set():
            try:
                found = link.arrived.get(timeout=1.0)
            except queue.Empty:
                found = ()
            if found is None:
                break
            if found:
                payload, topic, came, identifier = found
                with self._lock:
                    self._uncommitted += 1
                put(Delivery(payload, came, topic, place, (link, identifier)))
            if time.monotonic() > again:
                link.ask_again()
                again = time.monotonic() + AGAIN_S
        end = time.monotonic() + LINGER_S
        while (
            self._ended.is_set() and self._open_ends() and not link.lost.is_set() and time.monotonic() < end
        ):
            if self._closing.wait(0.02):
                break

    def _open_ends(self) -> bool:
        """Whether something that was delivered is not acknowledged, or an alarm that was told is not confirmed."""
        with self._lock:
            return self._uncommitted > 0 or not all(published(info) for _, info in self._alarms.values())

    # -- alarms -----------------------------------------------------------------------------------------------------
    def _ready(self, link: Link) -> None:
        """The broker has accepted the link: publish what former ones could not."""
        if self._known and not link.resumed:
            LOG.warning(
                "the broker has no session of this client_id any more: what came while it was away is lost",
                extra={"source": self.url},
            )
        self._known = True
        with self._lock:
            for topic, (payload, info) in self._alarms.items():
                if not published(info):
                    self._alarms[topic] = (payload, None)
            self._publish(link)

    def _publish(self, link: Link) -> None:
        """Publish what was told and not yet published; keep what is not confirmed.  Under the lock."""
        if not link.accepted or link.lost.is_set():
            return
        for topic, (payload, info) in list(self._alarms.items()):
            if info is None:
                self._alarms[topic] = (payload, link.publish(topic, payload))
            elif published(info):
                del self._alarms[topic]


# -- from the tracker's file -----------------------------------------------------------------------------------------
def mqtt_stream(
    table: MappingOf[str, object], where: str, folder: Path, mapping: Mapping, reader: TableReader
) -> Mqtt | None:
    """`mqtt://[USER@]HOST[:PORT]`, or `mqtts://` for TLS: docs/live_mqtt.md has all keys."""
    missing = paho_fault()
    if missing is not None:
        reader.faults.append(f"{where}: {missing}")
    broker = broker_of(table, where, folder, reader)
    return None if broker is None or missing else Mqtt(broker, mapping)
