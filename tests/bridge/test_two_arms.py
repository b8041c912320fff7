"""Ends of a run with two arms, state by state."""

from __future__ import annotations

import contextlib
import signal
import socket
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import log
from armlab.errors import ControllerFailed, LinkError, NoRobot
from armlab.state import Command, State

START_NS = 1_700_000_000_000_000_000


def sway(now: State) -> Command:
    return Command(now.q_start + 0.05 * np.sin(3.0 * now.t))


def test_listening_to_two_arms_writes_nothing(pair: Any) -> None:
    def script(left: Any, right: Any) -> None:
        while not pair.peer.over.is_set():
            left.send()
            right.send()
            time.sleep(0.001)

    run = pair(script, None, pair.link(clock="wall"), seconds=0.2)
    assert [peer.surplus() for peer in pair.peers] == [0, 0]
    for arm in run.arms:
        assert arm.statistics["replies"] == 0
        assert len(arm.table) >= 40
        assert "q_sent" not in arm.table


@pytest.mark.parametrize("pace", [pytest.param("yumi_left", marks=pytest.mark.slow), "yumi_right"])
def test_a_session_that_ends_ends_the_run_when_asked(pair: Any, pace: str) -> None:
    """The right arm's session ends; the left one comes to rest before the run does."""

    def script(left: Any, right: Any) -> None:
        left.begin()
        right.begin()
        for _ in range(30):
            left.cycle()
            right.cycle()
            time.sleep(0.003)
        right.cycle(motors=2)
        while not pair.peer.over.is_set():
            left.send()
            time.sleep(0.003)

    link = pair.link(clock="wall")
    run = pair(script, lambda now: Command(qd=np.full(14, 0.1)), link, reconnect="stop", wait="block", pace=pace)
    assert run.reason == "the motors were switched off"
    left = next(arm for arm in run.arms if arm.statistics["robot"] == "yumi_left")
    sent = left.table["qd_sent"]
    assert np.nanmax(sent) > 0.05
    assert not sent[np.isfinite(sent).all(axis=1)][-1].any()


def test_ctrl_c_stops_both_and_completes_both_logs(pair: Any, tmp_path: Path) -> None:
    def controller(now: State) -> Command:
        if now.seq == 50:
            signal.raise_signal(signal.SIGINT)
        return Command(qd=np.full(14, 0.1))

    with pytest.raises(KeyboardInterrupt):
        pair(pair.rest, controller, record=tmp_path / "run.mcap")
    for name in ("runleft.mcap", "runright.mcap"):
        table = log.read(tmp_path / name)
        np.testing.assert_array_equal(table["seq"], np.arange(len(table)))
        assert not table["qd_sent"][-1].any()
        assert np.nanmax(table["qd_sent"]) > 0.05


def test_one_arm_that_never_comes(pair: Any) -> None:
    def script(left: Any, right: Any) -> None:
        left.begin()
        left.rest(pause=0.003)

    link = pair.link(clock="wall", patience=0.4)
    over = threading.Event()

    def follow() -> None:
        while not over.wait(0.01):
            if len(pair.peers) == 2 and pair.peers[1].over.is_set():
                pair.peers[0].over.set()

    watcher = threading.Thread(target=follow)
    watcher.start()
    try:
        with pytest.raises(NoRobot, match=str(link.ports[1])):
            pair(script, sway, link, wait="block")
    finally:
        over.set()
        watcher.join()


def test_an_implausible_arm_stops_the_other_too(pair: Any) -> None:
    """The left arm reports degrees: nothing goes back to it, and the right one does not move."""

    def script(left: Any, right: Any) -> None:
        right.cycle()
        while not pair.peer.over.is_set():
            left.send(q=np.rad2deg(left.packets.q))
            right.send()
            time.sleep(0.001)

    with pytest.raises(LinkError, match="Usual causes are another robot"):
        pair(script, lambda now: Command(qd=np.full(14, 0.1)))
    left, right = pair.peers
    assert left.surplus() == 0
    assert not any(reply.qd is not None and reply.qd.any() for reply in right.replies)


