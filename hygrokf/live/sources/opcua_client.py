"""A connection to an OPC UA server: its subscription, its samples, and the history of its nodes; and the
conversion of OPC UA data to samples and error messages.

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
from hygrokf.live.sources.opcua_form import QUEUE_SIZE, Node, Security, Server
from hygrokf.live.sources.stream import SourceFault
from hygrokf.texts.wording import stamp_text

if TYPE_CHECKING:
    from asyncua import ua
    from asyncua.client.client import Client
    from asyncua.common.node import Node as UaNode
    from asyncua.common.subscription import DataChangeNotif, Subscription

OVERFLOW = 0x0480
"""Status code bits of a data value before which the server's full queue lost others (InfoType, Overflow)."""
OVERFLOW_MASK = 0x0C80
"""Bits of a status code that hold the InfoType (DataValue) and the overflow flag."""
NAME_MASK = 0xFFFF0000
"""Bits of a status code that determine its name."""
NO_TIME_YEAR = 1601
"""Year of OPC UA's earliest time, which means that there is no time."""
NO_HISTORY = (
    "BadHistoryOperationUnsupported", "BadHistoryOperationInvalid", "BadServiceUnsupported",
    "BadNotSupported",
    "BadNotImplemented", "BadNotReadable", "BadUserAccessDenied", "BadNodeIdUnknown", "BadAttributeIdInvalid",
)  # fmt: skip
"""Status codes of a server that will never provide a node's history, so that a retry is useless."""
STATUS_REMEDIES = {
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
    """A node's history could not be read; the message is the server's reason; `final`: a retry is useless."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.final = reason in NO_HISTORY


@dataclass(frozen=True)
class Sample:
    """A value of a node.

    `time`: time stamp [s] of the source, otherwise of the server, None without either; `quality`: "good",
    "uncertain" or "bad" (also for a missing value); `word`: name of the status code; `overflowed`: whether
    values before this one were lost in the server's queue; `received`: time of arrival [s]; `served`: the
    server's time stamp [s], NaN without one.
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
    # asyncua also raises its relevant log entries as exceptions; its debug output contains passwords
    logging.getLogger("asyncua").setLevel(logging.CRITICAL)
    return asyncua


def node_fault(text: str) -> str | None:
    """An error message for an invalid node id, else None.  Raises SourceFault if asyncua is missing."""
    ua = library().ua
    try:
        node_id = ua.NodeId.from_string(text)
    except (ua.UaError, ValueError, KeyError):
        node_id = None
    if node_id is None or getattr(node_id, "ServerIndex", None):
        return (
            f'expected a node id such as "ns=2;s=T07.CabinetTemp" or "nsu=urn:plant;i=1007", found {text!r}'
        )
    return None


def sample_of(node: Node, data: ua.DataValue, received: float) -> Sample:
    """A sample from asyncua's DataValue, received at a time [s]."""
    status, value = data.StatusCode, None if data.Value is None else data.Value.Value
    quality = "good"
    if value is None or (status is not None and status.is_bad()):
        quality = "bad"
    elif status is not None and status.is_uncertain():
        quality = "uncertain"
    source_time, server_time = (
        None if t is None or t.year <= NO_TIME_YEAR else t.replace(tzinfo=t.tzinfo or UTC).timestamp()
        for t in (data.SourceTimestamp, data.ServerTimestamp)
    )
    return Sample(
        node,
        server_time if source_time is None else source_time,
        value,
        quality,
        "Good" if status is None else type(status)(type(status.value)(status.value & NAME_MASK)).name,
        status is not None and status.value & OVERFLOW_MASK == OVERFLOW,
        received,
        math.nan if server_time is None else server_time,
    )


def status_name(fault: Exception) -> str:
    """The name of an exception's status code, such as "BadTimeout", or else the exception's message."""
    return type(fault).__name__ if type(fault).__name__.startswith("Bad") else str(fault)[:80]


def fault_text(fault: Exception) -> str:
    """Message for an exception of asyncua or the network."""
    if isinstance(fault, SourceFault):
        return str(fault)
    if isinstance(fault, ConnectionRefusedError):
        return "nothing listens there"
    if isinstance(fault, socket.gaierror):
        return f"the host is not known ({fault.strerror})"
    if isinstance(fault, TimeoutError):
        return "no answer in time"
    name = status_name(fault)
    if name in STATUS_REMEDIES:
        return f"{STATUS_REMEDIES[name]} ({name})"
    return " ".join(f"{type(fault).__name__} {fault}".split())[:160].strip()


SERVER_ANSWER_S = 5.0
"""Longest time [s] for a server's answer."""
HISTORY_ANSWER_S = 30.0
"""Longest time [s] for the answer to a history request."""
WATCH_S = 5.0
"""Time [s] between two checks that the server still answers."""
KEEP_ALIVE_S = 10.0
"""Time [s] without changes after which the server sends a keep-alive."""
LIFETIME_S = 120.0
"""Time [s] for which the server keeps the session and the subscription of a lost client."""
NODES_PER_REQUEST = 500
"""Largest number of nodes in a request."""
SAMPLES_AT_ONCE = 1_000
"""Largest number of samples in the answer to a history request."""
NO_FILTER = ("BadMonitoredItemFilterUnsupported", "BadMonitoredItemFilterInvalid", "BadFilterNotAllowed")
"""Status codes of a server that does not support the filter by time stamp."""


class Connection:
    """A session and its subscription.

    Call `open` and `subscribe`, then `samples` and `history` as long as `check` raises nothing, and `close`
    in any case.
    """

    def __init__(self, server: Server, security: Security | None) -> None:
        self.unfiltered = False
        """Whether the server reports only changes, that is omits repeated equal values."""
        self.dropped: set[Node] = set()
        """Nodes that lost samples because the queue of this client was full; the caller empties the set."""
        self._server, self._security = server, security
        self._ua = library().ua
        self._client: Client | None = None
        self._subscription: Subscription
        self._handles: dict[int, Node] = {}
        self._ids: dict[Node, ua.NodeId] = {}
        self._queued: list[tuple[Node, ua.DataValue, float]] = []
        self._arrived = asyncio.Event()
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
            client.uaclient.protocol.timeout = HISTORY_ANSWER_S
        except Exception as fault:  # asyncua raises many exceptions, also while decoding
            reason = await self._explanation(fault)
            await self.close()
            raise SourceFault(reason) from None

    @property
    def _open_client(self) -> Client:
        assert self._client is not None
        return self._client

    async def _new_client(self) -> Client:
        from asyncua.crypto import security_policies
        from asyncua.crypto.uacrypto import CertProperties

        client: Client = library().Client(
            self._server.endpoint, timeout=SERVER_ANSWER_S, watchdog_intervall=WATCH_S
        )
        client.name = client.description = f"hygrokf on {socket.gethostname()}"
        client.session_timeout = int(1e3 * LIFETIME_S)
        client.connection_lost_callback = self._note_loss
        security = self._security
        if security is not None:
            client.application_uri = security.application_uri
            await client.set_security(
                getattr(security_policies, f"SecurityPolicy{security.policy}"),
                CertProperties(security.certificate, "der"),
                CertProperties(security.key, "der"),
                server_certificate=CertProperties(security.server_certificate, "der"),
                mode=self._ua.MessageSecurityMode[security.mode],
            )
        if self._server.user:
            client.set_user(self._server.user)
            client.set_password(self._server.password.read() or "")
        return client

    async def _create_subscription(self, client: Client) -> None:
        """Create the subscription without asyncua's automatic renewal, which would not read missed samples
        from the history."""
        from asyncua.common.subscription import Subscription

        requested = self._ua.CreateSubscriptionParameters()
        requested.RequestedPublishingInterval = 1e3 * self._server.publishing_s
        requested.RequestedMaxKeepAliveCount = math.ceil(KEEP_ALIVE_S / self._server.publishing_s)
        requested.RequestedLifetimeCount = math.ceil(LIFETIME_S / self._server.publishing_s)
        requested.MaxNotificationsPerPublish = QUEUE_SIZE
        requested.PublishingEnabled = True
        subscription = self._subscription = Subscription(client.uaclient.session, requested, self)
        granted = await subscription.init()
        subscription.last_publish_at = time.monotonic()
        self._stale_s = (
            2e-3 * granted.RevisedPublishingInterval * granted.RevisedMaxKeepAliveCount + SERVER_ANSWER_S
        )

    async def close(self) -> None:
        """End session and subscription if the server still answers."""
        client, self._client = self._client, None
        if client is None:
            return
        protocol = client.uaclient.protocol
        with suppress(Exception):
            await asyncio.wait_for(client.disconnect(), SERVER_ANSWER_S)
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
            time_utc = await node.read_value()
            return (time_utc if time_utc.tzinfo else time_utc.replace(tzinfo=UTC)).timestamp()
        except Exception as fault:
            raise SourceFault(fault_text(fault)) from None

    async def _note_loss(self, fault: Exception) -> None:
        self._lost = self._lost or f"the connection is lost ({fault_text(fault)})"

    async def _explanation(self, fault: Exception) -> str:
        """Message that says why a connection failed; it compares the configuration with the endpoints that
        the server offers."""
        text = fault_text(fault)
        if isinstance(fault, ConnectionRefusedError | socket.gaierror | SourceFault):
            return text
        text = await self._mismatch() or text
        if self._security is not None and self._security.valid_until < time.time():
            text += (
                f"; this client's certificate was valid until {stamp_text(self._security.valid_until)}: "
                "make a new one"
            )
        return text

    async def _mismatch(self) -> str:
        """A message if policy, mode or certificate of the server differ from the configuration; "" if they
        agree or are unknown."""
        security, client = (
            self._security,
            library().Client(self._server.endpoint, timeout=0.4 * SERVER_ANSWER_S),
        )
        try:
            offers = await client.connect_and_get_server_endpoints()
        except Exception:  # the server does not answer unsecured clients, or does not answer at all
            return ""
        configured = "no security" if security is None else f"{security.policy} {security.mode}"
        offered = {_security_name(offer): offer.ServerCertificate or b"" for offer in offers}
        if configured not in offered:
            return (
                f"the server has no connection with {configured}; it offers "
                f"{', '.join(sorted(offered)) or 'none'}"
            )
        if security is not None and not offered[configured].startswith(security.server_certificate):
            return (
                "the server's certificate is not the one in server_certificate: find out whether it was "
                "replaced, and state the new one only then"
            )
        return ""

    # -- the subscription ------------------------------------------------------------------------------------
    async def subscribe(self, nodes: Sequence[Node]) -> dict[Node, str]:
        """Subscribe to nodes; returns refused node -> the server's reason.  Raises SourceFault."""
        try:
            refused = await self._look_up_ids(nodes)
            for filtered in (True, False):  # without the filter if the server does not support it
                requested = [
                    node
                    for node in nodes
                    if node in self._ids and (filtered or refused.get(node) in NO_FILTER)
                ]
                for start in range(0, len(requested), NODES_PER_REQUEST):
                    part = requested[start : start + NODES_PER_REQUEST]
                    results = await self._subscription.create_monitored_items(
                        [self._item(node, filtered) for node in part]
                    )
                    for node, result in zip(part, results, strict=True):
                        refused.pop(node, None)
                        if isinstance(result, self._ua.StatusCode):
                            refused[node] = result.name
                        self.unfiltered |= not filtered
        except Exception as fault:
            raise SourceFault(fault_text(fault)) from None
        return refused

    async def _look_up_ids(self, nodes: Iterable[Node]) -> dict[Node, str]:
        """Look up the ids of nodes, because some servers renumber their namespaces at a restart.

        Returns node with an unknown namespace -> reason.
        """
        ua = self._ua
        refused: dict[Node, str] = {}
        parsed = {node: ua.NodeId.from_string(node.id) for node in nodes}
        has_uris = any(getattr(node_id, "NamespaceUri", None) for node_id in parsed.values())
        namespaces = await self._open_client.get_namespace_array() if has_uris else []
        for node, node_id in parsed.items():
            uri = getattr(node_id, "NamespaceUri", None)
            if uri and uri not in namespaces:
                refused[node] = "the server has no such namespace"
                continue
            if uri:
                node_id = ua.NodeId(node_id.Identifier, namespaces.index(uri), node_id.NodeIdType)
            self._ids[node] = node_id
        return refused

    def _item(self, node: Node, filtered: bool) -> ua.MonitoredItemCreateRequest:
        """The request to monitor a node; `filtered`: with the filter that reports also an equal value with a
        new time stamp."""
        ua = self._ua
        parameters = ua.MonitoringParameters()
        parameters.ClientHandle = len(self._handles) + 1
        parameters.SamplingInterval = 1e3 * self._server.sampling_s
        parameters.QueueSize = self._server.queue
        parameters.DiscardOldest = True
        if filtered:
            parameters.Filter = ua.DataChangeFilter(Trigger=ua.DataChangeTrigger.StatusValueTimestamp)
        item = ua.MonitoredItemCreateRequest()
        item.ItemToMonitor = ua.ReadValueId(NodeId=self._ids[node], AttributeId=ua.AttributeIds.Value)
        item.MonitoringMode = ua.MonitoringMode.Reporting
        item.RequestedParameters = parameters
        self._handles[parameters.ClientHandle] = node
        return item

    def datachange_notification(self, node: UaNode, value: object, data: DataChangeNotif) -> None:
        """Queue a sample; called by asyncua."""
        handle = data.subscription_data.client_handle
        assert handle is not None, "every item is requested with a handle"
        configured_node = self._handles[handle]
        if len(self._queued) < QUEUE_SIZE:
            self._queued.append(
                (configured_node, data.monitored_item.Value or self._ua.DataValue(), time.time())
            )
        else:
            self.dropped.add(configured_node)
        self._arrived.set()

    def status_change_notification(self, notification: ua.StatusChangeNotification) -> None:
        """Record that the server has ended the subscription; called by asyncua."""
        self._lost = self._lost or f"the server ended the subscription ({notification.Status.name})"

    async def samples(self, patience_s: float) -> list[Sample]:
        """Samples since the last call; waits up to `patience_s` [s] for the first one."""
        with suppress(TimeoutError):
            await asyncio.wait_for(self._arrived.wait(), patience_s)
        self._arrived.clear()
        queued, self._queued = self._queued, []
        return [sample_of(node, data, received) for node, data, received in queued]

    # -- history ---------------------------------------------------------------------------------------------
    async def without_history(self, nodes: Sequence[Node]) -> dict[Node, str]:
        """Subscribed node whose access level excludes reading its history -> reason.  Raises SourceFault.

        The access level is needed because a server without a history may answer a history request with an
        empty one.  Nodes whose access level the server does not tell are omitted.
        """
        ua, reasons = self._ua, dict[Node, str]()
        attributes = {
            "AccessLevel": "the node's AccessLevel has no HistoryRead: the server keeps no history of it",
            "UserAccessLevel": "this user's access level has no HistoryRead",
        }
        try:
            for name, reason in attributes.items():
                requested = [node for node in nodes if node in self._ids and node not in reasons]
                for start in range(0, len(requested), NODES_PER_REQUEST):
                    part = requested[start : start + NODES_PER_REQUEST]
                    levels = await self._open_client.uaclient.read_attributes(
                        [self._ids[node] for node in part], ua.AttributeIds[name]
                    )
                    for node, level in zip(part, levels, strict=True):
                        value = level.Value.Value if level.Value is not None else None
                        if isinstance(value, int) and not value & (1 << ua.AccessLevel.HistoryRead):
                            reasons[node] = reason
        except ua.UaStatusCodeError:  # this server does not tell access levels
            return reasons
        except Exception as fault:
            raise SourceFault(fault_text(fault)) from None
        return reasons

    async def history(self, node: Node, since_s: float, until_s: float) -> AsyncIterator[Sample]:
        """A node's samples in since_s < time ≤ until_s [s], sorted by time.  Raises HistoryFault,
        SourceFault."""
        ua = self._ua
        details = ua.ReadRawModifiedDetails(
            NumValuesPerNode=SAMPLES_AT_ONCE, ReturnBounds=False, IsReadModified=False
        )
        details.EndTime = datetime.fromtimestamp(until_s, UTC)
        while True:
            details.StartTime = datetime.fromtimestamp(since_s, UTC)
            page, more = await self._page(node, details)
            timed = ((s.time, s) for s in page if s.time is not None and since_s < s.time <= until_s)
            new = sorted(timed, key=lambda pair: pair[0])
            for _, sample in new:
                yield sample
            if not new or (len(page) < SAMPLES_AT_ONCE and not more):
                return
            since_s = new[-1][0]

    async def _page(self, node: Node, details: ua.ReadRawModifiedDetails) -> tuple[list[Sample], bool]:
        """A page of a node's history, and whether the server has more.

        The next page is requested by time instead of a continuation point, because many nodes are read at
        once and servers offer few continuation points.
        """
        ua = self._ua
        value = ua.HistoryReadValueId(NodeId=self._ids[node])
        request = ua.HistoryReadParameters(details, ua.TimestampsToReturn.Both, False, [value])
        try:
            (result,) = await self._open_client.uaclient.history_read(request)
            more = result.ContinuationPoint
            if more:
                value.ContinuationPoint = more
                request.ReleaseContinuationPoints = True
                with suppress(ua.UaStatusCodeError):
                    await self._open_client.uaclient.history_read(request)
            result.StatusCode.check()
        except ua.UaStatusCodeError as fault:
            raise HistoryFault(status_name(fault)) from None
        except TimeoutError:
            self.check()
            raise HistoryFault(f"no answer within {HISTORY_ANSWER_S:g} s") from None
        except Exception as fault:
            raise SourceFault(fault_text(fault)) from None
        now = time.time()
        values = getattr(result.HistoryData, "DataValues", None) or ()
        return [sample_of(node, value, now) for value in values], bool(more)


def _security_name(offer: ua.EndpointDescription) -> str:
    policy = offer.SecurityPolicyUri.rpartition("#")[2].replace("_", "")
    return "no security" if policy == "None" else f"{policy} {offer.SecurityMode.name}"
