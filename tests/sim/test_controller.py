"""The controller's cycle, sessions, time-outs, events, programs and modes, without sockets."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armlab import robots
from armlab.sim.arm.arm import LaggingArm, SimulatedArm
from armlab.sim.arm.truth import synthetic_truth
from armlab.sim.controller.controller import EPOCH_NS, QUEUE_LENGTH, SimulatedController
from armlab.sim.controller.settings import ControllerSettings
from armlab.sim.events import MOTORS, RAPID, AppliedWrench, HandPath, StateScript, Surroundings
from armlab.wire.egm import EgmCodec, Packet, Reference
from armlab.wire.egm import armlab_egm_pb2 as pb
from armlab.wire.egm.robot_side import RobotSideCodec

ROBOT = robots.load("yumi_right")
TRUTH = synthetic_truth(ROBOT)
STOPPED, RUNNING, ERROR = 2, 3, 1


class Task:
    """A controller and a peer that answers, with a fixed reference (`cycle`) or with what `reply` returns (`run`)."""

    def __init__(self, scene: Surroundings | AppliedWrench | None = None, masses: bool = False, **changes: Any) -> None:
        chosen = ControllerSettings(**changes)
        self.events: list[str] = []
        arm = SimulatedArm(ROBOT, TRUTH, period=chosen.period) if masses else LaggingArm(ROBOT, chosen.period)
        external = scene.external if isinstance(scene, Surroundings) else 0
        codec = RobotSideCodec(ROBOT, extension=masses, external=external)
        self.controller = SimulatedController(arm, codec, chosen, scene, lambda event: self.events.append(str(event)))
        self.codec, self.packets, self._seq = EgmCodec(ROBOT, extension=masses), list[Packet](), 0

    def cycle(self, q: np.ndarray | None = None, qd: np.ndarray | None = None, replies: int = 1) -> Any:
        """One cycle: the packet, what the controller does with older messages, then the replies to the packet."""
        data = self.controller.packet()
        self.controller.advance()
        if data is None:
            return None
        packet = self.codec.decode(data)
        assert isinstance(packet, Packet)
        self.packets.append(packet)
        for _ in range(replies if q is not None else 0):
            assert self.controller.accept(self.reply(packet, q, qd)) is not None
        return packet

    def run(self, cycles: int, reply: Any = None) -> Packet:
        for _ in range(cycles):
            packet = self.cycle()
            if packet is not None and reply is not None:
                assert self.controller.accept(reply(packet)) is not None
        return self.packets[-1]

    def reply(self, packet: Packet, q: np.ndarray, qd: np.ndarray | None = None) -> bytes:
        self._seq += 1
        return self.codec.encode(
            Reference(q, qd, None, self._seq, packet.tm_ms or 0, packet.seqno, packet.robot_mono_ns)
        )

    def position(self, q: np.ndarray) -> Any:
        return lambda packet: self.reply(packet, q)


def test_packet_content() -> None:
    peer = Task(masses=True)
    first, second = peer.cycle(ROBOT.q_home), peer.cycle(ROBOT.q_home)
    assert (first.seqno, second.seqno) == (0, 1)
    assert first.tm_ms == 10000
    assert second.tm_ms == 10004
    assert first.robot_ns == EPOCH_NS
    assert second.robot_ns == EPOCH_NS + 4_032_000
    assert (first.motors, first.mci, first.rapid) == (1, RUNNING, 2)
    assert first.robotware == "6.10"
    assert np.isnan(first.wrench_raw).all()
    np.testing.assert_allclose(first.q, ROBOT.q_home, atol=1e-5)
    np.testing.assert_allclose(first.q_planned, ROBOT.q_home, atol=1e-12)
    np.testing.assert_allclose(first.T_frame_tool, ROBOT.chain.forward(first.q), atol=1e-9)
    assert first.tau_source == "measured"
    assert (np.abs(first.qd) < 6e-3).all()
    assert (np.abs(first.tau - peer.controller.arm.sample.tau) < 6 * TRUTH.tau_noise).all()


def test_the_answer_to_a_packet_acts_in_the_next_cycle() -> None:
    peer = Task(masses=True, ramp_in=0.005)
    peer.cycle(ROBOT.q_home + 0.1)
    still = peer.cycle(ROBOT.q_home + 0.1)
    moving = peer.cycle(ROBOT.q_home + 0.1)
    np.testing.assert_allclose(still.q_planned, ROBOT.q_home, atol=1e-12)
    assert (moving.q_planned > ROBOT.q_home + 1e-6).all()
    assert dict(peer.controller.statistics.age) == {1: 2}


def test_a_surplus_reply_adds_a_cycle_for_ever() -> None:
    peer = Task(masses=True)
    for k in range(20):
        packet = peer.cycle(ROBOT.q_home, replies=2 if k == 5 else 1)
    assert packet.queue_depth == 1
    assert {p.queue_depth for p in peer.packets[:7]} == {0}, (
        "what is left after the last take, not what waits for the next"
    )
    assert set(peer.controller.statistics.age) == {1, 2}
    assert peer.controller.statistics.age[2] >= 12


@pytest.mark.parametrize(("queue", "age", "told"), [("fifo", 45, 1), ("newest", 1, 0)])
def test_a_stall_of_the_client_costs_lag_only_first_in_first_out(queue: str, age: int, told: int) -> None:
    peer = Task(masses=True, queue=queue)
    peer.cycle(ROBOT.q_home, replies=45)
    for _ in range(260):
        peer.cycle(ROBOT.q_home)
    assert peer.controller.statistics.last_age == age
    events = [text for text in peer.events if "177 ms late" in text]
    assert len(events) == told
    assert all("Skip this number of replies once" in text for text in events)


def test_the_queue_is_bounded() -> None:
    peer = Task(masses=True)
    peer.cycle(ROBOT.q_home, replies=QUEUE_LENGTH + 5)
    assert peer.controller.statistics.drops["queue full"] == 5


def test_the_last_reference_stays_speed_included() -> None:
    peer = Task(masses=True, ramp_in=0.005, position_gain=0.0)
    for _ in range(60):
        peer.cycle(ROBOT.q_home, np.full(7, 0.1))
    for _ in range(100):
        peer.cycle()
    speeds = np.diff([p.q_planned for p in peer.packets[-50:]], axis=0) / 0.004032
    np.testing.assert_allclose(speeds, 0.1, rtol=1e-6)
    assert peer.controller.statistics.counts["starved"] == 99


def test_comm_timeout_ends_the_session_and_the_next_begins() -> None:
    peer = Task(masses=True, comm_timeout=0.2, ramp_in=0.005)
    for _ in range(60):
        peer.cycle(ROBOT.q_home + 0.3, np.full(7, 0.5))
    sent = len(peer.packets)
    while peer.cycle() is not None:
        pass
    assert (len(peer.packets) - sent) * 0.004032 == pytest.approx(0.2, abs=0.013)
    assert any("41822 No data from the UdpUc device" in event for event in peer.events)
    gap = 0
    while (packet := peer.cycle()) is None:
        gap += 1
    assert gap * 0.004032 == pytest.approx(0.2, abs=0.01)
    assert packet.seqno == 0
    assert peer.controller.session == 2
    assert np.abs(peer.controller.arm.sample.qd).max() < 0.02, "the arm came to a stop"
    assert packet.robot_ns > peer.packets[-2].robot_ns + 100_000_000


def test_session_time_out_is_said_once_without_a_peer() -> None:
    peer = Task(masses=True, comm_timeout=0.05)
    for _ in range(200):
        peer.cycle()
    assert peer.controller.session > 2
    assert len(peer.events) == 1


def test_convergence_ends_the_session() -> None:
    peer = Task(masses=True, window=np.radians(0.5), condition_time=0.4)
    while peer.cycle(ROBOT.q_home + 0.05) is not None:
        pass
    converged = [p.converged for p in peer.packets]
    assert not converged[2]
    assert converged[-1]
    assert sum(converged) * 0.004032 == pytest.approx(0.4, abs=0.01)
    assert any("convergence" in event for event in peer.events)


@pytest.mark.parametrize("stream", [0.0, 0.0975])
def test_guidance_time_is_zero_at_the_first_running_packet_of_each_session(stream: float) -> None:
    peer = Task(masses=True, stream=stream, comm_timeout=0.05)
    first: dict[int, float] = {}
    states: dict[int, list[int]] = {}
    for _ in range(200):
        session, t = peer.controller.session, peer.controller.guidance_time
        packet = peer.cycle()
        if packet is not None:
            states.setdefault(session, []).append(packet.mci)
        if packet is not None and packet.mci == RUNNING:
            first.setdefault(session, t)
    assert len(first) >= 2
    np.testing.assert_allclose(list(first.values()), 0.0, atol=1e-12)
    streamed = [seen.count(STOPPED) for seen in states.values()]
    assert streamed[0] == streamed[1] == np.ceil(stream / 0.004032)


def test_a_fast_reference_that_leaves_the_range_brakes_at_once() -> None:
    """No cycle of standstill between guidance and braking: speed falls by no more than the acceleration limit."""
    peer = Task(masses=True, ramp_in=0.005)
    for _ in range(30):
        peer.cycle(ROBOT.q_home, np.full(7, 1.0))
    peer.cycle(ROBOT.q_max + 0.01)
    while peer.cycle() is not None:
        pass
    speeds = np.diff([p.q_planned for p in peer.packets], axis=0) / 0.004032
    assert speeds.max() > 0.8
    assert (np.diff(speeds, axis=0) >= -ROBOT.qdd_max * 0.004032 - 1e-9).all()


def test_an_arm_driven_beyond_all_numbers_is_dead() -> None:
    """An operator enters millions of newtons by mistake: the controller stops instead of sending NaN."""
    peer = Task(AppliedWrench(np.array([0.0, 9.0]), np.full((2, 6), 1e9)), masses=True)
    with np.errstate(all="ignore"):
        for _ in range(300):
            peer.cycle(ROBOT.q_home)
    assert peer.controller.dead
    assert sum("diverged" in event for event in peer.events) == 1
    assert all(np.isfinite(p.q).all() for p in peer.packets)


def test_a_reference_out_of_bounds_stops_in_error() -> None:
    peer = Task(masses=True)
    for _ in range(20):
        peer.cycle(ROBOT.q_home)
    peer.cycle(ROBOT.q_max + 0.01)
    while peer.cycle(ROBOT.q_home) is not None:
        pass
    assert [p.mci for p in peer.packets][-20:] == [ERROR] * 20
    assert any("input out of bounds" in event and "joint 1" in event for event in peer.events)
    np.testing.assert_allclose(peer.controller.arm.sample.q, ROBOT.q_home, atol=1e-3)


@pytest.mark.parametrize("value", [np.nan, 1e300])
def test_a_reference_that_is_no_number_kills_the_controller(value: float) -> None:
    peer = Task(masses=True)
    peer.cycle(ROBOT.q_home)
    packet = peer.cycle(ROBOT.q_home)
    q = ROBOT.q_home.copy()
    q[3] = value
    peer.controller.accept(peer.reply(packet, q))
    for _ in range(400):
        peer.cycle()
    assert peer.controller.dead
    assert any(" 10014 " in event for event in peer.events)
    assert peer.controller.session == 1
    np.testing.assert_allclose(peer.controller.arm.sample.q, ROBOT.q_home, atol=1e-3)


def test_operator_acts_on_guidance_time() -> None:
    """The wrench of the packet at guidance time t is the operator's at t."""
    times = np.array([0.0, 0.1, 0.2])
    wrench = np.zeros((3, 6))
    wrench[1, 2] = -5.0
    peer = Task(AppliedWrench(times, wrench), masses=True)
    seen = []
    for _ in range(60):
        seen.append((peer.controller.guidance_time, peer.controller.arm.sample.wrench[2]))
        peer.cycle(ROBOT.q_home)
    t, f = np.array(seen).T
    np.testing.assert_allclose(f, np.interp(t, times, wrench[:, 2]), atol=1e-9)


