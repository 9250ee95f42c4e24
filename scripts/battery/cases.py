"""The cases of the battery: what is hidden, in which plant or record, at which strength."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from plants.hidden import FORMS, LIBRARY, OUT_OF_LIBRARY
from plants.injection import EFFECTS

from battery.measured import CAUSE_OF, RECORDS

FIRST_SEED = 5000
ROUNDS = 5
DAYS = 180.0
STRENGTHS = (1.0, 0.5)
GROUPS = ("hidden", "none", "convection", "pair", "outside", "paper", "measured", "injected")
NULLS = 40
"""Plants a round that hide nothing: 200 in five rounds."""
CONVECTING = 20
"""Plants a round that hide nothing in a cabinet of another make, which no network of resistances
describes."""
OUTSIDE = 2
"""Plants a round, effect and strength that hide what no library holds."""
LATER = (("unlogged_heater", 2), ("cooling_switching", 2), ("scheduled_heat", 0), ("scheduled_heat", 1))
"""Forms that came later: they have the last seeds, so that the others keep theirs."""
PAPER = 2
"""Plants a round of each of the paper's case and its decoys."""
PAPER_LEAST_DAYS = 126.0
"""[d] the paper's standstill must lie within the first two thirds."""
APART = 20_000
"""Seeds between the groups: no two groups share a plant."""

THERMAL = (
    "wall_thermal_mass",
    "solar_gain",
    "unlogged_heater",
    "cooling_switching",
    "heat_release_drift",
    "temperature_sensor_offset",
)
HYGRIC = (
    "moisture_sorption",
    "condensation",
    "humidity_sensor_drift",
    "rain_ingress",
    "dehumidifier",
    "internal_moisture_source",
)
"""Causes that act on the temperature, and on the moisture: each of the one kind goes beside each of the
other."""
_PAIRINGS = 2
_PAIR_STREAM = 35


@dataclass(frozen=True)
class Case:
    """One case: what is hidden (`causes` with their forms), at which strength [1], in a plant of `seed` and
    `days` [d].

    decoy: of the paper's case. record, effect: a measured record and the effect put into it.
    """

    group: str
    seed: int = 0
    causes: tuple[tuple[str, int], ...] = ()
    strength: float = 1.0
    days: float = DAYS
    decoy: str = ""
    record: str = ""
    effect: str = ""

    @property
    def key(self) -> str:
        """What tells the case from all others."""
        if self.record:
            return ":".join(part for part in (self.group, self.record, self.effect, str(self.seed)) if part)
        hidden = "+".join(f"{cause}/{form}" for cause, form in self.causes) or "nothing"
        decoy = f"{self.decoy}:" if self.decoy else ""
        return f"{self.group}:{decoy}{hidden}:{self.strength:g}:{self.seed}:{self.days:g}"


def pairs(number: int) -> list[tuple[tuple[str, int], ...]]:
    """Pairs of causes with their forms that a round draws: one on the temperature, one on the moisture."""
    random = np.random.default_rng([_PAIR_STREAM, number])
    found = []
    for _ in range(_PAIRINGS):
        for thermal, hygric in zip(THERMAL, random.permutation(HYGRIC), strict=True):
            two = (thermal, str(hygric))
            found.append(tuple((name, int(random.integers(len(FORMS[name])))) for name in two))
    return found


def _round(first: int, number: int, days: float) -> Iterator[Case]:
    """Cases of one round.  Every cell has seeds of its own, the same ones however many rounds are run."""
    cells = [(c, form, s) for c in LIBRARY for form in range(len(FORMS[c])) for s in STRENGTHS]
    cells.sort(key=lambda cell: cell[:2] in LATER)
    for place, (cause, form, strength) in enumerate(cells):
        yield Case("hidden", first + number * len(cells) + place, ((cause, form),), strength, days)
    for place in range(NULLS):
        yield Case("none", first + APART + number * NULLS + place, days=days)
    for place in range(CONVECTING):
        yield Case("convection", first + 6 * APART + number * CONVECTING + place, days=days)
    two = pairs(number)
    for place, causes in enumerate(two):
        yield Case("pair", first + 2 * APART + number * len(two) + place, causes, days=days)
    cells = [
        (c, form, s) for c in OUT_OF_LIBRARY for form in range(len(FORMS[c])) for s in STRENGTHS
    ] * OUTSIDE
    for place, (cause, form, strength) in enumerate(cells):
        yield Case(
            "outside", first + 3 * APART + number * len(cells) + place, ((cause, form),), strength, days
        )
    kinds = (
        ("", ("moisture_sorption", 0)),
        ("", ("moisture_sorption", 1)),
        ("film", ("condensation", 0)),
        ("source", ("internal_moisture_source", 0)),
    ) * PAPER
    for place, (decoy, cause) in enumerate(kinds):
        seed = first + 4 * APART + number * len(kinds) + place
        yield Case("paper", seed, (cause,), days=max(days, PAPER_LEAST_DAYS), decoy=decoy)
    for record in RECORDS:
        if number == 0:
            yield Case("measured", record=record)
        for effect in EFFECTS:
            yield Case(
                "injected", first + 5 * APART + number, ((CAUSE_OF[effect], 0),), record=record, effect=effect
            )


def full(first: int = FIRST_SEED, rounds: int = ROUNDS, days: float = DAYS) -> list[Case]:
    """All cases, round by round: a battery that is stopped early has seen every cell."""
    return [case for number in range(rounds) for case in _round(first, number, days)]


CI_SEED = 4700
CI_DAYS = 60.0
CI_NULLS = 1
CI_CAUSES = {
    0: ("moisture_sorption", 1),
    2: ("solar_gain", 1),
    4: ("exchange_step", 0),
    5: ("heat_release_drift", 1),
    6: ("humidity_sensor_drift", 0),
    7: ("clock_shift", 0),
}
"""Place among the small list's seeds -> cause and form; what costs minutes each, such as a film of
condensate, is left to the full one."""


def ci() -> list[Case]:
    """The small list: six causes at full strength, plants that hide nothing, one effect of no library."""
    made = [Case("hidden", CI_SEED + place, (one,), days=CI_DAYS) for place, one in CI_CAUSES.items()]
    made += [Case("none", CI_SEED + 50 + place, days=CI_DAYS) for place in range(CI_NULLS)]
    return [*made, Case("outside", CI_SEED + 80, (("neighbour_exhaust", 0),), days=CI_DAYS)]


def chosen(
    cases: Iterable[Case], groups: Sequence[str] | None = None, causes: Sequence[str] | None = None
) -> list[Case]:
    """The cases of some groups that hide one of some causes ("none": nothing)."""
    found = [case for case in cases if not groups or case.group in groups]
    if causes:
        found = [case for case in found if set(causes) & ({cause for cause, _ in case.causes} or {"none"})]
    return found
