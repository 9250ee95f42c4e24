"""How often `discover` is right: docs/validation/discovery_figures.md.

A case is a plant of tests/plants that hides a cause, two, or nothing, or a measured record of which something
is known.  A seed is one plant of every cell of a group: 15 causes, 8 effects of no library, one pair, one
null."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace

import numpy as np
from plants.as_record import to_record
from plants.hidden import FORMS, LIBRARY, OUT_OF_LIBRARY, hidden_plant
from plants.nulls import null_plant
from plants.plant import Plant

import hygrokf
from hygrokf.data.record import Record
from hygrokf.data.shared_clocks import Shift, shifted
from hygrokf.discovery.discovery_results import Discovery
from validation.discovery_tables import NULLS, table
from validation.frame import Claim
from validation.records import CASES, IDENTIFIED, Known, before_the_last_fifth, measured

Cause = tuple[str, int]
"""A cause of `plants.hidden` and the number of its form."""
DAYS = 170.0
APART = 100_000
"""Seeds between cells: no two cells share a plant; halved causes are in the plants of whole ones."""
CAUSES = (
    "moisture_sorption", "condensation", "wall_thermal_mass", "solar_gain", "wind_driven_exchange",
    "unlogged_heater", "cooling_switching", "exchange_step", "heat_release_drift", "humidity_sensor_drift",
    "clock_shift", "rain_ingress", "door_opening", "dehumidifier", "ambient_bias",
)  # fmt: skip
"""The fifteen causes; their places are part of the seeds.  Summer time cannot be halved."""
USED_FORMS = {"clock_shift": 1, "internal_moisture_source": 3}
"""Forms that seeds take by turns, where these are not two."""
THERMAL = (
    "wall_thermal_mass", "solar_gain", "unlogged_heater", "cooling_switching", "heat_release_drift",
    "wind_driven_exchange",
)  # fmt: skip
HYGRIC = (
    "moisture_sorption", "condensation", "humidity_sensor_drift", "rain_ingress", "dehumidifier",
    "internal_moisture_source",
)  # fmt: skip
NULL_KINDS = dict(zip(NULLS, ("two_times", "probe", "resistances", "bursts", "apart_bursts"), strict=True))
"""Group -> kind of `plants.nulls`."""
_CONFIDENCE_STREAM = 71


@dataclass(frozen=True)
class Case:
    """One case: its group, cell and seed, and what the plant of `plant_seed` hides.

    halved: with half the amplitude. null: kind of `plants.nulls`. known: a variant of a measured
    record.
    """

    group: str
    cell: str
    seed: int
    plant_seed: int = 0
    causes: tuple[Cause, ...] = ()
    halved: bool = False
    null: str = ""
    known: Known | None = None


def hidden_form(cause: str, turn: int) -> Cause:
    """The form of a cause whose turn it is."""
    return cause, turn % USED_FORMS.get(cause, 2)


def _alone(group: str, halved: bool) -> Callable[[int], Iterator[Case]]:
    def cases(seed: int) -> Iterator[Case]:
        for place, cause in enumerate(CAUSES, 1):
            yield Case(group, cause, seed, place * APART + seed, (hidden_form(cause, seed),), halved)

    return cases


def _pairs(seed: int) -> Iterator[Case]:
    """A cause on heat beside one on moisture; 36 seeds have every pair once, 18 each cause three times."""
    thermal = THERMAL[seed % 6]
    hygric = HYGRIC[(seed + seed // 6) % 6]
    hidden = tuple(hidden_form(cause, seed // 6) for cause in (thermal, hygric))
    yield Case("pairs", f"{thermal} + {hygric}", seed, 20 * APART + seed, hidden)


def _nulls(group: str) -> Callable[[int], Iterator[Case]]:
    place = 21 + list(NULL_KINDS).index(group)

    def cases(seed: int) -> Iterator[Case]:
        yield Case(group, "nothing", seed, place * APART + seed, null=NULL_KINDS[group])

    return cases


def _outside(seed: int) -> Iterator[Case]:
    for place, effect in enumerate(OUT_OF_LIBRARY):
        yield Case("outside", effect, seed, (30 + place) * APART + seed, ((effect, 0),))


def _confidence(seed: int) -> Iterator[Case]:
    """A plant as they may come: nothing in one of six, else any form of any cause, halved in one of two."""
    random = np.random.default_rng([_CONFIDENCE_STREAM, seed])
    plant_seed = 50 * APART + seed
    if random.random() < 1.0 / 6.0:
        yield Case("confidence", "drawn", seed, plant_seed, null="two_times")
        return
    cause = LIBRARY[int(random.integers(len(LIBRARY)))]
    form = int(random.integers(len(FORMS[cause])))
    yield Case("confidence", "drawn", seed, plant_seed, ((cause, form),), bool(random.random() < 0.5))


def _measured(seed: int) -> Iterator[Case]:
    """Variants of measured records, once whatever the seeds are."""
    if seed == 0:
        for one in CASES:
            yield Case("measured", f"{one.record}, {one.variant}", seed, known=one)


GROUPS: dict[str, Callable[[int], Iterator[Case]]] = {
    "causes": _alone("causes", False),
    "half": _alone("half", True),
    "pairs": _pairs,
    **{group: _nulls(group) for group in NULL_KINDS},
    "outside": _outside,
    "measured": _measured,
    "confidence": _confidence,
}
"""Group -> its cases of a seed."""


# -- one case ------------------------------------------------------------------------------------------------
def one(group: str, cell: str, seed: int) -> dict:
    """The record of a case, and what `discover` makes of it."""
    record, hidden, whole = make(case_of(group, cell, seed))
    return {"hidden": hidden, **found(record, whole)}


def case_of(group: str, cell: str, seed: int) -> Case:
    (case,) = (one for one in GROUPS[group](seed) if one.cell == cell)
    return case


def asked(group: str, cell: str, seed: int) -> dict:
    """What is known of a case before it is run."""
    case = case_of(group, cell, seed)
    return {
        "group": group,
        "cell": cell,
        "asked": [list(one) for one in case.causes],
        "strength": 0.5 if case.halved else 1.0,
        "known": asdict(case.known) if case.known else None,
    }


def make(case: Case) -> tuple[Record, list[dict], Record | None]:
    """The record of a case, the accounts of what is hidden in it, and of a measured one, which is cut before
    its last fifth, the whole."""
    if case.known:
        cut, whole = before_the_last_fifth(measured(case.known.record, case.known.variant))
        return cut, [], whole
    if case.null:
        made = null_plant(case.plant_seed, case.null, days=DAYS)
    else:
        (cause, form), *others = case.causes
        second = others[0] if others else None
        made = hidden_plant(case.plant_seed, cause, form=form, halved=case.halved, days=DAYS, second=second)
    record = to_record(made)
    record = to_record(made, until_s=identified_until(record, made))
    return record, [asdict(one) for one in made.truth.hidden], None


def identified_until(record: Record, made: Plant) -> float:
    """End of the identification period [s]: two thirds of the record, later where a change would else lie
    behind it.

    What begins in the validation period cannot be identified; so that it can, a seventh of the record follows
    the date.
    """
    span = record.end_s - record.start_s
    dates = [float(np.median(one.dates)) for one in made.truth.hidden if len(one.dates)]
    latest = max(((date - record.start_s) / span for date in dates), default=0.0)
    return record.start_s + min(max(IDENTIFIED, latest + 1.0 / 7.0), 0.95) * span


def found(record: Record, whole: Record | None = None) -> dict:
    """What is named in a record, what was refuted, free-run errors on held-out readings and on those of the
    whole record that were cut off, and the work."""
    begin = time.process_time()
    discovery = hygrokf.discover(record)
    results, spent = discovery.results, time.process_time() - begin
    return {
        "verdict": results.verdict,
        "names": [{**_told(one), "rivals": list(one.ambiguous_with), "confidence": one.confidence,
                   "worth": one.held_out.improvement} for one in results.causes],
        "refuted": [{**_told(one), "reason": one.held_out.reason} for one in results.refuted],
        "errors": {one.quantity: [one.rmse_before, one.rmse_after] for one in results.gains},
        "lines": [[one.quantity, one.period_h, one.p, one.cause] for one in results.lines],
        "last_fifth": {} if whole is None else afterwards(discovery, whole, record.end_s),
        "simulations": results.work.simulations,
        "cpu_s": spent,
        "said": ", ".join(f"{one.cause}/{one.form}" for one in results.causes) or results.verdict,
    }  # fmt: skip


def afterwards(discovery: Discovery, whole: Record, from_s: float) -> dict[str, list[float]]:
    """Free-run errors [K], [g/m³] of the base and of the told model on readings after an instant [s], by
    quantity."""
    later = replace(whole, until_s=from_s)
    shifts = [
        Shift(one.settings["source"], one.settings["shift_s"])
        for one in discovery.results.causes
        if "shift_s" in one.settings
    ]
    base = hygrokf.evaluate(discovery.base, later)
    told = hygrokf.evaluate(discovery.extended, shifted(later, *shifts)) if discovery.extended else base
    quantities = ("temperature_K", "absolute_humidity_g_m3")
    pairs = {q: [one.errors("validation", q).total for one in (base, told)] for q in quantities}
    return {q: pair for q, pair in pairs.items() if np.isfinite(pair).all()}


def _told(one) -> dict:
    return {
        "cause": one.cause, "form": one.form, "evidence": one.evidence.evidence,
        "evidence_in_days": one.evidence.in_days, "lead": one.evidence.lead,
    }  # fmt: skip


def cells(group: str, seed: int) -> list[tuple[str, str, int]]:
    """The cases of a group and a seed."""
    return [(group, case.cell, seed) for case in GROUPS[group](seed)]


CLAIM = Claim(
    "discovery",
    {
        "causes": range(4000, 4004),
        "half": range(4000, 4004),
        "pairs": range(4000, 4018),
        "nulls": range(4000, 4060),
        **dict.fromkeys(NULLS[1:], range(4000, 4020)),
        "outside": range(4000, 4002),
        "measured": range(1),
        "confidence": range(253),
    },
    one,
    table,
    cells,
    before=asked,
)
