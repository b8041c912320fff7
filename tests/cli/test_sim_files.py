"""Files of `armlab sim`: each wrong line is named. What `truth_writer` writes is read in test_sim.py."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from armlab.cli.sim import Written, read_hand, read_operator
from armlab.errors import ConfigError, LogError

HEADER = "t,fx,fy,fz,mx,my,mz\n"


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("t,fx,fy,fz\n", "line 1"),
        (HEADER + "0,1,2,3,4,5,6\n1,1,2,3\n", "line 3"),
        (HEADER + "0,1,2,3,4,5,6\n1,a,0,0,0,0,0\n", "line 3"),
        (HEADER + "0,1,2,3,4,5,nan\n", "line 2"),
        (HEADER + "1,0,0,0,0,0,0\n\n1,0,0,0,0,0,0\n", "line 4"),
        (HEADER + "1" * 200_000 + ",0,0,0,0,0,0\n", "line 2"),
        ("", "line 1"),
    ],
)
def test_read_operator_names_file_and_line(tmp_path: Path, text: str, where: str) -> None:
    path = tmp_path / "hand.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=rf"{where} of .*hand\.csv"):
        read_operator(path)


def test_read_operator_reads(tmp_path: Path) -> None:
    path = tmp_path / "hand.csv"
    path.write_text("\ufeff" + HEADER + "0, 0,0,0,0,0,0\n2,10,0,0,0,0,1\n", encoding="utf-8")
    np.testing.assert_allclose(read_operator(path).at(1.0), [5, 0, 0, 0, 0, 0.5])
    path.write_text(HEADER, encoding="utf-8")
    assert read_operator(path).at(0.0) is None


def test_read_hand_reads(tmp_path: Path) -> None:
    path = tmp_path / "hand.csv"
    path.write_text("t,q1,q2\n0,0,1\n1,2,1\n2,4,1\n", encoding="utf-8")
    q, qd = read_hand(path, 2).at(1.0)
    np.testing.assert_allclose(q, [2.0, 1.0])
    np.testing.assert_allclose(qd, [2.0, 0.0])


@pytest.mark.parametrize(("text", "what"), [("t,q1\n0,0\n", "header t,q1,q2"), ("t,q1,q2\n0,0,0\n", "two rows")])
def test_read_hand_refuses(tmp_path: Path, text: str, what: str) -> None:
    path = tmp_path / "hand.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=what):
        read_hand(path, 2)


def test_a_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"Expected to write .*none/x\.json, got: No such file"):
        Written(tmp_path / "none" / "x.json")
    with Written(tmp_path / "x.json") as file:
        file.write("1\n")
    assert (tmp_path / "x.json").read_text() == "1\n"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no file that is always full")
def test_a_full_disk_is_named_also_when_the_last_bytes_do_not_fit() -> None:
    full = Path("/dev/full")
    with pytest.raises(LogError, match=r"Expected to write /dev/full, got: No space left"), Written(full) as file:
        file.write("1\n")
    with pytest.raises(LogError, match="/dev/full"), Written(full) as file:
        file.write("1" * 1_000_000)
    with pytest.raises(KeyError), Written(full) as file:
        raise KeyError
