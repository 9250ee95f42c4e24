"""Forecasts over some weeks against what came: how often probabilities come true, how often bands hold the
truth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from battery.rates import Rate
from plants import plant

from hygrokf.live.condition import probability_above, probability_below
from hygrokf.live.forecast import conditions_by_member, mixture
from hygrokf.live.scenarios import HORIZON_S, NoScenarios
from trials.cabinets import DAY_S, SURFACE, tracked, truth

LEARNT_DAYS = 60.0
"""Days that a model is identified on."""
EVERY_S = 12 * 3600.0
"""[s] within which one forecast is made, at a random full hour."""
LEADS_H = (1.0, 3.0, 6.0, 12.0, 18.0, 24.0, 36.0, 48.0)
LIMITS = (0.5, 0.6, 0.7, 0.8)
MARGIN_K = 2.0
"""[K] margin of the cold surface that counts as close to condensation."""
COLUMNS = (
    "lead_h", "kelvin", "kelvin_sd", "kelvin_true", "humidity", "humidity_sd", "humidity_true",
    *(f"above_{100 * limit:.0f}" for limit in LIMITS), "close", "condensation", "margin_true",
)  # fmt: skip
EVENTS = {
    **{f"RH > {100 * limit:.0f} %": f"above_{100 * limit:.0f}" for limit in LIMITS},
    f"margin < {MARGIN_K:.0f} K": "close",
    "condensation": "condensation",
}
"""What a probability is given of, and the column that it stands in."""
GROUPS_H = ((0.0, 3.0), (3.0, 12.0), (12.0, 24.0), (24.0, 48.0))
"""Lead times (after, up to) [h] that are judged together."""
DECILES = tuple(i / 10 for i in range(10))


def one(seed: int, days: float = 60.0, learnt: float = LEARNT_DAYS) -> dict:
    """Forecasts of a plant over some days after those that its model was identified on, and the truth."""
    made = plant(seed, days=learnt + days, operation="turbine", weather="fronts", preheating=True)
    begin = float(made.drivers.time[0]) + learnt * DAY_S
    case = tracked(made, begin)
    random = np.random.default_rng([seed, 41])
    rows, silent = [], 0
    for after in np.arange(0.0, days * DAY_S - HORIZON_S - EVERY_S, EVERY_S):
        now = begin + after + 3600.0 * random.integers(0, int(EVERY_S // 3600))
        try:
            scenarios = case.scenarios(now)
        except NoScenarios:
            silent += 1
            continue
        rows += _rows(case, case.point(now), scenarios)
    return {
        "seed": seed,
        "days": days,
        "silent": silent,
        "columns": COLUMNS,
        "rows": np.round(rows, 5).tolist(),
    }


def _rows(case, point, scenarios) -> list[np.ndarray]:
    found = conditions_by_member(case.plan, point, scenarios, SURFACE)
    mixed = mixture(found)
    seen = truth(case.made, mixed.time_s)
    chances = [
        np.mean([probability_above(c.relative_humidity, limit) for c in found], axis=0) for limit in LIMITS
    ]
    chances.append(np.mean([probability_below(c.margin_K, MARGIN_K) for c in found], axis=0))
    table = np.column_stack(
        [
            (mixed.time_s - point.time) / 3600.0,
            mixed.temperature_K.value, mixed.temperature_K.sd, seen.kelvin,
            mixed.relative_humidity.value, mixed.relative_humidity.sd, seen.humidity,
            *chances, mixed.condensation, seen.margin_K,
        ]
    )  # fmt: skip
    return [table[np.argmin(np.abs(table[:, 0] - lead))] for lead in LEADS_H]


class Forecasts:
    """The columns (n,) of all rows, and the seed of each."""

    def __init__(self, lines: Sequence[Mapping]) -> None:
        table = np.concatenate([np.array(line["rows"]) for line in lines])
        self.columns = dict(zip(COLUMNS, table.T, strict=True))
        self.seed = np.repeat([line["seed"] for line in lines], [len(line["rows"]) for line in lines])

    def happened(self, column: str) -> np.ndarray:
        """Whether the event of a column came true (n,)."""
        c = self.columns
        if column == "close":
            return c["margin_true"] < MARGIN_K
        if column == "condensation":
            return c["margin_true"] < 0.0
        return c["humidity_true"] > float(column.removeprefix("above_")) / 100.0

    def within(self, low_h: float, high_h: float) -> np.ndarray:
        """Rows (n,) of these lead times."""
        lead = self.columns["lead_h"]
        return (lead > low_h) & (lead <= high_h + 0.1)


def reliability(said: np.ndarray, happened: np.ndarray, seed: np.ndarray) -> list[dict]:
    """By decile of the stated probability: how often it was said, what was said on average, what came.

    Bounds (95 %): `rate` as if every forecast were a trial of its own, `low` and `high` with whole plants
    drawn again, which keeps neighbouring forecasts together.
    """
    found = []
    for low in DECILES:
        here = (said >= low) & (said < low + 0.1 if low < 0.9 else said <= 1.0)
        if not here.any():
            continue
        least, most = between_plants(happened[here], seed[here])
        found.append(
            {
                "from": low,
                "said": float(said[here].mean()),
                "rate": Rate(int(happened[here].sum()), int(here.sum())),
                "low": least,
                "high": most,
            }
        )
    return found


def between_plants(happened: np.ndarray, seed: np.ndarray, draws: int = 2000) -> tuple[float, float]:
    """95 % bounds of a share with whole plants drawn again, which keeps neighbouring forecasts together."""
    plants = np.unique(seed)
    hits = np.array([happened[seed == p].sum() for p in plants])
    counts = np.array([(seed == p).sum() for p in plants])
    chosen = np.random.default_rng(1).integers(0, len(plants), (draws, len(plants)))
    shares = hits[chosen].sum(axis=1) / counts[chosen].sum(axis=1)
    low, high = np.quantile(shares, (0.025, 0.975))
    return float(low), float(high)


def brier(said: np.ndarray, happened: np.ndarray, seed: np.ndarray) -> tuple[float, float]:
    """Mean squared error of a probability, and that of each plant's own base rate over the same forecasts."""
    base = np.empty(len(said))
    for plant_seed in np.unique(seed):
        base[seed == plant_seed] = happened[seed == plant_seed].mean()
    return float(np.mean((said - happened) ** 2)), float(np.mean((base - happened) ** 2))


