"""Edge nodes as their messages describe them: aliases, gaps, order, deaths, and what a restart recalls."""

from __future__ import annotations

import json
import random
from collections import Counter
from collections.abc import Iterable, Mapping

import pytest
from builders.sparkplug_peer import (
    BYTES,
    DATASET,
    FLOAT,
    INT16,
    INT64,
    STRING,
    EdgeNode,
    metric,
    payload,
)

from hygrokf.live.sources import sparkplug, sparkplug_node
from hygrokf.live.sources.payload import Field, PayloadMapping
from hygrokf.live.sources.payload_formats import Refused, Unreadable
from hygrokf.live.sources.sparkplug import EdgeNodes
from hygrokf.live.sources.sparkplug_node import Released

AT = 1_772_366_400.0
NAME = "Cabinet/Temperature"
DEVICES = {"W01": {NAME: FLOAT, "Cabinet/Level": INT16}, "W02": {NAME: FLOAT}}


class Followed:
    """Edge nodes that are given messages, each a second after the one before, and what they released."""

    def __init__(self) -> None:
        self.nodes = EdgeNodes()
        self.now = AT
        self.released: list[Released] = []
        self.kept: dict[str, object] = {}

    def take(self, messages: Iterable[tuple[str, bytes]], apart_s: float = 1.0, **how: bool) -> None:
        for topic, content in messages:
            self.now += apart_s
            node, released = self.nodes.take(topic, content, self.now, **how)
            self.released += released
            self.kept |= node.memories() if node else {}

    def wait(self, seconds: float) -> None:
        self.now += seconds
        for node in self.nodes.nodes.values():
            self.released += node.release_overdue(self.now)
            self.kept |= node.memories()

    @property
    def payloads(self) -> list[tuple[str, Mapping]]:
        """(device, payload) of everything that the mapping is given, in order."""
        found = [
            (r.topic.split("/")[4], c) for r in self.released if r.topic.count("/") == 4 for c in r.contents
        ]
        return [(device, c) for device, c in found if not isinstance(c, Unreadable)]

    def values(self, device: str = "W01", name: str = NAME) -> list[object]:
        return [c[name] for d, c in self.payloads if d == device and name in c]

    @property
    def counts(self) -> Counter[str]:
        """Number of contents by the reason why they are not used."""
        found = Counter(c.kind for r in self.released for c in r.contents if isinstance(c, Unreadable))
        del found["no value"]
        return found


@pytest.fixture
def peer() -> EdgeNode:
    return EdgeNode(devices=DEVICES)


@pytest.fixture
def followed(peer: EdgeNode) -> Followed:
    """Edge nodes that have taken the births of the peer."""
    made = Followed()
    peer.bear(AT, Cabinet_Temperature=20.0, Cabinet_Level=-7)
    made.take(peer.sent)
    peer.sent.clear()
    return made


def test_births_name_what_data_say_by_alias(peer: EdgeNode, followed: Followed) -> None:
    peer.send("W01", {NAME: 21.5, "Cabinet/Level": -300}, AT + 10.25)
    peer.send("W02", {NAME: 22.5}, AT + 11.0)
    followed.take(peer.sent)
    assert followed.payloads == [
        ("W01", {NAME: 20.0, "Cabinet/Level": -7, "time": AT, "quality": "good"}),
        ("W02", {NAME: 20.0, "time": AT, "quality": "good"}),
        ("W01", {NAME: 21.5, "Cabinet/Level": -300, "time": AT + 10.25, "quality": "good"}),
        ("W02", {NAME: 22.5, "time": AT + 11.0, "quality": "good"}),
    ]
    assert not followed.counts and not followed.nodes.without_birth()


def test_the_sequence_begins_again_after_255(peer: EdgeNode, followed: Followed) -> None:
    for k in range(600):
        peer.send("W01", {NAME: float(k)}, AT + k)
    followed.take(peer.sent)
    assert followed.values()[1:] == list(map(float, range(600))) and not followed.counts


