"""Shares with their bounds, shares under weights, and quantiles."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass


def clopper_pearson(hits: float, n: float, level: float = 0.95) -> tuple[float, float]:
    """Bounds of a probability of which `hits` of `n` were seen: never narrower than they say.

    Quantiles of beta distributions (Clopper and Pearson 1934, Biometrika 26, 404); (0, 1) where nothing was
    seen. hits, n need not be whole: effective numbers of a weighted sample.
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

    def to_json(self) -> dict:
        low, high = self.bounds
        return {"hits": self.hits, "n": self.n, "share": self.share, "lower": low, "upper": high}


def rate(hits: Iterable[bool]) -> Rate:
    """How many of them hold."""
    seen = [bool(one) for one in hits]
    return Rate(sum(seen), len(seen))


@dataclass(frozen=True)
class WeightedShare:
    """Share of the weight that hits, of `n` cases that count as `effective` equal ones (Kish)."""

    share: float
    n: int
    effective: float

    @property
    def bounds(self) -> tuple[float, float]:
        """95 % bounds, as if of so many equal cases."""
        return clopper_pearson(self.share * self.effective, self.effective)

    def __str__(self) -> str:
        low, high = self.bounds
        return (
            f"{100 * self.share:.0f} % ({100 * low:.0f} … {100 * high:.0f}), n = {self.n}, effective "
            f"{self.effective:.0f}"
        )

    def to_json(self) -> dict:
        low, high = self.bounds
        return {"share": self.share, "n": self.n, "effective": self.effective, "lower": low, "upper": high}


def weighted_share(hits: Sequence[bool], weights: Sequence[float]) -> WeightedShare | None:
    """Share of the weight that hits; None of nothing."""
    total = sum(weights)
    if total <= 0.0:
        return None
    held = sum(w for hit, w in zip(hits, weights, strict=True) if hit)
    return WeightedShare(min(held / total, 1.0), len(weights), total**2 / sum(w * w for w in weights))


def quantile(values: Sequence[float], share: float) -> float | None:
    """Quantile by straight lines between the ordered values."""
    if not values:
        return None
    ordered = sorted(values)
    place = share * (len(ordered) - 1)
    low = math.floor(place)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (place - low) * (ordered[high] - ordered[low])
