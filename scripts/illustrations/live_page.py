"""Pictures of the live page."""

from __future__ import annotations

import io
from pathlib import Path

from illustrations.pages import PICTURES, ROOT, synthetic_record, true_values


def _known(truth) -> dict[str, float]:
    """Parameters of the tracked model at the truth."""
    p = truth.parameters
    known = {**true_values(truth), "preheating_heat": p.preheating_release_K}
    names = ("operation", "power_1", "power_2", "operation_ambient")
    known |= {f"heat_release_{name}": value for name, value in zip(names, p.operation_release, strict=True)}
    names = ("standstill", "standstill_ambient")
    known |= {f"heat_release_{name}": value for name, value in zip(names, p.standstill_release, strict=True)}
    return known


def live_page(directory: Path) -> None:
    """The live page: a real tracker's store of twelve synthetic turbines, one of them condensing, one
    changed, one silent."""
    import shutil

    from builders.page_case import Case, add_forecast, filled, opened
    from PIL import Image
    from playwright.sync_api import sync_playwright

    from hygrokf.live import service as loop
    from hygrokf.live.condition import Surface
    from hygrokf.live.web.application import Page
    from hygrokf.live.web.page_settings import PageSettings
    from hygrokf.live.web.server import Hub, serve

    _, truth = synthetic_record(1, directory)
    known = _known(truth)
    more = {
        3: {"surface": Surface(0.0, -4.0)},
        5: {"surface": Surface(0.0, -2.5)},
        6: {"without": ("cabinet_relative_humidity",)},
        8: {"known": {**known, "thermal_time_constant": 1.6 * known["thermal_time_constant"]}},
        10: {"silent_h": 5.0},
    }
    cases = [
        Case(f"Synthetic {n:02d}", **{"seed": 1 + n % 4, "known": known, **more.get(n, {})})
        for n in range(1, 13)
    ]
    hub, settings = Hub(), PageSettings(port=0)
    loop.MOST = 50  # rounds as short as those of a live source: alarms are judged once a round
    service = filled(directory, cases, 7.0)
    store = opened(service)
    for case in cases:
        add_forecast(
            store,
            case.name,
            "from 06:00 on pre-heat for 40 min before a start; from 11:00 on none is needed.",
        )
    store.close()
    views = {
        "page_fleet": ("#/", 1280, 600, "light"),
        "page_turbine": ("#/turbine/Synthetic%2003", 1160, 1720, "light"),
        "page_alarms": ("#/alarms", 1160, 640, "light"),
        "page_phone": ("#/turbine/Synthetic%2008", 375, 812, "dark"),
    }
    with serve(Page(service, hub, settings).app(), settings, hub) as server, sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=["--no-sandbox", "--disable-gpu"]
        )
        for name, (view, width, height, scheme) in views.items():
            shown = browser.new_page(viewport={"width": width, "height": height}, color_scheme=scheme)
            shown.goto(server.url + view)
            shown.locator("main tr[data-turbine], main canvas, main li").first.wait_for()
            shown.get_by_text("live", exact=True).wait_for()
            picture = io.BytesIO(shown.screenshot())
            path = PICTURES / f"{name}.png"
            Image.open(picture).convert("RGB").quantize(96).save(path, optimize=True)
            print(f"{path.relative_to(ROOT)}: {path.stat().st_size / 1e3:.0f} kB", flush=True)
        browser.close()
