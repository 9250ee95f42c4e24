"""How long to wait before another attempt: at a source, at the store, at a channel of notices."""

from __future__ import annotations


def pause_s(failed: int, limits_s: tuple[float, float]) -> float:
    """Pause [s] after `failed` attempts in a row, 1 or more: the shortest of its limits at first, then each
    twice as long as the one before, up to the longest."""
    shortest, longest = limits_s
    return min(shortest * 2.0 ** min(failed - 1, 30), longest)
