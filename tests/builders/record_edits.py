"""Records with some signals left out, or with other values of one signal."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hygrokf.data.record import Record


def without(record: Record, *signals: str) -> Record:
    """The record without some signals."""
    return replace(record, series=tuple(s for s in record.series if s.signal not in signals))


def changed(
    record: Record, signal: str, value: object, begin_s: float = -np.inf, end_s: float = np.inf
) -> Record:
    """The record with one signal's values replaced from after `begin_s` up to `end_s` [s]."""
    one = record[signal]
    here = (one.time > begin_s) & (one.time <= end_s)
    return record.replace_series(replace(one, value=np.where(here, value, one.value)))
