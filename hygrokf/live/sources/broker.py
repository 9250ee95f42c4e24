"""Where an MQTT broker is, what is asked of it and who asks: from the tracker's file, with every fault in words.

A password stands in a file or in an environment variable, never in the tracker's file or a URL.  Both are read anew for
every connection, as certificates are, so that what was renewed is used without a restart.
"""

from __future__ import annotations

import hashlib
import os
import socket
import ssl
from collections.abc import Iterator
from collections.abc import Mapping as MappingOf
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote, unquote, urlsplit

from hygrokf.live.sources.streams import SourceFault
from hygrokf.live.storage.store import Alarm
from hygrokf.live.table_reader import TableReader

PORTS = {"mqtt": 1883, "mqtts": 8883}
"""Scheme of a URL -> port where none is stated."""
EXPIRY_S = 7.0 * 86400.0
"""[s] for which a broker keeps the session of a tracker that is away."""
LEAST_EXPIRY_S, MOST_EXPIRY_S = 60.0, 2.0**32 - 2.0
LONGEST_TOPIC = 65_535
"""[bytes] of a topic in UTF-8."""
LONGEST_NAME = 100
OTHERS_READ = 0o004
"""Bit of a file's mode: every user of the machine may read it."""

_KEYS = (
    "url", "topics", "alarms", "client_id", "session_expiry", "user", "password_file", "password_env",
    "ca", "certificate", "key",
)  # fmt: skip
_TLS = ("ca", "certificate", "key")


@dataclass(frozen=True)
class Broker:
    """A broker and a session on it: `topics` filters, `alarms` the topic below which alarms are told ("" for none).

    `expiry_s` [s] for which the session outlives a connection; `ca` None trusts what the system trusts.
    """

    host: str
    port: int
    tls: bool
    topics: tuple[str, ...]
    client_id: str
    expiry_s: float = EXPIRY_S
    alarms: str = ""
    user: str = ""
    password_file: Path | None = None
    password_env: str = ""
    ca: Path | None = None
    certificate: Path | None = None
    key: Path | None = None

    @property
    def where(self) -> str:
        """Host and port, as in a URL."""
        return f"{_bracketed(self.host)}:{self.port}"

    @property
    def url(self) -> str:
        """The source's name: broker and session, without user and password."""
        return f"{'mqtts' if self.tls else 'mqtt'}://{self.where}?client_id={quote(self.client_id)}"

    def password(self) -> str | None:
        """The password as it is now; None where none is used.  Raises SourceFault."""
        if self.password_env:
            found = os.environ.get(self.password_env, "")
            if not found:
                raise SourceFault(
                    f"password_env: the environment variable {self.password_env} is not set or empty"
                )
            return found
        if self.password_file is None:
            return None
        try:
            found = self.password_file.read_text(encoding="utf-8").rstrip("\r\n")
        except OSError as fault:
            raise SourceFault(f"password_file: {self.password_file}: {fault.strerror}") from None
        except UnicodeDecodeError:
            raise SourceFault(f"password_file: {self.password_file}: expected text in UTF-8") from None
        if not found or "\n" in found:
            raise SourceFault(
                f"password_file: {self.password_file}: expected one line, the password, and nothing else"
            )
        return found

    def context(self) -> ssl.SSLContext | None:
        """How TLS is spoken, chain and name of the broker's certificate verified; None without TLS.  Raises SourceFault."""
        if not self.tls:
            return None
        try:
            context = ssl.create_default_context(cafile=self.ca)
        except (OSError, ssl.SSLError) as fault:
            raise SourceFault(f"ca: {self.ca}: {_file_words(fault, 'certificates in PEM')}") from None
        context.sslsocket_class = _ClosingSocket
        if self.certificate is not None:
            try:
                # an empty passphrase: a key that has one is refused, not asked for at a terminal
                context.load_cert_chain(self.certificate, self.key, password="")
            except (OSError, ssl.SSLError) as fault:
                said = _file_words(
                    fault, "a certificate in PEM and the key that belongs to it, without a passphrase"
                )
                raise SourceFault(f"certificate {self.certificate}, key {self.key}: {said}") from None
        return context

    def cautions(self) -> Iterator[str]:
        """What works but should not stay so, in words."""
        for name, path in (("password_file", self.password_file), ("key", self.key)):
            if path is not None and os.name == "posix" and path.exists():
                if path.stat().st_mode & OTHERS_READ:
                    yield f"{name}: every user of this machine may read {path}: chmod o-rwx {path}"
        if self.user and not self.tls and self.host not in ("localhost", "127.0.0.1", "::1"):
            yield f"user and password go to {self.where} in plain text: use mqtts://"


