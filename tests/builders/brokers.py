"""MQTT brokers that tests start: mosquitto on a free port of loopback, its files in a folder of the test;
certificates."""

from __future__ import annotations

import getpass
import hashlib
import ipaddress
import json
import os
import shutil
import signal
import socket
import subprocess
import time
from base64 import b64encode
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from builders.ports import free_port
from builders.waiting import PATIENCE_S, eventually

PROGRAM = shutil.which("mosquitto", path=f"{os.environ.get('PATH', '')}:/usr/sbin:/usr/local/sbin")
needs_mosquitto = pytest.mark.skipif(
    PROGRAM is None, reason="mosquitto is not installed (Debian and Ubuntu: apt-get install mosquitto)"
)


class Mosquitto:
    """A broker with its own port, persistence and log; `settings` are further lines of its file."""

    def __init__(self, folder: Path, settings: Iterable[str] = ("allow_anonymous true",)) -> None:
        self.port = free_port()
        self.folder = folder
        self.database = folder / "mosquitto.db"
        self._process: subprocess.Popen | None = None
        lines = [
            f"user {getpass.getuser()}", "persistence true", f"persistence_location {folder}/",
            "set_tcp_nodelay true", "max_inflight_messages 500", "max_queued_messages 100000",
            "log_type all", "connection_messages true", f"listener {self.port} 127.0.0.1", *settings,
        ]  # fmt: skip
        (folder / "mosquitto.conf").write_text("\n".join(lines) + "\n")

    @property
    def url(self) -> str:
        return f"mqtt://127.0.0.1:{self.port}"

    def start(self) -> None:
        with (self.folder / "mosquitto.log").open("ab") as log:
            self._process = subprocess.Popen(
                [PROGRAM, "-c", self.folder / "mosquitto.conf"], stdout=log, stderr=log
            )
        eventually(self._listens)

    def _listens(self) -> bool:
        assert self._process.poll() is None, self.log()
        try:
            socket.create_connection(("127.0.0.1", self.port), timeout=1.0).close()
        except OSError:
            return False
        return True

    def log(self) -> str:
        return (self.folder / "mosquitto.log").read_text(errors="replace")

    def save(self) -> None:
        """Have it write what it holds to its database, as it does by itself every so often."""
        before = self.database.stat().st_mtime_ns if self.database.exists() else 0
        self._process.send_signal(signal.SIGUSR1)
        eventually(lambda: self.database.exists() and self.database.stat().st_mtime_ns > before)

    def kill(self) -> None:
        """End it at once: nothing is written any more."""
        if self._process is not None:
            self._process.kill()
            self._process.wait(timeout=PATIENCE_S)

    def stop(self) -> None:
        """End it as it ends when it is told to: it writes its database."""
        self._process.terminate()
        self._process.wait(timeout=PATIENCE_S)


@contextmanager
def mosquitto(folder: Path, *settings: str) -> Iterator[Mosquitto]:
    """A broker that runs, and ends with the block whatever happens in it."""
    made = Mosquitto(folder, settings or ("allow_anonymous true",))
    try:
        made.start()
        yield made
    finally:
        made.kill()


# -- peers ---------------------------------------------------------------------------------------------------
@contextmanager
def peer(broker: Mosquitto | int, user: str = "", password: str = "") -> Iterator:
    """A client of paho's own making that is connected: what publishes, and what looks over the shoulder."""
    from paho.mqtt.client import Client, MQTTv5
    from paho.mqtt.enums import CallbackAPIVersion

    client = Client(CallbackAPIVersion.VERSION2, protocol=MQTTv5)
    client.reconnect_delay_set(0.1, 0.5)
    client.max_inflight_messages_set(500)
    if user:
        client.username_pw_set(user, password)
    client.connect("127.0.0.1", broker if isinstance(broker, int) else broker.port)
    client.loop_start()
    try:
        eventually(client.is_connected)
        yield client
    finally:
        client.disconnect()
        client.loop_stop()


def publish(
    client,
    messages: Iterable[tuple[str, str | bytes]],
    qos: int = 1,
    retain: bool = False,
    patience_s: float = PATIENCE_S,
) -> None:
    """Publish (topic, payload) and wait until the broker has confirmed all of them."""
    found = [client.publish(topic, payload, qos, retain) for topic, payload in messages]
    end = time.monotonic() + patience_s
    for one in found:
        one.wait_for_publish(max(end - time.monotonic(), 0.01))
        assert one.is_published()


