"""A discovery on disk: `discovery.json`, `discovery.npz`, and the model that it ends with as a fit beside
them."""

from __future__ import annotations

import io
import math
import os
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hygrokf.data.drawn import drawn
from hygrokf.data.files import DISCOVERY, DISCOVERY_SERIES, write_bytes_whole, write_text_whole
from hygrokf.data.result_file import ResultFault, read_result, result_text
from hygrokf.discovery.discovery_results import DiscoveryResults
from hygrokf.discovery.residuals import Residuals
from hygrokf.identification.fit import write_fit

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from hygrokf.discovery.procedure import Discovery

WHICH = ("before", "after")
AGAIN = "run `hygrokf discover` with --out on this directory first"


@dataclass(frozen=True)
class Discovered:
    """The content of a discovery's page: its results, and the residuals of both models."""

    results: DiscoveryResults
    before: Residuals | None = None
    after: Residuals | None = None

    def plot(self, axes: Axes | Sequence[Axes] | None = None) -> tuple[Axes, ...]:
        """The picture of the page on matplotlib's axes, as `Discovery.plot` draws it."""
        return drawn("plot_discovery", self, axes)


def write_discovery(found: Discovery, directory: str | os.PathLike[str]) -> Path:
    """Write `discovery.json` and `discovery.npz`, and the extended model (the base without one) as `fit.json`
    and `series.npz`; returns the path of discovery.json.

    Pages of earlier results in the directory are removed first.  Raises OSError as the system gives it.
    """
    folder = Path(directory)
    write_fit(found.extended or found.base, folder)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **_arrays(found))  # type: ignore[arg-type]  # its flag is a keyword too
    write_bytes_whole(folder / DISCOVERY_SERIES, buffer.getvalue())
    return write_text_whole(folder / DISCOVERY, result_text(found.results))


def read_discovery(directory: str | os.PathLike[str]) -> Discovered:
    """The discovery of a directory; raises ResultFault that lists all faults."""
    folder = Path(directory)
    faults: list[str] = []
    results = None
    try:
        results = read_result(DiscoveryResults, folder / DISCOVERY, "hygrokf discover")
    except ResultFault as fault:
        faults.append(str(fault))
    path = folder / DISCOVERY_SERIES
    residuals: dict[str, Residuals | None] = {}
    try:
        with open(path, "rb") as stream, np.load(stream, allow_pickle=False) as file:
            arrays = {name: np.asarray(file[name]) for name in file.files}
        residuals = {which: _residuals(arrays, which) for which in WHICH}
    except FileNotFoundError:
        faults.append(f"{path}: no such file; {AGAIN}")
    except (OSError, ValueError, EOFError, KeyError, AttributeError, TypeError, zipfile.BadZipFile) as fault:
        faults.append(f"{path}: expected arrays written by `hygrokf discover`, found: {fault}; {AGAIN}")
    if results is None or faults:
        raise ResultFault("\n".join(faults))
    return Discovered(results, **residuals)


def _arrays(found: Discovery) -> dict[str, np.ndarray]:
    """Every array of both residuals under "which/field" or "which/field/name"."""
    result = {}
    for which in WHICH:
        one = getattr(found, which)
        for field in fields(one) if one is not None else ():
            value = getattr(one, field.name)
            parts = value.items() if isinstance(value, Mapping) else [(None, value)]
            for name, array in parts:
                result["/".join(filter(None, (which, field.name, name)))] = np.asarray(array)
    return result


def _residuals(arrays: Mapping[str, np.ndarray], which: str) -> Residuals | None:
    """Residuals from the arrays of `_arrays`; None where there are none."""
    found: dict[str, Any] = {}
    for key, array in arrays.items():
        head, *path = key.split("/", 2)
        if head != which:
            continue
        if len(path) == 2:
            found.setdefault(path[0], {})[path[1]] = array
        elif path[0] == "name":
            found["name"] = str(array)
        else:
            found[path[0]] = array if array.ndim else float(array)
    if not found:
        return None
    if not math.isfinite(found.get("origin_s", math.nan)):
        raise ValueError(f"no {which}/origin_s")
    found.setdefault("drivers", {})
    return Residuals(**found)
