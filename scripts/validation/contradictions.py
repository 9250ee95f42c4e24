"""How often a reading is wrongly said to contradict the estimate, and how often a sensor's step is noticed
with its first reading: docs/validation/live_trials.md."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hygrokf.live.alarms import CONTRADICTION_SD, innovations
from validation.counts import markdown
from validation.frame import Claim
from validation.tracked import DAY_S, SETTLED_S, tracked_plant

STEPS = {"cabinet_temperature": (1.0, 2.0, 3.0, 5.0), "cabinet_relative_humidity": (0.03, 0.05, 0.1, 0.2)}
"""Steps of a sensor's reading [SI unit]."""
UNITS = {"cabinet_temperature": ("K", 1.0), "cabinet_relative_humidity": ("%", 100.0)}


def one(variant: str, seed: int, *, days: float = 60.0, learnt: float = 45.0) -> dict:
    """The innovations of a plant over the days after those that its model was identified on.

    For each signal: readings, days, readings beyond, and of each step the readings with which it would have
    been noticed had it begun with them; steps go up and down by turns.  What the filter predicts for a
    reading does not depend on the reading, so that every reading can be the first one of a step.
    """
    case, begin = tracked_plant(seed, learnt, days)
    found = [one for one in innovations(case.course) if one.time_s > begin + SETTLED_S]
    line: dict = {"days": days - SETTLED_S / DAY_S}
    for signal, steps in STEPS.items():
        z = np.array([each.deviations for each in found if each.signal == signal])
        sd = np.array([each.sd for each in found if each.signal == signal])
        side = np.where(np.arange(len(z)) % 2, 1.0, -1.0)
        line[signal] = {
            "readings": len(z),
            "beyond": int(np.sum(np.abs(z) >= CONTRADICTION_SD)),
            "noticed": [int(np.sum(np.abs(z + side * step / sd) >= CONTRADICTION_SD)) for step in steps],
        }
    return line


def table(lines: Sequence[Mapping]) -> str:
    """False flags, and of each step the share that is noticed with its first reading."""
    rows = []
    for signal, steps in STEPS.items():
        unit, factor = UNITS[signal]
        of = [line[signal] for line in lines]
        count = sum(each["readings"] for each in of)
        shares = (sum(each["noticed"][k] for each in of) / count for k in range(len(steps)))
        said = ", ".join(
            f"{factor * step:g} {unit}: {100.0 * share:.1f} %"
            for step, share in zip(steps, shares, strict=True)
        )
        rows.append((signal, count, sum(each["beyond"] for each in of), said))
    head = ("signal", "readings", "wrongly flagged", "step: noticed with its first reading")
    days = sum(line["days"] for line in lines)
    return f"{len(lines)} plants, {days:.0f} days\n\n{markdown(head, rows)}"


CLAIM = Claim("contradictions", {"contradictions": range(7300, 7320)}, one, table)
