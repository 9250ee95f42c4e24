"""Score and expected information from innovations and their tangents, as compiled code.

With dots for tangents, and the weight w = min(1, c² S/e²) of an innovation e of variance S in a model with
the bound c,

    z = e √(w/S),   a = e˙ √(w/S),   b = S˙/(√2 S):     score −z a − (1 − z²) b/√2,   information a a' + b b'.

Shapes: T instants, k outputs, B blocks of L = `LANES` directions.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from hygrokf.engine.jit import Code
from hygrokf.engine.llvm_writer import LANES, SCALAR, VECTOR, Writer, declarations, literal

ONE = literal(1.0)


def summed(
    e: np.ndarray, s: np.ndarray, e_dot: np.ndarray, s_dot: np.ndarray, square: float
) -> tuple[np.ndarray, np.ndarray]:
    """Score (T, B L) by instants, and information (B L, B L).

    e, s: innovations and variances (T, k); 0 and 1 without a reading.  e_dot, s_dot: their tangents
    (B, T, k, L), which are overwritten.  square: c², or infinity.
    """
    blocks, count, outputs, _ = e_dot.shape
    scores, information = np.zeros((count, blocks, LANES)), np.zeros((blocks, LANES, blocks, LANES))
    _code()("summed", blocks, count, outputs, np.array([square]), e, s, e_dot, s_dot, scores, information)
    upper = np.triu(information.reshape(blocks * LANES, -1))
    return scores.reshape(count, -1), upper + np.triu(upper, 1).T


@cache
def _code() -> Code:
    names = "square e s edot sdot scores information".split()
    integers = [("i64", name) for name in ("blocks", "count", "outputs")]
    w = Writer("summed", [*integers, *(("ptr", name) for name in names)])
    readings = w.integer("mul", "%count", "%outputs")
    with w.loop("%blocks") as block:
        first = w.integer("mul", block, readings)
        with w.loop("%count") as k, w.loop("%outputs") as c:
            _scaled(w, block, first, k, c)
    with w.loop("%blocks") as later, w.loop(w.integer("add", later, 1)) as block:
        _products(w, block, later, readings)
    return Code(declarations() + w.text(), ["summed"])


def _scaled(w: Writer, block: str, first: str, k: str, c: str) -> None:
    """Put a and b in the places of one reading's tangents; add to the score of its instant."""
    reading = w.integer("add", w.integer("mul", k, "%outputs"), c)
    e, s = (w.load(SCALAR, w.at(SCALAR, base, reading)) for base in ("%e", "%s"))
    square = w.load(SCALAR, "%square")
    inverse = w.real("fdiv", ONE, s)
    quadratic = w.real("fmul", w.real("fmul", e, e), inverse)
    share = w.real("fdiv", square, quadratic)
    beyond = w.value(f"fcmp ogt double {quadratic}, {square}")
    weight = w.value(f"select i1 {beyond}, double {share}, double {ONE}")
    factor = w.value(f"call double @llvm.sqrt.f64(double {w.real('fmul', weight, inverse)})")
    z = w.real("fmul", e, factor)
    half = w.real("fmul", inverse, literal(math.sqrt(0.5)))
    rest = w.value(f"fneg double {w.real('fsub', ONE, w.real('fmul', z, z))}")
    places = [w.at(VECTOR, base, w.integer("add", first, reading)) for base in ("%edot", "%sdot")]
    a, b = (
        w.value(f"fmul {VECTOR} {w.load(VECTOR, place)}, {w.splat(scale)}")
        for place, scale in zip(places, (factor, half), strict=True)
    )
    for place, value in zip(places, (a, b), strict=True):
        w.store(VECTOR, value, place)
    score = w.at(VECTOR, "%scores", w.integer("add", w.integer("mul", k, "%blocks"), block))
    total = w.fma(VECTOR, [w.splat(w.value(f"fneg double {z}")), a, w.load(VECTOR, score)])
    slope = w.splat(w.real("fmul", rest, literal(math.sqrt(0.5))))
    w.store(VECTOR, w.fma(VECTOR, [slope, b, total]), score)


def _products(w: Writer, block: str, later: str, readings: str) -> None:
    """Add a a' + b b' of all readings to the information between two blocks."""
    sums = [w.slot(VECTOR, "zeroinitializer") for _ in range(LANES)]
    starts = [w.integer("mul", one, readings) for one in (block, later)]
    with w.loop(readings) as reading:
        rows, columns = (w.integer("add", start, reading) for start in starts)
        for base in ("%edot", "%sdot"):
            column = w.load(VECTOR, w.at(VECTOR, base, columns))
            row = w.at(VECTOR, base, rows)
            for i, total in enumerate(sums):
                entry = w.splat(w.load(SCALAR, w.at(SCALAR, row, i)))
                w.store(VECTOR, w.fma(VECTOR, [entry, column, w.load(VECTOR, total)]), total)
    for i, total in enumerate(sums):
        line = w.integer("add", w.integer("mul", block, LANES), i)
        place = w.integer("add", w.integer("mul", line, "%blocks"), later)
        w.store(VECTOR, w.load(VECTOR, total), w.at(VECTOR, "%information", place))
