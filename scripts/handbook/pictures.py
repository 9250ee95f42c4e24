"""The gallery: its order, and how its pictures look."""

from __future__ import annotations

import os

ORDER = (
    "first_fit.py",
    "own_frames.py",
    "innovations_statsmodels.py",
    "profile_of_a_pair.py",
    "own_mechanism.py",
    "own_cause.py",
    "charger_network.py",
    "noise_of_own_models.py",
    "transfer_to_a_sister.py",
    "climate_of_three_sites.py",
    "forecast_and_restart.py",
    "fleet_with_dask.py",
    "fit_by_group.py",
    "control_and_filterpy.py",
)
"""Scripts of docs/gallery in the order of the page."""


def place(name: str) -> int:
    """Where a script stands in the gallery.  Raises ValueError for one that `ORDER` lacks."""
    return ORDER.index(os.path.basename(name))


STYLE = {
    "axes.axisbelow": True,
    "axes.grid": True,
    "axes.labelcolor": "#22272e",
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlelocation": "left",
    "axes.titlesize": 10.5,
    "figure.dpi": 110,
    "font.size": 9.5,
    "grid.color": "#d5dae0",
    "grid.linewidth": 0.5,
    "legend.frameon": False,
    "savefig.dpi": 110,
}
"""How pictures of the gallery look, as matplotlib's settings."""
COLOURS = ("#1b5fa8", "#e3a112", "#6b7480", "#c1272d", "#2b8a6b", "#6a4c93")
"""Blue, yellow, grey, red, green, violet; told apart in print by lightness."""


def style(gallery: object = None, file: str = "") -> None:
    """Set matplotlib to the style of the gallery; sphinx-gallery calls it before each script."""
    import matplotlib
    from cycler import cycler

    matplotlib.rcdefaults()
    matplotlib.rcParams.update({**STYLE, "axes.prop_cycle": cycler(color=COLOURS)})
