"""The sums of a Gaussian log-likelihood that a compiled loop keeps while it runs, and score and expected
information from innovations and their tangents, as compiled code.

With dots for tangents, and the weight w = min(1, c² S/e²) of an innovation e of variance S in a model with
the bound c,

    z = e √(w/S),   a = e˙ √(w/S),   b = S˙/(√2 S):     score −z a − (1 − z²) b/√2,   information a a' + b b'.

Shapes: T instants, k outputs, B blocks of L = `LANES` directions.

All functions but `summed` emit code: w is the writer, strings that they take and return are registers and
slots of its text (`llvm_writer`), and names with % are arguments of the emitted function.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from hygrokf.engine.jit import CompiledCode
from hygrokf.engine.llvm_writer import LANES, SCALAR, VECTOR, Writer, declarations, literal


# -- sums that a loop keeps ----------------------------------------------------------------------------------
class RunningSums:
    """Slots of the running sums Σ log S and Σ e²/S, with b² (1 + ln(e²/(b² S))) in place of e²/S beyond b²;
    the methods emit code that changes them.  b is the model's bound of an innovation, in standard deviations.

    Σ log S is kept as a product, whose binary exponent is moved to a separate sum before the product leaves
    the range of doubles.  The time loop contains no call, since a call would spill the whole state from the
    registers at every instant.  A variance that is not positive turns the product into NaN permanently.

    The smallest and the largest variance of each output show how many digits the covariance has lost.
    """

    def __init__(self, w: Writer, outputs: int) -> None:
        self.lowest = [w.slot(SCALAR, literal(math.inf)) for _ in range(outputs)]
        self.highest = [w.slot(SCALAR, literal(0.0)) for _ in range(outputs)]
        self.exponent = w.slot("i64", "0")
        self.product = w.slot(SCALAR, literal(1.0))
        self.quadratic = w.slot(SCALAR, literal(0.0))
        self.number = w.slot("i64", "0")

    def take(self, w: Writer, variance: str, quadratic: str, square: float) -> None:
        """Emit code that counts one reading: `variance` and `quadratic` are the registers of S and e²/S.

        square: b², the largest e²/S that enters the sum as it is; a whole number, since a larger e²/S adds
        b² ln(e²/(b² S)) as b² factors of the product, or infinity for no bound.
        """
        w.store("i64", w.integer("add", w.load("i64", self.number), 1), self.number)
        self._multiply(w, variance)
        if math.isinf(square):
            accumulate(w, quadratic, self.quadratic)
            return
        beyond = w.value(f"fcmp ogt double {quadratic}, {literal(square)}")
        bounded = w.value(f"select i1 {beyond}, double {literal(square)}, double {quadratic}")
        accumulate(w, bounded, self.quadratic)
        with w.when(beyond):
            ratio = w.real("fdiv", quadratic, literal(square))
            with w.loop(str(round(square))):
                self._multiply(w, ratio)

    def watch(self, w: Writer, place: int, variance: str, before: str) -> None:
        """Emit code that updates the smallest and largest innovation variance of output `place` by a
        reading's `variance` and by its variance `before` the other readings of the instant; NaN is
        ignored."""
        updates = ((self.lowest[place], "olt", variance), (self.highest[place], "ogt", before))
        for slot, order, value in updates:
            former = w.load(SCALAR, slot)
            exceeds = w.value(f"fcmp {order} double {value}, {former}")
            w.store(SCALAR, w.value(f"select i1 {exceeds}, double {value}, double {former}"), slot)

    def _multiply(self, w: Writer, factor: str) -> None:
        """Emit code that multiplies the product whose logarithm is Σ log S."""
        product = w.real("fmul", w.load(SCALAR, self.product), factor)
        w.store(SCALAR, product, self.product)
        low = w.value(f"fcmp ult double {product}, {literal(1e-100)}")
        high = w.value(f"fcmp ugt double {product}, {literal(1e100)}")
        with w.when(w.value(f"or i1 {low}, {high}")):
            self._set_exponent_aside(w, product)

    def _set_exponent_aside(self, w: Writer, product: str) -> None:
        """Emit code that moves the binary exponent of the product to its sum; NaN where it is not
        positive."""
        bits = w.value(f"bitcast double {product} to i64")
        exponent = w.integer("sub", w.integer("lshr", bits, 52), 1023)  # valid for a positive number
        w.store("i64", w.integer("add", w.load("i64", self.exponent), exponent), self.exponent)
        fraction = w.integer("or", w.integer("and", bits, 0x000FFFFFFFFFFFFF), 0x3FF0000000000000)
        rest = w.value(f"bitcast i64 {fraction} to double")
        above = w.value(f"fcmp ogt double {product}, {literal(0.0)}")
        below = w.value(f"fcmp olt double {product}, {literal(math.inf)}")
        sound = w.value(f"and i1 {above}, {below}")
        w.store(
            SCALAR, w.value(f"select i1 {sound}, double {rest}, double {literal(math.nan)}"), self.product
        )

    def write(self, w: Writer, out: str) -> None:
        """Emit code that writes the sums: out[0] = Σ log S, out[1] = Σ e²/S, out[2] = number of readings,
        then the smallest variance of every output, then the largest."""
        fraction = w.value(f"call double @llvm.log.f64(double {w.load(SCALAR, self.product)})")
        exponent = w.value(f"sitofp i64 {w.load('i64', self.exponent)} to double")
        exponent_part = w.real("fmul", exponent, literal(math.log(2.0)))
        w.store(SCALAR, w.real("fadd", exponent_part, fraction), out)
        w.store(SCALAR, w.load(SCALAR, self.quadratic), w.at(SCALAR, out, 1))
        number = w.value(f"sitofp i64 {w.load('i64', self.number)} to double")
        w.store(SCALAR, number, w.at(SCALAR, out, 2))
        for c, slot in enumerate([*self.lowest, *self.highest]):
            w.store(SCALAR, w.load(SCALAR, slot), w.at(SCALAR, out, 3 + c))


# -- score and information -----------------------------------------------------------------------------------
def accumulate(w: Writer, value: str, pointer: str) -> None:
    """Emit code that adds a number to the double at a pointer."""
    w.store(SCALAR, w.real("fadd", w.load(SCALAR, pointer), value), pointer)


ONE = literal(1.0)


def summed(
    e: np.ndarray, s: np.ndarray, e_dot: np.ndarray, s_dot: np.ndarray, square: float
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the score (T, B L) of every instant and the information (B L, B L).

    e, s: innovations and variances (T, k); 0 and 1 without a reading.  e_dot, s_dot: their tangents
    (B, T, k, L), which are overwritten.  square: c², or infinity.
    """
    blocks, count, outputs, _ = e_dot.shape
    scores, information = np.zeros((count, blocks, LANES)), np.zeros((blocks, LANES, blocks, LANES))
    _code()("summed", blocks, count, outputs, np.array([square]), e, s, e_dot, s_dot, scores, information)
    upper = np.triu(information.reshape(blocks * LANES, -1))
    return scores.reshape(count, -1), upper + np.triu(upper, 1).T


