"""Compiled code against the interpreter, and the cache of compiled code on disk."""

from __future__ import annotations

import math
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from hygrokf.engine import jit
from hygrokf.engine.jit import CompiledCode, cache_directory, has_fused_multiply_add
from hygrokf.engine.llvm_writer import SCALAR, Writer, declarations, literal
from hygrokf.physics.expression import Expression, Graph, exp, log, maximum, sqrt, where

NAMES = ("x", "y", "z")


@pytest.fixture
def fresh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache on disk and a process that has compiled nothing yet."""
    monkeypatch.setenv("HYGROKF_CACHE", str(tmp_path / "cache"))
    # the engines made here must outlive the code objects of the test
    monkeypatch.setattr(jit, "_engines", {})
    return tmp_path / "cache"


def doubling(factor: float = 2.0) -> str:
    """Text of `f(count, x, out)`: out[i] = factor x[i]."""
    w = Writer("f", [("i64", "count"), ("ptr", "x"), ("ptr", "out")])
    with w.loop("%count") as i:
        w.store(
            SCALAR,
            w.real("fmul", w.load(SCALAR, w.at(SCALAR, "%x", i)), literal(factor)),
            w.at(SCALAR, "%out", i),
        )
    return declarations() + w.text()


def run_doubling(text: str) -> np.ndarray:
    x, out = np.arange(5.0), np.zeros(5)
    CompiledCode(text, ["f"])("f", 5, x, out)
    return out


def formulas(graph: Graph) -> list[Expression]:
    x, y, z = (graph.symbol(name) for name in NAMES)
    return [
        x * y + z,
        x - y * z,
        exp(0.3 * x) / (1.0 + y * y),
        log(2.0 + z * z) - sqrt(1.0 + x * x),
        where(x < y, x * z, y - z),
        maximum(x, z) * y,
        -x,
        0.1 * z + 1e-300,
        where(x < y, 1.0, 0.0),
    ]


POINTS = np.random.default_rng(3).normal(size=(20, 3))


def test_compiled_blocks_compute_what_the_interpreter_computes() -> None:
    graph = Graph()
    outputs = formulas(graph)
    w = Writer("f", [("ptr", "in"), ("ptr", "out")])
    leaves = {graph.symbol(n).index: w.load(SCALAR, w.at(SCALAR, "%in", i)) for i, n in enumerate(NAMES)}
    for i, (kind, value) in enumerate(w.block(graph, outputs, leaves)):
        assert kind == SCALAR
        w.store(SCALAR, value, w.at(SCALAR, "%out", i))
    code = CompiledCode(declarations() + w.text(), ["f"])
    for point in POINTS:
        out = np.zeros(len(outputs))
        code("f", np.ascontiguousarray(point), out)
        expected = graph.evaluate(outputs, dict(zip(NAMES, point, strict=True)))
        # the processor rounds a fused product and sum once, the interpreter twice
        np.testing.assert_allclose(out, np.array(expected, dtype=float), rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize("value", [0.0, -0.0, 1.0, math.pi, 5e-324, 1e308, math.inf, -math.inf])
def test_literals_are_exact(value: float) -> None:
    w = Writer("f", [("ptr", "out")])
    w.store(SCALAR, literal(value), "%out")
    out = np.ones(1)
    CompiledCode(declarations() + w.text(), ["f"])("f", out)
    assert out[0] == value and math.copysign(1.0, out[0]) == math.copysign(1.0, value)


@pytest.mark.skipif(not has_fused_multiply_add(), reason="this processor has no fused multiply-add")
def test_a_fused_node_rounds_once() -> None:
    graph = Graph()
    x, y, z = (graph.symbol(name) for name in NAMES)
    w = Writer("f", [("ptr", "in"), ("ptr", "out")])
    leaves = {s.index: w.load(SCALAR, w.at(SCALAR, "%in", i)) for i, s in enumerate((x, y, z))}
    w.store(SCALAR, w.block(graph, [x * y + z], leaves)[0][1], "%out")
    tiny = 2.0**-52
    out = np.zeros(1)
    CompiledCode(declarations() + w.text(), ["f"])("f", np.array([1.0 + tiny, 1.0 - tiny, -1.0]), out)
    assert out[0] == -(tiny**2)  # rounding the product first would leave zero


def test_numbers_that_decay_out_of_range_are_zero_inside_compiled_code_alone(fresh: Path) -> None:
    """Below 2.2e-308 a product is 0, which keeps decaying variances fast; outside it keeps its digits."""
    x, out = np.array([1e-300, 1e-310]), np.full(2, np.nan)
    CompiledCode(doubling(1e-9), ["f"])("f", 2, x, out)
    flushed = bool(jit.without_subnormals()[1])
    assert bool(out[0] == 0.0) is flushed and bool(out[1] == 0.0) is flushed
    assert 0.0 < x[0] * 1e-9 < 1e-308


def test_code_is_kept_on_disk_and_taken_from_there(fresh: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    np.testing.assert_array_equal(run_doubling(doubling()), 2.0 * np.arange(5))
    files = list(fresh.rglob("*.o"))
    assert len(files) == 1
    if sys.platform != "win32":
        assert files[0].parent.stat().st_mode & 0o077 == 0  # loading it means running it: for the user alone
    before = files[0].read_bytes()
    kept = dict(jit._engines)
    monkeypatch.setattr(jit, "_engines", {})

    def refuse(*_: object) -> None:
        raise AssertionError("compiled although the object is on disk")

    with monkeypatch.context() as patch:
        patch.setattr(jit.llvm, "create_pass_builder", refuse)
        np.testing.assert_array_equal(run_doubling(doubling()), 2.0 * np.arange(5))
    assert files[0].read_bytes() == before and kept
    run_doubling(doubling(3.0))
    assert len(list(fresh.rglob("*.o"))) == 2  # other text, other object


def test_text_is_written_once_for_each_source_and_each_version_of_what_writes_it(
    fresh: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[float] = []

    def run(factor: float, source: str) -> float:
        def write() -> str:
            written.append(factor)
            return doubling(factor)

        x, out = np.ones(1), np.zeros(1)
        kept.append(CompiledCode(write, ["f"], source))
        kept[-1]("f", 1, x, out)
        return float(out[0])

    kept: list[CompiledCode] = []
    for _ in range(2):  # within a process, and in another one that begins with the cache on disk
        assert run(2.0, "two") == 2.0 and run(3.0, "three") == 3.0 and run(2.0, "two") == 2.0
        monkeypatch.setattr(jit, "_engines", {})
    assert written == [2.0, 3.0]
    note = jit._cache_entry(f"{jit._writers_digest()}\ntwo", "key")[1]
    note.write_bytes(note.read_bytes()[:-1])  # not whole
    assert run(2.0, "two") == 2.0 and written == [2.0, 3.0, 2.0]
    jit._cache_entry(doubling(2.0), "o")[1].unlink()  # the note alone remains
    monkeypatch.setattr(jit, "_engines", {})
    assert run(2.0, "two") == 2.0 and written[3:] == [2.0]
    monkeypatch.setattr(jit, "_writers_digest", lambda: "a later version that writes other text")
    assert run(5.0, "two") == 5.0 and written[4:] == [5.0]


@pytest.mark.parametrize(
    "damage", [lambda b: b[: len(b) // 2], lambda b: b"", lambda b: b[:100] + b"\0" * 8 + b[108:]]
)
def test_a_damaged_object_is_compiled_anew(
    fresh: Path, monkeypatch: pytest.MonkeyPatch, damage: object
) -> None:
    run_doubling(doubling())
    file = next(fresh.rglob("*.o"))
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    kept = dict(jit._engines)
    monkeypatch.setattr(jit, "_engines", {})
    np.testing.assert_array_equal(run_doubling(doubling()), 2.0 * np.arange(5))
    assert file.read_bytes() == whole and kept
    assert not list(fresh.rglob("*.tmp"))


def test_a_cache_that_cannot_be_written_costs_time_only(fresh: Path) -> None:
    fresh.write_text("a file stands where the folder should be")
    np.testing.assert_array_equal(run_doubling(doubling()), 2.0 * np.arange(5))


def test_the_cache_is_where_it_is_stated_to_be(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HYGROKF_CACHE", str(tmp_path))
    assert cache_directory() == tmp_path
    monkeypatch.delenv("HYGROKF_CACHE")
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache_directory() == tmp_path / "xdg" / "hygrokf"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_directory() == Path(os.path.expanduser("~")) / ".cache" / "hygrokf"


def test_arrays_that_are_not_contiguous_are_refused() -> None:
    code = CompiledCode(doubling(), ["f"])
    with pytest.raises(ValueError, match="contiguous"):
        code("f", 3, np.arange(6.0)[::2], np.zeros(3))


def test_a_leaf_without_a_value_is_named() -> None:
    graph = Graph()
    with pytest.raises(KeyError, match="'x'"):
        Writer("f", []).block(graph, [graph.symbol("x") + graph.symbol("y")], {})
