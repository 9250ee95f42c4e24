"""The complete tracker: service, page, log and operating-system signals, run from a configuration until a
signal ends it.

The log on standard error includes, in its own form, the logs of other packages, warnings, and exceptions that
end a thread.
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
_STANDARD_FIELDS = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName"}


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
        on_commit=hub.announce_batch,
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
        senders = [Sender(channel, service.store_url, lambda: service.now) for channel in service.channels]
        # callbacks run in reverse order: all senders are told to end before the first one is waited for
        for act in (Sender.stop, Sender.end):
            for sender in senders:
                stack.callback(act, sender)

        def begin() -> None:
            """Start the senders and log doubts, once the store is open."""
            for sender in senders:  # the store exists now
                sender.start()
            for name, doubt in record_doubts(config.turbines):
                LOG.warning(
                    "the model was identified on a doubtful record", extra={"turbine": name, "why": doubt}
                )
            begun(service, page)

        service.run(until_ended, begin)
    lost = [reason for word, reason in (stream.state for stream in config.streams) if word == "lost"]
    if until_ended and lost:
        raise SourceFault(f"{'; '.join(lost)}. All {service.health.deliveries} deliveries are committed")
    return service


def record_doubts(turbines: Mapping[str, Turbine]) -> Iterator[tuple[str, str]]:
    """Yield (turbine, sentence) for each doubt about the record that identified a turbine's model."""
    for name, turbine in turbines.items():
        reasons = (reason for verdict in turbine.verdicts.values() for reason in verdict.reasons)
        doubts = (reason.text for reason in reasons if reason.code is ReasonCode.RECORD_DOUBTED)
        yield from ((name, doubt) for doubt in dict.fromkeys(doubts))


@contextmanager
def ended_by_signals(service: Service) -> Iterator[None]:
    """Within this context SIGTERM and SIGINT let the service commit its deliveries and end; a second signal
    ends it at once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number: int, frame: object) -> None:
        """End the service at the first signal, raise KeyboardInterrupt at the second."""
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
    """Formats a log record as "text" or "json" (`form`), with time (UTC) and extra fields."""

    def __init__(self, form: str = "text") -> None:
        super().__init__()
        self.form = form

    def format(self, record: logging.LogRecord) -> str:
        """Return a log record as one line."""
        at = datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds")
        extra = {key: value for key, value in vars(record).items() if key not in _STANDARD_FIELDS}
        if record.exc_info:
            extra["trace"] = self.formatException(record.exc_info)
        if self.form == "json":
            entry = {
                "time": at,
                "level": record.levelname.lower(),
                "name": record.name,
                "message": _message(record),
            }
            # ASCII: replacements of characters that an encoding cannot express would break the JSON
            return json.dumps({**{key: _plain(value) for key, value in extra.items()}, **entry})
        # an event stays on one line, whatever characters an external name contains
        fields = "".join(f" {key}={one_line(str(value))}" for key, value in extra.items())
        return f"{at} {record.levelname.lower():7} {record.name}: {one_line(_message(record))}{fields}"


def _message(record: logging.LogRecord) -> str:
    """Return the message of a log record, also if its arguments do not fit."""
    try:
        return record.getMessage()
    except Exception:
        return f"{record.msg} {record.args}"


def _plain(value: object) -> str | int | float | bool | None:
    """Convert a value for JSON."""
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    return value if isinstance(value, str | int | bool | None) else str(value)


@contextmanager
def log_to_stderr(form: str = "text", level: int = logging.INFO) -> Iterator[None]:
    """Within this context send the package's logs, other packages' warnings, and exceptions that end a thread
    to standard error in a form, "text" or "json"."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(LogLines(form))
    package, root = logging.getLogger("hygrokf"), logging.getLogger()
    before = [(logger, list(logger.handlers), logger.level, logger.propagate) for logger in (package, root)]
    hooks = sys.unraisablehook, threading.excepthook
    package.handlers[:] = root.handlers[:] = [handler]
    package.setLevel(level)
    package.propagate = False
    root.setLevel(logging.WARNING)
    logging.captureWarnings(True)
    sys.unraisablehook = lambda raised: _log_exception("an exception could not be raised", raised)
    threading.excepthook = lambda raised: _log_exception("a thread ended by an exception", raised)
    try:
        yield
    finally:
        sys.unraisablehook, threading.excepthook = hooks
        logging.captureWarnings(False)
        for logger, handlers, before_level, propagate in before:
            logger.handlers[:] = handlers
            logger.setLevel(before_level)
            logger.propagate = propagate


def _log_exception(message: str, raised: sys.UnraisableHookArgs | threading.ExceptHookArgs) -> None:
    """Log an exception that nobody has handled, unless it ends a thread on purpose."""
    if not issubclass(raised.exc_type, SystemExit):
        exc_info = (raised.exc_type, raised.exc_value or raised.exc_type(), raised.exc_traceback)
        LOG.error(message, exc_info=exc_info, extra={"fault": str(raised.exc_value)})
