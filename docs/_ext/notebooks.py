"""Sphinx extension: notebooks run alike everywhere, without what a user of the machine has set up for IPython."""

from __future__ import annotations

import os
from pathlib import Path

from sphinx.application import Sphinx

PROFILE = """\
c = get_config()
c.HistoryManager.enabled = False
c.IPKernelApp.exec_lines = ["import logging; logging.getLogger('armlab').setLevel('ERROR')"]  # busy machines are slow
c.IPKernelApp.log_level = "ERROR"  # it warns that its connection, within this machine, is not encrypted
c.InlineBackend.figure_formats = {"png"}
c.InlineBackend.print_figure_kwargs = {"bbox_inches": None, "dpi": 120}  # the page that armlab laid out, uncut
"""


def prepare(app: Sphinx) -> None:
    """Give the kernels a profile of their own."""
    folder = Path(app.outdir).parent / "ipython"
    profile = folder / "profile_default"
    profile.mkdir(parents=True, exist_ok=True)
    (profile / "ipython_kernel_config.py").write_text(PROFILE, encoding="utf-8")
    os.environ["IPYTHONDIR"] = str(folder)


def setup(app: Sphinx) -> dict[str, bool]:
    """Prepare before the pages are read."""
    app.connect("builder-inited", prepare)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
