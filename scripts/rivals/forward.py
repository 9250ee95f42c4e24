"""Forward selection by likelihood ratios alone, after Bacher and Madsen (2011),
doi:10.1016/j.enbuild.2011.02.005.

From the identified base model on, the variant of the library with the smallest p is added, as long as p <
0.05.  What the package asks for beyond that is left out: no price for the settings searched or the number
tried, no free run, no held-out period.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

from scipy.stats import chi2

from hygrokf.discovery.baseline import Baseline
from hygrokf.discovery.candidate import Candidate, attempt
from hygrokf.discovery.library import LIBRARY
from hygrokf.discovery.model_selection import with_candidate

LEVEL = 0.05
LIMIT_S = 45.0
"""[s] CPU time after which no further variant is tried, with what identifying the base model took."""


@dataclass(frozen=True)
class Search:
    """Trials in the order in which they were added, the last baseline, and why it ended: "p" or "time"."""

    added: tuple[Candidate, ...]
    baseline: Baseline
    ended: str
    tried: int


def log_p(candidate: Candidate) -> float:
    """ln p of 2 Δ ln L by the χ² law of the parameters added; 0 where nothing was gained."""
    if candidate.lr <= 0.0 or not candidate.submodels:
        return 0.0
    return float(chi2.logsf(candidate.lr, candidate.parameters))


def search(baseline: Baseline, spent_s: float = 0.0, limit_s: float = LIMIT_S) -> Search:
    """Add the mechanism of the smallest p while p < 0.05.

    spent_s: [s] that the base model took; of a round that the time cut short, the best of what was tried is
        still added.
    """
    begin = time.process_time() - spent_s
    added: list[Candidate] = []
    tried = 0
    while True:
        candidates, cut = [], False
        known = {candidate.variant.cause for candidate in added}
        for cause in LIBRARY:
            if cause.name in known:
                continue
            if cut := time.process_time() - begin > limit_s:
                break
            for variant in cause.variants(baseline):
                candidates.append(attempt(baseline, variant))
        tried += len(candidates)
        best = min(candidates, key=lambda one: (log_p(one), -one.lr), default=None)
        if best is None or log_p(best) >= math.log(LEVEL):
            return Search(tuple(added), baseline, "time" if cut else "p", tried)
        baseline = with_candidate(baseline, best)
        added.append(best)
        if cut:
            return Search(tuple(added), baseline, "time", tried)
