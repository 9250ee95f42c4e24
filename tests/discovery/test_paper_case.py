"""The paper's open end as a test: after a six-day standstill, pre-heating brings a moisture peak that its
model cannot make.

Simulated, because the paper's readings are not public: the peak comes from polymers in the plant, or from a
film of condensate, or from a leak that only this standstill has.
"""

from __future__ import annotations

import numpy as np
import pytest
from plants.as_record import to_record
from plants.paper import paper_case
from plants.plant import Plant

from hygrokf.discovery.procedure import discover

DAYS = 126.0


def discovered(made: Plant) -> dict:
    record = to_record(made)
    record = to_record(made, until_s=record.start_s + 2.0 / 3.0 * (record.end_s - record.start_s))
    return discover(record, starts=1).to_json()


@pytest.mark.slow
def test_the_papers_moisture_peak_is_sorption() -> None:
    made = paper_case(41, form=0, days=DAYS)
    (hidden,) = made.truth.hidden
    found = discovered(made)
    cause = found["causes"][0]
    assert (found["verdict"], cause["cause"]) == ("named", "moisture_sorption")
    assert cause["gain"]["rmse_after"] < 0.8 * cause["gain"]["rmse_before"]
    truth, told = hidden.parameters, cause["parameters"]
    around = np.array([0.4999, 0.5001]) * truth["gab_k"]
    content = truth["gab_c"] * around / ((1.0 - around) * (1.0 + (truth["gab_c"] - 1.0) * around))
    capacity = truth["dry_material_kg"] * truth["monolayer"] * np.diff(content)[0] / 0.0002
    for name, value in (
        ("sorption_time", truth["time_constant_h"]),
        ("sorption_capacity", 1e3 * capacity / made.cabinet.volume),
    ):
        assert told[name]["lower"] < value < told[name]["upper"], (name, value, told[name])


@pytest.mark.slow
@pytest.mark.parametrize("seed", [42, 43])
def test_a_slab_of_material_is_sorption_too(seed: int) -> None:
    found = discovered(paper_case(seed, form=1, days=DAYS))
    assert (found["verdict"], found["causes"][0]["cause"]) == ("named", "moisture_sorption")


@pytest.mark.slow
@pytest.mark.parametrize("decoy", ["film", "source"])
@pytest.mark.parametrize("seed", [44, 45])
def test_what_only_looks_like_it_is_not_called_sorption(decoy: str, seed: int) -> None:
    found = discovered(paper_case(seed, decoy=decoy, days=DAYS))
    named = [cause["cause"] for cause in found["causes"]]
    assert "moisture_sorption" not in named
