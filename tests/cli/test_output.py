"""What commands print."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from armlab.cli.support.output import (
    FIGURES,
    aligned,
    check_output,
    note,
    print_json,
    progress,
    refuse_overwrite,
    result,
    save_figure,
)
from armlab.errors import ConfigError


def test_results_and_notes_go_to_their_streams(capsys: pytest.CaptureFixture[str]) -> None:
    result("done")
    note("careful")
    captured = capsys.readouterr()
    assert captured.out == "done\n"
    assert captured.err == "careful\n"


def test_json_has_arrays_as_lists_and_null_for_what_is_not_finite(capsys: pytest.CaptureFixture[str]) -> None:
    print_json({"q": np.array([1.0, np.nan]), "n": np.int64(7), "names": ("a", "b"), "none": None})
    assert json.loads(capsys.readouterr().out) == {"q": [1.0, None], "n": 7, "names": ["a", "b"], "none": None}


def test_columns_line_up() -> None:
    assert aligned([("name", "n"), ("yumi", "7"), ("x", "12")], right=(1,)) == "name   n\nyumi   7\nx     12"
    assert aligned([]) == ""


def test_refuse_overwrite_protects_what_exists(tmp_path) -> None:
    path = tmp_path / "model.toml"
    refuse_overwrite(path, force=False)
    path.write_text("mine")
    refuse_overwrite(path, force=True)
    with pytest.raises(ConfigError, match="--force"):
        refuse_overwrite(path, force=False)


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
