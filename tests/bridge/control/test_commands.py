"""Commands: valid return values, torques, external axes, values for RAPID, and the errors for invalid commands."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import bridge, robots
from armlab.bridge.control.external_axes import ExternalReferences, joined
from armlab.bridge.control.limits import (
    Limiter,
    Limits,
    entry_refusal,
    joint_name,
    jump_refusal,
    kept,
    refusal,
    requested,
)
from armlab.bridge.control.state_machine import Mode, StateMachine
from armlab.bridge.control.torque import Admittance, TorqueFunction, Torques, admittances
from armlab.errors import CommandRefused, ConfigError, ModelMismatchError
from armlab.robots import Robot
from armlab.state import Command, State
from armlab.wire.egm import Beside, EgmCodec, Packet
from armlab.wire.egm.robot_side import RobotMessage, RobotSideCodec

from .test_state_machine import Bench


def test_references_pass(robot: Robot) -> None:
    q, qd, tau = requested(Command([0.0] * 7, np.ones(7, dtype=np.float32), [1] * 7), robot)  # type: ignore[arg-type]
    assert (tau.dtype, tau.sum()) == (np.float64, 7.0)
    assert (q.dtype, qd.dtype) == (np.float64, np.float64)
    assert requested(Command(), robot) == (None, None, None)
    _, qd, tau = requested(Command(np.zeros(7), ones := np.ones(7), ones), robot)
    assert qd is tau is ones
    [halves, whole, _] = requested(Command(np.full(14, 0.5)[::2], np.ones(7, dtype=np.uint8)), robot)
    assert (halves.sum(), halves.flags.c_contiguous, whole.sum(), whole.dtype) == (3.5, True, 7.0, np.float64)


@pytest.mark.parametrize(
    ("command", "words"),
    [
        ([0.0] * 7, "got list"),
        (Command(np.zeros(6)), r"shape \(7,\).*got \(6,\)"),
        (Command(qd=np.zeros((1, 7))), r"Command.qd.*got \(1, 7\)"),
        (Command(0.5), r"got \(\)"),  # type: ignore[arg-type]
        (Command(["a"] * 7), "7 numbers in Command.q"),  # type: ignore[arg-type]
        (Command({}), "7 numbers"),  # type: ignore[arg-type]
        (Command(["0.1"] * 7), "7 numbers in Command.q.*of type <U3"),  # type: ignore[arg-type]
        (Command(np.zeros(7, dtype=complex)), "7 numbers in Command.q.*of type complex128"),
        (Command(qd=np.zeros(7) > 0), "7 numbers in Command.qd.*of type bool"),
        (Command(np.full(7, np.datetime64(1, "s"))), r"of type datetime64\[s\]"),
        (Command(tau=np.array(["0.1"] * 7, dtype=object)), "7 numbers in Command.tau.*of type object"),
        (Command([10**400] * 7), "7 numbers"),  # type: ignore[arg-type]
        (Command(tau=np.zeros(6)), r"Command.tau.*got \(6,\)"),
    ],
)
def test_what_is_no_reference_is_refused(robot: Robot, command: Any, words: str) -> None:
    with pytest.raises(CommandRefused, match=words):
        requested(command, robot)


@pytest.mark.parametrize("name", ["q", "qd", "tau", "q_ext", "rapid_data"])
def test_what_is_kept_does_not_change(name: str) -> None:
    for values in (np.zeros(7), [0.0] * 7):
        given: dict[str, Any] = {name: values, "rapid_digital": True, "record": {"x": 1.0}, "ends": True}
        command = kept(Command(**given))
        values[2] = 1.0
        np.testing.assert_array_equal(getattr(command, name), np.zeros(7))
        assert (command.rapid_digital, command.record, command.ends) == (True, {"x": 1.0}, True)
        assert sum(getattr(command, one) is not None for one in ("q", "qd", "tau", "q_ext", "rapid_data")) == 1


def test_what_is_no_command_is_kept_to_be_refused(robot: Robot) -> None:
    assert kept(None) is None
    for odd in (3, Command([[1.0], [2.0, 3.0]])):  # type: ignore[list-item]
        with pytest.raises(CommandRefused):
            requested(kept(odd), robot)  # type: ignore[arg-type]


def test_the_sentence_names_joint_and_values(robot: Robot) -> None:
    q = np.zeros(7)
    q[2] = np.nan
    assert f"q = nan for joint 3 ({robot.joint_names[2]})" in refusal(3, q, None, np.zeros(7), robot)
    assert f"got q = nan, qd = 0.0 for joint 3 ({robot.joint_names[2]})" in refusal(3, q, np.zeros(7), q, robot)
    q[2] = 57.3
    sentence = refusal(-3, q, None, np.full(7, 0.3), robot)
    assert (
        f"sent, 0.3000, for joint 3 ({robot.joint_names[2]}) of {robot.name}, got 57.3000: a jump of 57.0000"
        in sentence
    )
    assert "degrees" in sentence


def test_entry(robot: Robot) -> None:
    held, entry = np.zeros(7), np.full(7, 0.05)
    assert entry_refusal(held + 0.05, held, entry, robot) == ""
    far = held.copy()
    far[[1, 4]] = [0.06, -0.5]
    assert f"-0.5000 for joint 5 ({robot.joint_names[4]})" in entry_refusal(far, held, entry, robot)
    wide = np.where(np.arange(7) == 4, 0.4, 0.05)
    far[1] = 0.1
    assert "joint 2" in entry_refusal(far, held, wide, robot), "twice the limit is worse than 1.25 times the limit"
    assert "for axis 1 of" in entry_refusal(far, held, wide, robot, lambda i: f"axis {i}")


def test_a_joint_is_named_as_its_client_counts(robot: Robot) -> None:
    assert joint_name(robot, 3) == f"joint 4 ({robot.joint_names[3]})"
    assert joint_name(robot, 3, first=7) == f"{robot.ros_joint_names[3]} (number 11 of the message)"
    axis = robot.abb_axes[3]
    assert joint_name(robot, 3, by_axis=True) == f"{robot.joint_names[3]} (number {axis} of the vector)"


def test_no_position_is_near_a_place_that_is_not_a_number(robot: Robot) -> None:
    held, entry = np.where(np.arange(7) == 3, np.nan, 0.0), np.full(7, 0.05)
    assert f"joint 4 ({robot.joint_names[3]}) of {robot.name}, which holds at nan" in entry_refusal(
        np.zeros(7), held, entry, robot
    )
    assert entry_refusal(held, np.zeros(7), entry, robot) == "", "the limiter refuses and counts it"
    sent, jump, name = held, np.full(7, 0.1), partial(joint_name, robot)
    assert jump_refusal(np.full(7, 0.1), np.zeros(7), jump, robot, name) == ""
    assert jump_refusal(np.full(7, 0.3), np.full(7, 0.25), jump, robot, name) == ""
    found = jump_refusal(np.full(7, 0.2), np.zeros(7), jump, robot, name)
    assert "got 0.2000: a jump of 0.2000" in found
    assert "ABB's axes" not in found
    assert f"the last position sent, nan, for joint 4 ({robot.joint_names[3]})" in jump_refusal(
        np.zeros(7), sent, jump, robot, name
    )


def test_far_is_what_the_axes_are_where_they_are_not_the_joints(robot: Robot) -> None:
    """Axis 3 of an IRB 2400 is the sum of joints 2 and 3: 0.04 in both is too far, but not with opposite signs."""
    linked, entry = robots.load("irb2400"), np.full(6, 0.05)
    q = np.array([0.0, 0.04, 0.04, 0.0, 0.0, 0.0])
    held = np.array([0.0, 0.0, 0.01, 0.0, 0.0, 0.0])
    assert "got 0.0800 for joint 3 (axis_3) of irb2400, which holds at 0.0100" in entry_refusal(q, held, entry, linked)
    assert entry_refusal(q * [1, 1, -1, 1, 1, 1], held, entry, linked) == ""
    assert "sent, 0.0100, for joint 3 (axis_3) of irb2400, got 0.0800: a jump of 0.0700" in refusal(
        -3, q, None, held, linked
    )
    for sentence in (entry_refusal(q, held, entry, linked), refusal(-3, q, None, held, linked)):
        assert "degrees instead of radians" in sentence
        assert "ABB's axes" in sentence


TORQUES = frozenset(("position", "velocity", "torque"))
T = 0.004


@pytest.fixture
def limits(robot: Robot) -> Limits:
    return Limits.of(robot, tau_max=10.0)


def test_a_torque_is_clipped_and_rises_slowly(robot: Robot, limits: Limits) -> None:
    """10 N m in 0.1 s is 0.4 N m per period of 4 ms; the torque then stays at the limit and falls at the same rate."""
    torques, limiter = Torques(robot, limits, TORQUES), Limiter(limits)
    reply = limiter.rest(robot.q_home)
    assert torques.limited(reply, None, T) is reply
    wanted = np.zeros(7)
    wanted[0], wanted[1] = 50.0, 0.3
    found = [torques.limited(reply, wanted, T) for _ in range(30)]
    sent = np.array([one.tau for one in found])
    np.testing.assert_allclose(sent[:3, 0], [0.4, 0.8, 1.2])
    np.testing.assert_allclose(sent[-1, :2], [10.0, 0.3])
    assert found[0].clamped.tolist() == [48, 0, 0, 0, 0, 0, 0]
    assert found[-1].clamped[0] == 16
    assert not found[-1].tau.flags.writeable  # type: ignore[union-attr]
    assert not found[-1].clamped.flags.writeable
    back = [torques.limited(reply, None, T) for _ in range(30)]
    assert np.abs(np.diff([one.tau[0] for one in back if one.tau is not None])).max() <= 0.4 + 1e-12
    assert back[-1].tau is None


def test_rounding_is_not_a_clamp(robot: Robot, limits: Limits) -> None:
    reply = Limiter(limits).rest(robot.q_home)
    for more, slowed, clipped in ((0.0, 0, 0), (1e-6, 32, 16)):
        torques = Torques(robot, limits, TORQUES)
        assert torques.limited(reply, np.full(7, 0.4 + more), T).clamped.tolist() == [slowed] * 7
        for k in range(1, 25):
            torques.limited(reply, np.full(7, 0.4 * (k + 1)), T)
        assert torques.limited(reply, np.full(7, 10.0 + more), T).clamped.tolist() == [clipped] * 7


@pytest.mark.parametrize(
    ("able", "tau_max", "tau", "words"),
    [
        (["position", "velocity"], 10.0, 0.0, r'supported by this link: position, velocity\)\..*torque="admittance"'),
        ([], 10.0, 0.0, "supported by this link: none"),
        (TORQUES, None, 0.0, r"no torque limits.*tau_max"),
        (TORQUES, 10.0, np.nan, "NaN is never"),
    ],
)
def test_torques_that_are_refused(robot: Robot, able: Any, tau_max: float | None, tau: float, words: str) -> None:
    torques = Torques(robot, Limits.of(robot, tau_max=tau_max), frozenset(able))
    with pytest.raises(CommandRefused, match=words):
        torques.requested(None, None, np.full(7, tau), robot.q_home, np.zeros(7))


def test_drives_that_report_no_torque_take_none(robot: Robot, limits: Limits) -> None:
    """A simulated arm without masses has the extension, but no torques. Other links never report torques."""
    tau, state = np.ones(7), (robot.q_home, np.zeros(7))
    torques = Torques(robot, limits, TORQUES | {"measured_torque"})
    assert torques.requested(None, None, tau, *state)[2] is tau
    with pytest.raises(CommandRefused, match="reports no torques"):
        torques.requested(None, None, tau, *state, measured=False)
    assert Torques(robot, limits, TORQUES).requested(None, None, tau, *state, measured=False)[2] is tau


def test_admittance_by_hand(robot: Robot, limits: Limits) -> None:
    """qd = (tau - tau_model) / D."""
    model: TorqueFunction = lambda q, qd: q + 2.0 * qd  # noqa: E731
    unit = Admittance(np.full(7, 5.0), model)
    torques = Torques(robot, limits, frozenset(("position", "velocity")), unit)
    q, qd = np.arange(7.0), np.ones(7)
    asked, speed, tau = torques.requested(None, None, np.full(7, 12.0), q, qd)
    assert (asked, tau) == (None, None)
    np.testing.assert_allclose(speed, (12.0 - (q + 2.0)) / 5.0)
    with pytest.raises(CommandRefused, match="only tau"):
        torques.requested(q, None, q, q, qd)
    plain = Admittance([5.0] * 7)  # type: ignore[arg-type]
    assert isinstance(plain.damping, np.ndarray)
    np.testing.assert_allclose(plain.velocity(q, q, qd), q / 5.0)


@pytest.mark.parametrize("damping", [[0.0] * 7, [-1.0] * 7, [np.nan] * 7, 3.0])
def test_damping_must_be_positive(damping: Any) -> None:
    with pytest.raises(ConfigError, match="positive damping"):
        Admittance(damping)


def test_admittances_of_each_arm() -> None:
    arms = [robots.load("yumi_left"), robots.load("ur5e")]
    assert admittances("refuse", None, None, arms) == [None, None]
    first, second = admittances("admittance", np.arange(1.0, 14.0), None, arms)
    assert (len(first.damping), second.damping[0]) == (7, 8.0)
    models: list[TorqueFunction] = [lambda q, qd: q, lambda q, qd: qd, lambda q, qd: q + qd]
    three = admittances("admittance", np.arange(1.0, 21.0), models, [*arms, arms[0]])
    assert [(one.damping[0], one.model) for one in three if one] == list(zip((1.0, 8.0, 14.0), models, strict=True))
    (alone,) = admittances("admittance", np.ones(7), models[0], arms[:1])
    assert alone.model is models[0]
    for torque, damping, model, words in (
        ("always", None, None, '"refuse" or "admittance"'),
        ("admittance", None, None, "13 joints"),
        ("admittance", np.ones(7), None, "13 joints"),
        ("refuse", np.ones(13), None, "only"),
        ("admittance", np.ones(13), lambda q, qd: q, "torque models, one per arm"),
    ):
        with pytest.raises(ConfigError, match=words):
            admittances(torque, damping, model, arms)


def test_an_admittance_takes_an_identified_model_or_its_fit(fitted, truth) -> None:
    robot, model = truth.robot, fitted.value
    q, qd = robot.q_home + 0.1, np.full(robot.n, 0.2)
    wanted = model.torque(q[None], qd[None])[0]
    for given in (model, fitted, [fitted]):
        (one,) = admittances("admittance", np.ones(robot.n), given, [robot])
        np.testing.assert_array_equal(one.model(q, qd), wanted)
    with pytest.raises(ModelMismatchError):
        admittances("admittance", np.ones(6), fitted, [robots.load("ur5e")])


def test_a_torque_alone_follows_the_arm_and_ends_in_a_hold(feed: Any, robot: Robot, limits: Limits) -> None:
    machine = StateMachine(robot, limits, capabilities=TORQUES, on_event=feed.tell)
    home, push = robot.q_home, np.zeros(7)
    push[1] = 4.0

    def see(q: np.ndarray, command: Command | None) -> Any:
        machine.observe(feed.sample(q=q))
        return machine.answer(command, T)

    see(home, None)
    for k in range(5):
        reply = see(home + 1e-3 * k, Command(tau=push))
        assert reply.free
        np.testing.assert_allclose(reply.q, home + 1e-3 * k)
        assert reply.tau[1] == pytest.approx(0.4 * (k + 1))
    assert machine.mode is Mode.RUNNING
    machine.take_back()
    assert see(home, Command(tau=push)).tau[1] == pytest.approx(0.4 * 6), "an unsent command counts only as time"
    held = see(home + 5e-3, None)
    assert not held.free
    assert machine.mode is Mode.HOLDING
    np.testing.assert_allclose(held.q, home + 4e-3, atol=0.02)


def test_a_torque_alone_is_refused_beyond_the_limits_of_the_arm(feed: Any, robot: Robot, limits: Limits) -> None:
    machine = StateMachine(robot, limits, capabilities=TORQUES, on_event=feed.tell)
    q = robot.q_home.copy()
    q[3] = limits.q_max[3] - 0.005
    machine.observe(feed.sample(q=q))
    q[3] = limits.q_max[3] + 0.005
    for _ in range(3):
        machine.observe(feed.sample(q=q))
        reply: Any = machine.answer(Command(tau=np.ones(7)), T)
        assert not reply.free
    assert machine.mode is Mode.STOPPING
    low, high = limits.q_min[3], limits.q_max[3]
    assert (
        f"joint 4 ({robot.joint_names[3]}) is at {q[3]:.4f}; the allowed range is from {low:.4f} to {high:.4f}."
        in str(machine.failure)
    )
    outside, fast = Torques(robot, limits, TORQUES).outside, np.array([0, 99.0, 0, 0, 0, 0, 0])
    words = f"joint 2 ({robot.joint_names[1]}) is moving at 99.0000; the allowed range is up to {limits.qd_max[1]:.4f}."
    assert words in outside(robot.q_home, fast)
    for end, sign in ((limits.q_min, 1.0), (limits.q_max, -1.0)):
        assert outside(end, sign * limits.qd_max) == "", "the limits themselves are allowed"


def test_torque_limits_of_a_robot(robot: Robot) -> None:
    """No torque limits are added to a robot without them; ur5e has 150 N m and 28 N m."""
    assert Limits.of(robot).tau_max is None
    limits = Limits.of(robots.load("ur5e"))
    np.testing.assert_allclose(limits.tau_rate, [1500.0] * 3 + [280.0] * 3)
    with pytest.raises(ConfigError, match="together"):
        Limits(*np.stack([-np.ones(6), *[np.ones(6)] * 5]), tau_max=np.ones(6))
    with pytest.raises(ConfigError, match="tau_max above 0"):
        Limits.of(robot, tau_max=-1.0)


@pytest.fixture
def pushed(feed: Any, robot: Robot, limits: Limits) -> Bench:
    return Bench(feed, robot, limits, capabilities=TORQUES)


def test_a_torque_beside_a_position(pushed: Bench, robot: Robot) -> None:
    for _ in range(2):
        pushed.reply(None)
        for k in range(3):
            assert pushed.reply(Command(pushed.home, tau=np.full(7, 10.0))).tau == pytest.approx(0.4 * (k + 1))
        assert pushed.reply(Command(pushed.home)).tau == pytest.approx(0.8), "without tau, it falls at the same rate"
        assert pushed.reply(Command(pushed.home, tau=np.full(7, 10.0))).tau == pytest.approx(1.2)
        refused = pushed.reply(Command(pushed.home + 1.0, tau=np.full(7, 10.0)))
        assert refused.tau == pytest.approx(0.8)
        pushed.see(motors=2)


@pytest.mark.parametrize("late", [False, True])
def test_after_a_gap_a_torque_falls_by_no_more_than_in_three_periods(pushed: Bench, late: bool) -> None:
    pushed.reply(None)
    for _ in range(10):
        before = pushed.reply(Command(pushed.home, tau=np.full(7, 10.0)))
    for _ in range(10):
        pushed.see()
    held: Any = pushed.machine.hold(T) if late else pushed.machine.answer(None, T)
    np.testing.assert_allclose(held.tau, before.tau - 3 * 0.4)


@pytest.mark.parametrize("kind", ["q", "tau"])
def test_a_good_command_ends_the_count_of_the_refusals_before(pushed: Bench, kind: str) -> None:
    good = Command(**{kind: pushed.home if kind == "q" else np.ones(7)})
    pushed.reply(None)
    for _ in range(2):
        for command in (*[Command(pushed.home + 0.06)] * 150, good, *[Command(np.full(7, np.nan))] * 2, good):
            pushed.reply(command)
        assert pushed.mode is Mode.RUNNING
        pushed.reply(None)
    assert pushed.machine.refused == 304
    assert not any("the first position within" in text for text in pushed.feed.warnings), "twice 0.6 s, not 1.2 s"


MEASURED = TORQUES | {"measured_torque"}


@pytest.mark.parametrize(
    ("able", "tau", "warned", "mode"),
    [
        (MEASURED, None, True, Mode.STOPPING),
        (MEASURED, np.zeros(7), False, Mode.RUNNING),
        (MEASURED - {"torque"}, None, False, Mode.STOPPING),
    ],
)
def test_a_robot_that_could_take_torques_but_reports_none_is_told(
    feed: Any, robot: Robot, limits: Limits, able: frozenset[str], tau: Any, warned: bool, mode: Mode
) -> None:
    feed.packets.codec = RobotSideCodec(robot, extension=True)
    bench = Bench(feed, robot, limits, capabilities=able)
    bench.reply(None, tau=tau)
    assert any("it accepts no torque commands" in text for text in feed.events) == warned
    bench.reply(Command(tau=np.ones(7)), tau=tau)
    assert bench.mode is mode


ABLE = frozenset(("position", "velocity", "external_axes", "rapid_data"))
AXES = Limits.of_axes([-1.0, -2.0], [1.0, 2.0], [0.5, 0.5])


def packet(robot: Robot, q_ext: Any = (0.3, -0.2), robotware: str = "7") -> Packet:
    message = RobotMessage(1, 10, robot.q_home, robot.q_home, q_ext=q_ext, rapid_digital=False)
    found = EgmCodec(robot).decode(RobotSideCodec(robot, robotware, external=2).encode_robot(message))
    assert isinstance(found, Packet)
    return found


def seen(
    limits: Limits | None, robot: Robot, capabilities: frozenset[str] = ABLE, **fields: Any
) -> tuple[ExternalReferences, Packet]:
    """Return external axes whose feedback was plausible three times, and the packet."""
    external, here = ExternalReferences(limits, capabilities), packet(robot, **fields)
    for _ in range(3):
        assert external.observe(here, T) == ""
    return external, here


def test_axes_move_within_their_limits_and_come_to_rest(robot: Robot) -> None:
    """The axes reach 0.5 rad/s after 0.1 s, each position is sent with its speed, and they ramp down at the end."""
    external, here = seen(AXES, robot)
    assert external.hold(T, T) is None, "no motion was commanded"
    goal = here.q_ext + 0.0025 * np.arange(1, 61)[:, None]
    found = [external.follow(Command(q_ext=q_ext), here, T, T) or Beside() for q_ext in goal]
    steps = np.diff([here.q_ext, *[one.q_ext for one in found if one.q_ext is not None]], axis=0)
    assert steps.max() == pytest.approx(0.5 * T, rel=1e-6)
    assert np.diff(steps, axis=0).max() <= 5.0 * T**2 + 1e-12
    np.testing.assert_allclose(found[-1].qd_ext, steps[-1] / T, rtol=1e-6)
    assert not external.at_rest
    rest: Any = [external.hold(T, T) for _ in range(40)][-1]
    assert external.at_rest
    assert not rest.qd_ext.any()
    assert rest.rapid_data is None
    reply = Limiter(Limits.of(robot)).rest(robot.q_home)
    assert joined(reply, None) is reply
    assert joined(reply, rest).beside is rest
    np.testing.assert_array_equal(external.rest(here).q_ext, here.q_ext)
    external.begin()
    assert external.rest(here) is None


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (Command(q_ext=np.array([0.3])), r"Expected 2 values .* in the limits, .*got shape \(1,\)"),
        (Command(q_ext=np.array([0.3, np.nan])), "finite numbers in Command.q_ext"),
        (Command(q_ext=np.array([17.0, -0.2])), r"axis 1 within 0.05 of its current position, 0.3000, got 17.0000"),
        (Command(q_ext=np.array(["a", "b"])), "numbers in Command.q_ext"),
        (Command(q_ext=np.array([0.3, 1.0 + 1j])), "numbers in Command.q_ext.*of type complex128"),
        (Command(rapid_data=["1.0"]), "numbers in Command.rapid_data.*of type <U3"),  # type: ignore[list-item]
        (Command(rapid_data=[1.0] * 41), r"at most 40 numbers in Command.rapid_data, got shape \(41,\)"),
        (Command(rapid_data=[[1.0]]), r"shape \(1, 1\)"),
        (Command(rapid_data=[np.inf]), "finite numbers in Command.rapid_data"),
        (Command(rapid_digital=1), "True, False or None in Command.rapid_digital, got 1"),  # type: ignore[arg-type]
    ],
)
def test_what_is_refused(robot: Robot, command: Command, words: str) -> None:
    with pytest.raises(CommandRefused, match=words):
        seen(AXES, robot)[0].follow(command, packet(robot), T, T)


def test_jumps_missing_limits_and_robots_that_cannot_are_refused(robot: Robot) -> None:
    external, here = seen(AXES, robot)
    external.follow(Command(q_ext=here.q_ext), here, T, T)
    with pytest.raises(CommandRefused, match=r"axis 2 near the last position sent, -0.2000, got 0.8000"):
        external.follow(Command(q_ext=here.q_ext + np.array([0.0, 1.0])), here, T, T)
    external.begin()
    with pytest.raises(CommandRefused, match=r"three times in a row before they are moved"):
        external.follow(Command(q_ext=here.q_ext), here, T, T)
    for _ in range(3):
        external.observe(here, T)
    with pytest.raises(CommandRefused, match=r"first position of external axis 1 within 0.05"):
        external.follow(Command(q_ext=here.q_ext + 0.08), here, T, T)
    with pytest.raises(CommandRefused, match=r"external=Limits.of_axes"):
        ExternalReferences(None, ABLE).follow(Command(q_ext=here.q_ext), here, T, T)
    with pytest.raises(CommandRefused, match="cannot send external axes"):
        ExternalReferences(AXES, frozenset(("position",))).follow(Command(q_ext=here.q_ext), here, T, T)
    with pytest.raises(CommandRefused, match=r"require RobotWare 7, but this is RobotWare 6.10"):
        external.follow(Command(rapid_digital=True), packet(robot, robotware="6.10"), T, T)
    with pytest.raises(CommandRefused, match="a codec that cannot send RAPID data"):
        ExternalReferences(AXES, frozenset(("position",))).follow(Command(rapid_data=[1.0]), here, T, T)
    with pytest.raises(CommandRefused, match=r"Expected 0 values .* in the limits, .*got"):
        external.follow(Command(q_ext=here.q_ext), packet(robot, ()), T, T)


def test_feedback_of_external_axes_is_plausible_near_the_range_and_near_the_last_position(robot: Robot) -> None:
    """At most 0.1 outside; a step of at most 0.02 plus twice the speed limit times the time since the last."""
    limits, here = Limits.of_axes([-1.0, -2.0], [1.0, 2.0], [0.25, 0.5]), packet(robot)
    reach = 0.02 + 2.0 * limits.qd_max * 1.0
    for start, limit, beyond in (
        (limits.q_max, limits.q_max + 0.1, 9.0),
        (limits.q_min, limits.q_min - 0.1, -9.0),
        (np.zeros(2), reach, 9.0),
        (np.zeros(2), -reach, -9.0),
    ):
        for q_ext, words in ((limit, ""), (np.nextafter(limit, beyond), "This feedback is ignored.")):
            external = ExternalReferences(limits, ABLE)
            assert external.observe(here._replace(q_ext=start), T) == ""
            assert external.observe(here._replace(q_ext=q_ext), 1.0)[-25:] == words
    far = here._replace(q_ext=np.array([9.0, 0.0]))
    assert external.observe(far, T) == "", "only the first of several is reported"
    external.observe(here._replace(q_ext=-reach * 1.01), 0.1)
    assert external.observe(far, T), "the step was plausible, because the last plausible packet was 1.104 s before it"
    assert ExternalReferences(AXES, ABLE).observe(packet(robot, ()), T) == "", "a robot without external axes"


def test_external_axes_without_limits_stay_at_rest(robot: Robot) -> None:
    external, here = ExternalReferences(None, ABLE), packet(robot)
    assert external.observe(here, T) == ""
    assert external.at_rest
    external.memory = external.memory
    assert external.memory == (False, False, None)


def test_external_axes_wait_for_three_plausible_packets(robot: Robot) -> None:
    external, here = ExternalReferences(AXES, ABLE), packet(robot)._replace(q_ext=np.zeros(2))
    first = Command(q_ext=AXES.entry)
    for _ in range(3):
        with pytest.raises(CommandRefused, match="three times in a row"):
            external.follow(first, here, T, T)
        external.observe(here, T)
    assert external.follow(Command(), here, T, T) is external.rest(here) is None, "no motion was commanded"
    for _ in range(20):
        assert external.follow(first, here, T, T) is not None
    memory = external.memory
    found = [external.follow(first, here, T, T) for _ in range(2)]
    external.memory = memory
    again = [external.follow(first, here, T, T) for _ in range(2)]
    np.testing.assert_array_equal([one.qd_ext for one in found if one], [one.qd_ext for one in again if one])
    assert not external.at_rest
    external.begin()
    assert external.at_rest, "they are disabled"


def test_rapid_data_are_sent_with_or_without_a_motion_of_the_axes(robot: Robot) -> None:
    external, here = seen(AXES, robot)
    found = external.follow(Command(rapid_data=np.arange(40.0)), here, T, T) or Beside()
    np.testing.assert_array_equal(found.rapid_data, np.arange(40.0))
    assert not found.rapid_data.flags.writeable
    assert found.q_ext is None
    external.follow(Command(q_ext=here.q_ext), here, T, T)
    found = external.follow(Command(rapid_digital=True), here, T, T) or Beside()
    assert found.rapid_digital is True
    np.testing.assert_array_equal(found.q_ext, here.q_ext)


def test_a_refusal_stops_the_run_and_every_reply_says_where_the_axes_stay(feed: Any, robot: Robot) -> None:
    machine, cycle = moving(feed, robot, 0)
    here = np.array([0.3, -0.2])
    assert cycle(Command(q_ext=here)) is not None
    machine.take_back()
    assert cycle() is None, "the first reference of the axes was not sent"
    for k in range(20):
        found = cycle(Command(q_ext=here + 0.002 * k))
    assert found.qd_ext.min() > 0.1
    assert machine.mode is Mode.HOLDING, "the joints hold"
    cycle(answered=False)
    assert machine.hold(T).beside is not None
    np.testing.assert_allclose(cycle(motors=2).q_ext, here)
    cycle(Command(q_ext=here))
    last = cycle(Command(q_ext=here + 1.0))
    assert machine.mode is Mode.STOPPING
    assert isinstance(machine.failure, CommandRefused)
    np.testing.assert_allclose(last.q_ext, here, atol=0.01)


def moving(feed: Any, robot: Robot, cycles: int = 60) -> tuple[StateMachine, Callable[..., Any]]:
    """Return a machine with external axes at full speed after 60 cycles, and a function that answers its packets."""
    feed.packets.codec = RobotSideCodec(robot, "7", external=2)
    machine = StateMachine(robot, Limits.of(robot, external=AXES), capabilities=ABLE, on_event=feed.tell)
    here = np.array([0.3, -0.2])

    def cycle(command: Command | None = None, answered: bool = True, q_ext: Any = here, **fields: Any) -> Beside | None:
        machine.observe(feed.sample(q_ext=q_ext, **fields))
        reply = machine.answer(command, T) if answered else None
        return None if reply is None else reply.beside

    found = cycle()
    for k in range(cycles):
        found = cycle(Command(q_ext=here + 0.002 * k))
    assert cycles == 0 or np.allclose(found.qd_ext, 0.5, rtol=1e-7, atol=0.0)
    return machine, cycle


@pytest.mark.parametrize("away", ["overtaken", "not sent", "answered"])
def test_axes_begin_anew_where_they_are_when_the_robot_is_ready_again(feed: Any, robot: Robot, away: str) -> None:
    machine, cycle = moving(feed, robot)
    there = np.array([-0.6, 0.4])
    for _ in range(300):  # the axes need more than a second
        cycle(answered=away != "overtaken", q_ext=there, motors=2)
        if away == "not sent":
            machine.take_back()
    for k in range(3):
        found = cycle(q_ext=there + 0.001 * k)
        np.testing.assert_allclose(found.q_ext, there, rtol=1e-14)
        assert not np.any(found.qd_ext)
    assert machine.mode is Mode.HOLDING


@pytest.mark.parametrize(("off", "mode"), [(0.049, Mode.HOLDING), (0.051, Mode.STOPPING)])
def test_axes_begin_near_where_they_are_held_after_each_loss_of_readiness(
    feed: Any, robot: Robot, off: float, mode: Mode
) -> None:
    machine, cycle = moving(feed, robot)
    there = np.array([-0.6, 0.4])
    for _ in range(300):  # it takes them more than a second
        cycle(q_ext=there, motors=2)
    cycle(q_ext=there)
    cycle(Command(q_ext=there - off), q_ext=there + 0.01)
    assert machine.mode is mode
    if machine.failure is None:
        machine.take_back()
        cycle(Command(q_ext=there - 0.08), q_ext=there)
        assert machine.mode is Mode.STOPPING, "the first reference was not sent"
    assert "first position of external axis 1 within 0.05" in str(machine.failure)


def test_axes_that_are_others_after_a_loss_of_readiness_do_not_move(feed: Any, robot: Robot) -> None:
    _, cycle = moving(feed, robot)
    cycle(motors=2)
    feed.packets.codec = RobotSideCodec(robot, "7", external=1)
    assert cycle(q_ext=[0.1]) is None
    assert cycle(q_ext=[0.1]) is None


def test_a_refused_jump_is_one_step_of_the_brake(feed: Any, robot: Robot) -> None:
    machine, cycle = moving(feed, robot)
    before = machine._last.beside
    after = cycle(Command(q_ext=np.array([1.4, -0.2])))
    assert machine.mode is Mode.STOPPING
    np.testing.assert_allclose(after.qd_ext, 0.5 - 5.0 * T)
    np.testing.assert_allclose(after.q_ext, before.q_ext + (0.5 - 5.0 * T) * T, rtol=1e-12)


def test_a_run_with_the_simulated_controller(tmp_path: Path) -> None:
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
    machine, cycle = moving(feed, robot)
    here = np.array([0.3, -0.2])
    cycle(motors=2)
    for q_ext in (here + false, here + false, here):
        beside = cycle(q_ext=q_ext, motors=2 if q_ext is not here else 1)
        np.testing.assert_allclose(beside.q_ext, here)
    assert ["external axes" in text for text in feed.warnings] == [False, True], "the first: the robot is not ready"
    assert machine.ready
