"""What a scenario found, and the table of several."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass


@dataclass(frozen=True)
class Outcome:
    """What was done to a tracker with a seed, and what was found afterwards.

    `blows` how often something was done (kills, full disks, damaged files, payloads), `messages` that were
    sent in all. `missing` and `doubled` observations; `equal` whether the state is the offline filter's, bit
    for bit; `words` what else was seen; `fault` what did not hold, "" where all did.
    """

    scenario: str
    seed: int
    blows: int
    messages: int
    missing: int = 0
    doubled: int = 0
    equal: bool = True
    words: str = ""
    fault: str = ""

    @property
    def held(self) -> bool:
        return self.equal and not (self.missing or self.doubled or self.fault)

    def to_json(self) -> dict:
        return {**asdict(self), "held": self.held}


def table(outcomes: Sequence[Outcome]) -> str:
    """A row for each outcome; what else was seen stands below."""
    rows = [("scenario", "seed", "blows", "messages", "missing", "doubled", "state", "held")]
    for one in outcomes:
        state = "equal" if one.equal else "OTHER"
        numbers = (one.seed, one.blows, one.messages, one.missing, one.doubled)
        rows.append((one.scenario, *(f"{n:,}" for n in numbers), state, "yes" if one.held else "NO"))
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
    lines.insert(1, "-" * max(map(len, lines)))
    said = [f"{o.scenario}, seed {o.seed}: {o.fault or o.words}" for o in outcomes if o.fault or o.words]
    return "\n".join([*lines, *([""] if said else []), *said])