class _ClosingSocket(ssl.SSLSocket):
    """A socket that closes itself where the handshake fails: whoever made it keeps no hold of it then."""

    def do_handshake(self, block: bool = False) -> None:
        try:
            super().do_handshake(block)
        except BaseException:
            self.close()
            raise


def _file_words(fault: OSError, expected: str) -> str:
    if isinstance(fault, ssl.SSLError):
        return f"expected {expected}, found {fault.reason or 'nothing of the kind'}"
    return fault.strerror or str(fault)


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host


# -- topics ----------------------------------------------------------------------------------------------------------
def filter_fault(text: str) -> str | None:
    """What is wrong with a topic filter, in words; None for a valid one, shared ones ($share/GROUP/FILTER) included."""
    if not text.isprintable() or not 0 < len(text.encode("utf-8", "surrogatepass")) <= LONGEST_TOPIC:
        return f"a topic filter has 1 to {LONGEST_TOPIC} bytes of printable characters"
    if text.split("/")[0] == "$share":
        _, group, rest = (*text.split("/", 2), "", "")[:3]
        if not group or "+" in group or "#" in group or not rest:
            return "a shared subscription is $share/GROUP/FILTER"
        return filter_fault(rest)
    levels = text.split("/")
    if any("#" in level for level in levels[:-1]) or ("#" in levels[-1] and levels[-1] != "#"):
        return '"#" stands alone, as the last level'
    if any("+" in level and level != "+" for level in levels):
        return '"+" stands alone in its level'
    return None


def alarm_topic(prefix: str, alarm: Alarm) -> str:
    """`PREFIX/TURBINE/KIND` of an alarm, KIND with what it is about where a kind has several.

    What would divide or stand for levels is written as in a URL; blanks of the kind become "_".
    """
    # several alarms of a kind may be open at once, and what tells them apart is in the alarm's name
    name = alarm.id.removeprefix(f"{alarm.turbine}:").rpartition(":")[0]
    kind = name if name.startswith(alarm.kind) else alarm.kind
    return f"{prefix}/{quote(alarm.turbine, safe='')}/{quote(kind.replace(' ', '_'), safe='')}"


# -- from the tracker's file -----------------------------------------------------------------------------------------
def broker_of(table: MappingOf[str, object], where: str, folder: Path, reader: TableReader) -> Broker | None:
    """The broker of a `[[source]]` table; None where `reader` was told why there is none.  Nothing is connected yet."""
    before = len(reader.faults)
    reader.known({key: value for key, value in table.items() if key != "password"}, _KEYS, where)
    if "password" in table:
        reader.faults.append(f"{where}: {_NO_PASSWORD_HERE}")
    scheme, host, port, user = _address(reader.text(table, "url", where), where, reader)
    if "user" in table:
        if user:
            reader.faults.append(f"{where}: user stands in the url and as a key: keep one")
        user = reader.text(table, "user", where)
    named = {
        key: reader.text(table, key, where) for key in ("password_file", "password_env", *_TLS, "alarms")
    }
    files = {key: folder / named[key] if named[key] else None for key in ("password_file", *_TLS)}
    if named["password_file"] and named["password_env"]:
        reader.faults.append(f"{where}: password_file and password_env: keep one")
    if (named["password_file"] or named["password_env"]) and not user:
        reader.faults.append(f"{where}: a password needs its user: add user, or mqtt://USER@HOST")
    if scheme == "mqtt" and (given := [key for key in _TLS if named[key]]):
        reader.faults.append(f"{where}: {', '.join(given)}: only with TLS; write mqtts:// or take this away")
    if bool(named["certificate"]) != bool(named["key"]):
        reader.faults.append(f"{where}: certificate and key belong together: both, or neither")
    expiry_s = reader.seconds(table, "session_expiry", where, EXPIRY_S)
    if not LEAST_EXPIRY_S <= expiry_s <= MOST_EXPIRY_S:
        reader.faults.append(
            f"{where}: session_expiry must be 1 min or more (and fit into 32 bits): for so long the broker keeps "
            f"what comes while the tracker is away, found {table['session_expiry']!r}"
        )
    alarms = named["alarms"]
    if alarms and (wrong := _prefix_fault(alarms)):
        reader.faults.append(f"{where}: alarms: {wrong}, found {alarms!r}")
    client_id = reader.text(table, "client_id", where, default_client_id(f"{scheme}:{host}:{port}", folder))
    if not 0 < len(client_id) <= LONGEST_NAME or not client_id.isprintable():
        reader.faults.append(
            f"{where}: client_id must be text of 1 to {LONGEST_NAME} printable characters, found {client_id!r}"
        )
    broker = Broker(
        host, port, scheme == "mqtts", _topics(table, where, reader), client_id, expiry_s, alarms, user,
        password_env=named["password_env"], **files,
    )  # fmt: skip
    if len(reader.faults) == before:
        for look in (broker.password, broker.context):
            try:
                look()
            except SourceFault as fault:
                reader.faults.append(f"{where}: {fault}")
    return broker if len(reader.faults) == before else None


