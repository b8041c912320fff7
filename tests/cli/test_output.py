"""What commands print."""

from __future__ import annotations

import base64
import json
import re
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from armlab.cli.support.html_report import HtmlReport, Verdict
from armlab.cli.support.output import (
    FIGURES,
    aligned,
    check_output,
    print_json,
    progress,
    save_figure,
)
from armlab.errors import ConfigError


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


def test_a_table_fits_words_to_the_left_and_figures_whole() -> None:
    page = HtmlReport("t", "a")
    page.table([("joint", "friction [N m]", "where"), ("1", "0.5 ± 0.1", "point 100 %"), ("2", "nan", "-")])
    (table,) = page.pieces
    assert table.count("<th>") == 2
    assert "friction [N\N{NO-BREAK SPACE}m]" in table
    assert table.count('<th class="words">where</th>') == table.count('<td class="words">-</td>') == 1
    assert "<td>0.5 ±\N{NO-BREAK SPACE}0.1</td>" in table
    assert "overflow" not in page.html()
    assert "nowrap" not in page.html()


def test_long_tables_and_texts_open_with_a_click() -> None:
    page = HtmlReport("t", "a")
    page.table([("a",), ("1",)], "50 <numbers>")
    page.verbatim("long", "A text")
    assert page.pieces[0].startswith("<details><summary>50 &lt;numbers&gt;</summary><table>")
    assert page.pieces[1] == "<details><summary>A text</summary><pre>long</pre></details>"
