"""An edge node by pysparkplug, in an environment of its own, because that needs an older paho: `PORT`.

Obeys lines on standard input and answers each with "done"; a command that reaches it is told as
"command NAME".
"""

from __future__ import annotations

import sys
import time

import pysparkplug

ALIASES = {"W01": 1, "W02": 2}
NAME = "Cabinet/Temperature"


def metric(device: str, value: float, name: str | None = NAME) -> pysparkplug.Metric:
    stamp = pysparkplug.get_current_timestamp()
    return pysparkplug.Metric(stamp, name, pysparkplug.DataType.FLOAT, value=value, alias=ALIASES[device])


def told(node: pysparkplug.EdgeNode, message: pysparkplug.Message) -> None:
    for one in message.payload.metrics:
        print("command", one.name, flush=True)


def main(port: int) -> None:
    client = pysparkplug.Client()
    node = pysparkplug.EdgeNode("Farm", "N1", (), client, told)
    for device in ALIASES:
        node.register(pysparkplug.Device(device, [metric(device, 20.0)]))
    for line in sys.stdin:
        word, *rest = line.split()
        if word == "connect":
            node.connect("127.0.0.1", port=port)
            time.sleep(0.5)
        elif word == "named":
            node.update_device(rest[0], [metric(rest[0], float(rest[1]))])
        elif word == "alias":  # as edge nodes with aliases publish, which its own devices do not
            topic = pysparkplug.Topic(
                message_type=pysparkplug.MessageType.DDATA,
                group_id="Farm",
                edge_node_id="N1",
                device_id=rest[0],
            )
            data = pysparkplug.DData(
                pysparkplug.get_current_timestamp(),
                seq=node._seq,
                metrics=(metric(rest[0], float(rest[1]), None),),
            )
            client.publish(pysparkplug.Message(topic, data, pysparkplug.QoS.AT_MOST_ONCE, retain=False))
        elif word == "lose":
            node._seq  # noqa: B018 - it takes the number of a message that is not sent
        elif word == "leave":
            node.deregister(rest[0])
        elif word == "disconnect":
            node.disconnect()
            time.sleep(0.2)
        print("done", flush=True)


if __name__ == "__main__":
    main(int(sys.argv[1]))
