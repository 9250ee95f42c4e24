"""CPU times of interleaved runs, figures with targets, and their table."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass

import numpy as np

SLICE_S = 0.01
"""[s] CPU time that one measured slice should take at least: quick calls are repeated within it."""


@dataclass(frozen=True)
class Times:
    """CPU seconds (R,) of one call in every repetition."""

    seconds: np.ndarray

    @property
    def median(self) -> float:
        return float(np.median(self.seconds))

    @property
    def spread(self) -> tuple[float, float]:
        """Quartiles."""
        low, high = np.quantile(self.seconds, [0.25, 0.75])
        return float(low), float(high)

    def __mul__(self, factor: float) -> Times:
        return Times(self.seconds * factor)


def ratio(slow: Times, fast: Times) -> Times:
    """How many times longer one takes than the other, repetition by repetition."""
    return Times(slow.seconds / fast.seconds)


def interleaved(contenders: Mapping[str, Callable[[], object]], repetitions: int) -> dict[str, Times]:
    """CPU time of one call of every contender, all of them taking turns `repetitions` times."""
    calls = {}
    for name, run in contenders.items():
        run()  # compiles, allocates, fills caches
        calls[name] = max(1, math.ceil(SLICE_S / max(_cpu(run, 1), 1e-7)))
    found: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(repetitions):
        for name, run in contenders.items():
            found[name].append(_cpu(run, calls[name]) / calls[name])
    return {name: Times(np.array(values)) for name, values in found.items()}


def _cpu(run: Callable[[], object], calls: int) -> float:
    begin = time.process_time()
    for _ in range(calls):
        run()
    return time.process_time() - begin


def repeated(run: Callable[[], object], repetitions: int) -> Times:
    """CPU time of a long call."""
    return Times(np.array([_cpu(run, 1) for _ in range(repetitions)]))


@dataclass(frozen=True)
class Figure:
    """One number: `reached` with its quartiles, and the target, `at_most` or `at_least` (None: told, not
    judged)."""

    section: str
    name: str
    unit: str
    reached: float
    low: float | None = None
    high: float | None = None
    at_most: float | None = None
    at_least: float | None = None
    note: str = ""

    @property
    def met(self) -> bool | None:
        if self.at_most is not None:
            return self.reached <= self.at_most
        return self.reached >= self.at_least if self.at_least is not None else None

    def to_json(self) -> dict:
        return {**asdict(self), "met": self.met}


def timed(section: str, name: str, unit: str, times: Times, **more: object) -> Figure:
    """A figure from times that are already in its unit."""
    low, high = times.spread
    return Figure(section, name, unit, times.median, low, high, **more)


def table(figures: Sequence[Figure], spread: str = "quartiles") -> str:
    """Figure, target, reached (with its quartiles or another `spread`), met or not; the notes below."""
    rows = [("figure", "target", "reached", spread, "met")]
    for f in figures:
        target = "" if f.met is None else f"≤ {f.at_most:g}" if f.at_most is not None else f"≥ {f.at_least:g}"
        range_ = "" if f.low is None else f"{f.low:.3g} … {f.high:.3g}"
        verdict = {True: "yes", False: "NO", None: ""}[f.met]
        rows.append((f"{f.section}: {f.name} [{f.unit}]", target, f"{f.reached:.4g}", range_, verdict))
    widths = [max(len(row[i]) for row in rows) for i in range(5)]
    lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
    lines.insert(1, "-" * max(map(len, lines)))
    notes = [f"{f.section}: {f.name}: {f.note}" for f in figures if f.note]
    return "\n".join([*lines, *([""] if notes else []), *notes])
