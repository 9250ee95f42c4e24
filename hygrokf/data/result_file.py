"""Results as JSON files: written whole, read with every fault, its place, and the version of the file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TypeVar

from hygrokf.data.structured import StructureFault, plain, structured
from hygrokf.errors import HygrokfError

T = TypeVar("T")


class ResultFault(HygrokfError):
    """A result file that cannot be read, in one message."""


def result_text(found: object) -> str:
    """The JSON text of a result; numbers that JSON cannot hold (NaN, ±∞) become null."""
    return json.dumps(plain(found), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def read_result(kind: type[T], path: Path, command: str) -> T:
    """The result of a class in a file that `command` wrote.  Raises ResultFault."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        return structured(kind, data)
    except StructureFault as fault:
        version = data.get("version") if isinstance(data, dict) else None
        found = f"; the file was written by hygrokf {version}" if isinstance(version, str) else ""
        reason = f"{fault}{found}"
    except (OSError, ValueError, RecursionError) as fault:
        reason = getattr(fault, "strerror", None) or f"{type(fault).__name__} {fault}"
    raise ResultFault(f"{path}: expected the results of `{command}`, found: {reason}; run it again")
