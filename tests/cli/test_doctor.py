"""armlab doctor: one line per check, exit codes, and the simulated controller seen from outside."""

from __future__ import annotations

import json
import re
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from armlab.bridge.doctor.machine import Finding
from armlab.cli import main
from armlab.cli.doctor import disk

from ..processes import free_port


@contextmanager
def simulated(port: int, *words: str) -> Iterator[None]:
    command = [sys.executable, "-m", "armlab", "sim", "yumi_left", "--to", f"127.0.0.1:{port}", "--stream", "1000"]
    with subprocess.Popen([*command, *words], stderr=subprocess.DEVNULL) as process:
        try:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as first:
                first.bind(("0.0.0.0", port))
                first.settimeout(120.0)
                first.recv(65535)
            yield
        finally:
            process.terminate()


@pytest.mark.slow
def test_the_simulated_controller(capsys: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Streaming without guidance gives a warning. Takes about 3 s; the simulator needs 1 to 2 s to start."""
    monkeypatch.setattr("armlab.bridge.doctor.report.machine", lambda seconds: [])
    port = free_port()
    with simulated(port):
        code = main(["doctor", "yumi_left", "--port", str(port), "--seconds", "2", "--json"])
    found = {entry["name"]: entry for entry in json.loads(capsys.readouterr().out)}
    assert code == 3
    assert found[f"port {port}, first packet"]["value"] == "RobotWare 6.10, 7 axes"
    assert "guidance has not begun" in found[f"port {port}, guidance"]["value"]
    assert found[f"port {port}, guidance"]["verdict"] == "warning"
    timing = re.match(r"period ([\d.]+) ms", found[f"port {port}, timing"]["value"])
    assert timing is not None
    cycles = float(timing[1]) / 4.032  # a simulator on a busy machine skips some
    assert round(cycles) >= 1
    assert cycles == pytest.approx(round(cycles), rel=1e-3)
    assert found[f"port {port}, senders"]["verdict"] == "ok"
    assert found[f"port {port}, posture"]["verdict"] == "ok"


@pytest.mark.parametrize(("verdicts", "code"), [(["ok"], 0), (["ok", "warning"], 3), (["warning", "failure", "ok"], 1)])
def test_exit_codes_and_lines(
    verdicts: list[Any], code: int, monkeypatch: pytest.MonkeyPatch, command, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    findings = [Finding(f"check {i}", verdict, "seen", "do it") for i, verdict in enumerate(verdicts)]
    monkeypatch.setattr("armlab.bridge.doctor.report.examine", lambda *arguments: findings)
    monkeypatch.setattr("armlab.cli.doctor.disk", lambda folder: Finding("disk", "ok", "fast"))
    said = command(["doctor"], code)
    assert said.out.count("-> do it") == len(verdicts)
    for i, verdict in enumerate(verdicts):
        assert f"{verdict:7}  check {i}" in said.out
    assert "nothing is sent" in said.err


def test_ports_follow_the_robots(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    asked: list[Any] = []
    monkeypatch.setattr("armlab.bridge.doctor.report.examine", lambda ports, *rest: asked.append(ports) or [])
    for words in ([], ["yumi_left"], ["yumi_left", "yumi_right"], ["--port", "7000, 7001"]):
        main(["doctor", *words])
    assert asked == [None, [6510], [6511, 6512], [7000, 7001]]


def test_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now, free = [0.0], [10**12]
    monkeypatch.setattr("armlab.cli.doctor.time.perf_counter", lambda: now[0])
    monkeypatch.setattr("armlab.cli.doctor.shutil.disk_usage", lambda folder: SimpleNamespace(free=free[0]))
    monkeypatch.setattr("armlab.cli.doctor.os.fsync", lambda number: now.__setitem__(0, now[0] + 1e-3))
    good = disk(tmp_path)
    assert good.verdict == "ok"
    assert "space for" in good.value
    free[0] = 10**6
    full = disk(tmp_path)
    assert (full.verdict, "space for 0 h" in full.value) == ("warning", True)
    assert disk(tmp_path / "none").verdict == "failure"
    assert not list(tmp_path.iterdir())
    free[0] = 10**12
    monkeypatch.setattr("armlab.cli.doctor.os.fsync", lambda number: now.__setitem__(0, now[0] + 0.6))
    slow = disk(tmp_path)
    assert (slow.verdict, "sync 600.0 ms" in slow.value) == ("warning", True)
