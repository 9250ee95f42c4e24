"""Sparkplug edge nodes of another make: the public schema as google.protobuf builds it, published with paho.

Nothing here is shared with the decoder that is tested.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache

from builders.brokers import Mosquitto
from builders.waiting import eventually

INT8, INT16, INT32, INT64, UINT8, UINT16, UINT32, UINT64 = range(1, 9)
FLOAT, DOUBLE, BOOLEAN, STRING, DATETIME, TEXT = range(9, 15)
DATASET, BYTES, TEMPLATE = 16, 17, 19
_SCHEMA = {
    "Payload": "timestamp:uint64=1 metrics:*Metric=2 seq:uint64=3 uuid:string=4 body:bytes=5",
    "Metric": (
        "name:string=1 alias:uint64=2 timestamp:uint64=3 datatype:uint32=4 is_historical:bool=5 "
        "is_transient:bool=6 is_null:bool=7 properties:PropertySet=9 int_value:uint32=10 "
        "long_value:uint64=11 float_value:float=12 double_value:double=13 boolean_value:bool=14 "
        "string_value:string=15 bytes_value:bytes=16 dataset_value:DataSet=17 template_value:Template=18"
    ),
    "PropertySet": "keys:*string=1 values:*PropertyValue=2",
    "PropertyValue": (
        "type:uint32=1 is_null:bool=2 int_value:uint32=3 long_value:uint64=4 string_value:string=8"
    ),
    "DataSet": "num_of_columns:uint64=1 columns:*string=2 types:*uint32=3",
    "Template": "version:string=1 metrics:*Metric=2",
}
_FIELD_OF = {
    **dict.fromkeys((INT8, INT16, INT32, UINT8, UINT16), "int_value"),
    **dict.fromkeys((INT64, UINT32, UINT64, DATETIME), "long_value"),
    FLOAT: "float_value", DOUBLE: "double_value", BOOLEAN: "boolean_value", STRING: "string_value",
    TEXT: "string_value", BYTES: "bytes_value",
}  # fmt: skip


@cache
def payload_class() -> type:
    """The class of payloads, made from the schema at run time."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    file = descriptor_pb2.FileDescriptorProto(name="peer.proto", package="peer", syntax="proto2")
    kinds = descriptor_pb2.FieldDescriptorProto
    for name, fields in _SCHEMA.items():
        message = file.message_type.add(name=name)
        for one in fields.split():
            label, rest = one.split(":")
            kind, number = rest.split("=")
            many, kind = kind.startswith("*"), kind.removeprefix("*")
            field = message.field.add(
                name=label, number=int(number), label=kinds.LABEL_REPEATED if many else kinds.LABEL_OPTIONAL
            )
            if kind in _SCHEMA:
                field.type, field.type_name = kinds.TYPE_MESSAGE, f".peer.{kind}"
            else:
                field.type = getattr(kinds, f"TYPE_{kind.upper()}")
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("peer.Payload"))


def metric(
    name: str | None = None,
    value: object = None,
    kind: int = 0,
    alias: int | None = None,
    at: float | None = None,
    quality: int | None = None,
    typed: bool = True,
    **flags: bool,
):
    """A metric; `at` [s]; of a kind that is not stated if not `typed`; without a value it is null."""
    made = payload_class()().metrics.add()
    if name is not None:
        made.name = name
    if alias is not None:
        made.alias = alias
    if at is not None:
        made.timestamp = round(1000.0 * at)
    if kind and typed:
        made.datatype = kind
    if quality is not None:
        made.properties.keys.extend(["Unit", "Quality"])
        made.properties.values.add(type=STRING, string_value="degC")
        made.properties.values.add(type=INT32, int_value=quality)
    for flag, state in flags.items():
        setattr(made, flag, state)
    if value is None:
        made.is_null = True
    elif kind in (DATASET, TEMPLATE):
        getattr(made, "dataset_value" if kind == DATASET else "template_value").SetInParent()
    elif _FIELD_OF[kind] in ("int_value", "long_value"):
        bits = 32 if _FIELD_OF[kind] == "int_value" else 64
        setattr(made, _FIELD_OF[kind], int(value) % 2**bits)
    else:
        setattr(made, _FIELD_OF[kind], value)
    return made


def payload(metrics: Iterable = (), sequence: int | None = None, at: float | None = None) -> bytes:
    made = payload_class()(timestamp=round(1000.0 * (time.time() if at is None else at)))
    made.metrics.extend(metrics)
    if sequence is not None:
        made.seq = sequence
    return made.SerializeToString()


