"""Codes of the results of `hygrokf doctor`: each with its usual level, its sentence, and what to do."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from hygrokf.texts.statement import Code, Statement, Value
from hygrokf.texts.wording import one_line

OK: Final = "ok"
DOUBT: Final = "doubt"
FAULT: Final = "fault"
CHECK_LEVELS = (OK, DOUBT, FAULT)
ASK_REBIRTH = 'publish the command "Node Control/Rebirth" to spBv1.0/GROUP/NCMD/NODE'
"""Remedy if the tracker is not allowed to request a rebirth itself."""
_COMPARE_PAYLOADS = "compare [mapping] and known_as of each [[turbine]] with the delivered payloads"
_COMPARE_CLOCKS = "compare both clocks; stamps in local time need their offset from UTC"
_SET_CLOCK = "synchronise this machine's clock by NTP (timedatectl set-ntp true, or chrony)"
_BOTH_CLOCKS = "synchronise both clocks by NTP"
_UNSAFE = "use TLS and a secret where others could listen"
_ROOM = "make room, keep less (retention), or move the store"
_STATED = "nothing if this is intended"
_BROKER = "check url, user, password and certificates of this [[source]], and that the broker runs"
_TOPIC = "check topic, publisher and the rights of this user; wait longer (--wait 10min) if messages are rare"
_UNKEPT = (
    "{live:.0} messages within {wait:duration}, {unkept:.0} of them published at QoS 0, which the broker "
    "does not keep while the tracker is not running"
)
_SENSOR = "check the sensor and its connection to the server"
_WRITER = "check the program that writes the file"


# fmt: off
class CheckCode(Code):
    """A result of the doctor: its usual level, the template of its sentence, and the template of the
    remedy."""

    # clocks
    STAMP_AHEAD = (
        DOUBT, "its newest stamp is {ahead:duration} ahead of this machine's clock", _COMPARE_CLOCKS,
    )
    STAMP_TOO_FAR_AHEAD = (
        FAULT, "its newest stamp is {ahead:duration} ahead of this machine's clock; readings more than "
        "{limit:duration} ahead are held back", _COMPARE_CLOCKS,
    )
    STAMP_AGE = (OK, "its newest stamp is {age:duration} old")
    STAMP_OLD_BY_HOURS = (
        DOUBT, "its newest stamp is {age:duration} old on arrival: {hours:.0} whole hours",
        "check whether local time is stamped as UTC: stamps need their offset",
    )
    STAMP_TOO_LATE = (
        DOUBT, "its newest stamp is {age:duration} old on arrival, more than the lateness allows "
        "({lateness:duration})",
        "set the source's clock, or state a larger lateness if its readings do arrive so late",
    )
    SERVER_CLOCK_AGREES = (OK, "its clock agrees with this machine's within {limit:.0} s")
    SERVER_CLOCK_AHEAD = (
        DOUBT, "its clock is {difference:duration} ahead of this machine's clock", _BOTH_CLOCKS,
    )
    SERVER_CLOCK_BEHIND = (
        DOUBT, "its clock is {difference:duration} behind this machine's clock", _BOTH_CLOCKS,
    )
    CLOCK_JUMPED = (DOUBT, "it jumped by {jump:+.1} s during this examination", _SET_CLOCK)
    READINGS_OF_THE_FUTURE = (
        FAULT, "the store has readings received {ahead:duration} in the future: the clock was ahead then, or "
        "is behind now", _SET_CLOCK,
    )
    CLOCK_NOT_SYNCHRONISED = (DOUBT, "the kernel reports that it is not synchronised", _SET_CLOCK)
    CLOCK_SYNCHRONISED = (OK, "it is synchronised by NTP")
    CLOCK_EVEN = (OK, "it runs evenly; whether it is synchronised is unknown")
    # files of certificates and secrets
    FILE_UNREADABLE = (FAULT, "{path}: {fault}", "restore it, or name another file")
    SECRET_READABLE = (DOUBT, "every user of this machine can read {path}", "chmod o-rwx {path}")
    SECRET_KEPT = (OK, "other users cannot read {path}")
    CERTIFICATE_NOT_EXAMINED = (
        DOUBT, "{where} was not examined: cryptography is missing", "pip install cryptography",
    )
    NO_CERTIFICATE = (
        FAULT, "{where}: expected a certificate, found something else",
        "name a file with a certificate, PEM or DER",
    )
    CERTIFICATE_TOO_EARLY = (
        FAULT, "{where} is not valid before {begin:stamp}", "compare the clocks, or wait",
    )
    CERTIFICATE_EXPIRED = (
        FAULT, "{where} has expired {since:duration} ago", "replace the certificate",
    )
    CERTIFICATE_ENDS = (DOUBT, "{where} is valid for {left:duration}", "order a new certificate now")
    CERTIFICATE_VALID = (OK, "{where} is valid for {left:duration}")
    # page and channels
    PAGE_PACKAGES_MISSING = (
        FAULT, "its packages are missing", "pip install 'hygrokf[live]', or start with --no-page",
    )
    PAGE_ADDRESS_FREE = (OK, "the address is free")
    PAGE_ADDRESS_TAKEN = (FAULT, "{fault}", "give another address")
    PAGE_REPORTS = (
        DOUBT, "a tracker's page already runs there and reports: {fault}", "read that tracker's log",
    )
    PAGE_HEALTHY = (OK, "a tracker's page already runs there and is healthy")
    MAIL_UNENCRYPTED = (DOUBT, "mail goes to {where} unencrypted", _UNSAFE)
    NOTICES_UNENCRYPTED = (DOUBT, "notices go to {where} unencrypted: use https://", _UNSAFE)
    NOTICES_UNSIGNED = (DOUBT, "notices to {where} are not signed: name a secret_file", _UNSAFE)
    CHANNEL_ANSWERS = (OK, "{where}: {answer}")
    CHANNEL_ACCEPTS = (OK, "a test message was accepted")
    CHANNEL_FAILS = (
        FAULT, "{fault}", "correct [[notify]], or the server; notices wait in the store meanwhile",
    )
    # models
    NUMBER_REJECTED = (
        DOUBT, "the {part} time constant of its model is {words}: {why}",
        "read the fit's report; estimates and alarms that rest on this number say so",
    )
    INPUTS_NOT_MAPPED = (
        FAULT, "its model needs {names:several}, but no mapped field provides it",
        "add it to [mapping.signals]",
    )
    MODEL_CANNOT_RUN = (
        FAULT, "its model cannot be run on these signals: {fault}",
        "correct [mapping.signals] or [[turbine]], or fit the model again",
    )
    MODEL_ALONE = (
        OK, "no mapped field is a reading of its cabinet: the estimates come from the model alone",
    )
    STANDSTILL_ASSUMED = (
        DOUBT, "the model needs the operation, but no mapped field is active_power: it assumes standstill",
        "add the field to [mapping.signals]",
    )
    INPUTS_NEVER_ARRIVED = (
        DOUBT, "its model reads {names:several}, which never arrived",
        "compare the names in [mapping.signals] with the delivered payloads",
    )
    TURBINES_NEVER_HEARD = (
        DOUBT, "no reading of {names:several} has ever arrived",
        "compare their known_as with the names in the payloads, or wait longer (--wait 10min)",
    )
    MODELS_CAN_RUN = (OK, "{count:.0} have a model that can run, and have delivered all its inputs")
    # the store
    STORE_FOLDER_LOCKED = (FAULT, "{folder} is not writable", "check the folder's permissions")
    STORE_TO_BE_MADE = (OK, "{url} does not exist yet; the tracker creates it at its first start")
    STORE_FAILS = (
        FAULT, "{fault}",
        "check the store's URL, its server or folder, and this user's rights; restore a copy if it is "
        "damaged",
    )
    STORE_UNREADABLE = (FAULT, "{url} cannot be read ({fault})", "restore a copy, or name a new store")
    STORE_DAMAGED = (FAULT, "{url} is damaged ({damages})", "move it away and restore a copy")
    STORE_INTACT = (OK, "{url} is reached and intact; version {version:.0}, {size:bytes}")
    STORE_READ_ONLY = (
        FAULT, "this user may not write into it", "grant the tracker's user write permission",
    )
    DISK_ROOM = (
        OK, "{free:bytes} free on its disk; it grows by about {a_day:bytes} a day", _ROOM,
    )
    DISK_FILLS = (
        DOUBT, "{free:bytes} free on its disk; it grows by about {a_day:bytes} a day, which fills it in "
        "{days:.0} d, before retention stops its growth", _ROOM,
    )
    TURBINES_TRACKED = (OK, "{who} tracks {names:several} now")
    TURBINES_NOT_TRACKED = (OK, "no process tracks these turbines now")
    TURBINES_LEFT = (
        DOUBT, "it contains {names:several}, which no process tracks",
        "add a [[turbine]], or delete their rows by hand",
    )
    TURBINES_MISS_THE_PAST = (
        DOUBT, "it does not contain {names:several} yet, but the sources were already read for other "
        "turbines: only new readings are read for these",
        f"{_STATED}; name a new store to read a file from its start",
    )
    TURBINES_NEW = (OK, "it does not contain {names:several} yet: their first readings add them")
    MODELS_CHANGED = (
        DOUBT, "{names:several} had another model, or readings in another form, when last tracked",
        f"{_STATED}: the next start filters their readings again",
    )
    NO_ESTIMATE_YET = (
        DOUBT, "it has no estimate yet", "start the tracker; read its log if none appears",
    )
    ESTIMATES_OF_RECORD = (OK, "it has estimates of {names:several}")
    ESTIMATES_OLD = (
        DOUBT, "newest estimates are old: {names:several}",
        "check whether the tracker runs and readings arrive",
    )
    ESTIMATES_FRESH = (OK, "newest estimates: {names:several}")
    # sources of every kind
    SOURCE_NOT_EXAMINED = (OK, "can be read only while the tracker runs; not examined")
    READINGS_GIVEN = (OK, "{used:.0} of {count:.0} {examined} gave readings")
    READINGS_REFUSED = (
        DOUBT, "{used:.0} of {count:.0} {examined} gave readings; not used: {refused}", _COMPARE_PAYLOADS,
    )
    FORECAST_REACHES = (
        OK, "its weather forecast reaches {ahead:duration} ahead",
        "deliver at least a day: shorter forecasts are not used",
    )
    NEWEST_READING = (
        OK, "its newest reading is from {at:stamp}, {age:duration} ago",
        "check the program that writes the file, or fills the table",
    )
    # files
    FILE_FAILS = (FAULT, "{fault}", "check the path, and its permissions for the user of the tracker")
    FILE_AWAITED = (
        DOUBT, "does not exist yet; the tracker waits for it",
        "check the path and the program that writes the file",
    )
    FILE_EMPTY = (
        DOUBT, "it has no rows yet", "write a line of names and then rows, or one JSON object per line",
    )
    FILE_GROWS = (OK, "it grows: {grown:.0} bytes more within {within:duration}")
    FILE_REPLACED = (
        DOUBT, "it was replaced or truncated just now",
        "append to it; the tracker reads a replaced file from its start",
    )
    FILE_RESTS = (
        OK, "it has not grown within {within:duration}; it was last written {age:duration} ago", _WRITER,
    )
    # brokers
    BROKER_FAILS = (FAULT, "{fault}", _BROKER)
    BROKER_CONNECTED = (OK, "connected{security}{user}")
    CONNECTION_LOST = (FAULT, "the connection was lost: {fault}", _BROKER)
    LOGIN_IN_PLAIN_TEXT = (DOUBT, "user and password go to {where} in plain text", "use mqtts://")
    SUBSCRIPTION_DENIED = (
        FAULT, "the broker denies the subscription: {fault}", "give this user the right to read the topic",
    )
    MESSAGES_NOT_KEPT = (DOUBT, _UNKEPT, "publish at QoS 1")
    NODE_MESSAGES_NOT_KEPT = (
        DOUBT, _UNKEPT, "edge nodes publish at QoS 0: let the broker keep it for sessions (mosquitto: "
        "queue_qos0_messages true)",
    )
    MESSAGES_ARRIVE = (OK, "granted; {live:.0} messages within {wait:duration}")
    ONLY_RETAINED = (
        DOUBT, "granted; nothing new within {wait:duration}, only {retained:.0} retained messages", _TOPIC,
    )
    NO_MESSAGE = (
        DOUBT, "granted, but no message arrived within {wait:duration}: a broker may grant and deliver "
        "nothing", _TOPIC,
    )
    NODES_EXPLAINED = (OK, "all messages of the edge nodes {names:several} can be read")
    SEQUENCE_BROKEN = (
        DOUBT, "messages are missing in the sequence of {names:several}",
        "check the connection of the edge node, and look for two edge nodes with the same name",
    )
    BIRTH_MISSING = (
        DOUBT, "values by aliases, but no birth certificate within {wait:duration}, came from "
        "{names:several}",
        f"if the tracker has none of them either: {ASK_REBIRTH}, or set rebirth_requests = true",
    )
    NODES_DIED = (
        DOUBT, "a death certificate came within {wait:duration} from {names:several}", "check the edge node",
    )
    # OPC UA servers
    SERVER_FAILS = (
        FAULT, "{fault}", "check url, certificates and user of this [[source]], and that the server runs",
    )
    SERVER_CONNECTED = (OK, "connected")
    NODES_REFUSED = (
        FAULT, "{count:.0} of {of:.0} nodes do not exist or are denied: {names:several}",
        "compare the ids with the server's address space, and give this user the right to read them",
    )
    NODES_SILENT = (
        DOUBT, "no value of {names:several} within {wait:duration}",
        "wait longer (--wait 1min), or check whether the server samples these nodes",
    )
    VALUES_BAD = (DOUBT, "values that are not good: {names:several}", _SENSOR)
    VALUES_OLD = (DOUBT, "values older than {limit:duration}: {names:several}", _SENSOR)
    VALUES_UNSTAMPED = (
        DOUBT, "values without a time stamp, which are not used: {names:several}", _SENSOR,
    )
    NODES_GOOD = (OK, "{count:.0} of {of:.0} nodes have a good value")
    HISTORY_KEPT = (OK, "the server keeps the history of the {count:.0} nodes examined")
    HISTORY_MISSING = (
        DOUBT, "no history of {count:.0} of {of:.0} nodes: {names:several}",
        "enable history on the server and let this user read it: otherwise samples are lost while the "
        "tracker is not running",
    )
    # databases
    DATABASE_FAILS = (
        FAULT, "{fault}", "check url, password and query of this [[source]], and that the server runs",
    )
    QUERY_ANSWERED = (OK, "connected; the query gives {columns}")
    QUERY_EMPTY = (DOUBT, "no {examined}", "check the query and the program that fills its table")
    QUERY_SLOW = (
        DOUBT, "the query took {took:duration}, longer than poll ({poll:duration})",
        "create an index on {watermark}, or poll less often",
    )

    def __init__(self, usual: str, template: str, remedy: str = "") -> None:
        super().__init__(template, remedy)
        self.usual = usual

    def __call__(self, about: str = "", level: str = "", /, **values: Value) -> Check:
        """The check with these values; `about`: what was checked; `level`: if it is not the usual one."""
        return Check(self, values, about, level or self.usual)

# fmt: on


class ExaminedCode(Code):
    """What the doctor has read of a source, and phrases in its results."""

    PAYLOADS = "payloads"
    LAST_ROWS = "last rows"
    PLAYED_BACK = "rows that are played back"
    VALUES = "values"
    ROWS = "rows"
    FIRST_ROWS = "first rows"
    ROWS_SINCE = "rows of the last {span:duration}"
    BY_TLS = " by TLS"
    AS_USER = " as user {user}"
    AGED = "{turbine} {age:duration} ago"
    REFUSED = "{count:.0} {kind} ({why})"
    NODE = "{node} ({why})"
    NODE_SINCE = "{node} ({at:stamp})"


@dataclass(frozen=True)
class Check(Statement):
    """The result of one check: what was checked (`about`), its `level` (see `CHECK_LEVELS`), and the remedy,
    empty for level "ok"."""

    about: str = ""
    level: str = OK

    @property
    def remedy(self) -> str:
        """What to do; "" for the level "ok"."""
        return "" if self.level == OK else super().remedy

    def to_json(self) -> dict[str, Any]:
        return {
            "level": self.level,
            "about": self.about,
            "found": self.text,
            "remedy": self.remedy,
            **super().to_json(),
        }

    def __str__(self) -> str:
        """Return the check as one line for the terminal."""
        remedy_text = f"; to do: {self.remedy}" if self.remedy else ""
        return one_line(f"{self.level:5}  {self.about}: {self.text}{remedy_text}")
