"""Output of commands, the files they write, and the logs they read."""

from __future__ import annotations

import base64
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armlab import identify, log, robots
from armlab.cli.support.html_report import HtmlReport, Verdict
from armlab.cli.support.log_input import doubts, gaps, read_log
from armlab.cli.support.output import FIGURES, check_output
from armlab.errors import ConfigError, ModelMismatchError


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
            with pytest.raises(ConfigError, match="which is or contains the input"):
                check_output(path, force, [".csv", ".mcap", ".rosbag2"], [tmp_path / "other.csv", read])
    check_output(bag / "new.csv", False, [".csv"], [bag])
    check_output(log, True, [".csv"], [bag, tmp_path / "none.csv"])
    check_output(tmp_path / "fit.PNG", False, FIGURES)


def test_a_warning_is_written_once() -> None:
    """Python's last-resort handler would repeat the warning; seen only in a process without pytest's handlers."""
    program = (
        "import logging; from armlab.cli.support.output import Narrator; narrator = Narrator()\n"
        "logging.getLogger('armlab.bridge').warning('Twice.'); narrator.event('Twice.', warn=True)"
    )
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stderr
    assert said == "warning: Twice.\n"


def test_the_words_of_a_page_are_no_markup_and_nothing_is_asked_from_outside() -> None:
    page, pixel = HtmlReport("Arm <1> & more", "a log & a model"), b"\x89PNG\r\n\x1a\n not really"
    page.verdict(Verdict(good=["It <fits>."], bad=["Joint 7."]))
    page.section("Per joint", "How to read it.")
    page.table([("joint", "RMS"), ("1", "0.5 & up")])
    page.figure(pixel, 'the "residual"', "A caption.")
    page.verbatim("a < b")
    html = page.html()
    escaped = ("Arm &lt;1&gt; &amp; more", "It &lt;fits&gt;.", "0.5 &amp; up", "the &quot;residual&quot;", "a &lt; b")
    assert all(words in html for words in escaped)
    assert "<fits>" not in html
    assert html.startswith("<!doctype html>")
    (data,) = re.findall(r'src="data:image/png;base64,([^"]+)"', html)
    assert base64.b64decode(data) == pixel
    assert not re.findall(r"https?:|//\w|<script|<link|@import|url\(", html)
    assert "default-src 'none'; img-src data:" in html


def test_a_log_has_a_velocity_and_is_of_the_robot(truth, tmp_path: Path) -> None:
    table = truth.log(identify.dither(truth.robot.q_home, 1.0), seed=5).select("q", "tau")
    path = log.write(table, tmp_path / "swayed.mcap", truth.robot)
    assert "qd" in read_log(path, truth.robot)
    with pytest.raises(ModelMismatchError, match=r"'yumi_left' .*, got 'yumi_right'"):
        read_log(path, robots.load("yumi_right"))


def test_what_cannot_be_true_is_doubted(truth, model) -> None:
    table = truth.log(identify.dither(truth.robot.q_home, 4.0), seed=5)
    assert doubts(table, truth.robot) == ()
    backwards, motors = table.with_column("qd", -table["qd"]), table.with_column("tau", table["tau"] / 100)
    assert ["derivative of q" in sentence for sentence in doubts(backwards, truth.robot)] == [True]
    assert ["motor torques" in sentence for sentence in doubts(motors, truth.robot)] == [True]
    dead = table.with_column("tau", np.where(np.arange(7) == 6, 0.0, table["tau"]))
    (said,) = doubts(dead, truth.robot, model)
    assert "got constant values for axis_6" in said
    partly = replace(model.quality, rms_cv=np.where(np.arange(7) == 6, np.nan, model.quality.rms_cv))
    assert doubts(dead, truth.robot, replace(model, quality=partly)) == (), "of a joint that the model does not know"
    bare = replace(model, quality=replace(model.quality, rms_cv=np.full(7, np.nan)))
    assert doubts(dead, truth.robot, bare) == (said,)


def test_gaps_missing_rows_and_rest_are_no_reason_to_doubt(truth) -> None:
    table = truth.log(identify.dither(truth.robot.q_home, 4.0), seed=5)
    torn = table.rows(np.r_[0:300, 600 : len(table)])
    tau = torn["tau"].copy()
    tau[350] = np.nan
    assert doubts(torn.with_column("tau", tau), truth.robot) == ()
    assert (gaps(table), gaps(table.rows(slice(0, 1)))) == ([], [])
    (hole,) = gaps(torn)
    assert hole == pytest.approx((1.196, 1.204))
    still = truth.log(identify.dither(truth.robot.q_home, 2.0, amplitude=1e-6), seed=5)
    assert doubts(still, truth.robot) == ()
    assert doubts(table.rows(slice(0, 0)), truth.robot) == ()
