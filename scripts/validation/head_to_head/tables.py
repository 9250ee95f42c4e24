"""Tables of the results: one of totals, one of plants, one of measured boxes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from validation.counts import markdown
from validation.frame import Line
from validation.head_to_head.ground import HUMIDITY, TEMPERATURE

OWN, SPARSE, FORWARD, NETWORK = "discover", "pysindy", "likelihood ratio", "network"
METHODS = (OWN, SPARSE, FORWARD, NETWORK)
PLANT, BOX = "plant", "box"
WORTH = {"wrong": " ✗", "right": " ✓", "in class": " (✓)", "later": " ✗, right later"}


def tables(lines: Sequence[Line]) -> str:
    """All tables as text.  Cells: name; held-out error of temperature [K] / humidity [g/m³]; CPU time."""
    parts = {
        "Totals of the plants": _totals([line for line in lines if line["kind"] == PLANT]),
        "Simulated plants": _table([line for line in lines if line["kind"] == PLANT]),
        "Measured boxes": _table([line for line in lines if line["kind"] == BOX]),
    }
    return "\n\n".join(f"## {title}\n\n{text}" for title, text in parts.items())


def _table(lines: Sequence[Line]) -> str:
    rows = []
    for name in dict.fromkeys(line["name"] for line in lines):
        of = {line["method"]: line for line in lines if line["name"] == name}
        before = next(iter(of.values()))["before"]
        rows.append((name, _errors(before), *(_cell(of.get(method)) for method in METHODS)))
    return markdown(("record", "base", *METHODS), rows)


def _cell(line: Line | None) -> str:
    """The first name and the number of further ones, with what that is worth; errors; CPU time."""
    if line is None:
        return "–"
    first, *further = line["names"] or ["none"]
    more = f" + {len(further)}" if further else ""
    name = "" if line["method"] == NETWORK else f"{first}{more}{WORTH.get(line['outcome'], '')}; "
    return f"{name}{_errors(line['after'])}; {line['cpu_s']:.0f} s"


def _errors(values: Mapping | None) -> str:
    """Held-out errors, temperature / humidity."""
    if not values:
        return "–"
    return " / ".join("diverged" if value is None else f"{value:.2f}" for value in values.values())


def _totals(plants: Sequence[Line]) -> str:
    """Right, wrong and false names on plants; median gains; CPU."""
    rows = []
    for method in METHODS:
        some = [line for line in plants if line["method"] == method]
        if not some:
            continue
        hidden = [line for line in some if line["right"]]
        nothing = [line for line in some if not line["right"]]
        good = sum(line["outcome"] in ("right", "in class") for line in hidden)
        silent = sum(line["outcome"] == "none" for line in hidden)
        others = sum(len(set(line["names"]) - set(line["right"])) for line in some)
        false = sum(bool(line["names"]) for line in nothing)
        names = (f"{good} of {len(hidden)}", silent, f"{false} of {len(nothing)}", others)
        gains = [_median_gain(hidden, quantity) for quantity in (TEMPERATURE, HUMIDITY)]
        cpu = sorted(line["cpu_s"] for line in some)
        shown = ("–",) * 4 if method == NETWORK else names
        rows.append((method, *shown, *gains, f"{cpu[len(cpu) // 2]:.1f} s"))
    head = (
        "method", "right first", "no name", "nothing hidden, yet named",
        "names that are not right, all plants", "median gain, temperature", "median gain, humidity",
        "median CPU",
    )  # fmt: skip
    return markdown(head, rows)


def _median_gain(lines: Sequence[Line], quantity: str) -> str:
    """Median over records of the share of the held-out error that is gone; a run that diverged counts as the
    least."""
    shares = []
    for line in lines:
        if before := (line["before"] or {}).get(quantity):
            after = line["after"].get(quantity)
            shares.append(float("-inf") if after is None else 1.0 - after / before)
    if not shares:
        return "–"
    shares.sort()
    middle = 0.5 * (shares[(len(shares) - 1) // 2] + shares[len(shares) // 2])
    worse = sum(share < -0.02 for share in shares)
    return f"{100 * middle:.0f} % (worse in {worse} of {len(shares)})"
