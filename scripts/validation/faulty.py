"""Cabinets and sensors that fail on a date: what the tracker's estimates and alarms say of them:
docs/validation/safe_conclusions.md.

A plant of `other_make.faulty` is identified on its first 30 days and tracked from day 60 on, in rounds of six
hours; its fault begins on day 75.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from other_make.as_record import to_series
from other_make.faulty import (
    DAY_S,
    FAULT_DAY,
    FAULTS,
    FOLLOWS,
    SIGNALS,
    START_S,
    FaultyPlant,
    dew_point,
    make_faulty,
    make_sisters,
)
from other_make.moist_air import saturation_pressure

from hygrokf.data.record import Record, Site
from hygrokf.identification.fit import Fit
from hygrokf.live.batch import Alarm, Batch, Observation
from hygrokf.live.fault_isolation import LONGEST_ISOLATION_S, SHIFT_BEFORE_S, isolate
from hygrokf.live.properties import standard_errors
from hygrokf.live.tracker import Reading, tracked_record
from hygrokf.live.turbine import Turbine
from hygrokf.live.turbines import Fleet
from validation.counts import markdown
from validation.frame import Claim, by_variant
from validation.tracked import identified, plan_of

FITTED_DAYS, TRACKED_DAY, LAST_DAY = 30.0, 60.0, 96.0
LAST_DAY_HEALTHY = 150.0
"""The last day of healthy plants, which are tracked for 90 days."""
ROUND_S = 21600.0
HOLDS_K = 1.0
"""[K] margin above which an instant counts as dry."""
TOLD = 0.5
DAMP, SISTERS = "damp", " with sisters"
FROZEN = {f"frozen {word}": (2.0, "sensor frozen", signal) for word, signal in SIGNALS.items()}
RIGHT = {
    **FROZEN,
    "temperature drift": (20.0, "sensor suspect", "temperature_sensor"),
    "humidity drift down": (20.0, "sensor suspect", "humidity_sensor"),
    "ambient temperature drift": (20.0, "sensor suspect", "ambient_temperature"),
    "ambient humidity drift": (20.0, "sensor suspect", "ambient_humidity"),
    "humidity drift up": (20.0, "sensor or water", ""),
    "fan": (7.0, "cabinet changed", "thermal_time_constant"),
}
"""Fault -> days within which its right name must be said, and the alarm's kind and subject."""


@dataclass
class Tracking:
    """What a tracker said: `estimates` by time [s] (the last version of each), and its alarms by id."""

    estimates: dict[float, tuple[float, ...]] = field(default_factory=dict)
    alarms: dict[str, Alarm] = field(default_factory=dict)

    def keep(self, batch: Batch) -> None:
        for one in batch.estimates.values():
            found = one.condition
            assert found.condensation is not None and found.temperature_K is not None
            assert found.relative_humidity is not None and found.margin_K is not None
            kelvin, humidity = found.temperature_K, found.relative_humidity
            columns = (found.condensation, kelvin.value, kelvin.sd, humidity.value, humidity.sd)
            for at, *row in zip(found.time_s.tolist(), *(c.tolist() for c in columns), strict=True):
                self.estimates[at] = tuple(row)
        self.alarms.update({one.id: one for one in batch.alarms})


@lru_cache(maxsize=4)
def fitted(seed: int, damp: bool, days: float) -> Fit:
    """The model of the first days of a seed's plant of some days, the same for every fault."""
    return identified(logged(make_faulty(seed, damp=damp, days=days)), START_S + FITTED_DAYS * DAY_S)


def logged(made: FaultyPlant) -> Record:
    """What the loggers of a plant wrote."""
    return Record(made.name, tuple(map(to_series, made.channels)), Site(55.0, 9.0), made.rated_W)


