"""The complete tracker: service, page, log and operating-system signals, run from a configuration until it is
told to end.

The log on standard error takes in everything that would otherwise reach it in a form of its own: the logs of
other packages, warnings, and exceptions that end a thread.
"""

from __future__ import annotations

import json
import logging
import math
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime

from hygrokf.live.config import Config
from hygrokf.live.notification.sender import Sender
from hygrokf.live.service import Service
from hygrokf.live.sources.stream import SourceFault
from hygrokf.live.turbine import Turbine
from hygrokf.texts.reasons import ReasonCode
from hygrokf.texts.wording import one_line

LOG = logging.getLogger("hygrokf.track")
_OWN = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName"}


def track(
    config: Config,
    *,
    with_page: bool = True,
    until_ended: bool = False,
    begun: Callable[[Service, str | None], None] = lambda service, page: None,
) -> Service:
    """Track until SIGTERM or SIGINT, or with `until_ended` until every source has ended.

    With `until_ended` a followed file ends at its present end, and SourceFault is raised if a source was
    lost.  `begun` is called with the service and the page's URL once the store is open.  All deliveries are
    committed before this function returns the service, which holds the counts.
    """
    from hygrokf.live.web.server import Hub

    if until_ended:
        for stream in config.streams:
            stream.end_when_read()
    hub = Hub(clock=lambda: service.now)
    service = Service(
        config.turbines,
        config.streams,
        config.store,
        settle=hub.settle,
        retention_s=config.retention_s,
        channels=config.channels,
    )
    with ExitStack() as stack:
        page = None
        if with_page:
            from hygrokf.live.web.application import PageEndpoints
            from hygrokf.live.web.server import serve

            app = PageEndpoints(service, hub, config.page).app()
            page = stack.enter_context(serve(app, config.page, hub)).url
        stack.enter_context(ended_by_signals(service))
        senders = [Sender(one, service.store_url, lambda: service.now) for one in service.channels]
        # the last one registered is called first: all are told to end before one is waited for
        for act in (Sender.stop, Sender.end):
            for one in senders:
                stack.callback(act, one)

        def begin() -> None:
            for one in senders:  # their stores are there now
                one.start()
            for name, said in record_doubts(config.turbines):
                LOG.warning("its model rests on a doubted record", extra={"turbine": name, "why": said})
            begun(service, page)

        service.run(until_ended, begin)
    lost = [said for word, said in (one.state for one in config.streams) if word == "lost"]
    if until_ended and lost:
        raise SourceFault(f"{'; '.join(lost)}. All {service.health.deliveries} deliveries are committed")
    return service


def record_doubts(turbines: Mapping[str, Turbine]) -> Iterator[tuple[str, str]]:
    """(turbine, sentence) of each doubt about a record that a turbine's model was identified on."""
    for name, turbine in turbines.items():
        reasons = (reason for one in turbine.verdicts.values() for reason in one.reasons)
        said = dict.fromkeys(one.text for one in reasons if one.code is ReasonCode.RECORD_DOUBTED)
        yield from ((name, one) for one in said)


@contextmanager
def ended_by_signals(service: Service) -> Iterator[None]:
    """Within this context SIGTERM and SIGINT let the service drain and end; a second signal ends it at
    once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number: int, frame: object) -> None:
        if service.ending.is_set():
            raise KeyboardInterrupt
        LOG.info(
            "ending: committing what has been delivered",
            extra={"signal": signal.Signals(number).name},
        )
        service.stop()

    before = {number: signal.signal(number, handle) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


# -- the log on standard error -----------------------------------------------------------------------------
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
    try:
        return record.getMessage()
    except Exception:
        return f"{record.msg} {record.args}"


def _plain(value: object) -> str | int | float | bool | None:
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
