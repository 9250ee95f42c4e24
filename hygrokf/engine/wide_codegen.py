"""The loops of a filter with many states as LLVM text: what `filter_codegen` writes, over matrices.

The moments are one block: the rows of P, followed by the row m'.  With bars for adjoints and dots
for tangents, a step and a reading with c = P H', its variance S, g = 1/S and p = e/S are

    X = [P; m'] F',   P⁺ = F X + N,   m⁺' = x_n + Σ b_e w_e;        P⁺ = P − g c c',   m⁺ = m + p c.

Backwards, with symmetric P̄,

    M = [P̄⁺; m̄⁺'] F,   F̄ += 2 M P + m̄⁺ m',   N̄ += P̄⁺,   w̄_e += b_e m̄⁺,
    b̄_e = w_e' m̄⁺,   P̄ = F' M,   m̄' = m_n;
    c̄ = p m̄ − 2 g P̄ c,   ḡ = −c' P̄ c,   p̄ = c' m̄,   H̄ += c̄' P,   P̄ += (H' c̄' + c̄ H)/2.

Along directions, with V = [P˙; m˙'] F' and U = F P F˙',

    P⁺˙ = F V + N˙ + U + U',   m⁺˙' = v_n + m' F˙' + (Σ b_e w_e)˙;
    P⁺˙ = P˙ − t c' − c t',   t = g c˙ + g˙ c / 2.

Methods emit code; strings that they take and return are registers, slots and pointers of the text
(`llvm_writer`); a matrix is the pointer to its first number, in rows of `width` numbers.

- drive: the entries b_e, which move the mean along the columns w_e in a step.
- head: the scalars of a reading's update: e, S, e²/S, and the factors `gain` g and `push` p.
- leaves: node → register of its value, from which a block is computed; `spread` is the register of S.
- tile, strip, plus: as in `wide_products`.
- along: the tangents of expressions or numbers along `LANES` directions at a time, one in each lane.
- r, w, g, k, c: the recursion, the writer, the graph, the register of the instant, the output of a reading.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from hygrokf.engine.filter_codegen import Emission
from hygrokf.engine.information import RunningSums, accumulate
from hygrokf.engine.llvm_writer import LANES, SCALAR, VECTOR, Writer, declarations, literal
from hygrokf.engine.step_codegen import Names, Symbols, seed
from hygrokf.engine.traced_filter import Block
from hygrokf.engine.wide_products import ROWS, functions
from hygrokf.engine.wide_recursion import WideRecursion
from hygrokf.physics.expression import Expression, forward, reverse

WIDE_COMMON = "known keys table key u y reset state work"
"""Numbers of the parameter stage; leaves and matrices of the keys; key, inputs, readings and resets of every
instant; moments before the first instant (replaced by the moments after the last one); workspace."""
WIDE_ARGUMENTS = {
    "value": "out",
    "trace": "out rows",
    "adjoint": "out first store tablebar knownbar statebar",
    "tangent": "out knowndot tabledot statedot e s edot sdot",
}
ZERO_LITERAL = literal(0.0)


def wide_text(recursion: WideRecursion, kind: str, gain: bool) -> str:
    """LLVM text of a module with one function, named after its kind: value, trace, adjoint or tangent.

    Without `gain`, readings do not correct the state.
    """
    emission = WideEmission(recursion, kind, gain)
    getattr(emission, "_" + kind)()
    return declarations() + functions() + emission.writer.text()


def workspace(r: WideRecursion) -> int:
    """Size of the workspace (`WIDE_COMMON`) in numbers."""
    line = r.rows * LANES
    return r.width * (2 * r.held + 16) + 3 * (r.held + 4) * line + 2 * len(r.columns) * (LANES + 1) + 64


class WideEmission(Emission):
    """LLVM text of one loop; the methods named after the kinds emit the whole of it.

    gain: whether readings correct the moments.  Arrays of the workspace: `x` holds [P; m'] F', `c` the row
    c', `v` a row of adjoints, `b` the drive, `before` P before the readings of the instant.
    """

    recursion: WideRecursion

    def __init__(self, recursion: WideRecursion, kind: str, gain: bool) -> None:
        self.recursion, self.gain = recursion, gain
        names = f"{WIDE_COMMON} {WIDE_ARGUMENTS[kind]}".split()
        w = self.writer = Writer(kind, [("i64", "count"), *(("ptr", name) for name in names)])
        self.n, self.width, self.line = recursion.n, recursion.width, recursion.rows * LANES
        self.tiles, self.strips = recursion.rows // ROWS, recursion.width // LANES
        self.size, self.mean = recursion.held * self.width, self.n * self.width
        self.at_parameters = {
            i: w.load(SCALAR, w.at(SCALAR, "%known", c)) for c, i in enumerate(recursion.parameter_nodes)
        }
        self.used = 0
        self.x, self.c, self.v = self._space(self.size), self._space(self.width), self._space(self.width)
        self.b = self._space(len(recursion.columns))
        self.before = self._space(self.size) if len(recursion.updates) > 1 else "%state"

    # -- arrays ----------------------------------------------------------------------------------------------
    def _space(self, count: int) -> str:
        """Reserve an array of the workspace, aligned to 64 bytes; returns its address."""
        address = self.writer.at(SCALAR, "%work", self.used)
        self.used += -(-count // LANES) * LANES
        return address

    def _at(self, base: str, row: str | int, width: int, column: str | int = 0) -> str:
        """Emit code for the address of an entry of a matrix with rows of `width` numbers; returns its
        register."""
        w = self.writer
        return w.at(SCALAR, base, w.integer("add", w.integer("mul", row, width), column))

    def _number(self, base: str, row: str | int, width: int = 1, column: str | int = 0) -> str:
        """Emit code that loads an entry; returns its register."""
        return self.writer.load(SCALAR, self._at(base, row, width, column))

    def _vector(self, base: str, row: str | int, width: int = LANES, column: str | int = 0) -> str:
        """Emit code that loads the vector which begins at an entry; returns its register."""
        return self.writer.load(VECTOR, self._at(base, row, width, column))

    def _add(self, pointer: str, a: str, b: str) -> None:
        """Emit code that adds the product of two vectors, lane by lane, to the vector at a pointer."""
        w = self.writer
        w.store(VECTOR, w.fma(VECTOR, [a, b, w.load(VECTOR, pointer)]), pointer)

    @contextmanager
    def _strip(self) -> Iterator[str]:
        """Emit a loop over the strips of a row; yields the register of a strip's first column."""
        with self.writer.loop(str(self.strips)) as s:
            yield self.writer.integer("mul", s, LANES)

    def _add_row(self, pointer: str, factor: str, row: str) -> None:
        """Emit code that adds `factor` times a row to the row at a pointer."""
        w = self.writer
        scale = w.splat(factor)
        with self._strip() as j:
            self._add(w.at(SCALAR, pointer, j), scale, self._vector(row, j, 1))

    def _dot(self, a: str, b: str) -> str:
        """Emit code for the scalar product of two rows; returns its register."""
        w = self.writer
        total = w.slot(VECTOR, "zeroinitializer")
        with self._strip() as j:
            self._add(total, self._vector(a, j, 1), self._vector(b, j, 1))
        sums = w.load(VECTOR, total)
        parts = [w.value(f"extractelement {VECTOR} {sums}, i64 {i}") for i in range(LANES)]
        while len(parts) > 1:
            parts = [w.real("fadd", left, right) for left, right in zip(parts[::2], parts[1::2], strict=True)]
        return parts[0]

    def _call(self, name: str, pointers: Sequence[str], *integers: str | int) -> None:
        """Emit a call of a function of `wide_products`."""
        arguments = [*(f"ptr {value}" for value in pointers), *(f"i64 {value}" for value in integers)]
        self.writer.line(f"call void @{name}({', '.join(arguments)})")

    def _product(self, result: str, plus: str, a: str, b: str, tiles: int, lower: bool = False) -> None:
        """Emit code for result = plus + a b of `tiles` tiles; with `lower` the result is symmetric, and only
        its lower triangle is computed and mirrored."""
        sizes = tiles, self.n, self.strips, self.width, 1, self.width, int(lower)
        self._call("product", [result, plus, a, b], *sizes)
        if lower:
            self._call("mirrored", [result], self.n, self.width)

    def _lane_product(
        self, result: str, plus: str, a: str, b: str, strips: int, *, turned: bool = False, inner: int = 0
    ) -> None:
        """Emit code for result = plus + a b, or a' b if `turned`, where an entry of b is a vector of
        tangents.

        strips: vectors in a row of b.  inner: terms of each sum, n by default.
        """
        down, across = (1, self.width) if turned else (self.width, 1)
        sizes = self.tiles, inner or self.n, strips, down, across, strips * LANES, 0
        self._call("product", [result, plus, a, b], *sizes)

    def _copy(self, target: str, source: str, count: int) -> None:
        """Emit code that copies `count` numbers."""
        arguments = f"ptr {target}, ptr {source}, i64 {8 * count}, i1 false"
        self.writer.line(f"call void @llvm.memcpy.p0.p0.i64({arguments})")

    def _matrices(self, k: str, base: str = "%table") -> list[str]:
        """Emit code for the addresses of F, F', N and the columns w_e of the step to instant k; returns their
        registers."""
        w, square = self.writer, self.width**2
        row = self._at(base, self._index("%key", k), 3 * square + len(self.recursion.columns) * self.width)
        return [w.at(SCALAR, row, i * square) for i in range(4)]

    def _clear_running_means(self, base: str, k: str, kind: str = SCALAR) -> None:
        """Emit code that sets rows and columns of the running means to zero at an instant where their
        interval begins."""
        r, w = self.recursion, self.writer
        width, zero = (self.width, ZERO_LITERAL) if kind == SCALAR else (r.rows, "zeroinitializer")
        for bit, state in enumerate(r.model.resets):
            flag = w.value(f"and i32 {w.load('i32', w.at('i32', '%reset', k))}, {1 << bit}")
            with w.when(w.value(f"icmp ne i32 {flag}, 0")), w.loop(str(self.n + 1)) as i:
                row = w.integer("mul", i, width)
                w.store(kind, zero, w.at(kind, base, w.integer("add", row, state)))
                is_state_row = w.value(f"icmp slt i64 {i}, {self.n}")
                with w.when(is_state_row):
                    w.store(kind, zero, w.at(kind, base, w.integer("add", i, state * width)))

    # -- forwards --------------------------------------------------------------------------------------------
    def _leaves(self, k: str) -> Names:
        """Emit code that loads the regimes at an instant; returns node → register of these and of the
        parameters."""
        return self._key_row(self._index("%key", k)) | self.at_parameters

    def _drive(self, k: str) -> Names:
        """Emit code that computes the drive of the step to instant k and stores it in `b`; returns the leaves
        of its expressions."""
        w, r = self.writer, self.recursion
        leaves = self._leaves(k) | self.inputs_between(k)
        for e, (_, name) in enumerate(w.block(r.graph, r.predict, leaves)):
            w.store(SCALAR, name, w.at(SCALAR, self.b, e))
        return leaves

    def _step(self, k: str) -> None:
        """Emit code that predicts the moments to an instant, before its readings, and leaves [P; m'] F' in
        `x`."""
        f, turned, noise, columns = self._matrices(k)
        self._drive(k)
        self._product(self.x, "null", "%state", turned, self.recursion.held // ROWS)
        self._product("%state", noise, f, self.x, self.tiles, lower=True)
        w, count = self.writer, len(self.recursion.columns)
        mean, transformed = (w.at(SCALAR, base, self.mean) for base in ("%state", self.x))
        self._call("combined", [mean, transformed, self.b, columns], count, self.strips, self.width)
        if self.before != "%state":
            self._copy(self.before, "%state", self.mean)

    def _measure(self, c: int, k: str) -> tuple[Names, Names, list[str]]:
        """Emit code that computes c = P H' of reading c and stores it in the array `c`; returns the leaves of
        its update, those of its head, and the registers of the non-zero entries of H."""
        w, r = self.writer, self.recursion
        means = {e.index: self._number("%state", self.mean + i) for i, e in enumerate(r.mean)}
        leaves = self._leaves(k) | self.inputs_at(k) | means
        values = [name for _, name in w.block(r.graph, r.updates[c], leaves)]
        row = values[2:]
        with self._strip() as j:
            total = "zeroinitializer"
            for h, i in zip(row, r.reads[c], strict=True):
                total = w.fma(VECTOR, [w.splat(h), self._vector("%state", i, self.width, j), total])
            w.store(VECTOR, total, w.at(SCALAR, self.c, j))
        crossed = [self._number(self.c, i) for i in r.reads[c]]
        head = {e.index: name for e, name in zip(r.leaves[c], [*values, *crossed], strict=True)}
        return leaves, head, row

    def _head(self, c: int, known: Names, y: str) -> list[str]:
        """Emit code for the head of reading c; returns the registers of e, S, e²/S, g and p.

        known: the leaves of the head.  y: register of the reading.
        """
        r = self.recursion
        return [name for _, name in self.writer.block(r.graph, r.heads[c], known | {r.reading.index: y})]

    def _count(self, c: int, head: Names, spread: str, quadratic: str, total: RunningSums) -> None:
        """Emit code that adds a reading to the sums, and records its variance given the readings before it
        and without any of its instant.

        head: leaves of its head.  spread, quadratic: registers of S and e²/S.
        """
        w, r, first = self.writer, self.recursion, spread
        total.take(w, spread, quadratic, r.square)
        if c:
            count, before = len(r.reads[c]), {}
            slopes, crossed = r.leaves[c][2 : 2 + count], r.leaves[c][2 + count :]
            for e, i in zip(crossed, r.reads[c], strict=True):
                before[e.index] = ZERO_LITERAL
                for h, j in zip(slopes, r.reads[c], strict=True):
                    p = self._number(self.before, i, self.width, j)
                    before[e.index] = w.fma(SCALAR, [head[h.index], p, before[e.index]])
            ((_, first),) = w.block(r.graph, [r.heads[c][1]], head | before)
        total.watch(w, c, spread, first)

    def _correct_moments(self, gain: str, push: str) -> None:
        """Emit code that corrects the moments by a reading with these factors g and p, and c in its array."""
        w = self.writer
        with w.loop(str(self.n)) as i:
            factor = w.real("fmul", w.value(f"fneg double {gain}"), self._number(self.c, i))
            self._add_row(self._at("%state", i, self.width), factor, self.c)
        self._add_row(w.at(SCALAR, "%state", self.mean), push, self.c)

    def _update(self, c: int, reading: tuple[str, str], k: str, total: RunningSums) -> None:
        """Emit code that counts one reading in the sums and corrects the moments by it, if it exists.

        reading: registers of its value and of the i1 whether it exists.
        """
        y, exists = reading
        with self.writer.when(exists):
            _, head, _ = self._measure(c, k)
            _, spread, quadratic, gain, push = self._head(c, head, y)
            self._count(c, head, spread, quadratic, total)
            if self.gain:
                self._correct_moments(gain, push)

    def _value(self) -> None:
        """Emit the loop that filters the readings and keeps the sums of the likelihood."""
        w, total = self.writer, RunningSums(self.writer, len(self.recursion.updates))
        with w.loop("%count") as k:
            self._step(k)
            for c, reading in enumerate(self._readings(k)):
                self._update(c, reading, k, total)
            self._clear_running_means("%state", k)
        total.write(w, "%out")

    def _trace(self) -> None:
        """Emit the loop that writes one row for each instant: moments before the readings; prediction and
        variance of every output; moments after the readings."""
        w, r = self.writer, self.recursion
        total = RunningSums(w, len(r.updates))
        pairs = 2 * len(r.updates)
        with w.loop("%count") as k:
            self._step(k)
            row = self._at("%rows", k, 2 * self.size + pairs)
            self._copy(row, "%state", self.size)
            for c, reading in enumerate(self._readings(k)):
                _, head, _ = self._measure(c, k)
                w.store(SCALAR, head[r.leaves[c][0].index], w.at(SCALAR, row, self.size + 2 * c))
                w.store(
                    SCALAR, self._head(c, head, ZERO_LITERAL)[1], w.at(SCALAR, row, self.size + 2 * c + 1)
                )
                self._update(c, reading, k, total)
            self._copy(w.at(SCALAR, row, self.size + pairs), "%state", self.size)
            self._clear_running_means("%state", k)
        total.write(w, "%out")

    # -- backwards -------------------------------------------------------------------------------------------
    def _adjoint(self) -> None:
        """Emit the loops of the score: a forward pass that stores the moments, and a backward pass that
        propagates the adjoints."""
        w, total = self.writer, RunningSums(self.writer, len(self.recursion.updates))
        count = len(self.recursion.updates)
        # store: for every instant the moments before each reading and after the last one
        with w.loop("%count") as k:
            self._step(k)
            for c, reading in enumerate(self._readings(k)):
                self._copy(self._stored(k, c), "%state", self.size)
                self._update(c, reading, k, total)
            self._clear_running_means("%state", k)
            self._copy(self._stored(k, count), "%state", self.size)
        total.write(w, "%out")
        with w.loop("%count", backwards=True) as k:
            self._clear_running_means("%statebar", k)
            for c, (y, exists) in reversed(list(enumerate(self._readings(k)))):
                with w.when(exists):
                    self._copy("%state", self._stored(k, c), self.size)
                    self._reverse_reading(c, y, k)
            is_first = w.value(f"icmp eq i64 {k}, 0")
            previous = self._stored(w.integer("sub", k, 1), count)
            self._copy("%state", w.value(f"select i1 {is_first}, ptr %first, ptr {previous}"), self.size)
            self._reverse_step(k)

    def _stored(self, k: str, c: int) -> str:
        """Emit code for the address of the stored moments before reading c of an instant; returns its
        register."""
        return self._at("%store", k, (len(self.recursion.updates) + 1) * self.size, c * self.size)

    def _reverse_reading(self, c: int, y: str, k: str) -> None:
        """Emit code that propagates the adjoints back through reading c of an instant, whose moments are in
        `%state`.  y: register of the reading."""
        w, r, g = self.writer, self.recursion, self.recursion.graph
        leaves, head, row = self._measure(c, k)
        _, _, _, gain, push = self._head(c, head, y)
        mean = w.at(SCALAR, "%statebar", self.mean)
        self._call("combined", [self.v, "null", self.c, "%statebar"], self.n, self.strips, self.width)
        bars = [g.symbol(f"bar:{word}") for word in ("gain", "push")]
        known = {
            r.reading.index: y,
            bars[0].index: w.value(f"fneg double {self._dot(self.c, self.v)}"),
            bars[1].index: self._dot(self.c, mean),
        }
        _, spread, quadratic, *ends = r.heads[c]
        slopes = [-0.5 / spread, g.lift(-0.5 * r.term_derivative(quadratic)), *bars]
        seeds: Symbols = {}
        for e, slope in zip((spread, quadratic, *ends), slopes, strict=True):
            seed(seeds, e, slope)
        adjoints = reverse(g, seeds, [e.index for e in r.leaves[c]])
        outputs = [adjoints.get(e.index, g.constant(0.0)) for e in r.leaves[c]]
        values = [name for _, name in w.block(g, outputs, head | known)]
        direct, crossed = values[: 2 + len(row)], values[2 + len(row) :]
        # v holds P̄ c so far, and c̄ from here on
        minus_two_gain, push_vector = w.splat(w.real("fmul", literal(-2.0), gain)), w.splat(push)
        with self._strip() as j:
            total = w.value(f"fmul {VECTOR} {push_vector}, {self._vector(mean, j, 1)}")
            pointer = w.at(SCALAR, self.v, j)
            w.store(VECTOR, w.fma(VECTOR, [minus_two_gain, w.load(VECTOR, pointer), total]), pointer)
        for i, bar in zip(r.reads[c], crossed, strict=True):
            accumulate(w, bar, w.at(SCALAR, self.v, i))
        for a, (i, h) in enumerate(zip(r.reads[c], row, strict=True)):
            along_p = self._dot(self.v, w.at(SCALAR, "%state", i * self.width))
            direct[2 + a] = w.real("fadd", direct[2 + a], along_p)
            half_h = w.real("fmul", literal(0.5), h)
            self._add_row(w.at(SCALAR, "%statebar", i * self.width), half_h, self.v)
            with w.loop(str(self.n)) as j:
                share = w.real("fmul", half_h, self._number(self.v, j))
                accumulate(w, share, self._at("%statebar", j, self.width, i))
        self._pull_back(r.updates[c], direct, leaves)

    def _pull_back(self, block: Block, bars: Sequence[str], leaves: Names) -> None:
        """Emit code that propagates the adjoints of a block, one register each in `bars`, to the mean and to
        the parameter stage."""
        w, r, g = self.writer, self.recursion, self.recursion.graph
        symbols = [g.symbol(f"bar:{i}") for i in range(len(block))]
        seeds: Symbols = {}
        for e, symbol in zip(block, symbols, strict=True):
            seed(seeds, e, symbol)
        places = {e.index: ("%statebar", self.mean + i) for i, e in enumerate(r.mean)}
        places |= {i: ("%knownbar", c) for c, i in enumerate(r.parameter_nodes)}
        adjoints = reverse(g, seeds, places)
        known = leaves | {s.index: bar for s, bar in zip(symbols, bars, strict=True)}
        for i, (_, name) in zip(adjoints, w.block(g, list(adjoints.values()), known), strict=True):
            accumulate(w, name, w.at(SCALAR, *places[i]))

    def _reverse_step(self, k: str) -> None:
        """Emit code that propagates the adjoints back through the step to an instant."""
        w, r = self.writer, self.recursion
        f, turned, _, columns = self._matrices(k)
        f_bar, _, noise_bar, columns_bar = self._matrices(k, "%tablebar")
        leaves = self._drive(k)
        mean = w.at(SCALAR, "%statebar", self.mean)
        self._product(self.x, "null", "%statebar", f, r.held // ROWS)
        self._product(f_bar, f_bar, self.x, "%state", self.tiles)  # half of F̄
        one = literal(1.0)
        with w.loop(str(self.n)) as i:
            half = w.real("fmul", literal(0.5), self._number(mean, i))
            row = w.at(SCALAR, "%state", self.mean)
            self._add_row(self._at(f_bar, i, self.width), half, row)
            row = self._at("%statebar", i, self.width)
            self._add_row(self._at(noise_bar, i, self.width), one, row)
        bars = []
        for e in range(len(r.columns)):
            self._add_row(w.at(SCALAR, columns_bar, e * self.width), self._number(self.b, e), mean)
            bars.append(self._dot(w.at(SCALAR, columns, e * self.width), mean))
        self._product("%statebar", "null", turned, self.x, self.tiles, lower=True)
        self._copy(mean, w.at(SCALAR, self.x, self.mean), self.width)
        self._pull_back(r.predict, bars, leaves)

    # -- along directions ------------------------------------------------------------------------------------
    def _tangent(self) -> None:
        """Emit the loop that computes innovations, variances and the derivatives of both along `LANES`
        directions."""
        w, r, g = self.writer, self.recursion, self.recursion.graph
        total = RunningSums(w, len(r.updates))
        estimated = set(r.estimated_nodes)
        self.dots = {i: g.symbol(f"dot:{i}") for i in r.parameter_nodes if i in estimated}
        self.vectors = {
            self.dots[i].index: self._vector("%knowndot", c)
            for c, i in enumerate(r.parameter_nodes)
            if i in self.dots
        }
        self.moved, self.turned = self._space(r.held * self.line), self._space(r.rows * self.line)
        self.c_dot, self.t = self._space(self.line), self._space(self.line)
        self.b_dot = self._space(len(r.columns) * LANES)
        with w.loop("%count") as k:
            self._step_tangent(k)
            place = w.integer("mul", k, len(r.updates))
            for c, (y, exists) in enumerate(self._readings(k)):
                with w.when(exists):
                    self._reading_tangent(c, y, k, w.integer("add", place, c), total)
            self._clear_running_means("%state", k)
            self._clear_running_means("%statedot", k, VECTOR)
        total.write(w, "%out")

    def _along(
        self, outputs: Sequence[Expression], dots: Symbols, leaves: Names, vectors: Names
    ) -> list[str]:
        """Emit code for the tangents of expressions; returns the registers of vectors.

        dots: node → symbol of its tangent.  vectors: symbol of a tangent → register.
        """
        w, g = self.writer, self.recursion.graph
        derivatives = w.block(g, forward(g, outputs, dots), leaves | vectors, list(vectors))
        return [w.as_vector(*item) for item in derivatives]

    def _step_tangent(self, k: str) -> None:
        """Emit code that predicts the moments and their tangents to an instant, before its readings."""
        w, r = self.writer, self.recursion
        f, _, _, columns = self._matrices(k)
        rows, line, count = r.rows, self.line, len(r.columns)
        f_dot = self._at("%tabledot", self._index("%key", k), (2 * rows + count) * line)
        noise_dot, columns_dot = (w.at(SCALAR, f_dot, i * rows * line) for i in (1, 2))
        with w.loop(str(self.n + 1)) as i:
            pair = [self._at(base, i, line) for base in (self.moved, "%statedot")]
            self._lane_product(pair[0], "null", f, pair[1], 1)
        of_mean = w.at(SCALAR, self.moved, self.n * line)
        mean = w.at(SCALAR, "%state", self.mean)
        self._call("combined", [of_mean, of_mean, mean, f_dot], self.n, rows, line)
        leaves = self._drive(k)
        for e, name in enumerate(self._along(r.predict, self.dots, leaves, self.vectors)):
            w.store(VECTOR, name, w.at(VECTOR, self.b_dot, e))
        self._call("combined", [of_mean, of_mean, self.b, columns_dot], count, rows, line)
        if count:
            self._lane_product(of_mean, of_mean, columns, self.b_dot, 1, turned=True, inner=count)
        self._step(k)
        self._lane_product(self.turned, "null", self.x, f_dot, rows, turned=True)
        self._lane_product("%statedot", noise_dot, f, self.moved, rows)
        with w.loop(str(self.n)) as i, w.loop(str(self.n)) as j:
            total = self._vector("%statedot", i, line, w.integer("mul", j, LANES))
            for row, column in ((i, j), (j, i)):
                entry = self._vector(self.turned, row, line, w.integer("mul", column, LANES))
                total = w.value(f"fadd {VECTOR} {total}, {entry}")
            w.store(VECTOR, total, self._at("%statedot", i, line, w.integer("mul", j, LANES)))
        self._copy(w.at(SCALAR, "%statedot", self.n * line), of_mean, line)

    def _reading_tangent(self, c: int, y: str, k: str, place: str, total: RunningSums) -> None:
        """Emit code that counts reading c, stores its innovation, its variance and the tangents of both at
        `place`, and corrects the moments and their tangents by it."""
        w, r, g = self.writer, self.recursion, self.recursion.graph
        leaves, head, row = self._measure(c, k)
        error, spread, quadratic, gain, push = self._head(c, head, y)
        self._count(c, head, spread, quadratic, total)
        mean_dot = w.at(SCALAR, "%statedot", self.n * self.line)
        mean_dots = {e.index: g.symbol(f"dot:{e.index}") for e in r.mean}
        vectors = {s.index: self._vector(mean_dot, i) for i, s in enumerate(mean_dots.values())}
        leaf_dots = self._along(r.updates[c], self.dots | mean_dots, leaves, self.vectors | vectors)
        with w.loop(str(self.n)) as i:
            cross = "zeroinitializer"
            for state, h, h_dot in zip(r.reads[c], row, leaf_dots[2:], strict=True):
                p = w.splat(self._number("%state", i, 1, state * self.width))
                cross = w.fma(VECTOR, [h_dot, p, cross])
                covariance_dot = self._vector("%statedot", i, LANES, state * self.line)
                cross = w.fma(VECTOR, [w.splat(h), covariance_dot, cross])
            w.store(VECTOR, cross, self._at(self.c_dot, i, LANES))
        leaf_dots += [self._vector(self.c_dot, i) for i in r.reads[c]]
        dots = {e.index: g.symbol(f"dot:{e.index}") for e in r.leaves[c]}
        vectors = {s.index: name for s, name in zip(dots.values(), leaf_dots, strict=True)}
        head_dots = self._along(r.heads[c], dots, head | {r.reading.index: y}, vectors)
        w.store(SCALAR, error, w.at(SCALAR, "%e", place))
        w.store(SCALAR, spread, w.at(SCALAR, "%s", place))
        w.store(VECTOR, head_dots[0], w.at(VECTOR, "%edot", place))
        w.store(VECTOR, head_dots[1], w.at(VECTOR, "%sdot", place))
        if self.gain:
            self._correct_tangents(gain, push, head_dots[3], head_dots[4], mean_dot)
            self._correct_moments(gain, push)

    def _correct_tangents(self, gain: str, push: str, gain_dot: str, push_dot: str, mean_dot: str) -> None:
        """Emit code that corrects the tangents of the moments by a reading; the array `t` holds −t of the
        module's formulas."""
        w = self.writer
        half_gain_dot = w.value(f"fmul {VECTOR} {gain_dot}, {w.splat(literal(-0.5))}")
        minus_gain, push_vector = w.splat(w.value(f"fneg double {gain}")), w.splat(push)
        with w.loop(str(self.n)) as i:
            c_dot, c = self._vector(self.c_dot, i), w.splat(self._number(self.c, i))
            self._add(self._at(mean_dot, i, LANES), push_vector, c_dot)
            self._add(self._at(mean_dot, i, LANES), push_dot, c)
            t = w.fma(VECTOR, [minus_gain, c_dot, w.value(f"fmul {VECTOR} {half_gain_dot}, {c}")])
            w.store(VECTOR, t, self._at(self.t, i, LANES))
        with w.loop(str(self.n)) as i:
            t, c = self._vector(self.t, i), w.splat(self._number(self.c, i))
            with w.loop(str(self.n)) as j:
                pointer = self._at("%statedot", i, self.line, w.integer("mul", j, LANES))
                self._add(pointer, t, w.splat(self._number(self.c, j)))
                self._add(pointer, c, self._vector(self.t, j))
