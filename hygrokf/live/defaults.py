"""Configurations without a tracker's file: models and sources from the command line, and the demonstration.

The default has one turbine per model, and signals under their own names.

The demonstration tracks a synthetic turbine and needs no server and no file.  The model is identified on some
weeks, and the following weeks are played back faster than real time.  Some days before the playback the
cabinet begins to lose heat more slowly (a clogged filter); the tracker finds this at the beginning of the
playback.  The same cabinet is also tracked without its humidity sensor and without any sensor, so that the
model alone can be compared with the readings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from hygrokf.cases.case_file import read_case
from hygrokf.cases.synthetic import SyntheticParameters, synthetic_turbine, write_case
from hygrokf.data.record import Record, Series
from hygrokf.data.signals import SIGNALS
from hygrokf.data.timestamps import DAY_S
from hygrokf.data.toml_form import Place
from hygrokf.identification.fit import read_fit, write_fit
from hygrokf.identification.identify import identify
from hygrokf.live.config import Config, ConfigFault, read_turbine, store_url, stream_of, turbine_of
from hygrokf.live.plan import SignalReporting, plan
from hygrokf.live.sources.local import Playback, line_form, record_mapping, record_messages
from hygrokf.live.sources.payload import Field, PayloadMapping
from hygrokf.live.turbines import Turbine
from hygrokf.live.web.page_settings import PAGE_ADDRESS, PageSettings, page_settings
from hygrokf.modelling.library import LIBRARY, Library

TURBINE_NAMES = {
    "Synthetic 1": (),
    "Synthetic 2, temperature only": ("cabinet_relative_humidity",),
    "Synthetic 3, no sensor": ("cabinet_relative_humidity", "cabinet_temperature"),
}
"""Turbine -> signals that are left out."""
FIRST = next(iter(TURBINE_NAMES))
TURBINE_SEED = 1
"""Seed of the synthetic turbine."""
RECORD_DAYS = 100.0
LIVE_DAYS = 60.0
"""`RECORD_DAYS`: length of the record [d]; `LIVE_DAYS`: time from its start to the live part [d]."""
IDENTIFIED_DAYS = 30.0
"""Length of the period before the change on which the model is identified [d]: with a longer one the page
would not open within ten seconds."""
KNOWN_DAYS = 12.0
"""[d] before the live part whose readings the tracker gets at once, as history for the forecasts."""
CHANGED_DAYS = -7.0
"""[d] from the start of the live part to the change of the cabinet: early enough that the alarm of the shift,
which must last two days, begins within seconds of the playback."""
CHANGED_CABINET = SyntheticParameters(thermal_time_constant_h=2.5)
PLAYED = (
    "cabinet_temperature", "cabinet_relative_humidity", "ambient_temperature", "ambient_relative_humidity",
    "active_power", "preheating",
)  # fmt: skip


def default_mapping() -> PayloadMapping:
    """The mapping with all signals under their own names, in display units (°C, %, kW, g/m³)."""
    return PayloadMapping(
        {name: Field(name, row.display, SignalReporting(row.hold)) for name, row in SIGNALS.items()}
    )


def page_at(address: str | None) -> PageSettings:
    """Settings of a page at an address (None: the default).  Raises ConfigFault."""
    place = Place()
    settings = page_settings(address or PAGE_ADDRESS, Path(), place)
    if place.faults:
        raise ConfigFault("--page", place.faults)
    return settings


def store_at(url: str) -> str:
    """A store's URL from the command line.  Raises ConfigFault."""
    try:
        return store_url(url)
    except ValueError as fault:
        raise ConfigFault("--store", [str(fault)]) from None


