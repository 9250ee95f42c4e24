"""Tables of the battery: from lines of results to shares with their n and bounds.

Each table is a pure function of the lines.  A case that failed counts wherever a case of its kind is counted.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from battery.lines import (
    FAILURE,
    FULL,
    FULL_FROM,
    HALF,
    HALF_FROM,
    LEAST_GAIN,
    WEAKER,
    Line,
    answer,
    both_named,
    excused,
    first_right,
    gain_share,
    hidden_by_cause,
    last_of_each,
    names,
    of,
    reached,
    strength_class,
    truths,
)
from battery.rates import Rate, clopper_pearson, quantile, rate, weighted_share
from battery.required import requirements

STRENGTH_BINS = (0.0, 0.2, 0.4, 0.6, 0.85, 1.15, math.inf)
CONFIDENCE_BINS = (0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 1.0)
PRIOR_NULL = 0.5
"""Stated prior of the calibration: half of the plants hide nothing, the others one cause, each as often as
the others."""


@dataclass(frozen=True)
class Table:
    """A head, rows of cells (text, number, `Rate`, `WeightedShare`, None), and what a reader must know."""

    name: str
    title: str
    head: tuple[str, ...]
    rows: tuple[tuple, ...]
    notes: tuple[str, ...] = field(default=())

    def markdown(self) -> str:
        lines = [f"## {self.title}", ""]
        lines += [f"{note}\n" for note in self.notes]
        if not self.rows:
            return "\n".join([*lines, "No case."])
        lines += ["| " + " | ".join(self.head) + " |", "|" + " --- |" * len(self.head)]
        lines += ["| " + " | ".join(shown(cell) for cell in row) + " |" for row in self.rows]
        return "\n".join(lines)

    def to_json(self) -> dict:
        rows = [{name: _json(cell) for name, cell in zip(self.head, row, strict=True)} for row in self.rows]
        return {"title": self.title, "notes": list(self.notes), "rows": rows}


def shown(cell: object) -> str:
    if cell is None:
        return "–"
    if isinstance(cell, float):
        return f"{cell:.3g}"
    return str(cell)


def _json(cell: object) -> object:
    return cell.to_json() if hasattr(cell, "to_json") else cell


# -- tables --------------------------------------------------------------------------------------------------
def named_first(lines: Sequence[Line]) -> Table:
    """How often the cause is named first, by cause, form and strength."""
    head = ["cause"]
    for one in (FULL, HALF, WEAKER):
        head += [f"{one}: named first", f"{one}: or in its class"]

    def row(label: str, some: Sequence[Line]) -> tuple:
        cells: list[object] = [label]
        for one in (FULL, HALF, WEAKER):
            these = [line for line in some if strength_class(line) == one]
            cells += [rate(first_right(line, classes) for line in these) for classes in (False, True)]
        return tuple(cells)

    rows = []
    for cause, some in hidden_by_cause(lines).items():
        rows.append(row(cause, some))
        forms = sorted({line["asked"][0][1] for line in some})
        if len(forms) > 1:
            rows += [row(f"– form {f}", [line for line in some if line["asked"][0][1] == f]) for f in forms]
    everything = of(lines, "hidden")
    if everything:
        rows.append(row("all", everything))
    notes = (
        f"Strength as reached: full from {FULL_FROM:g} on, half from {HALF_FROM:g} on, weaker where a "
        "cause's ranges do not lead there. 95 % bounds by Clopper and Pearson.",
    )
    return Table("named_first", "Named first", tuple(head), tuple(rows), notes)


def confusion(lines: Sequence[Line], strength: str) -> Table:
    """Which name was given first to which cause."""
    rows_of = {
        c: [line for line in some if strength_class(line) == strength]
        for c, some in hidden_by_cause(lines).items()
    }
    if strength == FULL:
        if of(lines, "none"):
            rows_of["(nothing)"] = of(lines, "none")
        for line in of(lines, "outside"):
            rows_of.setdefault(f"({truths(line)[0]})", []).append(line)
    rows_of = {name: some for name, some in rows_of.items() if some}
    given = Counter(answer(line) for some in rows_of.values() for line in some)
    ends = [word for word in ("none", "unexplained", FAILURE) if word in given]
    columns = [*sorted(set(given) - set(ends)), *ends]
    rows = []
    for name, some in rows_of.items():
        seen = Counter(answer(line) for line in some)
        rows.append((name, len(some), *(seen.get(column, 0) or "" for column in columns)))
    title = f"Confusion, {strength} strength"
    notes = ("Rows: what is hidden. Columns: the name given first, or the verdict without a name.",)
    return Table(f"confusion_{strength}", title, ("hidden", "n", *columns), tuple(rows), notes)


def detection(lines: Sequence[Line]) -> Table:
    """Detection against the strength that was reached."""
    rows = []
    some = of(lines, "hidden")
    for low, high in pairwise(STRENGTH_BINS):
        these = [line for line in some if low <= reached(line) < high]
        if these:
            label = f"{low:g} … {high:g}" if math.isfinite(high) else f"from {low:g} on"
            rows.append(
                (
                    label,
                    len(these),
                    rate(answer(line) not in ("none", FAILURE) for line in these),
                    rate(bool(names(line)) for line in these),
                    rate(first_right(line, False) for line in these),
                    rate(first_right(line) for line in these),
                )
            )
    head = ("strength", "n", "something seen", "something named", "named first", "or in its class")
    return Table("detection", "Detection against strength", head, tuple(rows))


def false_alarms(lines: Sequence[Line]) -> Table:
    """What is said of plants that hide nothing."""
    return _alarms(of(lines, "none"), "false_alarms", "Plants that hide nothing")


def other_make(lines: Sequence[Line]) -> Table:
    """What is said of cabinets that hide nothing and that no network of resistances describes."""
    return _alarms(of(lines, "convection"), "other_make", "Cabinets of another make that hide nothing")


def _alarms(some: Sequence[Line], name: str, title: str) -> Table:
    rows: list[tuple] = []
    if some:
        rows.append(("a cause named", rate(bool(names(line)) for line in some)))
        rows.append(("unexplained", rate(answer(line) == "unexplained" for line in some)))
        rows.append(("nothing (right)", rate(answer(line) == "none" for line in some)))
        rows.append(("failure", rate(answer(line) == FAILURE for line in some)))
        for word, count in Counter(answer(line) for line in some if names(line)).most_common():
            rows.append((f"– {word}", Rate(count, len(some))))
    return Table(name, title, ("verdict", "share"), tuple(rows))


def pairs(lines: Sequence[Line]) -> Table:
    """Two causes at once."""
    by: dict[str, list[Line]] = {}
    for line in of(lines, "pair"):
        by.setdefault(" + ".join(truths(line)), []).append(line)

    def row(label: str, some: Sequence[Line]) -> tuple:
        return (
            label,
            len(some),
            rate(both_named(line, False) for line in some),
            rate(both_named(line) for line in some),
            rate(bool(set(truths(line)) & names(line)) for line in some),
            rate(bool(names(line, False) - excused(line)) for line in some),
        )

    rows = [row(name, some) for name, some in sorted(by.items())]
    if rows:
        rows.append(row("all", of(lines, "pair")))
    head = ("hidden", "n", "both named", "or in their classes", "at least one", "a wrong name too")
    return Table("pairs", "Two causes at once", head, tuple(rows))


def outside(lines: Sequence[Line]) -> Table:
    """Effects that no library holds."""
    by: dict[tuple[str, str], list[Line]] = {}
    for line in of(lines, "outside"):
        by.setdefault((truths(line)[0], strength_class(line)), []).append(line)

    def row(effect: str, strength: str, some: Sequence[Line]) -> tuple:
        wrong = Counter(name for line in some for name in names(line, False)).most_common(3)
        return (
            effect,
            strength,
            rate(answer(line) == "unexplained" for line in some),
            rate(bool(names(line)) for line in some),
            rate(answer(line) == "none" for line in some),
            rate(answer(line) == FAILURE for line in some),
            ", ".join(f"{name} {count}" for name, count in wrong) or None,
        )

    rows = [row(*key, some) for key, some in sorted(by.items())]
    if rows:
        rows.append(row("all", "", of(lines, "outside")))
    head = (
        "effect",
        "strength",
        "unexplained (right)",
        "a wrong name",
        "none",
        "failure",
        "most frequent names",
    )
    return Table("outside", "Effects outside of the library", head, tuple(rows))


def gains(lines: Sequence[Line]) -> Table:
    """Share of the attainable gain, on what followed the identification period."""

    def row(label: str, some: Sequence[Line]) -> tuple:
        shares = [share for line in some if (share := gain_share(line)) is not None]
        whole = [share for line in some if (share := gain_share(line, "attainable")) is not None]
        right = [s for line in some if first_right(line) and (s := gain_share(line)) is not None]
        unmeasured = sum(
            not line["failure"] and line["truth"][0].get("achieved") is None for line in some if line["truth"]
        )
        quarters = [quantile(shares, share) for share in (0.5, 0.25, 0.75)]
        last = (len(right), quantile(right, 0.5), len(whole), quantile(whole, 0.5), unmeasured)
        return (label, len(shares), *quarters, *last)

    rows = [row(cause, some) for cause, some in hidden_by_cause(lines).items()]
    if rows:
        everything = of(lines, "hidden")
        rows += [
            row(f"all, {one} strength", [line for line in everything if strength_class(line) == one])
            for one in (FULL, HALF, WEAKER)
        ]
        rows.append(row("all", everything))
    head = (
        "cause", "n", "median", "lower quartile", "upper quartile", "n right", "median where right",
        "n (whole record)", "median against the whole record's", "not measured",
    )  # fmt: skip
    periods = sorted({str(one.get("achieved_by")) for line in of(lines, "hidden") for one in line["truth"]})
    notes = (
        f"Plants of which the true mechanism with true parameters takes at least {100 * LEAST_GAIN:.0f} % of "
        "the error, on the stretch on which the gain was measured. What was not named has gained nothing, "
        f"what failed neither. Read from: {'; '.join(periods) or 'nothing'}.",
    )
    return Table("gains", "Share of the attainable gain", head, tuple(rows), notes)


def prior_weights(lines: Sequence[Line]) -> list[tuple[Line, float]]:
    """Lines of plants with no or one cause of the library, weighted as the stated prior has them."""
    nothing, by = of(lines, "none"), hidden_by_cause(lines)
    found = [(line, PRIOR_NULL / len(nothing)) for line in nothing]
    for some in by.values():
        found += [(line, (1.0 - PRIOR_NULL) / len(by) / len(some)) for line in some]
    return found


def calibration(lines: Sequence[Line]) -> Table:
    """Confidence of the first name against the share that is right, under the stated prior."""
    told = [(line, w, line["causes"][0]["confidence"]) for line, w in prior_weights(lines) if names(line)]
    rows = []
    for low, high in pairwise(CONFIDENCE_BINS):
        these = [
            (line, w, c)
            for line, w, c in told
            if low <= c < high or (high == CONFIDENCE_BINS[-1] and c == high)
        ]
        if these:
            rows.append((f"{low:g} … {high:g}", *_reliability(these)))
    if told:
        rows.append(("all", *_reliability(told)))
    head = (
        "confidence",
        "n",
        "mean confidence",
        "share right",
        "right or in its class",
        "names given to nothing",
    )
    strict, wide = (shown(calibration_error(told, classes)) for classes in (False, True))
    notes = (
        f"Prior: {100 * PRIOR_NULL:.0f} % of the plants hide nothing, the others one cause of the library, "
        "each as often as the others, half of them at half strength; cases are weighted to it.",
        f"Expected calibration error: {strict} for the name itself, {wide} for the name or one of its class.",
    )
    return Table("calibration", "Calibration of confidence", head, tuple(rows), notes)


def _reliability(told: Sequence[tuple[Line, float, float]]) -> tuple:
    weights = [w for _, w, _ in told]
    mean = sum(w * c for _, w, c in told) / sum(weights)
    strict = weighted_share([_right(line, False) for line, _, _ in told], weights)
    wide = weighted_share([_right(line, True) for line, _, _ in told], weights)
    return len(told), mean, strict, wide, sum(line["group"] == "none" for line, _, _ in told)


def _right(line: Line, classes: bool) -> bool:
    return line["group"] != "none" and first_right(line, classes)


def calibration_error(told: Sequence[tuple[Line, float, float]], classes: bool) -> float | None:
    """Distance between mean confidence and share right over the bins, by weight, of (line, weight,
    confidence)."""
    total = sum(w for _, w, _ in told)
    if not total:
        return None
    error = 0.0
    for low, high in pairwise(CONFIDENCE_BINS):
        these = [
            one for one in told if low <= one[2] < high or (high == CONFIDENCE_BINS[-1] and one[2] == high)
        ]
        error += abs(sum(w * (c - _right(line, classes)) for line, w, c in these)) / total
    return error


def paper(lines: Sequence[Line]) -> Table:
    """The paper's case and what only looks like it."""
    by: dict[str, list[Line]] = {}
    for line in of(lines, "paper"):
        label = f"decoy: {line['decoy']}" if line["decoy"] else f"sorption, form {line['asked'][0][1]}"
        by.setdefault(label, []).append(line)
    rows = [
        (
            label,
            len(some),
            rate("moisture_sorption" in names(line, False) for line in some),
            rate("moisture_sorption" in names(line) for line in some),
            rate(first_right(line) for line in some),
            ", ".join(
                f"{name} {count}" for name, count in Counter(answer(line) for line in some).most_common()
            ),
        )
        for label, some in sorted(by.items())
    ]
    head = ("case", "n", "called sorption", "or in a class", "truth first or in its class", "answers")
    notes = ("Decoys are not sorption: to call them so is wrong.",)
    return Table("paper", "The paper's case", head, tuple(rows), notes if rows else ())


