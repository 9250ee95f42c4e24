"""The time that a discovery may take."""

from __future__ import annotations

import math
import time

SECONDS = 120.0
"""[s] a discovery's time where nothing is stated."""
FOR_TRIALS = 0.6
"""Share of it for candidates: what was found by then has to be estimated to the end, judged and told."""


class BudgetSpent(Exception):
    """The time for candidates is over."""


class Budget:
    """Wall-clock time from now on, `seconds` in all; infinite for results that do not depend on the
    machine."""

    def __init__(self, seconds: float = math.inf) -> None:
        if not seconds > 0.0:
            raise ValueError(f"budget: expected seconds above 0, found {seconds}")
        self.seconds = seconds
        self._until = time.monotonic() + FOR_TRIALS * seconds if math.isfinite(seconds) else math.inf

    @property
    def spent(self) -> bool:
        """Whether the time for candidates is over."""
        return time.monotonic() > self._until

    def check(self) -> None:
        """Raise BudgetSpent where the time for candidates is over."""
        if self.spent:
            raise BudgetSpent
