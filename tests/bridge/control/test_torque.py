"""Torques on their way to the robot: limits, refusals, the admittance, and a simulated arm that is pushed by them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge import Limits, connect
from armlab.bridge.control.limits import Limiter
from armlab.bridge.control.state_machine import Mode, StateMachine
from armlab.bridge.control.torque import Admittance, TorqueModel, Torques, admittances
from armlab.errors import CommandRefused, ConfigError
from armlab.robots import Robot
from armlab.state import Command, State

from .test_state_machine import Bench

ABLE = frozenset(("position", "velocity", "torque"))
T = 0.004


@pytest.fixture
def limits(robot: Robot) -> Limits:
    return Limits.of(robot, tau_max=10.0)


def test_a_torque_is_clipped_and_rises_slowly(robot: Robot, limits: Limits) -> None:
    """10 N m in 0.1 s are 0.4 N m in a period of 4 ms; then it stays at the limit, and returns as slowly."""
    torques, limiter = Torques(robot, limits, ABLE), Limiter(limits)
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
    """What is asked for exactly at a limit is sent, and no bit tells of it; a millionth more is told."""
    reply = Limiter(limits).rest(robot.q_home)
    for more, slowed, clipped in ((0.0, 0, 0), (1e-6, 32, 16)):
        torques = Torques(robot, limits, ABLE)
        assert torques.limited(reply, np.full(7, 0.4 + more), T).clamped.tolist() == [slowed] * 7
        for k in range(1, 25):
            torques.limited(reply, np.full(7, 0.4 * (k + 1)), T)
        assert torques.limited(reply, np.full(7, 10.0 + more), T).clamped.tolist() == [clipped] * 7


def test_without_the_capability_a_torque_is_refused_by_name(robot: Robot, limits: Limits) -> None:
    plain = Torques(robot, limits, frozenset(("position", "velocity")))
    with pytest.raises(CommandRefused, match=r'can carry position, velocity only.*torque="admittance"'):
        plain.wanted(Command(tau=np.zeros(7)), robot.q_home, np.zeros(7))
    with pytest.raises(CommandRefused, match="can carry nothing only"):
        Torques(robot, limits, frozenset()).wanted(Command(tau=np.zeros(7)), robot.q_home, np.zeros(7))
    with pytest.raises(CommandRefused, match=r"no torque limits.*tau_max"):
        Torques(robot, Limits.of(robot), ABLE).wanted(Command(tau=np.zeros(7)), robot.q_home, np.zeros(7))


@pytest.mark.parametrize(
    ("tau", "words"), [(np.full(7, np.nan), "NaN never"), (np.zeros(6), r"\(6,\)"), (["a"] * 7, "7 numbers")]
)
def test_what_is_no_torque_is_refused(robot: Robot, limits: Limits, tau: Any, words: str) -> None:
    with pytest.raises(CommandRefused, match=words):
        Torques(robot, limits, ABLE).wanted(Command(tau=tau), robot.q_home, np.zeros(7))


def test_admittance_by_hand(robot: Robot, limits: Limits) -> None:
    """qd = (tau - tau_model) / D."""
    model: TorqueModel = lambda q, qd: q + 2.0 * qd  # noqa: E731
    unit = Admittance(np.full(7, 5.0), model)
    torques = Torques(robot, limits, frozenset(("position", "velocity")), unit)
    q, qd = np.arange(7.0), np.ones(7)
    assert torques.wanted(Command(), q, qd) == (None, None, None)
    asked, speed, tau = torques.wanted(Command(tau=np.full(7, 12.0)), q, qd)
    assert (asked, tau) == (None, None)
    assert speed is not None
    np.testing.assert_allclose(speed, (12.0 - (q + 2.0)) / 5.0)
    with pytest.raises(CommandRefused, match="tau alone"):
        torques.wanted(Command(q, tau=q), q, qd)
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
    assert first is not None
    assert second is not None
    assert (len(first.damping), second.damping[0]) == (7, 8.0)
    models: list[TorqueModel] = [lambda q, qd: q, lambda q, qd: qd, lambda q, qd: q + qd]
    three = admittances("admittance", np.arange(1.0, 21.0), models, [*arms, arms[0]])
    assert [(one.damping[0], one.model) for one in three if one] == list(zip((1.0, 8.0, 14.0), models, strict=True))
    (alone,) = admittances("admittance", np.ones(7), models[0], arms[:1])
    assert alone is not None
    assert alone.model is models[0]
    for torque, damping, model, words in (
        ("always", None, None, "refuse, admittance"),
        ("admittance", None, None, "13 joints"),
        ("admittance", np.ones(7), None, "13 joints"),
        ("refuse", np.ones(13), None, "only"),
        ("admittance", np.ones(13), lambda q, qd: q, "one torque_model per arm"),
    ):
        with pytest.raises(ConfigError, match=words):
            admittances(torque, damping, model, arms)


def test_a_torque_alone_follows_the_arm_and_ends_in_a_hold(feed: Any, robot: Robot, limits: Limits) -> None:
    machine = StateMachine(robot, limits, capabilities=ABLE, on_event=feed.tell)
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
    assert see(home, Command(tau=push)).tau[1] == pytest.approx(0.4 * 6), "what did not go out counts as time only"
    held = see(home + 5e-3, None)
    assert not held.free
    assert machine.mode is Mode.HOLDING
    np.testing.assert_allclose(held.q, home + 4e-3, atol=0.02)


def test_a_torque_alone_is_refused_beyond_the_limits_of_the_arm(feed: Any, robot: Robot, limits: Limits) -> None:
    machine = StateMachine(robot, limits, capabilities=ABLE, on_event=feed.tell)
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
    assert f"joint 4 ({robot.joint_names[3]}) is at {q[3]:.4f}, allowed is from {low:.4f} to {high:.4f}." in str(
        machine.failure
    )
    outside, fast = Torques(robot, limits, ABLE).outside, np.array([0, 99.0, 0, 0, 0, 0, 0])
    words = f"joint 2 ({robot.joint_names[1]}) is moving at 99.0000, allowed is up to {limits.qd_max[1]:.4f}."
    assert words in outside(robot.q_home, fast)
    for end, sign in ((limits.q_min, 1.0), (limits.q_max, -1.0)):
        assert outside(end, sign * limits.qd_max) == "", "the limits themselves are within"


def test_a_simulated_arm_moves_as_it_is_pushed() -> None:
    """A torque beyond its friction turns joint 1 the way it pushes; then the arm holds where it is."""
    robot = robots.load("yumi_right")
    push = np.zeros(7)

    def controller(state: State) -> Command | None:
        push[0] = 5.0 if state.t < 0.3 else 0.0
        return Command(tau=push.copy()) if state.t < 0.5 else None

    with connect("sim://yumi_right?lockstep=true&seed=3", robot) as link:
        run = link.run(controller, seconds=1.5, limits=Limits.of(robot, tau_max=40.0))
    q, qd, t = (np.asarray(run.table[name]) for name in ("q", "qd", "t"))
    tau = np.asarray(run.table["tau_sent"])
    assert np.nanmax(tau[:, 0]) == pytest.approx(5.0)
    assert q[-1, 0] - q[0, 0] > 0.02
    assert np.abs(qd[t > 1.3]).max() < 0.02
    assert run.reason == "the time is up"


def test_torque_limits_of_a_robot(robot: Robot) -> None:
    """A robot without torque limits gets none; ur5e has 150 N m and 28 N m."""
    assert Limits.of(robot).tau_max is None
    limits = Limits.of(robots.load("ur5e"))
    assert limits.tau_max is not None
    assert limits.tau_rate is not None
    np.testing.assert_allclose(limits.tau_rate, [1500.0] * 3 + [280.0] * 3)
    with pytest.raises(ConfigError, match="together"):
        Limits(*np.stack([-np.ones(6), *[np.ones(6)] * 5]), tau_max=np.ones(6))
    with pytest.raises(ConfigError, match="tau_max above 0"):
        Limits.of(robot, tau_max=-1.0)


@pytest.fixture
def pushed(feed: Any, robot: Robot, limits: Limits) -> Bench:
    return Bench(feed, robot, limits, capabilities=ABLE)


def test_a_torque_beside_a_position(pushed: Bench, robot: Robot) -> None:
    """It rises from zero whenever the robot becomes ready, and goes when the position is refused."""
    for _ in range(2):
        pushed.reply(None)
        for k in range(3):
            assert pushed.reply(Command(pushed.home, tau=np.full(7, 10.0))).tau == pytest.approx(0.4 * (k + 1))
        refused = pushed.reply(Command(pushed.home + 1.0, tau=np.full(7, 10.0)))
        assert refused.tau == pytest.approx(0.8)
        pushed.see(motors=2)