def test_a_second_sender_on_a_port_is_told(pair: Any) -> None:
    """Both motion tasks set up with one port: the first is answered, the other named."""
    other = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def script(left: Any, right: Any) -> None:
        for _ in range(20):
            left.cycle()
            right.cycle()
            other.sendto(right.packets(seqno=right.packets.seq), left.to)
            right.packets.seq -= 1
        pair.rest(left, right)

    run = pair(script, sway, seconds=0.15)
    other.close()
    left, right = (arm.statistics for arm in run.arms)
    assert left["drops"]["foreign source"] == 20
    assert not right["drops"]
    told = [text for _, text in run.events if "foreign source" in text]
    assert len(told) == 1
    assert "each motion task needs its own port" in told[0]
    assert "20 foreign source" in run.report()


def test_an_error_of_one_arm_is_the_one_that_is_raised(pair: Any) -> None:
    def controller(now: State) -> Command:
        if now.seq == 30:
            raise SystemExit(3)
        return sway(now)

    with pytest.raises(ControllerFailed, match="SystemExit"):
        pair(pair.rest, controller, pace="yumi_right")


def test_a_new_session_of_one_arm_begins_time_anew(pair: Any) -> None:
    """Both hold meanwhile; the entry check applies again, and `t` counts from when both were ready."""
    times: list[float] = []

    def controller(now: State) -> Command:
        times.append(now.t)
        return Command(now.q_start)

    def script(left: Any, right: Any) -> None:
        for _ in range(20):
            left.cycle()
            right.cycle()
        right.packets.seq = 0
        for _ in range(20):
            left.cycle()
            right.cycle()
        pair.rest(left, right)

    run = pair(script, controller, seconds=0.2)
    assert run.arms[1].statistics["sessions"] == 2
    assert times.count(0.0) == 2
    assert all(0.0 <= t < 0.3 for t in times)


def test_two_clocks_that_drift_through_each_other(pair: Any) -> None:
    """Cycles of 4.032 and 4.000 ms: ages are exact, and what the other arm is sent is at most one period old."""
    periods = (4_032_000, 4_000_000)
    told: list[float] = []

    def controller(now: State) -> Command:
        left, right = now.arms
        told.append(right.age)
        assert abs(1e9 * right.age - (left.robot_ns - right.robot_ns)) < 1.0
        return Command(now.q_start + 1e-9 * (now.robot_ns - START_NS) * 0.01)

    def script(left: Any, right: Any) -> None:
        peers, due = (left, right), [500_000, 0]
        while not pair.peer.over.is_set():
            k = int(due[1] <= due[0])
            peers[k].send(robot_ns=START_NS + due[k])
            while not pair.peer.over.is_set():
                with contextlib.suppress(TimeoutError):
                    peers[k].answer(0.02)
                    break
            due[k] += periods[k]

    run = pair(script, controller, seconds=0.6)
    assert 0.0 <= min(told) < 0.0001
    assert 0.0039 < max(told) <= 0.004
    right = run.arms[1].table
    followed = np.flatnonzero(np.isfinite(right["q_ref"]).all(axis=1))[10:]
    asked_at = (right["q_ref"][followed, 0] - right["q"][0, 0]) / 0.01
    ages = 1e-9 * (right["robot_ns"][followed] - START_NS) - asked_at
    assert ages.min() >= 0.0
    assert ages.max() <= 0.004032 + 1e-6


def test_a_flood_on_one_port_changes_no_reference_of_either_arm(pair: Any) -> None:
    """Bit for bit what an undisturbed run sends; nothing of it is answered."""
    rng = np.random.default_rng(7)
    other = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def references(garbage: int) -> list[np.ndarray]:
        def script(left: Any, right: Any) -> None:
            for _ in range(40):
                for _ in range(garbage):
                    other.sendto(rng.bytes(int(rng.integers(0, 400))), right.to)
                left.cycle()
                right.cycle()
            pair.rest(left, right)

        run = pair(script, sway, pair.link(), seconds=0.15)
        assert [peer.surplus() for peer in pair.peers[-2:]] == [0, 0]
        assert sum(run.arms[1].statistics["drops"].values()) == 40 * garbage
        return [arm.table["q_sent"][:35] for arm in run.arms]

    for disturbed, undisturbed in zip(references(100), references(0), strict=True):
        np.testing.assert_array_equal(disturbed, undisturbed)
    other.close()
