"""Sphinx extension: draw the figures of the pages during the build, so they are always up to date.

Scripts in ``docs/figures`` and examples with figures on a page run in ``docs/_figures`` and write their files there.
"""

from __future__ import annotations

import contextlib
import io
import runpy
from pathlib import Path

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.images import get_image_size

WIDE = 900  # pixels; figures at least this wide have several panels

EXAMPLES = (
    "10_draw_an_arm.py", "12_source_report.py", "14_hand_guiding.py", "15_lead_through.py", "16_stop_on_contact.py",
    "17_impedance.py", "20_weld_seam.py", "21_calibrate_camera.py",
    "22_calibrate_force_sensor.py", "23_calibrate_kinematics.py", "24_calibrate_laser.py",
    "26_hold_and_recover.py", "27_both_arms_wait.py", "31_turned_goal.py", "32_wiping.py",
    "33_several_demonstrations.py", "37_constant_force.py", "38_weigh.py", "39_carry_with_two_arms.py",
)  # fmt: skip


def draw(app: Sphinx) -> None:
    """Run every figure script that is older than the package or the script itself."""
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


def enlarge(app: Sphinx, page: nodes.document) -> None:
    """Let wide pictures scroll on a narrow page, and link them to the full-size images."""
    for image in page.findall(nodes.image):
        path = Path(app.srcdir, image["uri"])
        is_alone = isinstance(image.parent, nodes.figure | nodes.paragraph)  # otherwise a thumbnail
        if is_alone and path.is_file() and (get_image_size(path) or (0, 0))[0] >= WIDE:
            image["classes"].append("wide")
            image.setdefault("width", "100%")


def setup(app: Sphinx) -> dict[str, bool]:
    """Draw the figures before the build; mark wide pictures when a page is read."""
    app.connect("builder-inited", draw)
    app.connect("doctree-read", enlarge)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
