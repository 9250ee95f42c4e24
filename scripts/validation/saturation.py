"""Condensation said for surfaces of several kinds against what came, also where it is rare: near
saturation: docs/validation/live_trials.md."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np

from hygrokf.data.readings import SATURATED
from hygrokf.live.condition import Condition, air_condition, at_instants, inputs_of
from hygrokf.live.forecast import moments_by_member
from hygrokf.live.scenarios import HORIZON_S, NoScenarios, Scenarios
from hygrokf.texts.live_codes import BasisCode
from validation.counts import Columns, between_plants, markdown, reliability
from validation.frame import Claim
from validation.tracked import DAY_S, SETTLED_S, Surface, Tracked, tracked_plant, truth

EVERY_S = {"known": 3 * 3600.0, "persistence": 12 * 3600.0}
"""Scenarios → [s] within which one forecast is made, at a random minute."""
STEP_S = 600.0
"""[s] between the instants of scenarios that is the truth."""
SURFACES = (Surface(0.0, 0.0), Surface(0.3, 0.0), Surface(0.3, -1.5), Surface(0.6, 0.0), Surface(0.6, -3.0))
LEADS_H = (0.0, 1.0, 6.0, 24.0, 48.0)
WITHIN_H = 24.0
"""[h] within which condensation at any time is counted as well."""
KINDS = ("ordinary", "damp", "damp, errors of all sensors")
"""What a seed's plant is, by its remainder: see `cabinet`."""
BINS = (0.0, 0.02, 0.1, 0.2, 0.4, 0.6, 0.8, 0.9, 0.98, 1.0)
COLUMNS = ("scenarios", "surface", "lead_h", "ceiling", "said", "margin_true")
WINDOW_COLUMNS = ("scenarios", "surface", "highest", "came")
SCENARIOS = tuple(EVERY_S)


