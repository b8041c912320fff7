"""No reference leaves that is faster, or accelerates more, than allowed in the time the robot measured.

For the references q_k sent after one another, Δt_k the robot time between them, v_k = (q_k - q_(k-1)) / Δt_k:
``|v_k| <= qd_max`` and ``|v_k - v_(k-1)| <= qdd_max Δt_k``, whatever the cycle times, the losses and the commands are;
the speed sent beside q_k is v_k.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab import robots
from armlab.bridge.control.limits import Limits
from armlab.bridge.control.session import Session
from armlab.bridge.control.state_machine import StateMachine
from armlab.bridge.net.sockets import Arrival
from armlab.state import Command
from armlab.wire.egm import EgmCodec

from ..conftest import Packets

ROBOT = robots.load("yumi_right")
LIMITS = Limits.of(ROBOT)
MIDDLE = (ROBOT.q_min + ROBOT.q_max) / 2
EXACT = 1e-9
MS = 1_000_000
CYCLES = (2, 3, 4, 5, 8, 12, 24, 48)  # ms


class Robot:
    """A robot whose cycle changes at any packet, on a network that loses and bunches; its arm follows."""

    def __init__(self) -> None:
        self.packets, self.events = Packets(ROBOT), list[str]()
        self.packets.q = self.target = MIDDLE
        self.session = Session(EgmCodec(ROBOT), on_event=self.tell)
        self.machine = StateMachine(ROBOT, LIMITS, on_event=self.tell)
        self.now_ns, self.arrival_ns = 10**12, 0
        self.sent: tuple[int, np.ndarray, np.ndarray] | None = None  # robot ns, position, velocity
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
        assert sample is not None
        told = len(self.events)
        self.machine.observe(sample)
        if "The robot is ready and holds." in self.events[told:]:  # a reference begins where the arm is
            self.sent = self.now_ns - round(1e9 * sample.step), self.packets.q, np.zeros(7)
        asked = command(self.machine.state(sample, 0)) if self.machine.calls else None
        reply = self.machine.answer(asked, self.session.period.seconds)
        assert reply is not None, "one reply a packet"
        if not goes_out:
            self.machine.take_back()
            return
        self.replies += 1
        if not self.machine.ready and np.abs(reply.q - self.packets.q).max() <= EXACT and not reply.qd.any():
            self.sent = self.now_ns, reply.q, np.zeros(7)
        else:  # guided, or of a robot that no longer says whether it follows
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
        if not agrees:  # a speed of the controller's own: within one step of acceleration, of the longest so far
            self.apart = max(dt, self.apart)
        difference = np.abs(reply.qd - v_now)
        assert (difference <= self.apart * LIMITS.qdd_max + EXACT / dt).all(), "the speed agrees with the positions"
        if agrees and (difference <= EXACT / dt).all():
            self.apart = 0.0
        self.sent = self.now_ns, reply.q, v_now


def commands(kind: str, rng: np.random.Generator) -> Any:
    """Return what a controller does: a function of the state."""
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
    st.booleans(),  # another cycle time at each packet
    st.integers(1, 40),
    st.sampled_from(["hold", "speed", "speed", "near", "towards", "both", "jump"]),
    st.sampled_from(["good", "good", "loss", "burst", "unsent"]),
    st.sampled_from(STATES),
)


@given(st.lists(PIECES, min_size=1, max_size=12), st.integers(0, 2**32))
@settings(max_examples=150, deadline=None)
def test_no_reference_is_faster_than_the_measured_time_allows(pieces: list[Any], seed: int) -> None:
    rng, robot = np.random.default_rng(seed), Robot()
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
    """A stream that is not ready, then guidance with another cycle time: an event, and the speed that was allowed."""
    robot, rng = Robot(), np.random.default_rng(1)
    options: Any = {"lost": False, "late_ms": 0, "goes_out": True}
    for _ in range(50):
        robot.cycle(before, commands("hold", rng), mci=2, **options)
    for _ in range(200):
        robot.cycle(then, lambda state: Command(qd=np.eye(7)[0] * ROBOT.qd_max), **options)
    changes = [text for text in robot.events if "cycle time" in text]
    assert changes == [f"The cycle time of the robot changed from {before:.2f} to {then:.2f} ms."]
    assert robot.session.period.seconds == pytest.approx(1e-3 * then)
    assert robot.fastest[0] == pytest.approx(ROBOT.qd_max[0], rel=1e-9)
