"""Cabinets that change at a date, and such that do not: when a lasting shift is reported, and how often
wrongly: docs/validation/live_trials.md."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
from plants import DISTURBANCES
from plants.as_record import to_record

from hygrokf.cases.case_file import read_case
from hygrokf.cases.synthetic import SyntheticParameters, synthetic_turbine, write_case
from hygrokf.data.record import Record, Series
from hygrokf.live.plan import Plan
from hygrokf.live.properties import (
    TEMPERATURES,
    ParameterShift,
    deviations,
    parameter_shifts,
    standard_errors,
    states_of,
)
from hygrokf.live.tracker import TrackedCourse, offline_course
from hygrokf.live.turbines import PROPERTY_S
from hygrokf.physics.signal_names import CABINET_HUMIDITIES
from validation.counts import markdown, rate
from validation.frame import Claim
from validation.tracked import DAY_S, identified, plan_of, turbine_plant

PLANT_LEARNT_DAYS, PLANT_DAYS = 60.0, 240.0
FOUND_DAYS = 14.0
"""Days within which a change is to be found."""
YEAR_DAYS = 365.25
OTHER = tuple(kind for kind in DISTURBANCES if kind not in ("ou", "none"))
"""Disturbances that the model's class does not hold."""
BEFORE = SyntheticParameters()
WARMER_K = 3.0
VARIANTS = {
    "none": ("", BEFORE, None),
    "tau": (
        "thermal time constant 1.5 → 2.5 h",
        replace(BEFORE, thermal_time_constant_h=2.5),
        "thermal_time_constant",
    ),
    "exchange": (
        "hygric time constant × 1.6",
        replace(BEFORE, hygric_time_constant_h=1.6 * BEFORE.hygric_time_constant_h),
        "hygric_k",
    ),
    "release": (
        f"heat release + {WARMER_K:.0f} K",
        replace(
            BEFORE,
            operation_release=(BEFORE.operation_release[0] + WARMER_K, *BEFORE.operation_release[1:]),
            standstill_release=(BEFORE.standstill_release[0] + WARMER_K, BEFORE.standstill_release[1]),
        ),
        "heat_release_change",
    ),
}
"""What happens in words, what a synthetic turbine is after the date, and the property that is to depart."""
DAYS = (90.0, 150.0, 210.0)
"""Days of a record: up to which the model is identified, on which the cabinet changes, and the last one."""


def one(variant: str, seed: int) -> dict:
    """Lasting shifts of a synthetic turbine under each variant, and of two plants that do not change.

    `plant` has the disturbances that the model assumes, `other` those of another kind, and errors of all its
    sensors.
    """
    learnt, change, last = DAYS
    return {
        "days": last - learnt,
        "change_day": change - learnt,
        "found": changed(seed, tuple(VARIANTS), DAYS),
        "plant_days": PLANT_DAYS - PLANT_LEARNT_DAYS,
        "plant": _plant(seed, "ou", "cabinet"),
        "other": _plant(seed, OTHER[seed % len(OTHER)], "all"),
    }


def changed(seed: int, variants: Sequence[str], days: tuple[float, float, float]) -> dict[str, list]:
    """Lasting shifts after the identification of a synthetic turbine that becomes each of the variants at
    the date."""
    calm = _record(seed, BEFORE, days[-1])
    cut, date = (calm.start_s + day * DAY_S for day in days[:2])
    fit = identified(calm, cut)
    plan, errors = plan_of(fit, calm), standard_errors(fit)
    found = {}
    for name in variants:
        later = calm if name == "none" else _record(seed, VARIANTS[name][1], days[-1])
        found[name] = lasting(plan, _spliced(calm, later, date).window(cut, calm.end_s), errors)
    return found


def _plant(seed: int, disturbance: str, sensor_errors: str) -> list:
    made = turbine_plant(seed, PLANT_DAYS, disturbance=disturbance, sensor_errors=sensor_errors)
    record = to_record(made)
    cut = record.start_s + PLANT_LEARNT_DAYS * DAY_S
    fit = identified(record, cut)
    return lasting(plan_of(fit, record), record.window(cut, record.end_s), standard_errors(fit))