_NO_PASSWORD_HERE = (
    "a password must not stand in this file: put it into a file of its own and name that as password_file, or into an "
    "environment variable and name that as password_env"
)


def _address(url: str, where: str, reader: TableReader) -> tuple[str, str, int, str]:
    """(scheme, host, port, user) of mqtt[s]://[USER@]HOST[:PORT]; a URL that may hold a password is never shown."""
    scheme, _, rest = url.partition(":")
    login, at, _ = rest.removeprefix("//").rpartition("@")
    if ":" in login:
        reader.faults.append(f"{where}: url: {_NO_PASSWORD_HERE}")
        return scheme, "", PORTS[scheme], ""
    expected = f"{where}: url must be {scheme}://HOST or {scheme}://USER@HOST:PORT"
    try:
        parts = urlsplit(url)
        host, port = parts.hostname or "", parts.port
    except ValueError:
        reader.faults.append(f"{expected}, with a port of 1 to 65535")
        return scheme, "", PORTS[scheme], ""
    if not host or parts.path not in ("", "/") or parts.query or parts.fragment:
        reader.faults.append(f"{expected} and no more{'' if at else f', found {url!r}'}")
    if port == 0:
        reader.faults.append(f"{expected}, with a port of 1 to 65535")
    return scheme, host, PORTS[scheme] if port is None else port, unquote(login)


def _topics(table: MappingOf[str, object], where: str, reader: TableReader) -> tuple[str, ...]:
    topics = table.get("topics", [])
    if not isinstance(topics, list) or not topics or not all(isinstance(one, str) for one in topics):
        reader.faults.append(
            f'{where}: topics must be a list of topic filters such as ["scada/+/cabinet"], found {topics!r}'
        )
        return ()
    for one in topics:
        if (wrong := filter_fault(one)) is not None:
            reader.faults.append(f"{where}: topics: {wrong}, found {one!r}")
    return tuple(dict.fromkeys(topics))


def _prefix_fault(prefix: str) -> str | None:
    """What is wrong with a topic to publish below."""
    if prefix.startswith(("$", "/")) or prefix.endswith("/") or "+" in prefix or "#" in prefix:
        return 'expected a topic such as "hygrokf/alarms", without +, #, a $ or / in front and a / behind'
    return filter_fault(prefix)


def default_client_id(broker: str, folder: Path) -> str:
    """`hygrokf-HOST-DIGEST`: the same after every restart on this machine, another one for another folder or broker."""
    host = "".join(c for c in socket.gethostname().partition(".")[0] if c.isalnum() and c.isascii())[:20]
    digest = hashlib.sha256(f"{broker} {folder.resolve()}".encode()).hexdigest()[:8]
    return f"hygrokf-{host}-{digest}"
