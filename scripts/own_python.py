"""What every program of this folder does before it imports anything else.

`enter()` goes on in the repository's .venv where this interpreter lacks what the package needs, keeps linear
algebra to one thread, and puts the repository, its tests and this folder on the path.
"""

import os
import sys
from importlib.util import find_spec
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
FOLDERS = tuple(str(REPOSITORY / name) for name in ("scripts", "", "tests"))


def enter() -> None:
    """Prepare this process, or end it with what to run first."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")  # before numpy is loaded
    os.environ.setdefault("MPLBACKEND", "Agg")
    sys.path[:0] = FOLDERS
    if find_spec("llvmlite") and find_spec("scipy"):
        return
    own = REPOSITORY / ".venv" / "bin" / "python"
    if own.exists() and Path(sys.prefix).resolve() != own.parent.parent.resolve():
        os.execv(own, [str(own), *sys.argv])
    sys.exit(
        "expected an interpreter with the package's requirements; this one lacks them: run scripts/demo or "
        "scripts/test once, they make .venv"
    )
