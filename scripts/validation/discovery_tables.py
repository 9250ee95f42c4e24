"""The table of `discover`: from lines of results to counts beside what is aimed at; coefficients of the
confidence.

A case that failed counts as one without an answer: it is in every denominator and never right.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from scipy.optimize import minimize

from hygrokf.discovery import discovery_results
from validation.counts import Rate, markdown, rate
from validation.frame import Line
from validation.records import GIVEN, KNOWN, WITHHELD

NULLS = ("nulls", "sensor_nulls", "fluctuating_nulls", "burst_nulls", "apart_burst_nulls")
"""Groups of plants that hide nothing."""
EMPTY: Line = {
    "failure": None, "hidden": (), "verdict": None, "names": (), "refuted": (), "lines": (), "last_fifth": {},
    "simulations": None, "cpu_s": 0.0,
}  # fmt: skip
"""What is found in a case that failed."""


# -- one line ------------------------------------------------------------------------------------------------
def truths(line: Line) -> list[str]:
    """Causes that were asked for."""
    return [cause for cause, _ in line["asked"]]


def names(line: Line) -> list[Mapping]:
    """Names whose class is short enough to be told."""
    return [one for one in line["names"] if 1 + len(one["rivals"]) <= discovery_results.CLASS_LIMIT]


def first_right(line: Line, in_class: bool = False) -> bool:
    """Whether what is told first is the cause that was asked for, or has it in its class."""
    if not line["names"] or line["names"][0] not in names(line):
        return False
    first, (truth, *_) = line["names"][0], truths(line)
    return first["cause"] == truth or (in_class and truth in first["rivals"])


def both_named(line: Line) -> bool:
    return set(truths(line)) <= {one["cause"] for one in names(line)}


def any_right(line: Line) -> bool:
    """Whether one of the causes that were asked for is named, or in the class of a name."""
    true = set(truths(line))
    return any(true & {one["cause"], *one["rivals"]} for one in names(line))


def false_names(line: Line) -> list[Mapping]:
    """Names that are not asked for and whose class holds no cause that would else go unnamed."""
    unnamed = set(truths(line)) - {one["cause"] for one in names(line)}
    return [
        one for one in names(line)
        if one["cause"] not in truths(line) and not unnamed & set(one["rivals"])
    ]  # fmt: skip


def known_named(line: Line) -> bool:
    """Whether what is known of a measured record is named, or in the class of a name."""
    return any(set(line["known"]["right"]) & {one["cause"], *one["rivals"]} for one in names(line))


def wrongly_named(line: Line) -> bool:
    """Whether a name is one that may not come in a measured record."""
    return any(one["cause"] in line["known"]["wrong"] for one in names(line))


def silent(line: Line) -> bool:
    """Whether no name was given."""
    return not line["failure"] and not line["names"]


def unnamed(line: Line) -> bool:
    """Whether no name was given, or none that explains the record: the verdict says so."""
    return silent(line) or line["verdict"] == "unexplained"


# -- the table -----------------------------------------------------------------------------------------------
def table(lines: Iterable[Line]) -> str:
    """The figures of the last line of each case, what is wrong case by case, and the coefficients."""
    kept = [{**EMPTY, **line} for line in {line["key"]: line for line in lines}.values()]
    by: dict[str, list[Line]] = {}
    for line in kept:
        by.setdefault(line["group"], []).append(line)
    makers = (_causes, _companions, _without, _confidence, _measured, _costs)
    text = [markdown(("what", "found", "aim"), (row for make in makers for row in make(by)))]
    wrong = [(line["key"], _answer(line), _remark(line)) for line in kept if _remark(line)]
    text += [markdown(("case", "told", ""), wrong)] if wrong else []
    told = told_names(kept)
    return "\n\n".join([*text, *([calibrated(told)] if len(told) >= FEWEST else [])])


Row = tuple[str, object, str]
Groups = Mapping[str, Sequence[Line]]


def _causes(by: Groups) -> Iterable[Row]:
    for group, first, in_class in (("causes", "≥ 55 of 60", "≥ 58"), ("half", "≥ 46 of 60", "≥ 50")):
        if some := by.get(group):
            yield f"{group}: first by name", rate(first_right(line) for line in some), first
            yield f"{group}: or in a class", rate(first_right(line, True) for line in some), in_class
    if some := by.get("pairs"):
        yield "pairs: both named", rate(both_named(line) for line in some), "≥ 16 of 18"


def _companions(by: Groups) -> Iterable[Row]:
    some = [line for group in ("causes", "pairs") for line in by.get(group, ()) if any_right(line)]
    if not some:
        return
    told = sum(len(names(line)) for line in some)
    false = [one for line in some for one in false_names(line)]
    yield "false names beside right ones", Rate(len(false), told), "≤ 8 %"
    unexplained = rate(line["verdict"] == "unexplained" for line in some)
    yield "unexplained beside a right name", unexplained, "≤ 3 of 60"


def _without(by: Groups) -> Iterable[Row]:
    if some := by.get("nulls"):
        yield "nulls: none", rate(silent(o) and o["verdict"] == "none" for o in some), "≥ 58 of 60"
    if some := by.get("sensor_nulls"):
        yield "sensor_nulls: none", rate(silent(o) and o["verdict"] == "none" for o in some), "≥ 18 of 20"
    for group in ("fluctuating_nulls", "burst_nulls", "apart_burst_nulls"):
        if some := by.get(group):
            yield f"{group}: no name, or unexplained", rate(unnamed(o) for o in some), "≥ 18 of 20"
    if some := by.get("outside"):
        yield "outside: none or unexplained", rate(unnamed(line) for line in some), "≥ 15 of 16"


def _confidence(by: Groups) -> Iterable[Row]:
    some = by.get("confidence", ())
    told = [(one["confidence"], one["cause"] in truths(line)) for line in some for one in names(line)]
    for number, (difference, count) in enumerate(thirds(told), 1):
        yield f"confidence, third {number}: stated − observed", f"{difference:+.3f} of {count}", "≤ 0.07"


def thirds(told: Sequence[tuple[float, bool]]) -> list[tuple[float, int]]:
    """Stated confidence less the share that was right, and the number of names, in thirds by what was
    stated."""
    parts = np.array_split(np.array(sorted(told), dtype=float).reshape(-1, 2), 3)
    return [(float(part[:, 0].mean() - part[:, 1].mean()), len(part)) for part in parts if len(part)]


def _measured(by: Groups) -> Iterable[Row]:
    for row, aim in ((KNOWN, "≥ 7 of 9"), (WITHHELD, "≥ 4 of 8")):
        if some := [line for line in by.get("measured", ()) if line["known"]["row"] == row]:
            yield f"measured, {row}: named or in a class", rate(known_named(line) for line in some), aim
    if some := [line for line in by.get("measured", ()) if line["known"]["row"] == GIVEN]:
        yield f"measured, {GIVEN}: a name of their kind", rate(wrongly_named(line) for line in some), "0"
    ran = [line for line in by.get("measured", ()) if not line["failure"]]
    if pairs := [pair for line in ran for pair in line["last_fifth"].values()]:
        ratio = np.array([after / before for before, after in pairs])
        yield "last fifth, cut off before: worse by more than 2 %", rate(ratio > 1.02), "≤ 5 %"
        yield "last fifth: worse by more than 10 %", rate(ratio > 1.1), "0"
        yield "last fifth: geometric mean after/before", f"{np.exp(np.log(ratio).mean()):.2f}", "≤ 0.6"
    if ran:
        yield "measured: names a record, median", f"{np.median([len(names(o)) for o in ran]):.3g}", "≤ 3"


def _costs(by: Groups) -> Iterable[Row]:
    plants = [line for group, some in by.items() if group != "measured" for line in some]
    for label, some, limits in (
        ("plants", plants, ("≤ 10, 25 s", "≤ 7,500")),
        ("measured", by.get("measured", ()), ("≤ 40 s", "≤ 15,000")),
    ):
        ran = [line for line in some if not line["failure"]]
        kinds = ("cpu_s", "s CPU"), ("simulations", "simulations")
        for (key, unit), limit in zip(kinds, limits, strict=True):
            if ran:
                values = [line[key] for line in ran]
                told = f"{np.median(values):,.4g}, {max(values):,.4g} {unit}"
                yield f"{label}: {unit}, median and most", told, limit
    failed = [line for some in by.values() for line in some]
    yield "failures", rate(bool(line["failure"]) for line in failed), "0"


def _answer(line: Line) -> str:
    if line["failure"]:
        return line["failure"][:100]
    told = [
        f"{one['cause']}/{one['form']} ({one['evidence']:.0f}, {one['evidence_in_days']:.0f}; "
        + f"{one['worth']:+.0%})"
        + (f" or {', '.join(one['rivals'])}" if one["rivals"] else "")
        for one in line["names"]
    ]
    left = [f"a line at {hours:.4g} h in the {quantity}" for quantity, hours, *_ in line["lines"]]
    return ", ".join([*told, *left]) or line["verdict"]


def _remark(line: Line) -> str:
    """What is wrong with an answer; empty where nothing is."""
    if line["failure"]:
        return "failure"
    if line["group"] == "measured":
        return "told"
    if line["group"] == "outside" or not line["asked"]:
        return "" if unnamed(line) else "a name"
    reached = ", ".join(f"{one['reached']:.2f}" for one in line["hidden"])
    right = both_named(line) if len(line["asked"]) > 1 else first_right(line)
    if right and not false_names(line):
        return ""
    refuted = [one["reason"] for one in line["refuted"] if one["cause"] in truths(line)]
    more = f"; refuted: {', '.join(refuted)}" if refuted else ""
    return f"{'false companion' if right else 'missed'}, reached {reached}{more}"


# -- the confidence ------------------------------------------------------------------------------------------
FEWEST = 30
WIDEST = 10.0
"""Standard deviation of a coefficient's prior: where no name was wrong, the likelihood alone has no
maximum."""


def told_names(lines: Iterable[Line]) -> list[tuple[float, float, bool]]:
    """(evidence in days, lead, whether right) of the names that calibrate the confidence: those of all groups
    of simulated plants but `confidence`, which holds plants as they may come, and tests it."""
    return [
        (one["evidence_in_days"], one["lead"], one["cause"] in truths(line))
        for line in lines
        if line["group"] not in ("confidence", "measured") and not line["failure"]
        for one in names(line)
    ]


def calibrated(told: Sequence[tuple[float, float, bool]]) -> str:
    """The coefficients `discovery.discover.CONFIDENCE_WEIGHTS` by maximum likelihood, and how they state what
    was observed.

    P(right) = 1/(1 + exp(−(a + b ln(evidence in days) + c lead))), of every name that was told.  Raises
    ValueError for fewer than 30 names.
    """
    if len(told) < FEWEST:
        raise ValueError(f"expected at least {FEWEST} names to calibrate by, found {len(told)}")
    in_days, lead, right = np.array(told, dtype=float).T
    x = np.column_stack([np.ones(len(told)), np.log(np.maximum(in_days, 1.0)), lead])
    scale = np.array([1.0, 1.0, max(float(np.std(lead)), 1.0)])

    def loss(b: np.ndarray) -> tuple[float, np.ndarray]:
        z = (x / scale) @ b
        chance = 1.0 / (1.0 + np.exp(-z))
        value = float(np.sum(np.logaddexp(0.0, z) - right * z) + 0.5 * b @ b / WIDEST**2)
        return value, (x / scale).T @ (chance - right) + b / WIDEST**2

    b = minimize(loss, np.zeros(3), jac=True).x / scale
    stated = 1.0 / (1.0 + np.exp(-(x @ b)))
    numbers = ", ".join(f"{one:.3g}" for one in b)
    text = [f"CONFIDENCE_WEIGHTS = ({numbers})  # {len(told)} names, {right.mean():.0%} right"]
    for number, (difference, count) in enumerate(thirds(list(zip(stated, right, strict=True))), 1):
        text.append(f"third {number}: stated − observed {difference:+.3f} of {count}")
    return "\n".join(text)
