"""Compile LLVM text to callable machine code, cached on disk between runs.

The compiler is LLVM through llvmlite, as in numba.  Straight-line filter code of a thousand operations
compiles in a tenth of a second; the same code takes four seconds through numba's front end (docs/decisions).

Object code is cached under `$HYGROKF_CACHE` (default: the user's cache directory), keyed by the text, the
compiler version and the processor.  Text is written only if its key is not cached yet: beside the objects,
the cache holds the object's key for each source of a text and each digest of the modules that write text.
The cache is private to the user, because loading its content means executing it.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from threading import Lock
from weakref import WeakValueDictionary

import numpy as np
from llvmlite import binding as llvm


def cache_directory() -> Path:
    """The directory of compiled code: `$HYGROKF_CACHE`, else the platform's user cache directory."""
    from_environment = os.environ.get("HYGROKF_CACHE")
    if from_environment:
        return Path(from_environment)
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
    """Everything besides the text that compiled code depends on."""
    features = llvm.get_host_cpu_features().flatten()
    return f"{llvm.llvm_version_info} {llvm.get_process_triple()} {llvm.get_host_cpu_name()} {features}"


@cache
def has_fused_multiply_add() -> bool:
    """Whether the processor rounds a b + c once; otherwise the compiled code rounds twice (and stays
    fast)."""
    arm = llvm.get_process_triple().startswith(("aarch64", "arm64"))
    return arm or bool(llvm.get_host_cpu_features().get("fma", False))


@cache
def without_subnormals() -> tuple[str, str, str]:
    """LLVM text of declarations, of switching to rounding subnormal numbers (below 2.2e-308) to 0, and back.

    Variances and derivatives that decay become subnormal, and an operation with a subnormal number takes a
    hundred cycles on many processors.  Empty where the processor's control register is not known.
    """
    triple = llvm.get_process_triple()
    if triple.startswith(("x86_64", "amd64")):
        store, load = (f"call void @llvm.x86.sse.{word}mxcsr(ptr %control)\n" for word in ("st", "ld"))
        return (
            "declare void @llvm.x86.sse.stmxcsr(ptr)\ndeclare void @llvm.x86.sse.ldmxcsr(ptr)\n",
            f"%control = alloca i32\n{store}%former = load i32, ptr %control\n"
            f"%flushed = or i32 %former, {0x8040}\nstore i32 %flushed, ptr %control\n{load}",
            f"store i32 %former, ptr %control\n{load}",
        )
    if triple.startswith(("aarch64", "arm64")):
        return (
            "declare i64 @llvm.aarch64.get.fpcr()\ndeclare void @llvm.aarch64.set.fpcr(i64)\n",
            f"%former = call i64 @llvm.aarch64.get.fpcr()\n%flushed = or i64 %former, {1 << 24}\n"
            "call void @llvm.aarch64.set.fpcr(i64 %flushed)\n",
            "call void @llvm.aarch64.set.fpcr(i64 %former)\n",
        )
    return "", "", ""


_engines: WeakValueDictionary[str, llvm.ExecutionEngine] = WeakValueDictionary()
"""Engines by key; each `CompiledCode` keeps its engine alive, so that code that may run is never freed."""
_compiling = Lock()
"""Held while code is compiled: a second engine of the same code would replace the first and free running
code."""


@cache
def _writers_digest() -> str:
    """Digest of the modules that turn a source into text: all of the folders `engine` and `physics`."""
    packages = (Path(__file__).parent, Path(__file__).parents[1] / "physics")
    files = sorted(file for package in packages for file in package.glob("*.py*"))
    return hashlib.sha256(b"".join(hashlib.sha256(file.read_bytes()).digest() for file in files)).hexdigest()


def _cache_entry(content: str, ending: str) -> tuple[str, Path]:
    """The key of the file that is made from this content, and the file's path in the cache."""
    key = hashlib.sha256(f"{_identity()}\n{content}".encode()).hexdigest()
    return key, cache_directory() / "code-1" / f"{key}.{ending}"


def _engine(text: str | Callable[[], str], source: str) -> llvm.ExecutionEngine:
    """The engine of a module: of this process, else from the cache on disk, else compiled.

    text: of the module, or a function that writes it.  source: what determines the text; a note on disk leads
    from it to the object code, so that the text need not be written again.  "" without a note.
    """
    note = _cache_entry(f"{_writers_digest()}\n{source}", "key")[1] if source else None
    with _compiling:
        cached_key = _read(note) if note else None
        key = cached_key.decode() if cached_key else ""
        engine = (_engines.get(key) or _load_engine(key)) if cached_key else None
        if engine is None:
            content = text if isinstance(text, str) else text()
            key, file = _cache_entry(content, "o")
            engine = _engines.get(key) or _load_engine(key) or _compile_engine(content, file)
            if note:
                _write(note, key.encode())
        _engines[key] = engine
        return engine


def _load_engine(key: str) -> llvm.ExecutionEngine | None:
    """The engine of an object in the cache, or None if the object is missing or incomplete."""
    stored = _read(cache_directory() / "code-1" / f"{key}.o")
    return None if stored is None else _start_engine(stored, _machine())


def _compile_engine(text: str, file: Path) -> llvm.ExecutionEngine:
    """Compile a module, keep its object code in a file of the cache, and start it."""
    machine = _machine()
    module = llvm.parse_assembly(text)
    module.verify()
    builder = llvm.create_pass_builder(machine, llvm.create_pipeline_tuning_options(speed_level=2))
    builder.getModulePassManager().run(module, builder)
    object_code = machine.emit_object(module)
    _write(file, object_code)
    return _start_engine(object_code, machine)


def _start_engine(code: bytes, machine: llvm.TargetMachine) -> llvm.ExecutionEngine:
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    return engine


def _address(array: np.ndarray) -> int:
    """Address of an array's data; takes a quarter of the time of `array.ctypes.data`, which matters in short
    likelihoods."""
    try:
        # numpy declares the buffer protocol of arrays for Python 3.12 and later only
        return ctypes.addressof(ctypes.c_char.from_buffer(array))  # type: ignore[arg-type]
    except (TypeError, ValueError):  # read-only, or empty
        return array.ctypes.data


class CompiledCode:
    """Compiled functions of one module.

    text: the LLVM text, or a function that writes it.  source: everything that the text depends on besides
        the
    modules that write it; with a source that is cached, the text is not written again.
    """

    def __init__(self, text: str | Callable[[], str], functions: Sequence[str], source: str = "") -> None:
        self._engine = _engine(text, source)
        self._functions = {
            name: ctypes.CFUNCTYPE(None)(self._engine.get_function_address(name)) for name in functions
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
    """The cached object if the file is complete: its last 32 bytes are the digest of the preceding ones."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    body, digest = data[:-32], data[-32:]
    return body if hashlib.sha256(body).digest() == digest else None


def _write(path: Path, body: bytes) -> None:
    """Store an object completely or not at all; a cache that cannot be written costs time but no result."""
    temporary = path.with_suffix(f".{os.getpid()}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        temporary.write_bytes(body + hashlib.sha256(body).digest())
        os.replace(temporary, path)
    except OSError:
        with suppress(OSError):  # the folder may not exist
            temporary.unlink(missing_ok=True)
