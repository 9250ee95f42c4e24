"""Products of matrices as compiled functions, for models with too many states for straight-line code.

A matrix (n, n) is stored in `width` = ⌈n/8⌉ 8 rows of `width` numbers; the numbers beyond n are zero.  The
functions do not depend on the model: their loops run over tiles and strips, so that a tile's sums stay in the
processor's registers.

Functions of this module emit code; strings that they take and return are registers and slots of the text
(`llvm_writer`), and names with % are arguments of the emitted function.

- tile: `ROWS` neighbouring rows of a matrix.
- strip: `LANES` neighbouring columns, one vector in each row.
- plus: the matrix, or row, to which a product is added; null for none.
- inner: number of terms in each sum of a product.
- place: position of a number in an array, counted in numbers.
"""

from __future__ import annotations

from hygrokf.engine.llvm_writer import LANES, SCALAR, VECTOR, Writer

ROWS = 4
"""Rows of a tile: four sums of eight numbers fit the registers of every processor with vectors."""
_POINTER = "ptr nocapture"  # the added matrix may be the result itself, so that none is `noalias`


def padded(count: int, to: int = LANES) -> int:
    """The smallest multiple of `to` that is at least `count`."""
    return -(-count // to) * to


def functions() -> str:
    """LLVM text of `product`, `combined` and `mirrored`."""
    copy = "declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)\n"
    return copy + "".join(w.inner_text() for w in (_product(), _combined(), _mirrored()))


def _function(name: str, pointers: str, integers: str) -> Writer:
    """A writer of the function `name(pointers, integers)`."""
    kinds = [(_POINTER, one) for one in pointers.split()], [("i64", one) for one in integers.split()]
    return Writer(name, [*kinds[0], *kinds[1]])


def _accumulators(w: Writer, places: list[str], has_plus: str) -> list[str]:
    """Emit code that prepares a sum for each place; returns the slots of the sums.

    A sum starts with the vector of `%plus` at its place where the i1 `has_plus` holds, else with 0.
    """
    slots = [w.slot(VECTOR, "zeroinitializer") for _ in places]
    with w.when(has_plus):
        for slot, place in zip(slots, places, strict=True):
            w.store(VECTOR, w.load(VECTOR, w.at(SCALAR, "%plus", place)), slot)
    return slots


def _product() -> Writer:
    """The function `product`: result = plus + a b, of `tiles` tiles, `strips` strips and `inner` terms.

    Entry (i, k) of a stands at i·down + k·across, so that a transposed matrix needs no copy; `plus` may be
    null; with `lower`, strips right of the diagonal are not computed.
    """
    w = _function("product", "result plus a b", "tiles inner strips down across width lower")
    has_plus = w.value("icmp ne ptr %plus, null")
    triangle = w.value("icmp ne i64 %lower, 0")
    with w.loop("%tiles") as tile:
        top = w.integer("mul", tile, ROWS)
        strip_count = w.integer("lshr", w.integer("add", top, ROWS + LANES - 1), LANES.bit_length() - 1)
        with w.loop(w.value(f"select i1 {triangle}, i64 {strip_count}, i64 %strips")) as strip:
            left = w.integer("mul", strip, LANES)
            rows = [w.integer("add", top, r) for r in range(ROWS)]
            places = [w.integer("add", w.integer("mul", row, "%width"), left) for row in rows]
            sums = _accumulators(w, places, has_plus)
            with w.loop("%inner") as k:
                b = w.load(VECTOR, w.at(SCALAR, "%b", w.integer("add", w.integer("mul", k, "%width"), left)))
                column = w.integer("mul", k, "%across")
                for row, total in zip(rows, sums, strict=True):
                    place = w.integer("add", w.integer("mul", row, "%down"), column)
                    a = w.splat(w.load(SCALAR, w.at(SCALAR, "%a", place)))
                    w.store(VECTOR, w.fma(VECTOR, [a, b, w.load(VECTOR, total)]), total)
            for place, total in zip(places, sums, strict=True):
                w.store(VECTOR, w.load(VECTOR, total), w.at(SCALAR, "%result", place))
    return w


def _combined() -> Writer:
    """The function `combined`: result = plus + Σ_k x_k b_k, with the rows b_k of b; `plus` may be null."""
    w = _function("combined", "result plus x b", "inner strips width")
    has_plus = w.value("icmp ne ptr %plus, null")
    with w.loop("%strips") as strip:
        left = w.integer("mul", strip, LANES)
        (total,) = _accumulators(w, [left], has_plus)
        with w.loop("%inner") as k:
            b = w.load(VECTOR, w.at(SCALAR, "%b", w.integer("add", w.integer("mul", k, "%width"), left)))
            x = w.splat(w.load(SCALAR, w.at(SCALAR, "%x", k)))
            w.store(VECTOR, w.fma(VECTOR, [x, b, w.load(VECTOR, total)]), total)
        w.store(VECTOR, w.load(VECTOR, total), w.at(SCALAR, "%result", left))
    return w


def _mirrored() -> Writer:
    """The function `mirrored`: copies the lower triangle of a matrix to its upper triangle."""
    w = _function("mirrored", "matrix", "n width")
    with w.loop("%n") as i, w.loop(i) as j:
        low = w.integer("add", w.integer("mul", i, "%width"), j)
        high = w.integer("add", w.integer("mul", j, "%width"), i)
        w.store(SCALAR, w.load(SCALAR, w.at(SCALAR, "%matrix", low)), w.at(SCALAR, "%matrix", high))
    return w
