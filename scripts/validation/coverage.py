"""How often the bounds of the time constants hold: docs/validation/coverage.md.

Each plant is made by tests/other_make or tests/plants, which share no code with the package, and identified
with the default settings."""

from __future__ import annotations

import math
import resource
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from statistics import fmean, median, pstdev, stdev

from other_make import ROWS as SCENARIOS
from other_make import Scenario, Truth, make_plant
from other_make.as_record import to_record as record_of_other_make
from plants import DISTURBANCES, plant
from plants.as_record import to_record

from hygrokf import identify
from hygrokf.data.record import Record
from hygrokf.data.structured import plain
from validation.counts import markdown
from validation.frame import Claim

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
    begin, used = time.perf_counter(), _cpu_s()
    fit = identify(record)
    spent = {"wall_s": time.perf_counter() - begin, "cpu_s": _cpu_s() - used}
    errors = plain(fit.results.rmse["identification"])
    return {
        "row": row, "days": days, **spent, "converged": fit.results.converged,
        "statements": list(fit.results.statements),
        "free_run": {name: rmse["total"] for name, rmse in errors.items()},
        "mechanisms": [name for name, _ in fit.design.mechanisms],
        "quantities": {
            name: compared(quantity, plain(fit.results.time_constants[quantity.constant]))
            for name, quantity in quantities.items()
        },
    }  # fmt: skip


def compared(quantity: Quantity, whole: Entry) -> dict:
    """Truth, estimate, headline interval, plain profile bound and verdict of one quantity."""
    part = whole.get(quantity.key) if quantity.key else None
    entry = whole if part is None else part
    truth = float(quantity.truth(whole))
    profile, simulation = next(iter(entry.get("composition", ())), None), entry.get("simulation")
    return {
        "truth": truth,
        "value": entry["value_h"],
        **_interval(entry, truth),
        "own": quantity.key is None or part is not None,
        "profile": None if profile is None else _interval(profile, truth),
        "verdict": entry.get("verdict", whole.get("verdict")),
        "reasons": entry.get("reasons", whole.get("reasons")),
        "factor": entry.get("factor"),
        "simulation": None if simulation is None else simulation["value_h"],
        "disagreement": entry.get("criteria_disagree", False),
    }


def _interval(entry: Entry, truth: float) -> dict:
    """Bounds [h], None where open, and whether they hold the truth."""
    lower, upper = entry["lower_h"], entry["upper_h"]
    covered = (0.0 if lower is None else lower) <= truth <= (math.inf if upper is None else upper)
    return {"lower": lower, "upper": upper, "covered": bool(covered)}


def _cpu_s() -> float:
    """[s] of processor time of this process and of those that it has waited for."""
    who = (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    return sum(used.ru_utime + used.ru_stime for used in map(resource.getrusage, who))


# -- sums and the table --------------------------------------------------------------------------------------
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
    profiles = [one["profile"] for one in found]
    return Sums(
        plants=len(found),
        error=fmean(errors),
        spread=stdev(errors) if len(errors) > 1 else 0.0,
        half_width=median(map(half_width, found)),
        covered=len(found) - len(missed),
        profile=None if None in profiles else sum(one["covered"] for one in profiles),
        verdicts=Counter(one["verdict"] for one in found if one["verdict"] is not None),
        misses=len(missed),
        told=sum(one["verdict"] not in (None, "believe") for one in missed),
        free_run_error=fmean(free) if free else None,
        free_run_spread=math.hypot(fmean(free), pstdev(free)) if free else None,
    )


HEAD = (
    "row", "plants", "quantity", "mean error", "spread", "half width, median", "covered",
    "by the profile bound", "believe / caution / reject", "misses told", "free run", "CPU", "wall",
)  # fmt: skip


def table(lines: Sequence[Mapping]) -> str:
    """A line a row and quantity, then the mean errors of the free run."""
    rows, free_runs = [], []
    for row in dict.fromkeys(line["row"] for line in lines):
        some = [line for line in lines if line["row"] == row]
        for name in some[0]["quantities"]:
            cells = _cells(sums([line["quantities"][name] for line in some]))
            spent = (f"{median(line[key] for line in some):.1f} s" for key in ("cpu_s", "wall_s"))
            rows.append((row, len(some), name, *cells, *spent))
        kelvin, grams = (
            fmean(line["free_run"][quantity] for line in some)
            for quantity in ("temperature_K", "absolute_humidity_g_m3")
        )
        free_runs.append(f"{row}: free-run errors {kelvin:.2f} K, {grams:.3f} g/m³ in the mean")
    return "\n".join([markdown(HEAD, rows), "", *free_runs])


def _cells(s: Sums) -> tuple[str, ...]:
    free = s.free_run_error
    return (
        f"{100 * math.expm1(s.error):+.1f} %",
        f"{100 * s.spread:.1f} %",
        "open" if math.isinf(s.half_width) else f"±{100 * s.half_width:.1f} %",
        f"{s.covered}/{s.plants}",
        "–" if s.profile is None else f"{s.profile}/{s.plants}",
        " / ".join(str(s.verdicts.get(v, 0)) for v in VERDICTS) if s.verdicts else "–",
        f"{s.told}/{s.misses}" if s.verdicts else "–",
        "–" if free is None else f"{100 * math.expm1(free):+.0f} ± {100 * s.free_run_spread:.0f} %",
    )


CLAIM = Claim(
    "coverage",
    {row: range(1000, 1200) if row == "ou" else range(20000, 20060) for row in ROWS},
    one,
    table,
)
