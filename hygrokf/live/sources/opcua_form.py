"""A [[source]] that is an OPC UA server: its nodes, the security of its connection and its user.

Certificates and keys are read once, together with the tracker's file, which never contains a password.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from hygrokf.data.timestamps import duration
from hygrokf.data.toml_form import Place, across, entry_name, setting
from hygrokf.errors import suggestion
from hygrokf.live.sources.endpoint import Address, PasswordKeys, address_of, bracketed, is_loopback
from hygrokf.live.sources.opcua import OpcUa
from hygrokf.live.sources.opcua_client import HELD, ConnectionFault, Node, Rates, Security, User, node_fault
from hygrokf.live.sources.payload import PayloadMapping
from hygrokf.live.sources.stream import SourceFault, SourceKeys

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.rsa import RSAPrivateKey
    from cryptography.x509 import Certificate

T = TypeVar("T")
PORTS = {"opc.tcp": 4840}
"""Scheme of a URL -> default port."""
_PLAIN = ("turbine", "time", "quality")
POLICIES = ("Basic256Sha256", "Aes128Sha256RsaOaep", "Aes256Sha256RsaPss")
MODES = ("SignAndEncrypt", "Sign")
FILES = ("certificate", "key", "server_certificate")


@dataclass(frozen=True)
class SecurityForm(PasswordKeys):
    """The security and the user of a [[source]] that is an OPC UA server."""

    security: str = setting(
        "",
        '"none": a plain connection to another host',
        fits="none".__eq__,
        expected='"none" where it is stated',
    )
    policy: str | None = setting(None, f"of the signatures, by default {POLICIES[0]}", choices=POLICIES)
    mode: str | None = setting(None, f"what is secured, by default {MODES[0]}", choices=MODES)
    certificate: str | None = setting(None, "of the tracker, PEM or DER")
    key: str | None = setting(None, "of the certificate, PEM or DER, RSA, without a password")
    server_certificate: str | None = setting(None, "of the one server that is trusted, PEM or DER")
    user: str = setting("", "with password_file or password_env")

    @property
    def stated(self) -> list[str]:
        """Keys of a secured connection that are stated."""
        return [name for name in ("policy", "mode", *FILES) if getattr(self, name)]

    @across("security")
    def not_both(self) -> str | None:
        if self.security != "none" or not self.stated:
            return None
        return f'security = "none" contradicts {", ".join(self.stated)}: leave out one or the other'

    @across(*FILES)
    def all_files(self) -> str | None:
        missing = [name for name in FILES if not getattr(self, name)]
        if not self.stated or not missing or self.security == "none":
            return None
        return f"{', '.join(missing)} missing: a secured connection needs {', '.join(FILES)}"

    @across("user", "password_file", "password_env")
    def password_of_user(self) -> str | None:
        if bool(self.user) == self.has_password:
            return None
        return "user and its password_file or password_env belong together"


@dataclass(frozen=True)
class NodeForm:
    """An entry of `nodes`."""

    id: str = entry_name()
    turbine: str = setting(help="its turbine")
    field: str = setting(help="its field of [mapping.signals]")


@dataclass(frozen=True)
class ServerForm(SourceKeys):
    """A server and its nodes."""

    url: str = setting(help="opc.tcp://HOST:PORT/PATH")
    nodes: Mapping[str, NodeForm] = setting(dict, "node ids, each with turbine and field")
    sampling_s: float = setting(Rates.sampling_s, "how often the server looks at a value", read=duration)
    publishing_s: float = setting(
        Rates.publishing_s,
        "how often it sends what has come",
        read=duration,
        least=0.01,
        most=60.0,
        expected='within "0.01s" … "1min"',
    )
    queue: int = setting(Rates.queue, "values of one node that it keeps in between", least=2, most=HELD)
    look_back_s: float = setting(0.0, "how far back the history of a new node is read", read=duration)
    uncertain: bool = setting(True, "whether values with an uncertain status are used")

    @property
    def address(self) -> Address:
        """The parts of the url."""
        return address_of(self.url, PORTS, has_path=True)

    @across("url")
    def url_form(self) -> str | None:
        if self.address.user:
            return "a user does not belong in the url: state user, and password_file or password_env"
        return self.address.fault

    @across("nodes")
    def any_node(self) -> str | None:
        if self.nodes:
            return None
        return 'no nodes: add nodes = { "ns=2;s=T07.CabinetTemp" = { turbine = "T07", field = "Tcab" } }'


@dataclass(frozen=True)
class OpcUaForm(SecurityForm, ServerForm):
    """A [[source]] of `opc.tcp://HOST:PORT/PATH`."""

    def stream(self, folder: Path, mapping: PayloadMapping, place: Place) -> OpcUa:
        """The stream; faults of its nodes and files go to `place`."""
        scheme, host, port, _, path, _ = self.address
        url = f"{scheme}://{bracketed(host)}:{port}{path}" if host else ""
        security, user = security_of(self, host, folder, place)
        try:
            _check_nodes(self.nodes, mapping, place)
        except ConnectionFault as fault:
            place.fault(str(fault))
        nodes = [Node(id, one.turbine, one.field) for id, one in self.nodes.items()]
        turbines = {one.turbine: one.turbine for one in nodes}
        own = mapping.of_own_payloads(self.uncertain and mapping.use_uncertain, turbines)
        rates = Rates(self.sampling_s, self.publishing_s, self.queue)
        return OpcUa(url, nodes, own, rates, self.look_back_s, security, user)


def _check_nodes(nodes: Mapping[str, NodeForm], mapping: PayloadMapping, place: Place) -> None:
    """Faults of nodes that the mapping does not know, or that stand for one field twice.

    Raises ConnectionFault without asyncua.
    """
    turbines = tuple(set(mapping.turbines.values()))
    taken: dict[tuple[str, str], str] = {}
    for id, one in nodes.items():
        inside = place.inside("nodes", entry=repr(id))
        if (wrong := node_fault(id)) is not None:
            inside.fault(wrong)
        for key, value, known, where in (
            ("turbine", one.turbine, turbines, "[[turbine]]"),
            ("field", one.field, tuple(mapping.fields), "[mapping.signals]"),
        ):
            if value and value not in known:
                inside.fault(f"{key}: {where} has no {value!r}{suggestion(value, known)}")
        if one.field in _PLAIN:
            inside.fault(f"a field must not be named {one.field!r} here: rename it in [mapping.signals]")
        other = taken.setdefault((one.turbine, one.field), id)
        if other != id:
            inside.fault(f"{other!r} already is {one.field} of {one.turbine}")


# -- security ------------------------------------------------------------------------------------------------
def security_of(
    form: SecurityForm, host: str, folder: Path, place: Place
) -> tuple[Security | None, User | None]:
    """Security and user of a `[[source]]` table; faults go to `place`.

    Security is None for a plain connection, which requires `security = "none"` unless the host is this
    machine; the user is None for an anonymous login.
    """
    security = _security(form, folder, place) if form.stated and form.security != "none" else None
    user = _user(form, folder, place)
    if host and not form.stated and not is_loopback(host):
        if form.security != "none":
            place.fault(
                f"a connection to another host needs {', '.join(FILES)}; "
                'state security = "none" where it shall be readable and open to change on its way'
            )
        if user is not None:
            place.fault(f"a password to another host needs {', '.join(FILES)}: it would be sent readable")
    return security, user


def _security(form: SecurityForm, folder: Path, place: Place) -> Security | None:
    try:
        from cryptography.hazmat.primitives import serialization
    except ImportError:
        place.fault("certificates need cryptography: pip install 'hygrokf[opcua]'")
        return None
    own = _read(form, "certificate", folder, place, _certificate)
    key = _read(form, "key", folder, place, _key)
    server = _read(form, "server_certificate", folder, place, _certificate)
    uri = "" if own is None else _application_uri(own)
    if own is not None:
        if not uri:
            place.fault(
                "certificate: expected a URI among its alternative names, found none: servers refuse it"
            )
        if key is not None and own.public_key() != key.public_key():
            place.fault("certificate and key do not belong together")
    if own is None or key is None or server is None:
        return None
    der = serialization.Encoding.DER
    return Security(
        form.policy or POLICIES[0],
        form.mode or MODES[0],
        own.public_bytes(der),
        key.private_bytes(der, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()),
        server.public_bytes(der),
        uri,
        own.not_valid_after_utc.timestamp(),
    )


def _read(form: SecurityForm, name: str, folder: Path, place: Place, read: Callable[[bytes], T]) -> T | None:
    """The file named by a key, parsed by `read`; None if the key is missing or the file cannot be parsed."""
    if not getattr(form, name):
        return None
    path = folder / getattr(form, name)
    try:
        return read(path.read_bytes())
    except OSError as fault:
        place.fault(f"{name}: {path}: {fault.strerror}")
    except (ValueError, TypeError):
        kind = "a private RSA key without a password" if name == "key" else "an RSA certificate"
        place.fault(f"{name}: {path}: expected {kind}, as PEM or DER")
    return None


def _certificate(content: bytes) -> Certificate:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric import rsa

    pem = b"-----BEGIN" in content
    found = x509.load_pem_x509_certificate(content) if pem else x509.load_der_x509_certificate(content)
    if not isinstance(found.public_key(), rsa.RSAPublicKey):
        raise ValueError("not RSA")
    return found


def _key(content: bytes) -> RSAPrivateKey:
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric import rsa

    pem = b"-----BEGIN" in content
    load = serialization.load_pem_private_key if pem else serialization.load_der_private_key
    found = load(content, None)
    if not isinstance(found, rsa.RSAPrivateKey):
        raise ValueError("not RSA")
    return found


def _application_uri(certificate: Certificate) -> str:
    from cryptography import x509

    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ""
    return next(iter(names.get_values_for_type(x509.UniformResourceIdentifier)), "")


def _user(form: SecurityForm, folder: Path, place: Place) -> User | None:
    """The user with the password from its file or environment variable."""
    try:
        password = form.password(folder).read()
    except SourceFault as fault:
        place.fault(str(fault))
        return None
    return User(form.user, password) if form.user and password else None
