"""Bad readings in the record of a cabinet of another make: what they move, against a fit without
them: docs/validation/safe_conclusions.md.

In each signal in turn 1, 3 or 10 single readings, or one run of three, are moved by a step whose size is
drawn log-uniformly from five standard deviations of the signal's increments to its range.  The shift of the
logarithm of a time constant is told in half widths of its bounds; that of a tracked state, two hours after
the last bad reading, in its standard deviations.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from other_make import Scenario, make_plant
from other_make.as_record import to_record

from hygrokf.data.readings import mask
from hygrokf.data.record import Record, Series
from hygrokf.data.timestamps import DAY_S, HOUR_S
from hygrokf.identification.fit import Fit
from hygrokf.identification.identify import identify
from hygrokf.live.plan import Plan
from hygrokf.live.tracker import offline_course
from validation.counts import markdown
from validation.frame import Claim, by_variant
from validation.tracked import plan_of

DAYS = 30.0
SIGNALS = (
    "cabinet_temperature",
    "cabinet_relative_humidity",
    "ambient_temperature",
    "ambient_relative_humidity",
    "active_power",
)
KINDS = {"1": (1, 1), "3": (3, 1), "10": (10, 1), "run of 3": (1, 3)}
"""Number of bad places and of readings in each, by name."""


STEPS_S = {"1 min": 60.0, "10 min": 600.0, "1 h": 3600.0}
FITTED_S, TRACKED_S = 20.0 * DAY_S, 10.0 * DAY_S
APART_S = 12.0 * HOUR_S
AFTER_S = 2.0 * HOUR_S


def spoilt(
    series: Series,
    places: int,
    length: int,
    random: np.random.Generator,
    starts: np.ndarray | None = None,
) -> tuple[Series, np.ndarray]:
    """The series with bad readings, and True (T,) where they are; `starts`: their first readings among those
    that are there, drawn by default."""
    value = series.value.copy()
    there = np.flatnonzero(np.isfinite(value))
    spread = float(np.std(np.diff(value[there])))
    bad = np.zeros(len(value), bool)
    for start in random.choice(len(there) - length - 1, places, replace=False) if starts is None else starts:
        size = math.exp(random.uniform(math.log(5.0 * spread), math.log(float(np.ptp(value[there])))))
        chosen = there[start : start + length]
        value[chosen] += size * random.choice([-1.0, 1.0])
        bad[chosen] = True
    if series.signal.endswith("humidity"):
        value = np.clip(value, 0.01, 1.0)
    return replace(series, value=value), bad


def without(series: Series, bad: np.ndarray) -> Series:
    """The series without the readings at `bad` (T,)."""
    return replace(series, value=np.where(bad, np.nan, series.value))


def one(variant: str, seed: int) -> dict:
    """What bad readings move in a fit, or in the tracker."""
    return {"fitted": fitted, "tracked": tracked}[variant](seed)


def fitted(seed: int) -> dict:
    """Shifts in half widths by signal and kind, and what the gate kept out."""
    record = to_record(make_plant(seed, days=DAYS))
    line: dict = {"rows": [], "readings": 0, "suspected": 0}
    kept = mask(record)
    for before, after in zip(record.series, kept.series, strict=True):
        line["readings"] += int((~before.missing).sum())
        line["suspected"] += int((after.missing & ~before.missing).sum())
    random = np.random.default_rng([seed, 16])
    for signal in SIGNALS:
        for kind, (places, length) in KINDS.items():
            series, bad = spoilt(record[signal], places, length, random)
            found = mask(record.replace_series(series))
            seen = found[signal].missing & bad
            spoiled = _fit(record.replace_series(series))
            right = _fit(record.replace_series(without(record[signal], bad)))
            line["rows"].append(
                {
                    "signal": signal,
                    "kind": kind,
                    "found": int(seen.sum()),
                    "bad": int(bad.sum()),
                    "shifts": shifts(spoiled, right),
                }
            )
    return line


def _fit(record: Record) -> Fit:
    return identify(record, starts=1, profiles=False)


def shifts(fitted: Fit, right: Fit) -> dict[str, float]:
    """|Δ ln τ| in half widths of the bounds on ln τ, by time constant; 0 where a bound is open."""
    found = {}
    for name, tau in right.results.time_constants.items():
        half = 0.5 * math.log(tau.upper_h / tau.lower_h) if tau.lower_h > 0.0 else math.inf
        found[name] = abs(math.log(fitted.results.time_constants[name].value_h / tau.value_h)) / half
    return found


def tracked(seed: int) -> dict:
    """How far one bad reading or one run of three moves the tracker's states (final
    estimates, which the offline filter gives bit for bit)."""
    line: dict = {"rows": []}
    days = (FITTED_S + TRACKED_S) / DAY_S
    for step, step_s in STEPS_S.items():
        scenario = Scenario(cabinet_step_s=step_s, ambient_step_s=step_s)
        record = to_record(make_plant(seed, scenario, days))
        begin = record.start_s + FITTED_S
        plan = plan_of(_fit(mask(record.window(record.start_s, begin))), record)
        later = record.window(begin, record.end_s)
        random = np.random.default_rng([seed, 17])
        for signal in SIGNALS:
            for kind, (_, length) in (("1", (1, 1)), ("run of 3", (1, 3))):
                if length > 1 and step_s > 600.0:
                    continue
                moved = [
                    _moved(plan, later, signal, length, begin + APART_S * place, random)
                    for place in range(1, round(TRACKED_S / APART_S) - 1)
                ]
                line["rows"].append({"step": step, "signal": signal, "kind": kind, "moved": moved})
    return line


def _moved(
    plan: Plan, record: Record, signal: str, length: int, at_s: float, random: np.random.Generator
) -> float:
    """The largest difference of a state two hours after bad readings at a time [s], in its standard
    deviations."""
    time = record[signal].known[0]
    start = int(np.searchsorted(time, at_s + random.uniform(0.0, HOUR_S)))
    after_s = time[start + length - 1] + AFTER_S
    series, bad = spoilt(record[signal], 1, length, random, np.array([start]))
    found, right = (
        offline_course(plan, record.replace_series(one).window(record.start_s, after_s + HOUR_S))
        for one in (series, without(record[signal], bad))
    )
    i, j = (int(np.searchsorted(one.seconds, after_s - 1e-3)) for one in (found, right))
    difference = np.abs(found.trace.mean[i] - right.trace.mean[j])
    return float(np.max(difference / np.sqrt(np.diag(right.trace.covariance[j]))))


def table(lines: Sequence[Mapping]) -> str:
    """The tables of the variants that there are."""
    made = {"fitted": _table_of_fits, "tracked": _table_of_tracked}
    return "\n\n".join(made[variant](some) for variant, some in by_variant(lines).items())


def _table_of_fits(lines: Sequence[Mapping]) -> str:
    """Shares of shifts within a quarter of the half width, and of bad readings that the gate found."""
    rows = [row for line in lines for row in line["rows"]]
    cells = []
    for signal in SIGNALS:
        for kind in KINDS:
            part = [row for row in rows if row["signal"] == signal and row["kind"] == kind]
            moved = np.array([shift for row in part for shift in row["shifts"].values()])
            found = sum(row["found"] for row in part) / max(sum(row["bad"] for row in part), 1)
            share = f"{np.mean(moved <= 0.25):.0%}"
            cells.append((signal, kind, f"{found:.0%}", share, f"{moved.max():.2f}"))
    moved = np.array([shift for row in rows for shift in row["shifts"].values()])
    suspected, readings = (sum(line[key] for line in lines) for key in ("suspected", "readings"))
    return "\n\n".join(
        [
            f"{len(lines)} plants; clean readings suspected: {suspected} of {readings}",
            markdown(("signal", "bad readings", "found", "≤ 1/4", "largest"), cells),
            f"all: {np.mean(moved <= 0.25):.1%} of {len(moved)} within a quarter of the half width",
        ]
    )


def _table_of_tracked(lines: Sequence[Mapping]) -> str:
    """Share of bad readings after which no state differs by a tenth of its standard deviation."""
    by: dict[tuple[str, ...], list[float]] = {}
    for line in lines:
        for row in line["rows"]:
            by.setdefault((row["step"], row["signal"], row["kind"]), []).extend(row["moved"])
    cells = [
        (*what, len(moved), f"{np.mean(np.array(moved) <= 0.1):.1%}", f"{np.median(moved):.2f}",
         f"{max(moved):.2f}")
        for what, moved in by.items()
    ]  # fmt: skip
    every = np.concatenate([np.array(moved) for moved in by.values()])
    return "\n\n".join(
        [
            f"{len(lines)} plants",
            markdown(("step", "signal", "bad", "n", "≤ 0.1 sd", "median", "largest"), cells),
            f"all: {np.mean(every <= 0.1):.1%} of {len(every)} within 0.1 sd",
        ]
    )


CLAIM = Claim("spikes", {"fitted": range(7100, 7130), "tracked": range(7300, 7310)}, one, table)
