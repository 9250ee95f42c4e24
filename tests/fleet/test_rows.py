"""Rows of a fleet: statements and names in their cells, in files and in tables."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from hygrokf.data.result_file import result_text
from hygrokf.data.structured import structured
from hygrokf.fleet.fleet_results import FleetResults, table_csv
from hygrokf.fleet.job import DONE, LOST, Job, flat, row_of
from hygrokf.texts.climate_codes import ClimateCode


def test_cells_with_statements_survive_their_file_and_become_texts() -> None:
    job = Job("W1", "climate", Path("c"), Path("f"))
    statements = (ClimateCode.NO_POWER_INPUT(), ClimateCode.NO_PROFILE())
    row = row_of(job, DONE, {"statements": statements, "causes": ("rain", "door"), "ageing_h": np.nan})
    fleet = FleetResults("climate", (row, row_of(job, LOST, reason=ClimateCode.NO_PROFILE())))
    assert structured(FleetResults, json.loads(result_text(fleet))) == fleet
    assert row["statements"] == statements and row["ageing_h"] is None and flat(row["causes"]) == "rain door"
    text = table_csv("climate", fleet.rows)
    assert f"{statements[0]} | {statements[1]}" in text and f'lost,"{statements[1]}"' in text