def test_after_a_gap_aliases_are_held_until_the_next_birth(peer: EdgeNode, followed: Followed) -> None:
    peer.lose = True
    peer.send("W01", {NAME: 1.0}, AT + 1)
    peer.lose = False
    peer.send("W01", {NAME: 2.0}, AT + 2)
    peer.send_named("W01", NAME, 3.0, AT + 3)
    peer.send("W02", {NAME: 4.0}, AT + 4)
    followed.take(peer.sent)
    followed.wait(3.0)
    # what bears its name needs no alias
    assert followed.values() == [20.0, 3.0]
    assert followed.counts == {"held until birth": 2}
    assert followed.nodes.without_birth() == ["Farm/N1"]
    peer.sent.clear()
    peer.bear(AT + 5, Cabinet_Temperature=5.0)
    followed.take(peer.sent)
    assert followed.values() == [20.0, 3.0, 5.0, 2.0] and followed.values("W02") == [20.0, 5.0, 4.0]
    assert [c["time"] for _, c in followed.payloads][-3:] == [AT + 2, AT + 5, AT + 4]
    assert not followed.nodes.without_birth()


def test_an_alias_that_changed_in_a_gap_is_not_read(peer: EdgeNode, followed: Followed) -> None:
    peer.lose = True
    peer.send("W01", {NAME: 1.0}, AT + 1)
    peer.lose = False
    peer.send("W01", {NAME: 2.0}, AT + 2)
    again = EdgeNode(devices=DEVICES, first_alias=9)  # the aliases of W01 are shifted by one
    again.bear(AT + 5, Cabinet_Temperature=5.0)
    followed.take([*peer.sent, *again.sent])
    assert followed.values() == [20.0, 5.0]
    assert followed.counts == {"held until birth": 1, "alias changed": 1}


def test_messages_out_of_order_are_put_in_order(peer: EdgeNode, followed: Followed) -> None:
    for k in range(4):
        peer.send("W01", {NAME: float(k)}, AT + k)
    one, two, three, four = peer.sent
    followed.take([three, two, four, one], apart_s=0.1)
    assert followed.values()[1:] == [0.0, 1.0, 2.0, 3.0]
    assert not followed.counts and not followed.nodes.without_birth()


def test_a_device_is_born_before_its_node_s_certificate_arrives(peer: EdgeNode, followed: Followed) -> None:
    peer.send("W01", {NAME: 1.0}, AT + 1)
    peer.bear(AT + 2, Cabinet_Temperature=2.0)
    data, node, *devices = peer.sent
    followed.take([data, *devices, node], apart_s=0.1)
    assert followed.values()[1:] == [1.0, 2.0] and not followed.counts
    assert not followed.nodes.without_birth()


def test_data_before_any_birth_are_counted(peer: EdgeNode) -> None:
    peer.send("W01", {NAME: 1.0}, AT)
    peer.send_named("W01", NAME, 2.0, AT + 1)
    followed = Followed()
    followed.take(peer.sent)
    assert followed.values() == [2.0] and followed.counts == {"no birth yet": 1}
    assert followed.nodes.without_birth() == ["Farm/N1"]


def test_a_death_ends_the_session_until_the_next_birth(peer: EdgeNode, followed: Followed) -> None:
    (node,) = followed.nodes.nodes.values()
    followed.take([peer.death()])
    assert set(node.left_s) == {"", "W01", "W02"} and followed.counts == {"death certificate": 1}
    peer.send("W01", {NAME: 1.0}, AT + 1)
    followed.take(peer.sent)
    assert followed.values() == [20.0] and followed.counts["held until birth"] == 1
    peer.sent.clear()
    peer.bdseq = 1
    peer.bear(AT + 2, Cabinet_Temperature=2.0)
    followed.take(peer.sent)
    assert not node.left_s and followed.values() == [20.0, 2.0, 1.0]


@pytest.mark.parametrize(
    ("born", "died", "lives"), [(3, 2, True), (0, 255, True), (3, 3, False), (3, 4, False)]
)
def test_a_death_of_a_former_session_changes_nothing(born: int, died: int, lives: bool) -> None:
    """The will of a broken connection may come after the births of the next."""
    peer, followed = EdgeNode(bdseq=born), Followed()
    peer.bear(AT)
    peer.bdseq = died
    followed.take([*peer.sent, peer.death()])
    (node,) = followed.nodes.nodes.values()
    assert bool(node.left_s) != lives


def test_a_device_leaves_and_comes_back(peer: EdgeNode, followed: Followed) -> None:
    (node,) = followed.nodes.nodes.values()
    peer.leave("W01")
    peer.send("W02", {NAME: 1.0}, AT + 1)
    followed.take(peer.sent)
    assert set(node.left_s) == {"W01"} and followed.values("W02") == [20.0, 1.0]
    peer.sent.clear()
    peer.bear_device("W01", AT + 2, Cabinet_Temperature=2.0)
    followed.take(peer.sent)
    assert not node.left_s and followed.values() == [20.0, 2.0]


