"""A PostgreSQL server of the tests' own: made by initdb, on a free port of the loopback, ended with the
tests."""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from builders.ports import free_port

OWNER = "owner"
STARTING_S = 60.0


def program(name: str) -> str | None:
    """A program of PostgreSQL, where the path or Debian's folders have one."""
    places = sorted(Path("/usr/lib/postgresql").glob(f"*/bin/{name}"))
    # the real folder, not a link: the programs find each other beside themselves
    return str(places[-1]) if places else shutil.which(name)


def other_user() -> dict:
    """As whom the server runs: it refuses to be root."""
    if not hasattr(os, "geteuid") or os.geteuid() != 0:
        return {}
    import pwd

    for name in ("postgres", "nobody"):
        with contextlib.suppress(KeyError):
            found = pwd.getpwnam(name)
            return {"user": found.pw_uid, "group": found.pw_gid, "extra_groups": []}
    pytest.skip("no user to run PostgreSQL as: it refuses to be root")


class Server:
    """A server in a folder of its own; over its socket everybody is trusted, over TCP a password is asked
    for."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.data, self.port = folder, folder / "data", free_port()
        self.password = secrets.token_urlsafe(12)
        self._as = other_user()
        self._process: subprocess.Popen | None = None
        if self._as:
            os.chown(folder, self._as["user"], self._as["group"])
        self._run(
            program("initdb"), "-D", self.data, "-U", OWNER, "--no-sync", "--encoding=UTF8", "--locale=C",
            "--auth-local=trust", "--auth-host=scram-sha-256",
        )  # fmt: skip
        self._set(
            "listen_addresses = '127.0.0.1'", f"port = {self.port}", f"unix_socket_directories = '{folder}'",
            "shared_buffers = 16MB", "max_connections = 30",
            # a killed server leaves to the system what it wrote: only a machine that stops would lose it
            "fsync = off",
        )  # fmt: skip

    def _run(self, *command: object) -> None:
        done = subprocess.run(
            [str(c) for c in command],
            cwd=self.folder,
            capture_output=True,
            text=True,
            check=False,
            **self._as,
        )
        assert done.returncode == 0, done.stdout + done.stderr

    def _set(self, *lines: str) -> None:
        with open(self.data / "postgresql.conf", "a", encoding="utf-8") as file:
            file.write("".join(f"{one}\n" for one in lines))

    def certify(self) -> bool:
        """Speak TLS as "localhost", with a certificate that is its own authority; False without openssl."""
        if shutil.which("openssl") is None:
            return False
        self._run(
            "openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes",
            "-days", "2",
            "-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost",
            "-keyout", self.data / "server.key", "-out", self.data / "server.crt",
        )  # fmt: skip
        (self.data / "server.key").chmod(0o600)
        self._set("ssl = on")
        return True

    # -- running ---------------------------------------------------------------------------------------------
    def start(self) -> None:
        """Start, and wait until it answers."""
        import psycopg

        with open(self.folder / "log", "ab") as log:
            self._process = subprocess.Popen(
                [program("postgres"), "-D", self.data],
                cwd=self.folder, stdout=log, stderr=log, stdin=subprocess.DEVNULL, **self._as,
            )  # fmt: skip
        end = time.monotonic() + STARTING_S
        while True:
            try:
                psycopg.connect(self.url("postgres"), connect_timeout=5).close()
                return
            except psycopg.OperationalError:
                log = (self.folder / "log").read_text(encoding="utf-8", errors="replace")[-3000:]
                assert self._process.poll() is None and time.monotonic() < end, log
                time.sleep(0.05)

    @property
    def is_running(self) -> bool:
        return self._process is not None and self._process.poll() is None

    def stop(self) -> None:
        """End it at once: sessions are broken off."""
        if self.is_running:
            self._process.send_signal(signal.SIGQUIT)
            try:
                self._process.wait(timeout=30.0)
            except subprocess.TimeoutExpired:
                self.kill()
        self._process = None

    def kill(self) -> None:
        """The server and all of its processes die where they are."""
        assert self._process is not None
        # stopped first: a process that it starts after they were counted would live on, and keep the next
        # server from starting
        self._process.send_signal(signal.SIGSTOP)
        family = [self._process.pid, *children(self._process.pid)]
        for one in family:
            with contextlib.suppress(ProcessLookupError):
                os.kill(one, signal.SIGKILL)
        self._process.wait(timeout=STARTING_S)
        end = time.monotonic() + STARTING_S
        while any(is_alive(one) for one in family):
            assert time.monotonic() < end, "a killed server lives on"
            time.sleep(0.01)
        self._process = None

    # -- databases -------------------------------------------------------------------------------------------
    def url(self, name: str, user: str = OWNER, **parameters: str) -> str:
        """A database through the socket, where no password is needed."""
        more = "".join(f"&{key}={value}" for key, value in parameters.items())
        return f"postgresql://{user}@/{name}?host={self.folder}&port={self.port}{more}"

    def tcp_url(self, name: str, user: str = OWNER, **parameters: str) -> str:
        more = "&".join(f"{key}={value}" for key, value in parameters.items())
        return f"postgresql://{user}@127.0.0.1:{self.port}/{name}{'?' if more else ''}{more}"

    def execute(self, name: str, *statements: str) -> list[tuple]:
        """Run statements as the owner; rows of the last one."""
        import psycopg

        with psycopg.connect(self.url(name), autocommit=True) as connection:
            for statement in statements:
                cursor = connection.execute(statement)
            return cursor.fetchall() if cursor.description else []

    def database(self) -> str:
        """The name of a new and empty database."""
        name = f"live_{secrets.token_hex(6)}"
        self.execute("postgres", f"CREATE DATABASE {name}")
        return name


def children(process: int) -> list[int]:
    """Processes that a process has started."""
    said = subprocess.run(["ps", "-A", "-o", "pid=,ppid="], capture_output=True, text=True, check=True).stdout
    pairs = [tuple(map(int, line.split())) for line in said.splitlines()]
    return [one for one, parent in pairs if parent == process]


def is_alive(process: int) -> bool:
    """Whether a process still runs; one that is dead and not waited for does not."""
    said = subprocess.run(
        ["ps", "-o", "stat=", "-p", str(process)], capture_output=True, text=True, check=False
    )
    return said.stdout.strip()[:1] not in ("", "Z")


@contextlib.contextmanager
def running_server() -> Iterator[Server]:
    """A server that ends with the block."""
    # another user must be able to enter the folder, and a socket's path must be short: not in pytest's folder
    folder = Path(tempfile.mkdtemp(prefix="hygrokf-pg-"))
    try:
        server = Server(folder)
        server.certify()
        try:
            server.start()
            server.execute("postgres", f"ALTER ROLE {OWNER} PASSWORD '{server.password}'")
            yield server
        finally:
            server.stop()
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="session")
def postgresql() -> Iterator[Server]:
    """One running server for all tests; each takes a database of its own.  Skips where PostgreSQL is not
    installed."""
    if os.name == "nt" or program("initdb") is None or program("postgres") is None:
        pytest.skip(
            "PostgreSQL is not installed: no initdb and postgres on the path or in /usr/lib/postgresql"
        )
    with running_server() as server:
        yield server


@pytest.fixture(params=["sqlite", "postgresql"])
def store_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """A place for a store, in each of the two databases."""
    if request.param == "sqlite":
        return f"sqlite:{tmp_path / 'live.db'}"
    made = request.getfixturevalue("postgresql")
    schema = f"live_{secrets.token_hex(6)}"
    made.execute("postgres", f"CREATE SCHEMA {schema}")  # a database of its own would be a copy of 7 MB
    return made.url("postgres", options=f"-csearch_path%3D{schema}")
