"""Sphinx extension: the pictures of the pages are drawn while the pages are built, so none can be out of date.

Scripts in ``docs/figures``, and examples that the pages show with their pictures, run in ``docs/_figures`` and leave
their files there.
"""

from __future__ import annotations

import contextlib
import io
import runpy
from pathlib import Path

from sphinx.application import Sphinx

EXAMPLES = (
    "10_draw_an_arm.py", "12_source_report.py", "20_weld_seam.py", "21_calibrate_camera.py",
    "22_calibrate_force_sensor.py", "23_calibrate_kinematics.py", "24_calibrate_laser.py",
    "26_hold_and_recover.py", "27_both_arms_wait.py", "31_turned_goal.py", "32_wiping.py",
    "33_several_demonstrations.py",
)  # fmt: skip


def draw(app: Sphinx) -> None:
    """Run every script that makes pictures, but those that ran after the last change of it and of the package."""
    import matplotlib as mpl

    mpl.use("agg")
    import matplotlib.pyplot as plt

    docs = Path(app.srcdir)
    folder = docs / "_figures"
    folder.mkdir(exist_ok=True)
    changed = max(path.stat().st_mtime for path in (docs.parent / "src").rglob("*.py"))
    for script in (*sorted((docs / "figures").glob("*.py")), *(docs.parent / "examples" / name for name in EXAMPLES)):
        drawn = folder / f"{script.stem}.drawn"
        if drawn.exists() and drawn.stat().st_mtime > max(changed, script.stat().st_mtime):
            continue
        with contextlib.chdir(folder), contextlib.redirect_stdout(io.StringIO()):
            runpy.run_path(str(script), run_name="__main__")
        plt.close("all")
        drawn.touch()


def setup(app: Sphinx) -> dict[str, bool]:
    """Draw before the pages are read."""
    app.connect("builder-inited", draw)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
