"""What a run leaves behind."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import log
from armlab.bridge import Run
from armlab.bridge.control.run import served, statistics, together
from armlab.log import Column, Table
from armlab.state import Command, State


def rush(state: State) -> Command:
    return Command(qd=np.array([100.0, 0, 0, 0, 0, 0, 0]) * (state.t < 0.1))


@pytest.mark.parametrize("in_file", [False, True])
def test_report_and_table(play: Any, tmp_path: Path, in_file: bool) -> None:
    path = tmp_path / "run.mcap" if in_file else None
    run = play(lambda peer: peer.rest(), rush, seconds=0.3, record=path)
    assert isinstance(run, Run)
    assert (run.reason, run.path) == ("the time is up", path)
    report = run.report()
    for words in (
        "Ended: the time is up.",
        "yumi_right, RobotWare 6.10, 1 sessions, period 4.000 ms",
        f"replies {run.statistics['replies']}",
        "p99.9",
        "Clamped by velocity",
        "worst ratio 0.03",
        "Dropped datagrams: none",
    ):
        assert words in report
    assert run.table is run.table
    assert len(run.table) == run.statistics["packets"]
    assert run.table.clock == "robot"
    np.testing.assert_allclose(np.diff(run.table.t), 0.004, atol=1e-9)
    texts = [text for _, text in run.events]
    assert texts[0].startswith("Session 1 began")
    assert texts[-1] == "Stopping: the time is up."
    if path is not None:
        assert log.read(path).sha256 == run.table.sha256


def test_who_was_served() -> None:
    servers = {
        "labcomm": {"rows": 9, "lost": 2, "clients": {"left 127.0.0.1:7": (8, 0), "fused 127.0.0.1:8": [5, 4]}},
        "local": {"rows": 9, "lost": 0, "clients": {}},
        "other": {"rows": 1, "lost": 0, "clients": None},
    }
    commands: dict[str, dict[str, int]] = {"yumi_left": {"labcomm 127.0.0.1:7": 6}, "yumi_right": {}}
    counted = {
        "servers": servers, "commands": commands, "commands_refused": {"local 1": 3}, "parameters": {"gain": 2.0},
    }  # fmt: skip
    assert served(counted) == [
        "Rows to the server labcomm: 9 (2 lost). To its clients: left 127.0.0.1:7 8, fused 127.0.0.1:8 5 (4 dropped).",
        "Rows to the server local: 9. To its clients: none.",
        "Rows to the server other: 1. To its clients: unknown, it did not answer.",
        "Commands to yumi_left: labcomm 127.0.0.1:7 6.",
        "Commands to yumi_right: none.",
        "Commands of clients refused: local 1 3.",
        "Parameters in force: gain = 2.0.",
    ]
    assert served({}) == []


def test_replies_that_were_left_out_are_in_the_report(play: Any) -> None:
    run = play(lambda peer: peer.rest(), rush, seconds=0.05)
    assert "Left out" not in run.report()
    run.statistics["left_out"] = 3
    assert "Left out 3 replies: so many messages waited in the robot's queue." in run.report()


def test_a_run_without_replies_reports_no_times_of_them(play: Any) -> None:
    run = play(lambda peer: peer.rest(), rush, seconds=0.05)
    assert "Arrival to reply" in run.report()
    run.statistics["replies"], run.statistics["latency_us"] = 0, {"p50": float("nan")}
    assert "Arrival to reply" not in run.report()
    assert "nan" not in run.report()


def test_the_table_and_the_wire_agree_on_clamps(play: Any) -> None:
    run = play(lambda peer: peer.rest(), rush, seconds=0.3)
    clamped = run.table["clamped"].astype(int)
    counts = [int(((clamped[:, 0] & bit) != 0).sum()) for bit in (1, 2, 4, 8)]
    assert counts == [run.statistics["clamps"][name][0] for name in ("position", "velocity", "acceleration", "braking")]
    assert counts[1] > 5


def test_tables_together() -> None:
    def table(rows: int, start_ns: int) -> Table:
        t = 0.004 * np.arange(rows)
        q = Column(shape=(2,), unit="rad")
        return Table(t, {"q": np.stack((t, -t), axis=1)}, {"q": q}, t0_ns=start_ns)

    both = together({"a": table(10, 10**18), "b": table(5, 10**18 + 2_000_000)})
    assert set(both.names) == {"a.q", "b.q", "b.age"}
    assert np.isnan(both["b.q"][0]).all()
    np.testing.assert_allclose(both["b.age"][1:5], 0.002)
    np.testing.assert_allclose(both["b.q"][1:5, 0], 0.004 * np.arange(4))
    assert len(together({"a": table(10, 1), "b": table(0, 1)})) == 10
    assert callable(statistics)
