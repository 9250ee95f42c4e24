"""Independent calls on several threads: the compiled loops release the interpreter's lock, so two of them take two cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")

THREADS = "HYGROKF_THREADS"
"""Environment variable with the largest number of threads; workers that share the cores already set it to 1."""


def threads() -> int:
    """How many threads compiled loops may run on: the stated number, else the cores that this process may use."""
    stated = os.environ.get(THREADS, "")
    if stated.isdigit() and int(stated) > 0:
        return int(stated)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def mapped(function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """`function` of every item, in their order; the first error that was raised is raised."""
    known = list(items)
    count = min(threads(), len(known))
    if count < 2:
        return [function(one) for one in known]
    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(function, known))
