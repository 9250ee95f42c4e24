"""The two parts of a model, and the name by which each place calls what belongs to a part."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Part:
    """A network of the model.

    name: of the part in models and results; time_constant: its parameter [h]; output: what its sensor reads,
    in diagnoses and residuals; balance: what its network balances, in a search for causes; series: stem of
    its columns in series.npz; scored: quantity of its errors, with the unit.
    """

    name: str
    time_constant: str
    output: str
    balance: str
    series: str
    scored: str


THERMAL = Part(
    name="thermal",
    time_constant="thermal_time_constant",
    output="temperature",
    balance="temperature",
    series="temperature",
    scored="temperature_K",
)
HYGRIC = Part(
    name="hygric",
    time_constant="hygric_k",
    output="humidity",
    balance="vapour",
    series="absolute_humidity",
    scored="absolute_humidity_g_m3",
)
BOTH_PARTS = (THERMAL, HYGRIC)
PARTS = tuple(part.name for part in BOTH_PARTS)
TIME_CONSTANTS = tuple(part.time_constant for part in BOTH_PARTS)
SCORED = tuple(part.scored for part in BOTH_PARTS)