class EdgeNode:
    """An edge node with devices; the aliases of its metrics are numbered from `first_alias` on.

    `devices`: device -> name of a metric -> data type.  `rebirths` counts the commands to be born again,
    which it obeys; `sent`: (topic, payload) of all its messages, which without a broker are only kept there.
    With `lose` a message takes its number and is not sent.
    """

    def __init__(
        self,
        broker: Mosquitto | None = None,
        name: str = "Farm/N1",
        devices: Mapping[str, Mapping[str, int]] | None = None,
        first_alias: int = 10,
        bdseq: int = 0,
        qos: int = 0,
    ) -> None:
        self.group, self.node = name.split("/")
        self.devices = {"W01": {"Cabinet/Temperature": FLOAT}} if devices is None else devices
        self.bdseq, self.qos, self.rebirths = bdseq, qos, 0
        self.lose = self.dead = False
        self._sequence = 0
        names = [(device, one) for device, metrics in self.devices.items() for one in metrics]
        self.aliases = {key: first_alias + place for place, key in enumerate(names)}
        self.sent: list[tuple[str, bytes]] = []
        self._broker = broker

    def topic(self, kind: str, device: str = "") -> str:
        return "/".join(("spBv1.0", self.group, kind, self.node, *([device] if device else [])))

    @contextmanager
    def connected(self) -> Iterator[EdgeNode]:
        """Connected with its will; leaves by its death certificate unless it was killed."""
        from paho.mqtt.client import Client, MQTTv5
        from paho.mqtt.enums import CallbackAPIVersion

        self.client = client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTv5)
        client.will_set(self.topic("NDEATH"), self._death(), qos=1)
        client.on_message = self._command
        client.connect("127.0.0.1", self._broker.port)
        client.loop_start()
        try:
            eventually(client.is_connected)
            client.subscribe(self.topic("NCMD"), 1)
            yield self
        finally:
            if not self.dead:
                client.publish(self.topic("NDEATH"), self._death(), 1).wait_for_publish(10.0)
            client.disconnect()
            client.loop_stop()

    def die(self) -> None:
        """Lose the connection, so that the broker publishes the will."""
        self.dead = True
        self.client.loop_stop()
        self.client.socket().close()

    def death(self) -> tuple[str, bytes]:
        """Topic and payload of its death certificate."""
        return self.topic("NDEATH"), self._death()

    def _death(self) -> bytes:
        return payload([metric("bdSeq", self.bdseq, INT64)])

    def _command(self, client, userdata, message) -> None:
        found = payload_class().FromString(message.payload)
        if any(one.name == "Node Control/Rebirth" and one.boolean_value for one in found.metrics):
            self.rebirths += 1
            self.bear()

    def bear(self, at: float | None = None, **values: object) -> None:
        """Publish all birth certificates."""
        now = time.time() if at is None else at
        self._sequence = 0
        own = [metric("bdSeq", self.bdseq, INT64), metric("Node Control/Rebirth", False, BOOLEAN)]
        self._publish("NBIRTH", "", own, now)
        for device in self.devices:
            self.bear_device(device, now, **values)

    def bear_device(self, device: str, at: float | None = None, **values: object) -> None:
        now = time.time() if at is None else at
        found = [
            metric(name, values.get(name.replace("/", "_")), kind, self.aliases[device, name], now)
            for name, kind in self.devices[device].items()
        ]
        self._publish("DBIRTH", device, found, now)

    def send(
        self, device: str, values: Mapping[str, object], at: float | None = None, **flags: object
    ) -> None:
        """Publish values by their aliases, without names and types."""
        now = time.time() if at is None else at
        kinds = self.devices[device]
        found = [
            metric(None, value, kinds[name], self.aliases[device, name], now, typed=False, **flags)
            for name, value in values.items()
        ]
        self._publish("DDATA", device, found, now)

    def send_named(self, device: str, name: str, value: object, at: float | None = None) -> None:
        now = time.time() if at is None else at
        self._publish("DDATA", device, [metric(name, value, self.devices[device][name], at=now)], now)

    def leave(self, device: str) -> None:
        self._publish("DDEATH", device, [], time.time())

    def _publish(self, kind: str, device: str, metrics: list, at: float) -> None:
        content = payload(metrics, self._sequence, at)
        self._sequence = (self._sequence + 1) % 256
        if self.lose:
            return
        self.sent.append((self.topic(kind, device), content))
        if self._broker is not None:
            self.client.publish(*self.sent[-1], self.qos)
