"""A climate on disk: `climate.json`, `climate.csv`, and the test profile of each region; each file is written
whole or not at all."""

from __future__ import annotations

import csv
import io
import json
import os
import re
from pathlib import Path

from hygrokf.climate.study import Study, StudyRow
from hygrokf.data.files import CLIMATE, write_text_whole
from hygrokf.data.result_file import ResultFault, result_text
from hygrokf.data.structured import StructureFault, plain, structured

TABLE = "climate.csv"


def write_climate(study: Study, directory: str | os.PathLike[str]) -> Path:
    """Write climate.json, climate.csv and test_profile*.csv; returns the path of climate.json.

    Raises OSError from the system.
    """
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("test_profile*.csv"):  # of regions that are no longer there
        old.unlink()
    write_text_whole(folder / TABLE, climate_csv(study))
    for name, text in profile_files(study).items():
        write_text_whole(folder / name, text)
    return write_text_whole(folder / CLIMATE, result_text(plain(study)))


def read_climate(directory: str | os.PathLike[str]) -> Study:
    """A climate from its directory; raises ResultFault with everything that is wrong, and where."""
    file = Path(directory) / CLIMATE
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as fault:
        reason = getattr(fault, "strerror", None) or fault
        raise ResultFault(
            f"{file}: expected JSON written by `hygrokf climate`, found {reason}; run `hygrokf climate` again"
        ) from None
    try:
        return structured(Study, data)
    except StructureFault as fault:
        version = data.get("version") if isinstance(data, dict) else None
        writer = f", written by hygrokf {version}" if isinstance(version, str) else ""
        faults = "\n  ".join(fault.faults)
        raise ResultFault(
            f"{file}: expected a result of `hygrokf climate`{writer}; run it again. Found\n  {faults}"
        ) from None


def climate_csv(study: Study) -> str:
    """All single numbers, one row for each region, scope and statistic; limits with scope "limit"."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(StudyRow._fields)
    for row in study.rows():
        numbers = ["" if one != one else f"{one:.6g}" for one in row[3:9]]
        writer.writerow([*row[:3], *numbers, "" if row.outside != row.outside else row.outside])
    return text.getvalue()


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
        columns = ("hour", "temperature_degC", "relative_humidity_percent", "site_temperature_degC")
        rows = zip(*(getattr(profile, column) for column in columns), strict=True)
        found[name] = "\n".join([",".join(columns), *(",".join(f"{v:g}" for v in row) for row in rows), ""])
    return found
