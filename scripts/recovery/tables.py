"""Sums over the lines of a row, and the table of docs/validation/coverage.md."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean, median, pstdev, stdev

VERDICTS = ("believe", "caution", "reject")


@dataclass(frozen=True)
class Sums:
    """One quantity over the plants of a row; errors and half widths are logarithms.

    profile: plants whose plain profile bound holds the truth, None where fits report none. verdicts: plants
    by verdict. misses, told: plants whose headline interval misses the truth, and those of them whose verdict
    is not "believe". free_run_error, free_run_spread: mean and root mean square error of the output-error
    estimate.
    """

    plants: int
    error: float
    spread: float
    half_width: float
    covered: int
    profile: int | None
    verdicts: Mapping[str, int]
    misses: int
    told: int
    free_run_error: float | None
    free_run_spread: float | None


def half_width(interval: Mapping) -> float:
    """Half the width of an interval in the logarithm; ∞ where it is open."""
    lower, upper = interval["lower"], interval["upper"]
    return math.inf if not lower or upper is None else 0.5 * math.log(upper / lower)


def sums(found: Sequence[Mapping]) -> Sums:
    """Of the quantities `found`, one a plant."""
    errors = [math.log(one["value"] / one["truth"]) for one in found]
    free = [math.log(one["simulation"] / one["truth"]) for one in found if one["simulation"]]
    missed = [one for one in found if not one["covered"]]
    plain = [one["profile"] for one in found]
    return Sums(
        plants=len(found),
        error=fmean(errors),
        spread=stdev(errors) if len(errors) > 1 else 0.0,
        half_width=median(map(half_width, found)),
        covered=len(found) - len(missed),
        profile=None if None in plain else sum(one["covered"] for one in plain),
        verdicts=Counter(one["verdict"] for one in found if one["verdict"] is not None),
        misses=len(missed),
        told=sum(one["verdict"] not in (None, "believe") for one in missed),
        free_run_error=fmean(free) if free else None,
        free_run_spread=math.hypot(fmean(free), pstdev(free)) if free else None,
    )


def by_row(lines: Sequence[Mapping]) -> dict[str, list[Mapping]]:
    """Lines by row, in the order in which rows occur."""
    found: dict[str, list[Mapping]] = {}
    for line in lines:
        found.setdefault(line["row"], []).append(line)
    return found


HEAD = (
    "row", "plants", "quantity", "mean error", "spread", "half width, median", "covered",
    "by the profile bound",
    "believe / caution / reject", "misses told", "free run", "CPU", "wall",
)  # fmt: skip


def table(lines: Sequence[Mapping]) -> str:
    """The Markdown table: one line a row and quantity, then what failed."""
    texts = ["| " + " | ".join(HEAD) + " |", "|" + " --- |" * len(HEAD)]
    failures = []
    for row, every in by_row(lines).items():
        failures += [f"{row}, seed {line['seed']}: {line['failure']}" for line in every if line["failure"]]
        good = [line for line in every if not line["failure"]]
        if not good:
            continue
        for name in good[0]["quantities"]:
            s = sums([line["quantities"][name] for line in good])
            cells = [
                row,
                str(len(every)),
                name,
                f"{100 * math.expm1(s.error):+.1f} %",
                f"{100 * s.spread:.1f} %",
                "open" if math.isinf(s.half_width) else f"±{100 * s.half_width:.1f} %",
                f"{s.covered}/{s.plants}",
                "–" if s.profile is None else f"{s.profile}/{s.plants}",
                " / ".join(str(s.verdicts.get(v, 0)) for v in VERDICTS) if s.verdicts else "–",
                f"{s.told}/{s.misses}" if s.verdicts else "–",
                "–"
                if s.free_run_error is None
                else f"{100 * math.expm1(s.free_run_error):+.0f} ± {100 * s.free_run_spread:.0f} %",
                f"{median(line['cpu_s'] for line in good):.1f} s",
                f"{median(line['wall_s'] for line in good):.1f} s",
            ]
            texts.append("| " + " | ".join(cells) + " |")
    return "\n".join([*texts, *(["", *failures] if failures else [])])


def free_runs(lines: Sequence[Mapping]) -> str:
    """Mean error of the free run of each row: [K] and [g/m³]."""
    texts = []
    for row, every in by_row(lines).items():
        good = [line["free_run"] for line in every if not line["failure"]]
        if good:
            kelvin = fmean(one["temperature_K"] for one in good)
            humidity = fmean(one["absolute_humidity_g_m3"] for one in good)
            texts.append(f"{row}: free-run errors {kelvin:.2f} K, {humidity:.3f} g/m³ in the mean")
    return "\n".join(texts)
