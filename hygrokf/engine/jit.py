"""LLVM text in, callable machine code out, kept on disk between runs.

The compiler is LLVM through llvmlite, the one that numba is made of.  Straight-line filter code of a thousand
operations compiles here in a tenth of a second; the same code through numba's front end takes four (docs/decisions).

Object code is cached under `$HYGROKF_CACHE` (default: the user's cache directory), keyed by the text, the compiler
version and the processor.  The cache is private to the user, as loading it means running it.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from threading import Lock

import numpy as np
from llvmlite import binding as llvm


def cache_directory() -> Path:
    """Where compiled code is kept: `$HYGROKF_CACHE`, else the platform's user cache directory."""
    stated = os.environ.get("HYGROKF_CACHE")
    if stated:
        return Path(stated)
    if sys.platform == "win32":
        root = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    elif sys.platform == "darwin":
        root = Path.home() / "Library" / "Caches"
    else:
        root = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return root / "hygrokf"


def _machine() -> llvm.TargetMachine:
    """A new target machine (an engine takes ownership of the one it is given)."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    return llvm.Target.from_default_triple().create_target_machine(
        opt=2,
        cpu=llvm.get_host_cpu_name(),
        features=llvm.get_host_cpu_features().flatten(),
        jit=True,
    )


@cache
def _identity() -> str:
    """What the meaning of compiled code depends on besides its text."""
    features = llvm.get_host_cpu_features().flatten()
    return f"{llvm.llvm_version_info} {llvm.get_process_triple()} {llvm.get_host_cpu_name()} {features}"


@cache
def has_fused_multiply_add() -> bool:
    """Whether the processor rounds a b + c once; without it the compiled code rounds twice (and stays fast)."""
    arm = llvm.get_process_triple().startswith(("aarch64", "arm64"))
    return arm or bool(llvm.get_host_cpu_features().get("fma", False))


_engines: dict[
    str, llvm.ExecutionEngine
] = {}  # for the life of the process: code that may run is never freed
_compiling = Lock()
"""Held while code is compiled: a second engine of the same code would take the place of the first and free what runs."""


def _engine(text: str) -> llvm.ExecutionEngine:
    key = hashlib.sha256((_identity() + "\n" + text).encode()).hexdigest()
    with _compiling:
        if key not in _engines:
            _engines[key] = _compiled(text, key)
        return _engines[key]


def _compiled(text: str, key: str) -> llvm.ExecutionEngine:
    machine = _machine()
    path = cache_directory() / "code-1" / f"{key}.o"
    stored = _read(path)
    if stored is None:
        module = llvm.parse_assembly(text)
        module.verify()
        builder = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=2))
        builder.getModulePassManager().run(module, builder)
        stored = machine.emit_object(module)
        _write(path, stored)
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
    engine.add_object_file(llvm.ObjectFileRef.from_data(stored))
    engine.finalize_object()
    return engine


def _address(array: np.ndarray) -> int:
    """Where an array's numbers lie; a quarter of the time of `array.ctypes.data`, which counts in short likelihoods."""
    try:
        return ctypes.addressof(ctypes.c_char.from_buffer(array))  # type: ignore[arg-type]  # an array is a buffer
    except (TypeError, ValueError):  # read-only, or empty
        return array.ctypes.data


class Code:
    """Compiled functions of one module."""

    def __init__(self, text: str, functions: Sequence[str]) -> None:
        engine = _engine(text)
        self._functions = {
            name: ctypes.CFUNCTYPE(None)(engine.get_function_address(name)) for name in functions
        }

    def __call__(self, function: str, *arguments: np.ndarray | int) -> None:
        """Call a function; arrays are passed by address and must be C-contiguous, integers by value."""
        converted: list[ctypes.c_void_p | ctypes.c_int64] = []
        for a in arguments:
            if isinstance(a, np.ndarray):
                if not a.flags.c_contiguous:
                    raise ValueError("compiled code needs C-contiguous arrays")
                converted.append(ctypes.c_void_p(_address(a)))
            else:
                converted.append(ctypes.c_int64(a))
        self._functions[function](*converted)


def _read(path: Path) -> bytes | None:
    """The cached object if it is whole: its last 32 bytes are the digest of what comes before."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    body, digest = data[:-32], data[-32:]
    return body if hashlib.sha256(body).digest() == digest else None


def _write(path: Path, body: bytes) -> None:
    """Keep an object, whole or not at all; a cache that cannot be written costs time, not the result."""
    temporary = path.with_suffix(f".{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        temporary.write_bytes(body + hashlib.sha256(body).digest())
        os.replace(temporary, path)
    except OSError:
        with suppress(OSError):  # where the folder could not be made there is nothing to remove
            temporary.unlink(missing_ok=True)
