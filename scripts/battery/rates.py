"""Shares with their bounds."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass


def clopper_pearson(hits: float, n: float, level: float = 0.95) -> tuple[float, float]:
    """Bounds of a probability of which `hits` of `n` were seen: never narrower than they say.

    Quantiles of beta distributions (Clopper and Pearson 1934, Biometrika 26, 404); (0, 1) where nothing was
    seen.
    """
    from scipy.stats import beta

    if n < 0.0 or not 0.0 <= hits <= n:
        raise ValueError(f"expected 0 ≤ hits ≤ n, found {hits} of {n}")
    tail = 0.5 * (1.0 - level)
    low = 0.0 if hits <= 0.0 else float(beta.ppf(tail, hits, n - hits + 1.0))
    high = 1.0 if hits >= n else float(beta.ppf(1.0 - tail, hits + 1.0, n - hits))
    return low, high


@dataclass(frozen=True)
class Rate:
    """`hits` of `n`."""

    hits: int
    n: int

    @property
    def share(self) -> float | None:
        return self.hits / self.n if self.n else None

    @property
    def bounds(self) -> tuple[float, float]:
        """95 % bounds."""
        return clopper_pearson(self.hits, self.n)

    def __str__(self) -> str:
        if not self.n:
            return "0/0"
        low, high = self.bounds
        return f"{self.hits}/{self.n} = {100 * self.hits / self.n:.0f} % ({100 * low:.0f} … {100 * high:.0f})"


def rate(hits: Iterable[bool]) -> Rate:
    """How many of them hold."""
    seen = [bool(one) for one in hits]
    return Rate(sum(seen), len(seen))
