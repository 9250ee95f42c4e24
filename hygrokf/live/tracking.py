"""The whole tracker: service, page and signals, from a configuration to the end that it is told."""

from __future__ import annotations

import logging
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from hygrokf.live.config import Config
from hygrokf.live.service import Service
from hygrokf.live.sources.streams import SourceFault, TailedFile

LOG = logging.getLogger("hygrokf.track")


def track(
    config: Config,
    *,
    with_page: bool = True,
    until_ended: bool = False,
    begun: Callable[[Service, str | None], None] = lambda service, page: None,
) -> Service:
    """Track until a signal to end (SIGTERM, SIGINT), or with `until_ended` until every source has ended.

    A file that is followed then ends where it ends now; raises SourceFault where a source was lost instead.  `begun` is
    told the service and the page's address once the store is open.  What was delivered is committed before it
    returns; the service is returned for what it counted.
    """
    from hygrokf.live.web.events import Hub

    if until_ended:
        for stream in config.streams:
            if isinstance(stream, TailedFile):
                stream.follow = False
    hub = Hub(clock=lambda: service.now)
    service = Service(
        config.turbines,
        config.streams,
        config.store,
        settle=hub.settle,
        retention_s=config.retention_s,
    )
    with ExitStack() as stack:
        page = None
        if with_page:
            from hygrokf.live.web.application import Page
            from hygrokf.live.web.server import serve

            app = Page(service, hub, config.page).app()
            page = stack.enter_context(serve(app, config.page, hub)).url
        stack.enter_context(ended_by_signals(service))
        service.run(until_ended, lambda: begun(service, page))
    lost = [said for word, said in (one.state for one in config.streams) if word == "lost"]
    if until_ended and lost:
        raise SourceFault(
            f"{'; '.join(lost)}. All that was delivered ({service.health.deliveries}) is committed"
        )
    return service


@contextmanager
def ended_by_signals(service: Service) -> Iterator[None]:
    """While it lasts SIGTERM and SIGINT let the service drain and end; a second one ends at once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def told(number: int, frame: object) -> None:
        if service.ending.is_set():
            raise KeyboardInterrupt
        LOG.info(
            "told to end: what was delivered is committed first",
            extra={"signal": signal.Signals(number).name},
        )
        service.stop()

    before = {number: signal.signal(number, told) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
