"""How figures look, and how they are saved: style, thinning of long records, ticks of a calendar, SVG and
PNG.

matplotlib is imported inside the functions that need it, without its global state (`pyplot`).
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TYPE_CHECKING, Any

import numpy as np

from hygrokf.data.timestamps import DAY_S
from hygrokf.errors import HygrokfError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MEASURED = "#1b5fa8"
SIMULATED_COLOUR = "#c1272d"
AMBIENT_COLOUR = "#e3a112"
INK = "#22272e"
QUIET = "#6b7480"
RULE = "#d5dae0"
SHADE = "#e9eef4"
WARM_TO_COLD = ("#16365c", "#2b6ca3", "#6aa5c9", "#c9a227", "#c8641e", "#8f1d14")
"""Cold to warm in six steps that differ in lightness as well as in hue."""
WIDTH_IN = 7.3
"""[in] width of every figure: the text width of an A4 page."""
LEVEL_SD = 1.959964
"""Standard deviations from the mean to the ends of a normal distribution's 95 % interval."""
BINS = 520
"""Bins of time over the width of a page; a curve keeps the lowest and the highest value of each."""

_STYLE: dict[str, Any] = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 7.5,
    "axes.titlesize": 8.0,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 5.0,
    "axes.titley": 1.0,
    "axes.labelsize": 7.5,
    "axes.labelcolor": INK,
    "axes.edgecolor": QUIET,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.formatter.useoffset": False,
    "grid.color": RULE,
    "grid.linewidth": 0.4,
    "xtick.labelsize": 7.0,
    "ytick.labelsize": 7.0,
    "xtick.color": QUIET,
    "ytick.color": QUIET,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.minor.size": 0.0,
    "ytick.minor.size": 0.0,
    "text.color": INK,
    "text.parse_math": False,
    "legend.frameon": False,
    "legend.fontsize": 7.0,
    "legend.handlelength": 1.6,
    "legend.columnspacing": 1.4,
    "legend.handletextpad": 0.5,
    "legend.borderaxespad": 0.0,
    "lines.linewidth": 0.9,
    "lines.solid_capstyle": "butt",
    "patch.linewidth": 0.0,
    "hatch.linewidth": 0.4,
    "savefig.facecolor": "white",
    "svg.fonttype": "none",
    "path.simplify_threshold": 0.15,
}
FONTS = "system-ui, 'Segoe UI', Roboto, 'Helvetica Neue', Arial, 'Liberation Sans', sans-serif"
"""Fonts of the page; the drawings are laid out with a wider one, so that their labels fit with any of
these."""


class NothingToShow(ValueError):
    """The data for a figure are missing; the message is one sentence that says which, and why."""


_style_is_set = ContextVar("_style_is_set", default=False)
"""Whether the style is set already: setting it takes as long as drawing a small panel."""


@contextmanager
def styled() -> Iterator[None]:
    """Context in which the package's style is set; matplotlib's settings are restored afterwards."""
    if _style_is_set.get():
        yield
        return
    import matplotlib

    plain = {
        name: value for name, value in matplotlib.rcParamsDefault.items() if not name.startswith("backend")
    }
    style: Any = {**plain, **_STYLE}
    token = _style_is_set.set(True)
    try:
        with matplotlib.rc_context(style):
            yield
    finally:
        _style_is_set.reset(token)


def expect_matplotlib() -> None:
    """Raise HygrokfError if matplotlib is not installed."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise HygrokfError(
            "drawing needs matplotlib, which comes with hygrokf unless it was installed without its "
            "dependencies; found none: pip install matplotlib"
        ) from None


def new_figure(height_in: float) -> Figure:
    """Return an empty figure of the page's width and `height_in` [in], without a window on the screen."""
    from matplotlib.figure import Figure

    return Figure(figsize=(WIDTH_IN, height_in))


def svg(figure: Figure, name: str) -> str:
    """Return the figure as standalone SVG text; `name` (letters, digits, -) makes its identifiers unique on a
    page."""
    with styled():
        import matplotlib
        from matplotlib.backends.backend_svg import FigureCanvasSVG

        matplotlib.rcParams["svg.hashsalt"] = name
        buffer = io.StringIO()
        no_metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))
        # `savefig` would draw the figure twice, first for the layout
        _save(FigureCanvasSVG(figure).print_svg, buffer, metadata=no_metadata)
    text = buffer.getvalue()
    text = re.sub(
        r"<\?xml.*?\?>\s*|<!DOCTYPE.*?>\s*|<metadata>.*?</metadata>\s*|<!--.*?-->\s*", "", text, flags=re.S
    )
    coordinates = r'\b(?:d|x|y|points|x1|y1|x2|y2|width|height)="[^"]*"'
    text = re.sub(coordinates, lambda match: re.sub(r"(\d+\.\d\d)\d+", r"\1", match[0]), text)
    text = re.sub(r" font-family: [^;\"]*;", "", text)
    text = re.sub(r"<defs>\s*<style.*?</style>\s*</defs>\s*", "", text, flags=re.S)
    text = text.replace("<svg ", f'<svg font-family="{FONTS}" stroke-linejoin="round" ', 1)
    text = re.sub(r' id="(?!' + re.escape(name) + r"-)", f' id="{name}-', text)
    text = text.replace('href="#', f'href="#{name}-').replace("url(#", f"url(#{name}-")
    return re.sub(r"\n\s*", "\n", text)


