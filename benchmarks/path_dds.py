"""Joint states and wrenches with cyclonedds alone: `path_dds.py read DOMAIN COUNT` or `path_dds.py write DOMAIN`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests" / "bridge" / "servers" / "ros" / "peers"))

import cyclone
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.topic import Topic
from path_ends import JOINTS, ROBOT, Lines, numbers, paced

NAMES = [f"yumi_robl_joint_{k}" for k in range(1, JOINTS + 1)]
RELIABLE = Qos(Policy.Reliability.Reliable(0), Policy.History.KeepLast(10))


class Node(cyclone.Node):
    """Node that reads two topics."""

    def __init__(self, domain: int, count: int) -> None:
        self.found = Lines(count)
        super().__init__(domain, 0, 0)

    def state(self, reader: Any) -> None:
        self._take("J", reader)

    def wrench(self, reader: Any) -> None:
        self._take("W", reader)

    def _take(self, kind: str, reader: Any) -> None:
        for one in reader.take(100):
            if one.sample_info.valid_data:
                stamp = one.header.stamp
                self.found.add(kind, stamp.sec * 10**9 + stamp.nanosec)


def main() -> None:
    role, domain, *count = sys.argv[1:]
    if role == "write":
        write(int(domain))
    else:
        Node(int(domain), int(count[0])).found.wait()


def write(domain: int) -> None:
    """Send a new message of each kind in every period."""
    node = DomainParticipant(domain)
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
