"""Sphinx configuration. `make docs` builds offline; warnings are errors."""

import logging
import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

os.environ["OMP_NUM_THREADS"] = "1"  # for the build and its notebooks: bit-identical results everywhere

import matplotlib.font_manager  # noqa: F401  builds the font cache now; in a notebook cell it would write to stderr

import armlab

logging.basicConfig()  # before the theme adds a handler that would show all loggers of the process
logging.getLogger("armlab").setLevel(logging.ERROR)  # no warnings about missing packets on a busy machine

project = "armlab"
author = "The armlab authors"
copyright = author
version = release = armlab.__version__

extensions = [
    "myst_nb",
    "sphinx.ext.autodoc",
    "mathml",
    "plain_docstrings",
    "library_table",
    "accuracy_table",
    "kernel_signatures",
    "fault_table",
    "symbol_table",
    "figures",
    "notebooks",
]
exclude_patterns = ["_build", "_figures", "_templates"]
default_role = "literal"
smartquotes = False  # it would alter code such as --help and wait="spin" in running text
nb_execution_raise_on_error = True
nb_execution_timeout = 300  # s, generous for a busy machine
nb_execution_in_temp = True  # files written by notebooks are deleted afterwards
nb_merge_streams = True
nb_output_stderr = "error"  # warnings and logs of a cell are build errors

myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3

html_theme = "furo"
html_title = f"armlab {version}"
html_favicon = "_static/favicon.svg"
templates_path = ["_templates"]
html_context = {"versions": os.environ.get("ARMLAB_DOCS_VERSIONS", "").split()}  # folders next to that of this version
html_sidebars = {
    "**": [
        f"sidebar/{part}.html" for part in ("brand", "versions", "search", "scroll-start", "navigation", "scroll-end")
    ]
}
html_static_path = ["_static"]
html_css_files = ["armlab.css"]
html_search_scorer = str(Path(__file__).parent / "_ext" / "search_scorer.js")  # users' pages first
html_math_renderer = "mathml"
html_show_sourcelink = False
html_copy_source = False

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # docstrings give shapes, units and frames, which annotations lack