def _save(save: Callable[..., object], buffer: io.BytesIO | io.StringIO, **settings: Any) -> None:
    """Call `save` of matplotlib without its warning about letters that the font of the layout lacks."""
    import warnings

    with warnings.catch_warnings():
        # a name may use letters that the font of the layout lacks; the browser has a font for them
        warnings.filterwarnings("ignore", message="Glyph .* missing from")
        save(buffer, **settings)


def inline_svg(figure: Figure, name: str, title: str) -> str:
    """Return the figure as SVG for the body of an HTML page: it scales with the page, names no host, and has
    `title` as its label for screen readers."""
    from html import escape

    drawing_svg = svg(figure, name)
    drawing_svg = re.sub(r' xmlns(?::xlink)?="[^"]*"', "", drawing_svg).replace("xlink:href", "href")
    tag_start = drawing_svg.index("<svg")
    tag_end = drawing_svg.index(">", tag_start)
    view_box = re.search(r'viewBox="[^"]*"', drawing_svg[tag_start:tag_end])
    label = escape(title, quote=True)
    attributes = f'{view_box.group(0) if view_box else ""} font-family="{FONTS}" stroke-linejoin="round"'
    return f'<svg {attributes} role="img" aria-label="{label}">{drawing_svg[tag_end + 1 :]}'


def png(figure: Figure, dpi: int = 150) -> bytes:
    """Return the figure as a PNG image of `dpi` dots per inch, for documents that cannot hold SVG."""
    with styled():
        buffer = io.BytesIO()
        _save(figure.savefig, buffer, format="png", dpi=dpi)
    return buffer.getvalue()


# --- long records ----------------------------------------------------------------------------


def envelope(
    time: np.ndarray, value: np.ndarray, span: tuple[float, float], bins: int = BINS
) -> tuple[np.ndarray, ...]:
    """Return the points (time, value) of a line, thinned to about 2 `bins` points such that every extreme
    stays visible.

    time: [s] (T,) increasing. value: (T,), NaN where missing. span: [s] limits of the axis.

    Gaps longer than three steps and longer than a bin break the line (NaN).
    """
    in_span = np.isfinite(value) & (time >= span[0]) & (time <= span[1])
    x, y = time[in_span], value[in_span]
    if len(x) == 0:
        return x, y
    step = float(np.median(np.diff(x))) if len(x) > 1 else 0.0
    if len(x) > 2 * bins:
        bin_starts, bin_middles = _bins(x, span, bins)
        low, high = np.minimum.reduceat(y, bin_starts), np.maximum.reduceat(y, bin_starts)
        bin_ends = np.append(bin_starts[1:], len(y)) - 1
        rising = y[bin_ends] >= y[bin_starts]
        width = (span[1] - span[0]) / bins
        x = np.column_stack([bin_middles - 0.25 * width, bin_middles + 0.25 * width]).ravel()
        y = np.column_stack([np.where(rising, low, high), np.where(rising, high, low)]).ravel()
        step = max(step, width / 1.2)
    return _broken(x, 3.0 * step, y)


