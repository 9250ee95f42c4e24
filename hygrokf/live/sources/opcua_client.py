"""One connection to an OPC UA server: a subscription, its samples, and the history of its nodes; and OPC UA
data in the tracker's terms: nodes, samples and error messages.

The connection only reads: it writes no value and calls no method.  It belongs to one asyncio loop and is
discarded when it is lost.
"""

from __future__ import annotations

import asyncio
import logging
import math
import socket
import time
from collections.abc import AsyncIterator, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from types import ModuleType
from typing import TYPE_CHECKING

from hygrokf.errors import HygrokfError
from hygrokf.live.sources.opcua_form import HELD, Node, Security, Server
from hygrokf.live.sources.stream import SourceFault
from hygrokf.texts.wording import stamp_text

if TYPE_CHECKING:
    from asyncua import ua
    from asyncua.client.client import Client
    from asyncua.common.node import Node as UaNode
    from asyncua.common.subscription import DataChangeNotif, Subscription

OVERFLOW = 0x0480
"""Status code bits of a data value before which others were lost in the server's full queue."""
NO_HISTORY = (
    "BadHistoryOperationUnsupported", "BadHistoryOperationInvalid", "BadServiceUnsupported",
    "BadNotSupported",
    "BadNotImplemented", "BadNotReadable", "BadUserAccessDenied", "BadNodeIdUnknown", "BadAttributeIdInvalid",
)  # fmt: skip
"""Status codes of a server that will never provide a node's history, so that asking again is useless."""
REMEDIES = {
    "BadUserAccessDenied": "the server refuses the user: check user and password",
    "BadIdentityTokenRejected": "the server refuses the user: check user and password, or state them if "
    "they are missing",
    "BadIdentityTokenInvalid": "the server refuses the user: check user and password, or state them if "
    "they are missing",
    "BadSecurityChecksFailed": "the server refuses this client's certificate: let the server trust it",
    "BadCertificateUntrusted": "the server does not trust this client's certificate: let the server trust it",
    "BadCertificateUriInvalid": "the client's certificate was made for another application",
    "BadCertificateTimeInvalid": "a certificate is not valid today: check both clocks, or make a new one",
    "BadTooManySessions": "the server has no session left: close other clients",
}


class HistoryFault(HygrokfError):
    """A node's history could not be read; `word`: the server's reason; `final`: asking again is useless."""

    def __init__(self, word: str) -> None:
        super().__init__(word)
        self.final = word in NO_HISTORY


@dataclass(frozen=True)
class Sample:
    """A value of a node.

    `time`: stamp [s] of the source, else of the server, None without either; `quality`: "good", "uncertain"
    or "bad" (also for a missing value); `word`: name of the status code; `overflowed`: values before it were
    lost in the server's queue; `received`: time of arrival [s]; `served`: the server's stamp [s], else NaN.
    """

    node: Node
    time: float | None
    value: object
    quality: str
    word: str
    overflowed: bool
    received: float
    served: float = math.nan


def library() -> ModuleType:
    """The module asyncua, an optional dependency.  Raises SourceFault if it is missing."""
    try:
        import asyncua
    except ImportError:
        raise SourceFault("OPC UA needs asyncua: pip install 'hygrokf[opcua]'") from None
    # its relevant log entries are also raised as exceptions; its debug output contains passwords
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
    return asyncua


def node_fault(text: str) -> str | None:
    """An error message for an invalid node id, else None.  Raises SourceFault without asyncua."""
    ua = library().ua
    try:
        found = ua.NodeId.from_string(text)
    except (ua.UaError, ValueError, KeyError):
        found = None
    if found is None or getattr(found, "ServerIndex", None):
        return (
            f'expected a node id such as "ns=2;s=T07.CabinetTemp" or "nsu=urn:plant;i=1007", found {text!r}'
        )
    return None