def parameters(lines: Sequence[Line]) -> Table:
    """How often true values lie inside the reported bounds, where the plant's form has the library's
    parameter."""
    seen: dict[tuple[str, str], list[tuple[float, float, bool]]] = {}
    for line in of(lines, "hidden", "paper"):
        if line["failure"]:
            continue
        for account in line["truth"]:
            for one in line["causes"]:
                if one["cause"] != account["cause"]:
                    continue
                for name, value in account.get("comparable", {}).items():
                    found = one["parameters"].get(name)
                    if found is None or found["value"] is None:
                        continue
                    low, high = found.get("lower"), found.get("upper")
                    inside = (
                        "lower" in found and (low is None or low <= value) and (high is None or value <= high)
                    )
                    place = (account["cause"] + (" (paper)" if line["group"] == "paper" else ""), name)
                    seen.setdefault(place, []).append((value, found["value"], inside))
    rows = []
    for (cause, name), triples in sorted(seen.items()):
        ratios = [estimate / value for value, estimate, _ in triples if value]
        middle, low, high = (quantile(ratios, share) for share in (0.5, 0.1, 0.9))
        rows.append((cause, name, rate(inside for _, _, inside in triples), middle, low, high))
    head = ("cause", "parameter", "truth inside the bounds", "median estimate / truth", "10 %", "90 %")
    return Table("parameters", "Parameters of named causes", head, tuple(rows))


