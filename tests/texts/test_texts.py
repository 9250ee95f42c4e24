"""The text of every code by its values; and that the package uses every code."""

from __future__ import annotations

import re
import tomllib
from functools import cache
from pathlib import Path
from typing import Any, get_args

import pytest

import hygrokf
from hygrokf.data.structured import plain, structured
from hygrokf.discovery.discovery_results import Exclusion, Reason, Verdict
from hygrokf.report.discovery_text import ANSWERS, EXCLUSIONS, REFUTATIONS
from hygrokf.texts.climate_codes import ClimateCode
from hygrokf.texts.discovery_codes import ConditionCode, DiscoveryCode
from hygrokf.texts.doctor_codes import CHECK_LEVELS, DOUBT, OK, CheckCode, ExaminedCode
from hygrokf.texts.fit_codes import FitCode
from hygrokf.texts.fleet_codes import FleetCode
from hygrokf.texts.live_codes import AdviceCode, AlarmCode, BasisCode, CauseCode, NoticeCode, StateCode
from hygrokf.texts.reasons import ReasonCode, VerdictCode
from hygrokf.texts.record_codes import DoubtCode, RecordCode, touched
from hygrokf.texts.statement import Code, Statement
from hygrokf.texts.transfer_codes import TransferCode, TransferVerdict

TABLES = {
    "fit": FitCode, "record": RecordCode, "doubt": DoubtCode, "condition": ConditionCode,
    "discovery": DiscoveryCode, "transfer_verdict": TransferVerdict, "transfer": TransferCode,
    "climate": ClimateCode, "fleet": FleetCode, "reason": ReasonCode, "verdict": VerdictCode,
    "check": CheckCode, "examined": ExaminedCode, "alarm": AlarmCode, "notice": NoticeCode,
    "advice": AdviceCode, "basis": BasisCode, "cause": CauseCode, "state": StateCode,
}  # fmt: skip
PACKAGE = Path(hygrokf.__file__).parent


@cache
def rows(table: str) -> dict[str, dict[str, Any]]:
    """Code -> its text, and the values that fill it."""
    return tomllib.loads((Path(__file__).parent / f"{table}.toml").read_text(encoding="utf-8"))


@pytest.mark.parametrize("table", TABLES)
def test_every_code_has_its_text(table: str) -> None:
    assert list(rows(table)) == [code.key for code in TABLES[table]]
    for key, row in rows(table).items():
        statement = structured(Statement, {"code": key, "values": row.get("values", {})})
        assert statement.text == row["text"]
        assert structured(Statement, plain(statement)) == statement
        assert bool(statement.remedy) == bool(statement.code.remedy)


def test_a_check_says_what_to_do_unless_all_is_well() -> None:
    slow = CheckCode.QUERY_SLOW("source x", took=12.0, poll=10.0, watermark="id")
    found, to_do = "the query took 12 s, longer than poll (10 s)", "create an index on id, or poll less often"
    assert str(slow) == f"doubt  source x: {found}; to do: {to_do}"
    assert CheckCode.FILE_RESTS("x", within=1.0, age=2.0).remedy == ""
    assert CheckCode.FILE_RESTS("x", DOUBT, within=1.0, age=2.0).remedy.startswith("check the program")
    assert {code.usual for code in CheckCode} == set(CHECK_LEVELS)
    assert all(code.remedy for code in CheckCode if code.usual != OK)
    data = plain(slow)
    assert data["code"] == "query_slow" and data["remedy"] == slow.remedy and data["found"] == slow.text


def test_every_doubt_touches_the_constants_that_it_names_or_that_its_signal_tells() -> None:
    for key, row in rows("doubt").items():
        doubt = structured(Statement, {"code": key, "values": row.get("values", {})})
        assert set(touched(doubt)) <= {"thermal", "hygric"}
    assert touched(DoubtCode.WRONG_UNIT(signal="active_power")) == ("thermal",)
    assert touched(DoubtCode.WRONG_UNIT(signal="ambient_dew_point_temperature")) == ("hygric",)
    assert touched(DoubtCode.WRONG_UNIT(signal="cabinet_temperature")) == ("thermal", "hygric")
    assert touched(DoubtCode.WRONG_UNIT(signal="wind_speed")) == ()
    assert touched(FitCode.NO_POWER()) == ()


def test_every_verdict_of_a_discovery_and_every_reason_has_its_code() -> None:
    for kind, codes in ((Verdict, ANSWERS), (Reason, REFUTATIONS), (Exclusion, EXCLUSIONS)):
        assert set(get_args(kind)) == set(codes)
    assert [str(one) for one in TransferVerdict] == [one().text for one in TransferVerdict]


@cache
def sources() -> str:
    """All of the package outside of the enumerations."""
    texts = PACKAGE / "texts"
    files = [path for path in sorted(PACKAGE.rglob("*.py")) if path.parent != texts]
    return "\n".join(path.read_text(encoding="utf-8") for path in [*files, texts / "record_codes.py"])


@pytest.mark.parametrize("kind", TABLES.values())
def test_the_package_uses_every_code(kind: type[Code]) -> None:
    used = set(re.findall(rf"\b{kind.__name__}\.([A-Z_]+)\b", sources()))
    assert set(kind.__members__) - used == set()
