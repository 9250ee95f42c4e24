"""The climate in a fitted cabinet: one `Study` of one or several regions, and the files that hold it."""

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
"""Of the numbers of a climate, by name."""
LIMIT_UNITS = {"hours": "h/a", "number": "1/a", "longest_h": "h"}
"""Of the numbers of a limit."""


@dataclass(frozen=True)
class YearSpan:
    """One simulated year: first and last instant [UTC], hours [h] with known weather and power, and the share
    of these [1] in operation."""

    hours_known: float
    operating_share: float
    start: Instant
    end: Instant

    @property
    def hours_covered(self) -> float:
        """[h] from the first to the last instant, gaps included."""
        first, last = (np.datetime64(one.removesuffix("Z"), "s") for one in (self.start, self.end))
        return float((last - first) / np.timedelta64(1, "h")) + 1.0


@dataclass(frozen=True, eq=False)
class DurationCurve:
    """Values that are exceeded for each share of the time [1] (`share_beyond`), with bounds of a single year,
    and those of the weather (`outside`)."""

    share_beyond: np.ndarray
    value: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    outside: np.ndarray

    def __post_init__(self) -> None:
        expect_shape(self.share_beyond.shape, vars(self))


@dataclass(frozen=True, eq=False)
class JointDistribution:
    """Hours a year [h] by temperature [°C] and relative humidity [%], with bounds, and those of the weather.

    Edges (I+1,) and (J+1,) of the bins; the others (I, J).
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

    `files` of the weather and its `provenance`.  `statements` on weather, power and bounds; `warnings` of the
    weather's readers.
    `part_of_year`: its length where no year is known well enough to stand for one.
    `bounds_hold`, `mean_bounds_hold`: shares [1] of single years, and of means, that the bounds hold.
    `scopes`: numbers (`climate.statistics.STATISTICS`) by scope and name; `outside`: those of the weather.
    `duration`, `rates`: duration curves by quantity.  Without humidity there is no class of wetness, no joint
    distribution and no test profile.
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
        """The worst verdict on its limits: "fail", "undecided" or "pass"; empty without limits."""
        found = {limit.verdict for limit in self.limits}
        return next((verdict for verdict in ("fail", "undecided", "pass") if verdict in found), "")


@dataclass(frozen=True, eq=False, repr=False)
class Study:
    """The climate in a fitted cabinet under the weather of one or several regions.

    `name` of the fit and the `version` that simulated it.  `members` of the ensemble, its `seed`, and the
    `level` [1] of its bounds.  `verdicts`: the fit's time constants, by part.  `provenance` of the
    fit's record.
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
        """The provenance of what all of it rests on: the fit's record and the weather of every region."""
        return least_measured((self.provenance, *(region.provenance for region in self.regions)))

    def rows(self) -> Iterator[dict[str, str | float]]:
        """Every single number, by region, scope and name, with its bounds and unit; limits follow with scope
        "limit".  `outside` is NaN where the weather has none."""
        for region in self.regions:
            numbers = [
                (scope, name, STATISTIC_UNITS.get(name, "1"), one)
                for scope, by_name in region.scopes.items()
                for name, one in by_name.items()
            ]
            numbers += [
                ("limit", f"{limit.name}: {part}", unit, getattr(limit, part))
                for limit in region.limits
                for part, unit in LIMIT_UNITS.items()
            ]
            for scope, name, unit, one in numbers:
                weather = region.outside.get(name, math.nan) if scope == "all" else math.nan
                place = {"region": region.name, "scope": scope, "statistic": name}
                yield {**place, **vars(one), "outside": weather, "unit": unit}

    def plot(self, axes: Axes | Sequence[Axes] | None = None) -> tuple[Axes, ...]:
        """Hours a year by temperature [°C] and relative humidity [%], else duration curves; or the regions.

        axes: matplotlib's; one, or one for each panel (cabinet and weather; quantities).
            None: a new figure of pyplot, in the style of the reports.

        Returns the axes that were drawn on; nothing is shown.  Raises HygrokfError where the picture's
        data or matplotlib are missing, ValueError for more axes than panels.
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
    for old in folder.glob("test_profile*.csv"):  # of regions that are no longer there
        old.unlink()
    for name in SUMMARIES:  # of other numbers
        (folder / name).unlink(missing_ok=True)
    write_text_whole(folder / TABLE, climate_csv(study))
    for name, text in profile_files(study).items():
        write_text_whole(folder / name, text)
    return write_text_whole(folder / CLIMATE, result_text(study))


def read_climate(directory: str | os.PathLike[str]) -> Study:
    """A climate from its directory; raises ResultFault with everything that is wrong, and where."""
    return read_result(Study, Path(directory) / CLIMATE, "hygrokf climate")


def climate_csv(study: Study) -> str:
    """All single numbers, one row for each region, scope and statistic; limits with scope "limit"."""
    table = study.to_frame().drop(columns="unit").astype({"outside": object})  # unrounded
    return str(table.to_csv(float_format="%.6g", lineterminator="\n"))


def profile_files(study: Study) -> dict[str, str]:
    """Test profiles by file name: test_profile.csv, or test_profile_REGION.csv for several regions."""
    found: dict[str, str] = {}
    several = len(study.regions) > 1
    for number, region in enumerate(study.regions, 1):
        profile = region.test_profile
        if profile is None:
            continue
        short = re.sub(r"[^A-Za-z0-9]+", "_", region.name).strip("_") or str(number)
        name = f"test_profile_{short}.csv" if several else "test_profile.csv"
        if name in found:
            name = f"test_profile_{short}_{number}.csv"
        columns = ("temperature_degC", "relative_humidity_percent", "site_temperature_degC")
        rows = zip(
            range(len(profile.temperature_degC)),
            *(getattr(profile, column) for column in columns),
            strict=True,
        )
        head = ",".join(("hour", *columns))
        found[name] = "\n".join([head, *(",".join(f"{v:g}" for v in row) for row in rows), ""])
    return found
