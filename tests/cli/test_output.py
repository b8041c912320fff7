"""What commands print and write, and the logs that they read."""

from __future__ import annotations

import base64
import json
import re
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armlab import identify, log, robots
from armlab.cli.support.html_report import HtmlReport, Verdict
from armlab.cli.support.log_input import doubts, gaps, left_out, read_log, reading_bar
from armlab.cli.support.output import FIGURES, aligned, check_output, print_json, progress, save_figure
from armlab.errors import ConfigError, LogError, ModelMismatchError


def test_json_has_arrays_as_lists_and_null_for_what_is_not_finite(capsys: pytest.CaptureFixture[str]) -> None:
    print_json({"q": np.array([1.0, np.nan]), "n": np.int64(7), "names": ("a", "b"), "none": None})
    assert json.loads(capsys.readouterr().out) == {"q": [1.0, None], "n": 7, "names": ["a", "b"], "none": None}


def test_columns_line_up() -> None:
    assert aligned([("name", "n"), ("yumi", "7"), ("x", "12")], right=(1,)) == "name   n\nyumi   7\nx     12"
    assert aligned([]) == ""


def test_check_output_speaks_before_the_work(tmp_path) -> None:
    check_output(tmp_path / "fit.PNG", False, FIGURES)
    with pytest.raises(ConfigError, match=r"\.png or \.svg or \.pdf"):
        check_output(tmp_path / "fit.xyz", False, FIGURES)
    with pytest.raises(ConfigError, match="folder that exists"):
        check_output(tmp_path / "none" / "fit.png", False, FIGURES)
    (tmp_path / "fit.png").write_text("mine")
    with pytest.raises(ConfigError, match="--force"):
        check_output(tmp_path / "fit.png", False, FIGURES)
    check_output(tmp_path / "fit.png", True, FIGURES)


def test_progress_says_each_step_once_where_there_is_no_terminal(capsys) -> None:
    with progress("identify") as tell:
        for done in range(3):
            tell(done, 4, "reading")
        tell(4, 4, "done")
    assert capsys.readouterr().err.splitlines() == ["identify: reading", "identify: done"]


@pytest.mark.parametrize("fails", [True, False])
def test_a_figure_is_written_whole_or_not_at_all(fails: bool, tmp_path: Path) -> None:
    class Figure:
        def savefig(self, path: Path, **_: object) -> None:
            path.write_bytes(b"new")
            if fails:
                raise OSError(28, "No space left on device")

    path = tmp_path / "a.png"
    path.write_bytes(b"old")
    with pytest.raises(OSError, match="space") if fails else nullcontext():
        save_figure(Figure(), path)
    assert path.read_bytes() == (b"old" if fails else b"new")
    assert [file.name for file in tmp_path.iterdir()] == ["a.png"]


def test_what_is_read_is_never_replaced(tmp_path: Path) -> None:
    log, bag = tmp_path / "run.csv", tmp_path / "run.rosbag2"
    log.write_text("mine")
    bag.mkdir()
    (bag / "run_0.mcap").write_text("mine")
    (tmp_path / "link.csv").symlink_to(log)
    ways = [(log, log), (tmp_path / "link.csv", log), (log, tmp_path / "link.csv"), (bag / ".." / "run.csv", log)]
    folders = [(bag, bag), (bag, bag / "run_0.mcap"), (bag / "run_0.mcap", bag)]
    for path, read in (*ways, *folders):
        for force in (False, True):
            with pytest.raises(ConfigError, match="which is or holds what is read"):
                check_output(path, force, [".csv", ".mcap", ".rosbag2"], [tmp_path / "other.csv", read])
    check_output(bag / "new.csv", False, [".csv"], [bag])
    check_output(log, True, [".csv"], [bag, tmp_path / "none.csv"])


def test_a_warning_is_written_once() -> None:
    """Python's handler of last resort would write it again: seen in a process of its own, without pytest's handlers."""
    program = (
        "import logging; from armlab.cli.support.output import Narrator; narrator = Narrator()\n"
        "logging.getLogger('armlab.bridge').warning('Twice.'); narrator.event('Twice.', warn=True)"
    )
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stderr
    assert said == "warning: Twice.\n"


PIXEL = b"\x89PNG\r\n\x1a\n not really"


@pytest.fixture
def page() -> HtmlReport:
    page = HtmlReport("Arm <1> & more", "a log & a model")
    page.verdict(Verdict(good=("It <fits>.",), bad=("Joint 7.",)))
    page.section("Per joint", "How to read it.")
    page.table([("joint", "RMS"), ("1", "0.5 & up")])
    page.figure(PIXEL, 'the "residual"', "A caption.")
    page.verbatim("a < b")
    return page


def test_the_words_are_there_and_none_of_them_is_markup(page: HtmlReport) -> None:
    html = page.html()
    for words in (
        "Arm &lt;1&gt; &amp; more",
        "It &lt;fits&gt;.",
        "0.5 &amp; up",
        "the &quot;residual&quot;",
        "a &lt; b",
    ):
        assert words in html
    assert "<fits>" not in html
    assert html.startswith("<!doctype html>")
    assert html.rstrip().endswith("</html>")
    assert '<meta charset="utf-8">' in html


