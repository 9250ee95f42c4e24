"""Notices: written with their alarm, sent once each, whatever the receiver does."""

from __future__ import annotations

import base64
import json
import math
import re
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from builders import sender_process
from builders.command_line import run
from builders.page_case import write_certificate
from builders.ports import free_port
from builders.receivers import FAILURES, PASSWORD, USER, MailServer, WebhookServer
from builders.store_case import queried
from builders.track_case import write_model
from builders.waiting import eventually
from validation.notices import outages

from hygrokf.data.record import Record
from hygrokf.data.timestamps import DAY_S
from hygrokf.live.batch import Alarm, Batch, Notice, Shelf
from hygrokf.live.condition import Surface
from hygrokf.live.config import Config, ConfigFault, read_config
from hygrokf.live.doctor.check import certificate_checks
from hygrokf.live.doctor.examination import channel_checks
from hygrokf.live.notification import notices as outbox
from hygrokf.live.notification import sender as module
from hygrokf.live.notification.channel import Channel, ChannelFault, Content, NoticeMessage
from hygrokf.live.notification.notices import acknowledge, decide, look_again, notices_of
from hygrokf.live.notification.sender import Sender
from hygrokf.live.notification.transports import Mail, Webhook, secret_bytes
from hygrokf.live.sources.local import Playback, record_mapping, record_messages
from hygrokf.live.storage.store import Store, StoreFault, open_store
from hygrokf.live.tracking import track
from hygrokf.live.turbines import Turbine
from hygrokf.texts.doctor_codes import Check
from hygrokf.texts.live_codes import NoticeCode
from hygrokf.texts.statement import Code, Statement

T0 = 1.7e9
SECRET = bytes(range(32))
SECRET_TEXT = "whsec_" + base64.b64encode(SECRET).decode()


def all_sent(store: Store) -> bool:
    return not any(one.waiting for one in outbox.channel_states(store).values())


def an_alarm(number: int = 0, severity: str = "warning", **more: object) -> Alarm:
    began = time.time() - 60.0
    name = f"T1:condensation:{number}"
    return Alarm(name, "T1", "condensation", severity, began, "water condenses", "dry it", **more)


@dataclass(frozen=True, kw_only=True)
class Silent(Channel):
    """A channel that only keeps what it was given."""

    name: str = "ops"
    url: str = ""
    messages: list[NoticeMessage] = field(default_factory=list)

    def send(self, message: NoticeMessage) -> None:
        self.messages.append(message)

    def cautions(self) -> list[Check]:
        return []


SILENT = Silent()


# -- which notices are written, and when they are due --------------------------------------------------------
def test_a_channel_covers_its_kinds_severities_and_turbines() -> None:
    alarm = Alarm("a", "T1", "condensation", "warning", T0, "", "")
    lost = replace(alarm, turbine="", kind="source lost", severity="alarm")
    for some, of_turbine, of_none in (
        ({}, True, True), ({"kinds": ("source lost",)}, False, True),
        ({"severities": ("alarm",)}, False, True),
        ({"turbines": ("T1",)}, True, True), ({"turbines": ("T2",)}, False, True),
    ):  # fmt: skip
        channel = replace(SILENT, **some)
        assert (channel.covers(alarm), channel.covers(lost)) == (of_turbine, of_none)


def test_a_digest_collects_all_but_the_most_severe() -> None:
    channel = replace(SILENT, hold_off_s=60.0, digest_s=3600.0)
    now = 3600.0 * 100 + 1800.0
    soft = Alarm("a", "T1", "condensation", "warning", now, "", "")
    for alarm, due in (
        (soft, 3600.0 * 101), (replace(soft, severity="alarm"), now + 60.0),
        (replace(soft, severity="alarm", ended=now), now), (replace(soft, ended=now), 3600.0 * 101),
        (replace(soft, severity="alarm", began=now - 2 * DAY_S), now + 600.0),
    ):  # fmt: skip
        (notice,) = notices_of([alarm], [channel], now, now)
        assert (notice.due, notice.made) == (due, now)


