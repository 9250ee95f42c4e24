"""The complete tracker: service, page, log and operating-system signals, run from a configuration until it is
told to end.
"""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager

from hygrokf.live.config import Config
from hygrokf.live.notification.sender import Sender
from hygrokf.live.service import Service
from hygrokf.live.sources.stream import SourceFault
from hygrokf.live.turbine import Turbine

LOG = logging.getLogger("hygrokf.track")


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
            from hygrokf.live.web.application import Page
            from hygrokf.live.web.server import serve

            app = Page(service, hub, config.page).app()
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
        said = dict.fromkeys(one.text for one in reasons if one.code == "record_doubted")
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
