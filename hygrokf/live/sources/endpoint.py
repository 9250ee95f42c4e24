"""Keys of tables that describe a connection to another machine: its URL, TLS, and passwords, which are kept
outside of the tracker's file."""

from __future__ import annotations

import ipaddress
import os
import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, NamedTuple
from urllib.parse import unquote, urlsplit

from hygrokf.data.toml_form import FolderKeys, across, setting
from hygrokf.live.sources.stream import SourceFault

PORTS = {
    "mqtt": 1883, "mqtts": 8883, "opc.tcp": 4840, "smtp": 587, "smtps": 465, "http": 80, "https": 443,
}  # fmt: skip
"""Scheme of a URL -> default port."""
WITH_PATH = ("opc.tcp", "http", "https")
"""Schemes whose URLs have a path."""
OTHERS_READ = 0o004
"""Permission bit of a file that every user of the machine may read."""
NO_PASSWORD_HERE = (
    "a password must not be in this file: put it into a separate file and name that as password_file, "
    "or into an environment variable and name that as password_env"
)


class Address(NamedTuple):
    """The parts of a URL SCHEME://[USER@]HOST[:PORT][/PATH]; `fault`: error message for an invalid URL."""

    scheme: str
    host: str
    port: int
    user: str = ""
    path: str = "/"
    fault: str | None = None


def is_loopback(host: str) -> bool:
    """Whether a host is this machine itself, so that data sent to the host do not leave the machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def bracketed(host: str) -> str:
    """A host as it is written in a URL: an IPv6 address in brackets."""
    return f"[{host}]" if ":" in host else host


class UrlKeys:
    """Mixin for tables with the `url` of another machine."""

    url: str

    @property
    def address(self) -> Address:
        """The parts of the URL.  The error message never quotes the URL, which may contain a secret."""
        scheme, after_scheme = self.url.partition(":")[0], self.url.partition("://")[2]
        default_port, has_path = PORTS.get(scheme, 0), scheme in WITH_PATH
        expected = f"url must be {scheme}://" + (
            "HOST[:PORT]/PATH" if has_path else "[USER@]HOST[:PORT] without a path"
        )
        login = (after_scheme.partition("/")[0] if has_path else after_scheme).rpartition("@")[0]
        if ":" in login:
            return Address(scheme, "", default_port, fault=f"url: {NO_PASSWORD_HERE}")
        try:
            parts = urlsplit(self.url)
            host, port = parts.hostname or "", parts.port
        except ValueError:
            port = 0
        if port == 0:
            return Address(scheme, "", default_port, fault=f"{expected}, with a port of 1 to 65535")
        query = f"?{parts.query}" if parts.query else ""
        is_well_formed = host and self.url.isprintable() and " " not in self.url and not parts.fragment
        if not is_well_formed or (not has_path and (query or parts.path not in ("", "/"))):
            return Address(scheme, host, default_port, fault=expected)
        return Address(scheme, host, port or default_port, unquote(login), (parts.path or "/") + query)

    @property
    def tls(self) -> bool:
        """Whether the scheme uses TLS from the first byte on."""
        return self.address.scheme in ("mqtts", "smtps", "https")

    @property
    def leaves_machine(self) -> bool:
        """Whether the data leave this machine, so that others could read them on their way."""
        return not is_loopback(self.address.host)

    @property
    def where(self) -> str:
        """HOST:PORT, as it is written in the URL."""
        return f"{bracketed(self.address.host)}:{self.address.port}"


def tls_context(ca: Path | None, certificate: Path | None = None, key: Path | None = None) -> ssl.SSLContext:
    """A TLS context that verifies the chain and the host name of a server's certificate.

    ca: certificates of the trusted CAs, None for those of the system. certificate, key: presented to a server
    that asks for a client certificate. Raises SourceFault for a file that cannot be read.
    """
    try:
        context = ssl.create_default_context(cafile=ca)
    except (OSError, ssl.SSLError) as fault:
        raise SourceFault(f"ca: {ca}: {_file_fault_text(fault, 'certificates in PEM')}") from None
    if certificate is not None:
        try:
            # with an empty passphrase a protected key is refused instead of prompting at a terminal
            context.load_cert_chain(certificate, key, password="")
        except (OSError, ssl.SSLError) as fault:
            pair = "a certificate in PEM and the key that belongs to it, without a passphrase"
            reason = _file_fault_text(fault, pair)
            raise SourceFault(f"certificate {certificate}, key {key}: {reason}") from None
    return context


def _file_fault_text(fault: OSError, expected: str) -> str:
    """Return why a certificate file cannot be used: what was `expected` in it, or the error of the system."""
    if isinstance(fault, ssl.SSLError):
        return f"expected {expected}, found {fault.reason or 'nothing of the kind'}"
    return fault.strerror or str(fault)


@dataclass(frozen=True)
class Secret:
    """A password or another secret in a `file` or an environment `variable`; `key`: its name in messages."""

    file: Path | None = None
    variable: str = ""
    key: str = "password"

    @property
    def is_stated(self) -> bool:
        return self.file is not None or bool(self.variable)

    def read(self) -> str | None:
        """The present value of the secret; None if none is configured.  Raises SourceFault."""
        if self.variable:
            secret = os.environ.get(self.variable, "")
            if not secret:
                raise SourceFault(
                    f"{self.key}_env: the environment variable {self.variable} is not set or empty"
                )
            return secret
        if self.file is None:
            return None
        prefix = f"{self.key}_file: {self.file}"
        try:
            secret = self.file.read_text(encoding="utf-8").rstrip("\r\n")
        except OSError as fault:
            raise SourceFault(f"{prefix}: {fault.strerror}") from None
        except UnicodeDecodeError:
            raise SourceFault(f"{prefix}: expected text in UTF-8") from None
        if not secret or "\n" in secret:
            raise SourceFault(f"{prefix}: expected one line, the {self.key}, and nothing else")
        return secret


@dataclass(frozen=True, kw_only=True)
class PasswordKeys(FolderKeys):
    """The keys of every table that needs a password; the tracker's file never contains the password."""

    REFUSED: ClassVar = {"password": NO_PASSWORD_HERE}
    password_file: str = setting("", "file with the password as its only line")
    password_env: str = setting("", "environment variable with the password")

    @across("password_file", "password_env")
    def password_stated_once(self) -> str | None:
        is_ambiguous = self.password_file and self.password_env
        return "password_file and password_env: keep one" if is_ambiguous else None

    @property
    def password(self) -> Secret:
        """The secret that holds the password: a file or an environment variable."""
        return Secret(self.path("password_file"), self.password_env)