def planned_after(garbage: list[bytes]) -> np.ndarray:
    """Run 20 cycles with garbage before each good reply; return the planned positions."""
    peer = Task(masses=True)
    for k in range(20):
        for data in garbage:
            assert peer.controller.accept(data) is None
        peer.cycle(ROBOT.q_home + 0.002 * k, np.full(7, 0.1))
    return np.array([p.q_planned for p in peer.packets])


@cache
def undisturbed() -> np.ndarray:
    return planned_after([])


@settings(max_examples=6)
@given(st.lists(st.binary(max_size=60), max_size=4))
def test_garbage_never_moves_the_robot(noise: list[bytes]) -> None:
    peer = Task(masses=True)
    packet = peer.codec.decode(peer.controller.packet() or b"")
    assert isinstance(packet, Packet)
    good = peer.reply(packet, ROBOT.q_home)
    robot_side = RobotSideCodec(ROBOT)
    garbage = [
        data
        for data in [b"", b"\0", good[:1], good[: len(good) // 2], good[:-3], bytes(65507), *noise]
        if type(robot_side.decode_sensor(data)).__name__ == "Drop" or robot_side.decode_sensor(data).q is None  # type: ignore[union-attr]
    ]
    np.testing.assert_array_equal(planned_after(garbage), undisturbed())


def sensor(packet: Packet, **content: Any) -> bytes:
    message = pb.EgmSensor(header=pb.EgmHeader(seqno=packet.seqno, tm=packet.tm_ms, mtype=3))
    for name, value in content.items():
        getattr(message, name).CopyFrom(value)
    return message.SerializeToString()


def test_stream_only_never_guides_and_never_times_out() -> None:
    task = Task(program="stream", comm_timeout=0.05)
    task.run(200, task.position(ROBOT.q_home + 0.3))
    assert {p.mci for p in task.packets} == {STOPPED}
    assert task.controller.session == 1
    assert task.controller.statistics.drops["not guiding"] == 200
    np.testing.assert_allclose(task.packets[-1].q, ROBOT.q_home, atol=1e-9)


def test_messages_of_the_stream_are_kept_for_guidance_when_asked() -> None:
    for keep, expected in (("drop", 0), ("keep", 24)):
        task = Task(stream=0.1, stream_queue=keep)
        task.run(26, task.position(ROBOT.q_home))
        assert len(task.controller.inbox) == expected + 1
    ages = Task(stream=0.1, stream_queue="keep")
    ages.run(60, ages.position(ROBOT.q_home))
    assert max(ages.controller.statistics.age) == 25, "each kept message adds a cycle of lag for ever"


def test_lead_through_follows_the_hand_and_says_stopped() -> None:
    hand = HandPath.random(ROBOT, 3, 4.0)
    task = Task(Surroundings(hand=hand), masses=True, program="lead-through")
    task.run(400)
    assert {p.mci for p in task.packets} == {STOPPED}
    led = np.array([hand.at(0.004032 * k)[0] for k in range(400)])
    np.testing.assert_allclose([p.q_planned for p in task.packets], led, atol=1e-9)
    np.testing.assert_allclose([p.q for p in task.packets], led, atol=0.01)
    assert np.ptp(led, axis=0).max() > 0.05


@pytest.mark.parametrize(
    "scene",
    [
        Surroundings(motors=StateScript("0:on,0.5:off,1:on", MOTORS)),
        Surroundings(rapid=StateScript("0:running,0.5:stopped,1:running", RAPID)),
    ],
)
def test_motors_or_rapid_that_stop_interrupt_guidance(scene: Surroundings) -> None:
    task = Task(scene, ramp_in=0.005)
    begun = task.run(100, task.position(ROBOT.q_home + 0.5))
    assert begun.mci == RUNNING
    task.run(60, task.position(ROBOT.q_home + 0.5))
    interrupted = [p for p in task.packets if p.mci == STOPPED]
    assert len(interrupted) >= 30
    assert {(p.motors, p.rapid) for p in interrupted} in ({(2, 2)}, {(1, 1)})
    assert not np.ptp([p.q_planned for p in task.packets[-10:]], axis=0).any(), "the arm stands"
    last = task.run(120, task.position(ROBOT.q_home + 0.5))
    assert (last.mci, last.seqno, task.controller.session) == (RUNNING, 279, 1), "the same session goes on"


def test_another_mode_than_activated_is_event_41826() -> None:
    task = Task(mode="joint", activated="pose", program="once")
    for _ in range(100):
        assert task.controller.packet() is None
        task.controller.advance()
    assert [" 41826 " in event for event in task.events] == [True]
    assert task.controller.phase == "over"


def test_pose_mode_moves_the_tool_to_the_pose() -> None:
    task = Task(mode="pose", ramp_in=0.005)
    goal = ROBOT.chain.forward(ROBOT.q_home + 0.05)
    from armlab.wire.egm.codec import pose_from_matrix

    motion = pb.EgmMotion()
    pose_from_matrix(motion.cartesian, goal)
    last = task.run(500, lambda p: sensor(p, planned=motion))
    np.testing.assert_allclose(last.T_frame_tool, goal, atol=1e-4)
    motion.cartesian.pos.x = 9000.0
    task.run(3, lambda p: sensor(p, planned=motion))
    assert any("no posture" in event for event in task.events)


def test_path_corrections_are_asked_for_and_taken_every_24_ms() -> None:
    """A client that answers each packet does not lag."""
    task = Task(mode="path", ramp_in=0.005)
    start = ROBOT.chain.forward(ROBOT.q_home)

    def correct(packet: Packet) -> bytes:
        header = pb.EgmHeader(seqno=packet.seqno, tm=packet.tm_ms, mtype=4)
        where = pb.EgmCartesian(x=99.0, y=10.0, z=-5.0)
        return pb.EgmSensorPathCorr(header=header, pathCorr=pb.EgmPathCorr(pos=where, age=3)).SerializeToString()

    task.run(101, correct)
    T_tool_moved = np.linalg.inv(start) @ task.packets[-1].T_frame_tool
    np.testing.assert_allclose(T_tool_moved[:3, 3], [0.0, 0.01, -0.005], atol=1e-4)
    statistics = task.controller.statistics
    np.testing.assert_allclose(np.diff([packet.robot_ns for packet in task.packets]), 24e6)
    assert statistics.mtypes == {4: 101}
    assert statistics.age == {1: 100}


def test_external_axes_follow_their_references() -> None:
    task = Task(Surroundings(external=2))
    joints = pb.EgmJoints(joints=np.degrees(ROBOT.q_home[[0, 1, 3, 4, 5, 6]]))
    beyond = pb.EgmJoints(joints=np.degrees([ROBOT.q_home[2], 0.2, -0.1]))
    last = task.run(400, lambda p: sensor(p, planned=pb.EgmMotion(joints=joints, externalJoints=beyond)))
    np.testing.assert_allclose(last.q_ext, [0.2, -0.1], atol=1e-3)


def research(packet: Packet, tau: np.ndarray, scale: float) -> bytes:
    arrays = {"torqueFF": tau, "posGainScale": np.full(7, scale), "velGainScale": np.full(7, scale)}
    reference = pb.EgmRIRef(validMask=0b11001, order=1, echoSeqno=packet.seqno, echoTNs=packet.robot_mono_ns, **arrays)
    joints = packet.q_planned[[0, 1, 3, 4, 5, 6]]
    motion = pb.EgmMotion(
        joints=pb.EgmJoints(joints=np.degrees(joints)),
        externalJoints=pb.EgmJoints(joints=np.degrees(packet.q_planned[2:3])),
    )
    return sensor(packet, planned=motion, researchRef=reference)


def test_torques_move_an_arm_whose_gains_are_zero() -> None:
    """Torque mode: exact gravity compensation holds the arm, an extra 6 N m moves joint 1, and restoring the gains
    causes no jerk."""
    task = Task(masses=True)
    task.run(5, task.position(ROBOT.q_home))
    sample = task.controller.arm.sample
    rest = sample.tau - sample.tau_gravity  # what feed-forward lacks, friction included
    push = rest + np.array([6.0, 0, 0, 0, 0, 0, 0])
    task.run(60, lambda p: research(p, push, 0.0))
    moved = task.controller.arm.sample.q - ROBOT.q_home
    assert moved[0] > 0.1
    assert np.abs(moved[1:]).max() < 1e-3
    np.testing.assert_allclose(task.packets[-1].q_planned, task.packets[-2].q, atol=0.02)
    before = task.controller.arm.sample.q
    task.run(50, task.position(task.packets[-1].q))
    assert np.abs(task.controller.arm.sample.q - before).max() < 0.1, "no snap back to where position control ended"


@pytest.mark.parametrize(("changes", "scale", "mode"), [({}, 1.0, 1), ({"position_gain": 0.0}, 1.0, 2), ({}, 0.0, 3)])
def test_the_mode_of_the_drives_is_sent(changes: dict[str, Any], scale: float, mode: int) -> None:
    task = Task(masses=True, **changes)
    task.run(3, lambda p: research(p, np.zeros(7), scale))
    assert pb.EgmRobot.FromString(task.controller.packet() or b"").researchState.mode == mode


def test_cycles_without_packets_are_not_the_peers_silence() -> None:
    task = Task(comm_timeout=0.1, ramp_in=0.005)
    before = task.run(50, task.position(ROBOT.q_home + 0.3)).q_planned
    for _ in range(100):
        task.controller.advance(takes=False)
    assert task.controller.phase == "guiding"
    assert task.controller.statistics.counts["starved"] == 0
    assert (task.run(1).q_planned > before).all(), "the last reference goes on"
