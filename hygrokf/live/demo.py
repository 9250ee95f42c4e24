"""A synthetic turbine that is tracked as if it were there: no server and no file is needed.

Its model is identified on its first weeks; the weeks after them are played back, faster than they were.  On one day its
cabinet loses its heat more slowly (a clogged filter), which the tracker is to find.  Beside it the same cabinet is tracked
without its humidity sensor, and without any: what the model alone says can be held against what was read.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from hygrokf.cases.case_file import read_case
from hygrokf.cases.synthetic import SyntheticParameters, synthetic_turbine, write_case
from hygrokf.data.record import Record, Series
from hygrokf.identification.procedure import identify
from hygrokf.identification.results import read_fit, write_fit
from hygrokf.identification.verdict import inherited
from hygrokf.live.plan import plan
from hygrokf.live.properties import standard_errors
from hygrokf.live.sources.streams import Playback, form_of, record_mapping, record_messages
from hygrokf.live.turbines import Turbine

NAMES = {
    "Synthetic 1": (),
    "Synthetic 2, temperature only": ("cabinet_relative_humidity",),
    "Synthetic 3, no sensor": ("cabinet_relative_humidity", "cabinet_temperature"),
}
"""Name -> signals that it does not have."""
FIRST = next(iter(NAMES))
DAYS = 120.0
IDENTIFIED_DAYS = 60.0
"""[d] of the record, and of its beginning that the model is identified on."""
KNOWN_DAYS = 34.0
"""[d] before the live part that the tracker is given at once: forecasts draw on them."""
CHANGED_DAYS = 4.0
"""[d] after the beginning of the live part at which the cabinet changes."""
CHANGED = SyntheticParameters(thermal_time_constant_h=2.5)
DAY_S = 86400.0
SIGNALS = (
    "cabinet_temperature", "cabinet_relative_humidity", "ambient_temperature", "ambient_relative_humidity",
    "active_power", "preheating",
)  # fmt: skip


def demo_turbines(
    folder: Path, seed: int = 1, progress: Callable[[str], None] = lambda text: None
) -> tuple[dict[str, Turbine], Record, float]:
    """The turbines with their model, the record that is played back, and when its live part begins [s].

    What is there in `folder` from an earlier demo is used again.
    """
    folder.mkdir(parents=True, exist_ok=True)
    record = _record(folder / "turbine", seed, SyntheticParameters())
    live_s = record.start_s + IDENTIFIED_DAYS * DAY_S
    model = folder / f"model-{seed}"
    if not (model / "fit.json").is_file():
        fit = identify(record.window(record.start_s, live_s), starts=1, progress=progress)
        write_fit(replace(fit, name=FIRST), model)
    fit = read_fit(model)
    changed = _record(folder / "changed", seed, CHANGED)
    date_s = live_s + CHANGED_DAYS * DAY_S
    series = tuple(_spliced(s, changed[s.signal], date_s) for s in record.series if s.signal in SIGNALS)
    played = replace(record, series=series).window(live_s - KNOWN_DAYS * DAY_S, record.end_s)
    forms = {s.signal: form_of(s) for s in series}
    turbines = {
        name: Turbine(
            plan(fit, name=name, forms=forms, site=record.site, rated_power_W=record.rated_power_W),
            errors=standard_errors(fit),
            verdicts=inherited(fit.results),
        )
        for name in NAMES
    }
    return turbines, played, live_s


def demo_stream(record: Record, live_s: float, speed: float) -> Playback:
    """The record as messages: those before `live_s` [s] at once, those after it `speed` times faster than they were."""
    found = []
    for name, without in NAMES.items():
        own = replace(record, series=tuple(s for s in record.series if s.signal not in without))
        found += record_messages(own, name)
    mapping = replace(record_mapping(record, FIRST), turbines={name: name for name in NAMES})
    return Playback("replay:demo", sorted(found, key=lambda one: one[0]), mapping, speed, live_s)


def _record(folder: Path, seed: int, parameters: SyntheticParameters) -> Record:
    return read_case(write_case(synthetic_turbine(seed=seed, days=DAYS, parameters=parameters), folder))


def _spliced(before: Series, after: Series, date_s: float) -> Series:
    """A cabinet's readings from one course up to a date, from another one after it."""
    if not before.signal.startswith("cabinet_"):
        return before
    early, late = before.time < date_s, after.time >= date_s
    return replace(
        before,
        time=np.concatenate([before.time[early], after.time[late]]),
        value=np.concatenate([before.value[early], after.value[late]]),
    )