def coverage(f: Forecasts, quantity: str, rows: np.ndarray) -> dict:
    """How often the 95 % band held the truth, and mean and root mean square of the error."""
    value, sd, seen = (f.columns[quantity + end][rows] for end in ("", "_sd", "_true"))
    error = value - seen
    held = np.abs(error) < 1.959964 * sd
    low, high = between_plants(held, f.seed[rows])
    return {
        "rate": Rate(int(held.sum()), len(held)),
        "low": low,
        "high": high,
        "bias": float(error.mean()),
        "rms": float(np.sqrt(np.mean(error**2))),
    }


def table(lines: Sequence[Mapping]) -> str:
    """Tables of the forecasts; docs/validation/live_trials.md sums them up."""
    f = Forecasts(lines)
    count = len(f.seed) // len(LEADS_H)
    out = [
        f"{len(lines)} plants, {count} forecasts, lead times {', '.join(f'{h:.0f}' for h in LEADS_H)} h.",
        "",
        "| event | base rate | Brier score | of the base rate | skill |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name, column in EVENTS.items():
        happened = f.happened(column)
        score, base = brier(f.columns[column], happened, f.seed)
        skill = f"{1.0 - score / base:.2f}" if base > 0 else "–"
        out.append(f"| {name} | {100 * happened.mean():.1f} % | {score:.4f} | {base:.4f} | {skill} |")
    out += ["", *_reliability_rows(f)]
    out += ["", *_lead_rows(f), "", *_coverage_rows(f)]
    return "\n".join(out)


def _reliability_rows(f: Forecasts) -> list[str]:
    """A row a decile: mean of what was stated, what came true with its binomial bounds, and how many, all in
    percent."""
    shown = {name: column for name, column in EVENTS.items() if column != "condensation"}
    rows = {
        name: {r["from"]: r for r in reliability(f.columns[c], f.happened(c), f.seed)}
        for name, c in shown.items()
    }
    out = ["| stated | " + " | ".join(shown) + " |", "| --- |" + " --- |" * len(shown)]
    for low in DECILES:
        cells = []
        for name in shown:
            r = rows[name].get(low)
            if r is None:
                cells.append("–")
                continue
            least, most = r["rate"].bounds
            share = 100 * r["rate"].share
            cells.append(
                f"{100 * r['said']:.0f} → {share:.0f} ({100 * least:.0f}–{100 * most:.0f}), {r['rate'].n:,}"
            )
        out.append(f"| {100 * low:.0f}–{100 * low + 10:.0f} % | " + " | ".join(cells) + " |")
    return out


def _lead_rows(f: Forecasts) -> list[str]:
    """Mean of what was said against what came where it was said with 20 to 80 %, by lead time."""
    out = [
        "| event | " + " | ".join(f"{low:.0f}–{high:.0f} h" for low, high in GROUPS_H) + " |",
        "| --- |" + " --- |" * len(GROUPS_H),
    ]
    for name, column in EVENTS.items():
        cells = []
        for low_h, high_h in GROUPS_H:
            said = f.columns[column]
            rows = f.within(low_h, high_h) & (said > 0.2) & (said < 0.8)
            if rows.sum() < 20:
                cells.append(f"n = {rows.sum()}")
                continue
            happened = f.happened(column)[rows]
            low, high = between_plants(happened, f.seed[rows])
            cells.append(
                f"{100 * said[rows].mean():.0f} % said, {100 * happened.mean():.0f} % came "
                f"({100 * low:.0f}–{100 * high:.0f}), n = {rows.sum()}"
            )
        out.append(f"| {name} | " + " | ".join(cells) + " |")
    return out


def _coverage_rows(f: Forecasts) -> list[str]:
    out = [
        "| lead time | n | temperature: held | bias | r.m.s. | humidity: held | bias | r.m.s. |",
        "|" + " --- |" * 8,
    ]
    for lead in LEADS_H:
        rows = f.within(lead - 0.5, lead + 0.4)
        cells = [f"{lead:.0f} h", str(int(rows.sum()))]
        for quantity, unit, factor in (("kelvin", "K", 1.0), ("humidity", "%", 100.0)):
            c = coverage(f, quantity, rows)
            cells += [
                f"{100 * c['rate'].share:.1f} % ({100 * c['low']:.0f}–{100 * c['high']:.0f})",
                f"{factor * c['bias']:+.1f} {unit}",
                f"{factor * c['rms']:.1f} {unit}",
            ]
        out.append("| " + " | ".join(cells) + " |")
    return out
