"""Python node with cyclonedds and its own codec, independent of armlab: DOMAIN COUNT FROM TO; see cyclone.c."""

import sys
import time
from dataclasses import dataclass

from cyclonedds.core import Listener, Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, sequence, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class Dimension(IdlStruct, typename="std_msgs::msg::dds_::MultiArrayDimension_"):
    label: str
    size: uint32
    stride: uint32


@dataclass
class Layout(IdlStruct, typename="std_msgs::msg::dds_::MultiArrayLayout_"):
    dim: sequence[Dimension]
    data_offset: uint32


@dataclass
class Float64MultiArray(IdlStruct, typename="std_msgs::msg::dds_::Float64MultiArray_"):
    layout: Layout
    data: sequence[float64]


@dataclass
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    header: Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]


@dataclass
class Vector3(IdlStruct, typename="geometry_msgs::msg::dds_::Vector3_"):
    x: float64
    y: float64
    z: float64


@dataclass
class Wrench(IdlStruct, typename="geometry_msgs::msg::dds_::Wrench_"):
    force: Vector3
    torque: Vector3


@dataclass
class WrenchStamped(IdlStruct, typename="geometry_msgs::msg::dds_::WrenchStamped_"):
    header: Header
    wrench: Wrench


class Node:
    def __init__(self, domain: int, first: int, last: int) -> None:
        self.joints, self.first, self.last = 0, first, last
        self.lines: list[str] = []
        self.node = DomainParticipant(domain)
        velocities = Topic(self.node, "rt/yumi_left/joint_group_velocity_controller/commands", Float64MultiArray)
        self.commands = DataWriter(self.node, velocities, Qos(Policy.Reliability.Reliable(0)))
        deep = Policy.History.KeepLast(100)
        self.readers = [
            DataReader(self.node, Topic(self.node, f"rt/yumi_left/{name}", type_), Qos(kind, deep), listener)
            for name, type_, kind, listener in (
                ("joint_states", JointState, Policy.Reliability.Reliable(0), Listener(on_data_available=self.state)),
                ("wrench", WrenchStamped, Policy.Reliability.BestEffort, Listener(on_data_available=self.wrench)),
            )
        ]

    def head(self, kind: str, header: Header) -> str:
        stamp = header.stamp.sec * 10**9 + header.stamp.nanosec
        return f"{kind} {stamp} {time.time_ns()} {header.frame_id or '-'}"

    def state(self, reader: DataReader[JointState]) -> None:
        for one in reader.take(100):
            if one.sample_info.valid_data:
                numbers = " ".join(map(repr, one.position))
                self.lines.append(f"{self.head('J', one.header)} {numbers} {one.name[2]} {len(one.effort)}")
                self.joints += 1
                if self.joints == 1:
                    print("reading", file=sys.stderr, flush=True)

    def wrench(self, reader: DataReader[WrenchStamped]) -> None:
        for one in reader.take(100):
            if one.sample_info.valid_data:
                f, m = one.wrench.force, one.wrench.torque
                numbers = " ".join(map(repr, (f.x, f.y, f.z, m.x, m.y, m.z)))
                self.lines.append(f"{self.head('W', one.header)} {numbers}")

    def run(self, count: int) -> None:
        end, told = time.monotonic() + 60.0, 0
        while self.joints < count and time.monotonic() < end:
            if told != self.joints and self.first < self.joints <= self.last:
                told = self.joints
                self.commands.write(Float64MultiArray(Layout([], 0), [0.05] * 7))
            time.sleep(0.001)


if __name__ == "__main__":
    domain, count, first, last = map(int, sys.argv[1:])
    node = Node(domain, first, last)
    node.run(count)
    sys.stdout.write("\n".join(node.lines) + "\n")
