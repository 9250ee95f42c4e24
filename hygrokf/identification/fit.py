"""An identified model with everything needed to repeat it, use it elsewhere and report it, and its files.

A fit on disk is `fit.json` and `series.npz` in one directory, each written atomically.
"""

from __future__ import annotations

import io
import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np

from hygrokf.data.actuators import ACTUATORS
from hygrokf.data.files import (
    BESIDE_DISCOVERY,
    DISCOVERY,
    DISCOVERY_SERIES,
    FIT,
    REPORT,
    SUMMARIES,
    write_bytes_whole,
    write_text_whole,
)
from hygrokf.data.readings import mask
from hygrokf.data.record import Record, expect_record
from hygrokf.data.result_file import ResultFault, drawn, read_arrays, read_json, result_text, with_units
from hygrokf.data.structured import JsonObject, StructureFault, plain, structured
from hygrokf.data.toml_form import FormFault, read_toml
from hygrokf.estimation.likelihood import Likelihood
from hygrokf.estimation.subject import IDENTIFICATION, WHOLE_RECORD
from hygrokf.identification.fit_results import FitResults
from hygrokf.identification.verdict import inherited, with_verdicts
from hygrokf.identification.verdict_terms import verdict_lines
from hygrokf.modelling.derived_inputs import feature_faults
from hygrokf.modelling.design import Design, read_as
from hygrokf.modelling.inputs import model_inputs
from hygrokf.modelling.library import LIBRARY, Library
from hygrokf.version import __version__

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame


SERIES_FILE = "series.npz"


class LibraryAbsent(ResultFault):
    """A fit whose model has mechanisms from a user's file or package that is not loaded."""


@dataclass(frozen=True)
class Fit:
    """An identified model: everything needed to repeat it and to use it elsewhere.

    name: of the record.
    design, values: the model, and its parameters in their units.
    results: what `fit.json` says; time constants [h] with bounds in `results.time_constants`, errors and
        verdicts beside them.
    series: arrays (T,) for figures, in the units of their signals.

    A fit can be pickled; `write_fit` and `read_fit` keep it in files.
    """

    name: str
    design: Design
    values: Mapping[str, float]
    results: FitResults = field(default_factory=FitResults)
    series: Mapping[str, np.ndarray] = field(default_factory=dict)

    @property
    def covariance(self) -> tuple[tuple[str, ...], np.ndarray]:
        """Names and covariance (r, r) of the parameters that have one, in their own units."""
        found = self.results.covariance
        count = len(found.names)
        return found.names, found.matrix.reshape(count, -1) if count else np.empty((0, 0))

    @property
    def fixed(self) -> dict[str, float]:
        """The parameters that were not estimated, with their values in their units."""
        return {name: row.value for name, row in self.results.parameters.items() if row.fixed}

    def likelihood(self, record: Record, part: str = IDENTIFICATION) -> Likelihood:
        """The likelihood of a record under this model.

        record: the one that was identified, or another with the inputs that the model reads.
        part: "identification" (the readings up to `record.until_s`) or "whole".

        Returns the `Likelihood`, whose `timeline.part` says which part it holds.  On the identification part
        of the fit's own record `likelihood(record).value(fit.values)` is `fit.results.loglik`.
        Raises ValueError for anything but a record, and for another part; KeyError for a missing input.
        """
        if part not in (IDENTIFICATION, WHOLE_RECORD):
            raise ValueError(f"part: expected {IDENTIFICATION!r} or {WHOLE_RECORD!r}, found {part!r}")
        whole = mask(expect_record(record, "likelihood"))
        return likelihood_on(self.design, whole if part == WHOLE_RECORD else whole.identification(), part)

    def to_json(self) -> JsonObject:
        """The data of `fit.json`."""
        data: dict[str, Any] = plain(self.results)
        return data

    @classmethod
    def from_json(cls, data: JsonObject, library: Library = LIBRARY) -> Fit:
        """A fit from the data of `to_json`; verdicts that the data lack are decided from the data.

        library: with the mechanisms of its model.

        Raises StructureFault with every fault and its place.
        """
        results = with_verdicts(structured(FitResults, dict(data)))
        if results.design is None:
            raise ValueError("design: expected, and missing")
        values = {name: row.value for name, row in results.parameters.items()}
        design = replace(results.design, library=library)
        return cls(results.name, design, values, replace(results, design=design))

    def to_frame(self) -> DataFrame:
        """The time constants with bounds [h] and verdicts as a pandas data frame, one row each."""
        from pandas import DataFrame

        rows = {
            part: (one.value_h, one.lower_h, one.upper_h, one.words)
            for part, one in inherited(self.results).items()
        }
        columns = ["value [h]", "lower bound [h]", "upper bound [h]", "verdict"]
        frame = DataFrame.from_dict(rows, orient="index", columns=columns)
        return with_units(frame, dict.fromkeys(columns[:3], "h"))

    def plot(self, axes: Axes | Sequence[Axes] | None = None) -> tuple[Axes, ...]:
        """Readings and free run with its 95 % band after the identification period, or in the last fortnight.

        axes: matplotlib's; one, or one for each panel: temperature [°C], humidity [g/m³].
            None: a new figure of pyplot, in the style of the reports.

        Returns the axes that were drawn on; nothing is shown.  Raises HygrokfError where the picture's
        data or matplotlib are missing, ValueError for more axes than panels.
        """
        return drawn(self, axes)

    def __str__(self) -> str:
        """The name with its time constants and their verdicts, and what they were identified on."""
        found = self.results
        lines = [self.name, *verdict_lines(inherited(found))]
        if math.isfinite(found.loglik):
            ends = (found.period.start, found.period.until or found.period.end)
            span = " … ".join(f"{one[:16]}Z" for one in ends if one)
            lines.append(f"ln L {found.loglik:.2f} of {found.n_obs} readings, identification part {span}")
        return "\n".join(lines)

    __repr__ = __str__

    def _repr_html_(self) -> str:
        """The table of the time constants, for a notebook."""
        return str(self.to_frame().to_html())


