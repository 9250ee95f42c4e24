"""Logs of the tracker: one line an event, as text for people or as JSON for machines."""

from __future__ import annotations

import json
import logging
import sys
from datetime import UTC, datetime

_OWN = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName"}
FORMS = ("text", "json")


class Lines(logging.Formatter):
    """Time (UTC), level, where, what happened, and what was said beside it."""

    def __init__(self, form: str = "text") -> None:
        super().__init__()
        self.form = form

    def format(self, record: logging.LogRecord) -> str:
        at = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")
        beside = {key: value for key, value in vars(record).items() if key not in _OWN}
        if record.exc_info:
            beside["trace"] = self.formatException(record.exc_info)
        if self.form == "json":
            said = {
                "time": at,
                "level": record.levelname.lower(),
                "name": record.name,
                "message": record.getMessage(),
            }
            return json.dumps({**said, **beside}, default=str, ensure_ascii=False)
        # one event is one line, whatever a name from outside holds
        more = "".join(f" {key}={_flat(value)}" for key, value in beside.items())
        return f"{at} {record.levelname.lower():7} {record.name}: {_flat(record.getMessage())}{more}"


def _flat(value: object) -> str:
    return "".join(c if c.isprintable() else " " for c in str(value))


def log_to_stderr(form: str = "text", level: int = logging.INFO) -> None:
    """Let the package's logs go to standard error in a form of `FORMS`."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(Lines(form))
    own = logging.getLogger("hygrokf")
    own.handlers[:] = [handler]
    own.setLevel(level)
    own.propagate = False
