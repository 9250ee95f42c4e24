"""An OPC UA server in a process of its own, told over its standard input what to hold; run as a script it is
that server.

What it records outlives it: a journal of one sample a line, which the next server on the same folder reads
in.
"""

from __future__ import annotations

import asyncio
import json
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path

from builders.ports import free_port

PATIENCE_S = 120.0
NAMESPACE = "urn:plant:cabinets"
MOST = 40
"""Samples of one answer from the history, whatever was asked for."""


class Peer:
    """A server on loopback.

    `certificate` and `key` are files, with `closed` it has no connection that is not encrypted, `users` name
    -> password; with `clock` it tells its time.  A sample is (node, time [s] or None, value, status code).
    """

    def __init__(self, folder: Path, port: int = 0, **settings: object) -> None:
        self.port = port or free_port()
        self.url = f"opc.tcp://127.0.0.1:{self.port}/cabinets"
        self._settings = {"url": self.url, "journal": str(folder / "journal"), **settings}
        self._process: subprocess.Popen | None = None

    def prepare(self) -> None:
        """Start the process, which holds its nodes but does not listen yet."""
        command = [sys.executable, "-m", "builders.opcua_peer", json.dumps(self._settings)]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=Path(__file__).parents[1]
        )
        assert self._answer() == "prepared"

    def listen(self) -> None:
        self._ask({"do": "listen"})

    def start(self) -> Peer:
        self.prepare()
        self.listen()
        return self

    def add(
        self, nodes: Iterable[str], history: str = "kept", value: object = None, filters: bool = True
    ) -> None:
        """Add nodes, with a value (None: nobody has measured yet).

        Their history is "kept", "none" (there never is any, which their access level says), "refused" or
        "failing" (it is kept, and cannot be read now). Without `filters`
        their changes are told as they are by default.
        """
        what = {"nodes": list(nodes), "history": history, "value": value, "filters": filters}
        self._ask({"do": "add", **what})

    def record(self, samples: Iterable[tuple]) -> None:
        """Record samples in the history only."""
        self._ask({"do": "record", "samples": list(samples)})

    def write(self, samples: Iterable[tuple], pause_s: float = 0.0) -> None:
        """Record samples, each of which is the node's value for `pause_s` [s] at least."""
        self._ask({"do": "write", "samples": list(samples), "pause_s": pause_s})

    def killed_while_writing(self, samples: Iterable[tuple], pause_s: float, after_s: float) -> None:
        """Write samples, and kill the server `after_s` [s] after it has noted them in its journal."""
        journal = Path(self._settings["journal"])
        before = journal.stat().st_size
        what = {"do": "write", "samples": list(samples), "pause_s": pause_s}
        self._process.stdin.write(json.dumps(what).encode() + b"\n")
        self._process.stdin.flush()
        end = time.monotonic() + PATIENCE_S
        while journal.stat().st_size == before:
            assert time.monotonic() < end, "the server has noted nothing"
            time.sleep(0.002)
        time.sleep(after_s)
        self.kill()

    def stall(self) -> None:
        """Stop the process where it is, with its connections open, until `go_on`."""
        self._process.send_signal(signal.SIGSTOP)

    def go_on(self) -> None:
        self._process.send_signal(signal.SIGCONT)

    def asked_of(self) -> dict[str, int]:
        """How often clients have written, called a method, or read history."""
        return self._ask({"do": "report"})

    def kill(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait(PATIENCE_S)
            self._process.stdin.close()
            self._process.stdout.close()
            self._process = None

    def __enter__(self) -> Peer:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    def _ask(self, what: dict) -> object:
        self._process.stdin.write(json.dumps(what).encode() + b"\n")
        self._process.stdin.flush()
        return self._answer()

    def _answer(self) -> object:
        ready, _, _ = select.select([self._process.stdout], [], [], PATIENCE_S)
        line = self._process.stdout.readline() if ready else b""
        assert line, f"the server has not answered; it ended with {self._process.poll()}"
        return json.loads(line)


# -- the server ----------------------------------------------------------------------------------------------
class Plant:
    """What the server's process does; imports asyncua, which the test itself may be without."""

    def __init__(self, settings: dict) -> None:
        self.settings = settings
        self.asked = {"written": 0, "called": 0, "history": 0}
        self.histories: dict[str, str] = {}
        self.unfiltered: set[str] = set()

    async def made(self) -> None:
        """The server, as it stands before it listens."""
        from asyncua import Server, ua

        settings = self.settings
        self.server = server = Server(user_manager=self)
        await server.init()
        server.set_endpoint(settings["url"])
        if not settings.get("clock"):
            server.disable_clock()
        if "certificate" in settings:
            await server.set_application_uri("urn:plant:server")
            await server.load_certificate(settings["certificate"])
            await server.load_private_key(settings["key"], format="pem")
        if "users" in settings:
            server.set_identity_tokens([ua.UserNameIdentityToken])
        encrypted = [ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt]
        open_ = [] if settings.get("closed") else [ua.SecurityPolicyType.NoSecurity]
        server.set_security_policy([*open_, *encrypted])
        assert await server.register_namespace(NAMESPACE) == 2
        server.iserver.history_manager.set_storage(self._storage())
        self._count("write", "written")
        self._count("call", "called")
        self._refuse_filters()

    def get_user(self, iserver, username=None, password=None, certificate=None):
        from asyncua.crypto.permission_rules import User, UserRole

        known = self.settings.get("users")
        allowed = known is None or (username in known and known[username] == password)
        return User(role=UserRole.User, name=username) if allowed else None

    def _storage(self):
        from asyncua import ua
        from asyncua.common.utils import ServiceError
        from asyncua.server.history import HistoryDict

        plant = self

        class Journal(HistoryDict):
            async def read_node_history(self, node_id, start, end, nb_values):
                plant.asked["history"] += 1
                mode = plant.histories[node_id.to_string()]
                if mode == "refused":
                    raise ServiceError(ua.StatusCodes.BadHistoryOperationUnsupported)
                if mode == "failing":
                    raise ServiceError(ua.StatusCodes.BadResourceUnavailable)
                return await super().read_node_history(node_id, start, end, nb_values)

        return Journal(max_history_data_response_size=MOST)

    def _count(self, service: str, name: str) -> None:
        """Count what clients ask of a service of their sessions."""
        kind = type(self.server.iserver.isession)
        original = getattr(kind, service)

        async def counted(session, parameters):
            self.asked[name] += int(session.external)
            return await original(session, parameters)

        setattr(kind, service, counted)

    def _refuse_filters(self) -> None:
        from asyncua import ua
        from asyncua.server.monitored_item_service import MonitoredItemService

        original = MonitoredItemService._create_data_change_monitored_item

        async def created(service, item):
            if item.ItemToMonitor.NodeId.to_string() in self.unfiltered and item.RequestedParameters.Filter:
                refused = ua.StatusCode(ua.StatusCodes.BadMonitoredItemFilterUnsupported)
                return ua.MonitoredItemCreateResult(StatusCode=refused)
            return await original(service, item)

        MonitoredItemService._create_data_change_monitored_item = created

    async def do(self, what: dict) -> object:
        """One command; what to answer."""
        if what["do"] == "listen":
            await self.server.start()
        elif what["do"] == "add":
            for name in what["nodes"]:
                await self._add(name, what)
        elif what["do"] in ("write", "record"):
            self._journal({**what, "pause_s": 0.0})
            for number, sample in enumerate(what["samples"]):
                await self._take(sample, what["do"] == "write")
                if what.get("pause_s") or number % 100 == 99:
                    await asyncio.sleep(what.get("pause_s", 0.0))
        return self.asked if what["do"] == "report" else what["do"]

    async def _add(self, name: str, what: dict) -> None:
        from asyncua import ua

        self._journal({**what, "nodes": [name]})
        known, value = name in self.histories, what["value"]
        self.histories[name] = what["history"]
        if not what["filters"]:
            self.unfiltered.add(name)
        if known:
            return
        node_id = ua.NodeId.from_string(name)
        first = 0.0 if value is None else value
        node = await self.server.nodes.objects.add_variable(node_id, ua.QualifiedName(name, 2), first)
        if value is None:
            waiting = self._value(None, None, ua.StatusCodes.BadWaitingForInitialData)
            await self.server.write_attribute_value(node.nodeid, waiting)
        if what["history"] != "none":
            for attribute in (ua.AttributeIds.AccessLevel, ua.AttributeIds.UserAccessLevel):
                await node.set_attr_bit(attribute, ua.AccessLevel.HistoryRead)
        await self.server.iserver.history_manager.storage.new_historized_node(node_id, None, 0)

    async def _take(self, sample: list, current: bool) -> None:
        from asyncua import ua

        name, at, value, status = sample
        node_id, found = ua.NodeId.from_string(name), self._value(at, value, status)
        if at is not None and self.histories[name] != "none":
            await self.server.iserver.history_manager.storage.save_node_value(node_id, found)
        if current:
            await self.server.write_attribute_value(node_id, found)

    def _journal(self, what: dict) -> None:
        with open(self.settings["journal"], "a", encoding="utf-8") as file:
            file.write(json.dumps(what) + "\n")

    def _value(self, at: float | None, value: object, status: int):
        from asyncua import ua

        kind = ua.VariantType.Double if type(value) in (int, float) else None
        variant = ua.Variant(None, ua.VariantType.Null) if value is None else ua.Variant(value, kind)
        moment = None if at is None else datetime.fromtimestamp(at, UTC)
        return ua.DataValue(variant, StatusCode=ua.StatusCode(status), SourceTimestamp=moment)


async def serve(settings: dict) -> None:
    plant = Plant(settings)
    await plant.made()
    journal = Path(settings["journal"])
    past = journal.read_text(encoding="utf-8").splitlines() if journal.exists() else []
    journal.unlink(missing_ok=True)
    for line in past:
        await plant.do(json.loads(line))
    lines = asyncio.StreamReader(limit=2**26)
    await asyncio.get_running_loop().connect_read_pipe(lambda: asyncio.StreamReaderProtocol(lines), sys.stdin)
    answer = "prepared"
    while True:
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()
        line = await lines.readline()
        if not line:
            return
        answer = await plant.do(json.loads(line))


if __name__ == "__main__":
    asyncio.run(serve(json.loads(sys.argv[1])))
