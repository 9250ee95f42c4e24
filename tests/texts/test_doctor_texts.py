"""The sentences of the doctor, from the values of their codes."""

from __future__ import annotations

from string import Formatter

import pytest

from hygrokf.data.structured import plain
from hygrokf.texts.doctor_codes import CHECK_LEVELS, DOUBT, OK, CheckCode, ExaminedCode
from hygrokf.texts.statement import Code, Statement

KINDS = (CheckCode, ExaminedCode)
VALUES = {
    "ahead": 7200.0, "limit": 900.0, "age": 7200.0, "hours": 2, "lateness": 1800.0, "difference": 90.0,
    "jump": 30.0, "path": "page.key", "fault": "no answer", "where": "ca.crt", "begin": 86400.0,
    "since": 172800.0, "left": 864000.0, "answer": "it answers", "part": "thermal", "words": "not reliable",
    "why": "too short", "names": tuple("abcdefg"), "count": 3, "folder": "store", "url": "sqlite:live.db",
    "damages": "a; b", "version": 7, "size": 1.5e6, "free": 2e9, "a_day": 3e6, "days": 12.0,
    "who": "process 7", "kind": "no time", "used": 2, "examined": ExaminedCode.LAST_ROWS(),
    "refused": ("1 no time",), "at": 86400.0,
    "grown": 120, "within": 5.0, "security": ExaminedCode.BY_TLS(), "user": " as reader",
    "wait": 10.0, "live": 9, "unkept": 4, "retained": 2, "of": 4, "columns": ("time", "value"),
    "took": 12.0, "poll": 10.0, "watermark": "id", "span": 600.0, "turbine": "T07", "node": "ns=2;s=a",
}  # fmt: skip
"""Values of the fields of all templates."""
TEXTS = {
    CheckCode.STAMP_AHEAD: "its newest stamp is 2 h ahead of this machine's clock",
    CheckCode.STAMP_TOO_FAR_AHEAD: (
        "its newest stamp is 2 h ahead of this machine's clock; readings more than 15 min ahead are held back"
    ),
    CheckCode.STAMP_AGE: "its newest stamp is 2 h old",
    CheckCode.STAMP_OLD_BY_HOURS: "its newest stamp is 2 h old on arrival: 2 whole hours",
    CheckCode.STAMP_TOO_LATE: (
        "its newest stamp is 2 h old on arrival, more than the lateness allows (30 min)"
    ),
    CheckCode.SERVER_CLOCK_AGREES: "its clock agrees with this machine's within 900 s",
    CheckCode.SERVER_CLOCK_AHEAD: "its clock is 90 s ahead of this machine's clock",
    CheckCode.SERVER_CLOCK_BEHIND: "its clock is 90 s behind this machine's clock",
    CheckCode.CLOCK_JUMPED: "it jumped by +30.0 s during this examination",
    CheckCode.READINGS_OF_THE_FUTURE: (
        "the store has readings received 2 h in the future: the clock was ahead then, or is behind now"
    ),
    CheckCode.FILE_UNREADABLE: "page.key: no answer",
    CheckCode.SECRET_READABLE: "every user of this machine can read page.key",
    CheckCode.SECRET_KEPT: "other users cannot read page.key",
    CheckCode.CERTIFICATE_NOT_EXAMINED: "ca.crt was not examined: cryptography is missing",
    CheckCode.NO_CERTIFICATE: "ca.crt: expected a certificate, found something else",
    CheckCode.CERTIFICATE_TOO_EARLY: "ca.crt is not valid before 1970-01-02T00:00Z",
    CheckCode.CERTIFICATE_EXPIRED: "ca.crt has expired 2 d ago",
    CheckCode.CERTIFICATE_ENDS: "ca.crt is valid for 10 d",
    CheckCode.CERTIFICATE_VALID: "ca.crt is valid for 10 d",
    CheckCode.PAGE_ADDRESS_TAKEN: "no answer",
    CheckCode.PAGE_REPORTS: "a tracker's page already runs there and reports: no answer",
    CheckCode.MAIL_UNENCRYPTED: "mail goes to ca.crt unencrypted",
    CheckCode.NOTICES_UNENCRYPTED: "notices go to ca.crt unencrypted: use https://",
    CheckCode.NOTICES_UNSIGNED: "notices to ca.crt are not signed: name a secret_file",
    CheckCode.CHANNEL_ANSWERS: "ca.crt: it answers",
    CheckCode.CHANNEL_FAILS: "no answer",
    CheckCode.NUMBER_REJECTED: "the thermal time constant of its model is not reliable: too short",
    CheckCode.INPUTS_NOT_MAPPED: "its model needs a, b, c, d, e and 2 more, but no mapped field provides it",
    CheckCode.MODEL_CANNOT_RUN: "its model cannot be run on these signals: no answer",
    CheckCode.INPUTS_NEVER_ARRIVED: "its model reads a, b, c, d, e and 2 more, which never arrived",
    CheckCode.TURBINES_NEVER_HEARD: "no reading of a, b, c, d, e and 2 more has ever arrived",
    CheckCode.MODELS_CAN_RUN: "3 have a model that can run, and have delivered all its inputs",
    CheckCode.STORE_FOLDER_LOCKED: "store is not writable",
    CheckCode.STORE_TO_BE_MADE: (
        "sqlite:live.db does not exist yet; the tracker creates it at its first start"
    ),
    CheckCode.STORE_FAILS: "no answer",
    CheckCode.STORE_UNREADABLE: "sqlite:live.db cannot be read (no answer)",
    CheckCode.STORE_DAMAGED: "sqlite:live.db is damaged (a; b)",
    CheckCode.STORE_INTACT: "sqlite:live.db is reached and intact; version 7, 1.5 MB",
    CheckCode.DISK_ROOM: "2 GB free on its disk; it grows by about 3 MB a day",
    CheckCode.DISK_FILLS: (
        "2 GB free on its disk; it grows by about 3 MB a day, which fills it in 12 d, before retention "
        "stops its growth"
    ),
    CheckCode.TURBINES_TRACKED: "process 7 tracks a, b, c, d, e and 2 more now",
    CheckCode.TURBINES_LEFT: "no process tracks a, b, c, d, e and 2 more, which it contains",
    CheckCode.TURBINES_MISS_THE_PAST: (
        "it does not contain a, b, c, d, e and 2 more yet, but its sources were read for others: only "
        "what comes after that is read for these"
    ),
    CheckCode.TURBINES_NEW: "it does not contain a, b, c, d, e and 2 more yet: their first readings add them",
    CheckCode.MODELS_CHANGED: (
        "a, b, c, d, e and 2 more had another model, or readings in another form, when last tracked"
    ),
    CheckCode.ESTIMATES_OF_RECORD: "it has estimates of a, b, c, d, e and 2 more",
    CheckCode.ESTIMATES_OLD: "newest estimates are old: a, b, c, d, e and 2 more",
    CheckCode.ESTIMATES_FRESH: "newest estimates: a, b, c, d, e and 2 more",
    CheckCode.READINGS_GIVEN: "2 of 3 last rows gave readings",
    CheckCode.READINGS_REFUSED: "2 of 3 last rows gave readings; not used: 1 no time",
    CheckCode.FORECAST_REACHES: "its weather forecast reaches 2 h ahead",
    CheckCode.NEWEST_READING: "its newest reading is from 1970-01-02T00:00Z, 2 h ago",
    CheckCode.FILE_FAILS: "no answer",
    CheckCode.FILE_GROWS: "it grows: 120 bytes more within 5 s",
    CheckCode.FILE_RESTS: "it has not grown within 5 s; it was last written 2 h ago",
    CheckCode.BROKER_FAILS: "no answer",
    CheckCode.BROKER_CONNECTED: "connected by TLS as reader",
    CheckCode.CONNECTION_LOST: "the connection was lost: no answer",
    CheckCode.LOGIN_IN_PLAIN_TEXT: "user and password go to ca.crt in plain text",
    CheckCode.SUBSCRIPTION_DENIED: "the broker denies the subscription: no answer",
    CheckCode.MESSAGES_NOT_KEPT: (
        "9 messages within 10 s, 4 of them published at QoS 0, which the broker does not keep while the "
        "tracker is not running"
    ),
    CheckCode.NODE_MESSAGES_NOT_KEPT: (
        "9 messages within 10 s, 4 of them published at QoS 0, which the broker does not keep while the "
        "tracker is not running"
    ),
    CheckCode.MESSAGES_ARRIVE: "granted; 9 messages within 10 s",
    CheckCode.ONLY_RETAINED: "granted; nothing new within 10 s, only 2 retained messages",
    CheckCode.NO_MESSAGE: (
        "granted, but no message arrived within 10 s: a broker may grant and deliver nothing"
    ),
    CheckCode.NODES_EXPLAINED: "every message is explained, of edge nodes a, b, c, d, e and 2 more",
    CheckCode.SEQUENCE_BROKEN: "messages are missing in the sequence of a, b, c, d, e and 2 more",
    CheckCode.BIRTH_MISSING: (
        "values came by aliases, but no birth certificate within 10 s, of a, b, c, d, e and 2 more"
    ),
    CheckCode.NODES_DIED: "a death certificate came within 10 s, of a, b, c, d, e and 2 more",
    CheckCode.SERVER_FAILS: "no answer",
    CheckCode.NODES_REFUSED: "3 of 4 nodes do not exist or are denied: a, b, c, d, e and 2 more",
    CheckCode.NODES_SILENT: "no value of a, b, c, d, e and 2 more within 10 s",
    CheckCode.VALUES_BAD: "values that are not good: a, b, c, d, e and 2 more",
    CheckCode.VALUES_OLD: "values older than 15 min: a, b, c, d, e and 2 more",
    CheckCode.VALUES_UNSTAMPED: "values without a time stamp, which are not used: a, b, c, d, e and 2 more",
    CheckCode.NODES_GOOD: "3 of 4 nodes have a good value",
    CheckCode.HISTORY_KEPT: "the server keeps the history of the 3 nodes examined",
    CheckCode.HISTORY_MISSING: "no history of 3 of 4 nodes: a, b, c, d, e and 2 more",
    CheckCode.DATABASE_FAILS: "no answer",
    CheckCode.QUERY_ANSWERED: "connected; the query gives time, value",
    CheckCode.QUERY_EMPTY: "no last rows",
    CheckCode.QUERY_SLOW: "the query took 12 s, longer than poll (10 s)",
    ExaminedCode.ROWS_SINCE: "rows of the last 10 min",
    ExaminedCode.AS_USER: " as user  as reader",
    ExaminedCode.AGED: "T07 2 h ago",
    ExaminedCode.REFUSED: "3 no time (too short)",
    ExaminedCode.NODE: "ns=2;s=a (too short)",
    ExaminedCode.NODE_SINCE: "ns=2;s=a (1970-01-02T00:00Z)",
}
"""Code with fields -> its sentence with these values."""