def _record(seed: int, parameters: SyntheticParameters, days: float) -> Record:
    with tempfile.TemporaryDirectory() as folder:
        return read_case(write_case(synthetic_turbine(seed, days=days, parameters=parameters), folder))


def _spliced(before: Record, after: Record, date_s: float) -> Record:
    """The readings of one record up to a date [s] and of another from then on: the cabinet's alone differ."""

    def joined(early: Series, late: Series) -> Series:
        a, b = early.time < date_s, late.time >= date_s
        return replace(
            early, time=np.r_[early.time[a], late.time[b]], value=np.r_[early.value[a], late.value[b]]
        )

    return replace(before, series=tuple(joined(s, after[s.signal]) for s in before.series))


def lasting(plan: Plan, record: Record, errors: Mapping[str, float]) -> list:
    """Lasting shifts in a record: [property, day of its beginning, day from which it lasted, largest
    change]."""
    begin = record.start_s
    found: list[list] = []
    before: dict[str, ParameterShift] = {}
    for time, known in followed(plan, offline_course(plan, record), errors):
        for name, one in known.items():
            if one.lasting and not (name in before and before[name].lasting):
                found.append([name, (one.since - begin) / DAY_S, (time - begin) / DAY_S, one.change])
            elif one.lasting:
                last = next(row for row in reversed(found) if row[0] == name)
                last[3] = one.change
        before = known
    return [[name, *(round(v, 4) for v in rest)] for name, *rest in found]


def followed(
    plan: Plan, course: TrackedCourse, errors: Mapping[str, float]
) -> Iterator[tuple[float, dict[str, ParameterShift]]]:
    """(time [s], parameter shifts) once an hour, as the fleet judges them."""
    seconds = course.seconds
    first = np.append(True, np.diff(seconds // PROPERTY_S) > 0)
    known: dict[str, ParameterShift] = {}
    for i in np.flatnonzero(first):
        time = float(seconds[i])
        heard = dict.fromkeys((*TEMPERATURES, *CABINET_HUMIDITIES), time)
        states = states_of(plan.model, course.trace.mean[i], course.trace.covariance[i], time, heard)
        known = parameter_shifts(known, float(seconds[i]), deviations(states, errors))
        yield float(seconds[i]), known


def waits(lines: Sequence[Mapping], variant: str) -> list[float]:
    """Days from the change until its property was reported as departed to stay; infinite where it was not."""
    wanted = VARIANTS[variant][-1]
    found = []
    for line in lines:
        days = [row[2] - line["change_day"] for row in line["found"][variant] if row[0] == wanted]
        found.append(min((d for d in days if d >= 0.0), default=math.inf))
    return found


def table(lines: Sequence[Mapping]) -> str:
    """How soon changes were reported, and false alarms without a change."""
    rows = []
    for variant, (words, _, wanted) in VARIANTS.items():
        if wanted is None:
            continue
        days = waits(lines, variant)
        seen = [d for d in days if math.isfinite(d)]
        middle = f"{np.median(seen):.1f}" if seen else "–"
        longest = f"{max(seen):.1f}" if len(seen) == len(days) else f"{len(days) - len(seen)} never"
        rows.append((words, len(days), rate(d <= FOUND_DAYS for d in days), middle, longest))
    head = ("change", "turbines", "found within 14 days", "days: median", "longest")
    kinds = {
        "synthetic turbines": ([line["found"]["none"] for line in lines], "days"),
        "plants": ([line["plant"] for line in lines], "plant_days"),
        "plants with other disturbances and errors of all sensors": (
            [line["other"] for line in lines],
            "plant_days",
        ),
    }
    calm = []
    for name, (runs, days) in kinds.items():
        alarms = sum(map(len, runs))
        years = sum(line[days] for line in lines) / YEAR_DAYS
        calm.append((name, len(runs), f"{years:.1f}", alarms, f"{alarms / years:.2f}"))
    without = ("without change", "turbines", "turbine-years", "false alarms", "a turbine-year")
    return f"{markdown(head, rows)}\n\n{markdown(without, calm)}"


CLAIM = Claim("changes", {"changes": range(300, 326)}, one, table)
