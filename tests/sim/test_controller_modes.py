"""Programs, scripted states, modes, external axes and the drive law of the controller, without sockets."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.sim.arm.arm import LaggingArm, SimulatedArm
from armlab.sim.arm.truth import synthetic_truth
from armlab.sim.controller.controller import SimulatedController
from armlab.sim.controller.settings import ControllerSettings
from armlab.sim.controller.statistics import ControllerEvent
from armlab.sim.events import MOTORS, RAPID, HandPath, StateScript, Surroundings
from armlab.wire.egm import EgmCodec, Packet, Reference, RobotSideCodec
from armlab.wire.egm import armlab_egm_pb2 as pb

ROBOT = robots.load("yumi_right")
TRUTH = synthetic_truth(ROBOT)
STOPPED, RUNNING = 2, 3


class Task:
    """A controller and a peer that answers with what `reply` returns."""

    def __init__(self, scene: Surroundings | None = None, masses: bool = False, **changes: Any) -> None:
        settings = ControllerSettings(**changes)
        self.events: list[ControllerEvent] = []
        arm = SimulatedArm(ROBOT, TRUTH, period=settings.period) if masses else LaggingArm(ROBOT, settings.period)
        external = scene.external if scene else 0
        codec = RobotSideCodec(ROBOT, extension=masses, external=external)
        self.controller = SimulatedController(arm, codec, settings, scene, self.events.append)
        self.codec, self.packets = EgmCodec(ROBOT, extension=masses), list[Packet]()

    def run(self, cycles: int, reply: Any = None) -> Packet:
        for _ in range(cycles):
            data = self.controller.packet()
            self.controller.advance()
            if data is None:
                continue
            packet = self.codec.decode(data)
            assert isinstance(packet, Packet)
            self.packets.append(packet)
            if reply is not None:
                assert self.controller.accept(reply(packet)) is not None
        return self.packets[-1]

    def position(self, q: np.ndarray) -> Any:
        return lambda p: self.codec.encode(Reference(q, None, None, p.seqno, p.tm_ms or 0))


def sensor(packet: Packet, **content: Any) -> bytes:
    message = pb.EgmSensor(header=pb.EgmHeader(seqno=packet.seqno, tm=packet.tm_ms, mtype=3))
    for name, value in content.items():
        getattr(message, name).CopyFrom(value)
    return message.SerializeToString()


def test_stream_only_never_guides_and_never_times_out() -> None:
    task = Task(program="stream", comm_timeout=0.05)
    task.run(500, task.position(ROBOT.q_home + 0.3))
    assert {p.mci for p in task.packets} == {STOPPED}
    assert task.controller.session == 1
    assert task.controller.statistics.drops["not guiding"] == 500
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
    hand = HandPath.random(ROBOT, 3, 10.0)
    task = Task(Surroundings(hand=hand), masses=True, program="lead-through")
    task.run(700)
    assert {p.mci for p in task.packets} == {STOPPED}
    led = np.array([hand.at(0.004032 * k)[0] for k in range(700)])
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
    assert [event.number for event in task.events] == [41826]
    assert task.controller.phase == "over"


def test_pose_mode_moves_the_tool_to_the_pose() -> None:
    task = Task(mode="pose", ramp_in=0.005)
    goal = ROBOT.chain.forward(ROBOT.q_home + 0.05)
    from armlab.wire.egm.pose_force import pose_from_matrix

    motion = pb.EgmMotion()
    pose_from_matrix(motion.cartesian, goal)
    last = task.run(500, lambda p: sensor(p, planned=motion))
    np.testing.assert_allclose(last.T_frame_tool, goal, atol=1e-4)
    motion.cartesian.pos.x = 9000.0
    task.run(3, lambda p: sensor(p, planned=motion))
    assert any("no posture" in event.text for event in task.events)


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
    """Torque mode: the exact gravity holds the arm, two newton metres more move joint 1, and giving the gains back
    does not jerk."""
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


def test_cycles_without_packets_are_not_the_peers_silence() -> None:
    task = Task(comm_timeout=0.1, ramp_in=0.005)
    before = task.run(50, task.position(ROBOT.q_home + 0.3)).q_planned
    for _ in range(100):
        task.controller.advance(takes=False)
    assert task.controller.phase == "guiding"
    assert task.controller.statistics.counts["starved"] == 0
    assert (task.run(1).q_planned > before).all(), "the last reference goes on"
