"""What a payload gave that was not used, counted."""

from __future__ import annotations

from collections import Counter

from hygrokf.live.sources.payload import TurbineReadings


def counted(found: TurbineReadings) -> Counter[str]:
    """Number of rejections by kind."""
    return Counter(one.kind for one in found.rejections)
