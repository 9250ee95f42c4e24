"""Condensation said for surfaces of several kinds against what came, also where it is rare: near
saturation."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise

import numpy as np
from battery.rates import Rate
from plants import plant

from hygrokf.data.readings import SATURATED
from hygrokf.live.condition import Condition, air_condition, inputs_of, only
from hygrokf.live.forecast import moments_by_member
from hygrokf.live.scenarios import HORIZON_S, NoScenarios, Scenarios
from trials.cabinets import DAY_S, Surface, Tracked, tracked, truth
from trials.forecast import between_plants

LEARNT_DAYS = 45.0
"""Days that a model is identified on."""
SETTLED_S = 2 * DAY_S
"""[s] of tracking before the first forecast."""
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
COLUMNS = ("scenarios", "surface", "lead_h", "ceiling", "said", "rank", "margin_true")
WINDOW_COLUMNS = ("scenarios", "surface", "highest", "came")
SCENARIOS = tuple(EVERY_S)


def one(seed: int, days: float = 60.0, learnt: float = LEARNT_DAYS) -> dict:
    """Forecasts of a plant over some days after those that its model was identified on, and the truth.

    A row is a forecast, a surface, a lead time: whether the newest reading of humidity was at the ceiling,
    the probability that was said, the rank of the true margin in what was said of it, the margin.  A window
    is a forecast and a surface: the highest probability within `WITHIN_H`, and whether there was condensation
    at any instant of them.
    """
    made = plant(
        seed, days=learnt + days, operation="turbine", weather="fronts", preheating=True, **cabinet(seed)
    )
    begin = float(made.drivers.time[0]) + learnt * DAY_S
    case = tracked(made, begin)
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
        "seed": seed,
        "kind": KINDS[seed % len(KINDS)],
        "rows": np.round(rows, 4).tolist(),
        "windows": np.round(windows, 4).tolist(),
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
    return Scenarios(begin, time, (member,), "what came")


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
        yield place, [only(one, kept) for one in found]


def _compared(case: Tracked, found: Sequence[Condition], surface: Surface) -> tuple[list[tuple], tuple]:
    """(said, rank, true margin) at the lead times, and (highest said, whether it came) within `WITHIN_H`."""
    from scipy.special import ndtr

    hours = (found[0].time_s - found[0].time_s[0]) / 3600.0
    margin = truth(case.made, found[0].time_s, surface).margin_K
    said = np.mean([c.condensation for c in found], axis=0)
    rank = np.mean([ndtr((margin - c.margin_K.value) / c.margin_K.sd) for c in found], axis=0)
    places = [int(np.argmin(np.abs(hours - lead))) for lead in LEADS_H]
    soon = hours <= WITHIN_H + 0.01
    return (
        [(said[i], rank[i], margin[i]) for i in places],
        (float(said[soon].max()), float(np.any(margin[soon] < 0.0))),
    )


def _newest_humidity(case: Tracked, now_s: float) -> float:
    series = case.record["cabinet_relative_humidity"]
    there = np.flatnonzero((series.time <= now_s) & ~series.missing)
    return float(series.value[there[-1]])


class Cases:
    """The columns (n,) of rows or windows, with the seed and the kind of plant of each."""

    def __init__(self, lines: Sequence[Mapping], part: str, columns: Sequence[str]) -> None:
        counts = [len(line[part]) for line in lines]
        table = np.concatenate([np.array(line[part]).reshape(-1, len(columns)) for line in lines])
        self.columns = dict(zip(columns, table.T, strict=True))
        self.seed = np.repeat([line["seed"] for line in lines], counts)
        self.kind = np.repeat([line["kind"] for line in lines], counts)


def reliability(
    said: np.ndarray, came: np.ndarray, seed: np.ndarray
) -> list[tuple[float, float, Rate, float, float]]:
    """(lower edge, mean of what was said, what came, its bounds over plants) of each bin of the stated
    probability."""
    found = []
    for low, high in pairwise(BINS):
        here = (said >= low) & ((said < high) | (high == BINS[-1]))
        if here.any():
            rate = Rate(int(came[here].sum()), int(here.sum()))
            found.append((low, float(said[here].mean()), rate, *between_plants(came[here], seed[here])))
    return found


FEWEST = 50
"""Forecasts below which a share is not shown."""


def table(lines: Sequence[Mapping]) -> str:
    """Tables of condensation; docs/validation/live_trials.md sums them up."""
    cases = Cases(lines, "rows", COLUMNS)
    c = cases.columns
    came = c["margin_true"] < 0.0
    kinds = ", ".join(f"{sum(line['kind'] == kind for line in lines)} {kind}" for kind in KINDS)
    out = [f"{len(lines)} plants ({kinds})."]
    edges = [f"{100 * a:.0f}–{100 * b:.0f} %" for a, b in pairwise(BINS)]
    for number, name in enumerate(SCENARIOS):
        out += ["", f"Scenarios: {name}.", "",
            "| surface | lead | n | said | came | " + " | ".join(edges) + " |",
            "|" + " --- |" * (5 + len(edges))]  # fmt: skip
        own = c["scenarios"] == number
        for place, words in (*enumerate(map(_words, SURFACES)), (None, "all")):
            for lead in (*LEADS_H, None):
                here = own & (place is None or c["surface"] == place) & (lead is None or c["lead_h"] == lead)
                leads = "all" if lead is None else f"{lead:.0f} h"
                out.append(f"| {words} | {leads} | " + _cells(c["said"][here], came[here], cases.seed[here],
                    edges))  # fmt: skip
    out += [
        "",
        "By the newest reading of humidity, surface 0.3 / 0 K and 0.6 / 0 K, known scenarios, up to 6 h:",
        "",
    ]
    out += [
        "| newest reading | n | said | came | " + " | ".join(edges) + " |",
        "|" + " --- |" * (4 + len(edges)),
    ]
    near = (c["scenarios"] == 0) & np.isin(c["surface"], (1, 3)) & (c["lead_h"] <= 6.0)
    for flag, words in ((0.0, "below the ceiling"), (1.0, "at the ceiling")):
        here = near & (c["ceiling"] == flag)
        out.append(f"| {words} | " + _cells(c["said"][here], came[here], cases.seed[here], edges))
    out += ["", *_rank_rows(cases), "", *_window_rows(lines, edges)]
    return "\n".join(out)


def _words(surface: Surface) -> str:
    return f"{surface.follows:g} / {surface.offset_K:+g} K"


def _cells(said: np.ndarray, came: np.ndarray, seed: np.ndarray, edges: Sequence[str]) -> str:
    if not len(said):
        return "0 | – | – |" + " – |" * len(edges)
    rows = {low: rest for low, *rest in reliability(said, came, seed)}
    cells = []
    for low in BINS[:-1]:
        if low not in rows or rows[low][1].n < FEWEST:
            cells.append(f"n = {rows[low][1].n if low in rows else 0}")
            continue
        mean, rate, least, most = rows[low]
        cells.append(
            f"{100 * mean:.1f} → {100 * rate.share:.1f} ({100 * least:.1f}–{100 * most:.1f}), {rate.n:,}"
        )
    least, most = between_plants(came, seed)
    whole = f"{100 * said.mean():.2f} % | {100 * came.mean():.2f} % ({100 * least:.2f}–{100 * most:.2f})"
    return f"{len(said):,} | {whole} | " + " | ".join(cells) + " |"


def _rank_rows(cases: Cases) -> list[str]:
    """How the true margin's rank in what was said is spread where condensation is possible: uniform it would
    be 2.5 and 5 %."""
    c = cases.columns
    near = (c["said"] > 0.02) & (c["said"] < 0.98)
    out = [
        "Rank of the true margin where 2 to 98 % were said (of a right probability: 5, 50, 5 %):",
        "",
        "| scenarios | lead | n | below 5 % | below 50 % | above 95 % |",
        "|" + " --- |" * 6,
    ]
    for number, name in enumerate(SCENARIOS):
        for lead in LEADS_H:
            rank = c["rank"][near & (c["scenarios"] == number) & (c["lead_h"] == lead)]
            if len(rank) >= FEWEST:
                shares = (100 * np.mean(rank < 0.05), 100 * np.mean(rank < 0.5), 100 * np.mean(rank > 0.95))
                out.append(
                    f"| {name} | {lead:.0f} h | {len(rank):,} | "
                    + " | ".join(f"{s:.1f} %" for s in shares)
                    + " |"
                )
    return out


def _window_rows(lines: Sequence[Mapping], edges: Sequence[str]) -> list[str]:
    """The highest probability of an instant against condensation at any time."""
    cases = Cases(lines, "windows", WINDOW_COLUMNS)
    c = cases.columns
    out = [
        f"Highest probability of any instant within {WITHIN_H:.0f} h → condensation at any time of them:",
        "",
        "| scenarios | n | highest said | came | " + " | ".join(edges) + " |",
        "|" + " --- |" * (4 + len(edges)),
    ]
    for number, name in enumerate(SCENARIOS):
        here = c["scenarios"] == number
        out.append(
            f"| {name} | " + _cells(c["highest"][here], c["came"][here] > 0.5, cases.seed[here], edges)
        )
    return out