def track(
    made: FaultyPlant, fit: Fit, last_day: float = LAST_DAY, sisters: Sequence[Record] = ()
) -> Tracking:
    """Track a plant from its record, with fault isolation when it is due and what its sisters read then."""
    whole = logged(made)
    record = whole.window(START_S + TRACKED_DAY * DAY_S, START_S + last_day * DAY_S)
    plan = plan_of(fit, whole)
    fleet = Fleet({made.name: Turbine(plan, errors=standard_errors(fit))})
    readings = sorted(
        (Reading(s.signal, float(at), float(value)) for s in record.series
         for at, value in zip(s.time, s.value, strict=True)),
        key=lambda one: one.time,
    )  # fmt: skip
    rounds: dict[float, list[Reading]] = {}
    for one in readings:
        rounds.setdefault(np.ceil(one.time / ROUND_S) * ROUND_S, []).append(one)
    found = Tracking()
    for now, some in rounds.items():
        batch = Batch()
        fleet._now = now
        fleet._take(made.name, [Observation(made.name, one, now) for one in some], batch)
        found.keep(fleet.filter_waiting(batch))
        while (due := fleet.isolation_due()) is not None:
            step = due[1]
            since = min(one.since for one in step.lasting)
            history = whole.window(max(since - SHIFT_BEFORE_S, step.time - LONGEST_ISOLATION_S), step.time)
            times = {one.signal: one.time for one in history.series}
            values = {one.signal: one.value for one in history.series}
            beside = [one.window(history.start_s, step.time) for one in sisters]
            *_, finding = isolate(plan, tracked_record(plan, times, values), sisters=beside)
            assert finding is not None
            found.keep(fleet.keep_finding(made.name, replace(finding, time_s=step.time)))
    return found


def raw_margin(made: FaultyPlant) -> np.ndarray:
    """The coldest surface above the dew point [K] (T,) by the readings alone, NaN where they are silent."""
    words = ("temperature", "humidity", "ambient temperature")
    kelvin, humidity, outside = (_on(made, SIGNALS[word]) for word in words)
    return outside + FOLLOWS * (kelvin - outside) - dew_point(humidity * saturation_pressure(kelvin))


def _on(made: FaultyPlant, signal: str) -> np.ndarray:
    """A channel's readings at the plant's instants, NaN where it has none."""
    (channel,) = (one for one in made.channels if one.signal == signal)
    value = np.full(len(made.time), np.nan)
    value[np.searchsorted(made.time, channel.time)] = channel.value
    return value


def one(variant: str, seed: int) -> dict:
    """Counts of a plant's instants from its fault on (healthy: from five days after the tracker's start), and
    its alarms; with sisters other turbines read the ambient, too."""
    damp, sisters = variant == DAMP, variant.endswith(SISTERS)
    fault = "healthy" if damp else variant.removesuffix(SISTERS)
    last_day = LAST_DAY_HEALTHY if variant == "healthy" else LAST_DAY
    made = make_faulty(seed, fault, damp, last_day + 1.0)
    within, *_ = RIGHT.get(fault, (last_day - FAULT_DAY, "", ""))
    beside = [
        Record("sister", tuple(map(to_series, channels)))
        for channels in (make_sisters(seed) if sisters else ())
    ]
    fit = fitted(seed, damp, last_day + 1.0)
    tracked_day = min(last_day, FAULT_DAY + within + 0.5)
    said = track(made, fit, tracked_day, beside)
    begin = START_S + (TRACKED_DAY + 5.0 if fault == "healthy" else FAULT_DAY) * DAY_S
    later = (made.time >= begin) & (made.time <= START_S + tracked_day * DAY_S - 3600.0)
    rows = np.array([said.estimates.get(at, (np.nan,) * 5) for at in made.time.tolist()])
    told, raw = rows[:, 0], raw_margin(made)
    wet, dry = later & (made.margin_K < 0.0), later & (made.margin_K > HOLDS_K)
    held = {}
    silent = later & np.isnan(raw)
    if silent.any():
        humidity = _humidity(made)
        inside = np.abs(rows[:, [1, 3]] - np.stack([made.cabinet_K, humidity], 1)) < 1.96 * rows[:, [2, 4]]
        held = {"silent": int(silent.sum()), "estimates": int(np.isfinite(told[silent]).sum()),
                "held": inside[silent].sum(axis=0).tolist()}  # fmt: skip
    return {
        "fault": fault,
        "wet": int(wet.sum()),
        "missed": int(np.sum(~(told[wet] >= TOLD))),
        "missed_raw": int(np.sum(~(raw[wet] < 0.0))),
        "dry": int(dry.sum()),
        "false": int(np.sum(told[dry] >= TOLD)),
        "alarms": [_alarm(one, made, raw) for one in sorted(said.alarms.values(), key=lambda a: a.began)],
        **held,
    }