def sample_of(node: Node, found: ua.DataValue, received: float) -> Sample:
    """A sample from asyncua's DataValue; the year 1601 means in OPC UA that there is no time."""
    status, value = found.StatusCode, None if found.Value is None else found.Value.Value
    quality = "good"
    if value is None or (status is not None and status.is_bad()):
        quality = "bad"
    elif status is not None and status.is_uncertain():
        quality = "uncertain"
    stated, served = (
        None if s is None or s.year <= 1601 else s.replace(tzinfo=s.tzinfo or UTC).timestamp()
        for s in (found.SourceTimestamp, found.ServerTimestamp)
    )
    return Sample(
        node,
        served if stated is None else stated,
        value,
        quality,
        "Good" if status is None else type(status)(type(status.value)(status.value & 0xFFFF0000)).name,
        status is not None and status.value & 0x0C80 == OVERFLOW,
        received,
        math.nan if served is None else served,
    )


def name_of(fault: Exception) -> str:
    """The name of the status code that an exception stands for."""
    return type(fault).__name__ if type(fault).__name__.startswith("Bad") else str(fault)[:80]


def words_of(fault: Exception) -> str:
    """Message for an exception of asyncua or the network."""
    if isinstance(fault, SourceFault):
        return str(fault)
    if isinstance(fault, ConnectionRefusedError):
        return "nothing listens there"
    if isinstance(fault, socket.gaierror):
        return f"the host is not known ({fault.strerror})"
    if isinstance(fault, TimeoutError):
        return "no answer in time"
    name = name_of(fault)
    if name in REMEDIES:
        return f"{REMEDIES[name]} ({name})"
    return " ".join(f"{type(fault).__name__} {fault}".split())[:160].strip()


ANSWER_S = 5.0
"""[s] allowed for a server's answer."""
HISTORY_S = 30.0
"""[s] allowed for the answer to a history request."""
WATCH_S = 5.0
"""[s] between two checks that the server is alive."""
KEEP_ALIVE_S = 10.0
"""[s] without changes after which the server sends a keep-alive."""
LIFETIME_S = 120.0
"""[s] the server keeps session and subscription of a lost client."""
AT_ONCE = 500
"""Nodes per subscription request."""
PAGE = 1_000
"""Samples per history request."""
NO_FILTER = ("BadMonitoredItemFilterUnsupported", "BadMonitoredItemFilterInvalid", "BadFilterNotAllowed")


