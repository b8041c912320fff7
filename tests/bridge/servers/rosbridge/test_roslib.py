"""roslib, the JavaScript client of npm, against a whole cell: version 2 leaves out the leading slash of names."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from armlab.bridge.cell import parse_cell, run_cell

PROGRAM = Path(__file__).with_name("roslib_client.mjs")
CELL = """
[[robots]]
name = "yumi_left"
link = "sim://yumi_left"
[parameters.gain]
default = 2.0
maximum = 10.0
rights = "anyone"
[servers.rosbridge]
port = 0
"""


def _installed(version: str, folder: Path) -> None:
    """Install a version of roslib into a folder, or skip the test with the reason."""
    node, npm = shutil.which("node"), shutil.which("npm")
    if node is None or npm is None:
        pytest.skip("node or npm is not installed")
    found = subprocess.run([node, "--version"], capture_output=True, text=True, check=True).stdout
    if version.startswith("2.") and int(found[1:].partition(".")[0]) < 20:
        pytest.skip(f"roslib {version} needs Node.js 20, found {found.strip()}")
    options = ["--no-save", "--no-package-lock", "--ignore-scripts", "--no-audit", "--no-fund"]
    command = [npm, "install", "--prefix", str(folder), *options, f"roslib@{version}"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300.0, check=False)
    if done.returncode:
        pytest.skip(f"npm does not install roslib {version}: {(done.stderr.splitlines() or ['no reason'])[0]}")
    shutil.copy(PROGRAM, folder)


@pytest.mark.slow
@pytest.mark.parametrize("version", ["1.4.1", "2.1.0"])
def test_roslib_reads_topics_and_parameters(version: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Names with and without the leading slash. Takes 15 s."""
    _installed(version, tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    programs: list[subprocess.Popen[str]] = []

    def ready(line: str) -> None:
        found = re.search(r":(\d+) \(rosbridge\)", line)
        assert found is not None, line
        command = ["node", str(tmp_path / PROGRAM.name), found[1]]
        programs.append(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True))

    try:
        run_cell(parse_cell(CELL), seconds=10.0, ready=ready, patience=30.0)
        output, errors = programs[0].communicate(timeout=30.0)
    finally:
        for program in programs:
            program.kill()
    assert programs[0].returncode == 0, errors
    found = json.loads(output)
    assert {"/yumi_left/joint_states", "/yumi_left/stop"} <= set(found["topics"])
    assert found["params"] == ["gain"]
    assert found["type"] == ("sensor_msgs/JointState" if version.startswith("1.") else "sensor_msgs/msg/JointState")
    assert found["rows"] == [[7] * 20] * 2
    assert found["gain"] == 3.5