def test_the_end_is_for_those_who_were_told_of_the_beginning() -> None:
    channel = replace(SILENT, severities=("warning",))
    worse = Alarm("a", "T1", "condensation", "alarm", T0, "", "")
    assert notices_of([worse], [channel], T0, T0) == []
    (end,) = notices_of([replace(worse, ended=T0 + 9.0)], [channel], T0, T0)
    begin = written(replace(worse, severity="warning"), T0, channel)
    ended = replace(worse, ended=T0 + 9.0)
    assert isinstance(decide(end, channel, **known(ended, replace(begin, sent=T0))), Content)
    assert why_not(end, channel, **known(ended)) is NoticeCode.BEGINNING_NOT_SENT


def why_not(notice: Notice, channel: Channel, **more: object) -> Code:
    """Why nothing is sent."""
    reason = decide(notice, channel, **more)
    assert isinstance(reason, Statement)
    return reason.code


def known(alarm: Alarm | None, *others: Notice, shelved: bool = False, now: float = T0 + 100.0) -> dict:
    return {"alarm": alarm, "others": others, "shelved": shelved, "now": now, "record_now": now}


def written(alarm: Alarm, at: float = T0, channel: Channel = SILENT) -> Notice:
    (notice,) = notices_of([alarm], [channel], at, at)
    return notice


def test_what_becomes_of_a_beginning() -> None:
    held = replace(SILENT, hold_off_s=100.0)
    alarm = Alarm("a", "T1", "condensation", "warning", T0, "", "")
    begin = written(alarm, T0, held)
    short, long = replace(alarm, ended=T0 + 50.0), replace(alarm, ended=T0 + 5000.0)
    worse = replace(alarm, severity="alarm")
    sent = replace(begin, sent=T0)
    assert isinstance(decide(begin, held, **known(alarm)), Content)
    assert why_not(begin, held, **known(short, written(short, T0 + 50.0))) is NoticeCode.ENDED_IN_HOLD_OFF
    # a server was away while the alarm stood long enough
    late = known(long, written(long, T0 + 5000.0), now=T0 + 9000.0)
    assert isinstance(decide(begin, held, **late), Content)
    assert why_not(begin, held, **known(long, now=T0 + 3 * DAY_S)) is NoticeCode.OVER_BEFORE_CAUGHT_UP
    assert why_not(begin, held, **known(None)) is NoticeCode.ALARM_NOT_STORED
    acknowledged = replace(alarm, acknowledged=T0 + 1.0)
    assert why_not(begin, held, **known(acknowledged)) is NoticeCode.ACKNOWLEDGED_BEFORE
    assert decide(begin, held, **known(alarm, shelved=True)) == T0 + 160.0
    assert why_not(begin, held, **known(long, shelved=True)) is NoticeCode.ENDED_WHILE_SHELVED
    found = decide(written(worse), held, **known(worse, sent))
    assert isinstance(found, Content) and found.event == "worsened"
    severer = replace(written(worse), sent=T0)
    assert why_not(begin, held, **known(worse, severer)) is NoticeCode.SEVERER_SENT


def test_an_end_is_sent_only_after_its_beginning() -> None:
    alarm = Alarm("a", "T1", "condensation", "warning", T0, "", "", ended=T0 + 50.0)
    begin, end = written(replace(alarm, ended=None)), written(alarm, T0 + 50.0)
    assert isinstance(decide(end, SILENT, **known(alarm, replace(begin, sent=T0))), Content)
    dropped = replace(begin, sent=T0, failure="dropped")
    assert why_not(end, SILENT, **known(alarm, dropped)) is NoticeCode.BEGINNING_NOT_SENT
    assert why_not(end, SILENT, **known(alarm)) is NoticeCode.BEGINNING_NOT_SENT
    assert decide(end, SILENT, **known(alarm, replace(begin, due=T0 + 500.0))) == T0 + 500.0


