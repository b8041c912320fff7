"""Sphinx extension: run notebooks without the IPython configuration of the user."""

from __future__ import annotations

import os
from pathlib import Path

from sphinx.application import Sphinx

PROFILE = """\
c = get_config()
c.HistoryManager.enabled = False
c.IPKernelApp.exec_lines = ["import logging; logging.getLogger('armlab').setLevel('ERROR')"]
c.IPKernelApp.log_level = "ERROR"  # no warning about the unencrypted local connection
c.InlineBackend.figure_formats = {"png"}
c.InlineBackend.print_figure_kwargs = {"bbox_inches": None, "dpi": 120}  # keep the figure size
"""


def prepare(app: Sphinx) -> None:
    """Create a separate profile for the kernels."""
    folder = Path(app.outdir).parent / "ipython"
    profile = folder / "profile_default"
    profile.mkdir(parents=True, exist_ok=True)
    (profile / "ipython_kernel_config.py").write_text(PROFILE, encoding="utf-8")
    os.environ["IPYTHONDIR"] = str(folder)


def setup(app: Sphinx) -> dict[str, bool]:
    """Register `prepare` to run at the start of the build."""
    app.connect("builder-inited", prepare)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
