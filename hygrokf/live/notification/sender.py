"""Sends a channel's notices, in a thread of its own over its own connection to the store.

The composition of a message is stored before its first attempt, so that every later one is the same and has
the same key.  A message counts as sent once the receiver has accepted it; until then it is tried again, at
intervals that grow.
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

from hygrokf.data.timestamps import DAY_S
from hygrokf.live.batch import Notice
from hygrokf.live.notification import notices
from hygrokf.live.notification.channel import Channel, ChannelFault, Content, NoticeMessage
from hygrokf.live.notification.notices import as_text, content_of, decide, prefix
from hygrokf.live.sources.stream import pause_s
from hygrokf.live.storage.store import Store, StoreFault, open_store
from hygrokf.texts.live import NoticeCode
from hygrokf.texts.statement import Statement

LOG = logging.getLogger("hygrokf.notify")
POLL_S = 1.0
"""[s] between two looks at the outbox."""
BACK_OFF_S = (2.0, 300.0)
"""Shortest and longest pause [s] after a failed attempt."""
MOST = 1_000
"""Largest number of notices read at once."""
TOGETHER = 100
"""Largest number of notices in one message."""
GIVE_UP_S = 7.0 * DAY_S
"""[s] after which a message that nobody accepts is dropped, with an error in the log."""
KEPT_S = 30.0 * DAY_S
"""[s] a notice is kept after it was sent or dropped."""
REFUSALS = 3
"""Messages refused one after the other from which the server counts as failing."""
STOP_S = 5.0
"""[s] a stopped sender has for what is due; an exchange in progress may take longer."""


class Sender:
    """Sends the notices of one channel until it is stopped.

    `record_now` gives the time [s] of the readings, against which shelves are judged.  `failures`: number of
    failed attempts; `failure`: why the last attempt failed, empty if it did not.
    """

    def __init__(self, channel: Channel, store_url: str, record_now: Callable[[], float] = time.time) -> None:
        self.channel = channel
        self.failures = 0
        self.failure = ""
        self._store_url = store_url
        self._record_now = record_now
        self._store: Store | None = None
        self._ending = threading.Event()
        self._thread: threading.Thread | None = None
        self._accepted: list[tuple[tuple[str, ...], float]] = []
        self._paused_until = 0.0
        self._end_by = math.inf
        self._refusals = 0
        self._next_tidy = 0.0
        self._store_fault = ""

    def start(self) -> None:
        """Begin to send."""
        for caution in self.channel.cautions():
            LOG.warning(caution.text, extra={"channel": self.channel.name})
        self._thread = threading.Thread(target=self._run, name=f"notify {self.channel.name}", daemon=True)
        self._thread.start()

    def end(self) -> None:
        """Send what is due once more, and end; what fails is sent after the next start."""
        self._end_by = time.monotonic() + STOP_S
        self._ending.set()

    def stop(self) -> None:
        """End, and wait for that."""
        self.end()
        if self._thread is not None:
            self._thread.join(timeout=2.0 * STOP_S)

    # -- the sender's own thread -----------------------------------------------------------------------------
    def _run(self) -> None:
        while True:
            last = self._ending.is_set()
            self._pass()
            if last:
                break
            self._ending.wait(POLL_S)
        self._close()

    def _pass(self) -> None:
        """Send what is due now; whatever goes wrong, the next pass tries again."""
        try:
            if self._store is None:
                self._store = open_store(self._store_url)
            self._mark_accepted(self._store)
            self.send_due(self._store)
            self._store_fault = ""
        except StoreFault as fault:
            if str(fault) != self._store_fault:
                LOG.warning("notices wait for the store", extra={"fault": str(fault).strip()})
            self._store_fault = str(fault)
            self._close()
        except Exception:  # of any kind: a thread that ends would be silent for ever
            LOG.exception("notices could not be sent", extra={"channel": self.channel.name})
            self._close()

    def _close(self) -> None:
        if self._store is not None:
            with suppress(Exception):
                self._store.close()
            self._store = None

    def send_due(self, store: Store) -> None:
        """Decide about the notices that are due, and attempt the messages."""
        now = time.time()
        if now >= self._next_tidy:
            notices.forget(store, now - KEPT_S)
            self._next_tidy = now + DAY_S
        if now < self._paused_until:
            return
        found = notices.due(store, self.channel.name, now, MOST)
        for message, made in self._messages(store, found, now):
            if now - made > GIVE_UP_S and message.attempts:
                self._give_up(store, message)
            elif time.monotonic() > self._end_by or not self._attempt(store, message):
                return

    def _messages(
        self, store: Store, found: Sequence[Notice], now: float
    ) -> list[tuple[NoticeMessage, float]]:
        """Messages to attempt now, each with the time [s] at which its first notice was made."""
        messages: dict[str, list[Notice]] = {}
        fresh: list[Notice] = []
        for one in found:
            key = content_of(one).message
            if key:
                messages.setdefault(key, []).append(one)
            else:
                fresh.append(one)
        if len(found) == MOST and len(messages) > 1:
            messages.popitem()  # it may be incomplete
        again = [
            (
                NoticeMessage(
                    key, {one.id: content_of(one) for one in rows}, max(one.attempts for one in rows)
                ),
                min(one.made for one in rows),
            )
            for key, rows in messages.items()
        ]
        new = [NoticeMessage.of(one) for one in self._collected(self._decided(store, fresh, now))]
        notices.keep_contents(store, [(name, as_text(one)) for m in new for name, one in m.contents.items()])
        return again + [(one, now) for one in new]

    def _decided(self, store: Store, fresh: Sequence[Notice], now: float) -> dict[str, Content]:
        if not fresh:
            return {}
        record_now = self._record_now()
        shelves = {(one.turbine, one.kind) for one in store.shelves(record_now)}
        sent: dict[str, Content] = {}
        dropped: list[tuple[str, Statement]] = []
        postponed: list[tuple[str, float]] = []
        for notice in fresh:
            alarm = content_of(notice).alarm
            others = notices.beginning_with(store, self.channel.name, prefix(self.channel.name, alarm.id))
            others = [one for one in others if one.id != notice.id]
            known, shelved = notices.alarm_of(store, alarm.id), (alarm.turbine, alarm.kind) in shelves
            outcome = decide(notice, self.channel, known, others, shelved, now, record_now)
            if isinstance(outcome, Content):
                sent[notice.id] = outcome
            elif isinstance(outcome, Statement):
                dropped.append((notice.id, outcome))
            else:
                postponed.append((notice.id, outcome))
        notices.drop(store, dropped, now)
        notices.postpone(store, postponed)
        return sent

    def _collected(self, contents: dict[str, Content]) -> list[dict[str, Content]]:
        """The contents of each message: urgent ones alone, the others of a digest together."""
        digest = {name: one for name, one in contents.items() if self.channel.collects(one.alarm)}
        names = list(digest)
        together = [names[i : i + TOGETHER] for i in range(0, len(names), TOGETHER)]
        return [{name: one} for name, one in contents.items() if name not in digest] + [
            {name: digest[name] for name in part} for part in together
        ]

    def _attempt(self, store: Store, message: NoticeMessage) -> bool:
        """Attempt a message; returns whether others should be attempted now.

        One that is refused does not hold up the others, but several in a row mean that the server fails.
        """
        names, now = tuple(message.contents), time.time()
        try:
            self.channel.send(message)
        except ChannelFault as fault:
            self.failures += 1
            if str(fault) != self.failure:  # log once, not at every attempt
                said = {"channel": self.channel.name, "reason": str(fault)}
                LOG.warning("a message was not sent", extra=said)
            self.failure = str(fault)
            again = time.time() + pause_s(message.attempts + 1, BACK_OFF_S)
            self._refusals += 1
            going_on = fault.reached and self._refusals < REFUSALS and not self._ending.is_set()
            if not going_on:
                self._paused_until = again
            notices.mark_failed(store, names, str(fault), again)
            return going_on
        self._refusals = 0
        self._accepted.append((names, now))
        if self.failure:
            LOG.info("notices pass again", extra={"channel": self.channel.name})
        self.failure = ""
        self._mark_accepted(store)
        return True

    def _mark_accepted(self, store: Store) -> None:
        """Mark accepted messages as sent; if the store fails, they stay in memory and are not sent again."""
        while self._accepted:
            names, at = self._accepted[0]
            notices.mark_sent(store, names, at)
            del self._accepted[0]

    def _give_up(self, store: Store, message: NoticeMessage) -> None:
        reason = NoticeCode.GIVEN_UP(attempts=message.attempts, failure=self.failure)
        notices.drop(store, [(name, reason) for name in message.contents], time.time())
        LOG.error(
            "a message was given up",
            extra={"channel": self.channel.name, "notices": len(message.contents), "reason": reason.text},
        )
