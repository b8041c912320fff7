"""External axes and values for RAPID: within limits, once, and refused by sentences."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import bridge, robots
from armlab.bridge.control.external_axes import Aside, joined
from armlab.bridge.control.limits import Limiter, Limits
from armlab.bridge.control.state_machine import Guide, Mode
from armlab.errors import CommandRefused
from armlab.robots import Robot
from armlab.state import Command, State
from armlab.wire.egm import Beside, EgmCodec, Packet, Reference
from armlab.wire.egm.robot_side import RobotMessage, RobotSideCodec, SensorMessage

ABLE = frozenset(("position", "velocity", "external_axes", "rapid_data"))
AXES = Limits.of_axes([-1.0, -2.0], [1.0, 2.0], [0.5, 0.5])
T = 0.004


def packet(robot: Robot, q_ext: Any = (0.3, -0.2), robotware: str = "7") -> Packet:
    message = RobotMessage(1, 10, robot.q_home, robot.q_home, q_ext=q_ext, rapid_digital=False)
    found = EgmCodec(robot).decode(RobotSideCodec(robot, robotware, external=2).encode_robot(message))
    assert isinstance(found, Packet)
    return found


def seen(
    limits: Limits | None, robot: Robot, capabilities: frozenset[str] = ABLE, **fields: Any
) -> tuple[Aside, Packet]:
    """Return external axes whose feedback was plausible three times, and the packet."""
    aside, here = Aside(limits, capabilities), packet(robot, **fields)
    for _ in range(3):
        assert aside.observe(here, T) == ""
    return aside, here


def test_axes_move_within_their_limits_and_come_to_rest(robot: Robot) -> None:
    """Half a radian per second after 0.1 s, its speed with each position, and a ramp down in the end."""
    aside, here = seen(AXES, robot)
    assert aside.hold(T, T) is None, "nobody asked for a motion"
    goal = here.q_ext.copy()
    found: list[Beside] = []
    for _ in range(60):
        goal = goal + 0.0025
        found.append(aside.follow(Command(q_ext=goal), here, T, T) or Beside())
    q = np.array([one.q_ext for one in found])
    steps = np.diff(np.vstack((here.q_ext, q)), axis=0)
    assert steps.max() == pytest.approx(0.5 * T, rel=1e-6)
    assert np.diff(steps, axis=0).max() <= 5.0 * T**2 + 1e-12
    np.testing.assert_allclose(found[-1].qd_ext, steps[-1] / T, rtol=1e-6)
    assert not aside.at_rest
    rest = [aside.hold(T, T) for _ in range(40)]
    assert aside.at_rest
    assert rest[-1] is not None
    assert rest[-1].qd_ext is not None
    assert not rest[-1].qd_ext.any()
    assert rest[-1].rapid_data is None
    reply = Limiter(Limits.of(robot)).rest(robot.q_home)
    assert joined(reply, None) is reply
    assert joined(reply, rest[-1]).beside is rest[-1]
    where = aside.rest(here)
    assert where is not None
    np.testing.assert_array_equal(where.q_ext, here.q_ext)
    aside.begin()
    assert aside.rest(here) is None


def test_values_for_rapid_go_out_once(robot: Robot) -> None:
    aside, here = Aside(None, ABLE), packet(robot)
    found = aside.follow(Command(rapid_data=[1.0, 2.5], rapid_digital=True), here, T, T)
    assert found is not None
    assert (found.rapid_data.tolist(), found.rapid_digital, found.q_ext) == ([1.0, 2.5], True, None)  # type: ignore[union-attr]
    assert aside.follow(Command(robot.q_home), here, T, T) is None
    assert aside.follow(Command(rapid_digital=False), here, T, T) == Beside(rapid_digital=False)


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (Command(q_ext=np.array([0.3])), r"external axes, 2, got shape \(1,\)"),
        (Command(q_ext=np.array([0.3, np.nan])), "finite numbers in Command.q_ext"),
        (Command(q_ext=np.array([17.0, -0.2])), r"axis 1 within 0.05 of where it is, 0.3000, got 17.0000"),
        (Command(q_ext=np.array(["a", "b"])), "numbers in Command.q_ext"),
        (Command(q_ext=np.array([0.3, 1.0 + 1j])), "numbers in Command.q_ext.*of type complex128"),
        (Command(rapid_data=["1.0"]), "numbers in Command.rapid_data.*of type <U3"),  # type: ignore[list-item]
        (Command(rapid_data=[1.0] * 41), r"at most 40 numbers in a row in Command.rapid_data, got shape \(41,\)"),
        (Command(rapid_data=[[1.0]]), r"shape \(1, 1\)"),
        (Command(rapid_data=[np.inf]), "finite numbers in Command.rapid_data"),
        (Command(rapid_digital=1), "True, False or None in Command.rapid_digital, got 1"),  # type: ignore[arg-type]
    ],
)
def test_what_is_refused(robot: Robot, command: Command, words: str) -> None:
    with pytest.raises(CommandRefused, match=words):
        seen(AXES, robot)[0].follow(command, packet(robot), T, T)


def test_jumps_missing_limits_and_robots_that_cannot_are_refused(robot: Robot) -> None:
    aside, here = seen(AXES, robot)
    aside.follow(Command(q_ext=here.q_ext), here, T, T)
    with pytest.raises(CommandRefused, match=r"axis 2 near the last one sent, -0.2000, got 0.8000"):
        aside.follow(Command(q_ext=here.q_ext + np.array([0.0, 1.0])), here, T, T)
    aside.begin()
    with pytest.raises(CommandRefused, match=r"three times in a row before they are moved"):
        aside.follow(Command(q_ext=here.q_ext), here, T, T)
    for _ in range(3):
        aside.observe(here, T)
    with pytest.raises(CommandRefused, match=r"first position of external axis 1 within 0.05"):
        aside.follow(Command(q_ext=here.q_ext + 0.08), here, T, T)
    with pytest.raises(CommandRefused, match=r"external=Limits.of_axes"):
        Aside(None, ABLE).follow(Command(q_ext=here.q_ext), here, T, T)
    with pytest.raises(CommandRefused, match="cannot send external axes"):
        Aside(AXES, frozenset(("position",))).follow(Command(q_ext=here.q_ext), here, T, T)
    with pytest.raises(CommandRefused, match=r"need RobotWare 7, this is RobotWare 6.10"):
        aside.follow(Command(rapid_digital=True), packet(robot, robotware="6.10"), T, T)
    with pytest.raises(CommandRefused, match="a codec that cannot send it"):
        Aside(AXES, frozenset(("position",))).follow(Command(rapid_data=[1.0]), here, T, T)
    with pytest.raises(CommandRefused, match="external axes, 0, got"):
        aside.follow(Command(q_ext=here.q_ext), packet(robot, ()), T, T)


def test_a_refusal_stops_the_run_and_every_reply_says_where_the_axes_stay(feed: Any, robot: Robot) -> None:
    feed.packets.codec = RobotSideCodec(robot, "7", external=2)
    guide = Guide(robot, Limits.of(robot, external=AXES), capabilities=ABLE, on_event=feed.tell)
    here = np.array([0.3, -0.2])

    def cycle(command: Command | None, **fields: Any) -> Beside | None:
        guide.observe(feed.sample(q_ext=here, rapid_digital=False, **fields))
        reply = guide.answer(command, T)
        assert reply is not None
        return reply.beside

    assert cycle(None) is None
    assert cycle(Command(q_ext=here)) is not None
    guide.take_back()
    assert cycle(None) is None, "the first reference of the axes did not go out"
    for k in range(20):
        moving = cycle(Command(q_ext=here + 0.002 * k))
    assert moving is not None
    assert moving.qd_ext is not None
    assert moving.qd_ext.min() > 0.1
    assert guide.mode is Mode.HOLDING, "the joints hold"
    guide.observe(feed.sample(q_ext=here, rapid_digital=False))
    late = guide.hold(T)
    assert late is not None
    assert late.beside is not None
    away = cycle(None, motors=2)
    assert away is not None
    np.testing.assert_allclose(away.q_ext, here)
    cycle(Command(q_ext=here))
    last = cycle(Command(q_ext=here + 1.0))
    assert guide.mode is Mode.STOPPING
    assert isinstance(guide.failure, CommandRefused)
    assert last is not None
    np.testing.assert_allclose(last.q_ext, here, atol=0.01)


def moving(feed: Any, robot: Robot) -> tuple[Guide, Callable[..., Beside | None]]:
    """Return a guide whose external axes move at full speed, and what answers its next packet."""
    feed.packets.codec = RobotSideCodec(robot, "7", external=2)
    guide = Guide(robot, Limits.of(robot, external=AXES), capabilities=ABLE, on_event=feed.tell)
    here = np.array([0.3, -0.2])

    def cycle(command: Command | None = None, answered: bool = True, q_ext: Any = here, **fields: Any) -> Beside | None:
        guide.observe(feed.sample(q_ext=q_ext, **fields))
        reply = guide.answer(command, T) if answered else None
        return None if reply is None else reply.beside

    cycle()
    for k in range(60):
        found = cycle(Command(q_ext=here + 0.002 * k))
    assert found is not None
    np.testing.assert_allclose(found.qd_ext, 0.5)
    return guide, cycle


@pytest.mark.parametrize("away", ["overtaken", "not sent", "answered"])
def test_axes_begin_anew_where_they_are_when_the_robot_is_ready_again(feed: Any, robot: Robot, away: str) -> None:
    """Whether or not a packet that said so was answered: RAPID or a hand moved them meanwhile."""
    guide, cycle = moving(feed, robot)
    there = np.array([-0.6, 0.4])
    for _ in range(300):  # it takes them more than a second
        cycle(answered=away != "overtaken", q_ext=there, motors=2)
        if away == "not sent":
            guide.take_back()
    for k in range(3):
        found = cycle(q_ext=there + 0.001 * k)
        assert found is not None
        np.testing.assert_allclose(found.q_ext, there, rtol=1e-14)
        assert not np.any(found.qd_ext)
    assert guide.mode is Mode.HOLDING


@pytest.mark.parametrize(("off", "mode"), [(0.049, Mode.HOLDING), (0.051, Mode.STOPPING)])
def test_axes_begin_near_where_they_are_held_after_each_loss_of_readiness(
    feed: Any, robot: Robot, off: float, mode: Mode
) -> None:
    guide, cycle = moving(feed, robot)
    there = np.array([-0.6, 0.4])
    for _ in range(300):  # it takes them more than a second
        cycle(q_ext=there, motors=2)
    cycle(q_ext=there)
    cycle(Command(q_ext=there - off), q_ext=there + 0.01)
    assert guide.mode is mode
    if guide.failure is None:
        guide.take_back()
        cycle(Command(q_ext=there - 0.08), q_ext=there)
        assert guide.mode is Mode.STOPPING, "the first one did not go out"
    assert "first position of external axis 1 within 0.05" in str(guide.failure)


def test_axes_that_are_others_after_a_loss_of_readiness_do_not_move(feed: Any, robot: Robot) -> None:
    _, cycle = moving(feed, robot)
    cycle(motors=2)
    feed.packets.codec = RobotSideCodec(robot, "7", external=1)
    assert cycle(q_ext=[0.1]) is None
    assert cycle(q_ext=[0.1]) is None


def test_a_refused_jump_is_one_step_of_the_brake(feed: Any, robot: Robot) -> None:
    guide, cycle = moving(feed, robot)
    before = guide._last.beside
    after = cycle(Command(q_ext=np.array([1.4, -0.2])))
    assert guide.mode is Mode.STOPPING
    assert before is not None
    assert after is not None
    assert before.q_ext is not None
    np.testing.assert_allclose(after.qd_ext, 0.5 - 5.0 * T)
    np.testing.assert_allclose(after.q_ext, before.q_ext + (0.5 - 5.0 * T) * T, rtol=1e-12)


@pytest.mark.parametrize("name", ["yumi_right", "irb120"])
@pytest.mark.parametrize("extension", [False, True])
def test_the_round_trip_through_the_robots_codec(name: str, extension: bool) -> None:
    """Axis 7 of a YuMi shares its array with the axes beyond; one reply after another, with and without them."""
    robot = robots.load(name)
    codec, theirs = EgmCodec(robot, extension), RobotSideCodec(robot, external=2)
    q, qd = robot.q_home + 0.1, np.full(robot.n, 0.2)
    q_ext, qd_ext, data = np.array([0.5, -1.0]), np.array([0.1, 0.2]), np.array([3.0, -4.5])

    def heard(beside: Beside | None, speed: np.ndarray | None = qd) -> SensorMessage:
        found = theirs.decode_sensor(codec.encode(Reference(q, speed, None, 1, 2, beside=beside)))
        assert isinstance(found, SensorMessage)
        np.testing.assert_allclose(found.q, q)
        if speed is not None:
            np.testing.assert_allclose(found.qd, speed)
        return found

    for beside, speed in ((Beside(q_ext, qd_ext, data, True), qd), (Beside(q_ext, qd_ext), None), (Beside(q_ext), qd)):
        found = heard(beside, speed)
        np.testing.assert_allclose(found.q_ext, q_ext)
        if beside.rapid_data is None:
            assert (found.rapid_data, found.rapid_digital) == (None, None)
        else:
            np.testing.assert_array_equal(found.rapid_data, data)
            assert found.rapid_digital is True
    assert heard(None).q_ext is None
    assert heard(Beside(rapid_digital=False)).rapid_digital is False
    assert heard(Beside(rapid_data=data)).rapid_digital is None


def test_a_run_with_the_simulated_controller(tmp_path: Path) -> None:
    """Two external axes move, RAPID sends back what it hears, the log holds all of it."""
    robot = robots.load("irb120")
    limits = Limits.of(robot, external=Limits.of_axes([-1, -1], [1, 1], [0.5, 0.5]))
    first: dict[str, float] = {}

    def controller(state: State) -> Command:
        start = first.setdefault("t", state.t)
        q_ext = np.array([0.2, -0.1]) * min(1.0, (state.t - start) / 0.8)
        return Command(q_ext=q_ext, rapid_data=[state.t, 7.0], rapid_digital=state.t > 0.5)

    options = "lockstep=true&robotware=7&external=2&rapid-data=2&lagging=true"
    with bridge.connect(f"sim://irb120?{options}", robot) as link:
        run = link.run(controller, seconds=2.0, limits=limits, record=tmp_path / "run.mcap")
    table = run.table
    np.testing.assert_allclose(table["q_ext"][-1], [0.2, -0.1], atol=2e-3)
    np.testing.assert_allclose(table["q_ext_ref"][250:300], [[0.2, -0.1]] * 50)
    assert np.nanmax(np.abs(np.diff(table["q_ext_sent"], axis=0))) <= 0.5 * 0.00404
    sent, back = table["rapid_data_sent"], table["rapid_data"]
    assert sent.shape[1] == back.shape[1] == 2
    np.testing.assert_array_equal(back[100:200], sent[98:198])
    assert table["rapid_digital_sent"][50] == 0.0
    assert table["rapid_digital"][400] == 1.0
    states = list(table.states())
    np.testing.assert_array_equal(states[300].rapid_data, back[300])
    assert states[300].rapid_digital is True


@pytest.mark.parametrize("false", [100.0, 0.5])
def test_a_false_feedback_of_external_axes_is_never_a_reference(feed: Any, robot: Robot, false: float) -> None:
    guide, cycle = moving(feed, robot)
    here = np.array([0.3, -0.2])
    cycle(motors=2)
    for q_ext in (here + false, here + false, here):
        beside = cycle(q_ext=q_ext, motors=2 if q_ext is not here else 1)
        assert beside is not None
        np.testing.assert_allclose(beside.q_ext, here)
    assert len([text for text in feed.warnings if "external axes" in text]) == 1
    assert guide.ready