# -- the sender on a store -----------------------------------------------------------------------------------
def raised(store: Store, channel: Channel, *alarms: Alarm) -> None:
    """Alarms that a round has written, with their notices."""
    now = time.time()
    store.commit(Batch(alarms=list(alarms), notices=notices_of(alarms, [channel], now, now)))


def events(messages: list[NoticeMessage]) -> list[str]:
    return [one.event for message in messages for one in message.contents.values()]


def test_what_people_do_is_sent_to_those_who_were_told(store_url: str) -> None:
    channel = Silent()
    sender, store = Sender(channel, store_url), open_store(store_url)
    alarm = an_alarm()
    raised(store, channel, alarm)
    sender.send_due(store)
    now = time.time()
    assert acknowledge(store, alarm.id, "Ä. Berg", now, "look again", "filter ordered", now + 9.0, [channel])
    assert acknowledge(store, alarm.id, "another", now, "defect", channels=[channel]) is None
    assert acknowledge(store, "a9", "another", now, "defect", channels=[channel]) is None
    sender.send_due(store)
    assert look_again(store, now + 8.0, [channel]).empty
    back = look_again(store, now + 9.0, [channel])
    store.commit(back)
    assert look_again(store, now + 9.0, [channel]).empty
    sender.send_due(store)
    found = outbox.alarm_of(store, alarm.id)
    assert found == replace(alarm, cause="look again", note="filter ordered")
    assert acknowledge(store, alarm.id, "Ä. Berg", now + 10.0, "defect", channels=[channel]) == "T1"
    raised(store, channel, replace(alarm, ended=time.time()))
    sender.send_due(store)
    assert events(channel.messages) == ["began", "acknowledged", "due again", "acknowledged", "ended"]
    sender.send_due(store)
    assert len(channel.messages) == 5 and all_sent(store)
    store.close()


