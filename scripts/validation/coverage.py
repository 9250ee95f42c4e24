"""How often the bounds of the time constants hold: docs/validation/coverage.md.

Each plant is made by tests/other_make or tests/plants, which share no code with the package, and identified
with the default settings."""

from __future__ import annotations

import math
import resource
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from statistics import fmean, median, stdev

from other_make import ROWS as SCENARIOS
from other_make import Scenario, Truth, make_plant
from other_make.as_record import to_record as record_of_other_make
from plants import DISTURBANCES, plant
from plants.as_record import to_record

from hygrokf import identify
from hygrokf.data.record import Record
from hygrokf.data.structured import plain
from validation.counts import markdown
from validation.frame import Claim, by_variant

VERDICTS = ("believe", "caution", "reject")
Entry = Mapping
"""One of a fit's `time_constants`."""


@dataclass(frozen=True)
class Quantity:
    """A quantity whose truth is known.

    constant: the fit's time constant it is compared with. truth: the true value [h], given the fit's entry,
    which says at which temperatures or which difference it holds. key: the part of that entry that reports
    this quantity; where the fit has no such part, and where None, it is the entry itself.
    """

    constant: str
    truth: Callable[[Entry], float]
    key: str | None = None


# -- the rows ------------------------------------------------------------------------------------------------
def _of_other_make(scenario: Scenario, seed: int, days: float) -> tuple[Record, Mapping[str, Quantity]]:
    made = make_plant(seed, scenario, days)
    return record_of_other_make(made), other_make_quantities(scenario, made.truth)


def other_make_quantities(scenario: Scenario, truth: Truth) -> dict[str, Quantity]:
    """What a plant of tests/other_make is held against.

    Under convection the headline is the small-signal constant, and R·C stands beside it.  With a second mass
    it is (R_AT+R_IC) C of the converter, the constant of the paper's network; the network's longest constant
    stands beside it.
    """

    def small_signal(entry: Entry) -> float:
        return truth.cabinet.small_signal_h(_difference_K(entry, truth))

    def resistance_capacity(entry: Entry) -> float:
        return truth.cabinet.resistance_capacity_h(_difference_K(entry, truth))

    found = {
        "thermal": Quantity("thermal", small_signal),
        "hygric": Quantity("hygric", partial(_hygric, truth)),
    }
    if scenario.exponent is not None:
        found["thermal R·C"] = Quantity("thermal", resistance_capacity, "resistance_capacity")
    if scenario.second_mass is not None:
        found["thermal longest"] = Quantity("thermal", lambda entry: truth.dominant_h)
    return found


def _difference_K(entry: Entry, truth: Truth) -> float:
    """The median difference [K] at which the fit reports its thermal constant; the plant's where it does not
    say."""
    stated = entry.get("difference_K")
    return stated[1] if stated else truth.differences_K[1]


def _hygric(truth: Truth, entry: Entry) -> float:
    reference = entry["mean_temperatures"]
    return truth.hygric_h(reference["cabinet_temperature_K"], reference["ambient_temperature_K"])


def _of_plants(options: Mapping[str, str], seed: int, days: float) -> tuple[Record, Mapping[str, Quantity]]:
    made = plant(seed, days=days, **options)
    return to_record(made), {
        "thermal": Quantity("thermal", lambda entry: made.truth.tau_h),
        "hygric": Quantity("hygric", lambda entry: made.truth.hygric_h),
    }


ROWS: dict[str, Callable[[int, float], tuple[Record, Mapping[str, Quantity]]]] = {
    **{name: partial(_of_other_make, scenario) for name, scenario in SCENARIOS.items()},
    **{
        kind: partial(_of_plants, {"disturbance": kind, "sensor_errors": "cabinet"})
        for kind in DISTURBANCES
        if kind != "none"
    },
    "ou-all-sensors": partial(_of_plants, {"disturbance": "ou", "sensor_errors": "all"}),
}
"""Row -> the record of a seed and a length [d], and its quantities by name."""


