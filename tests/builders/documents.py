"""Pages of the docs run as programs."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


DOCS = ROOT / "docs"


def document(name: str) -> Path:
    """The one file of the docs that has this name, in whichever section it stands."""
    (found,) = DOCS.rglob(name)
    return found


RUNNER = """
import subprocess, sys
from pathlib import Path

page, languages = Path(sys.argv[1]), sys.argv[2].split(",")

def bash(text):
    command = f'python() {{ "{sys.executable}" "$@"; }}\\n'
    command += 'hygrokf() { python -m hygrokf.commands.main "$@"; }\\n' + text
    subprocess.run(["bash", "-euo", "pipefail", "-c", command], check=True)

lines, block, language = [], [], None
for line in page.read_text(encoding="utf-8").split("\\n"):
    kept = ""  # other lines become empty ones, so that a traceback names lines of the page
    if line.startswith("```"):
        if language == "bash" and "bash" in languages:
            kept = f"bash({chr(10).join(block)!r})"
        language, block = (line[3:].strip() or "text", []) if language is None else (None, [])
    elif language == "python" and "python" in languages:
        kept = line
    elif language is not None:
        block.append(line)
    lines.append(kept)
exec(compile("\\n".join(lines), str(page), "exec"), {"__name__": "__main__", "bash": bash})
"""


def run_page(page: Path, directory: Path, languages: str) -> subprocess.CompletedProcess[str]:
    """Blocks of a page in their order, as one program in an empty directory; warnings are errors."""
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep),
        "PYTHONWARNINGS": "error",
        "PYTHONIOENCODING": "utf-8",
        "MPLBACKEND": "Agg",
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }
    return subprocess.run(
        [sys.executable, "-c", RUNNER, str(page), languages],
        cwd=directory, env=environment, capture_output=True, text=True, encoding="utf-8", timeout=600,
    )  # fmt: skip
