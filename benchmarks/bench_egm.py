"""EGM: one cycle of the codec, and round trips of complete clients with the simulated controller."""

from __future__ import annotations

from typing import Any

import numpy as np
from ABBRobotEGM._egm_protobuf import egm_pb2
from ABBRobotEGM.egm import EGM
from blocks import Contender, Table, agree, loop, table
from egm_round_trips import round_trips

from armlab import robots
from armlab.robots import Robot
from armlab.wire.egm import EgmCodec, Reference
from armlab.wire.egm.robot_side import RobotMessage, RobotSideCodec

ROBOT = "yumi_right"
PACKETS = 500
BAR = 0.15  # relative to the peer's time


def run(quick: bool) -> list[Table]:
    """Measure decoding and encoding of `wire.egm.EgmCodec` and ABBRobotEGM, then the clients, including
    abb_robot_client.
    """
    robot = robots.load(ROBOT)
    standard, extended = _packets(robot, extension=False), _packets(robot, extension=True)
    plain, research = EgmCodec(robot), EgmCodec(robot, extension=True)
    peer = _Peer()
    worst = max(_check(plain, peer, data) for data in standard[:50])

    def cycle(codec: EgmCodec, data: bytes) -> bytes:
        packet: Any = codec.decode(data)
        return codec.encode(Reference(packet.q, None, None, packet.seqno, packet.tm_ms or 0))

    def cycle_with_speed(data: bytes) -> bytes:
        packet: Any = research.decode(data)
        reference = Reference(packet.q, packet.qd, packet.tau, packet.seqno, packet.tm_ms or 0, packet.seqno)
        return research.encode(reference)

    def protobuf_alone(data: bytes) -> bytes:
        egm_pb2.EgmRobot.FromString(data)
        return reply.SerializeToString()

    reply = egm_pb2.EgmSensor.FromString(cycle(plain, standard[0]))
    contenders = [
        Contender("armlab decode and encode", loop(lambda data: cycle(plain, data), standard), "armlab"),
        Contender(
            "armlab, research extension both ways",
            loop(cycle_with_speed, extended),
            "armlab",
            note=f"{len(extended[0])} bytes; with velocities and torques",
        ),
        Contender("armlab decode", loop(plain.decode, standard), "armlab"),
        Contender("ABBRobotEGM decode and encode", loop(peer.cycle, standard), bar=BAR, note="degrees, ABB's order"),
        Contender("ABBRobotEGM decode", loop(peer.decode, standard)),
        Contender(
            "protobuf alone", loop(protobuf_alone, standard), "limit", note="parse, and serialise a stored reply"
        ),
    ]
    text = (
        f"A packet of {ROBOT} as sent by RobotWare 7 ({len(standard[0])} bytes) is converted to SI values, and a joint "
        f"reference is converted back. Joints agree to {worst:.1g} rad. ABBRobotEGM is measured without its socket "
        "calls. abb_robot_client is not compared here: it decodes only inside its socket calls, and its messages "
        "cannot be loaded together with those of ABBRobotEGM."
    )
    return [table("EGM codec, one cycle", text, "µs", contenders, 20 if quick else 100), *round_trips(quick)]


class _Peer:
    """ABBRobotEGM's own steps between receiving and sending."""

    def __init__(self) -> None:
        self._egm = EGM.__new__(EGM)  # its constructor opens a socket
        self._egm.send_sequence_number = 0

    def decode(self, data: bytes) -> Any:
        message = egm_pb2.EgmRobot()
        message.ParseFromString(data)
        return self._egm._parse_robot_message(message)

    def cycle(self, data: bytes) -> bytes:
        state = self.decode(data)
        message = self._egm._create_sensor_message(state.joint_angles, None, state.external_axes, None, None, None)
        return message.SerializeToString()


def _check(codec: EgmCodec, peer: _Peer, data: bytes) -> float:
    packet: Any = codec.decode(data)
    state = peer.decode(data)
    order = np.argsort(np.array(robots.load(ROBOT).abb_axes))
    theirs = np.radians(np.concatenate((state.joint_angles, state.external_axes)))
    ours = packet.q[order]
    sent = egm_pb2.EgmSensor.FromString(peer.cycle(data)).planned
    replied = np.radians([*sent.joints.joints, *sent.externalJoints.joints])
    return max(agree("joints", theirs, ours), agree("reply", replied, ours))


def _packets(robot: Robot, extension: bool) -> list[bytes]:
    """Return packets with every field that RobotWare 7 fills, and varying joints."""
    codec = RobotSideCodec(robot, "7", extension, force=True)
    rng = np.random.default_rng(5)
    rows = rng.uniform(robot.q_min, robot.q_max, (PACKETS, robot.n))
    torques = rng.standard_normal((PACKETS, robot.n))
    return [
        codec.encode_robot(
            RobotMessage(
                seqno=1000 + k,
                tm_ms=4 * k,
                q=q,
                q_planned=q + 1e-3,
                robot_ns=1_700_000_000_000_000_000 + 4_000_000 * k,
                T_frame_tool=robot.chain.forward(q),
                utilization=12.5,
                wrench_raw=torques[k, :6],
                rapid_data=(1.0, 2.0),
                rapid_digital=True,
                tau_reference=torques[k],
                qd=0.1 * q,
                tau=torques[k],
                tau_total=torques[k],
                tau_gravity=torques[k],
                mono_ns=10**12 + 4_000_000 * k,
                used_seq=k,
            )
        )
        for k, q in enumerate(rows)
    ]
