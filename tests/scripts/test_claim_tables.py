"""Tables of claims on lines made by hand: what is counted, and in which denominator."""

from __future__ import annotations

from validation import changes, climate, clocks, contradictions, notices, sisters, transfer


def cells(text: str, start: str) -> list[str]:
    """Cells of the row that begins so."""
    (row,) = (line for line in text.splitlines() if line.startswith(f"| {start} |"))
    return [cell.strip() for cell in row.strip("|").split("|")]


def test_pairs_are_counted_by_what_differs() -> None:
    def line(differ: list[str], told: list[str], right: bool) -> dict:
        found = {"differ": differ, "re_estimate": told, "right": right, "verdict": "wrong"}
        return {"variant": "power 1.2", **found}

    text = transfer.table(
        [line(["thermal"], ["thermal"], True), line(["thermal"], [], False), line([], ["thermal"], False)]
    )
    assert cells(text, "thermal") == ["thermal", "2", "1", "1", "1: wrong"]
    assert cells(text, "nothing") == ["nothing", "1", "0", "–", "1: wrong"]
    assert cells(text, "**all**")[:3] == ["**all**", "3", "1"]


def test_types_are_held_against_their_next_turbine() -> None:
    def line(held: bool, alone: float) -> dict:
        row = {"alone": alone, "helped": 0.05, "bounds_held": held}
        return {"variant": "types", "parameters": {"hygric_k": row}}

    text = transfer.table([line(True, 0.3), line(False, 0.4)])
    assert cells(text, "`hygric_k`") == ["`hygric_k`", "2", "1", "35 %", "5 %"]


def test_climates_are_counted_by_statistic_and_variant() -> None:
    def row(truth: float, low: float, high: float) -> dict:
        found = climate._row(type("B", (), {"lower": low, "value": 1.0, "upper": high})(), truth)
        return {"wetness_h": found}

    lines = [
        {"variant": "ou", "statistics": row(1.5, 0.5, 1.4)},
        {"variant": "ou", "statistics": row(0.0, 0.0, 0.0)},
        {"variant": "shot", "statistics": row(1.0, 0.0, 2.0)},
    ]
    first, _, second = climate.table(lines).partition("shot: 1")
    assert cells(first, "wetness h") == ["wetness h", "1", "2"]
    assert cells(second, "all") == ["all", "1", "1"]


def test_changes_are_found_in_time_late_or_never() -> None:
    def line(tau: list, calm: list) -> dict:
        found = {"tau": tau, "exchange": [], "release": [], "none": calm}
        return {
            "found": found,
            "change_day": 60.0,
            "days": 120.0,
            "plant_days": 180.0,
            "plant": [],
            "other": calm,
        }

    text = changes.table(
        [
            line([["thermal_time_constant", 61.0, 64.0, 0.4]], []),
            line(
                [["thermal_time_constant", 61.0, 90.0, 0.4], ["hygric_k", 70.0, 71.0, 0.1]],
                [["hygric_k", 1, 3, 1]],
            ),
        ]
    )
    tau = cells(text, changes.VARIANTS["tau"][0])
    assert tau[1] == "2" and tau[2].startswith("1/2 = 50 %") and tau[3:] == ["17.0", "30.0"]
    assert cells(text, changes.VARIANTS["release"][0])[2:] == ["0/2 = 0 % (0 … 84)", "–", "2 never"]
    assert cells(text, "plants") == ["plants", "2", "1.0", "0", "0.00"]
    assert cells(text, "synthetic turbines")[3:] == ["1", "1.52"]


def test_clocks_count_what_is_named_in_wrong_and_in_right_records() -> None:
    right = {f"{kind}, right": ["named: x"] for kind in clocks.KINDS}
    right |= {f"{kind}, CPU [s]": 0.2 for kind in clocks.KINDS}
    wrong = {f"{kind}, {source}, {name}": [source == "cabinet.csv", []]
             for kind in clocks.KINDS for source in clocks.SOURCES for name in clocks.SHIFTS_H}  # fmt: skip
    wrong |= {f"{kind}, {name}": [True, []] for kind in clocks.KINDS for name in clocks.VALUES}
    text = clocks.table([{"variant": "right", **right}, {"variant": "wrong", **right, **wrong}])
    assert "instants: named in right records: 2 ['named: x', 'named: x']; CPU 0.20 s" in text
    assert (
        text.count("| cabinet.csv |" + " 1 of 1 |" * 6) == text.count("| scada.csv |" + " 0 of 1 |" * 6) == 2
    )
    assert text.count("- °F inside: 1 of 1") == 2
    assert "cabinet.csv" not in clocks.table([{"variant": "right", **right}])


def test_contradictions_are_shares_of_readings() -> None:
    def line(readings: int, noticed: int) -> dict:
        found = {"readings": readings, "beyond": 1, "noticed": [0, 0, noticed, readings]}
        return {"days": 10.0, "cabinet_temperature": found, "cabinet_relative_humidity": found}

    text = contradictions.table([line(100, 50), line(300, 250)])
    assert text.startswith("2 plants, 20 days")
    said = "1 K: 0.0 %, 2 K: 0.0 %, 3 K: 75.0 %, 5 K: 100.0 %"
    assert cells(text, "cabinet_temperature")[1:] == ["400", "2", said]


def test_notices_that_were_lost_do_not_hold() -> None:
    line = dict.fromkeys(("outages", "restarts", "notices", "lost", "doubled", "repeated"), 3)
    assert cells(notices.table([{"kind": "mail", "seed": 2, **line}]), "mail") == ["mail", "2", *"333333"]


def test_sisters_state_the_source_and_the_verdict() -> None:
    constant = {"value_h": 0.345, "lower_h": 0.2, "upper_h": 0.58, "verdict": "reject"}
    verdict = {"verdict": "does not transfer", "sentence": "differs"}
    line = {"source": "turbine 1", "other": "turbine 2", "constant": constant, **verdict}
    said = ["0.34 h (0.20 … 0.58), reject", "turbine 2", "does not transfer", "differs"]
    assert cells(sisters.table([line]), "turbine 1") == ["turbine 1", *said]
