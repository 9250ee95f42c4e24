"""The page of a fleet, and its text at the terminal."""

from __future__ import annotations

import numpy as np
from builders.fleet_case import departing_rows
from builders.html_page import Page

from hygrokf.fleet.fleet_results import FleetResults
from hygrokf.report.fleet_page import fleet_blocks
from hygrokf.report.page import page_html
from hygrokf.report.terminal import page_text
from hygrokf.texts.climate_codes import ClimateCode
from hygrokf.texts.fleet_codes import FleetCode


def table(task: str, rows: list[dict], name: str = "park") -> FleetResults:
    return FleetResults(task, tuple(rows), name, created="2024-05-01T12:00:00")


def test_the_page_of_climates_shows_limits_and_numbers_that_are_zero() -> None:
    rows = []
    for place in range(7):
        row: dict = {"turbine": f"W{place}", "status": "done", "limits": "fail" if place == 2 else "pass"}
        statements = (ClimateCode.NO_POWER_INPUT(), ClimateCode.NO_PROFILE())[: 2 if place else 1]
        row |= {"wetness_class": "τ2", "statements": statements}
        row |= {"ageing_h": 12.0 + place, "ageing_h_lower": 11.0 + place, "ageing_h_upper": 13.0 + place}
        row |= {f"wetness_h{end}": v for end, v in (("", 43.5397), ("_lower", 0.0), ("_upper", 116.1))}
        rows.append(row)
    rows[6] |= {"wetness_h": 0.0, "wetness_h_upper": 0.0}
    text = page_html(fleet_blocks(table("climate", rows)))
    cells = Page(text).text
    assert "pass 6 W0, W1, W3, W4, W5, W6" in cells and "fail 1 W2" in cells
    assert f"{ClimateCode.NO_POWER_INPUT()} 7 W0, W1" in cells
    assert f"{ClimateCode.NO_PROFILE()} 6 W1, W2" in cells
    ranking = text.split("<h2>Ranking</h2>")[1]
    assert ranking.count("43.5 (0 … 116)") == 6 and "43.5397" not in text
    assert "above zero on both sides, so not compared: time of wetness of W0, W1" in text
    assert "W6.</p>" in text  # also the one without any wet hour


def test_the_page_shows_failures_outliers_and_ranking() -> None:
    random = np.random.default_rng(5)
    rows = []
    for place in range(9):
        row: dict = {"turbine": f"W<{place}>", "status": "done", "task": "fit", "provenance": "synthetic"}
        for name, middle in (("thermal", 1.5), ("hygric", 0.3)):
            value = middle * float(
                np.exp(0.05 * random.normal() + (1.0 if place == 4 and name == "thermal" else 0.0))
            )
            row |= {f"{name}_{k}_h": value * f for k, f in (("lower", 0.9), ("value", 1.0), ("upper", 1.1))}
        rows.append(row | {"temperature_rmse_K": 1.0 + 0.01 * place, "humidity_rmse_g_m3": 0.4})
    rows[7] |= {"thermal_upper_h": None, "thermal_statement": FleetCode.NOT_BELOW(bound=1.2)}
    rows.append({"turbine": "W9", "status": "failed", "reason": "no <file>", "task": "fit"})
    text = page_html(fleet_blocks(table("fit", rows, "P & Q")))
    assert "<script" not in text and "W<4>" not in text and "P &amp; Q" in text and "no &lt;file&gt;" in text
    outliers = text.split("<h2>Outliers</h2>")[1].split("<h2>")[0]
    assert "W&lt;4&gt;" in outliers and outliers.count("<tr") == 2
    ranking = text.split("<h2>Ranking</h2>")[1]
    assert ranking.index("W&lt;8&gt;") < ranking.index("W&lt;1&gt;") and "≥ 1.20 h" in ranking
    assert "9 of 10" in text and text.count("<svg") == 2 and "SYNTHETIC" in text
    assert "<h2>Outliers<" not in page_html(fleet_blocks(table("fit", rows[-1:])))


def test_the_page_of_discoveries_counts_verdicts_and_names_classes() -> None:
    found = (("named", ("solar_gain",)), ("ambiguous", ("condensation/moisture_sorption",)), ("refuted", ()),
             ("named", ("solar_gain", "exchange_step")))  # fmt: skip
    rows = [
        {"turbine": f"W{place}", "status": "done", "verdict": verdict, "causes": causes, "not_judged": ()}
        for place, (verdict, causes) in enumerate(found)
    ]
    rows[2]["not_judged"] = ("clock_shift",)
    text = page_html(fleet_blocks(table("discover", rows)))
    cells = Page(text).text
    assert "verdict named 2 W0, W3 verdict ambiguous 1 W1 verdict refuted 1 W2" in cells
    assert "condensation or moisture sorption 1 W1" in cells and "solar gain 2 W0, W3" in cells
    assert "not judged: the budget of simulations ended clock shift 1 W2" in cells
    assert "the budget" not in page_html(fleet_blocks(table("discover", rows[:2])))


def test_the_terminal_says_who_departs() -> None:
    rows = departing_rows()
    text = page_text(fleet_blocks(table("fit", rows)))
    (line,) = (one for one in text.splitlines() if one.startswith("W4 "))
    assert line.split()[1:7] == ["thermal", "time", "constant", "[h]", "4.32", "1.48"]
    assert "No turbine differs from the others" in page_text(fleet_blocks(table("fit", rows[:4] + rows[5:])))
    assert "Outliers" not in page_text(fleet_blocks(table("fit", rows[:3])))
