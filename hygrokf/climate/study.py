"""The result of a climate simulation: a `Study` of one or several regions, and its files."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hygrokf.climate.bounds import BoundedMean, expect_shape
from hygrokf.climate.chamber import ProfilePlan
from hygrokf.climate.chamber_profile import ChamberProfile
from hygrokf.climate.limits import Exceedance
from hygrokf.climate.statistics import STATISTICS
from hygrokf.data.files import CLIMATE, SUMMARIES, write_text_whole
from hygrokf.data.record import Provenance, least_measured
from hygrokf.data.result_file import drawn, read_result, result_text, with_units
from hygrokf.identification.verdict_terms import Inherited
from hygrokf.physics.psychrometrics import Surface
from hygrokf.texts.statement import Statement
from hygrokf.texts.terms import Instant, Name, ReaderText, Source, Version

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from pandas import DataFrame

TABLE = "climate.csv"
STATISTIC_UNITS = {one.name: one.unit for one in STATISTICS}
"""Name of a number of a climate → its unit."""
LIMIT_UNITS = {"hours": "h/a", "number": "1/a", "longest_h": "h"}
"""Field of an `Exceedance` → its unit."""


@dataclass(frozen=True)
class YearSpan:
    """One simulated year: its first and last instant [UTC], the hours [h] with known weather and power, and
    the share of them [1] in operation."""

    hours_known: float
    operating_share: float
    start: Instant
    end: Instant

    @property
    def hours_covered(self) -> float:
        """Hours [h] from the first to the last instant, gaps included."""
        first, last = (np.datetime64(stamp.removesuffix("Z"), "s") for stamp in (self.start, self.end))
        return float((last - first) / np.timedelta64(1, "h")) + 1.0


@dataclass(frozen=True, eq=False)
class DurationCurve:
    """The values that are exceeded for each share of the time [1] (`share_beyond`), with bounds of a single
    year, and those of the weather (`outside`)."""

    share_beyond: np.ndarray
    value: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    outside: np.ndarray

    def __post_init__(self) -> None:
        expect_shape(self.share_beyond.shape, vars(self))


@dataclass(frozen=True, eq=False)
class JointDistribution:
    """Hours a year [h] by temperature [°C] and relative humidity [%] (I, J), with bounds, and those of the
    weather.

    The edges of the bins have the shapes (I+1,) and (J+1,).
    """

    temperature_edges_degC: np.ndarray
    humidity_edges_percent: np.ndarray
    hours: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    outside: np.ndarray

    def __post_init__(self) -> None:
        shape = (len(self.temperature_edges_degC) - 1, len(self.humidity_edges_percent) - 1)
        expect_shape(shape, {name: vars(self)[name] for name in ("hours", "lower", "upper", "outside")})


@dataclass(frozen=True, eq=False)
class RegionClimate:
    """The climate in a cabinet under the weather of one region.

    `files` and `provenance` of the weather. `statements` on weather, power and bounds; `warnings` of the
    weather's readers. `part_of_year`: its length, if no year is known well enough to stand for a whole one.
    `bounds_hold`, `mean_bounds_hold`: probabilities [1] with which the bounds hold a single year, or the mean
    of years. `scopes`: numbers (`climate.statistics.STATISTICS`) by scope and name; `outside`: those of the
    weather. `duration`, `rates`: duration curves by quantity. Without humidity there are no class of wetness,
    joint distribution and test profile.
    """

    name: Name
    files: tuple[Source, ...]
    provenance: Provenance
    statements: tuple[Statement, ...]
    warnings: tuple[ReaderText, ...]
    part_of_year: Statement | None
    bounds_hold: float
    mean_bounds_hold: float
    years: tuple[YearSpan, ...]
    wetness_class: Name | None
    wetness_class_bounds: tuple[Name, Name] | None
    scopes: Mapping[Name, Mapping[Name, BoundedMean]]
    outside: Mapping[Name, float]
    duration: Mapping[Name, DurationCurve]
    rates: Mapping[Name, DurationCurve]
    joint: JointDistribution | None
    limits: tuple[Exceedance, ...]
    test_profile: ChamberProfile | None

    def __post_init__(self) -> None:
        if "all" not in self.scopes or not self.years:
            raise ValueError("expected at least one year, and numbers of all of it in scopes.all")

    @property
    def year(self) -> Mapping[str, BoundedMean]:
        """The numbers of the whole year by name."""
        return self.scopes["all"]

    @property
    def verdict(self) -> str:
        """The worst verdict on the limits: "fail", "undecided" or "pass"; "" without limits."""
        verdicts = {limit.verdict for limit in self.limits}
        return next((verdict for verdict in ("fail", "undecided", "pass") if verdict in verdicts), "")


@dataclass(frozen=True, eq=False, repr=False)
class Study:
    """The climate in a fitted cabinet under the weather of one or several regions.

    `name` of the fit; `version` that simulated it; `members` of the ensemble and its `seed`; `level` [1] of
    the bounds; `verdicts` on the fit's time constants; `provenance` of the fit's record.
    """

    name: Name
    version: Version
    members: int
    seed: int
    level: float
    verdicts: Mapping[Name, Inherited]
    surface: Surface
    plan: ProfilePlan
    provenance: Provenance
    regions: tuple[RegionClimate, ...]

    def __post_init__(self) -> None:
        if not self.regions:
            raise ValueError("expected at least one region, found none")

    def __repr__(self) -> str:
        names = ", ".join(region.name for region in self.regions)
        return f"Study({self.name!r}: {names}; {self.members} members, seed {self.seed})"

    @property
    def least_measured(self) -> Provenance:
        """The provenance of everything behind the study: the fit's record and the weather of every region."""
        return least_measured((self.provenance, *(region.provenance for region in self.regions)))

    def rows(self) -> Iterator[dict[str, str | float]]:
        """Yield every number by region, scope and name, with its bounds and unit; limits follow with the
        scope "limit". `outside` is NaN if the weather does not have the number."""
        for region in self.regions:
            numbers = [
                (scope, name, STATISTIC_UNITS.get(name, "1"), number)
                for scope, by_name in region.scopes.items()
                for name, number in by_name.items()
            ]
            numbers += [
                ("limit", f"{limit.name}: {field_name}", unit, getattr(limit, field_name))
                for limit in region.limits
                for field_name, unit in LIMIT_UNITS.items()
            ]
            for scope, name, unit, number in numbers:
                weather = region.outside.get(name, math.nan) if scope == "all" else math.nan
                labels = {"region": region.name, "scope": scope, "statistic": name}
                yield {**labels, **vars(number), "outside": weather, "unit": unit}

    def plot(self, axes: Axes | Sequence[Axes] | None = None) -> tuple[Axes, ...]:
        """Draw the hours a year by temperature and relative humidity; without humidity the duration curves;
        or several regions side by side.

        axes: one or more axes of matplotlib, one for each panel; None: a new figure of pyplot, in the style
            of the reports.

        Returns the axes that were drawn on. Raises HygrokfError if data for the figure or matplotlib are
        missing, ValueError for more axes than panels.
        """
        return drawn(self, axes)

    def to_frame(self) -> DataFrame:
        """The rows as a pandas frame, indexed by region, scope and statistic, with the `unit` of each."""
        import pandas as pd

        return with_units(pd.DataFrame(self.rows()).set_index(["region", "scope", "statistic"]), {})


