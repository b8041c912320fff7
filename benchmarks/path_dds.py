"""`path_dds.py DOMAIN`: joint states and wrenches by cyclonedds alone, 250 of each per second."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "bridge" / "ros" / "peers"))

import cyclone
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic
from path_ends import JOINTS, ROBOT, numbers, paced

NAMES = [f"yumi_robl_joint_{k}" for k in range(1, JOINTS + 1)]
RELIABLE = Qos(Policy.Reliability.Reliable(0), Policy.History.KeepLast(10))


def main() -> None:
    node = DomainParticipant(int(sys.argv[1]))
    joints = DataWriter(node, Topic(node, f"rt/{ROBOT}/joint_states", cyclone.JointState), RELIABLE)
    wrenches = DataWriter(node, Topic(node, f"rt/{ROBOT}/wrench", cyclone.WrenchStamped), RELIABLE)

    def send(stamp_ns: int) -> None:
        stamp = cyclone.Time(*divmod(stamp_ns, 10**9))
        joints.write(cyclone.JointState(cyclone.Header(stamp, ""), NAMES, *numbers(stamp_ns)))
        force, moment = cyclone.Vector3(0.0, 1.0, 2.0), cyclone.Vector3(3.0, 4.0, 5.0)
        wrenches.write(cyclone.WrenchStamped(cyclone.Header(stamp, "tool"), cyclone.Wrench(force, moment)))

    paced(send)


if __name__ == "__main__":
    main()