@cache
def _code() -> CompiledCode:
    """The compiled function `summed`."""
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
    return CompiledCode(declarations() + w.text(), ["summed"])


def _scaled(w: Writer, block: str, first: str, k: str, c: str) -> None:
    """Emit code that replaces one reading's tangents by a and b, and adds its terms to the score of its
    instant.

    block, k, c: registers of the block of directions, the instant and the output; first: of the position of
    the block's first tangents.
    """
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


def _products(w: Writer, row_block: str, column_block: str, readings: str) -> None:
    """Emit code that sums a a' + b b' of all readings into the information between two blocks."""
    sums = [w.slot(VECTOR, "zeroinitializer") for _ in range(LANES)]
    starts = [w.integer("mul", index, readings) for index in (row_block, column_block)]
    with w.loop(readings) as reading:
        rows, columns = (w.integer("add", start, reading) for start in starts)
        for base in ("%edot", "%sdot"):
            column = w.load(VECTOR, w.at(VECTOR, base, columns))
            row = w.at(VECTOR, base, rows)
            for i, total in enumerate(sums):
                entry = w.splat(w.load(SCALAR, w.at(SCALAR, row, i)))
                w.store(VECTOR, w.fma(VECTOR, [entry, column, w.load(VECTOR, total)]), total)
    for i, total in enumerate(sums):
        information_row = w.integer("add", w.integer("mul", row_block, LANES), i)
        place = w.integer("add", w.integer("mul", information_row, "%blocks"), column_block)
        w.store(VECTOR, w.load(VECTOR, total), w.at(VECTOR, "%information", place))
