"""Settings of the page: its address, the host names it answers to, its token and its certificate."""

from __future__ import annotations

import os
import ssl
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from hygrokf.data.toml_form import Place, across, read_form, setting
from hygrokf.errors import HygrokfError
from hygrokf.live.sources.endpoint import is_loopback

PAGE = "127.0.0.1:8080"
SHORTEST = 16
"""Shortest token [characters]; the tokens made as the message below says have 43."""

NEEDED = "the live page needs further packages: pip install 'hygrokf[live]'"


class PageFault(HygrokfError):
    """The page cannot be served; the message tells the operator why."""


@dataclass(frozen=True)
class PageSettings:
    """Where the page is served and to whom.

    `hosts`: further host names that requests may use; `token`: required token ("": none); `certificate`,
    `key`: PEM files ("": no TLS); `behind_proxy`: a proxy in front of the page terminates TLS.
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
        """Host names, in lower case, that requests may use besides the address that they reach."""
        own = {self.host, "localhost"} if is_loopback(self.host) else {self.host}
        return frozenset(name.lower().rstrip(".") for name in (*own, *self.hosts))


@dataclass(frozen=True)
class PageForm:
    """The table [page]; an address alone stands for a table with it."""

    address: str = setting(PAGE, "HOST:PORT")
    hosts: tuple[str, ...] = setting(
        (), "further names that browsers ask for", expected='a list of names such as ["farm.example"]'
    )
    token_file: str = setting("", "file with the token")
    token_env: str = setting("", "variable of the environment with the token")
    certificate: str = setting("", "PEM file for TLS")
    key: str = setting("", "PEM file with its key, which has no password")
    behind_proxy: bool = setting(False, "a proxy on the way does TLS")

    @across("address")
    def host_and_port(self) -> str | None:
        return (
            None
            if address(self.address)
            else f"page must be HOST:PORT such as {PAGE}, found {self.address!r}"
        )

    @across("token_file", "token_env")
    def one_token(self) -> str | None:
        both = self.token_file and self.token_env
        return "give token_file or token_env, not both" if both else None

    @across("certificate", "key")
    def pair(self) -> str | None:
        alone = bool(self.certificate) != bool(self.key)
        return "certificate and key belong together: two PEM files" if alone else None


def page_settings(value: object, folder: Path, place: Place) -> PageSettings:
    """The page's settings from `page = "HOST:PORT"` or a table [page]; faults go to `place`, of the file.

    Paths are relative to `folder`.  An address that other machines can reach needs a token and a certificate
    or a proxy.
    """
    table = {"address": value} if isinstance(value, str) else value
    if not isinstance(table, Mapping):
        place.fault(f'page: expected "HOST:PORT" or a table [page], found {value!r}')
        return PageSettings()
    inside, before = place.inside("page"), len(place.faults)
    form = read_form(PageForm, table, inside)
    token = _token(form, folder, inside)
    certificate, private = _certificate(form, folder, inside)
    host, port = address(form.address) or ("127.0.0.1", 0)
    if len(place.faults) == before:
        if form.behind_proxy and not token:
            inside.fault("behind_proxy needs token_file or token_env: the proxy lets others in")
        if not is_loopback(host) and not form.behind_proxy and not (token and certificate):
            lacking = [
                *([] if token else ["token_file or token_env"]),
                *([] if certificate else ["certificate and key (or behind_proxy = true)"]),
            ]
            inside.fault(
                f"other machines reach {host}: give {' and '.join(lacking)}, or an address such as {PAGE}"
            )
    return PageSettings(host, port, form.hosts, token, certificate, private, form.behind_proxy)


def address(text: str) -> tuple[str, int] | None:
    """Host and port of `HOST:PORT`; None for another text."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 <= int(port) < 65536:
        return None
    return host.strip("[]"), int(port)


def _token(form: PageForm, folder: Path, place: Place) -> str:
    """The token from its file or environment variable; no message contains it."""
    file, variable = form.token_file, form.token_env
    if bool(file) == bool(variable):
        return ""
    if variable:
        source, token = f"the variable {variable}", os.environ.get(variable, "").strip()
    else:
        source = str(folder / file)
        try:
            token = (folder / file).read_text(encoding="ascii").strip()
        except OSError as fault:
            place.fault(f"token_file {source}: {fault.strerror}")
            return ""
        except UnicodeDecodeError:
            token = ""
    if len(token) < SHORTEST or not (token.isascii() and token.isprintable()) or " " in token:
        place.fault(
            f"expected a token of at least {SHORTEST} printable characters without spaces in {source}; "
            "make one with: python -c 'import secrets; print(secrets.token_urlsafe())'"
        )
        return ""
    return token


def _certificate(form: PageForm, folder: Path, place: Place) -> tuple[str, str]:
    """Paths of a certificate and the matching key."""
    if not (form.certificate and form.key):
        return "", ""
    certificate, private = str(folder / form.certificate), str(folder / form.key)
    try:
        # the empty password makes a protected key fail here instead of prompting for its password
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, private, password=lambda: "")
    except OSError as fault:
        place.fault(
            f"expected a certificate and its key as PEM files without a password in {certificate} "
            f"and {private}: {fault.strerror or fault}"
        )
    return certificate, private
