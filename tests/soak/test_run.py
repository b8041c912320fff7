"""A short soak of each part: everything runs, is measured, and ends whole. Hours of it are behind `make soak`."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]


def soaked(part: str, seconds: float, folder: Path) -> dict[str, dict[str, object]]:
    """Run a part. Return its findings that a short run can judge, by what they are of."""
    words = [sys.executable, str(ROOT / "soak" / "run.py"), part, "--seconds", str(seconds), "--folder", str(folder)]
    ended = subprocess.run(words, capture_output=True, text=True, timeout=500.0, check=False)
    assert (folder / "result.json").exists(), ended.stdout + ended.stderr
    result = json.loads((folder / "result.json").read_text())
    assert (folder / "soak.png").stat().st_size > 10_000
    judged = {one["what"]: one for one in result["judged"]}
    assert all(one["what"] in ended.stdout for one in result["judged"])
    assert ended.returncode == (not all(one["is_met"] for one in result["judged"])), ended.stderr
    return judged


def failed(judged: dict[str, dict[str, object]]) -> list[str]:
    """What is beyond its bound, but for what some seconds on a busy machine cannot tell."""
    short = ("memory, growth", "arrival to reply", "stamp to receipt", "packets left out", "last look")
    return [what for what, one in judged.items() if not one["is_met"] and not any(word in what for word in short)]


def test_all_servers_and_ten_clients_in_real_time(tmp_path: Path) -> None:
    """Takes 30 s, more where the machine is busy."""
    for extra in ("zenoh", "cyclonedds", "websockets", "xxhash"):
        pytest.importorskip(extra)
    judged = soaked("real_time", 6.0, tmp_path)
    assert failed(judged) == []
    servers = ("ros2", "rmw_zenoh", "rosbridge", "zenoh", "plotjuggler", "labcomm", "local")
    assert all(f"server {name}: starts anew (0 of 0), difference" in judged for name in servers)
    assert any(what.startswith("run-right: rows that can be read") for what in judged)
    assert any(what.startswith("commander left: rows that can be read") for what in judged)


def test_lockstep(tmp_path: Path) -> None:
    """Takes 10 s."""
    judged = soaked("lockstep", 20.0, tmp_path)
    assert failed(judged) == []
    assert any(what.startswith("run: rows that can be read, of packets (50") for what in judged)


@pytest.mark.parametrize("way", ["--most", "a signal"])
def test_a_run_that_is_cut_off_is_judged_and_says_so(way: str, tmp_path: Path) -> None:
    """Takes 5 s each."""
    words = [sys.executable, str(ROOT / "soak" / "run.py"), "lockstep", "--folder", str(tmp_path)]
    words += ["--most", "1"] if way == "--most" else []
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        said = ""
        while "judged all the same" not in said:
            line = child.stdout.readline()
            assert line, said
            said += line
        if way != "--most":
            child.send_signal(signal.SIGTERM)
        said += child.stdout.read()
    assert child.returncode == 1
    assert f"FAIL cut off by {way}" in said
    assert "FAIL length, short of what was wanted by" in said
    assert "ok   run: recordings finished" in said
