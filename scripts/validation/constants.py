"""What half and double of each constant that decides do to ten plants and five nulls:
docs/reference/discover_constants.md."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import FunctionType

from hygrokf.discovery.discover import Conclusion, conclude, remaining_lines, verdict
from hygrokf.discovery.search import Search
from hygrokf.discovery.starting_model import base_estimate
from hygrokf.modelling.causes.forms import ground_of
from hygrokf.modelling.library import CAUSES
from validation.counts import markdown
from validation.discovery import asked, case_of, cells, make
from validation.discovery_tables import false_names, first_right
from validation.frame import Claim, Line

CONSTANTS = (
    ("candidates", "ACCEPTED_EVIDENCE"), ("search", "FURTHER_EVIDENCE"), ("candidates", "CLOSE_Z"),
    ("candidates", "WATER_SHARE"), ("error_model", "HUBER"), ("judgement", "BETTER_Z"),
    ("judgement", "WORSE_GROWTH"), ("judgement", "LEAST_IMPROVEMENT"), ("judgement", "NOTICED"),
    ("discover", "SIGNIFICANT"), ("discover", "CYCLES"), ("discovery_results", "CLASS_LIMIT"),
    ("final_set", "BETTER_RATIO"),
)  # fmt: skip
"""Module of `hygrokf.discovery` and name; the share of saturated readings decides a remark alone."""
CELLS = (
    "moisture_sorption", "condensation", "wall_thermal_mass", "solar_gain", "unlogged_heater",
    "exchange_step", "humidity_sensor_drift", "clock_shift", "rain_ingress", "door_opening",
)  # fmt: skip
AFTER_THE_SEARCH = ("SIGNIFICANT", "CYCLES", "CLASS_LIMIT", "BETTER_RATIO")


@dataclass(frozen=True)
class Variant:
    """A constant of a module times a factor."""

    module: str
    name: str
    factor: float

    @property
    def key(self) -> str:
        return f"{self.name} x {self.factor:g}"


def variants() -> list[Variant]:
    """The constants as they are, then each halved and doubled."""
    return [
        Variant("candidates", "ACCEPTED_EVIDENCE", 1.0),
        *(Variant(module, name, factor) for module, name in CONSTANTS for factor in (0.5, 2.0)),
    ]


def some_cells(group: str, seed: int) -> list[tuple[str, str, int]]:
    """Ten plants with a cause, or one without."""
    return [case for case in cells(group, seed) if case[1] in (*CELLS, "nothing")]


@contextmanager
def varied(one: Variant) -> Iterator[None]:
    """The package with another value of a constant: in every module that has it, and as a default."""
    owner = sys.modules[f"hygrokf.discovery.{one.module}"]
    before = getattr(owner, one.name)
    value = 1.0 - one.factor * (1.0 - before) if one.name == "BETTER_RATIO" else before * one.factor
    after = type(before)(value)
    modules = [module for name, module in sys.modules.items() if name.startswith("hygrokf.discovery.")]
    owners = [module for module in modules if getattr(module, one.name, None) is before]
    functions = [
        value for value in vars(owner).values()
        if isinstance(value, FunctionType) and any(default is before for default in value.__defaults__ or ())
    ]  # fmt: skip

    def put(old: object, new: object) -> None:
        for module in owners:
            setattr(module, one.name, new)
        for function in functions:
            function.__defaults__ = tuple(new if d is old else d for d in function.__defaults__ or ())

    put(before, after)
    try:
        yield
    finally:
        put(after, before)


def told(case: dict, ended: Conclusion) -> dict:
    """What is told of a case under a variant: whether its cause is first, false names, the verdict."""
    names = [
        {"cause": name.cause, "rivals": sorted({rival.cause for rival in name.rivals})}
        for name in ended.accepted
    ]
    line = {**case, "names": names}
    return {
        "first": bool(names and case["asked"]) and first_right(line),
        "false": len(false_names(line)),
        "verdict": verdict(ended, remaining_lines(ended)),
    }


def one(group: str, cell: str, seed: int) -> dict:
    """What is told of a case under every variant; those that act after the search share one."""
    record = make(case_of(group, cell, seed))[0]
    base = base_estimate(record)
    ground = ground_of(record, base.simulator.heat, base.simulator.vapour)
    forms = [form for cause in CAUSES for form in cause.forms(ground) if form.grid]
    found = Search(base, forms).run()
    case, rows = asked(group, cell, seed), {}
    for variant in variants():
        with varied(variant):
            again = found
            if variant.factor != 1.0 and variant.name not in AFTER_THE_SEARCH:
                own = base_estimate(record) if variant.name == "HUBER" else base
                again = Search(own, forms).run()
            rows[variant.key] = told(case, conclude(again))
    return {**case, "variants": rows}


def table(lines: Sequence[Line]) -> str:
    """Plants whose cause is first, false names and nulls without a name, by variant."""
    plants = [line["variants"] for line in lines if line["asked"]]
    nulls = [line["variants"] for line in lines if not line["asked"]]
    rows = []
    for key in lines[0]["variants"]:
        first, false = (sum(one[key][what] for one in plants) for what in ("first", "false"))
        none = sum(one[key]["verdict"] == "none" for one in nulls)
        rows.append((key, f"{first} of {len(plants)}", false, f"{none} of {len(nulls)}"))
    return markdown(("variant", "first by name", "false names", "nulls: none"), rows)


CLAIM = Claim("constants", {"causes": range(3000, 3001), "nulls": range(3000, 3005)}, one, table, some_cells)
