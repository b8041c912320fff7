"""`Limits` and `Limiter`: no reference exceeds the position, speed or acceleration limits."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab import bridge, robots
from armlab.bridge.control.feedback import outside_range
from armlab.bridge.control.limits import Limiter, Limits, LinkedLimiter, Reply, axes_of, limiter_of
from armlab.bridge.control.session import Session
from armlab.bridge.control.state_machine import StateMachine
from armlab.bridge.control.torque import Torques
from armlab.bridge.net.sockets import Arrival
from armlab.errors import ConfigError
from armlab.robots import Robot, from_links
from armlab.state import Command, State
from armlab.wire.egm import EgmCodec
from tests.oracles import limit_reference

from ..conftest import Packets

T = 0.004


def test_limits_of_a_robot(robot: Robot) -> None:
    limits = Limits.of(robot, margin=0.02, speed=0.5)
    np.testing.assert_allclose(limits.q_max, robot.q_max - 0.02)
    np.testing.assert_allclose(limits.qd_max, 0.5 * robot.qd_max)
    assert limits.jump.tolist() == limits.following_error.tolist() == [0.1] * 7  # type: ignore[union-attr]
    assert Limits.of(robot, following_error=0.03).following_error.tolist() == [0.03] * 7  # type: ignore[union-attr]
    own = Limits(limits.q_min, limits.q_max, limits.qd_max, limits.qdd_max, limits.jump, limits.entry)
    assert own.lag == limits.lag == 0.2
    assert Limits.of(robot, lag=0).lag == 0
    for lag in (-0.1, np.inf, np.nan, "0.1", None):
        with pytest.raises(ConfigError, match="lag of at least 0 s"):
            Limits.of(robot, lag=lag)  # type: ignore[arg-type]
    np.testing.assert_array_equal(Limits.of(robot, margin=0.0).q_max, robot.q_max)
    for options in ({"speed": 2.0}, {"speed": 0.0}, {"entry": 0.0}):
        with pytest.raises(ConfigError, match=r"speed in \(0, 1\], entry above 0"):
            Limits.of(robot, **options)
    for margin in (10.0, -0.01, np.nan):
        with pytest.raises(ConfigError, match="margin"):
            Limits.of(robot, margin=margin)


@pytest.mark.parametrize("name", ["q_min", "q_max", "qd_max", "qdd_max", "jump", "entry"])
def test_a_limit_that_would_never_act_is_refused(robot: Robot, name: str) -> None:
    limits = Limits.of(robot)
    bad = getattr(limits, name).copy()
    bad[3] = np.nan
    with pytest.raises(ConfigError, match=r"q_min below q_max|above 0"):
        replace(limits, **{name: bad})
    with pytest.raises(ConfigError, match=r"all Limits to have the same shape \(n,\), got .* \(6,\)"):
        replace(limits, **{name: bad[:6]})
    bad[3] = limits.q_max[3] if name == "q_min" else limits.q_min[3] if name == "q_max" else 0.0
    with pytest.raises(ConfigError, match=r"q_min below q_max|above 0"):
        replace(limits, **{name: bad})


def test_a_sliding_joint_may_jump_and_begin_two_centimetres_away() -> None:
    links = [np.eye(4)] * 3
    robot = from_links("table", links, [True, False], q_min=[-1.0, -1.0], q_max=[1.0, 1.0], qd_max=[1.0, 1.0])
    assert Limits.of(robot).jump.tolist() == [0.02, 0.1]
    assert Limits.of(robot).entry.tolist() == [0.02, 0.05]
    assert Limits.of(robot, entry=0.01).entry.tolist() == [0.01, 0.01]


def test_no_first_position_may_be_further_away_than_a_jump(robot: Robot) -> None:
    """Such a position would pass the entry check but be refused as a jump three times, which ends the run."""
    assert Limits.of(robot, entry=0.1).entry.tolist() == [0.1] * 7
    with pytest.raises(
        ConfigError, match=r"Limits\.entry to be at most Limits\.jump for each joint.*got \[0\.3.*\] and \[0\.1"
    ):
        Limits.of(robot, entry=0.3)
    limits = Limits.of(robot)
    far = limits.entry.copy()
    far[6] = 0.1001
    with pytest.raises(ConfigError, match=r"Limits\.entry to be at most Limits\.jump for each joint"):
        replace(limits, entry=far)


def test_the_limiter_remembers_what_it_sent(robot: Robot) -> None:
    limiter = limiter_of(Limits.of(robot), robot)
    assert type(limiter) is Limiter
    assert limiter.at_rest
    assert not limiter.hold(T).q.any(), "a new limiter is at zero"
    start = limiter.rest(robot.q_home.copy())
    for reply in (start, limiter.follow(robot.q_home.copy(), np.zeros(7))):
        assert not any(array.flags.writeable for array in (reply.q, reply.qd, reply.clamped))
        assert (reply.ratio, reply.refused, reply.tau, reply.beside) == (1.0, 0, None, None)
        assert reply.free is (reply is not start)
    assert isinstance(start, Reply)
    assert not limiter.step(robot.q_home + 1e-4, np.zeros(7), T).qd.any()
    assert not limiter.at_rest, "at rest requires constant position and zero speed"
    limiter.rest(robot.q_home)
    first, second = (limiter.step(robot.q_home + 0.05, None, T) for _ in range(2))
    np.testing.assert_array_equal(limiter.q, second.q)
    assert np.all(second.q > first.q)
    np.testing.assert_allclose(second.qd, (second.q - first.q) / T)
    while not limiter.at_rest:
        limiter.hold(T)
    assert not limiter.hold(T).qd.any()
    before = limiter.memory
    again = limiter.step(robot.q_home, None, T)
    assert not limiter.at_rest
    limiter.memory = before
    np.testing.assert_array_equal(limiter.step(robot.q_home, None, T).q, again.q)


def test_a_limiter_knows_what_was_asked_before(robot: Robot) -> None:
    limits = Limits.of(robot)
    limiter = Limiter(limits)
    rows = np.stack((limits.q_min, limits.q_max, limits.qd_max, limits.qdd_max, limits.jump))
    path = robot.q_home + 0.05 + 0.3 * T * np.arange(80)[:, None]
    for begin in (limiter.rest, lambda q: limiter.follow(q, np.zeros(7)), limiter.rest):
        begin(robot.q_home)
        sent, asked = np.stack((robot.q_home, np.zeros(7), np.zeros(7))), None
        for q in path:
            sent = limit_reference(sent, rows, T, q, asked)[0]
            asked = q
            np.testing.assert_allclose(limiter.step(q, None, T).q, sent[0], rtol=0.0, atol=1e-12)
        assert not np.allclose(sent, limit_reference(sent, rows, T, q + 0.05)[0])


def test_limits_of_axes_beyond_the_robot(robot: Robot) -> None:
    axes = Limits.of_axes([-1.0], [1.0], [0.5])
    assert (axes.qdd_max.tolist(), axes.jump.tolist(), axes.entry.tolist()) == ([5.0], [0.1], [0.05])
    assert Limits.of(robot).external is None
    assert Limits.of(robot, external=axes).external is axes
    with pytest.raises(ConfigError, match="q_min below q_max"):
        Limits.of_axes([1.0], [-1.0], [0.5])
    with pytest.raises(ConfigError, match=r"all Limits to have the same shape \(n,\), got qd_max of shape \(2,\)"):
        Limits.of_axes([-1.0], [1.0], [0.5, 0.5])


LINKED = robots.load("irb2400")


def test_the_sum_of_two_joints_is_limited() -> None:
    """Joints 2 and 3 each stay within their limits, but their sum would reach 68 degrees; the axis limit is 65."""
    limits = Limits.of(LINKED)
    limiter = limiter_of(limits, LINKED)
    q = np.radians([0.0, 40, 20, 0, 30, 0])
    np.testing.assert_allclose(limiter.rest(q).q, q)
    np.testing.assert_allclose(limiter.q, q)
    for _ in range(500):
        q = np.minimum(q + np.radians([0, 0.2, 0, 0, 0, 0]), np.radians([0, 48, 20, 0, 30, 0]))
        reply = limiter.step(q, None, T)
    axis = reply.q[1] + reply.q[2]
    assert axis == pytest.approx(np.radians(65.0) - 0.01, abs=1e-3)
    assert reply.clamped[2] & 9
    assert reply.q[1] == pytest.approx(np.radians(48.0), abs=1e-3), "axis 2 goes on"
    rest = limiter.hold(T)
    assert rest.q[1] + rest.q[2] <= limits.q_max[2]
    moving = limiter.follow(q, np.radians([0.0, 10, -10, 0, 0, 0]))
    np.testing.assert_allclose(moving.qd, np.radians([0.0, 10, -10, 0, 0, 0]), atol=1e-15)


def test_limits_of_a_coupled_robot_are_those_of_its_axes() -> None:
    """With the lower arm 60 degrees forward and the upper arm level, joint 3 is at -60 - 50 degrees, which is valid."""
    limiter = limiter_of(Limits.of(LINKED), LINKED)
    assert isinstance(limiter, LinkedLimiter)
    limiter.rest(LINKED.q_home)
    assert limiter.step(LINKED.q_home + 0.5 * np.eye(6)[3], None, T).refused == -4
    assert limiter.step(np.full(6, np.nan), None, T).refused == 1
    level = np.radians([0, 60.0, -110, 0, 30, 0])
    assert outside_range(level, LINKED) == ""
    assert "joint 3" in outside_range(np.radians([0, 60.0, 40, 0, 30, 0]), LINKED)
    torques = Torques(LINKED, Limits.of(LINKED, tau_max=1.0), frozenset(("torque",)))
    assert torques.outside(level, np.zeros(6)) == ""
    assert "joint 3" in torques.outside(np.radians([0, 48.0, 20, 0, 30, 0]), np.zeros(6))


ROBOT = robots.load("yumi_right")
LIMITS = Limits.of(ROBOT)
MIDDLE = (ROBOT.q_min + ROBOT.q_max) / 2
EXACT = 1e-9
MS = 1_000_000
CYCLES = (2, 3, 4, 5, 8, 12, 24, 48)  # ms


class RobotOnNetwork:
    """Robot whose cycle time may change at any packet, on a network that loses and bunches packets; its arm follows."""

    def __init__(self) -> None:
        self.packets, self.events = Packets(ROBOT), list[str]()
        self.packets.q = self.target = MIDDLE
        self.session = Session(EgmCodec(ROBOT), on_event=self.tell)
        self.machine = StateMachine(ROBOT, LIMITS, on_event=self.tell)
        self.now_ns, self.arrival_ns = 10**12, 0
        self.sent: tuple[int, np.ndarray, np.ndarray] | None = None  # robot time [ns], position, velocity
        self.replies, self.apart, self.fastest = 0, 0.0, np.zeros(7)

    def tell(self, text: str, warn: bool = False) -> None:
        self.events.append(text)

    def cycle(self, ms: int, command: Any, *, lost: bool, late_ms: int, goes_out: bool, **states: Any) -> None:
        """Let one cycle pass; `command` is a Command or a function of the position sent last."""
        self.now_ns += ms * MS
        reach = 1e-3 * ms * ROBOT.qd_max
        self.packets.q = self.packets.q + np.clip(self.target - self.packets.q, -reach, reach)
        data = self.packets(robot_ns=self.now_ns, tm_ms=self.now_ns // MS % 2**32, **states)
        if lost:
            return
        self.arrival_ns = max(self.now_ns + late_ms * MS, self.arrival_ns + 1000)
        sample = self.session.accept(Arrival(data, ("127.0.0.1", 5000), self.arrival_ns))
        told = len(self.events)
        self.machine.observe(sample)
        if "The robot is ready and holds its position." in self.events[told:]:  # start at the arm's position
            self.sent = self.now_ns - round(1e9 * sample.step), self.packets.q, np.zeros(7)
        asked = command(self.machine.state(sample, 0, {})) if self.machine.calls else None
        reply = self.machine.answer(asked, self.session.period.seconds)
        assert reply is not None, "one reply a packet"
        if not goes_out:
            self.machine.take_back()
            return
        self.replies += 1
        if not self.machine.ready and np.abs(reply.q - self.packets.q).max() <= EXACT and not reply.qd.any():
            self.sent = self.now_ns, reply.q, np.zeros(7)
        else:  # guided, or the robot no longer reports whether it follows
            self.judge(reply, agrees=asked is None or asked.q is None or asked.qd is None)
        self.target = reply.q

    def judge(self, reply: Any, agrees: bool) -> None:
        assert self.sent is not None
        then_ns, q, v = self.sent
        dt = 1e-9 * (self.now_ns - then_ns)
        v_now = (reply.q - q) / dt
        self.fastest = np.maximum(self.fastest, np.abs(v_now))
        assert (np.abs(reply.q - q) <= LIMITS.qd_max * dt + EXACT).all()
        assert (np.abs(v_now - v) <= LIMITS.qdd_max * dt + EXACT / dt).all()
        assert ((reply.q >= LIMITS.q_min - EXACT) & (reply.q <= LIMITS.q_max + EXACT)).all()
        if not agrees:  # separate speed command: within the acceleration of the longest cycle so far
            self.apart = max(dt, self.apart)
        difference = np.abs(reply.qd - v_now)
        assert (difference <= self.apart * LIMITS.qdd_max + EXACT / dt).all(), "the speed agrees with the positions"
        if agrees and (difference <= EXACT / dt).all():
            self.apart = 0.0
        self.sent = self.now_ns, reply.q, v_now


def commands(kind: str, rng: np.random.Generator) -> Any:
    """Return a controller of the given kind, a function of the state."""
    goal, speed = rng.uniform(ROBOT.q_min - 0.1, ROBOT.q_max + 0.1), rng.uniform(-3.0, 3.0, 7) * ROBOT.qd_max
    return {
        "hold": lambda state: None,
        "speed": lambda state: Command(qd=speed),
        "near": lambda state: Command(state.q_sent + rng.uniform(-0.09, 0.09, 7)),
        "towards": lambda state: Command(state.q_sent + np.clip(goal - state.q_sent, -0.05, 0.05)),
        "both": lambda state: Command(state.q_sent + rng.uniform(-0.01, 0.01, 7), rng.uniform(-1.0, 1.0, 7)),
        "jump": lambda state: Command(state.q_sent + rng.choice([-0.9, 0.0, 0.9], 7)),
    }[kind]


STATES = [{}] * 5 + [{"motors": 2}, {"mci": 2}, {"motors": None}, {"rapid": 1}]
PIECES = st.tuples(
    st.sampled_from(CYCLES),
    st.booleans(),  # whether the cycle time changes at each packet
    st.integers(1, 40),
    st.sampled_from(["hold", "speed", "speed", "near", "towards", "both", "jump"]),
    st.sampled_from(["good", "good", "loss", "burst", "unsent"]),
    st.sampled_from(STATES),
)


@given(st.lists(PIECES, min_size=1, max_size=12), st.integers(0, 2**32))
@settings(max_examples=40, deadline=None)
def test_no_reference_is_faster_than_the_measured_time_allows(pieces: list[Any], seed: int) -> None:
    rng, robot = np.random.default_rng(seed), RobotOnNetwork()
    for _ in range(4):
        robot.cycle(4, commands("hold", rng), lost=False, late_ms=0, goes_out=True)
    for ms, varies, count, kind, network, states in pieces:
        command = commands(kind, rng)
        for k in range(count):
            robot.cycle(
                int(rng.choice(CYCLES)) if varies else ms,
                command,
                lost=network == "loss" and rng.random() < 0.3 and k < count - 1,
                late_ms=int(rng.integers(0, 60)) if network == "burst" else 0,
                goes_out=network != "unsent" or rng.random() < 0.5,
                **states,
            )
    assert robot.replies > 0


@pytest.mark.parametrize(("before", "then"), [(24, 4), (8, 4), (4, 24), (48, 2)])
def test_a_robot_that_streams_slower_than_it_guides(before: int, then: int) -> None:
    robot, rng = RobotOnNetwork(), np.random.default_rng(1)
    options: Any = {"lost": False, "late_ms": 0, "goes_out": True}
    for _ in range(50):
        robot.cycle(before, commands("hold", rng), mci=2, **options)
    for _ in range(200):
        robot.cycle(then, lambda state: Command(qd=np.eye(7)[0] * ROBOT.qd_max), **options)
    changes = [text for text in robot.events if "cycle time" in text]
    assert changes == [f"The cycle time of the robot changed from {before:.2f} to {then:.2f} ms."]
    assert robot.session.period.seconds == pytest.approx(1e-3 * then)
    assert robot.fastest[0] == pytest.approx(ROBOT.qd_max[0], rel=1e-9)


QUICK = "irb1200"  # its simulated arm once exceeded its limits, as did irb120 and yumi_right
LIMITED = [name for name in robots.names() if np.isfinite(robots.load(name).q_max).all()]  # without dh_test
ARMS = [pytest.param(name, marks=() if name == QUICK else pytest.mark.slow) for name in LIMITED]


@pytest.mark.parametrize("name", ARMS)
def test_full_speed_into_each_limit_stops_before_it(name: str) -> None:
    robot = robots.load(name)
    limits, axes = Limits.of(robot), axes_of(robot)
    longest = float(((robot.q_max - robot.q_min) / robot.qd_max).max())
    turn = longest + 2.0  # s in each direction

    def controller(state: State) -> Command:
        return Command(qd=robot.qd_max * (1.0 if state.t < turn else -1.0))

    # the ur5e's torque limits cannot brake all joints in the 0.1 s that its description assumes
    lagging = "&lagging=true" if name == "ur5e" else ""
    with bridge.connect(f"sim://{name}?lockstep=true&seed=1{lagging}", robot) as link:
        run = link.run(controller, seconds=2.0 * turn + 1.0, limits=limits)
    assert run.statistics["sessions"] == 1
    q, sent = np.array([axes(row) for row in run.table["q"]]), run.table["q_sent"]
    sent = np.array([axes(row) for row in sent[np.isfinite(sent).all(axis=1)]])
    assert ((sent >= limits.q_min - 1e-9) & (sent <= limits.q_max + 1e-9)).all(), "no reference outside the limits"
    assert ((q >= robot.q_min) & (q <= robot.q_max)).all(), "the arm stays within its range"
    if axes(robot.q_home) is robot.q_home:  # joints of a coupled robot limit each other
        assert (sent.max(axis=0) > limits.q_max - 0.01).all()
        assert (sent.min(axis=0) < limits.q_min + 0.01).all()


@pytest.mark.slow
@pytest.mark.parametrize("lagging", [True, False])
def test_an_irb_2400_follows(lagging: bool) -> None:
    def controller(state: State) -> Command:
        sway = 0.2 * (1.0 - np.cos(2.0 * state.t))
        return Command(state.q_start + sway * np.array([0, 1, -1, 0, 0, 0]))

    with bridge.connect(f"sim://irb2400?lockstep=true&lagging={str(lagging).lower()}", LINKED) as link:
        run = link.run(controller, seconds=3.0)
    table = run.table
    moved = table["q"] - table["q"][0]
    assert moved[:, 1].max() == pytest.approx(0.4, abs=0.02)
    np.testing.assert_allclose(moved[:, 1] + moved[:, 2], 0.0, atol=1e-6 if lagging else 5e-3)
    assert not np.nan_to_num(table["clamped"][50:700]).any()
    np.testing.assert_allclose(table["q_planned"][-1], table["q_sent"][-1], atol=0.02)