# -- one plant -----------------------------------------------------------------------------------------------
def one(row: str, seed: int, *, days: float = 90.0) -> dict:
    """The record of a plant, its fit with the default settings, and what came of it."""
    record, quantities = ROWS[row](seed, days)
    used = _cpu_s()
    fit = identify(record)
    return {
        "days": days,
        "cpu_s": _cpu_s() - used,
        "quantities": {
            name: compared(quantity, plain(fit.results.time_constants[quantity.constant]))
            for name, quantity in quantities.items()
        },
    }


def compared(quantity: Quantity, whole: Entry) -> dict:
    """Truth, estimate, interval and verdict of one quantity."""
    part = whole.get(quantity.key) if quantity.key else None
    entry = whole if part is None else part
    truth = float(quantity.truth(whole))
    lower, upper = entry["lower_h"], entry["upper_h"]  # [h], None where open
    covered = (0.0 if lower is None else lower) <= truth <= (math.inf if upper is None else upper)
    return {
        "truth": truth,
        "value": entry["value_h"],
        "lower": lower,
        "upper": upper,
        "covered": bool(covered),
        "verdict": entry.get("verdict", whole.get("verdict")),
    }


def _cpu_s() -> float:
    """[s] of processor time of this process and of those that it has waited for."""
    who = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return sum(used.ru_utime + used.ru_stime for used in map(resource.getrusage, who))


# -- sums and the table --------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Sums:
    """One quantity over the plants of a row; errors and half widths are logarithms.

    verdicts: plants by verdict. misses, told: plants whose interval misses the truth, and those of them whose
    verdict is not "believe".
    """

    plants: int
    error: float
    spread: float
    half_width: float
    covered: int
    verdicts: Mapping[str, int]
    misses: int
    told: int


def half_width(interval: Mapping) -> float:
    """Half the width of an interval in the logarithm; ∞ where it is open."""
    lower, upper = interval["lower"], interval["upper"]
    return math.inf if not lower or upper is None else 0.5 * math.log(upper / lower)


def sums(found: Sequence[Mapping]) -> Sums:
    """Of the quantities `found`, one a plant."""
    errors = [math.log(one["value"] / one["truth"]) for one in found]
    missed = [one for one in found if not one["covered"]]
    return Sums(
        plants=len(found),
        error=fmean(errors),
        spread=stdev(errors) if len(errors) > 1 else 0.0,
        half_width=median(map(half_width, found)),
        covered=len(found) - len(missed),
        verdicts=Counter(one["verdict"] for one in found if one["verdict"] is not None),
        misses=len(missed),
        told=sum(one["verdict"] not in (None, "believe") for one in missed),
    )


HEAD = (
    "row", "plants", "quantity", "mean error", "spread", "half width, median", "covered",
    "believe / caution / reject", "misses told", "CPU",
)  # fmt: skip


def table(lines: Sequence[Mapping]) -> str:
    """A line a row and quantity."""
    rows = []
    for row, some in by_variant(lines).items():
        cpu = f"{median(line['cpu_s'] for line in some):.1f} s"
        for name in some[0]["quantities"]:
            found = sums([line["quantities"][name] for line in some])
            rows.append((row, len(some), name, *_cells(found), cpu))
    return markdown(HEAD, rows)


def _cells(s: Sums) -> tuple[str, ...]:
    return (
        f"{100 * math.expm1(s.error):+.1f} %",
        f"{100 * s.spread:.1f} %",
        "open" if math.isinf(s.half_width) else f"±{100 * s.half_width:.1f} %",
        f"{s.covered}/{s.plants}",
        " / ".join(str(s.verdicts.get(v, 0)) for v in VERDICTS) if s.verdicts else "–",
        f"{s.told}/{s.misses}" if s.verdicts else "–",
    )


CLAIM = Claim(
    "coverage",
    {row: range(1000, 1200) if row == "ou" else range(20000, 20060) for row in ROWS},
    one,
    table,
)