def overheard(client, *topics: str) -> list:
    """The list that messages of some topics go to from now on; their `retain` says whether they were kept."""
    found: list = []
    granted: list = []
    client.on_message = lambda client, userdata, message: found.append(message)
    client.on_subscribe = lambda client, userdata, identifier, codes, properties: granted.extend(codes)
    client.subscribe([(one, 1) for one in topics])
    eventually(lambda: granted)
    return found


# -- rights --------------------------------------------------------------------------------------------------
def dynamic_security(folder: Path, user: str, password: str, denied: str) -> tuple[str, ...]:
    """Settings of a broker whose plugin denies `user` one topic filter, and says so when it is subscribed
    to."""
    plugin = next(Path("/usr/lib").glob("*/mosquitto_dynamic_security.so"), None)
    if plugin is None:
        pytest.skip("mosquitto's dynamic security plugin is not installed")
    salt, rounds = b"0123456789ab", 101
    digest = hashlib.pbkdf2_hmac("sha512", password.encode(), salt, rounds)
    content = {
        "defaultACLAccess": {"publishClientSend": True, "publishClientReceive": True, "subscribe": True},
        "clients": [
            {
                "username": user,
                "password": b64encode(digest).decode(),
                "salt": b64encode(salt).decode(),
                "iterations": rounds,
                "roles": [{"rolename": "reader"}],
            }
        ],
        "roles": [
            {
                "rolename": "reader",
                "acls": [{"acltype": "subscribeLiteral", "topic": denied, "allow": False, "priority": 1}],
            }
        ],
    }
    file = folder / "dynamic_security.json"
    file.write_text(json.dumps(content))
    return "allow_anonymous false", f"plugin {plugin}", f"plugin_opt_config_file {file}"


def password_file(folder: Path, user: str, password: str) -> Path:
    """A file of one user, as mosquitto reads it."""
    salt, rounds = b"0123456789ab", 101
    digest = hashlib.pbkdf2_hmac("sha512", password.encode(), salt, rounds)
    file = folder / "passwords"
    file.write_text(f"{user}:$7${rounds}${b64encode(salt).decode()}${b64encode(digest).decode()}\n")
    return file


# -- certificates --------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Authority:
    """A certificate authority for a test: `file` its certificate."""

    folder: Path
    name: str
    key: object
    certificate: object

    @property
    def file(self) -> Path:
        return self.folder / f"{self.name}.crt"

    def issue(self, name: str, address: str = "", days: int = 1) -> tuple[Path, Path]:
        """Files of a certificate and its key, for a server where an address is stated; of the past where
        `days` < 0."""
        from cryptography import x509
        from cryptography.hazmat.primitives.asymmetric import ec

        key = ec.generate_private_key(ec.SECP256R1())
        usage = x509.ExtendedKeyUsageOID
        made = (
            _certificate(name, key, days)
            .issuer_name(self.certificate.subject)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(self.key.public_key()), False)
            .add_extension(
                x509.ExtendedKeyUsage([usage.SERVER_AUTH if address else usage.CLIENT_AUTH]), critical=False
            )
        )
        if address:
            names = x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address(address))])
            made = made.add_extension(names, critical=False)
        return _written(self.folder / name, made, key, self.key)


def authority(folder: Path, name: str = "ca") -> Authority:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    usage = dict.fromkeys(
        ("digital_signature", "content_commitment", "key_encipherment", "data_encipherment", "key_agreement",
         "encipher_only", "decipher_only"), False,
    )  # fmt: skip
    made = (
        _certificate(name, key, 1)
        .issuer_name(_name(name))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(x509.KeyUsage(key_cert_sign=True, crl_sign=True, **usage), critical=True)
    )
    file, _ = _written(folder / name, made, key, key)
    return Authority(folder, name, key, x509.load_pem_x509_certificate(file.read_bytes()))


def _name(text: str):
    from cryptography import x509

    return x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, text)])


def _certificate(name: str, key, days: int):
    from cryptography import x509

    now = datetime.now(UTC)
    first, last = sorted(
        (now - timedelta(days=2) if days < 0 else now - timedelta(hours=1), now + timedelta(days=days))
    )
    return (
        x509.CertificateBuilder()
        .subject_name(_name(name))
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(first)
        .not_valid_after(last)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _written(stem: Path, made, key, signer) -> tuple[Path, Path]:
    from cryptography.hazmat.primitives import hashes, serialization

    certificate, private = stem.with_suffix(".crt"), stem.with_suffix(".key")
    certificate.write_bytes(made.sign(signer, hashes.SHA256()).public_bytes(serialization.Encoding.PEM))
    private.write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.NoEncryption(),
        )
    )
    private.chmod(0o600)
    return certificate, private
