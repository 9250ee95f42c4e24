"""The table of an MQTT source: what it gives, and that every fault is told in words without a secret in
them."""

from __future__ import annotations

import os
import sys
import tomllib
from pathlib import Path

import pytest
from builders.brokers import authority
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.reasoncodes import ReasonCode

from hygrokf.data.toml_form import Place, read_form
from hygrokf.live.batch import Alarm
from hygrokf.live.config import stream_of
from hygrokf.live.sources.broker import (
    EXPIRY_S,
    Broker,
    alarm_topic,
    filter_fault,
    reason_text,
    tls_error_text,
    unreachable_text,
)
from hygrokf.live.sources.payload import Field, PayloadMapping
from hygrokf.live.sources.sparkplug import MqttForm
from hygrokf.texts.doctor_codes import CheckCode

MAPPING = PayloadMapping({"Tcab": Field("cabinet_temperature", "degC")}, turbines={"T1": "T1"})
SECRET = "pa55-4711"


def read(folder: Path, text: str) -> tuple[Broker | None, list[str]]:
    place = Place("[[source]] 1")
    broker = read_form(MqttForm, tomllib.loads(text), place, folder=folder)
    broker.stream(MAPPING, place)
    return None if place.faults else broker, place.faults


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with files of a password and of certificates."""
    own = authority(tmp_path)
    own.issue("client")
    own.issue("another")
    secret = tmp_path / "secret"
    secret.write_text(SECRET + "\n")
    secret.chmod(0o600)
    (tmp_path / "empty").write_text("")
    (tmp_path / "rows").write_text(f"{SECRET}\n{SECRET}\n")
    (tmp_path / "latin").write_bytes(b"\xe4\n")
    return tmp_path


def test_a_short_table(tmp_path: Path) -> None:
    found, faults = read(tmp_path, 'url = "mqtt://broker.example"\ntopics = ["scada/+/cabinet"]')
    assert faults == []
    assert found.where == "broker.example:1883" and not found.tls and found.session_expiry_s == EXPIRY_S
    assert (found.topics, found.alarms, found.user_name) == (("scada/+/cabinet",), "", "")
    assert found.password.read() is None and found.context() is None and not list(found.cautions())
    assert found.session_url == f"mqtt://broker.example:1883?client_id={found.session}"


def test_a_whole_table(folder: Path) -> None:
    found, faults = read(
        folder,
        'url = "mqtts://the%20reader@[::1]:8884"\ntopics = ["$share/hygrokf/scada/#", "a/b"]\nalarms '
        '= "hygrokf/alarms"\nclient_id = "tracker 1"\nsession_expiry = "2d"\npassword_file = "secret"\nca = '
        '"ca.crt"\ncertificate = "client.crt"\nkey = "client.key"',
    )
    assert faults == []
    assert (found.where, found.tls, found.user_name) == ("[::1]:8884", True, "the reader")
    assert (found.topics, found.session_expiry_s) == (("$share/hygrokf/scada/#", "a/b"), 172_800.0)
    assert found.session_url == "mqtts://[::1]:8884?client_id=tracker%201" and found.password.read() == SECRET
    context = found.context()
    assert context.check_hostname and context.verify_mode.name == "CERT_REQUIRED"
    assert SECRET not in repr(found)


def test_the_session_is_the_same_after_a_restart_and_another_one_elsewhere(tmp_path: Path) -> None:
    text = 'url = "mqtt://broker.example"\ntopics = ["a"]'
    (tmp_path / "other").mkdir()
    names = [
        read(tmp_path, text)[0].session,
        read(tmp_path, text.replace('"a"', '"b"'))[0].session,
        read(tmp_path / "other", text)[0].session,
        read(tmp_path, text.replace("broker.", "another."))[0].session,
    ]
    assert names[0] == names[1] and len(set(names)) == 3
    assert all(name.startswith("hygrokf-") and len(name) <= 37 for name in names)


SHORT = 'url = "mqtt://h"\ntopics = ["a"]\n'
TLS = 'url = "mqtts://h"\ntopics = ["a"]\n'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (SHORT + "topic = 1", 'unknown key "topic"'),
        ('url = "mqtt://h"', "topics must be a list of topic filters"),
        ('url = "mqtt://h"\ntopics = "a"', "topics must be a list of topic filters"),
        ('url = "mqtt://h"\ntopics = ["a/#/b"]', '"#" must be alone, as the last level, found \'a/#/b\''),
        ('url = "mqtt://:1883"\ntopics = ["a"]', "url must be mqtt://[USER@]HOST"),
        ('url = "mqtts://h/topic"\ntopics = ["a"]', "url must be mqtts://[USER@]HOST"),
        ('url = "mqtt://h:65536"\ntopics = ["a"]', "a port of 1 to 65535"),
        ('url = "mqtt://h:x"\ntopics = ["a"]', "a port of 1 to 65535"),
        ('url = "mqtt://[::1"\ntopics = ["a"]', "url must be mqtt://[USER@]HOST"),
        (f'url = "mqtt://u:{SECRET}@h"\ntopics = ["a"]', "put it into a separate file"),
        (f'url = "mqtt://u:{SECRET}/x@h"\ntopics = ["a"]', "put it into a separate file"),
        (f'url = "mqtt://u@h/{SECRET}"\ntopics = ["a"]', "without a path"),
        (SHORT + f'password = "{SECRET}"', "name that as password_file"),
        (SHORT + 'user = "u"\npassword_file = "none"', "password_file: "),
        (SHORT + 'user = "u"\npassword_file = "empty"', "expected one line"),
        (SHORT + 'user = "u"\npassword_file = "rows"', "expected one line"),
        (SHORT + 'user = "u"\npassword_file = "latin"', "expected text in UTF-8"),
        (SHORT + 'user = "u"\npassword_env = "NOT_SET"', "the environment variable NOT_SET is not set"),
        (SHORT + 'user = "u"\npassword_env = "E"\npassword_file = "secret"', "keep one"),
        (SHORT + 'password_file = "secret"', "a password needs its user"),
        ('url = "mqtt://u@h"\ntopics = ["a"]\nuser = "v"', "user is stated in the url and as a key"),
        (SHORT + 'ca = "ca.crt"', "ca: only for TLS"),
        (TLS + 'ca = "none"', "ca: "),
        (TLS + 'ca = "empty"', "expected certificates in PEM"),
        (TLS + 'certificate = "client.crt"', "certificate and key belong together"),
        (TLS + 'key = "client.key"', "certificate and key belong together"),
        (TLS + 'certificate = "none"\nkey = "client.key"', "No such file"),
        (TLS + 'certificate = "client.crt"\nkey = "another.key"', "the key that belongs to it"),
        (SHORT + 'session_expiry = "soon"', "session_expiry: expected a duration"),
        (SHORT + 'session_expiry = "0s"', "session_expiry must be 1 min or more"),
        (SHORT + 'session_expiry = "60000d"', "session_expiry must be 1 min or more"),
        (SHORT + 'client_id = ""', "client_id must be text of 1 to 100"),
        (SHORT + 'client_id = 5', "client_id must be text"),
        (SHORT + 'alarms = "a/+"', "expected a topic such as"),
        (SHORT + 'alarms = "a/"', "expected a topic such as"),
        (SHORT + 'alarms = "$SYS"', "expected a topic such as"),
        (SHORT + "verify = false", 'unknown key "verify"'),
    ],
)  # fmt: skip
def test_faults_in_words(folder: Path, text: str, said: str) -> None:
    found, faults = read(folder, text)
    assert found is None and len(faults) == 1, faults
    assert said in faults[0] and faults[0].startswith("[[source]] 1: ")
    assert SECRET not in faults[0]


def test_all_faults_at_once(tmp_path: Path) -> None:
    _, faults = read(
        tmp_path, 'url = "mqtt://h:0"\ntopics = ["+a"]\nca = "x"\nkey = "k"\nalarms = "#"\nclient_id = "\\t"'
    )
    assert len(faults) == 6


def test_a_key_with_a_passphrase_is_refused_and_not_asked_for(folder: Path) -> None:
    from cryptography.hazmat.primitives import serialization

    key = serialization.load_pem_private_key((folder / "client.key").read_bytes(), None)
    (folder / "client.key").write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM,
            serialization.PrivateFormat.PKCS8,
            serialization.BestAvailableEncryption(b"open"),
        )
    )
    _, faults = read(folder, TLS + 'certificate = "client.crt"\nkey = "client.key"')
    assert len(faults) == 1 and "without a passphrase" in faults[0]


@pytest.mark.skipif(os.name != "posix", reason="permissions as POSIX has them")
def test_cautions(folder: Path) -> None:
    text = TLS + 'user = "u"\npassword_file = "secret"\ncertificate = "client.crt"\nkey = "client.key"'
    assert list(read(folder, text)[0].cautions()) == []
    (folder / "secret").chmod(0o644)
    (folder / "client.key").chmod(0o604)
    found = list(read(folder, text)[0].cautions())
    assert len(found) == 2 and all(one.code is CheckCode.SECRET_READABLE for one in found)
    plain = read(folder, SHORT + 'user = "u"\npassword_file = "secret"')[0]
    assert CheckCode.LOGIN_IN_PLAIN_TEXT in [one.code for one in plain.cautions()]
    near = read(folder, SHORT.replace("//h", "//localhost") + 'user = "u"\npassword_file = "secret"')[0]
    assert CheckCode.LOGIN_IN_PLAIN_TEXT not in [one.code for one in near.cautions()]


def test_a_source_of_these_schemes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def made(text: str):
        place = Place("[[source]] 1")
        return stream_of(tomllib.loads(text), place, tmp_path, MAPPING), place.faults

    for text in (SHORT, TLS):
        stream, faults = made(text)
        assert faults == [] and stream.mapping == MAPPING and stream.state == ("idle", "not started")
    stream, (fault,) = made(f'url = "mqt://u:{SECRET}@h"\ntopics = ["a"]')
    assert stream is None and "mqtt:, mqtts:" in fault and SECRET not in fault
    monkeypatch.setitem(sys.modules, "paho.mqtt.enums", None)
    stream, faults = made(SHORT)
    assert stream is None and faults == [
        "[[source]] 1: MQTT needs paho-mqtt 2.1 or newer, and protobuf: pip install 'hygrokf[mqtt]'"
    ]


FILTERS = ("a", "/", "+", "#", "a/+/b/#", "+/+", "$SYS/#", "$share/g/a/#", "a b/ü")
NONE = (
    "", "a#", "#/a", "a/b+", "+a", "a\0b", "a\nb", "x" * 65_536, "$share", "$share/g", "$share/g/",
    "$share//a", "$share/+/a", "$share/g/a#",
)  # fmt: skip


def test_filters() -> None:
    assert [text for text in FILTERS if filter_fault(text)] == []
    assert [text for text in NONE if not filter_fault(text)] == []


def test_topics_of_alarms() -> None:
    def topic(turbine: str, kind: str, subject: str = "") -> str:
        key = f"{kind} {subject}".strip()
        alarm = Alarm(f"{turbine}:{key}:16", turbine, kind, "notice", 16.0, "", "", subject=subject)
        return alarm_topic("p", alarm)

    assert topic("T1", "condensation") == "p/T1/condensation"
    assert topic("T1", "cabinet changed", "hygric_k") == "p/T1/cabinet_changed_hygric_k"
    assert topic("a:b/1", "data stale") == "p/a%3Ab%2F1/data_stale"
    assert len({topic(name, "x") for name in ("a/b", "a b", "a_b", "a+b", "a#b", "a%2Fb")}) == 6
    assert alarm_topic("p", Alarm("by hand", "T1", "data stale", "notice", 16.0, "", "")) == "p/T1/data_stale"


def test_reasons_in_words() -> None:
    assert "its own client_id" in reason_text(ReasonCode(PacketTypes.DISCONNECT, "Session taken over"))
    unusual = ReasonCode(PacketTypes.DISCONNECT, "Payload format invalid")
    assert reason_text(unusual) == "payload format invalid (reason code 153)"
    assert "requires a client certificate" in tls_error_text(
        "[SSL: TLSV13_ALERT_CERTIFICATE_REQUIRED] tlsv13 alert"
    )
    assert tls_error_text("[Errno 104] Connection reset by peer") is None
    assert unreachable_text(TimeoutError("timed out"), "h:1").startswith("h:1: it does not answer")
    assert unreachable_text(OSError(113, "No route to host"), "h:1") == "h:1: No route to host"
    assert unreachable_text(KeyError("x"), "h:1") == "h:1: KeyError: 'x'"
