"""How often `hygrokf transfer` is right on pairs of simulated cabinets, and how often a type holds its next
turbine: docs/validation/coverage.md."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from builders.transfer_pairs import KINDS, pair, record_of
from plants.plant import plant

from hygrokf.identification.identify import identify
from hygrokf.identification.turbine_type import pool_types
from hygrokf.transfer.transfer_fit import transfer_fit
from validation.counts import markdown
from validation.frame import Claim, by_variant

TURBINES, TYPE_DAYS, NEXT_DAYS = 5, 30.0, 8.0
SPREADS = {"thermal_time_constant": 0.12, "hygric_k": 0.2, "heat": 0.08}
"""sd of the logarithms from turbine to turbine in the trials of types."""
FACTORS = {"power 1.2": 1.2, "power 1.1": 1.1}
"""Variant -> the factor, or its inverse, by which pairs differ in one group, another one every seed."""


def one(variant: str, seed: int) -> dict:
    """The verdict on a pair, or what a type says of its next turbine."""
    if variant == "types":
        return {"parameters": _type(seed)}
    if variant in FACTORS:
        return _judged(pair(seed, KINDS[1 + seed % 3], factor=FACTORS[variant]))
    return _judged(pair(seed, disturbance="power-law" if variant == "coloured pairs" else "ou"))


def _judged(made) -> dict:
    found = transfer_fit(identify(made.first, starts=1, profiles=False), made.second, fits=False).results
    word, names = made.right
    return {
        "differ": list(made.differ),
        "verdict": found.statement.text,
        "re_estimate": list(found.re_estimate),
        # in their own order on both sides
        "right": str(found.verdict) == word and sorted(found.re_estimate) == sorted(names),
    }


def _type(seed: int) -> dict:
    """What a few turbines as prior do to the fit of the next one."""
    random = np.random.default_rng([seed, 13])
    middle = plant(40_000 + 10 * seed, days=2.0).cabinet
    fits, truths = [], []
    for k in range(TURBINES + 1):
        thermal, hygric, heat = (float(np.exp(sd * random.standard_normal())) for sd in SPREADS.values())
        cabinet = replace(
            middle,
            heat_capacity=middle.heat_capacity * thermal,
            gap=middle.gap / hygric,
            operation_W=tuple(heat * part for part in middle.operation_W),
            standstill_W=tuple(heat * part for part in middle.standstill_W),
        )
        days = TYPE_DAYS if k < TURBINES else NEXT_DAYS
        record = replace(record_of(40_000 + 10 * seed + k, cabinet, days, 0.0, "ou"), until_s=None)
        truths.append({"thermal_time_constant": cabinet.thermal_h, "hygric_k": cabinet.hygric_constant_h})
        fits.append(identify(record, starts=1, profiles=False))
    *fits, alone = fits
    made = pool_types(fits)
    helped = identify(record, starts=1, profiles=False, prior=made.prior)
    rows = {}
    for name, true in truths[-1].items():
        bounds = helped.to_json()["parameters"][name]
        rows[name] = {
            "alone": abs(float(np.log(alone.values[name] / true))),
            "helped": abs(float(np.log(helped.values[name] / true))),
            "bounds_held": bool(bounds["lower"] <= true <= (bounds["upper"] or np.inf)),
        }
    return rows


def table(lines: Sequence[Mapping]) -> str:
    """The tables of the variants that there are."""
    return "\n\n".join(
        f"{variant}\n\n{(_types if variant == 'types' else _pairs)(some)}"
        for variant, some in by_variant(lines).items()
    )


def _pairs(lines: Sequence[Mapping]) -> str:
    """Right verdicts by what differs; a difference that is not named at all is missed."""
    rows = []
    for differ in sorted({tuple(line["differ"]) for line in lines}, key=lambda groups: (len(groups), groups)):
        part = [line for line in lines if tuple(line["differ"]) == differ]
        missed = sum(not line["re_estimate"] for line in part) if differ else "–"
        rows.append((", ".join(differ) or "nothing", *_counted(part), missed, _otherwise(part)))
    rows.append(("**all**", *_counted(lines), "", ""))
    return markdown(("the pair differs in", "pairs", "right", "missed", "otherwise"), rows)


def _counted(lines: Sequence[Mapping]) -> tuple[int, int]:
    return len(lines), sum(line["right"] for line in lines)


def _otherwise(lines: Sequence[Mapping]) -> str:
    wrong = Counter(line["verdict"] for line in lines if not line["right"])
    return "; ".join(f"{n}: {verdict}" for verdict, n in wrong.items()) or "–"


def _types(lines: Sequence[Mapping]) -> str:
    """Bounds of the next turbine, and its errors with and without the prior."""
    rows = []
    for name in lines[0]["parameters"]:
        part = [line["parameters"][name] for line in lines]
        errors = (100 * np.sqrt(np.mean([row[key] ** 2 for row in part])) for key in ("alone", "helped"))
        held = sum(row["bounds_held"] for row in part)
        rows.append((f"`{name}`", len(part), held, *(f"{error:.0f} %" for error in errors)))
    head = ("parameter", "types", "bounds with the prior hold", "error alone", "with it")
    return markdown(head, rows)


CLAIM = Claim(
    "transfer",
    {
        "pairs": range(100, 180),
        "coloured pairs": range(400, 424),
        "power 1.2": range(510, 534),
        "power 1.1": range(510, 534),
        "types": range(100, 123),
    },
    one,
    table,
)
