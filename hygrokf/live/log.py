"""The log on standard error: one line per event, as text for people or as JSON for machines.

It takes in everything that would otherwise reach standard error in a form of its own: the logs of other
packages, warnings, and exceptions that end a thread.
"""

from __future__ import annotations

import json
import logging
import math
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime

from hygrokf.identification.wording import one_line

LOG = logging.getLogger("hygrokf.track")
_OWN = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName"}


class LogLines(logging.Formatter):
    """Formats time (UTC), level, logger, message and extra fields."""

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
                "message": _message(record),
            }
            # ASCII: what an encoding cannot express would be replaced by something that is no JSON
            return json.dumps({**{key: _plain(value) for key, value in beside.items()}, **said})
        # an event stays on one line, whatever characters an external name contains
        more = "".join(f" {key}={one_line(str(value))}" for key, value in beside.items())
        return f"{at} {record.levelname.lower():7} {record.name}: {one_line(_message(record))}{more}"


def _message(record: logging.LogRecord) -> str:
    """A record's message, also where its arguments do not fit."""
    try:
        return record.getMessage()
    except Exception:
        return f"{record.msg} {record.args}"


def _plain(value: object) -> str | int | float | bool | None:
    """A value as JSON has it; text for anything else."""
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    return value if isinstance(value, str | int | bool | None) else str(value)


@contextmanager
def log_to_stderr(form: str = "text", level: int = logging.INFO) -> Iterator[None]:
    """Within this context send the package's logs, other packages' warnings, and exceptions that end a thread
    to standard error in a form, "text" or "json"."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(LogLines(form))
    own, root = logging.getLogger("hygrokf"), logging.getLogger()
    before = [(one, list(one.handlers), one.level, one.propagate) for one in (own, root)]
    hooks = sys.unraisablehook, threading.excepthook
    own.handlers[:] = root.handlers[:] = [handler]
    own.setLevel(level)
    own.propagate = False
    root.setLevel(logging.WARNING)
    logging.captureWarnings(True)
    sys.unraisablehook = lambda one: _log_exception("an exception could not be raised", one)
    threading.excepthook = lambda one: _log_exception("a thread ended by an exception", one)
    try:
        yield
    finally:
        sys.unraisablehook, threading.excepthook = hooks
        logging.captureWarnings(False)
        for one, handlers, before_level, propagate in before:
            one.handlers[:] = handlers
            one.setLevel(before_level)
            one.propagate = propagate


def _log_exception(words: str, one: sys.UnraisableHookArgs | threading.ExceptHookArgs) -> None:
    """Log an exception that nobody has handled, unless it ends a thread on purpose."""
    if not issubclass(one.exc_type, SystemExit):
        exc_info = (one.exc_type, one.exc_value or one.exc_type(), one.exc_traceback)
        LOG.error(words, exc_info=exc_info, extra={"fault": str(one.exc_value)})