class Connection:
    """A session and its subscription.

    Call `open` and `subscribe`, then `samples` and `history` as long as `check` raises nothing, and `close`
    in any case.
    """

    def __init__(self, server: Server, security: Security | None) -> None:
        self.unfiltered = False
        """Whether the server reports changes only and omits repeated equal values."""
        self.dropped: set[Node] = set()
        """Nodes that lost samples because the queue here was full; the caller empties the set."""
        self._server, self._security = server, security
        self._ua = library().ua
        self._client: Client | None = None
        self._subscription: Subscription
        self._handles: dict[int, Node] = {}
        self._ids: dict[Node, ua.NodeId] = {}
        self._held: list[tuple[Node, ua.DataValue, float]] = []
        self._came = asyncio.Event()
        self._lost = ""
        self._stale_s = math.inf

    # -- the session -----------------------------------------------------------------------------------------
    async def open(self) -> None:
        """Connect, log in and create an empty subscription.  Raises SourceFault."""
        try:
            client = self._client = await self._new_client()
            await client.connect()
            await self._create_subscription(client)
            assert client.uaclient.protocol is not None
            client.uaclient.protocol.timeout = HISTORY_S
        except Exception as fault:  # asyncua raises many exceptions, also while decoding
            words = await self._explain(fault)
            await self.close()
            raise SourceFault(words) from None

    @property
    def _open_client(self) -> Client:
        assert self._client is not None
        return self._client

    async def _new_client(self) -> Client:
        from asyncua.crypto import security_policies
        from asyncua.crypto.uacrypto import CertProperties

        client: Client = library().Client(self._server.endpoint, timeout=ANSWER_S, watchdog_intervall=WATCH_S)
        client.name = client.description = f"hygrokf on {socket.gethostname()}"
        client.session_timeout = int(1e3 * LIFETIME_S)
        client.connection_lost_callback = self._note_loss
        s = self._security
        if s is not None:
            client.application_uri = s.application_uri
            await client.set_security(
                getattr(security_policies, f"SecurityPolicy{s.policy}"),
                CertProperties(s.certificate, "der"),
                CertProperties(s.key, "der"),
                server_certificate=CertProperties(s.server_certificate, "der"),
                mode=self._ua.MessageSecurityMode[s.mode],
            )
        if self._server.user:
            client.set_user(self._server.user)
            client.set_password(self._server.password.read() or "")
        return client

    async def _create_subscription(self, client: Client) -> None:
        """Create the subscription without asyncua's automatic renewal, which would not read back missed
        samples."""
        from asyncua.common.subscription import Subscription

        wanted = self._ua.CreateSubscriptionParameters()
        wanted.RequestedPublishingInterval = 1e3 * self._server.publishing_s
        wanted.RequestedMaxKeepAliveCount = math.ceil(KEEP_ALIVE_S / self._server.publishing_s)
        wanted.RequestedLifetimeCount = math.ceil(LIFETIME_S / self._server.publishing_s)
        wanted.MaxNotificationsPerPublish = HELD
        wanted.PublishingEnabled = True
        made = self._subscription = Subscription(client.uaclient.session, wanted, self)
        granted = await made.init()
        made.last_publish_at = time.monotonic()
        self._stale_s = 2e-3 * granted.RevisedPublishingInterval * granted.RevisedMaxKeepAliveCount + ANSWER_S

    async def close(self) -> None:
        """End session and subscription if the server still answers."""
        client, self._client = self._client, None
        if client is None:
            return
        protocol = client.uaclient.protocol
        with suppress(Exception):
            await asyncio.wait_for(client.disconnect(), ANSWER_S)
        if protocol is not None and protocol.transport is not None:
            protocol.transport.abort()  # asyncua keeps the socket of a silent server open
        await asyncio.sleep(0.0)

    def check(self) -> None:
        """Raises SourceFault if the connection is lost or the server has stopped publishing."""
        last = self._subscription.last_publish_at
        silent_s = 0.0 if last is None else time.monotonic() - last
        if not self._lost and silent_s > self._stale_s:
            self._lost = f"the server has not published for {silent_s:.0f} s"
        if self._lost:
            raise SourceFault(self._lost)

    async def server_time(self) -> float:
        """The server's clock [s].  Raises SourceFault."""
        try:
            node = self._open_client.get_node(
                self._ua.NodeId(self._ua.ObjectIds.Server_ServerStatus_CurrentTime)
            )
            found = await node.read_value()
            return (found if found.tzinfo else found.replace(tzinfo=UTC)).timestamp()
        except Exception as fault:
            raise SourceFault(words_of(fault)) from None

    async def _note_loss(self, fault: Exception) -> None:
        self._lost = self._lost or f"the connection is lost ({words_of(fault)})"

    async def _explain(self, fault: Exception) -> str:
        """Why a connection failed, including a mismatch with the endpoints that the server offers to
        anyone."""
        words = words_of(fault)
        if isinstance(fault, ConnectionRefusedError | socket.gaierror | SourceFault):
            return words
        words = await self._mismatch() or words
        if self._security is not None and self._security.valid_until < time.time():
            words += (
                f"; this client's certificate was valid until {stamp_text(self._security.valid_until)}: "
                "make a new one"
            )
        return words

    async def _mismatch(self) -> str:
        """A message if the server's policy, mode or certificate differs from the configured one; empty if
        unknown."""
        s, client = self._security, library().Client(self._server.endpoint, timeout=0.4 * ANSWER_S)
        try:
            offers = await client.connect_and_get_server_endpoints()
        except Exception:  # the server answers no unsecured client, or none at all
            return ""
        wanted = "no security" if s is None else f"{s.policy} {s.mode}"
        offered = {_security_name(o): o.ServerCertificate or b"" for o in offers}
        if wanted not in offered:
            return (
                f"the server has no connection with {wanted}; it offers "
                f"{', '.join(sorted(offered)) or 'none'}"
            )
        if s is not None and not offered[wanted].startswith(s.server_certificate):
            return (
                "the server's certificate is not the one in server_certificate: find out whether it was "
                "replaced, and state the new one only then"
            )
        return ""

    # -- the subscription ------------------------------------------------------------------------------------
    async def subscribe(self, nodes: Sequence[Node]) -> dict[Node, str]:
        """Subscribe to nodes; returns the refused nodes with the server's reason.  Raises SourceFault."""
        try:
            refused = await self._look_up_ids(nodes)
            for filtered in (True, False):
                asked = [
                    node
                    for node in nodes
                    if node in self._ids and (filtered or refused.get(node) in NO_FILTER)
                ]
                for start in range(0, len(asked), AT_ONCE):
                    part = asked[start : start + AT_ONCE]
                    results = await self._subscription.create_monitored_items(
                        [self._item(node, filtered) for node in part]
                    )
                    for node, result in zip(part, results, strict=True):
                        refused.pop(node, None)
                        if isinstance(result, self._ua.StatusCode):
                            refused[node] = result.name
                        self.unfiltered |= not filtered
        except Exception as fault:
            raise SourceFault(words_of(fault)) from None
        return refused

    async def _look_up_ids(self, nodes: Iterable[Node]) -> dict[Node, str]:
        """Look up the ids of nodes, because some servers renumber their namespaces at a restart; returns
        unknown nodes."""
        ua = self._ua
        refused: dict[Node, str] = {}
        found = {node: ua.NodeId.from_string(node.id) for node in nodes}
        named = [one for one in found.values() if getattr(one, "NamespaceUri", None)]
        namespaces = await self._open_client.get_namespace_array() if named else []
        for node, one in found.items():
            uri = getattr(one, "NamespaceUri", None)
            if uri and uri not in namespaces:
                refused[node] = "the server has no such namespace"
                continue
            self._ids[node] = ua.NodeId(one.Identifier, namespaces.index(uri), one.NodeIdType) if uri else one
        return refused

    def _item(self, node: Node, filtered: bool) -> ua.MonitoredItemCreateRequest:
        """The request to monitor a node; `filtered` also by time stamp, so that a repeated equal value is
        reported."""
        ua = self._ua
        wanted = ua.MonitoringParameters()
        wanted.ClientHandle = len(self._handles) + 1
        wanted.SamplingInterval = 1e3 * self._server.sampling_s
        wanted.QueueSize = self._server.queue
        wanted.DiscardOldest = True
        if filtered:
            wanted.Filter = ua.DataChangeFilter(Trigger=ua.DataChangeTrigger.StatusValueTimestamp)
        item = ua.MonitoredItemCreateRequest()
        item.ItemToMonitor = ua.ReadValueId(NodeId=self._ids[node], AttributeId=ua.AttributeIds.Value)
        item.MonitoringMode = ua.MonitoringMode.Reporting
        item.RequestedParameters = wanted
        self._handles[wanted.ClientHandle] = node
        return item

    def datachange_notification(self, node: UaNode, value: object, data: DataChangeNotif) -> None:
        """Called by asyncua; only queues the sample."""
        handle = data.subscription_data.client_handle
        assert handle is not None, "every item is asked for with one"
        one = self._handles[handle]
        if len(self._held) < HELD:
            self._held.append((one, data.monitored_item.Value or self._ua.DataValue(), time.time()))
        else:
            self.dropped.add(one)
        self._came.set()

    def status_change_notification(self, notification: ua.StatusChangeNotification) -> None:
        """Called by asyncua when the server ends the subscription."""
        self._lost = self._lost or f"the server ended the subscription ({notification.Status.name})"

    async def samples(self, patience_s: float) -> list[Sample]:
        """Samples since the last call; waits up to `patience_s` [s] for the first one."""
        with suppress(TimeoutError):
            await asyncio.wait_for(self._came.wait(), patience_s)
        self._came.clear()
        held, self._held = self._held, []
        return [sample_of(*one) for one in held]

    # -- history ---------------------------------------------------------------------------------------------
    async def without_history(self, nodes: Sequence[Node]) -> dict[Node, str]:
        """Subscribed nodes whose access level excludes reading their history, with the reason.

        A server that keeps no history may still answer a request for it, with nothing.  Nodes whose access
        level the server does not tell are left out.  Raises SourceFault.
        """
        ua, found = self._ua, dict[Node, str]()
        kinds = {
            "AccessLevel": "the node's AccessLevel has no HistoryRead: the server keeps no history of it",
            "UserAccessLevel": "this user's access level has no HistoryRead",
        }
        try:
            for name, words in kinds.items():
                asked = [node for node in nodes if node in self._ids and node not in found]
                for start in range(0, len(asked), AT_ONCE):
                    part = asked[start : start + AT_ONCE]
                    levels = await self._open_client.uaclient.read_attributes(
                        [self._ids[node] for node in part], ua.AttributeIds[name]
                    )
                    for node, level in zip(part, levels, strict=True):
                        value = level.Value.Value if level.Value is not None else None
                        if isinstance(value, int) and not value & (1 << ua.AccessLevel.HistoryRead):
                            found[node] = words
        except ua.UaStatusCodeError:  # this server refuses to tell
            return found
        except Exception as fault:
            raise SourceFault(words_of(fault)) from None
        return found

    async def history(self, node: Node, since_s: float, until_s: float) -> AsyncIterator[Sample]:
        """A node's samples in since_s < time ≤ until_s [s], sorted by time.  Raises HistoryFault,
        SourceFault."""
        ua = self._ua
        details = ua.ReadRawModifiedDetails(NumValuesPerNode=PAGE, ReturnBounds=False, IsReadModified=False)
        details.EndTime = datetime.fromtimestamp(until_s, UTC)
        while True:
            details.StartTime = datetime.fromtimestamp(since_s, UTC)
            page, more = await self._page(node, details)
            timed = ((s.time, s) for s in page if s.time is not None and since_s < s.time <= until_s)
            new = sorted(timed, key=lambda one: one[0])
            for _, sample in new:
                yield sample
            if not new or (len(page) < PAGE and not more):
                return
            since_s = new[-1][0]

    async def _page(self, node: Node, details: ua.ReadRawModifiedDetails) -> tuple[list[Sample], bool]:
        """A page of a node's history, and whether the server has more.

        The next page is requested by time instead of a continuation point, because servers have few of these
        and many nodes are read at once.
        """
        ua = self._ua
        value = ua.HistoryReadValueId(NodeId=self._ids[node])
        wanted = ua.HistoryReadParameters(details, ua.TimestampsToReturn.Both, False, [value])
        try:
            (found,) = await self._open_client.uaclient.history_read(wanted)
            more = found.ContinuationPoint
            if more:
                value.ContinuationPoint = more
                wanted.ReleaseContinuationPoints = True
                with suppress(ua.UaStatusCodeError):
                    await self._open_client.uaclient.history_read(wanted)
            found.StatusCode.check()
        except ua.UaStatusCodeError as fault:
            raise HistoryFault(name_of(fault)) from None
        except TimeoutError:
            self.check()
            raise HistoryFault(f"no answer within {HISTORY_S:g} s") from None
        except Exception as fault:
            raise SourceFault(words_of(fault)) from None
        now = time.time()
        return [
            sample_of(node, one, now) for one in getattr(found.HistoryData, "DataValues", None) or ()
        ], bool(more)


def _security_name(offer: ua.EndpointDescription) -> str:
    policy = offer.SecurityPolicyUri.rpartition("#")[2].replace("_", "")
    return "no security" if policy == "None" else f"{policy} {offer.SecurityMode.name}"
