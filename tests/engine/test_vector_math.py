"""Exponential and logarithm of whole vectors against numpy's, over the whole range of doubles."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

from hygrokf.engine.cell_loop import exponential, logarithm
from hygrokf.engine.jit import CompiledCode, has_fused_multiply_add
from hygrokf.engine.llvm_writer import LANES, Writer, declarations

UNITS = 3.0 if has_fused_multiply_add() else 6.0
"""Units in the last place: the reduction, the polynomial and the last sum round once each; without fused
multiply-add every product rounds, too."""
MAKERS = {"exponential": exponential, "logarithm": logarithm}


@cache
def code(name: str) -> CompiledCode:
    w = Writer("each", [("i64", "count"), ("ptr", "x"), ("ptr", "out")])
    with w.loop("%count") as k:
        x = w.load(w.vector, w.at(w.vector, "%x", k))
        w.store(w.vector, w.value(f"call {w.vector} @{name}({w.vector} {x})"), w.at(w.vector, "%out", k))
    return CompiledCode(declarations() + MAKERS[name](LANES) + w.text(), ["each"])


def each(name: str, x: np.ndarray) -> np.ndarray:
    """The function of every number, in blocks of LANES."""
    padded = np.append(x, np.ones(-len(x) % LANES))
    out = np.empty_like(padded)
    code(name)("each", len(padded) // LANES, padded, out)
    return out[: len(x)]


def units(found: np.ndarray, expected: np.ndarray) -> np.ndarray:
    return np.abs(found - expected) / np.spacing(np.abs(expected))


@pytest.mark.parametrize("reach", [1e-12, 1e-3, 1.0, 40.0, 708.0])
def test_the_exponential_is_numpys_to_few_units_in_the_last_place(reach):
    x = np.random.default_rng(1).uniform(-reach, reach, 40_000)
    assert units(each("exponential", x), np.exp(x)).max() <= UNITS


def test_the_exponential_at_the_seams_of_its_reduction():
    """Half multiples of ln 2, where the whole number that is split off changes."""
    seams = (np.arange(-1020, 1020) + 0.5) * math.log(2.0)
    x = np.concatenate([np.nextafter(seams, -np.inf), seams, np.nextafter(seams, np.inf)])
    x = x[np.abs(x) <= 708.0]
    assert units(each("exponential", x), np.exp(x)).max() <= UNITS


def test_the_limits_of_the_exponential():
    """It ends at e^-708 and e^709: what is beyond is no number of the model; NaN stays NaN."""
    x = np.array([0.0, -0.0, -708.0, -709.0, -1e300, -np.inf, 709.0, 710.0, 1e300, np.inf, np.nan])
    found = each("exponential", x)
    expected = np.exp(np.clip(x, -708.0, 709.0))
    assert np.array_equal(found[:2], [1.0, 1.0])
    assert units(found[:-1], expected[:-1]).max() <= UNITS
    assert np.isnan(found[-1])
    assert 0.0 < found[5] < 1e-307


@pytest.mark.parametrize("reach", [1e-9, 1e-3, 0.5, 30.0, 700.0])
def test_the_logarithm_is_numpys_to_few_units_in_the_last_place(reach):
    """Near 1, where the logarithm passes through 0, too."""
    x = np.exp(np.random.default_rng(2).uniform(-reach, reach, 40_000))
    x = x[x != 1.0]
    assert units(each("logarithm", x), np.log(x)).max() <= UNITS


def test_the_logarithm_at_the_seams_of_its_reduction():
    """Powers of two and √2 times these, where exponent and mantissa change."""
    powers = 2.0 ** np.arange(-1021.0, 1023.0)
    seams = np.concatenate([powers, math.sqrt(2.0) * powers])
    x = np.concatenate([np.nextafter(seams, 0.0), seams, np.nextafter(seams, np.inf)])
    x = x[(x != 1.0) & (x >= np.finfo(float).tiny)]
    assert units(each("logarithm", x), np.log(x)).max() <= UNITS
    assert each("logarithm", np.ones(1))[0] == 0.0


def test_the_limits_of_the_logarithm():
    found = each("logarithm", np.array([0.0, -0.0, -1.0, -1e-300, -np.inf, np.nan, np.inf]))
    assert np.isnan(found[:6]).all()
    assert found[6] == np.inf


def test_every_lane_has_its_own_number():
    x = np.arange(1.0, LANES + 1.0)
    for name, known in (("exponential", np.exp), ("logarithm", np.log)):
        for shift in range(LANES):
            rolled = np.roll(x, shift)
            assert units(each(name, rolled), known(rolled)).max() <= UNITS
