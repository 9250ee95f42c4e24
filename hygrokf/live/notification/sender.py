"""Sends a channel's notices in its own thread, over its own connection to the store.

The composition of a message is stored before its first attempt, so that every later attempt sends the same
message with the same key.  A message counts as sent once the receiver has accepted it; until then it is
repeated at increasing intervals.
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
from hygrokf.live.notification.notices import content_text, decide, id_prefix, notice_content
from hygrokf.live.sources.stream import pause_s
from hygrokf.live.storage.store import Store, StoreFault, open_store
from hygrokf.texts.live_codes import NoticeCode
from hygrokf.texts.statement import Statement

LOG = logging.getLogger("hygrokf.notify")
POLL_S = 1.0
"""[s] between two reads of the outbox."""
SENDER_BACK_OFF_S = (2.0, 300.0)
"""Shortest and longest pause [s] after a failed attempt."""
NOTICES_AT_ONCE = 1_000
"""Largest number of notices read at once."""
LARGEST_DIGEST = 100
"""Largest number of notices in one message."""
GIVE_UP_S = 7.0 * DAY_S
"""[s] after which a message that was never accepted is dropped, with an error in the log."""
NOTICE_KEPT_S = 30.0 * DAY_S
"""[s] for which a notice is kept after it was sent or dropped."""
REFUSALS = 3
"""Number of consecutive refusals from which on the server counts as failing."""
STOPPED_SENDING_S = 5.0
"""[s] for which a stopped sender still sends due notices; an exchange in progress may take longer."""


class Sender:
    """Sends the notices of one channel until it is stopped.

    `record_now` gives the time [s] of the readings, against which shelves are judged.  `failures`: number of
    failed attempts; `failure`: why the last attempt failed, "" if it succeeded.
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
        """Send the due notices once more and end; notices that fail are sent after the next start."""
        self._end_by = time.monotonic() + STOPPED_SENDING_S
        self._ending.set()

    def stop(self) -> None:
        """End the sender and wait for its thread."""
        self.end()
        if self._thread is not None:
            self._thread.join(timeout=2.0 * STOPPED_SENDING_S)

    # -- the sender's own thread -----------------------------------------------------------------------------
    def _run(self) -> None:
        while True:
            is_last = self._ending.is_set()
            self._pass()
            if is_last:
                break
            self._ending.wait(POLL_S)
        self._close()

    def _pass(self) -> None:
        """Send the notices that are due now; after any failure the next pass tries again."""
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
        except Exception:  # any exception, because a thread that ended would send nothing any more
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
            notices.forget(store, now - NOTICE_KEPT_S)
            self._next_tidy = now + DAY_S
        if now < self._paused_until:
            return
        due = notices.due(store, self.channel.name, now, NOTICES_AT_ONCE)
        for message, made in self._messages(store, due, now):
            if now - made > GIVE_UP_S and message.attempts:
                self._give_up(store, message)
            elif time.monotonic() > self._end_by or not self._attempt(store, message):
                return

    def _messages(self, store: Store, due: Sequence[Notice], now: float) -> list[tuple[NoticeMessage, float]]:
        """Messages to attempt now, each with the time [s] at which its first notice was made."""
        messages: dict[str, list[Notice]] = {}
        fresh: list[Notice] = []
        for notice in due:
            key = notice_content(notice).message
            if key:
                messages.setdefault(key, []).append(notice)
            else:
                fresh.append(notice)
        if len(due) == NOTICES_AT_ONCE and len(messages) > 1:
            messages.popitem()  # the last message may be incomplete
        repeated = [
            (
                NoticeMessage(
                    key,
                    {notice.id: notice_content(notice) for notice in group},
                    max(notice.attempts for notice in group),
                ),
                min(notice.made for notice in group),
            )
            for key, group in messages.items()
        ]
        new = [NoticeMessage.of(contents) for contents in self._group(self._decide(store, fresh, now))]
        notices.keep_contents(
            store, [(name, content_text(content)) for m in new for name, content in m.contents.items()]
        )
        return repeated + [(message, now) for message in new]

    def _decide(self, store: Store, fresh: Sequence[Notice], now: float) -> dict[str, Content]:
        """Decide about new notices; returns the contents to send now by id of the notice."""
        if not fresh:
            return {}
        record_now = self._record_now()
        shelves = {(shelf.turbine, shelf.kind) for shelf in store.shelves(record_now)}
        sent: dict[str, Content] = {}
        dropped: list[tuple[str, Statement]] = []
        postponed: list[tuple[str, float]] = []
        for notice in fresh:
            alarm = notice_content(notice).alarm
            about_alarm = notices.with_prefix(
                store, self.channel.name, id_prefix(self.channel.name, alarm.id)
            )
            others = [other for other in about_alarm if other.id != notice.id]
            stored, shelved = notices.alarm_of(store, alarm.id), (alarm.turbine, alarm.kind) in shelves
            outcome = decide(notice, self.channel, stored, others, shelved, now, record_now)
            if isinstance(outcome, Content):
                sent[notice.id] = outcome
            elif isinstance(outcome, Statement):
                dropped.append((notice.id, outcome))
            else:
                postponed.append((notice.id, outcome))
        notices.drop(store, dropped, now)
        notices.postpone(store, postponed)
        return sent

    def _group(self, contents: dict[str, Content]) -> list[dict[str, Content]]:
        """Group contents into messages: one message per urgent content, digests of the others."""
        digest = {name: c for name, c in contents.items() if self.channel.collects(c.alarm)}
        names = list(digest)
        digests = [names[i : i + LARGEST_DIGEST] for i in range(0, len(names), LARGEST_DIGEST)]
        return [{name: content} for name, content in contents.items() if name not in digest] + [
            {name: digest[name] for name in group} for group in digests
        ]

    def _attempt(self, store: Store, message: NoticeMessage) -> bool:
        """Attempt a message; returns whether other messages should be attempted now.

        A refused message does not delay the others, but several refusals in a row mean that the server fails.
        """
        names, now = tuple(message.contents), time.time()
        try:
            self.channel.send(message)
        except ChannelFault as fault:
            self.failures += 1
            if str(fault) != self.failure:  # log once, not at every attempt
                fields = {"channel": self.channel.name, "reason": str(fault)}
                LOG.warning("a message was not sent", extra=fields)
            self.failure = str(fault)
            due_s = time.time() + pause_s(message.attempts + 1, SENDER_BACK_OFF_S)
            self._refusals += 1
            continues = fault.reached and self._refusals < REFUSALS and not self._ending.is_set()
            if not continues:
                self._paused_until = due_s
            notices.mark_failed(store, names, str(fault), due_s)
            return continues
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