def measured_records(lines: Sequence[Line]) -> Table:
    """Measured records as they are, and with a known effect put in."""
    untouched = {line["record"]: line for line in of(lines, "measured")}
    rows = []
    order = {"measured": 0, "injected": 1}
    for line in sorted(
        of(lines, "measured", "injected"), key=lambda o: (o["record"], order[o["group"]], o["key"])
    ):
        before = names(untouched[line["record"]], False) if line["record"] in untouched else None
        hit: object = None
        if line["group"] == "injected":
            truth = truths(line)[0]
            given = names(line, False)
            hit = (
                FAILURE
                if line["failure"]
                else "first"
                if first_right(line, False)
                else "in the first one's class"
                if first_right(line)
                else "later"
                if truth in given
                else "in a later one's class"
                if truth in names(line)
                else "no"
            )
            if before is not None and truth in before and truth in given:
                hit = f"{hit}, as without it"
        rows.append(
            (
                line["record"],
                line["effect"] or "measured, untouched",
                _size(line),
                line["verdict"] if not line["failure"] else FAILURE,
                _causes(line),
                hit,
            )
        )
    skipped = sorted({line["skipped"] for line in lines if line["skipped"]})
    notes = tuple(f"Left out: {reason}." for reason in skipped)
    head = ("record", "put in", "size", "verdict", "causes in order (confidence, class)", "found")
    return Table("measured", "Measured records", head, tuple(rows), notes)