def test_figures_are_inside_and_nothing_is_asked_from_outside(page: HtmlReport) -> None:
    html = page.html()
    (data,) = re.findall(r'src="data:image/png;base64,([^"]+)"', html)
    assert base64.b64decode(data) == PIXEL
    assert not re.findall(r"https?:|//\w|<script|<link|@import|url\(", html)
    assert "default-src 'none'; img-src data:" in html


def test_a_log_without_torques_or_of_another_robot_is_refused(truth, tmp_path: Path) -> None:
    table = truth.log(identify.dither(truth.robot.q_home, 1.0), seed=5).select("q", "tau")
    path = log.write(table, tmp_path / "swayed.mcap", truth.robot)
    assert "qd" in read_log(path, truth.robot)
    with pytest.raises(ModelMismatchError, match="recording of 'yumi_right', got one of 'yumi_left'"):
        read_log(path, robots.load("yumi_right"))
    mute = log.write(table.select("q"), tmp_path / "mute.mcap", truth.robot)
    with pytest.raises(LogError, match=r"got none for tau among .*research extension"):
        read_log(mute, truth.robot)


def test_of_a_recording_of_both_arms_the_rows_of_the_arm_are_read(truth, tmp_path: Path) -> None:
    left, right = truth.robot, replace(robots.load("yumi_right"), name="yumi-right")
    table = truth.log(identify.dither(left.q_home, 1.0), seed=5).select("q", "qd", "tau")
    other = table.with_column("q", -table["q"])
    pieces = [log.write(one, tmp_path / f"{arm.name}.mcap", arm) for one, arm in ((table, left), (other, right))]
    both = log.merge(pieces, tmp_path / "both.mcap")
    for arm, one in ((left, table), (right, other)):
        np.testing.assert_array_equal(read_log(both, arm)["q"], one["q"])
    with pytest.raises(ModelMismatchError, match="of 'irb120', got one of 'yumi_left' and 'yumi_right'"):
        read_log(both, robots.load("irb120"))


def test_what_cannot_be_true_is_doubted(truth) -> None:
    table = truth.log(identify.dither(truth.robot.q_home, 4.0), seed=5)
    assert doubts(table, truth.robot) == ()
    backwards, motors = table.with_column("qd", -table["qd"]), table.with_column("tau", table["tau"] / 100)
    assert ["derivative of q" in sentence for sentence in doubts(backwards, truth.robot)] == [True]
    assert ["motors'" in sentence for sentence in doubts(motors, truth.robot)] == [True]


def test_a_torque_that_the_model_does_not_know_is_not_doubted(truth, model) -> None:
    table = truth.log(identify.dither(truth.robot.q_home, 4.0), seed=5)
    dead = table.with_column("tau", np.where(np.arange(7) == 6, 0.0, table["tau"]))
    (said,) = doubts(dead, truth.robot, model)
    assert "got a constant for axis_6" in said
    partly = replace(model.quality, rms_cv=np.where(np.arange(7) == 6, np.nan, model.quality.rms_cv))
    assert doubts(dead, truth.robot, replace(model, quality=partly)) == ()
    bare = replace(model, quality=replace(model.quality, rms_cv=np.full(7, np.nan)))
    assert doubts(dead, truth.robot, bare) == (said,)


def test_gaps_missing_rows_and_rest_are_no_reason_to_doubt(truth) -> None:
    table = truth.log(identify.dither(truth.robot.q_home, 4.0), seed=5)
    torn = table.rows(np.r_[0:300, 600 : len(table)])
    tau = torn["tau"].copy()
    tau[350] = np.nan
    assert doubts(torn.with_column("tau", tau), truth.robot) == ()
    still = truth.log(identify.dither(truth.robot.q_home, 2.0, amplitude=1e-6), seed=5)
    assert doubts(still, truth.robot) == ()
    assert doubts(table.rows(slice(0, 0)), truth.robot) == ()


def test_gaps_and_rows_without_an_estimate_are_counted(truth) -> None:
    table = truth.log(identify.dither(truth.robot.q_home, 2.0), seed=5)
    assert gaps(table) == []
    assert gaps(table.rows(slice(0, 1))) == []
    torn = table.rows((table.t < 0.5) | ((table.t >= 0.6) & (np.arange(len(table)) != 300)))
    (first, second) = gaps(torn)
    assert first == pytest.approx((0.496, 0.104))
    assert second == pytest.approx((1.196, 0.008))
    flags = np.where(np.arange(len(table)) < 7, 1 + 4, 4)
    assert left_out(table.with_column("wrench_flags", flags, unit="1", kind="count")) == 7


def test_a_bag_of_another_program_gives_the_joints_of_the_robot(ur5e_bag: Path) -> None:
    with reading_bar(ur5e_bag) as tell:
        assert tell is None  # no terminal, no large file
    table = read_log(ur5e_bag, robots.load("ur5e"))
    np.testing.assert_array_equal(table["q"][0], np.arange(6.0))
    assert table["qd"].shape == (5, 6)
    with pytest.raises(LogError, match="Only in the robot: panda_joint1"):
        read_log(ur5e_bag, robots.load("panda"))