def one(variant: str, seed: int, *, days: float = 60.0, learnt: float = 45.0) -> dict:
    """Forecasts of a plant over some days after those that its model was identified on, and the truth.

    A row is a forecast, a surface, a lead time: whether the newest reading of humidity was at the ceiling,
    the probability that was said, the true margin.  A window is a forecast and a surface: the highest
    probability within `WITHIN_H`, and whether there was condensation at any instant of them.
    """
    case, begin = tracked_plant(seed, learnt, days, **cabinet(seed))
    rows: list[tuple] = []
    windows: list[tuple] = []
    for number, name in enumerate(SCENARIOS):
        random = np.random.default_rng([seed, 43, number])
        for after in np.arange(SETTLED_S, days * DAY_S - HORIZON_S - EVERY_S[name], EVERY_S[name]):
            now = begin + after + 60.0 * random.integers(0, int(EVERY_S[name] // 60))
            try:
                scenarios = _known(case, now) if name == "known" else case.scenarios(now)
            except NoScenarios:
                continue
            for surface, found in _conditions(case, now, scenarios):
                some, window = _compared(case, found, SURFACES[surface])
                moist = float(_newest_humidity(case, now) >= SATURATED)
                rows += [
                    (number, surface, lead, moist, *row) for lead, row in zip(LEADS_H, some, strict=True)
                ]
                windows.append((number, surface, *window))
    return {
        "kind": KINDS[seed % len(KINDS)],
        "rows": np.round(rows, 4),
        "windows": np.round(windows, 4),
    }


def cabinet(seed: int) -> dict[str, object]:
    """Options of a seed's plant: an ordinary cabinet, or one that gives little heat, least at standstill.

    Damp ones give 0.5 to 3 K at standstill and 4.5 to 10 K at rated power, where ordinary ones give 4.5 to 6
    K and more than 10 K: their air is near saturation whenever the ambient's is.
    """
    if seed % len(KINDS) == 0:
        return {}
    random = np.random.default_rng([seed, 77])
    tau_h, rho = np.exp(random.uniform(np.log(0.8), np.log(3.0))), random.uniform(0.72, 0.93)
    outer = 0.025
    operation_K = (random.uniform(2.0, 5.0), random.uniform(2.5, 5.5), -random.uniform(0.3, 1.0),
        -random.uniform(0.02, 0.15))  # fmt: skip
    standstill_K = (random.uniform(0.5, 3.0), -random.uniform(0.01, 0.08))
    return {
        "outer_resistance": outer,
        "inner_resistance": outer * (1.0 / rho - 1.0),
        "heat_capacity": 3600.0 * tau_h * rho / outer,
        "operation_W": tuple(part / outer for part in operation_K),
        "standstill_W": tuple(part / outer for part in standstill_K),
        "preheating_W": random.uniform(6.0, 11.0) / outer,
        "sensor_errors": "cabinet" if seed % len(KINDS) == 1 else "all",
    }


def _known(case: Tracked, now_s: float) -> Scenarios:
    """The weather and the operation that came, as one member."""
    begin = case.point(now_s).time
    time = begin + np.arange(-18 * STEP_S, HORIZON_S + 1.0, STEP_S)
    drivers = case.made.drivers
    member = {
        "ambient_temperature": np.interp(time, drivers.time, drivers.ambient_K),
        "ambient_absolute_humidity": np.interp(time, drivers.time, drivers.ambient_kg_m3),
        "active_power": _means(drivers.time, drivers.power_W, time),
    }
    if drivers.preheating.any():
        member["preheating"] = _means(drivers.time, drivers.preheating, time)
    return Scenarios(begin, time, (member,), BasisCode.OPERATION_AS_NOW())


def _means(minutes: np.ndarray, held: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Means (H,) over the steps that end at `time` (H,) of what is held from each minute on."""
    area = np.concatenate(([0.0], np.cumsum(held[:-1] * np.diff(minutes))))
    return (np.interp(time, minutes, area) - np.interp(time - STEP_S, minutes, area)) / STEP_S


def _conditions(case: Tracked, now_s: float, scenarios: Scenarios) -> Iterator[tuple[int, list[Condition]]]:
    """(place of the surface, its condition under each member) of one forecast."""
    model, courses = case.plan.model, list(moments_by_member(case.plan, case.point(now_s), scenarios))
    for place, surface in enumerate(SURFACES):
        found = [
            air_condition(model, case.plan.values, t.seconds, inputs_of(model, t), *moments, surface)
            for t, *moments in courses
        ]
        kept = np.isin(np.round(found[0].time_s), np.round(scenarios.time_s))
        yield place, [at_instants(one, kept) for one in found]


def _compared(case: Tracked, found: Sequence[Condition], surface: Surface) -> tuple[list[tuple], tuple]:
    """(said, true margin) at the lead times, and (highest said, whether it came) within `WITHIN_H`."""
    hours = (found[0].time_s - found[0].time_s[0]) / 3600.0
    margin = truth(case.made, found[0].time_s, surface).margin_K
    said = np.mean([c.condensation for c in found], axis=0)
    places = [int(np.argmin(np.abs(hours - lead))) for lead in LEADS_H]
    soon = hours <= WITHIN_H + 0.01
    return (
        [(said[i], margin[i]) for i in places],
        (float(said[soon].max()), float(np.any(margin[soon] < 0.0))),
    )


def _newest_humidity(case: Tracked, now_s: float) -> float:
    series = case.record["cabinet_relative_humidity"]
    there = np.flatnonzero((series.time <= now_s) & ~series.missing)
    return float(series.value[there[-1]])


FEWEST = 50
"""Forecasts below which a share is not shown."""
EDGES = tuple(f"{100 * a:.0f}–{100 * b:.0f} %" for a, b in pairwise(BINS))


def table(lines: Sequence[Mapping]) -> str:
    """Condensation said and come, by surface and lead time, and at any time."""
    cases = Columns(lines, "rows", COLUMNS)
    c, came = cases.columns, cases.columns["margin_true"] < 0.0

    def cells(here: np.ndarray) -> tuple[str, ...]:
        return _cells(c["said"][here], came[here], cases.seed[here])

    kinds = ", ".join(f"{sum(line['kind'] == kind for line in lines)} {kind}" for kind in KINDS)
    parts = [f"{len(lines)} plants ({kinds})."]
    surfaces = (*enumerate(f"{s.follows:g} / {s.offset_K:+g} K" for s in SURFACES), (None, "all"))
    for number, name in enumerate(SCENARIOS):
        rows = []
        for place, words in surfaces:
            for lead in (*LEADS_H, None):
                here = (c["scenarios"] == number) & (place is None or c["surface"] == place)
                here &= lead is None or c["lead_h"] == lead
                rows.append((words, "all" if lead is None else f"{lead:.0f} h", *cells(here)))
        parts += [f"Scenarios: {name}.", markdown(("surface", "lead", "n", "said", "came", *EDGES), rows)]
    parts += [
        f"Highest probability of any instant within {WITHIN_H:.0f} h → condensation at any time of them:",
        markdown(("scenarios", "n", "highest said", "came", *EDGES), _windows(lines)),
    ]
    return "\n\n".join(parts)


def _cells(said: np.ndarray, came: np.ndarray, seed: np.ndarray) -> tuple[str, ...]:
    if not len(said):
        return ("0", *("–",) * (2 + len(EDGES)))
    bins, cells = reliability(said, came, seed, BINS), []
    for edge in BINS[:-1]:
        if edge not in bins or bins[edge].rate.n < FEWEST:
            cells.append(f"n = {bins[edge].rate.n if edge in bins else 0}")
            continue
        one = bins[edge]
        bounds = f"({100 * one.low:.1f}–{100 * one.high:.1f})"
        cells.append(f"{100 * one.said:.1f} → {100 * one.rate.share:.1f} {bounds}, {one.rate.n:,}")
    least, most = between_plants(came, seed)
    whole = f"{100 * came.mean():.2f} % ({100 * least:.2f}–{100 * most:.2f})"
    return (f"{len(said):,}", f"{100 * said.mean():.2f} %", whole, *cells)


def _windows(lines: Sequence[Mapping]) -> Iterator[tuple]:
    """The highest probability of an instant against condensation at any time."""
    cases = Columns(lines, "windows", WINDOW_COLUMNS)
    c = cases.columns
    for number, name in enumerate(SCENARIOS):
        here = c["scenarios"] == number
        yield name, *_cells(c["highest"][here], c["came"][here] > 0.5, cases.seed[here])


CLAIM = Claim("saturation", {"saturation": range(7000, 7102)}, one, table)
