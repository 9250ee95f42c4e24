"""Four ways to say what a model lacks, on the same simulated plants and the same measured boxes:
docs/validation/head_to_head.md.  Half an hour of CPU time."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

from builders import greenhouse
from plants.as_record import to_record
from plants.hidden import hidden_plant

from hygrokf.data.record import Record
from hygrokf.discovery.procedure import discover
from validation import cabinet
from validation.discovery import identified_until
from validation.frame import Absent, Claim
from validation.head_to_head.forward import log_p, search
from validation.head_to_head.ground import Ground, ground
from validation.head_to_head.network import corrected
from validation.head_to_head.sparse import regressed
from validation.head_to_head.tables import BOX, FORWARD, METHODS, NETWORK, OWN, PLANT, SPARSE, tables
from validation.records import measured
from validation.sisters import record as sister

FIRST_SEED = 97000
DAYS = 90.0
HIDDEN = (
    "moisture_sorption", "solar_gain", "wind_driven_exchange", "cooling_switching", "exchange_step",
    "humidity_sensor_drift", "clock_shift", "internal_moisture_source",
)  # fmt: skip
NOTHING = 4
"""Plants that hide nothing."""


@dataclass(frozen=True)
class Case:
    """A record to be asked: its `name`, its `kind`, the names that are `right` (None: not known), and how it
    is made."""

    name: str
    kind: str
    right: tuple[str, ...] | None
    record: Callable[[], Record]


def _plant(seed: int, cause: str) -> Case:
    def make() -> Record:
        made = hidden_plant(seed, cause, form=0, strength=1.0, days=DAYS)
        return to_record(made, until_s=identified_until(to_record(made), made))

    return Case(f"{cause} ({seed})", PLANT, () if cause == "none" else (cause,), make)


def _greenhouse() -> Record:
    sister("Koala")  # raises Absent without the data
    return greenhouse.record("Koala", greenhouse.whole("Koala"), ("fan_duty",))


def cases() -> list[Case]:
    """All cases, the plants first.  What a measured box lacks is known for the greenhouse alone."""
    causes = (*HIDDEN, *("none",) * NOTHING)
    return [
        *(_plant(FIRST_SEED + place, cause) for place, cause in enumerate(causes)),
        Case("controller's cabinet", BOX, None, lambda: cabinet.record("controller")),
        Case("greenhouse, vents withheld", BOX, greenhouse.CLASSES["fan_duty"], _greenhouse),
        *(
            Case(name, BOX, None, lambda name=name: measured(name))
            for name in ("attic R2", "attic R4", "house")
        ),
    ]


def outcome(names: list[str], alike: list[str], right: tuple[str, ...] | None) -> str:
    """What names are worth, the first one first: "right", "in class", "later" (another one is right), "wrong"
    or "none".

    names: in the order in which they were given. alike: causes that the method said it cannot tell from the
        first.
    right: names that are right, none where nothing is hidden, None where it is not known.
    """
    if not names:
        return "none"
    if right is None:
        return "not known"
    if names[0] in right:
        return "right"
    if set(alike) & set(right):
        return "in class"
    return "later" if set(names) & set(right) else "wrong"


# -- the methods ---------------------------------------------------------------------------------------------
def own(shared: Ground) -> dict:
    """`hygrokf.discover` as it is called without options."""
    begin = time.process_time()
    results = discover(shared.record).to_json()
    spent = time.process_time() - begin

    def errors(side: str) -> dict[str, float | None]:
        table = (results[side] or results["baseline"])["rmse"].get("validation", {})
        return {quantity: table.get(quantity, {}).get("total") for quantity in shared.quantities}

    causes = results["causes"]
    return {
        "names": [one["cause"] for one in causes],
        "alike": list(causes[0]["ambiguous_with"]) if causes else [],
        "before": errors("baseline"),
        "after": errors("extended"),
        "cpu_s": spent,
    }


def forward(shared: Ground, limit_s: float) -> dict:
    begin = time.process_time()
    found = search(shared.base, shared.cpu_s, limit_s)
    return {
        "names": [one.cause for one in found.added],
        "log_p": [log_p(one) for one in found.added],
        "after": shared.held_out(found.last if found.added else None),
        "cpu_s": time.process_time() - begin + shared.cpu_s,
        "ended": found.ended,
        "tried": found.tried,
    }


def network(shared: Ground) -> dict:
    begin = time.process_time()
    after = corrected(shared)
    return {"names": [], "after": after, "cpu_s": time.process_time() - begin + shared.cpu_s}


@lru_cache(maxsize=1)
def _shared(number: int) -> Ground:
    """What the methods share of a case; these take turns on it."""
    return ground(cases()[number].record())


def one(method: str, number: int, *, pysindy: str = "", limit: float = 45.0) -> dict:
    """What a method says of a case; `pysindy`: an interpreter of another environment that has it; `limit` [s]
    of CPU time of the forward search."""
    if method == SPARSE and not pysindy:
        raise Absent("--pysindy PYTHON names an interpreter that has it")
    case, shared = cases()[number], _shared(number)
    said = {
        OWN: lambda: own(shared),
        SPARSE: lambda: regressed(shared, pysindy),
        FORWARD: lambda: forward(shared, limit),
        NETWORK: lambda: network(shared),
    }[method]()
    worth = None if method == NETWORK else outcome(said["names"], said.get("alike", []), case.right)
    return {
        "name": case.name, "kind": case.kind, "right": case.right, "method": method, "outcome": worth,
        "before": shared.held_out(), **said, "said": f"{', '.join(said['names']) or 'no name'}",
    }  # fmt: skip


CLAIM = Claim("head_to_head", dict.fromkeys(METHODS, range(len(cases()))), one, tables)
