"""Forward selection by likelihood ratios alone, after Bacher and Madsen (2011),
doi:10.1016/j.enbuild.2011.02.005.

From the base model on, the cause with the smallest p is added, as long as p < 0.05.  What the package asks
for beyond that is left out: no price for the settings searched, no evidence in days, no held-out period.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

from scipy.stats import chi2

from hygrokf.discovery.candidates import Candidate, candidate, estimated
from hygrokf.discovery.estimate import LIGHT, Calibration
from hygrokf.discovery.forms import ground_of
from hygrokf.discovery.library import LIBRARY
from hygrokf.discovery.screening import parent_of, screened

LEVEL = 0.05
LIMIT_S = 45.0
"""[s] CPU time after which no further cause is tried, with what the base model took."""


@dataclass(frozen=True)
class Search:
    """Candidates in the order in which they were added, the last model, and why it ended: "p" or "time"."""

    added: tuple[Candidate, ...]
    last: Calibration
    ended: str
    tried: int


def log_p(one: Candidate) -> float:
    """ln p of 2 Δ ln L by the χ² law of the constants added; 0 where nothing was gained."""
    gain = sum(one.gains.values())
    return float(chi2.logsf(gain, one.constants)) if gain > 0.0 and one.constants else 0.0


def search(base: Calibration, spent_s: float = 0.0, limit_s: float = LIMIT_S) -> Search:
    """Add the cause of the smallest p while p < 0.05.

    spent_s: [s] that the base model took; of a round that the time cut short, the best of what was tried is
        still added.
    """
    begin = time.process_time() - spent_s
    simulator = base.simulator
    ground = ground_of(simulator.scene.record, simulator.heat, simulator.vapour)
    added: list[Candidate] = []
    last, tried = base, 0
    while True:
        candidates, cut = [], False
        parent = parent_of(last)
        for cause in LIBRARY:
            if cause.name in {one.cause for one in added}:
                continue
            if cut := time.process_time() - begin > limit_s:
                break
            seen = [s for form in cause.forms(ground) if form.grid for s in screened(parent, form)]
            if seen:
                best = max(seen, key=lambda s: s.gain)
                one = estimated(last, best.form, best.setting, best.values, LIGHT, parent.columns)
                candidates.append(candidate(last, one, best.form, best.setting, len(seen)))
        tried += len(candidates)
        best_one = min(candidates, key=log_p, default=None)
        if best_one is None or log_p(best_one) >= math.log(LEVEL):
            return Search(tuple(added), last, "time" if cut else "p", tried)
        added.append(best_one)
        last = best_one.estimate
        if cut:
            return Search(tuple(added), last, "time", tried)
