"""A sender in a process of its own, which may be killed: `sender_process.py STORE-URL PORT`."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def started(url: str, port: int) -> subprocess.Popen[bytes]:
    """Send a store's notices of the channel "hook" to a webhook on the loopback, until it is killed."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(Path(__file__)), url, str(port)]
    return subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)


def send(url: str, port: str) -> None:
    from hygrokf.live.notification import sender
    from hygrokf.live.notification.transports import Webhook

    sender.POLL_S = 0.01
    sender.Sender(Webhook(name="hook", url=f"http://127.0.0.1:{port}"), url).start()
    threading.Event().wait()


if __name__ == "__main__":
    send(*sys.argv[1:])