def _humidity(made: FaultyPlant) -> np.ndarray:
    return made.pressure_Pa / saturation_pressure(made.cabinet_K)


def _alarm(alarm: Alarm, made: FaultyPlant, raw: np.ndarray) -> dict:
    """An alarm with its days after the fault's, and the least margins [K], true and by the readings, while it
    was open."""
    ended = made.time[-1] if alarm.ended is None else alarm.ended
    while_open = (made.time >= alarm.began) & (made.time <= ended)
    days = [(at - START_S) / DAY_S - FAULT_DAY for at in (alarm.began, ended)]
    read = raw[while_open]
    return {
        "kind": alarm.kind,
        "subject": alarm.subject,
        "days": [round(day, 2) for day in days],
        "statement": alarm.statement,
        "either": bool(alarm.statements[0].values.get("either")),
        "margin": round(float(made.margin_K[while_open].min(initial=np.inf)), 2),
        "margin_raw": round(float(np.nanmin(read)), 2) if np.isfinite(read).any() else None,
    }


def table(lines: Sequence[Mapping]) -> str:
    """Sums by fault: truly condensing and dry instants, and alarms by kind; then what is claimed of it."""
    rows, held = [], []
    for name, some in by_variant(lines).items():
        wet, missed, raw, dry, false = (
            sum(line[key] for line in some) for key in ("wet", "missed", "missed_raw", "dry", "false")
        )
        kinds = Counter(f"{a['kind']} {a['subject']}".strip() for line in some for a in line["alarms"])
        parts = ((missed, wet), (raw, wet), (false, dry))
        share = [f"{100.0 * part / max(whole, 1):.2f} %" for part, whole in parts]
        said = ", ".join(f"{count} {kind}" for kind, count in kinds.most_common())
        rows.append((name, len(some), wet, *share[:2], dry, share[2], said))
        held += [text for text in (_named(name, some), _silent(name, some)) if text]
    head = (
        "fault", "plants", "condensing", "told < 50 %", "by the reading", "dry", "told ≥ 50 %", "alarms",
    )  # fmt: skip
    return "\n".join([markdown(head, rows), "", *held])


def _named(name: str, lines: Sequence[Mapping]) -> str:
    """In how many plants the right name was said in time, and the cabinet named."""
    if lines[0]["fault"] not in RIGHT:
        return ""
    within, kind, subject = RIGHT[lines[0]["fault"]]
    early = [[a for a in line["alarms"] if 0.0 <= a["days"][0] <= within] for line in lines]
    named = sum(any((a["kind"], a["subject"]) == (kind, subject) for a in told) for told in early)
    joined = sum(any(a["either"] for a in told) for told in early)
    blamed = sum(any(a["kind"] == "cabinet changed" for a in line["alarms"]) for line in lines)
    return (
        f"{name}: right name within {within:g} days in {named} of {len(lines)}; the cabinet's sensor "
        f"or the ambient's in {joined}; the cabinet named in {blamed}"
    )


def _silent(name: str, lines: Sequence[Mapping]) -> str:
    """How often bands held while sensors were silent."""
    silent = [line for line in lines if "silent" in line]
    if not silent:
        return ""
    count, there = (sum(line[key] for line in silent) for key in ("silent", "estimates"))
    kelvin, humidity = 100.0 * np.sum([line["held"] for line in silent], axis=0) / count
    return (
        f"{name}: {there} of {count} silent instants estimated; 95 % bands hold temperature in "
        f"{kelvin:.1f} %, humidity in {humidity:.1f} %"
    )


TWENTY = ("wet", "ingress", "silent 12 h", "silent 5 d", DAMP)
CLAIM = Claim(
    "faulty",
    {
        **{name: range(2000, 2020 if name in TWENTY else 2040) for name in (*FAULTS, DAMP)},
        "healthy": range(2000, 2160),
        **{f"{name}{SISTERS}": range(900, 904) for name in (*RIGHT, "healthy", "wet")},
    },
    one,
    table,
)
