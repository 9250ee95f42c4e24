"""Tables of the results: one of plants, one of measured boxes, one of totals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rivals.cases import BOX, PLANT
from rivals.ground import HUMIDITY, TEMPERATURE
from rivals.methods import METHODS, NETWORK

Line = Mapping
UNITS = {TEMPERATURE: "K", HUMIDITY: "g/m³"}


def _errors(values: Mapping | None) -> str:
    """Held-out errors, temperature / humidity."""
    if not values:
        return "–"
    return " / ".join("diverged" if value is None else f"{value:.2f}" for value in values.values())


def _names(line: Line) -> str:
    """The first name and the number of further ones, with what that is worth."""
    if line["failure"]:
        return "failed"
    first, *further = line["names"] or ["none"]
    more = f" + {len(further)}" if further else ""
    worth = {"wrong": " ✗", "right": " ✓", "in class": " (✓)", "later": " ✗, right later"}.get(
        line["outcome"], ""
    )
    return f"{first}{more}{worth}"


def _cell(line: Line | None) -> str:
    if line is None:
        return "–"
    if line["failure"]:
        return "failed"
    name = "" if line["method"] == NETWORK else f"{_names(line)}; "
    return f"{name}{_errors(line['after'])}; {line['cpu_s']:.0f} s"


def _table(lines: Sequence[Line], kind: str, title: str) -> str:
    some = [line for line in lines if line["kind"] == kind]
    rows = []
    for case in dict.fromkeys(line["case"] for line in some):
        of = {line["method"]: line for line in some if line["case"] == case}
        any_line = next(iter(of.values()))
        name = any_line["name"] if any_line["seed"] is None else f"{any_line['name']} ({any_line['seed']})"
        cells = [_cell(of.get(method)) for method in METHODS]
        rows.append((name, _errors(any_line["before"]), *cells))
    head = ("record", "base", *METHODS)
    return "\n".join([f"## {title}", "", _row(head), "|" + " --- |" * len(head), *map(_row, rows)])


def _row(cells: Sequence[object]) -> str:
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


def _mean_gain(lines: Sequence[Line], quantity: str) -> str:
    """Median over records of the share of the held-out error that is gone; a run that diverged counts as the
    least."""
    shares = []
    for line in lines:
        before = (line["before"] or {}).get(quantity)
        if before and not line["failure"]:
            after = line["after"].get(quantity)
            shares.append(float("-inf") if after is None else 1.0 - after / before)
    if not shares:
        return "–"
    shares.sort()
    middle = 0.5 * (shares[(len(shares) - 1) // 2] + shares[len(shares) // 2])
    worse = sum(share < -0.02 for share in shares)
    return f"{100 * middle:.0f} % (worse in {worse} of {len(shares)})"


def _totals(lines: Sequence[Line]) -> str:
    """Right, wrong and false names on plants; median gains; CPU."""
    rows = []
    for method in METHODS:
        plants = [line for line in lines if line["method"] == method and line["kind"] == PLANT]
        if not plants:
            continue
        hidden = [line for line in plants if line["right"]]
        nothing = [line for line in plants if not line["right"]]
        good = sum(line["outcome"] in ("right", "in class") for line in hidden)
        silent = sum(line["outcome"] == "none" for line in hidden)
        others = sum(len(set(line.get("names", ())) - set(line["right"])) for line in plants)
        false = sum(bool(line.get("names")) for line in nothing)
        names = (f"{good} of {len(hidden)}", silent, f"{false} of {len(nothing)}", others)
        gains = [_mean_gain(hidden, quantity) for quantity in UNITS]
        cpu = sorted(line["cpu_s"] for line in plants if not line["failure"])
        shown = ("–",) * 4 if method == NETWORK else names
        rows.append((method, *shown, *gains, f"{cpu[len(cpu) // 2]:.1f} s"))
    head = (
        "method", "right first", "no name", "nothing hidden, yet named",
        "names that are not right, all plants",
        "median gain, temperature", "median gain, humidity", "median CPU",
    )  # fmt: skip
    return "\n".join(
        ["## Totals of the plants", "", _row(head), "|" + " --- |" * len(head), *map(_row, rows)]
    )


def tables(lines: Sequence[Line]) -> str:
    """All tables as text.  Cells: name; held-out error of temperature [K] / humidity [g/m³]; CPU time."""
    return "\n\n".join(
        [
            _totals(lines),
            _table(lines, PLANT, "Simulated plants"),
            _table(lines, BOX, "Measured boxes"),
        ]
    )
