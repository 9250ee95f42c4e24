"""Outliers of a fleet, and the type of turbine that is pooled without them."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from builders.fleet_case import departing_rows

from hygrokf.fleet import running
from hygrokf.fleet.fleet_plan import FleetPlan
from hygrokf.fleet.outliers import FEWEST_JUDGED, INTERVAL_SD, spread, spreads
from hygrokf.fleet.tasks import Compared


def made_rows(random: np.random.Generator, count: int, between: float, error: np.ndarray) -> list[dict]:
    x = np.log(1.5) + between * random.normal(size=count) + error * random.normal(size=count)
    return [
        {
            "turbine": f"W{i}", "status": "done", "v": float(np.exp(a)),
            "l": float(np.exp(a - INTERVAL_SD * e)), "u": float(np.exp(a + INTERVAL_SD * e)),
        }
        for i, (a, e) in enumerate(zip(x, error, strict=True))
    ]  # fmt: skip


BOUNDED, BARE = Compared("v", "time constant", "h", "l", "u"), Compared("v", "error", "K")


@pytest.mark.parametrize(
    ("count", "between", "unequal", "compared", "least_power"),
    [
        (8, 0.06, 0.0, BARE, 0.6),
        (12, 0.06, 0.0, BOUNDED, 0.8),
        (40, 0.06, 0.5, BOUNDED, 0.9),
        (40, 0.0, 0.3, BOUNDED, 0.9),
        (150, 0.06, 0.0, BARE, 0.9),
    ],
)
def test_false_outliers_are_as_rare_as_stated(
    count: int, between: float, unequal: float, compared: Compared, least_power: float
) -> None:
    """200 fleets alike: any outlier in at most 5 % (its 99.9 % bound with 200 draws: 10 %); one that is e^0.6
    off is found."""
    random = np.random.default_rng(4711 + count)
    false = found = 0
    for _ in range(200):
        rows = made_rows(random, count, between, 0.05 * np.exp(unequal * random.normal(size=count)))
        false += bool(spread(rows, compared).outliers)
        moved = dict(rows[0])
        moved |= {name: moved[name] * np.exp(0.6) for name in ("v", "l", "u")}
        found += 0 in spread([moved, *rows[1:]], compared).outliers
    assert false <= 20
    assert found >= 200 * least_power


def test_open_bounds_and_few_turbines_are_not_judged() -> None:
    rows = made_rows(np.random.default_rng(1), FEWEST_JUDGED - 1, 0.05, np.full(FEWEST_JUDGED - 1, 0.05))
    rows[1] |= {"u": None}
    (one,) = spreads(rows, [BOUNDED, Compared("none", "nothing", "")])
    assert (
        one.open == ("W1",)
        and len(one.turbines) == FEWEST_JUDGED - 2
        and np.isnan(one.z).all()
        and not one.outliers
    )
    alike = [{"turbine": f"W{i}", "v": 1.5, "l": 1.4, "u": 1.6} for i in range(9)]
    assert not spread(alike, BOUNDED).outliers


def test_what_bounds_explain_is_not_said_where_one_of_few_departs() -> None:
    """Four turbines, one at twice the value: the median deviation does not see it, and so few name no
    outlier."""
    four = [
        {"turbine": f"W{i}", "v": v, "l": 0.8 * v, "u": 1.25 * v} for i, v in enumerate((1.4, 1.5, 1.5, 3.8))
    ]
    one = spread(four, BOUNDED)
    assert one.between == 0.0 and not one.outliers and not one.explained
    assert spread(four[:3], BOUNDED).explained and spread(four[:1], BOUNDED).explained
    random = np.random.default_rng(8)
    alike = sum(spread(made_rows(random, 8, 0.0, np.full(8, 0.05)), BOUNDED).explained for _ in range(400))
    assert (
        400 * 0.95 - 4 * 4.4 < alike
    )  # 5 % of 400 with its standard deviation; outliers are left out beforehand


def test_several_quantities_share_the_chance() -> None:
    rows = made_rows(np.random.default_rng(3), 12, 0.05, np.full(12, 0.05))
    alone, shared = spread(rows, BOUNDED, 1), spread(rows, BOUNDED, 4)
    assert np.allclose(shared.p, np.minimum(1.0, 4.0 * alone.p)) and np.array_equal(shared.z, alone.z)


def test_a_turbine_that_departs_is_no_part_of_the_type(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The type is pooled from the others."""
    pooled: list[str] = []

    def pool(fits: list, name: str) -> None:
        pooled.extend(fit.name for fit in fits)

    monkeypatch.setattr(running, "read_fit", lambda folder: SimpleNamespace(name=folder.name))
    monkeypatch.setattr(running, "replace", lambda fit, name: fit)
    monkeypatch.setattr(running, "pool_types", pool)
    monkeypatch.setattr(running, "write_type", lambda kind, file: file)
    _, without = running._type_of(FleetPlan("park", "fit", (), {}), tmp_path, departing_rows())
    assert without == ["W4"] and pooled == [f"W{i}" for i in range(9) if i != 4]