def test_a_shelved_alarm_waits_for_the_end_of_its_shelf(
    store_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("hygrokf.live.notification.notices.SHELVED_S", 0.0)
    channel = Silent()
    clock = [time.time()]
    sender, store = Sender(channel, store_url, lambda: clock[0]), open_store(store_url)
    store.shelve(Shelf("T1", "condensation", clock[0] + 600.0, clock[0], "me"))
    stays, goes = an_alarm(1), an_alarm(2)
    raised(store, channel, stays, goes)
    sender.send_due(store)
    raised(store, channel, replace(goes, ended=time.time()))
    sender.send_due(store)
    assert channel.messages == []
    clock[0] += 601.0
    sender.send_due(store)
    assert [list(one.contents) for one in channel.messages] == [["ops:T1:condensation:1:warning"]]
    store.close()


def test_a_digest_is_one_message_that_stays_the_same(store_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SENDER_BACK_OFF_S", (0.0, 0.0))

    class Failing(Silent):
        def send(self, message: NoticeMessage) -> None:
            super().send(message)
            if len(self.messages) < 2:
                raise ChannelFault("refused", reached=True)

    channel = Failing(digest_s=1e-3)
    sender, store = Sender(channel, store_url), open_store(store_url)
    raised(store, channel, *map(an_alarm, range(3)))
    time.sleep(2e-3)
    sender.send_due(store)
    raised(store, channel, an_alarm(3), an_alarm(4, "alarm"))  # while the first message is tried again
    time.sleep(2e-3)
    sender.send_due(store)
    sender.send_due(store)
    first, again, *rest = channel.messages
    assert (first.key, first.contents) == (again.key, again.contents) and len(first.contents) == 3
    assert {len(one.contents) for one in rest} == {1} and len({one.key for one in channel.messages}) == 3
    assert all_sent(store) and sender.failures == 1
    store.close()


def test_an_accepted_message_is_not_sent_again_when_the_store_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    channel = Silent()
    url = f"sqlite:{tmp_path / 'live.db'}"
    sender, store = Sender(channel, url), open_store(url)
    raised(store, channel, an_alarm())
    real, fails = outbox.mark_sent, [True]

    def mark(*given: object) -> None:
        if fails[0]:
            raise StoreFault("disk full")
        real(*given)

    monkeypatch.setattr(outbox, "mark_sent", mark)
    sender._pass()
    sender._pass()
    assert outbox.channel_states(store)["ops"].waiting == 1
    again = Sender(channel, url)  # as after a crash before the commit
    again._pass()
    assert channel.messages[0] == channel.messages[1]
    again._close()
    del channel.messages[1:]
    fails[0] = False
    sender._pass()
    assert all_sent(store) and len(channel.messages) == 1
    sender._close()
    store.close()


# -- receivers that fail -------------------------------------------------------------------------------------
def mail_to(server: MailServer, **more: object) -> Mail:
    settings = {"name": "mail", "unencrypted": True, "timeout_s": 0.6, **more}
    start = "smtps://" if settings.pop("tls", False) else "smtp://"
    url = f"{start}{settings.pop('user', '')}127.0.0.1:{server.port}"
    return Mail(url=url, sender="tracker@farm.example", to=("ops@farm.example",), **settings)


def hook_to(server: WebhookServer, folder: Path, **more: object) -> Webhook:
    (folder / "secret").write_text(f"{SECRET_TEXT}\n")
    settings = {"name": "hook", "folder": folder, "secret_file": "secret", "timeout_s": 0.6, **more}
    start = "https" if settings.pop("tls", False) else "http"
    return Webhook(url=f"{start}://127.0.0.1:{server.port}/hook?key=geheim", **settings)


@pytest.mark.parametrize("count", [10, pytest.param(100, marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", ["mail", "webhook"])
def test_no_message_is_lost_or_doubled_whatever_the_receiver_does(
    kind: str, count: int, tmp_path: Path
) -> None:

    found = outages(kind, count, 1, tmp_path)
    assert found["held"] and (found["lost"], found["doubled"], found["outages"]) == (0, 0, count)
    assert found["lost_answers"] >= found["repeated"] > 0 and set(found["noticed"]) == set(FAILURES)


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("tls")
    write_certificate(folder / "page.pem", folder / "page.key")
    return folder / "page.pem", folder / "page.key"


@pytest.mark.parametrize("tls", [True, False])
def test_mail_over_tls_with_a_login(tls: bool, pair: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "password").write_text(f"{PASSWORD}\n")
    secured = {"unencrypted": False, "tls": tls, "user": f"{USER}@", "timeout_s": 10.0}
    right = {**secured, "folder": tmp_path, "password_file": "password", "ca": str(pair[0])}
    with MailServer(*pair, tls=tls, login=True) as server:
        mail = mail_to(server, **right)
        assert "TLSv1.3" in mail.probe() and USER in mail.probe() and not server.accepted.messages
        mail.send(NoticeMessage.of({"n1": Content("began", an_alarm())}))
        ((sent, to),) = server.accepted.messages
        assert to == ("ops@farm.example",) and sent["From"] == "tracker@farm.example"
        assert sent["Subject"] == "[hygrokf] T1: condensation (warning, began)"
        assert "water condenses" in sent.get_payload(decode=True).decode()
        (tmp_path / "wrong").write_text("falsch")
        for settings in ({**right, "password_file": "wrong"}, {**right, "ca": ""}):
            for attempt in (mail_to(server, **settings).probe, lambda s=settings: mail_to(
                server, **s).send(NoticeMessage("test"))):  # fmt: skip
                with pytest.raises(ChannelFault) as fault:
                    attempt()
                assert "falsch" not in str(fault.value) and "127.0.0.1" in str(fault.value)
    assert len(server.accepted.messages) == 1


def test_mail_is_not_sent_in_plain_text_unasked() -> None:
    with MailServer() as server:
        with pytest.raises(ChannelFault, match="STARTTLS"):
            mail_to(server, unencrypted=False).send(NoticeMessage.of({"n": Content("began", an_alarm())}))
        assert not server.accepted.messages


def test_a_refused_address_does_not_hold_up_the_others_for_long() -> None:
    message = NoticeMessage.of({"n": Content("began", an_alarm())})
    with MailServer() as server:
        mail = replace(mail_to(server), to=("ops@farm.example", "gone@farm.example"))
        server.refuses = {"gone@farm.example": "450 come back"}
        with pytest.raises(ChannelFault) as fault:
            mail.send(message)
        assert fault.value.reached and not server.accepted.messages
        mail.send(replace(message, attempts=3))
        server.refuses = {"gone@farm.example": "550 unknown"}
        mail.send(message)
        assert [to for _, to in server.accepted.messages] == [("ops@farm.example",)] * 2
        server.refuses = {one: "550 unknown" for one in mail.to}
        with pytest.raises(ChannelFault):
            mail.send(replace(message, attempts=9))


def test_a_webhook_over_tls_is_signed(pair: tuple[Path, Path], tmp_path: Path) -> None:
    alarm = an_alarm()
    with WebhookServer(SECRET, *pair) as server:
        hook = hook_to(server, tmp_path, tls=True, ca=str(pair[0]), timeout_s=10.0)
        assert "TLSv1.3" in hook.probe() and not server.accepted.messages
        message = NoticeMessage.of({"n1": Content("began", alarm)})
        hook.send(message)
        hook.send(NoticeMessage("test"))
        first, test = server.accepted.messages
        assert first["notices"][0]["alarm"] == json.loads(json.dumps(alarm.served()))
        assert (first["type"], test["type"], test["notices"]) == ("hygrokf.alarms", "hygrokf.test", [])
        assert server.accepted.keys[message.key] == 1 and not server.wrong
        with pytest.raises(ChannelFault):
            hook_to(server, tmp_path, tls=True).send(message)  # its CA is not trusted
        server.secret = bytes(32)
        hook.send(message)
        assert server.wrong == [message.key]


def test_what_a_webhook_refuses_says_nothing_secret(tmp_path: Path) -> None:
    with WebhookServer() as server:
        for status in (307, 401, 404, 500):
            server.status = status
            with pytest.raises(ChannelFault) as fault:
                hook_to(server, tmp_path).send(NoticeMessage("k"))
            assert fault.value.reached and str(status) in str(fault.value)
            assert "geheim" not in str(fault.value) + repr(hook_to(server, tmp_path))
    with pytest.raises(ChannelFault) as fault:
        replace(hook_to(server, tmp_path), url=f"http://127.0.0.1:{free_port()}").send(NoticeMessage("k"))
    assert not fault.value.reached
    for text in ("short", "whsec_AAAA", SECRET_TEXT.removeprefix("whsec_"), "whsec_!"):
        with pytest.raises(ChannelFault) as fault:
            secret_bytes(text, "hook.secret")
        assert text not in str(fault.value).replace("whsec_ and", "")


# -- from the tracker's file to the receiver -----------------------------------------------------------------
MAIL = """\
[[notify]]
name = "control room"
url = "smtp://127.0.0.1:{mail}"
sender = "Tracker <tracker@farm.example>"
to = ["ops@farm.example"]
unencrypted = true
hold_off = "10min"
digest = "1h"
severities = ["warning", "alarm"]
kinds = ["condensation"]
turbines = ["T07"]
"""
HOOK = """\
[[notify]]
name = "duty"
url = "http://127.0.0.1:{hook}/alarms?key=geheim"
secret_file = "hook.secret"
timeout = "2s"
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_model(tmp_path / "T07")
    (tmp_path / "hook.secret").write_text(SECRET_TEXT)
    (tmp_path / "hook.secret").chmod(0o600)
    return tmp_path


def read(folder: Path, text: str) -> Config:
    (folder / "track.toml").write_text(TRACK + text)
    return read_config(folder / "track.toml")


TRACK = """\
[[turbine]]
name = "T07"
fit = "T07"
[mapping.signals]
Tcab = { signal = "cabinet_temperature", unit = "degC" }
Tamb = { signal = "ambient_temperature", unit = "degC" }
[[source]]
url = "file:live.csv"
"""


def test_channels_of_a_tracker_s_file(folder: Path) -> None:
    first, second = read(folder, MAIL.format(mail=25) + HOOK.format(hook=80)).channels
    assert (first.hold_off_s, first.digest_s, first.kinds) == (600.0, 3600.0, ("condensation",))
    assert isinstance(first, Mail) and (first.where, first.unencrypted) == ("127.0.0.1:25", True)
    assert (first.sender, first.to) == ("Tracker <tracker@farm.example>", ("ops@farm.example",))
    assert isinstance(second, Webhook) and second.signing_key() == SECRET
    assert second.address.path == "/alarms?key=geheim" and second.timeout_s == 2.0


@pytest.mark.parametrize(
    ("before", "after", "said"),
    [
        ("smtp://127.0.0.1:{mail}", "smtp://me:geheim@mail", "a password must not be in this file"),
        ("smtp://127.0.0.1:{mail}", "ftp://mail", "url must begin with one of smtp:"),
        ("smtp://127.0.0.1:{mail}", "smtp://me@mail", "user and password belong together"),
        ("smtp://127.0.0.1:{mail}", "smtps://mail", "unencrypted does not go with smtps"),
        ('to = ["ops@farm.example"]', 'to = ["ops"]', "to must be a list of addresses"),
        ('to = ["ops@farm.example"]', "", "needs to, receivers"),
        ('kinds = ["condensation"]', 'kinds = ["condensations"]', "found ['condensations']"),
        ('severities = ["warning", "alarm"]', 'severities = ["worst"]', "found ['worst']"),
        ('turbines = ["T07"]', 'turbines = ["T08"]', "no turbine is named 'T08'"),
        ('"10min"', '"10d"', "hold_off must be at most 7 d"),
        ('"control room"', '"duty"', "a second channel named 'duty'"),
        ("/alarms?key=geheim", '"\nsecret = "geheim', "a secret must not be in this file"),
        ('secret_file = "hook.secret"', 'secret_file = "no.secret"', "No such file"),
        ('secret_file = "hook.secret"', 'secret_file = "T07/fit.json"', "secret_file"),
        ("http://127.0.0.1:{hook}", "http://me:geheim@host", "a password must not be in this file"),
        ("http://127.0.0.1:{hook}", "http://127.0.0.1:70000", "a port of 1 to 65535"),
    ],
)
def test_a_fault_of_a_channel_is_told_and_shows_no_secret(
    folder: Path, before: str, after: str, said: str
) -> None:
    text = MAIL + HOOK
    assert before in text
    with pytest.raises(ConfigFault) as fault:
        read(folder, text.replace(before, after).format(mail=25, hook=80))
    assert said in str(fault.value) and "geheim" not in str(fault.value)
    assert re.match(r"track.toml: line \d+, \[\[notify\]\] [12]: ", str(fault.value))


def test_the_doctor_tries_channels_and_sends_on_request(folder: Path) -> None:
    with MailServer() as mail, WebhookServer(SECRET) as hook:
        text = MAIL.format(mail=mail.port) + HOOK.format(hook=hook.port)
        channels = read(folder, text).channels
        found = channel_checks(channels, send=False)
        assert [one.level for one in found] == ["ok", "ok"] and not mail.accepted.messages
        found = channel_checks(channels, send=True)
        assert [one.level for one in found] == ["ok"] * 4
        assert len(mail.accepted.messages) == len(hook.accepted.messages) == 1 and not hook.wrong
    found = channel_checks(channels, send=True)
    assert [one.level for one in found] == ["fault", "fault"]
    assert all("refused" in str(one) and "geheim" not in str(one) for one in found)
    checks = {one.about: one.level for one in certificate_checks(folder / "track.toml")}
    assert checks["[[notify]] 2 secret_file"] == "ok"


def test_an_alarm_of_a_tracker_arrives(
    tmp_path: Path, record: Record, turbine: Turbine, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The whole way: readings, an alarm in the store, a mail; also for a channel whose server is away."""
    monkeypatch.setattr(module, "SENDER_BACK_OFF_S", (0.05, 0.2))
    monkeypatch.setattr("hygrokf.live.notification.notices.PAST_S", math.inf)
    cold = replace(turbine, surface=Surface(0.0, -8.0))
    url = f"sqlite:{tmp_path / 'live.db'}"
    with MailServer() as mail, WebhookServer(SECRET) as hook:
        channels = (
            mail_to(mail, timeout_s=5.0, kinds=("condensation",)),
            hook_to(hook, tmp_path, kinds=("condensation",)),
        )
        hook.fail("refuse")
        stream = Playback("replay:", record_messages(record, "T1"), record_mapping(record, "T1"))
        config = Config({"T1": cold}, (stream,), url, channels=channels)
        track(config, with_page=False, until_ended=True)
        store = open_store(url)
        raised = queried(store, "SELECT id FROM alarm WHERE kind = 'condensation'")
        assert raised
        subjects = [str(one["Subject"]) for one, _ in mail.accepted.messages]
        assert len(set(mail.accepted.keys)) == len(subjects) >= 1
        assert all(one.startswith("[hygrokf] T1: condensation") for one in subjects)
        assert outbox.channel_states(store)["hook"].waiting >= len(subjects) and not hook.accepted.messages
        hook.fail("")
        senders = [Sender(one, url, lambda: record.end_s) for one in channels]
        for one in senders:
            one.start()
        eventually(lambda: all_sent(store))
        for one in senders:
            one.stop()
        told = [one["notices"][0]["event"] for one in hook.accepted.messages]
        assert len(told) == len(mail.accepted.messages) and told[0] == "began" and not hook.wrong
        store.close()


@pytest.mark.parametrize("kills", [1, pytest.param(10, marks=pytest.mark.slow)])
def test_a_killed_sender_repeats_at_most_what_it_was_sending(kills: int, tmp_path: Path) -> None:
    """`kill -9` while messages flow: each arrives, and one per kill may come again, with the same key."""
    random, url, each = np.random.default_rng(5), f"sqlite:{tmp_path / 'live.db'}", 60
    with WebhookServer() as hook:
        hook.slow_s = 0.005
        channel = Webhook(name="hook", url=f"http://127.0.0.1:{hook.port}")
        store, count = open_store(url), each * (kills + 1)
        raised(store, channel, *map(an_alarm, range(count)))
        for kill in range(kills + 1):
            process = sender_process.started(url, hook.port)
            try:
                if kill < kills:
                    eventually(lambda many=each * (kill + 1): len(hook.accepted.keys) >= many)
                    time.sleep(float(random.uniform(0.0, 0.02)))
                else:
                    eventually(lambda: all_sent(store))
            finally:
                process.kill()
                process.wait()
        assert len(hook.accepted.keys) == count and hook.accepted.repeated <= kills
        store.close()


def test_the_doctor_s_command_sends_a_test_message(folder: Path) -> None:
    with MailServer() as mail, WebhookServer(SECRET) as hook:
        read(folder, MAIL.format(mail=mail.port) + HOOK.format(hook=hook.port))
        (folder / "live.csv").write_text("turbine,time,Tcab,Tamb\n")
        said = run(f"doctor {folder / 'track.toml'} --wait 1s --no-page --notify --json")
        checks = [one for one in json.loads(said.out)["checks"] if one["about"].startswith("notify")]
        assert [one["level"] for one in checks] == ["ok"] * 4 and "geheim" not in said.out + said.err
        assert len(mail.accepted.messages) == len(hook.accepted.messages) == 1
