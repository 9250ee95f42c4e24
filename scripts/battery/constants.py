"""What half and double of each constant that decides do to ten plants and five nulls."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import FunctionType

from battery.cases import Case, chosen
from battery.tables import false_names, first_right
from battery.trial import make, sources_hash
from hygrokf.discovery.conclusion import Conclusion, concluded, what_is_left
from hygrokf.discovery.forms import ground_of
from hygrokf.discovery.library import LIBRARY
from hygrokf.discovery.procedure import verdict
from hygrokf.discovery.search import Search
from hygrokf.discovery.starting_model import base_estimate

CONSTANTS = (
    ("candidates", "THRESHOLD"), ("search", "FURTHER"), ("candidates", "CLOSE_Z"),
    ("candidates", "WATER_SHARE"), ("error_model", "HUBER"), ("judgement", "BETTER_Z"),
    ("judgement", "WORSE_GROWTH"), ("judgement", "LEAST_IMPROVEMENT"), ("judgement", "NOTICED"),
    ("conclusion", "SIGNIFICANT"), ("conclusion", "CYCLES"), ("results", "CLASS_LIMIT"),
    ("final_set", "BETTER"),
)  # fmt: skip
"""Module of `hygrokf.discovery` and name; the share of saturated readings decides a remark alone."""
CELLS = (
    "sorption", "condensation", "wall", "sun", "standstill heater", "exchange step",
    "drift of the humidity sensor", "clock", "rain", "doors",
)  # fmt: skip
AFTER_THE_SEARCH = ("SIGNIFICANT", "CYCLES", "CLASS_LIMIT", "BETTER")
SEED = 3000
NULLS = 5


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
        Variant("candidates", "THRESHOLD", 1.0),
        *(Variant(module, name, factor) for module, name in CONSTANTS for factor in (0.5, 2.0)),
    ]


def cases() -> list[Case]:
    """Ten plants with a cause and five without."""
    plants = [case for case in chosen(["causes"], [SEED]) if case.cell in CELLS]
    return [*plants, *chosen(["nulls"], range(SEED, SEED + NULLS))]


@contextmanager
def varied(one: Variant) -> Iterator[None]:
    """The package with another value of a constant: in every module that has it, and as a default."""
    owner = sys.modules[f"hygrokf.discovery.{one.module}"]
    before = getattr(owner, one.name)
    value = 1.0 - one.factor * (1.0 - before) if one.name == "BETTER" else before * one.factor
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


def told(case: Case, one: Variant, ended: Conclusion) -> dict:
    """The line of a case under a variant."""
    names = [
        {"cause": name.candidate.cause, "rivals": sorted({rival.cause for rival in name.rivals})}
        for name in ended.accepted
    ]
    line: dict = {
        "key": f"{one.key}: {case.key}", "variant": one.key, "asked": [list(cause) for cause in case.causes],
        "sources": sources_hash(), "failure": None, "names": names,
        "verdict": verdict(ended, what_is_left(ended)),
    }  # fmt: skip
    return line | {"first": bool(names) and first_right(line), "false": len(false_names(line))}


def lines_of(case: Case) -> Iterator[dict]:
    """The lines of a case under every variant; those that act after the search share one."""
    record = make(case)[0]
    base = base_estimate(record)
    ground = ground_of(record, base.simulator.heat, base.simulator.vapour)
    forms = [form for cause in LIBRARY for form in cause.forms(ground) if form.grid]
    found = Search(base, forms).run()
    for one in variants():
        with varied(one):
            again = found
            if one.factor != 1.0 and one.name not in AFTER_THE_SEARCH:
                own = base_estimate(record) if one.name == "HUBER" else base
                again = Search(own, forms).run()
            yield told(case, one, concluded(again))


def table(lines: Sequence[dict]) -> str:
    """Plants whose cause is first, false names and nulls without a name, by variant."""
    text = ["| variant | first by name | false names | nulls: none |", "| --- | --- | --- | --- |"]
    for one in dict.fromkeys(line["variant"] for line in lines):
        mine = [line for line in lines if line["variant"] == one]
        plants = [line for line in mine if line["asked"]]
        nulls = [line for line in mine if not line["asked"]]
        first, false = (sum(line[key] for line in plants) for key in ("first", "false"))
        none = sum(line["verdict"] == "none" for line in nulls)
        text.append(f"| {one} | {first} of {len(plants)} | {false} | {none} of {len(nulls)} |")
    return "\n".join(text)
