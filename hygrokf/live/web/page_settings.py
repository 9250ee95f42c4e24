"""How the page may be reached: its address, the names it answers to, its token and its certificate."""

from __future__ import annotations

import ipaddress
import os
import ssl
from collections.abc import Mapping as MappingOf
from dataclasses import dataclass, field
from pathlib import Path

from hygrokf.errors import HygrokfError
from hygrokf.live.table_reader import TableReader

PAGE = "127.0.0.1:8080"
SHORTEST = 16
"""Characters of a token at least: whoever guesses gets ten attempts in five minutes."""

_PAGE = ("address", "hosts", "token_file", "token_env", "certificate", "key", "behind_proxy")


NEEDED = "the live page needs further packages: pip install 'hygrokf[live]'"


class PageFault(HygrokfError):
    """A page that cannot be served, in words for the one who runs it."""


@dataclass(frozen=True)
class PageSettings:
    """Where the page is served and to whom.

    `hosts` names beside the address that a browser may ask for; `token` what is asked for ("": nothing); `certificate`,
    `key` PEM files ("": no TLS); `behind_proxy` whether a proxy in front of it does TLS.
    """

    host: str = "127.0.0.1"
    port: int = 8080
    hosts: tuple[str, ...] = ()
    token: str = field(default="", repr=False)
    certificate: str = ""
    key: str = ""
    behind_proxy: bool = False

    @property
    def encrypted(self) -> bool:
        """Whether browsers reach the page by https."""
        return bool(self.certificate) or self.behind_proxy

    @property
    def names(self) -> frozenset[str]:
        """Names that a request may be made to, in lower case, beside the address that it reached."""
        own = {self.host, "localhost"} if is_loopback(self.host) else {self.host}
        return frozenset(name.lower().rstrip(".") for name in (*own, *self.hosts))


def page_settings(value: object, folder: Path, reader: TableReader) -> PageSettings:
    """The page's settings from `page = "HOST:PORT"` or a table [page]; what is wrong goes to `reader`.

    Files are relative to `folder`.  An address that other machines reach needs a token, and a certificate or a proxy.
    """
    if isinstance(value, str):
        value = {"address": value}
    if not isinstance(value, dict):
        reader.faults.append(f'page: expected "HOST:PORT" or a table [page], found {value!r}')
        return PageSettings()
    where, before = "[page]", len(reader.faults)
    reader.known(value, _PAGE, where)
    host, port = address(reader.text(value, "address", where, PAGE), reader.faults)
    hosts = value.get("hosts", [])
    if not isinstance(hosts, list) or not all(isinstance(one, str) and one for one in hosts):
        reader.faults.append(
            f'{where}: hosts must be a list of names such as ["farm.example"], found {hosts!r}'
        )
        hosts = []
    behind_proxy = value.get("behind_proxy", False)
    if not isinstance(behind_proxy, bool):
        reader.faults.append(f"{where}: behind_proxy must be true or false, found {behind_proxy!r}")
        behind_proxy = False
    token = _token(value, where, folder, reader)
    certificate, key = _certificate(value, where, folder, reader)
    if len(reader.faults) == before:
        if behind_proxy and not token:
            reader.faults.append(
                f"{where}: behind_proxy needs token_file or token_env: the proxy lets others in"
            )
        if not is_loopback(host) and not behind_proxy and not (token and certificate):
            lacking = [
                *([] if token else ["token_file or token_env"]),
                *([] if certificate else ["certificate and key (or behind_proxy = true)"]),
            ]
            reader.faults.append(
                f"{where}: other machines reach {host}: give {' and '.join(lacking)}, or an address such as {PAGE}"
            )
    return PageSettings(host, port, tuple(hosts), token, certificate, key, behind_proxy)


def address(text: str, faults: list[str]) -> tuple[str, int]:
    """Host and port of `HOST:PORT`; what is wrong goes to `faults`."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 <= int(port) < 65536:
        faults.append(f"page must be HOST:PORT such as {PAGE}, found {text!r}")
        return "127.0.0.1", 0
    return host.strip("[]"), int(port)


def is_loopback(host: str) -> bool:
    """Whether an address is reached from this machine alone."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _token(table: MappingOf, where: str, folder: Path, reader: TableReader) -> str:
    """The token out of its file or its variable; it is named in no message."""
    file, variable = (reader.text(table, key, where) for key in ("token_file", "token_env"))
    if not file and not variable:
        return ""
    if file and variable:
        reader.faults.append(f"{where}: give token_file or token_env, not both")
        return ""
    if variable:
        source, token = f"the variable {variable}", os.environ.get(variable, "").strip()
    else:
        source = str(folder / file)
        try:
            token = (folder / file).read_text(encoding="ascii").strip()
        except OSError as fault:
            reader.faults.append(f"{where}: token_file {source}: {fault.strerror}")
            return ""
        except UnicodeDecodeError:
            token = ""
    if len(token) < SHORTEST or not (token.isascii() and token.isprintable()) or " " in token:
        reader.faults.append(
            f"{where}: expected a token of at least {SHORTEST} printable characters without spaces in {source}; "
            "make one with: python -c 'import secrets; print(secrets.token_urlsafe())'"
        )
        return ""
    return token


def _certificate(table: MappingOf, where: str, folder: Path, reader: TableReader) -> tuple[str, str]:
    """Paths of a certificate and its key that fit each other."""
    names = [reader.text(table, key, where) for key in ("certificate", "key")]
    if not any(names):
        return "", ""
    if not all(names):
        reader.faults.append(f"{where}: certificate and key belong together: two PEM files")
        return "", ""
    certificate, key = (str(folder / name) for name in names)
    try:
        # a key with a password is refused here, where nobody can be asked for it
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key, password=lambda: "")
    except OSError as fault:
        reader.faults.append(
            f"{where}: expected a certificate and its key as PEM files without a password in {certificate} and {key}: "
            f"{fault.strerror or fault}"
        )
    return certificate, key
