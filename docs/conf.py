"""The documentation as a site; scripts/docs builds it."""

from __future__ import annotations

import os
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "scripts")]
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("DASK_LOGGING__DISTRIBUTED", "error")

from hygrokf.version import __version__  # noqa: E402

project = "hygrokf"
author = "the hygrokf authors"
copyright = author
version = release = __version__
language = "en"

extensions = ["myst_parser", "sphinx_gallery.gen_gallery", "handbook.site_pages", "handbook.mathml"]
root_doc = "index"
exclude_patterns = ["gallery", "live_files"]
# payloads and queries of other programs are quoted as they are; not every highlighter knows them
suppress_warnings = ["config.cache", "misc.highlighting_failure"]
toc_object_entries_show_parents = "hide"
maximum_signature_line_length = 72
python_use_unqualified_type_names = True
highlight_language = "none"
default_role = "code"

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
myst_dmath_double_inline = True

html_theme = "furo"
html_title = f"hygrokf {__version__}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_math_renderer = "mathml"
html_show_copyright = False
html_copy_source = False
html_show_sourcelink = False
html_last_updated_fmt = None
html_theme_options = {
    "light_css_variables": {"color-brand-primary": "#1b5fa8", "color-brand-content": "#1b5fa8"},
    "dark_css_variables": {"color-brand-primary": "#7fb2e5", "color-brand-content": "#7fb2e5"},
}

sphinx_gallery_conf = {
    "examples_dirs": [str(ROOT / "docs/gallery")],
    "gallery_dirs": [str(ROOT / "docs/generated/gallery")],
    "filename_pattern": r"\.py$",
    "within_subsection_order": "handbook.pictures.place",
    "download_all_examples": False,
    "show_memory": False,
    "min_reported_time": 1e9,
    "remove_config_comments": True,
    "image_scrapers": ("matplotlib",),
    "capture_repr": (),
    "copyfile_regex": r".*\.mplstyle",
    "reset_modules": ("handbook.pictures.style",),
    "plot_gallery": True,
    "abort_on_example_error": True,
    "write_computation_times": False,
    "show_signature": False,
    "nested_sections": False,
}