def default_config(
    fits: Sequence[Path],
    sources: Sequence[str],
    store: str,
    page: PageSettings,
    library: Library = LIBRARY,
) -> Config:
    """A configuration with one turbine per model.  Raises ConfigFault with all faults."""
    place = Place()
    mapping = default_mapping()
    forms = {field.signal: field.form for field in mapping.fields.values()}
    turbines: dict[str, Turbine] = {}
    for path in fits:
        turbine = read_turbine(path, place, library, forms=forms)
        if turbine is None:
            continue
        name = turbine.plan.name
        if name in turbines:
            place.fault(f"{path}: a second model of {name!r}; name turbines in a track.toml")
        turbines[name] = turbine
    # payloads need not name the turbine if there is only one
    mapping = replace(
        mapping, turbine="" if len(turbines) == 1 else "turbine", turbines={name: name for name in turbines}
    )
    # messages refer to a source by number, because its URL may contain a password
    streams = [
        stream_of(default_table(url), replace(place, name=f"--source {number}"), Path(), mapping)
        for number, url in enumerate(sources, start=1)
    ]
    if not sources:
        place.fault(
            'no source: add --source "file:PATH", stdin or "mqtt://BROKER/TOPIC", or write a track.toml'
        )
    if place.faults:
        raise ConfigFault("track", place.faults)
    return Config(turbines, tuple(stream for stream in streams if stream is not None), store, page)


def default_table(url: str) -> dict[str, str | list[str]]:
    """The `[[source]]` table equivalent to a URL; the path of an MQTT URL is the topic filter."""
    scheme, _, rest = url.partition("://")
    broker, _, topic = rest.partition("/")
    if scheme in ("mqtt", "mqtts") and topic:
        return {"url": f"{scheme}://{broker}", "topics": [topic]}
    return {"url": url}


# -- the demonstration ---------------------------------------------------------------------------------------
def demo_turbines(
    folder: Path, progress: Callable[[str], None] = lambda text: None
) -> tuple[dict[str, Turbine], Record, float]:
    """The turbines with their model, the record to play back, and the start of its live part [s].

    Files of an earlier demonstration in `folder` are reused.
    """
    folder.mkdir(parents=True, exist_ok=True)
    record = _record(folder / "turbine", SyntheticParameters())
    live_s = record.start_s + LIVE_DAYS * DAY_S
    date_s = live_s + CHANGED_DAYS * DAY_S
    model = folder / f"model-{TURBINE_SEED}"
    if not (model / "fit.json").is_file():
        until_s = min(date_s, live_s)
        history = record.window(until_s - IDENTIFIED_DAYS * DAY_S, until_s)
        fit = identify(history, starts=1, progress=progress)
        write_fit(replace(fit, name=FIRST), model)
    fit = read_fit(model)
    changed = _record(folder / "changed", CHANGED_CABINET)
    series = tuple(_splice(s, changed[s.signal], date_s) for s in record.series if s.signal in PLAYED)
    played = replace(record, series=series).window(live_s - KNOWN_DAYS * DAY_S, record.end_s)
    forms = {s.signal: line_form(s) for s in series}
    turbines = {
        name: turbine_of(
            fit, plan(fit, name=name, forms=forms, site=record.site, rated_power_W=record.rated_power_W)
        )
        for name in TURBINE_NAMES
    }
    return turbines, played, live_s


def demo_stream(record: Record, live_s: float, speed: float) -> Playback:
    """The record as messages, played at once before `live_s` [s] and at `speed` times real time after it."""
    messages = []
    for name, left_out in TURBINE_NAMES.items():
        sensed = replace(record, series=tuple(s for s in record.series if s.signal not in left_out))
        messages += record_messages(sensed, name)
    mapping = replace(record_mapping(record, FIRST), turbines={name: name for name in TURBINE_NAMES})
    label = f"Demo: synthetic turbines, played back at {speed:,.0f} times real time"
    return Playback(
        "replay:demo", sorted(messages, key=lambda message: message[0]), mapping, speed, live_s, label
    )


def _record(folder: Path, parameters: SyntheticParameters) -> Record:
    return read_case(
        write_case(synthetic_turbine(seed=TURBINE_SEED, days=RECORD_DAYS, parameters=parameters), folder)
    )


def _splice(before: Series, after: Series, date_s: float) -> Series:
    """A cabinet signal that switches from one series to another at a date [s]."""
    if not before.signal.startswith("cabinet_"):
        return before
    early, late = before.time < date_s, after.time >= date_s
    return replace(
        before,
        time=np.concatenate([before.time[early], after.time[late]]),
        value=np.concatenate([before.value[early], after.value[late]]),
    )