def injections(lines: Sequence[Line]) -> Table:
    """How often what was put into measured records is found, by effect."""
    untouched = {line["record"]: names(line, False) for line in of(lines, "measured")}
    by: dict[str, list[Line]] = {}
    for line in of(lines, "injected"):
        by.setdefault(line["effect"], []).append(line)

    def row(label: str, some: Sequence[Line]) -> tuple:
        new = [line for line in some if truths(line)[0] not in untouched.get(line["record"], set())]
        return (
            label,
            rate(first_right(line, False) for line in some),
            rate(first_right(line) for line in some),
            rate(truths(line)[0] in names(line) for line in some),
            rate(truths(line)[0] in names(line) for line in new),
        )

    rows = [row(effect, some) for effect, some in by.items()]
    if rows:
        rows.append(row("all", of(lines, "injected")))
    head = (
        "put in",
        "named first",
        "or in its class",
        "anywhere",
        "anywhere, where it was not named without it",
    )
    return Table("injections", "Effects put into measured records", head, tuple(rows))


def _size(line: Line) -> str | None:
    if not line["truth"]:
        return None
    account = line["truth"][0]
    given = ", ".join(
        f"{name} {value:.3g}" for name, value in account["parameters"].items() if not name.startswith("date")
    )
    heat, damp = account["added_temperature_K"], account["added_absolute_humidity_g_m3"]
    return f"{given}; readings change by {heat:.2g} K, {damp:.2g} g/m³"


