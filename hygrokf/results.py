"""A fit on disk: `fit.json` and `series.npz` in one directory, each written whole or not at all."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from hygrokf.files import write_bytes_whole, write_text_whole
from hygrokf.fit import Fit


class ResultFault(Exception):
    """A result file that cannot be read, in one message."""


def write_fit(fit: Fit, directory: Path) -> Path:
    """Write `fit.json` and `series.npz`; returns the path of fit.json."""
    directory.mkdir(parents=True, exist_ok=True)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **fit.series)
    write_bytes_whole(directory / "series.npz", buffer.getvalue())
    write_text_whole(directory / "fit.json", dump(fit.to_json()))
    return directory / "fit.json"


def dump(data: Mapping) -> str:
    """JSON text; numbers that JSON cannot hold (NaN, ±∞) become null."""
    return json.dumps(_plain(data), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _plain(value: object) -> object:
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def read_fit(path: Path) -> Fit:
    """A fit from fit.json (or its directory); raises ResultFault with the reason and what to do."""
    file = path / "fit.json" if path.is_dir() else path
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ResultFault(
            f"{file}: expected a result of `hygrokf fit`, found no such file; run `hygrokf fit` first"
        ) from None
    except (OSError, ValueError) as fault:
        raise ResultFault(
            f"{file}: expected JSON written by `hygrokf fit`, found {fault}; run `hygrokf fit` again"
        ) from None
    needed = {"name", "design", "parameters", "time_constants"}
    missing = sorted(needed - set(data)) if isinstance(data, dict) else sorted(needed)
    if missing:
        raise ResultFault(f"{file}: not a result of `hygrokf fit`: it lacks {', '.join(missing)}")
    try:
        return Fit.from_json(data)
    except (KeyError, TypeError, ValueError) as fault:
        raise ResultFault(
            f"{file}: written by another version of hygrokf or damaged ({fault}); run `hygrokf fit` again"
        ) from None
