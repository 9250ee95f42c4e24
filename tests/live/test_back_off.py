"""Pauses between attempts."""

from __future__ import annotations

from hygrokf.live.sources.stream import pause_s


def test_pauses_double_between_their_limits() -> None:
    assert [pause_s(failed, (0.5, 10.0)) for failed in (1, 2, 5, 6, 10**6)] == [0.5, 1.0, 8.0, 10.0, 10.0]