def test_messages_that_the_broker_repeats_are_no_gap(peer: EdgeNode, followed: Followed) -> None:
    for k in range(3):
        peer.send("W01", {NAME: float(k)}, AT + k)
    followed.take(peer.sent)
    followed.take(peer.sent[-1:])  # by two filters that both fit
    followed.take(peer.sent, repeated=True)  # after a reconnection
    followed.wait(10.0)
    assert followed.values() == [20.0, 0.0, 1.0, 2.0] and followed.counts == {"repeated": 4}
    assert not followed.nodes.without_birth()


def restarted(followed: Followed) -> Followed:
    """What follows from the memories alone, as the store gives them back."""
    made = Followed()
    made.kept = json.loads(json.dumps(followed.kept))
    made.nodes.recall(made.kept)
    made.now = followed.now
    return made


def test_a_restart_recalls_aliases_and_the_place_in_the_sequence(peer: EdgeNode, followed: Followed) -> None:
    after = restarted(followed)
    peer.send("W01", {NAME: 1.0, "Cabinet/Level": -1}, AT + 1)
    after.take(peer.sent)
    assert after.values() == [1.0] and after.values(name="Cabinet/Level") == [-1] and not after.counts
    peer.send("W01", {NAME: 2.0}, AT + 2)
    peer.sent.clear()  # it comes while nobody listens
    again = restarted(after)
    peer.send("W01", {NAME: 3.0}, AT + 3)
    again.take(peer.sent)
    again.wait(3.0)
    assert not again.values() and again.counts == {"held until birth": 1}
    third = restarted(again)
    assert third.nodes.without_birth() == ["Farm/N1"]
    peer.sent.clear()
    peer.send("W01", {NAME: 4.0}, AT + 4)
    peer.bear(AT + 5, Cabinet_Temperature=5.0)
    third.take(peer.sent)
    assert third.values() == [5.0, 4.0]


def test_a_restart_recalls_who_has_left(peer: EdgeNode, followed: Followed) -> None:
    followed.take([peer.death()])
    (node,) = restarted(followed).nodes.nodes.values()
    assert set(node.left_s) == {"", "W01", "W02"}


@pytest.mark.parametrize("content", [None, 3, {"tables": {"a": 3}}, {"left_s": {"": "yesterday"}}])
def test_memories_that_cannot_be_read_are_forgotten(content: object) -> None:
    nodes = EdgeNodes()
    nodes.recall({"edge node Farm/N1": content, "sequence of Farm/N1": "x", "batch": 1})
    (node,) = nodes.nodes.values()
    assert node.gap_s is None and not node.unborn and not node.left_s


def test_only_changes_are_kept_again(peer: EdgeNode, followed: Followed) -> None:
    (node,) = followed.nodes.nodes.values()
    assert set(followed.kept) == {"edge node Farm/N1", "sequence of Farm/N1"}
    assert node.memories() == {"sequence of Farm/N1": 3}


def test_what_has_no_value_to_store_is_counted_and_passed(followed: Followed) -> None:
    content = payload(
        [
            metric("Table", {}, DATASET, at=AT), metric("Raw", b"1", BYTES, at=AT),
            metric("Passing", 1.0, FLOAT, at=AT, is_transient=True), metric(None, 1.0, FLOAT, at=AT),
            metric("x" * 501, 1.0, FLOAT, at=AT), metric(NAME, None, FLOAT, at=AT),
            metric("Cabinet/Level", 1, INT16, at=AT), metric("bdSeq", 1, INT64, at=AT),
        ],
        3, AT,
    )  # fmt: skip
    followed.take([("spBv1.0/Farm/DDATA/N1/W01", content)])
    assert followed.payloads[-1] == ("W01", {"Cabinet/Level": 1, "time": AT, "quality": "good"})
    assert followed.counts == {"no single value": 1, "transient": 1, "no name": 1, "name too long": 1}


