"""Messages into a broker at quality 1, in a process of its own: `publisher.py PORT FILE RATE`, a line of the
file a message.

`RATE` messages a second, 0 as fast as the broker confirms them.  Ends when all are confirmed.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

TOPIC = "scada/all"
OPEN = 2_000
"""Messages that are not confirmed yet, at most."""


def publish(port: int, lines: list[bytes], rate: float) -> None:
    from paho.mqtt.client import Client, MQTTv5
    from paho.mqtt.enums import CallbackAPIVersion

    client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTv5)
    client.max_inflight_messages_set(500)
    client.connect("127.0.0.1", port)
    client.loop_start()
    while not client.is_connected():
        time.sleep(0.01)
    began, sent = time.monotonic(), []
    for number, line in enumerate(lines):
        if rate:
            time.sleep(max(began + number / rate - time.monotonic(), 0.0))
        sent.append(client.publish(TOPIC, line, qos=1))
        if number >= OPEN:
            sent[number - OPEN].wait_for_publish(60.0)
    for one in sent:
        one.wait_for_publish(60.0)
    client.disconnect()
    client.loop_stop()


if __name__ == "__main__":
    publish(int(sys.argv[1]), Path(sys.argv[2]).read_bytes().splitlines(), float(sys.argv[3]))
