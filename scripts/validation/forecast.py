"""Forecasts over some weeks against what came: how often probabilities come true, how often bands hold the
truth: docs/validation/live_trials.md."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hygrokf.live.condition import probability_above, probability_below
from hygrokf.live.forecast import conditions_by_member, mixture
from hygrokf.live.scenarios import HORIZON_S, NoScenarios
from validation.counts import Columns, Rate, between_plants, markdown, reliability
from validation.frame import ROOT, Claim
from validation.tracked import DAY_S, SURFACE, tracked_plant, truth

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
DECILES = tuple(i / 10 for i in range(11))
FEWEST = 20
"""Forecasts below which a share is not shown."""


def one(variant: str, seed: int, *, days: float = 60.0, learnt: float = 60.0) -> dict:
    """Forecasts of a plant over some days after those that its model was identified on, and the truth."""
    case, begin = tracked_plant(seed, learnt, days)
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
        "days": days,
        "silent": silent,
        "columns": COLUMNS,
        "rows": np.round(rows, 5),
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


class Forecasts(Columns):
    """All rows of forecasts."""

    def __init__(self, lines: Sequence[Mapping]) -> None:
        super().__init__(lines, "rows", COLUMNS)

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
    """Scores of the probabilities, what came of each decile and lead time, and how often bands held."""
    f = Forecasts(lines)
    leads = ", ".join(f"{h:.0f}" for h in LEADS_H)
    scores = []
    for name, column in EVENTS.items():
        happened = f.happened(column)
        score, base = brier(f.columns[column], happened, f.seed)
        skill = f"{1.0 - score / base:.2f}" if base > 0 else "–"
        scores.append((name, f"{100 * happened.mean():.1f} %", f"{score:.4f}", f"{base:.4f}", skill))
    head = ("event", "base rate", "Brier score", "of the base rate", "skill")
    return "\n\n".join(
        [
            f"{len(lines)} plants, {len(f.seed) // len(LEADS_H)} forecasts, lead times {leads} h.",
            markdown(head, scores),
            _by_decile(f),
            _by_lead(f),
            _coverages(f),
        ]
    )


def _by_decile(f: Forecasts) -> str:
    """A row a decile: mean of what was stated, what came true with its binomial bounds, and how many, all in
    percent."""
    shown = {name: column for name, column in EVENTS.items() if column != "condensation"}
    bins = [reliability(f.columns[c], f.happened(c), f.seed, DECILES) for c in shown.values()]

    def cell(of: Mapping, edge: float) -> str:
        if edge not in of:
            return "–"
        seen = of[edge].rate
        least, most = seen.bounds
        return (
            f"{100 * of[edge].said:.0f} → {100 * seen.share:.0f} ({100 * least:.0f}–{100 * most:.0f}), "
            f"{seen.n:,}"
        )

    rows = [
        (f"{100 * edge:.0f}–{100 * edge + 10:.0f} %", *(cell(of, edge) for of in bins))
        for edge in DECILES[:-1]
    ]
    return markdown(("stated", *shown), rows)


def _by_lead(f: Forecasts) -> str:
    """Mean of what was said against what came where it was said with 20 to 80 %, by lead time."""

    def cell(column: str, low_h: float, high_h: float) -> str:
        said = f.columns[column]
        rows = f.within(low_h, high_h) & (said > 0.2) & (said < 0.8)
        if rows.sum() < FEWEST:
            return f"n = {rows.sum()}"
        happened = f.happened(column)[rows]
        low, high = between_plants(happened, f.seed[rows])
        return (
            f"{100 * said[rows].mean():.0f} % said, {100 * happened.mean():.0f} % came "
            f"({100 * low:.0f}–{100 * high:.0f}), n = {rows.sum()}"
        )

    head = ("event", *(f"{low:.0f}–{high:.0f} h" for low, high in GROUPS_H))
    return markdown(head, [(name, *(cell(c, *hours) for hours in GROUPS_H)) for name, c in EVENTS.items()])


def _coverages(f: Forecasts) -> str:
    rows = []
    for lead in LEADS_H:
        here = f.within(lead - 0.5, lead + 0.4)
        cells = [f"{lead:.0f} h", int(here.sum())]
        for quantity, unit, factor in (("kelvin", "K", 1.0), ("humidity", "%", 100.0)):
            c = coverage(f, quantity, here)
            cells += [
                f"{100 * c['rate'].share:.1f} % ({100 * c['low']:.0f}–{100 * c['high']:.0f})",
                f"{factor * c['bias']:+.1f} {unit}",
                f"{factor * c['rms']:.1f} {unit}",
            ]
        rows.append(cells)
    held = ("held", "bias", "r.m.s.")
    return markdown(
        ("lead time", "n", *(f"{q}: {x}" for q in ("temperature", "humidity") for x in held)), rows
    )


SHOWN = ("RH > 50 %", "RH > 60 %", "RH > 70 %", "RH > 80 %")


def reliability_png(f: Forecasts) -> bytes:
    """The reliability diagram as PNG: a panel an event, with the numbers of forecasts below."""
    from hygrokf.report.figures.drawing import INK, MEASURED, QUIET, new_figure, png, styled

    with styled():
        figure = new_figure(3.1)
        figure.subplots_adjust(left=0.085, right=0.98, top=0.92, bottom=0.15, wspace=0.16, hspace=0.1)
        panels = figure.subplots(2, len(SHOWN), sharex=True, sharey="row", height_ratios=(3.0, 1.0))
        for name, top, below in zip(SHOWN, *panels, strict=True):
            column = EVENTS[name]
            bins = reliability(f.columns[column], f.happened(column), f.seed, DECILES).values()
            below.bar(
                [one.edge + 0.05 for one in bins], [one.rate.n for one in bins], width=0.08, color=QUIET
            )
            bins = [one for one in bins if one.rate.n >= FEWEST]
            said, came = [one.said for one in bins], [one.rate.share for one in bins]
            beyond = [[one.rate.share - one.low for one in bins], [one.high - one.rate.share for one in bins]]
            top.plot([0, 1], [0, 1], color=INK, linewidth=0.6)
            top.errorbar(said, came, yerr=beyond, color=MEASURED, marker="o", markersize=3.2,
                         linestyle="none", elinewidth=1.0)  # fmt: skip
            top.set(title=name, xlim=(0, 1), ylim=(0, 1))
            top.set_yticks((0, 0.25, 0.5, 0.75, 1), ("0", "25", "50", "75", "100"))
            below.set_yscale("log")
            below.set_yticks((1, 100, 10000), ("1", "100", "10 000"))
            below.minorticks_off()
            below.set_ylim(1, 3e4)
            below.set_xticks((0, 0.5, 1), ("0", "50", "100"))
        panels[0, 0].set_ylabel("came true [%]")
        panels[1, 0].set_ylabel("number")
        figure.supxlabel("stated probability [%]", x=0.53, y=0.01, fontsize=7.5)
        figure.align_ylabels(panels[:, 0])
        return png(figure, dpi=170)


def docs(lines: Sequence[Mapping]) -> None:
    """The diagram of docs/validation/live_trials.md."""
    (ROOT / "docs" / "pictures" / "reliability.png").write_bytes(reliability_png(Forecasts(lines)))


CLAIM = Claim("forecast", {"forecast": range(100, 120)}, one, table, docs=docs)
