"""What a tracker says at its start."""

from __future__ import annotations

from typing import cast

from hygrokf.identification.verdict_terms import Inherited
from hygrokf.live.plan import Plan
from hygrokf.live.tracking import record_doubts
from hygrokf.live.turbine import Turbine
from hygrokf.texts.reasons import CAUTION, ReasonCode


def test_doubts_about_the_record_of_a_model_are_said_once_a_turbine() -> None:
    clock = ReasonCode.RECORD_DOUBTED(doubt="the clock of a.csv seems 2 h fast")
    short = ReasonCode.RECORD_SHORT(time_constants=3.0)
    verdicts = {part: Inherited(verdict=CAUTION, reasons=(short, clock)) for part in ("thermal", "hygric")}
    plan = cast("Plan", None)
    turbines = {"T1": Turbine(plan, verdicts=verdicts), "T2": Turbine(plan)}
    assert list(record_doubts(turbines)) == [("T1", clock.text)]
