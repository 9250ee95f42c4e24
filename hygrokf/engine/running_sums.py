"""Sums of a Gaussian log-likelihood that a compiled loop keeps while it runs."""

from __future__ import annotations

import math

from hygrokf.engine.llvm_writer import SCALAR, Writer, literal


class RunningSums:
    """Running sums Σ log S and Σ e²/S, with b² (1 + ln(e²/(b² S))) in place of e²/S beyond b².

    Σ log S is kept as a product, whose binary exponent is moved to a separate sum before the product leaves
    the range of doubles.  The time loop contains no call, since a call would spill the whole state from the
    registers at every instant.  A variance that is not positive turns the product into NaN permanently.

    The smallest and the largest variance of each output say how many digits the covariance has lost.
    """

    def __init__(self, w: Writer, outputs: int) -> None:
        self.lowest = [w.slot(SCALAR, literal(math.inf)) for _ in range(outputs)]
        self.highest = [w.slot(SCALAR, literal(0.0)) for _ in range(outputs)]
        self.exponent = w.slot("i64", "0")
        self.product = w.slot(SCALAR, literal(1.0))
        self.quadratic = w.slot(SCALAR, literal(0.0))
        self.number = w.slot("i64", "0")

    def take(self, w: Writer, variance: str, quadratic: str, square: float) -> None:
        """Count one reading with innovation variance S and e²/S; `square` b² is whole or infinite."""
        w.store("i64", w.integer("add", w.load("i64", self.number), 1), self.number)
        self._multiply(w, variance)
        if math.isinf(square):
            accumulate(w, quadratic, self.quadratic)
            return
        beyond = w.value(f"fcmp ogt double {quadratic}, {literal(square)}")
        bounded = w.value(f"select i1 {beyond}, double {literal(square)}, double {quadratic}")
        accumulate(w, bounded, self.quadratic)
        with w.when(beyond):  # b² ln(e²/(b² S)) as b² factors
            ratio = w.real("fdiv", quadratic, literal(square))
            with w.loop(str(round(square))):
                self._multiply(w, ratio)

    def watch(self, w: Writer, place: int, variance: str, before: str) -> None:
        """Note the innovation variance of a reading of output `place`, with and without the correction by the
        other readings of its instant; NaN passes."""
        both = ((self.lowest[place], "olt", variance), (self.highest[place], "ogt", before))
        for slot, order, value in both:
            known = w.load(SCALAR, slot)
            beyond = w.value(f"fcmp {order} double {value}, {known}")
            w.store(SCALAR, w.value(f"select i1 {beyond}, double {value}, double {known}"), slot)

    def _multiply(self, w: Writer, factor: str) -> None:
        product = w.real("fmul", w.load(SCALAR, self.product), factor)
        w.store(SCALAR, product, self.product)
        low = w.value(f"fcmp ult double {product}, {literal(1e-100)}")
        high = w.value(f"fcmp ugt double {product}, {literal(1e100)}")
        with w.when(w.value(f"or i1 {low}, {high}")):
            self._set_exponent_aside(w, product)

    def _set_exponent_aside(self, w: Writer, product: str) -> None:
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
        """out[0] = Σ log S, out[1] = Σ e²/S, out[2] = number of readings, then the smallest
        variance of every output, then the largest."""
        fraction = w.value(f"call double @llvm.log.f64(double {w.load(SCALAR, self.product)})")
        exponent = w.value(f"sitofp i64 {w.load('i64', self.exponent)} to double")
        whole = w.real("fmul", exponent, literal(math.log(2.0)))
        w.store(SCALAR, w.real("fadd", whole, fraction), out)
        w.store(SCALAR, w.load(SCALAR, self.quadratic), w.at(SCALAR, out, 1))
        number = w.value(f"sitofp i64 {w.load('i64', self.number)} to double")
        w.store(SCALAR, number, w.at(SCALAR, out, 2))
        for c, slot in enumerate([*self.lowest, *self.highest]):
            w.store(SCALAR, w.load(SCALAR, slot), w.at(SCALAR, out, 3 + c))


def accumulate(w: Writer, value: str, pointer: str) -> None:
    """Add a number to the value at a pointer."""
    w.store(SCALAR, w.real("fadd", w.load(SCALAR, pointer), value), pointer)
