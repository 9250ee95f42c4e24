"""Checks of the channels by which people are notified: whether they can be reached, TLS and login work, and a
test message is accepted."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

from hygrokf.live.doctor.check import Check, doubt, fault, ok
from hygrokf.live.notification.channel import Channel, ChannelFault
from hygrokf.live.notification.sender import send_test

_MEND = "correct [[notify]], or the server; notices wait in the store meanwhile"


def channel_checks(channels: Sequence[Channel], send: bool) -> list[Check]:
    """Check channels, all at the same time; `send`: with a test message to each."""
    if not channels:
        return []
    with ThreadPoolExecutor(min(len(channels), 8)) as pool:
        found = pool.map(lambda one: list(_checks(one, send)), channels)
        return [check for checks in found for check in checks]


def _checks(channel: Channel, send: bool) -> Iterator[Check]:
    about = f"notify {channel.name}"
    for caution in channel.transport.cautions():
        yield doubt(about, caution, "use TLS and a secret where others could listen")
    try:
        yield ok(about, f"{channel.transport.where}: {channel.transport.probe()}")
        if send:
            send_test(channel)
            yield ok(about, "a test message was accepted")
    except ChannelFault as found:
        yield fault(about, str(found), _MEND)
