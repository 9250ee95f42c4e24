"""Pictures of the live page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from illustrations.pages import synthetic_record, write_picture

if TYPE_CHECKING:
    from hygrokf.live.service import Service


def _known(truth) -> dict[str, float]:
    """Parameters of the tracked model at the truth of a synthetic turbine."""
    p = truth.parameters
    operation = ("operation", "power_1", "power_2", "operation_ambient")
    return {
        "thermal_time_constant": p.thermal_time_constant_h,
        "resistance_ratio": p.resistance_ratio,
        "heat_disturbance_sd": p.heat_disturbance_K,
        "heat_disturbance_time": p.heat_correlation_h,
        "hygric_k": truth.hygric_constant_s / 3600.0,
        "vapour_disturbance_sd": 1e3 * p.vapour_disturbance_kg_m3,
        "vapour_disturbance_time": p.vapour_correlation_h,
        "thermal_diffusion": p.temperature_diffusion_K,
        "hygric_diffusion": 1e3 * p.humidity_diffusion_kg_m3,
        "preheating_heat": p.preheating_release_K,
        **{f"heat_release_{n}": v for n, v in zip(operation, p.operation_release, strict=True)},
        "heat_release_standstill": p.standstill_release[0],
        "heat_release_standstill_ambient": p.standstill_release[1],
    }


CASES = {
    3: {"surface": (0.0, -4.0)},
    5: {"surface": (0.0, -2.5)},
    6: {"without": ("cabinet_relative_humidity",)},
    8: {"slower": 1.6},
    10: {"silent_h": 5.0},
    11: {"without": ("ambient_relative_humidity",)},
}
"""What is particular of some turbines: condensing, nearly so, without humidity sensor, changed, silent,
without ambient humidity."""
UNSEEN = (10, 11)
"""Turbines without a forecast."""
VIEWS = {
    # name: view, width, height, scheme
    "page_fleet": ("#/", 1280, 720, "light"),
    "page_fleet_dark": ("#/", 1280, 720, "dark"),
    "page_turbine": ("#/turbine/Synthetic%2003", 1160, 1720, "light"),
    "page_turbine_dark": ("#/turbine/Synthetic%2008", 1160, 1080, "dark"),
    "page_alarms": ("#/alarms", 1160, 720, "light"),
    "page_phone": ("#/turbine/Synthetic%2003", 390, 844, "dark"),
    "page_phone_fleet": ("#/", 390, 844, "light"),
}
ARGUMENTS = (
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
)  # fmt: skip


def live_page(directory: Path) -> None:
    """The live page: a real tracker's store of twelve synthetic turbines (`CASES`)."""
    import shutil

    from builders.page_case import Case, filled
    from PIL.Image import Dither, Quantize
    from playwright.sync_api import sync_playwright

    from hygrokf.live import service as loop
    from hygrokf.live.condition import Surface
    from hygrokf.live.web.application import PageEndpoints
    from hygrokf.live.web.page_settings import PageSettings
    from hygrokf.live.web.server import Hub, serve

    _, truth = synthetic_record(1, directory)
    known = _known(truth)
    cases = []
    for n in range(1, 13):
        given = dict(CASES.get(n, {}))
        slower = given.pop("slower", 1.0)
        own = {**known, "thermal_time_constant": slower * known["thermal_time_constant"]}
        surface = Surface(*given.pop("surface", (0.0, 0.0)))
        cases.append(
            Case(f"Synthetic {n:02d}", **{"seed": 1 + n % 4, "known": own, "surface": surface, **given})
        )
    hub, settings = Hub(), PageSettings(port=0)
    loop.MOST_PER_ROUND = 50  # rounds as short as those of a live source: alarms are judged once a round
    service = filled(directory, cases, 7.0)
    _stated(service)
    with (
        serve(PageEndpoints(service, hub, settings).app(), settings, hub) as server,
        sync_playwright() as playwright,
    ):
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=list(ARGUMENTS))
        for name, (view, width, height, scheme) in VIEWS.items():
            shown = browser.new_page(viewport={"width": width, "height": height}, color_scheme=scheme)
            shown.goto(server.url + view)
            shown.locator("main .spark, main canvas, main li").first.wait_for()
            shown.get_by_text("page connected", exact=True).wait_for()
            shown.locator("#live-data:not(:empty)").wait_for()
            # the colours of small parts, such as a green dot, count as much as those of the ground
            write_picture(name, shown.screenshot(), 256, method=Quantize.MAXCOVERAGE, dither=Dither.NONE)
            shown.close()
        browser.close()


def _stated(service: Service) -> None:
    """What is not a tracker's own: forecasts by hand, with the states that follow, and what people state."""
    import numpy as np
    from builders.page_case import add_forecast, opened
    from builders.store_case import queried

    from hygrokf.data.timestamps import DAY_S
    from hygrokf.live.assessment import Outlook
    from hygrokf.live.batch import Assessment, Batch, Event, Shelf, stated_content, stated_text
    from hygrokf.live.notification.notices import acknowledge
    from hygrokf.texts.live_codes import StateCode

    store, now = opened(service), service.now
    advice = "from 06:00 on pre-heat for 40 min before a start; from 11:00 on none is needed."
    states = store.assessments()
    for n, name in enumerate(service.turbines, start=1):
        if n in UNSEEN:
            continue
        add_forecast(store, name, advice, drift=-0.12 if n in (3, 5) else 0.0)
        likely_s = Outlook(*np.array(store.outlook(name)).T).likely_s(now)
        if likely_s is not None and states[name].state != "at risk":
            said = (StateCode.CONDENSATION_LIKELY_FROM(at=likely_s),)
            risk = Assessment(name, "at risk", stated_text(said), now, stated_content(said))
            store.commit(Batch(assessments=[risk]))
    # a detail of the last alarm of the fleet, as the control room would have left it
    ended = queried(store, "SELECT id FROM alarm WHERE ended IS NOT NULL ORDER BY began DESC")
    for (alarm,), cause in zip(ended, 3 * ("defect", "defect", "false alarm"), strict=False):
        acknowledge(store, alarm, "K. Maier", now - DAY_S / 2.0, cause)
    store.shelve(
        Shelf("Synthetic 08", "cabinet changed", now + 3 * DAY_S, now, "K. Maier", "filter is ordered")
    )
    store.note_event(
        Event("heater", "Synthetic 03", now - DAY_S, "settings changed", "heater set to 5 K", now, "K. Maier")
    )
    store.close()