def likelihood_on(design: Design, record: Record, part: str) -> Likelihood:
    """The likelihood of a design on a record that is this part of another one."""
    own = read_as(design, record)
    return Likelihood(own.model, replace(model_inputs(own, record).timeline, part=part))


# --- files -----------------------------------------------------------------------------------


def write_fit(fit: Fit, directory: str | os.PathLike[str]) -> Path:
    """Write a fit as `fit.json` and `series.npz`.

    fit: of `identify`.
    directory: made if absent; pages and a discovery of earlier results in it are removed first, because they
        belong to other numbers.

    Returns the path of fit.json.  Raises OSError from the system.
    """
    directory = Path(directory)
    text, buffer = result_text(fit.results), io.BytesIO()
    # numpy types the arrays' names as if one of them could be its own option allow_pickle
    np.savez_compressed(buffer, **fit.series)  # type: ignore[arg-type]
    directory.mkdir(parents=True, exist_ok=True)
    for name in (REPORT, BESIDE_DISCOVERY, DISCOVERY, DISCOVERY_SERIES, *SUMMARIES):
        (directory / name).unlink(missing_ok=True)
    write_bytes_whole(directory / SERIES_FILE, buffer.getvalue())
    return write_text_whole(directory / FIT, text)


def read_fit(path: str | os.PathLike[str], series: bool = False, *, library: Library = LIBRARY) -> Fit:
    """Read a fit that `write_fit` or `hygrokf fit` wrote.

    path: of fit.json, or of its directory.
    series: whether to read `series.npz` beside it too, which `Fit.plot` needs.
    library: with the mechanisms of the model (`load_library`), where they are not the package's.

    Returns the fit.  Raises ResultFault with the reason and the remedy, and LibraryAbsent where the library
    lacks mechanisms of the model or has others of their names.
    """
    path = Path(path)
    file = path / FIT if path.is_dir() else path
    try:
        data = read_json(file, "hygrokf fit")
    except ResultFault:
        if _is_case(file):
            raise ResultFault(
                f"{file} is a case file, expected a result of `hygrokf fit`; the fit comes first, as in "
                "`hygrokf evaluate FIT CASE`"
            ) from None
        raise
    needed = {"name", "version", "design", "parameters", "covariance", "time_constants"}
    missing = sorted(needed - set(data)) if isinstance(data, dict) else sorted(needed)
    if missing:
        raise ResultFault(
            f"{file}: not a result of `hygrokf fit`: it lacks {', '.join(missing)}; "
            "name the fit.json that `hygrokf fit` wrote"
        )
    if _release(data["version"]) > _release(__version__):
        raise ResultFault(
            f"{file}: written by hygrokf {data['version']}, this is {__version__}; "
            "install that version, or run `hygrokf fit` again"
        )
    try:
        lacking = library.absent(data["design"].get("origins", {}))
        if lacking:
            raise LibraryAbsent(f"{file}: {'; '.join(lacking)}")
        fit = Fit.from_json(data, library)
        faults = _faults(fit)
    except StructureFault as fault:
        faults = list(fault.faults)
    except (AttributeError, KeyError, TypeError, ValueError) as fault:
        faults = [f"{type(fault).__name__} {fault}"]
    if faults:
        raise ResultFault(
            f"{file}: damaged, or of another version than hygrokf {__version__} (it states "
            f"{data['version']}): {'; '.join(faults)}; run `hygrokf fit` again"
        )
    return replace(fit, series=read_series(file.parent)) if series else fit