@pytest.mark.parametrize(("code", "text"), TEXTS.items(), ids=lambda one: getattr(one, "key", ""))
def test_a_sentence_from_its_values(code: Code, text: str) -> None:
    assert Statement(code, VALUES).text == text


def test_every_code_with_fields_is_in_the_table() -> None:
    codes = [code for kind in KINDS for code in kind]
    assert set(TEXTS) == {code for code in codes if fields(code)}
    assert all(bool(Statement(code, VALUES).remedy) == bool(code.remedy) for code in codes)


def fields(code: Code) -> set[str]:
    return {name for _, name, _, _ in Formatter().parse(code.template) if name}


def test_a_check_says_what_to_do_unless_all_is_well() -> None:
    slow = CheckCode.QUERY_SLOW("source x", took=12.0, poll=10.0, watermark="id")
    found, to_do = "the query took 12 s, longer than poll (10 s)", "create an index on id, or poll less often"
    assert str(slow) == f"doubt  source x: {found}; to do: {to_do}"
    assert CheckCode.FILE_RESTS("x", within=1.0, age=2.0).remedy == ""
    assert CheckCode.FILE_RESTS("x", DOUBT, within=1.0, age=2.0).remedy.startswith("check the program")
    assert {code.usual for code in CheckCode} == set(CHECK_LEVELS)
    assert all(code.remedy for code in CheckCode if code.usual != OK)
    data = plain(slow)
    assert data["code"] == "query_slow" and data["remedy"] == slow.remedy and data["found"] == slow.text