def test_times_and_qualities_are_each_metric_s_own(followed: Followed) -> None:
    content = payload(
        [
            metric(NAME, 3.0, FLOAT, at=AT + 3, quality=0),
            metric("Cabinet/Level", 3, INT16, at=AT + 3, quality=192),
            metric(NAME, 2.0, FLOAT, at=AT + 2, is_historical=True),
            metric(NAME, 1.0, FLOAT, at=AT + 1, is_historical=True),
            metric(NAME, 9.0, FLOAT, is_historical=True),
            metric("State", "on", STRING),
        ],
        3, AT + 9,
    )  # fmt: skip
    followed.take([("spBv1.0/Farm/DDATA/N1/W01", content)])
    assert [one for _, one in followed.payloads[2:]] == [
        {NAME: 9.0, "time": None, "quality": "good"},  # of which time is not known
        {NAME: 1.0, "time": AT + 1, "quality": "good"},
        {NAME: 2.0, "time": AT + 2, "quality": "good"},
        {NAME: 3.0, "time": AT + 3, "quality": "bad"},
        {"Cabinet/Level": 3, "time": AT + 3, "quality": "good"},
        {"State": "on", "time": AT + 9, "quality": "good"},
    ]


@pytest.mark.parametrize(
    ("topic", "ours"),
    [
        ("spBv1.0/Farm/NCMD/N1", False), ("spBv1.0/Farm/DCMD/N1/W01", False), ("spBv1.0/STATE/host", False),
        ("spBv1.0/Farm/STATE/host", False), ("spAv1.0/Farm/NDATA/N1", True), ("spBv1.0/Farm/NDATA", True),
        ("spBv1.0/Farm/NDATA/N1/W01", True), ("spBv1.0/Farm/DDATA/N1", True), ("spBv1.0//NDATA/N1", True),
        ("spBv1.0/Farm/OTHER/N1", True), ("spBv1.0/Farm/NDATA/N\x001", True), ("", True),
    ],
)  # fmt: skip
def test_topics_of_others(topic: str, ours: bool) -> None:
    node, (released,) = EdgeNodes().take(topic, b"", AT)
    assert node is None and bool(released.contents) == ours


def test_numbers_of_nodes_devices_and_held_metrics_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sparkplug, "MOST_NODES", 2)
    monkeypatch.setattr(sparkplug_node, "MOST_DEVICES", 2)
    monkeypatch.setattr(sparkplug_node, "MOST_HELD_BYTES", 3 * 600)
    followed = Followed()
    for number in range(3):
        peer = EdgeNode(name=f"Farm/N{number}", devices={f"W{k}": {NAME: FLOAT} for k in range(3)})
        peer.bear(AT, Cabinet_Temperature=20.0)
        followed.take(peer.sent)
    assert followed.counts == {"too many edge nodes": 4, "too large": 2}
    peer = EdgeNode(name="Farm/N0", devices={"W0": {NAME: FLOAT}})
    peer.lose = True
    for _ in range(9):
        peer.send("W0", {NAME: 0.0}, AT)
    peer.lose = False
    for k in range(9):
        peer.send("W0", {NAME: float(k)}, AT + k)
    peer.bear(AT + 20, Cabinet_Temperature=30.0)
    before = len(followed.values("W0"))
    followed.take(peer.sent)
    assert followed.values("W0")[before:] == [30.0, 6.0, 7.0, 8.0]
    assert followed.counts["held until birth"] == 9


def test_10_000_damaged_messages_never_raise(peer: EdgeNode) -> None:
    draw = random.Random(7)
    peer.bear(AT, Cabinet_Temperature=20.0)
    for k in range(20):
        peer.send("W01", {NAME: float(k)}, AT + k)
    peer.leave("W02")
    whole = [*peer.sent, peer.death()]
    mapping = PayloadMapping(
        {NAME: Field("cabinet_temperature", "degC")}, "{4}", quality="quality", turbines={"W01": "T1"}
    )
    followed, read = Followed(), 0
    for number in range(10_000):
        topic, content = draw.choice(whole)
        damaged = bytearray(content)
        for _ in range(draw.randrange(3)):
            damaged[draw.randrange(len(damaged))] = draw.randrange(256)
        followed.take([(topic, bytes(damaged))], 0.5, repeated=number % 5 == 0)
        if number % 1_000 == 999:
            followed.nodes = restarted(followed).nodes
    for one in followed.released:
        for content in one.contents:
            try:
                read += any(found.readings for found in mapping.read(content, one.received, one.topic))
            except Refused:
                pass
    assert read > 500 and len(followed.counts) > 5
