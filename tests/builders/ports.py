"""Ports of the loopback for servers that tests start: nobody else is given one, also while its server is
away.  Room for many connections."""

from __future__ import annotations

import os
import random
import re
import resource
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

FIRST = 20_000
SLICES = 8
"""Workers of pytest-xdist that have ports of their own; more of them share."""
_GIVEN: set[int] = set()


def free_port() -> int:
    """A port that nobody listens at, which this process is given once.

    It lies below those that the system itself gives away, to clients and to servers that ask for any: one
    that was only just free, or whose server is killed and started again, would now and then be another test's
    by then.
    """
    ports = list(_slice())
    random.shuffle(ports)
    for port in ports:
        if port not in _GIVEN and _is_free(port):
            _GIVEN.add(port)
            return port
    raise RuntimeError(f"no port is free from {min(ports)} to {max(ports)}")


def _slice() -> range:
    """This worker's ports."""
    end = 32_768
    with suppress(OSError, ValueError, IndexError):
        end = int(Path("/proc/sys/net/ipv4/ip_local_port_range").read_text().split()[0])
    end = end if end >= FIRST + 1_000 else 32_768
    worker = int(re.sub(r"\D", "", os.environ.get("PYTEST_XDIST_WORKER", "")) or 0)
    return range(FIRST + worker % SLICES, end, SLICES)


def _is_free(port: int) -> bool:
    # without SO_REUSEADDR: what a server before it has left behind counts, too
    with socket.socket() as one:
        try:
            one.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


@contextmanager
def open_files(most: int) -> Iterator[None]:
    """As many files and connections as a test needs may be open in this process."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(max(soft, most), hard), hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
