"""paho's MQTT client, which asks the system for many packets at once instead of several times for each."""

from __future__ import annotations

from functools import cache

AT_ONCE = 65_536
"""[bytes] that are asked for at once."""
MOST = 500
"""Packets that are read before what is to be sent, and the keep-alive, have their turn."""


@cache
def piecewise_client() -> type:
    """The class of clients, paho's own but for how it reads; its `loop` is to be `turn`.

    Each call to the system lets another thread of the process run, for as long as that one likes, and takes its turn from
    that one when it comes back: a client that asks for every packet's first byte, length and rest hinders a busy tracker
    and waits for it.
    """
    from paho.mqtt.client import Client

    class PiecewiseClient(Client):
        _held, _place = b"", 0

        def turn(self, timeout: float) -> bool:
            """Wait for something to come or to be sent, and do it; whether the connection still stands."""
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
                self._held, self._place = super()._sock_recv(max(bufsize, AT_ONCE)), 0
            found = self._held[self._place : self._place + bufsize]
            self._place += len(found)
            return found

    return PiecewiseClient
