"""Independent calls on several threads: compiled loops release the interpreter's lock, so that two of them
use two cores."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")
R = TypeVar("R")

THREADS = "HYGROKF_THREADS"
"""Environment variable that limits the number of threads; workers that already share the cores set it to
1."""


def threads() -> int:
    """Number of threads for compiled loops: `$HYGROKF_THREADS`, else the cores available to this process."""
    limit = os.environ.get(THREADS, "")
    if limit.isdigit() and int(limit) > 0:
        return int(limit)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def mapped(function: Callable[[T], R], items: Iterable[T]) -> list[R]:
    """`function` applied to every item, in order; raises the first error that a call raised."""
    item_list = list(items)
    count = min(threads(), len(item_list))
    if count < 2:
        return [function(item) for item in item_list]
    with ThreadPoolExecutor(count) as pool:
        return list(pool.map(function, item_list))