def read_series(directory: str | os.PathLike[str]) -> dict[str, np.ndarray]:
    """The arrays of `series.npz` in a directory.  Raises ResultFault with the reason and the remedy."""
    path = Path(directory) / SERIES_FILE
    again = f"run `hygrokf fit` with --out {path.parent} first"
    series = read_arrays(path, "hygrokf fit")
    if text := [name for name, value in series.items() if value.dtype.kind not in "fiub"]:
        found = ", ".join(sorted(text))
        raise ResultFault(f"{path}: expected numbers, found text or objects in {found}; {again}")
    return series


def _is_case(file: Path) -> bool:
    """Whether a file is TOML that names sources, as a case file does."""
    try:
        return not {"source", "weather", "identification"}.isdisjoint(read_toml(file)[1])
    except FormFault:
        return False


def _release(version: Any) -> tuple[int, ...]:
    """Major and minor number of a version; (0, 0) for anything that is not a version."""
    found = re.match(r"(\d+)\.(\d+)", version) if isinstance(version, str) else None
    return (int(found[1]), int(found[2])) if found else (0, 0)


def _faults(fit: Fit) -> list[str]:
    """Faults that prevent the use of a fit: values and covariance must belong to its model."""
    faults = []
    for p in fit.design.model.parameters:
        value = fit.values.get(p.name)
        if not is_number(value):
            faults.append(f"parameter {p.name}: expected a number, found {value!r}")
        elif not p.lower * (1 - 1e-9 * math.copysign(1, p.lower)) <= value <= p.upper * (1 + 1e-9):
            faults.append(f"parameter {p.name}: expected {p.lower:g} … {p.upper:g} {p.unit}, found {value:g}")
    names, matrix = fit.covariance
    unknown = sorted(set(names) - {p.name for p in fit.design.model.parameters})
    if unknown:
        faults.append(f"covariance of unknown parameters {', '.join(unknown)}")
    if matrix.shape != (len(names), len(names)) or not np.all(np.isfinite(matrix)):
        finite = int(np.isfinite(matrix).sum())
        faults.append(f"covariance: expected {len(names)} × {len(names)} finite numbers, found {finite}")
    if len(set(names)) < len(names):
        faults.append("covariance: expected every parameter once, found some twice")
    return faults + _design_faults(fit.design)


def _design_faults(design: Design) -> list[str]:
    """Faults of the constants with which a design makes inputs from a record."""
    faults = []
    scale, order, mean = design.power_scale_W, design.power_order, design.power_mean
    if scale is not None and not (is_number(scale) and scale > 0):
        faults.append(f"design.power_scale_W: expected a number above 0 or null, found {scale!r}")
    if type(order) is not int or order < 0:
        faults.append(f"design.power_order: expected a whole number from 0 on, found {order!r}")
    elif not all(map(is_number, mean)) or len(mean) not in (0, order + 1):
        faults.append(f"design.power_mean: expected {order + 1} numbers or none, found {list(mean)!r}")
    for kind, count in (("averaged", 1), ("ambient_noise", 2), ("scales", 4)):
        for name, found in getattr(design, kind).items():
            numbers = (found,) if count == 1 else found
            positive = numbers[:3]  # the top of a scale may be 0
            if len(numbers) != count or not all(map(is_number, numbers)) or min(positive) <= 0:
                words = f"{count} number{'s' if count > 1 else ''}"
                faults.append(f"design.{kind}.{name}: expected {words} above 0, found {found!r}")
    for name, found in design.actuator_means.items():
        if name not in ACTUATORS or not is_number(found):
            faults.append(
                f"design.actuator_means: expected numbers of {', '.join(ACTUATORS)}, found {name} = {found!r}"
            )
    known = design.library.features
    faults += [f"design.features.{fault}" for fault in feature_faults(design.features, known)]
    return faults


def is_number(value: Any) -> TypeGuard[float]:
    """Whether a value from a file is a finite number."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
