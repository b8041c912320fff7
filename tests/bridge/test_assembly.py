"""The arms of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge import Limits
from armlab.bridge.assembly import End, Rehearsal, assemble, checked_limits, finished
from armlab.bridge.control.arm import Arm
from armlab.bridge.control.supervision import Settings
from armlab.bridge.control.torque import Admittance
from armlab.bridge.net.sockets import Arrival, Port
from armlab.errors import ConfigError, LogError
from armlab.robots import Robot
from armlab.state import Command, State
from armlab.wire.egm import EgmCodec, Reference

RIGHT = robots.load("yumi_right")


def test_limits_of_each() -> None:
    own = Limits.of(RIGHT, speed=0.5)
    assert checked_limits(own, [RIGHT]) == [own]
    np.testing.assert_array_equal(checked_limits(None, [RIGHT] * 2)[1].qd_max, RIGHT.qd_max)
    with pytest.raises(ConfigError, match="Limits for each"):
        checked_limits([own], [RIGHT, RIGHT])
    with pytest.raises(ConfigError, match="7 joints of yumi_right, got 6"):
        checked_limits(Limits(*np.stack([-np.ones(6), *[np.ones(6)] * 5])), [RIGHT])


def test_a_robot_without_limits_of_speed_is_not_commanded() -> None:
    """Any jump would pass the limits, since it may be as large as the speed allows."""
    robot = robots.load("dh_test")
    with pytest.raises(ConfigError, match=r"speed and acceleration.* of dh_test.*qd_max"):
        checked_limits(None, [robot])
    with pytest.raises(ConfigError, match="of dh_test"):
        checked_limits(Limits.of(robot), [robot])
    assert len(checked_limits(None, [robot], commands=False)) == 1
    ones = np.ones(robot.n)
    slow = Limits(-np.inf * ones, np.inf * ones, ones, ones, ones, ones)
    assert checked_limits(slow, [robot]) == [slow]


def ends(*arms: Robot) -> list[End]:
    return [End(arm, Port("127.0.0.1", 0), EgmCodec(arm), ()) for arm in arms]


OPTIONS: dict[str, Any] = {
    "commands": True,
    "answer_stream": True,
    "extra": None,
    "attachments": {},
    "feeds": (),
    "sources": (),
}


def test_one_clock_and_a_run_at_the_end(tmp_path: Path) -> None:
    made = ends(robots.load("yumi_left"), RIGHT)
    limits = checked_limits(None, [end.robot for end in made])
    arms = assemble(made, limits, Settings(), record=tmp_path / "run.mcap", **OPTIONS)
    assert all(isinstance(arm, Arm) for arm in arms)
    assert abs(arms[0].stamp_ns - arms[1].stamp_ns) < 10**9
    run = finished(arms, "the test is over")
    assert [arm.path for arm in run.arms] == [tmp_path / "runleft.mcap", tmp_path / "runright.mcap"]
    assert (run.reason, run.statistics["problems"]) == ("the test is over", [])
    for end in made:
        end.port.close()


def test_a_file_that_cannot_be_written_is_an_error_before_anything_moves(tmp_path: Path) -> None:
    made = ends(RIGHT)
    (tmp_path / "file").touch()
    with pytest.raises(LogError):
        assemble(made, [Limits.of(RIGHT)], Settings(), record=tmp_path / "file" / "run.mcap", **OPTIONS)
    made[0].port.close()


class Recorded(EgmCodec):
    """Remembers what it encoded."""

    encoded: list[Reference]

    def encode(self, ref: Reference) -> bytes:
        self.encoded.append(ref)
        return super().encode(ref)


def test_it_encodes_what_the_loop_would(robot: Robot, packets: Any) -> None:
    codec = Recorded(robot)
    codec.encoded = []
    port = Port("127.0.0.1", 0, to_itself=True)
    rehearsal = Rehearsal(robot, Limits.of(robot), codec, port)
    for k in range(10):
        arrival = Arrival(packets(), ("127.0.0.1", 5), 4_000_000 * k)
        rehearsal(arrival, Command(robot.q_home + 1e-4 * k))
    assert [ref.seq for ref in codec.encoded] == list(range(10))
    np.testing.assert_allclose(codec.encoded[-1].q, robot.q_home + 9e-4)
    rehearsal(Arrival(b"garbage", ("127.0.0.1", 5), 0), None)
    assert len(codec.encoded) == 10
    port.close()


def test_it_asks_no_model_of_the_user(robot: Robot, packets: Any) -> None:
    """The model of an admittance may remember its calls, as a filter does: the rehearsal is none of them."""
    calls = []
    admittance = Admittance(np.ones(robot.n), lambda q, qd: np.array(calls.append(0) or np.zeros(robot.n)))
    port = Port("127.0.0.1", 0, to_itself=True)
    rehearsal = Rehearsal(robot, Limits.of(robot), EgmCodec(robot), port, admittance)
    for k in range(3):
        rehearsal(Arrival(packets(), ("127.0.0.1", 5), 4_000_000 * k), Command(tau=np.ones(robot.n)))
    assert not calls
    port.close()


def test_it_never_sends_and_changes_no_reference(play: Any) -> None:
    """A polling run, which rehearses, answers each packet once and exactly as one that blocks."""

    def steady(state: State) -> Command:
        return Command(state.q_start + 1e-5 * (state.seq - first.setdefault(state.session, state.seq)))

    first: dict[int, int] = {}

    def script(peer: Any) -> None:
        peer.begin()
        peer.rest(pause=0.004)

    run = play(script, steady, play.link(clock="wall"), wait="spin", seconds=0.2)
    assert play.peer.surplus() == 0
    assert run.statistics["replies"] + run.statistics["overtaken"] == run.statistics["packets"]
    commanded = run.table["q_ref"]
    rows = np.isfinite(commanded).all(axis=1) & ~run.table["clamped"].astype(bool).any(axis=1)
    np.testing.assert_array_equal(run.table["q_sent"][rows], commanded[rows])
