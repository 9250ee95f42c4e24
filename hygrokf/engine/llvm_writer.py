"""LLVM text of expression graphs: straight-line blocks between hand-written loops.

`Writer` holds the text of one function.  Blocks are emitted at the current position from a mapping of leaf
nodes to values; loops and conditions are context managers whose counters are stack slots (LLVM turns them
into registers). Scalars are `double`; vectors have one lane for each of several directions (tangents) or
runs.

Nothing is computed while the text is written.  What these functions take and return for a number is its name
in the text: that of a *register*, such as "%v12", which is assigned once, or a literal.  A *slot* is the name
of an address on the stack, whose number can be stored anew; a *pointer* is any address.  The *kind* of a
value is its LLVM type: `SCALAR`, a vector, "i64" and so on; the *leaves* of a block are the nodes whose
values are in registers already.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

from hygrokf.engine.jit import has_fused_multiply_add, without_subnormals
from hygrokf.physics.expression import Expression, Graph

LANES = 8
"""Lanes for tangents."""
RUNS = 4
"""Lanes for runs side by side: fewer than for tangents, because registers are scarce."""
SCALAR = "double"
VECTOR = f"<{LANES} x double>"
TRUTH = "i1"

_OPERATION = {"add": "fadd", "sub": "fsub", "mul": "fmul", "div": "fdiv"}


def declarations() -> str:
    """Declarations that every module needs."""
    lines = [without_subnormals()[0]]
    for kind in (SCALAR, VECTOR, vector(RUNS)):
        lines.append(f"declare {kind} @llvm.fma.{_suffix(kind)}({kind}, {kind}, {kind})")
        lines += [f"declare {kind} @llvm.{name}.{_suffix(kind)}({kind})" for name in ("exp", "log", "sqrt")]
    return "\n".join(lines) + "\n"


def vector(lanes: int, of: str = SCALAR) -> str:
    """The LLVM type of a vector of numbers, or of truth values."""
    return f"<{lanes} x {of}>"


def _suffix(kind: str) -> str:
    return "f64" if kind == SCALAR else f"v{kind[1:].split()[0]}f64"


class Writer:
    """Text of one LLVM function `void name(arguments)` with vectors of `lanes` lanes.

    functions: operation → function of the module that computes it for vectors (see `cell_loop`).
    """

    def __init__(
        self,
        name: str,
        arguments: Sequence[tuple[str, str]],
        lanes: int = LANES,
        functions: Mapping[str, str] | None = None,
    ) -> None:
        self._name = name
        self.lanes = lanes
        self._functions = functions or {}
        self.vector = vector(lanes)
        self.truths = vector(lanes, TRUTH)
        self._arguments = arguments
        self._slots: list[str] = []
        self._lines: list[str] = []
        self._count = 0

    def inner_text(self) -> str:
        """The text of a function that is called only within its module and is not inlined."""
        return self._text("internal void", "noinline ", "", "")

    def text(self) -> str:
        _, enter, leave = without_subnormals()
        return self._text("void", "", enter, leave)

    def _text(self, kind: str, attribute: str, enter: str, leave: str) -> str:
        # `noalias` holds by construction: callers pass separate arrays
        kinds = {"ptr": "ptr noalias nocapture"}
        arguments = ", ".join(f"{kinds.get(kind, kind)} %{name}" for kind, name in self._arguments)
        body = "\n".join([*self._slots, *self._lines])
        head = f"define {kind} @{self._name}({arguments}) {attribute}{{"
        return f"{head}\nentry:\n{enter}{body}\n{leave}  ret void\n}}\n"

    # -- plain instructions ----------------------------------------------------------------------------------
    def line(self, text: str) -> None:
        """Emit an instruction without a result."""
        self._lines.append("  " + text)

    def value(self, text: str) -> str:
        """Emit an instruction; returns the register of its result."""
        self._count += 1
        name = f"%v{self._count}"
        self._lines.append(f"  {name} = {text}")
        return name

    def slot(self, kind: str, initial: str | None = None) -> str:
        """A new stack slot, allocated in the entry block; emits code that sets it to `initial` at the current
        position."""
        self._count += 1
        name = f"%s{self._count}"
        self._slots.append(f"  {name} = alloca {kind}")
        if initial is not None:
            self.line(f"store {kind} {initial}, ptr {name}")
        return name

    def load(self, kind: str, pointer: str) -> str:
        """Emit code that loads a value; returns its register."""
        return self.value(f"load {kind}, ptr {pointer}, align {_align(kind)}")

    def store(self, kind: str, value: str, pointer: str) -> None:
        """Emit code that stores a value."""
        self.line(f"store {kind} {value}, ptr {pointer}, align {_align(kind)}")

    def at(self, kind: str, base: str, index: str | int) -> str:
        """Emit code for the address of element `index` of an array of `kind`; returns its register."""
        return self.value(f"getelementptr {kind}, ptr {base}, i64 {index}")

    def integer(self, operation: str, a: str | int, b: str | int) -> str:
        """Emit an operation on two i64; returns the register of its result."""
        return self.value(f"{operation} i64 {a}, {b}")

    def real(self, operation: str, a: str, b: str) -> str:
        """Emit an operation on two doubles; returns the register of its result."""
        return self.value(f"{operation} double {a}, {b}")

    # -- control flow ----------------------------------------------------------------------------------------
    def _label(self, name: str) -> str:
        """A new label that begins with `name`."""
        self._count += 1
        return f"{name}{self._count}"

    @contextmanager
    def loop(self, count: str, *, backwards: bool = False) -> Iterator[str]:
        """Emit the loop `for i in range(count)`, or its reverse, around the code emitted meanwhile; yields
        the register of i."""
        counter = self.slot("i64", "0")
        with self._repeated(counter, f"slt i64 {{}}, {count}") as i:
            yield self.integer("sub", self.integer("sub", count, 1), i) if backwards else i
            self.store("i64", self.integer("add", i, 1), counter)

    @contextmanager
    def during(self, going: str) -> Iterator[None]:
        """Emit a loop around the code emitted meanwhile, which runs as long as the i64 in the slot `going` is
        not 0."""
        with self._repeated(going, "ne i64 {}, 0"):
            yield

    @contextmanager
    def _repeated(self, slot: str, comparison: str) -> Iterator[str]:
        """Emit a loop that runs as long as the `comparison` of the i64 in a slot holds; yields the register
        of the i64."""
        head, body, done = (self._label(x) for x in ("head", "body", "done"))
        self.line(f"br label %{head}")
        self._lines.append(f"{head}:")
        value = self.load("i64", slot)
        test = self.value(f"icmp {comparison.format(value)}")
        self.line(f"br i1 {test}, label %{body}, label %{done}")
        self._lines.append(f"{body}:")
        yield value
        self.line(f"br label %{head}")
        self._lines.append(f"{done}:")

    @contextmanager
    def when(self, condition: str) -> Iterator[None]:
        """Emit a condition: the code emitted meanwhile runs only if the i1 `condition` holds.  Its results
        must leave it through slots or memory, not through registers."""
        body, done = self._label("then"), self._label("after")
        self.line(f"br i1 {condition}, label %{body}, label %{done}")
        self._lines.append(f"{body}:")
        yield
        self.line(f"br label %{done}")
        self._lines.append(f"{done}:")

    # -- blocks of the graph ---------------------------------------------------------------------------------
    def block(
        self,
        graph: Graph,
        outputs: Sequence[Expression],
        leaves: Mapping[int, str],
        vectors: Sequence[int] = (),
    ) -> list[tuple[str, str]]:
        """Emit code that computes `outputs` from `leaves` (node → its register); returns (kind, register) of
        each output.

        `vectors` lists the leaves that are vectors.
        """
        wide = set(vectors)
        kinds: dict[int, str] = {i: self.vector if i in wide else SCALAR for i in leaves}
        names: dict[int, str] = dict(leaves)
        splats: dict[str, str] = {}

        def operand(i: int, kind: str) -> str:
            name = names[i]
            if kind == kinds[i] or kinds[i] in (TRUTH, self.truths):
                return name
            if name not in splats:
                splats[name] = self.splat(name)
            return splats[name]

        for i in graph.needed(outputs, leaves):
            if i in names:
                continue
            node = graph.nodes[i]
            operation = node[0]
            if operation == "const":
                names[i], kinds[i] = literal(node[1]), SCALAR
                continue
            if operation == "symbol":
                raise KeyError(f"no value for the leaf {node[1]!r}")
            kind = self.vector if any(kinds[j] in (self.vector, self.truths) for j in node[1:]) else SCALAR
            kinds[i] = kind
            a = [operand(j, kind) for j in node[1:]]
            match operation:
                case "add" | "sub" | "mul" | "div":
                    names[i] = self.value(f"{_OPERATION[operation]} {kind} {a[0]}, {a[1]}")
                case "neg":
                    names[i] = self.value(f"fneg {kind} {a[0]}")
                case "fma":
                    names[i] = self.fma(kind, a)
                case "lt":
                    names[i] = self.value(f"fcmp olt {kind} {a[0]}, {a[1]}")
                    kinds[i] = TRUTH if kind == SCALAR else self.truths
                case "select":
                    truth = kinds[node[1]]
                    names[i] = self.value(f"select {truth} {a[0]}, {kind} {a[1]}, {kind} {a[2]}")
                case _:
                    called = f"llvm.{operation}.{_suffix(kind)}"
                    if kind == self.vector:
                        called = self._functions.get(operation, called)
                    names[i] = self.value(f"call {kind} @{called}({kind} {a[0]})")
        return [(kinds[e.index], names[e.index]) for e in outputs]

    def fma(self, kind: str, a: Sequence[str]) -> str:
        """Emit a₀ a₁ + a₂ of three values; returns the register of the result."""
        if has_fused_multiply_add():
            three = ", ".join(f"{kind} {value}" for value in a)
            return self.value(f"call {kind} @llvm.fma.{_suffix(kind)}({three})")
        return self.value(f"fadd {kind} {self.value(f'fmul {kind} {a[0]}, {a[1]}')}, {a[2]}")

    def as_vector(self, kind: str, value: str) -> str:
        """The register of a value as a vector: a tangent that is zero for structural reasons is a scalar
        constant, which is copied to every lane."""
        return value if kind == self.vector else self.splat(value)

    def splat(self, value: str) -> str:
        """Emit code that copies a double to every lane of a vector; returns the vector's register."""
        first = self.value(f"insertelement {self.vector} poison, double {value}, i64 0")
        mask = f"<{self.lanes} x i32> zeroinitializer"
        return self.value(f"shufflevector {self.vector} {first}, {self.vector} poison, {mask}")


def _align(kind: str) -> int:
    """Minimum alignment [bytes] of numpy arrays of this kind."""
    return 4 if kind == "i32" else 8


def literal(value: float) -> str:
    """A double in LLVM's exact hexadecimal form."""
    return f"0x{struct.unpack('>Q', struct.pack('>d', value))[0]:016X}"
