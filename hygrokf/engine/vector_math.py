"""Exponential and logarithm of whole vectors, in place of one library call for each lane.

Both are polynomials after the usual reduction to [1/√2, √2] and ±ln 2/2; their errors stay below three units
in the last place.  They use the same operations on every processor with fused multiply-add.
"""

from __future__ import annotations

import math

from hygrokf.engine.llvm_writer import Writer, literal, vector

_MAGIC = 6755399441055744.0
"""1.5 · 2⁵²: adding it rounds to whole numbers, which then stand in the lowest bits."""
_LN2_HIGH, _LN2_LOW = 0.6931471803691238, 1.9082149292705877e-10
_TERMS = 13
_LOG_TERMS = 10
_SMALLEST = -708.0
_LARGEST = 709.0


class _Function(Writer):
    """A function of one vector, which the compiler copies into its callers."""

    def __init__(self, name: str, lanes: int) -> None:
        super().__init__(name, [], lanes)
        self.integers = vector(lanes, "i64")

    def all(self, number: float) -> str:
        return self.splat_of("double", literal(number))

    def whole(self, number: int) -> str:
        return self.splat_of("i64", str(number))

    def splat_of(self, kind: str, number: str) -> str:
        return "<" + ", ".join([f"{kind} {number}"] * self.lanes) + ">"

    def real(self, operation: str, a: str, b: str) -> str:
        return self.value(f"{operation} {self.vector} {a}, {b}")

    def integer(self, operation: str, a: str | int, b: str | int) -> str:
        return self.value(f"{operation} {self.integers} {a}, {b}")

    def fused(self, a: str, b: str, c: str) -> str:
        return self.fma(self.vector, (a, b, c))

    def select(self, test: str, yes: str, no: str) -> str:
        return self.value(f"select {self.truths} {test}, {self.vector} {yes}, {self.vector} {no}")

    def compare(self, word: str, a: str, b: str) -> str:
        return self.value(f"fcmp {word} {self.vector} {a}, {b}")

    def bits(self, a: str) -> str:
        return self.value(f"bitcast {self.vector} {a} to {self.integers}")

    def number(self, a: str) -> str:
        return self.value(f"bitcast {self.integers} {a} to {self.vector}")

    def done(self, result: str) -> str:
        head = f"define internal {self.vector} @{self._name}({self.vector} %x) alwaysinline {{"
        return "\n".join([head, *self._lines, f"  ret {self.vector} {result}", "}"]) + "\n"


def exponential(lanes: int) -> str:
    """LLVM text of `@exponential`: e^x of a vector; 0 below −708 in effect, limited above 709."""
    t = _Function("exponential", lanes)
    low = t.select(t.compare("olt", "%x", t.all(_SMALLEST)), t.all(_SMALLEST), "%x")
    x = t.select(t.compare("ogt", low, t.all(_LARGEST)), t.all(_LARGEST), low)
    shifted = t.fused(x, t.all(1.0 / math.log(2.0)), t.all(_MAGIC))
    n = t.real("fsub", shifted, t.all(_MAGIC))
    r = t.fused(n, t.all(-_LN2_LOW), t.fused(n, t.all(-_LN2_HIGH), x))
    total = t.all(1.0 / math.factorial(_TERMS))
    for k in range(_TERMS - 1, -1, -1):
        total = t.fused(total, r, t.all(1.0 / math.factorial(k)))
    raised = t.integer("add", t.bits(total), t.integer("shl", t.bits(shifted), t.whole(52)))
    return t.done(t.select(t.compare("ord", "%x", "%x"), t.number(raised), "%x"))


def logarithm(lanes: int) -> str:
    """LLVM text of `@logarithm`: ln x of a vector of normal numbers and ∞; NaN where x is not positive."""
    t = _Function("logarithm", lanes)
    bits = t.bits("%x")
    exponent = t.integer("sub", t.integer("lshr", bits, t.whole(52)), t.whole(1023))
    one = t.integer("and", bits, t.whole(0x000FFFFFFFFFFFFF))
    mantissa = t.number(t.integer("or", one, t.whole(0x3FF0000000000000)))
    large = t.compare("ogt", mantissa, t.all(math.sqrt(2.0)))
    m = t.select(large, t.real("fmul", mantissa, t.all(0.5)), mantissa)
    n = t.value(f"sitofp {t.integers} {exponent} to {t.vector}")
    n = t.select(large, t.real("fadd", n, t.all(1.0)), n)
    f = t.real("fdiv", t.real("fsub", m, t.all(1.0)), t.real("fadd", m, t.all(1.0)))
    s = t.real("fmul", f, f)
    total = t.all(2.0 / (2 * _LOG_TERMS + 1))
    for k in range(_LOG_TERMS - 1, -1, -1):
        total = t.fused(total, s, t.all(2.0 / (2 * k + 1)))
    result = t.fused(n, t.all(_LN2_HIGH), t.fused(n, t.all(_LN2_LOW), t.real("fmul", total, f)))
    result = t.select(t.compare("olt", "%x", t.all(math.inf)), result, "%x")
    return t.done(t.select(t.compare("ogt", "%x", t.all(0.0)), result, t.all(math.nan)))