# --- files -----------------------------------------------------------------------------------


def write_climate(study: Study, directory: str | os.PathLike[str]) -> Path:
    """Write climate.json, climate.csv and test_profile*.csv; returns the path of climate.json.

    Raises OSError from the system.
    """
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("test_profile*.csv"):  # of regions that the study no longer has
        old.unlink()
    for name in SUMMARIES:  # summaries of an earlier study
        (folder / name).unlink(missing_ok=True)
    write_text_whole(folder / TABLE, climate_csv(study))
    for name, text in profile_files(study).items():
        write_text_whole(folder / name, text)
    return write_text_whole(folder / CLIMATE, result_text(study))


def read_climate(directory: str | os.PathLike[str]) -> Study:
    """Read a study from its directory. Raises ResultFault with everything that is wrong in climate.json."""
    return read_result(Study, Path(directory) / CLIMATE, "hygrokf climate")


def climate_csv(study: Study) -> str:
    """All numbers as CSV, one row for each region, scope and statistic; limits with the scope "limit"."""
    table = study.to_frame().drop(columns="unit").astype({"outside": object})  # unrounded
    return str(table.to_csv(float_format="%.6g", lineterminator="\n"))


def profile_files(study: Study) -> dict[str, str]:
    """Return the test profiles as CSV by file name: test_profile.csv; for several regions
    test_profile_REGION.csv."""
    text_by_file: dict[str, str] = {}
    several = len(study.regions) > 1
    for number, region in enumerate(study.regions, 1):
        profile = region.test_profile
        if profile is None:
            continue
        region_in_letters = re.sub(r"[^A-Za-z0-9]+", "_", region.name).strip("_") or str(number)
        name = f"test_profile_{region_in_letters}.csv" if several else "test_profile.csv"
        if name in text_by_file:
            name = f"test_profile_{region_in_letters}_{number}.csv"
        columns = ("temperature_degC", "relative_humidity_percent", "site_temperature_degC")
        rows = zip(
            range(len(profile.temperature_degC)),
            *(getattr(profile, column) for column in columns),
            strict=True,
        )
        head_line = ",".join(("hour", *columns))
        text_by_file[name] = "\n".join(
            [head_line, *(",".join(f"{number:g}" for number in row) for row in rows), ""]
        )
    return text_by_file
