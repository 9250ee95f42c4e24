"""Shares with their bounds, stated probabilities against what came, and tables in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.stats import binomtest


def markdown(head: Sequence[object], rows: Iterable[Sequence[object]]) -> str:
    """A table; cells are shown by `str`."""
    lines = ["| " + " | ".join(map(str, row)) + " |" for row in (head, *rows)]
    lines.insert(1, "|" + " --- |" * len(head))
    return "\n".join(lines)


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
        """95 % bounds that are never narrower than they say (Clopper and Pearson, 1934)."""
        found = binomtest(self.hits, self.n).proportion_ci(0.95, "exact")
        return float(found.low), float(found.high)

    def __str__(self) -> str:
        if not self.n:
            return "0/0"
        low, high = self.bounds
        return f"{self.hits}/{self.n} = {100 * self.hits / self.n:.0f} % ({100 * low:.0f} … {100 * high:.0f})"


def rate(hits: Iterable[bool]) -> Rate:
    """How many of them hold."""
    seen = [bool(one) for one in hits]
    return Rate(sum(seen), len(seen))


def between_plants(happened: np.ndarray, seed: np.ndarray, draws: int = 2000) -> tuple[float, float]:
    """95 % bounds of a share with whole plants drawn again, which keeps neighbouring forecasts together."""
    plants = np.unique(seed)
    hits = np.array([happened[seed == p].sum() for p in plants])
    counts = np.array([(seed == p).sum() for p in plants])
    chosen = np.random.default_rng(1).integers(0, len(plants), (draws, len(plants)))
    shares = hits[chosen].sum(axis=1) / counts[chosen].sum(axis=1)
    low, high = np.quantile(shares, (0.025, 0.975))
    return float(low), float(high)


@dataclass(frozen=True)
class Bin:
    """Forecasts whose stated probability lies from `edge` up to the next edge: its mean `said`, and what
    came.

    `rate` has bounds as if every forecast were a trial of its own, `low` and `high` are those between plants.
    """

    edge: float
    said: float
    rate: Rate
    low: float
    high: float


def reliability(
    said: np.ndarray, came: np.ndarray, seed: np.ndarray, edges: Sequence[float]
) -> dict[float, Bin]:
    """Bins of the stated probability (n,) that hold a forecast, by their lower edge; the last holds its upper
    edge, too."""
    found = {}
    for low, high in pairwise(edges):
        here = (said >= low) & ((said < high) | (high == edges[-1]))
        if here.any():
            seen = Rate(int(came[here].sum()), int(here.sum()))
            found[low] = Bin(low, float(said[here].mean()), seen, *between_plants(came[here], seed[here]))
    return found


class Columns:
    """The columns (n,) of a table that is spread over lines, and the line of each row."""

    def __init__(self, lines: Sequence[Mapping], part: str, names: Sequence[str]) -> None:
        tables = [np.array(line[part]).reshape(-1, len(names)) for line in lines]
        self.columns = dict(zip(names, np.concatenate(tables).T, strict=True))
        self.seed = np.repeat([line["seed"] for line in lines], [len(one) for one in tables])
