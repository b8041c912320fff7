"""Sphinx configuration. `make docs` builds offline; warnings are errors."""

import logging
import os
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

os.environ["OMP_NUM_THREADS"] = "1"  # of this build and its notebooks: matrices are small, and bits the same everywhere

import matplotlib.font_manager  # noqa: F401  its cache of fonts is made now: a cell that makes it writes to stderr

import armlab

logging.basicConfig()  # before the theme does: its colours let all loggers of the process speak
logging.getLogger("armlab").setLevel(logging.ERROR)  # a busy machine is told that no packet has come yet

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
    "figures",
    "notebooks",
]
exclude_patterns = ["_build", "_figures"]
default_role = "literal"
nb_execution_raise_on_error = True
nb_execution_timeout = 300  # s, generous for a busy machine
nb_execution_in_temp = True  # what notebooks write is gone afterwards
nb_merge_streams = True
nb_output_stderr = "error"  # warnings and logs of a cell are errors of the build

myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3

html_theme = "furo"
html_title = f"armlab {version}"
html_static_path = ["_static"]
html_css_files = ["armlab.css"]
html_math_renderer = "mathml"
html_show_sourcelink = False
html_copy_source = False

autodoc_member_order = "bysource"
autodoc_typehints = "none"  # shapes, units and frames stand in the docstrings; annotations repeat less than that
