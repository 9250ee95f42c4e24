"""A climate on disk: `climate.json`, `climate.csv`, and the test profile of each region; each written whole or not at all."""

from __future__ import annotations

import csv
import io
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path

from hygrokf.climate.study import Study
from hygrokf.data.files import CLIMATE, write_text_whole
from hygrokf.identification.results import ResultFault, dump

TABLE = "climate.csv"
_COLUMNS = (
    "region", "scope", "statistic", "value", "lower", "upper", "mean_lower", "mean_upper", "between_years", "outside",
)  # fmt: skip


def write_climate(study: Study, directory: str | os.PathLike[str]) -> Path:
    """Write climate.json, climate.csv and test_profile*.csv; returns the path of climate.json.

    Raises OSError as the system gives it.
    """
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.glob("test_profile*.csv"):  # of regions that are no longer there
        old.unlink()
    data = study.to_json()
    write_text_whole(folder / TABLE, climate_csv(data))
    for name, text in profile_files(data).items():
        write_text_whole(folder / name, text)
    return write_text_whole(folder / CLIMATE, dump(data))


def read_climate(directory: str | os.PathLike[str]) -> Study:
    """A climate from its directory; raises ResultFault with the reason."""
    file = Path(directory) / CLIMATE
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as fault:
        reason = getattr(fault, "strerror", None) or fault
        raise ResultFault(
            f"{file}: expected JSON written by `hygrokf climate`, found {reason}; run `hygrokf climate` again"
        ) from None
    regions = data.get("regions") if isinstance(data, dict) else None
    if not isinstance(regions, list) or not all(isinstance(one, dict) and "scopes" in one for one in regions):
        raise ResultFault(f"{file}: not a result of `hygrokf climate`: it has no regions; run it again")
    return Study(data)


def climate_csv(data: Mapping) -> str:
    """All single numbers, one row for each region, scope and statistic; limits with scope "limit"."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_COLUMNS)
    for region in data["regions"]:
        for scope, rows in region["scopes"].items():
            for name, one in rows.items():
                weather = region["outside"].get(name, "") if scope == "all" else ""
                writer.writerow(_row(region["name"], scope, name, one, weather))
        for limit in region["limits"]:
            for part in ("hours", "number", "longest_h"):
                writer.writerow(_row(region["name"], "limit", f"{limit['name']}: {part}", limit[part], ""))
    return text.getvalue()


def _row(region: str, scope: str, name: str, one: Mapping, weather: object) -> list:
    numbers = (one[key] for key in _COLUMNS[3:9])
    return [region, scope, name, *("" if v is None or v != v else f"{v:.6g}" for v in numbers), weather]


def profile_files(data: Mapping) -> dict[str, str]:
    """Test profiles by file name: test_profile.csv, or test_profile_REGION.csv where there are several regions."""
    found = {}
    several = len(data["regions"]) > 1
    for number, region in enumerate(data["regions"], 1):
        profile = region["test_profile"]
        if profile is None:
            continue
        short = re.sub(r"[^A-Za-z0-9]+", "_", region["name"]).strip("_") or str(number)
        name = f"test_profile_{short}.csv" if several else "test_profile.csv"
        if name in found:
            name = f"test_profile_{short}_{number}.csv"
        columns = ("hour", "temperature_degC", "relative_humidity_percent", "site_temperature_degC")
        rows = zip(*(profile[column] for column in columns), strict=True)
        found[name] = "\n".join([",".join(columns), *(",".join(f"{v:g}" for v in row) for row in rows), ""])
    return found