def band(
    time: np.ndarray, low: np.ndarray, high: np.ndarray, span: tuple[float, float], bins: int = BINS
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return lower and upper edge (time, low, high) of a band, thinned as in `envelope`."""
    in_span = np.isfinite(low) & np.isfinite(high) & (time >= span[0]) & (time <= span[1])
    x, below, above = time[in_span], low[in_span], high[in_span]
    if len(x) == 0:
        return x, below, above
    step = float(np.median(np.diff(x))) if len(x) > 1 else 0.0
    if len(x) > bins:
        bin_starts, x = _bins(x, span, bins)
        below, above = np.minimum.reduceat(below, bin_starts), np.maximum.reduceat(above, bin_starts)
        step = max(step, (span[1] - span[0]) / bins)
    x, below, above = _broken(x, 3.0 * step, below, above)
    return x, below, above


def _bins(x: np.ndarray, span: tuple[float, float], bins: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the index of the first point in each used bin, and the middles of these bins."""
    width = (span[1] - span[0]) / bins
    bin_number = np.minimum((x - span[0]) // width, bins - 1)
    starts = np.flatnonzero(np.append(True, np.diff(bin_number) > 0))
    return starts, span[0] + (bin_number[starts] + 0.5) * width


def _broken(x: np.ndarray, longest_gap: float, *values: np.ndarray) -> tuple[np.ndarray, ...]:
    """x (n,) and values (n,) with a NaN in every gap longer than `longest_gap`; 0: no gap is too long."""
    gap_ends = np.flatnonzero(np.diff(x) > max(longest_gap, 1e-9)) + 1
    if longest_gap <= 0:
        gap_ends = gap_ends[:0]
    middle = 0.5 * (x[gap_ends - 1] + x[gap_ends])
    return (np.insert(x, gap_ends, middle), *(np.insert(value, gap_ends, np.nan) for value in values))


def means(index: np.ndarray, value: np.ndarray, count: int) -> np.ndarray:
    """Means (count,) of the values (T,) with the index 0, 1, …, count − 1; NaN without values."""
    counts = np.bincount(index, minlength=count).astype(float)
    sums = np.bincount(index, weights=value, minlength=count)
    return np.divide(sums, counts, out=np.full(count, np.nan), where=counts > 0)


def stretches(time: np.ndarray, flag: np.ndarray, shortest_gap: float = 0.0) -> list[tuple[float, float]]:
    """Return the periods (start, end) of `time` [s] (T,) in which `flag` (T,) is true; interruptions shorter
    than `shortest_gap` [s] are bridged."""
    flag = np.asarray(flag, dtype=bool)
    if not flag.any():
        return []
    edges = np.diff(np.concatenate([[0], flag.astype(int), [0]]))
    starts, ends = time[np.flatnonzero(edges == 1)], time[np.flatnonzero(edges == -1) - 1]
    joined = [[float(starts[0]), float(ends[0])]]
    for start, end in zip(starts[1:], ends[1:], strict=True):
        if start - joined[-1][1] < shortest_gap:
            joined[-1][1] = float(end)
        else:
            joined.append([float(start), float(end)])
    return [(start, end) for start, end in joined]


# --- calendar ------------------------------------------------------------------------------

_STEPS = (
    *((number, "m") for number in (1, 2, 5, 10, 15, 30)),
    *((number, "h") for number in (1, 2, 3, 6, 12)),
    *((number, "D") for number in (1, 2, 7, 14)),
    *((number, "M") for number in (1, 2, 3, 6, 12, 24, 60, 120, 600)),
)
_SECONDS = {"m": 60.0, "h": 3600.0, "D": DAY_S, "M": 30.4 * DAY_S}


def calendar_ticks(low: float, high: float, ticks: int) -> tuple[np.ndarray, list[str]]:
    """Return at most `ticks` round instants [s] between `low` and `high` [s], and their labels (UTC)."""
    first, last = (np.datetime64(math.floor(bound), "s") for bound in (low, high))
    instants, unit = np.array([first]), "s"
    for step, unit in _STEPS:
        if (high - low) / _SECONDS[unit] / step > 2 * ticks:
            continue
        # whole multiples since 1970 fall on midnights and on Januaries; weeks begin on Mondays
        first_multiple = first.astype(f"datetime64[{unit}]").astype(int)
        offset = 4 if (step, unit) in ((7, "D"), (14, "D")) else 0
        first_multiple = (first_multiple - offset) // step * step + offset
        multiples = np.arange(first_multiple, last.astype(f"datetime64[{unit}]").astype(int) + step + 1, step)
        instants = multiples.astype(f"datetime64[{unit}]").astype("datetime64[s]")
        instants = instants[(instants >= first) & (instants <= last)]
        if len(instants) <= ticks:
            break
    moments = [instant.item() for instant in instants]
    labels, last_coarse = [], None
    for moment in moments:
        coarse, fine = {
            "m": (f"{moment.day} {moment:%b %Y}", f"{moment:%H:%M}"),
            "h": (f"{moment.day} {moment:%b %Y}", f"{moment:%H:%M}"),
            "D": (f"{moment:%b %Y}", f"{moment.day}"),
            "M": (f"{moment:%Y}", f"{moment:%b}"),
        }.get(unit, ("", ""))
        zone = " UTC" if last_coarse is None else ""
        labels.append(fine if coarse == last_coarse else f"{fine}\n{coarse}{zone}")
        last_coarse = coarse
    return instants.astype(float), labels
