"""The `[[notify]]` tables of the tracker's file: each becomes a channel."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from email.utils import parseaddr
from functools import partial
from pathlib import Path
from typing import ClassVar
from urllib.parse import unquote, urlsplit

from hygrokf.data.timestamps import DAY_S, duration
from hygrokf.data.toml_form import Place, across, read_form, setting
from hygrokf.errors import suggestion
from hygrokf.live.alarms import RULES
from hygrokf.live.notification.notices import SEVERITIES, Channel, ChannelFault
from hygrokf.live.notification.transports import Mail, Webhook
from hygrokf.live.sources.endpoint import NO_PASSWORD_HERE, Address, password_of
from hygrokf.live.sources.stream import SourceFault

LONGEST_NAME = 40
PORTS = {"smtp": 587, "smtps": 465, "http": 80, "https": 443}
"""Scheme of a URL -> default port."""
MOST_HOLD_OFF_S, MOST_DIGEST_S = 7.0 * DAY_S, DAY_S
_ADDRESS = 'an address such as "ops@farm.example"'


def _is_address(text: str) -> bool:
    address = parseaddr(text)[1]
    user, at, host = address.rpartition("@")
    return bool(user and at and host) and text.isprintable() and text.isascii() and " " not in address


def _of(value: object, choices: tuple[str, ...]) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(one, str) for one in value):
        raise ValueError(f"expected a list of {', '.join(choices)}, found {value!r}")
    for one in value:
        if one not in choices:
            raise ValueError(f'expected {", ".join(choices)}, found "{one}"{suggestion(one, choices)}')
    return tuple(value)


@dataclass(frozen=True, kw_only=True)
class ChannelForm:
    """What the tables of all channels have in common."""

    name: str = setting(
        help="the name of the channel",
        fits=lambda name: len(name) <= LONGEST_NAME and name.isprintable() and ":" not in name,
        expected=f"text of 1 to {LONGEST_NAME} printable characters without a colon",
    )
    hold_off_s: float = setting(
        0.0,
        "time that an alarm must stand",
        read=duration,
        least=0.0,
        most=MOST_HOLD_OFF_S,
        expected="at most 7 d",
    )
    digest_s: float = setting(
        0.0, "interval of collected messages", read=duration, least=0.0, most=MOST_DIGEST_S,
        expected="at most 1 d",
    )  # fmt: skip
    kinds: tuple[str, ...] = setting((), "kinds of alarms", read=partial(_of, choices=tuple(RULES)))
    severities: tuple[str, ...] = setting((), "severities of alarms", read=partial(_of, choices=SEVERITIES))
    turbines: tuple[str, ...] = setting((), "names of turbines", empty=True)
    ca: str = setting("", "certificates of the CAs to trust, PEM")


@dataclass(frozen=True, kw_only=True)
class MailForm(ChannelForm):
    """A [[notify]] by mail."""

    REFUSED: ClassVar = {"password": NO_PASSWORD_HERE}
    url: str = setting(help="smtp://[USER@]HOST[:PORT] for STARTTLS, or smtps:// for TLS from the start")
    sender: str = setting(help="the sender's address", fits=_is_address, expected=_ADDRESS)
    to: tuple[str, ...] = setting(
        help="receivers", expected='a list of addresses such as ["ops@farm.example"]',
        fits=lambda to: bool(to) and all(map(_is_address, to)),
    )  # fmt: skip
    password_file: str = setting("", "file with the password as its only line")
    password_env: str = setting("", "environment variable with the password")
    unencrypted: bool = setting(False, "whether the server is reached without TLS")
    timeout_s: float = setting(60.0, "of one message", read=duration, least=1.0, most=600.0,
                               expected="1 s to 10 min")  # fmt: skip

    @across("url")
    def url_form(self) -> str | None:
        return _address(self.url).fault

    @across("password_file", "password_env", "url")
    def login(self) -> Iterator[str]:
        given = bool(self.password_file) + bool(self.password_env)
        if given == 2:
            yield "password_file and password_env: keep one"
        if bool(given) != bool(_address(self.url).user):
            yield "user and password belong together: smtp://USER@HOST and password_file or password_env"

    @across("unencrypted", "url", "password_file", "password_env")
    def secured(self) -> Iterator[str]:
        if self.unencrypted and self.url.startswith("smtps:"):
            yield "unencrypted does not go with smtps://: keep one"
        if self.unencrypted and (self.password_file or self.password_env):
            yield "unencrypted: a password is only sent over TLS"

    def transport(self, folder: Path) -> Mail:
        """The mail server.  Raises SourceFault or ChannelFault for a password that cannot be used."""
        scheme, host, port, user, _, _ = _address(self.url)
        password = password_of(folder / self.password_file if self.password_file else None, self.password_env)
        if not f"{user}{password or ''}".isascii():
            raise ChannelFault("user and password must be ASCII, as Python's SMTP client sends no other")
        return Mail(
            host, port, self.sender, self.to, scheme == "smtps", self.unencrypted, user,
            folder / self.password_file if self.password_file else None, self.password_env,
            folder / self.ca if self.ca else None, self.timeout_s,
        )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class WebhookForm(ChannelForm):
    """A [[notify]] by a webhook."""

    REFUSED: ClassVar = {
        "secret": "a secret must not be in this file: name a file as secret_file, or an environment "
        "variable as secret_env"
    }
    url: str = setting(help="https://HOST[:PORT]/PATH")
    secret_file: str = setting("", "file with the secret that signs, as its only line")
    secret_env: str = setting("", "environment variable with the secret")
    timeout_s: float = setting(10.0, "of one message", read=duration, least=1.0, most=120.0,
                               expected="1 s to 2 min")  # fmt: skip

    @across("url")
    def url_form(self) -> str | None:
        found = _address(self.url)
        return found.fault or (
            "url: user and password do not belong here; sign by secret_file" if found.user else None
        )

    @across("secret_file", "secret_env")
    def one_secret(self) -> str | None:
        return "secret_file and secret_env: keep one" if self.secret_file and self.secret_env else None

    def transport(self, folder: Path) -> Webhook:
        """The receiver.  Raises ChannelFault for a secret that cannot be used."""
        scheme, host, port, _, path, _ = _address(self.url)
        made = Webhook(
            host, port, path, scheme == "https", folder / self.secret_file if self.secret_file else None,
            self.secret_env, folder / self.ca if self.ca else None, self.timeout_s,
        )  # fmt: skip
        made.secret()
        return made


KINDS: Mapping[str, type[MailForm] | type[WebhookForm]] = {
    "smtp": MailForm, "smtps": MailForm, "https": WebhookForm, "http": WebhookForm,
}  # fmt: skip
"""Scheme of a URL -> form of the table."""


def channel_of(
    table: Mapping[str, object], place: Place, folder: Path, turbines: Collection[str]
) -> Channel | None:
    """The channel of a `[[notify]]` table; None if the table is faulty, with the faults in `place`.

    Nothing is connected yet.  Paths are relative to `folder`.
    """
    url = table.get("url")
    scheme = url.partition(":")[0] if isinstance(url, str) else ""
    if scheme not in KINDS:
        place.fault(f"url must begin with one of {', '.join(f'{one}:' for one in KINDS)}, found {scheme!r}")
        return None
    own = replace(place, faults=[])
    form: MailForm | WebhookForm = read_form(KINDS[scheme], table, own)
    if not own.faults:
        unknown = [one for one in form.turbines if one not in turbines]
        if unknown:
            own.fault(f"turbines: no turbine is named {unknown[0]!r}{suggestion(unknown[0], turbines)}")
    made = None
    if not own.faults:
        try:
            transport, covered = form.transport(folder), (form.kinds, form.severities, form.turbines)
            made = Channel(form.name, transport, form.hold_off_s, form.digest_s, *covered)
        except (SourceFault, ChannelFault) as fault:
            own.fault(str(fault))
    place.faults.extend(own.faults)
    return None if own.faults else made


def _address(url: str) -> Address:
    """The parts of a URL; no fault shows it, because it may contain a secret."""
    scheme = url.partition(":")[0]
    default, mail = PORTS.get(scheme, 0), scheme.startswith("smtp")
    expected = f"url must be {scheme}://" + ("[USER@]HOST[:PORT] and no more" if mail else "HOST[:PORT]/PATH")
    try:
        parts = urlsplit(url)
        host, port = parts.hostname or "", parts.port
    except ValueError:
        return Address(scheme, "", default, fault=f"{expected}, with a port of 1 to 65535")
    if parts.password is not None:
        return Address(scheme, host, default, fault=f"url: {NO_PASSWORD_HERE}")
    fault = None
    if not host or not url.isascii() or not url.isprintable() or " " in url or parts.fragment:
        fault = expected
    elif mail and (parts.path not in ("", "/") or parts.query):
        fault = expected
    elif port == 0:
        fault = f"{expected}, with a port of 1 to 65535"
    path = (parts.path or "/") + (f"?{parts.query}" if parts.query else "")
    user = unquote(parts.username or "")
    return Address(scheme, host, default if port is None else port, user, path, fault)
