"""Other programs that show recordings."""

from __future__ import annotations

from pathlib import Path

import pytest

from armlab.cli.log import VIEWERS, Viewer, check_finished, chosen, started
from armlab.errors import ConfigError, LogError, MissingExtra


def test_the_first_that_is_installed_is_taken_and_what_is_asked_for_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(MissingExtra, match="Expected Foxglove, PlotJuggler or Rerun on the PATH"):
        chosen([])
    for name in ("rerun", "foxglove-studio"):
        (tmp_path / name).write_text("#!/bin/sh\n")
        (tmp_path / name).chmod(0o755)
    assert chosen([]) == (VIEWERS["foxglove"], str(tmp_path / "foxglove-studio"))
    assert chosen(["rerun"]) == (VIEWERS["rerun"], str(tmp_path / "rerun"))
    with pytest.raises(MissingExtra, match="Expected PlotJuggler on the PATH, got Foxglove, Rerun"):
        chosen(["plotjuggler"])
    with pytest.raises(ConfigError, match="foxglove and rerun"):
        chosen(["foxglove", "rerun"])


def test_rerun_listens_on_this_computer_only(tmp_path: Path) -> None:
    program = tmp_path / "rerun"
    program.write_text(f'#!/bin/sh\necho "$@" > {tmp_path}/called\nexit 3\n')
    program.chmod(0o755)
    assert started(VIEWERS["rerun"], str(program), tmp_path / "a b.mcap") == 3
    assert (tmp_path / "called").read_text() == f"--bind 127.0.0.1 {tmp_path}/a b.mcap\n"
    assert started(Viewer("True", "true", (), ""), "/bin/true", tmp_path) == 0


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="No such file"):
        check_finished(tmp_path / "run.mcap")
