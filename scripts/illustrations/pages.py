"""What several pictures share: synthetic records and fits, tables written into docs, pictures saved."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from validation.counts import markdown
from validation.frame import ROOT

DOCS = ROOT / "docs"
PICTURES = DOCS / "pictures"
LARGEST = 150_000
"""[bytes] of a picture."""
QUANTITIES = {"temperature_K": "K", "absolute_humidity_g_m3": "g/m³"}


def write_table(page: str, name: str, rows: Sequence[Sequence[str]], note: str = "",
                program: str = "scripts/pictures") -> None:  # fmt: skip
    """Put a table, its head in the first row, between the marks of that name."""
    body = markdown(rows[0], rows[1:]) + (f"\n\n{note}" if note else "")
    (path,) = DOCS.rglob(page)
    text = path.read_text(encoding="utf-8")
    begin, end = f"<!-- made by {program}: {name} -->", "<!-- end -->"
    head, found, rest = text.partition(begin)
    if not found or end not in rest:
        raise SystemExit(f"{page}: expected the marks {begin} and {end}")
    path.write_text(head + begin + "\n\n" + body + "\n\n" + rest[rest.index(end) :], encoding="utf-8")
    print(f"\n{page}, {name}\n{body}", flush=True)


def synthetic_record(seed: int, directory: Path):
    """The demo's record and its truth."""
    from hygrokf import read_case, synthetic_turbine, write_case

    turbine = synthetic_turbine(seed=seed)
    return read_case(write_case(turbine, directory / f"turbine{seed}")), turbine.truth


def identified(record):
    from hygrokf import identify

    print(f"fit {record.name}", flush=True)
    return identify(record)


def bounds_text(entry: Mapping) -> str:
    """Value and bounds of a time constant."""
    if entry["upper_h"] is None:
        return f"{entry['value_h']:.3g} (from {entry['lower_h']:.3g}, open above)"
    return f"{entry['value_h']:.3g} ({entry['lower_h']:.3g} … {entry['upper_h']:.3g})"


def save(figure, name: str, label: str = "") -> None:
    """Write a figure as a small PNG; `label` says in the picture itself what is not measured."""
    from hygrokf.report.figures.drawing import png

    if label:
        figure.text(0.995, 0.995, label, ha="right", va="top", fontsize=8, fontstyle="italic", color="0.35")
    write_picture(name, png(figure, dpi=110), 64)


def write_picture(name: str, drawn: bytes, colours: int, **how: object) -> None:
    """Write a PNG with fewer colours.  Raises SystemExit where it is still too large."""
    from PIL import Image

    path = PICTURES / f"{name}.png"
    Image.open(io.BytesIO(drawn)).convert("RGB").quantize(colours, **how).save(path, optimize=True)
    size = path.stat().st_size
    print(f"{path.relative_to(ROOT)}: {size / 1e3:.0f} kB", flush=True)
    if size > LARGEST:
        raise SystemExit(f"{path}: expected at most {LARGEST / 1e3:.0f} kB, found {size / 1e3:.0f} kB")
