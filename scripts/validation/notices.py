"""Whether notices are lost or doubled while their receiver fails: docs/validation/live_guarantees.md."""

from __future__ import annotations

import base64
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from builders.receivers import FAILURES, MailServer, WebhookServer
from builders.store_case import queried
from builders.waiting import eventually

from hygrokf.live.batch import Alarm, Batch
from hygrokf.live.notification import sender as sending
from hygrokf.live.notification.notices import channel_states, notices_of
from hygrokf.live.notification.sender import Sender
from hygrokf.live.notification.transports import Mail, Webhook
from hygrokf.live.storage.store import open_store
from validation.counts import markdown
from validation.frame import Claim

SECRET = bytes(range(32))
EACH = 3
"""Alarms that begin during each outage, and before it."""


def outages(kind: str, count: int, seed: int, folder: Path) -> dict:
    """Let a receiver fail `count` times in random order, each at least until an attempt met the failure.

    The sender is stopped and started again in every third outage.  `doubled`: messages accepted again though
    the receiver had answered; `repeated`: those that came again because their answer was lost, with the same
    key; `noticed`: attempts that met each way to fail.
    """
    random = np.random.default_rng(seed)
    before = sending.SENDER_BACK_OFF_S, sending.POLL_S
    sending.SENDER_BACK_OFF_S, sending.POLL_S = (0.02, 0.2), 0.01
    try:
        return _outages(kind, count, seed, folder, random)
    finally:
        sending.SENDER_BACK_OFF_S, sending.POLL_S = before


def _outages(kind: str, count: int, seed: int, folder: Path, random: np.random.Generator) -> dict:
    url = f"sqlite:{folder / 'notices.db'}"
    store = open_store(url)
    (folder / "hook.secret").write_text("whsec_" + base64.b64encode(SECRET).decode())
    server = MailServer() if kind == "mail" else WebhookServer(SECRET)
    channel = _channel(kind, server.port, folder)
    server.start()
    sender, restarts, number = Sender(channel, url), 0, 0
    sender.start()

    def raise_alarms() -> None:
        nonlocal number
        now = time.time()
        alarms = [
            Alarm(f"T1:condensation:{number + i}", "T1", "condensation", "alarm", now, "water condenses", "")
            for i in range(EACH)
        ]
        number += EACH
        store.commit(Batch(alarms=alarms, notices=notices_of(alarms, [channel], now, now)))

    ways = [FAILURES[i % len(FAILURES)] for i in random.permutation(count)]
    try:
        for place, way in enumerate(ways):
            raise_alarms()
            time.sleep(float(random.uniform(0.0, 0.02)))
            server.fail(way)
            met, failures = server.noticed[way], sender.failures
            raise_alarms()
            eventually(
                lambda way=way, met=met, failures=failures, one=sender: (
                    one.failures > failures and (way == "refuse" or server.noticed[way] > met)
                )
            )
            if place % 3 == 2:
                sender.stop()
                sender, restarts = Sender(channel, url), restarts + 1
                sender.start()
            server.fail("")
        eventually(lambda: not any(one.waiting for one in channel_states(store).values()))
    finally:
        sender.stop()
        server.stop()
    accepted = server.accepted
    rows = queried(store, "SELECT COUNT(*) FROM outbox WHERE sent IS NOT NULL AND failure = ''")
    wrong = queried(store, "SELECT id, attempts, failure FROM outbox WHERE sent IS NULL OR failure <> ''")
    assert rows == [(number,)], wrong
    store.close()
    lost, doubled = number - len(accepted.keys), len(accepted.doubled)
    return {
        "kind": kind, "outages": count, "restarts": restarts, "notices": number, "lost": lost,
        "doubled": doubled, "repeated": accepted.repeated,
        "lost_answers": sum(accepted.lost_answers.values()),
        "noticed": {way: server.noticed[way] for way in FAILURES}, "held": not (lost or doubled),
    }  # fmt: skip


def _channel(kind: str, port: int, folder: Path) -> Mail | Webhook:
    if kind == "mail":
        ends = {"sender": "tracker@farm.example", "to": ("ops@farm.example", "night@farm.example")}
        return Mail(name=kind, url=f"smtp://127.0.0.1:{port}", unencrypted=True, timeout_s=0.5, **ends)
    url = f"http://127.0.0.1:{port}/hook"
    return Webhook(name=kind, url=url, folder=folder, secret_file="hook.secret", timeout_s=0.5)


def one(kind: str, seed: int, *, count: int = 100) -> dict:
    """Outages of a mail server or a webhook."""
    with tempfile.TemporaryDirectory(prefix="hygrokf-notices-") as folder:
        return outages(kind, count, seed, Path(folder))


def table(lines: Sequence[Mapping]) -> str:
    """One row a line."""
    columns = ("kind", "seed", "outages", "restarts", "notices", "lost", "doubled", "repeated")
    return markdown(columns, ([line[name] for name in columns] for line in lines))


CLAIM = Claim("notices", dict.fromkeys(("mail", "webhook"), range(2, 3)), one, table)