def _causes(line: Line) -> str | None:
    if line["failure"]:
        return line["failure"]["type"]
    told = []
    for one in line["causes"]:
        rest = f", or {', '.join(one['ambiguous_with'])}" if one["ambiguous_with"] else ""
        told.append(f"{one['cause']} ({one['confidence']:.2f}{rest})")
    return ", ".join(told) or None


def costs(lines: Sequence[Line]) -> Table:
    """CPU time."""

    def row(label: str, some: Sequence[Line]) -> tuple:
        seconds = [line["cpu_s"] for line in some]
        making = [line["making_s"] for line in some]
        hours = (sum(seconds) + sum(making)) / 3600.0
        return (
            label,
            len(some),
            *(quantile(seconds, share) for share in (0.5, 0.95)),
            max(seconds),
            quantile(making, 0.5),
            hours,
        )

    by: dict[str, list[Line]] = {}
    for line in lines:
        if not line["skipped"]:
            by.setdefault(line["group"], []).append(line)
    rows = [row(group, some) for group, some in by.items()]
    if rows:
        rows.append(row("all", [line for some in by.values() for line in some]))
    head = (
        "group",
        "n",
        "median [s]",
        "95 % [s]",
        "longest [s]",
        "making the record [s]",
        "CPU hours, all of it",
    )
    return Table("costs", "CPU time", head, tuple(rows))


def failures(lines: Sequence[Line]) -> Table:
    """Cases that raised."""
    rows = [
        (
            line["key"],
            line["failure"]["type"],
            line["failure"]["message"].splitlines()[0][:120] if line["failure"]["message"] else None,
        )
        for line in lines
        if line["failure"]
    ]
    ran = [line for line in lines if not line["skipped"]]
    notes = (f"{rate(bool(line['failure']) for line in ran)} of the cases.",)
    return Table("failures", "Failures", ("case", "error", "message"), tuple(rows), notes)


def required(lines: Sequence[Line]) -> Table:
    rows = []
    for one in requirements(lines):
        sign = "≤" if one.at_most else "≥"
        met = {None: None, True: "yes", False: "no"}[one.met]
        bounds = None
        if one.reached is not None and not one.name.startswith("median"):
            low, high = clopper_pearson(round(one.reached * one.n), one.n)
            bounds = f"{low:.3f} … {high:.3f}"
        rows.append((one.name, one.n, f"{sign} {one.wanted:g}", one.reached, bounds, met))
    head = ("figure", "n", "required", "reached", "95 % bounds", "met")
    return Table("required", "What is required", head, tuple(rows))


TABLES: tuple[Callable[[Sequence[Line]], Table], ...] = (
    required,
    named_first,
    lambda lines: confusion(lines, FULL),
    lambda lines: confusion(lines, HALF),
    detection,
    false_alarms,
    other_make,
    pairs,
    outside,
    gains,
    calibration,
    paper,
    parameters,
    injections,
    measured_records,
    costs,
    failures,
)


def all_tables(lines: Iterable[Line]) -> list[Table]:
    """Every table of the last line of each case."""
    kept = last_of_each(lines)
    return [make(kept) for make in TABLES]
