"""Rows as the bridge makes them, and recordings of them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import armlab
from armlab import robots
from armlab.errors import LogError
from armlab.log import Column, Recorder, Tick
from armlab.robots import Robot
from armlab.state import Command, State

START_NS = 1_700_000_000_000_000_000
PERIOD_NS = 4_032_000
EXTRA = {"fext": Column(shape=(6,), unit="N", frame="base"), "mode": Column(unit="1", kind="count")}


@pytest.fixture(scope="session")
def robot() -> Robot:
    return robots.load("yumi_right")


@pytest.fixture
def extra() -> dict[str, Column]:
    """The controller's own columns in `rows`."""
    return dict(EXTRA)


class Rows:
    """Row i of a synthetic run: every number is random, so that a misplaced column shows."""

    def __init__(self, robot: Robot, seed: int = 1) -> None:
        self.robot, self.seed = robot, seed

    def __call__(self, i: int) -> tuple[State, Command, Tick]:
        rng = np.random.default_rng([self.seed, i])
        n = self.robot.n
        q, qd, tau, q_ref, qd_ref, q_sent, qd_sent, q_planned = rng.normal(size=(8, n))
        R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        T = np.eye(4)
        T[:3, :3] = R * np.sign(np.linalg.det(R))
        T[:3, 3] = rng.normal(size=3)
        state = State(
            t=i * PERIOD_NS / 1e9, dt=PERIOD_NS / 1e9, q=q, qd=qd, tau=tau, seq=i + 7, missed=int(rng.integers(3)),
            qd_source="measured", tau_source="measured", q_planned=q_planned, wrench_raw=rng.normal(size=6),
            T_frame_tool=T, motors=1, rapid=2, mci=3, converged=bool(i % 2), utilization=float(rng.uniform(0, 100)),
            robot_ns=START_NS + i * PERIOD_NS, t_receive=START_NS + i * PERIOD_NS,
        )  # fmt: skip
        record = {"fext": rng.normal(size=6), "mode": i % 4, "wrench_hat": rng.normal(size=6)}
        record["wrench_hat_cov"] = rng.normal(size=(6, 6))
        stamp = START_NS + 12_345 + i * PERIOD_NS
        tick = Tick(
            i, i + 3, stamp, stamp - 200, stamp + 90_000, int(rng.integers(1000, 90_000)), wake_ns=1000 + i,
            late=bool(rng.integers(2)), drops=i // 10, q_sent=q_sent, qd_sent=qd_sent,
            clamped=rng.integers(0, 16, n).astype(np.uint8),
        )  # fmt: skip
        return state, Command(q_ref, qd_ref, record=record), tick


@pytest.fixture
def read_spoilt() -> Callable[[Path, Path, int], None]:
    """Truncate a file at random places and corrupt its bytes: reading gives a table or one error message."""

    def read(log: Path, file: Path, count: int) -> None:
        data, rng = file.read_bytes(), np.random.default_rng(1)
        cut = [data[:n] for n in rng.integers(8, len(data), count)]
        places = rng.integers(8, len(data), count)
        wrong = [data[:n] + bytes([data[n] ^ rng.integers(1, 256)]) + data[n + 1 :] for n in places]
        for one in cut + wrong:
            file.write_bytes(one)
            with contextlib.suppress(LogError):
                armlab.log.read(log)
        file.write_bytes(data)

    return read


@pytest.fixture
def rows(robot: Robot) -> Rows:
    return Rows(robot)


@pytest.fixture
def recording(tmp_path: Path, robot: Robot, rows: Rows) -> Callable[..., Path]:
    """Record some rows and return the file."""

    def record(count: int = 600, name: str = "run.mcap", **options: object) -> Path:
        options = {"extra": EXTRA, "attachments": {"robot.toml": b"name = 'x'"}, "note": "test", **options}
        with Recorder(tmp_path / name, robot, **options) as recorder:  # type: ignore[arg-type]
            for i in range(count):
                assert recorder.row(*rows(i))
        assert recorder.failed is None
        return recorder.path

    return record


class Ros:
    """Messages from other programs, and bags of them."""

    start = START_NS

    def __init__(self) -> None:
        from rosbags.typesys import Stores, get_typestore

        self.store = get_typestore(Stores.ROS2_HUMBLE)
        self.types = self.store.types

    def header(self, ns: int, frame: str = "") -> object:
        time = self.types["builtin_interfaces/msg/Time"](sec=ns // 10**9, nanosec=ns % 10**9)
        return self.types["std_msgs/msg/Header"](stamp=time, frame_id=frame)

    def vector(self, kind: str, *numbers: float) -> object:
        return self.types[f"geometry_msgs/msg/{kind}"](**dict(zip("xyzw", map(float, numbers), strict=False)))

    def joints(self, ns: int, names: Sequence[str], values: Sequence[float], efforts: bool = True) -> object:
        numbers = np.array(values, dtype=float)
        none = np.zeros(0)
        parts = {"position": numbers, "velocity": -numbers, "effort": 2 * numbers if efforts else none}
        return self.types["sensor_msgs/msg/JointState"](header=self.header(ns), name=list(names), **parts)

    def wrench(self, ns: int, frame: str, values: Sequence[float]) -> object:
        parts = {"force": self.vector("Vector3", *values[:3]), "torque": self.vector("Vector3", *values[3:])}
        wrench = self.types["geometry_msgs/msg/Wrench"](**parts)
        return self.types["geometry_msgs/msg/WrenchStamped"](header=self.header(ns, frame), wrench=wrench)

    def pose(self, ns: int, frame: str, p: Sequence[float], xyzw: Sequence[float] = (0, 0, 0, 1)) -> object:
        parts = {"position": self.vector("Point", *p), "orientation": self.vector("Quaternion", *xyzw)}
        pose = self.types["geometry_msgs/msg/Pose"](**parts)
        return self.types["geometry_msgs/msg/PoseStamped"](header=self.header(ns, frame), pose=pose)

    def transforms(self, ns: int, *pairs: tuple[str, str, Sequence[float]]) -> object:
        transforms = []
        for parent, child, p in pairs:
            parts = {"translation": self.vector("Vector3", *p), "rotation": self.vector("Quaternion", 0, 0, 0, 1)}
            one = self.types["geometry_msgs/msg/Transform"](**parts)
            kind = self.types["geometry_msgs/msg/TransformStamped"]
            transforms.append(kind(header=self.header(ns, parent), child_frame_id=child, transform=one))
        return self.types["tf2_msgs/msg/TFMessage"](transforms=transforms)

    def numbers(self, values: Sequence[float]) -> object:
        layout = self.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
        return self.types["std_msgs/msg/Float64MultiArray"](layout=layout, data=np.array(values, dtype=float))

    def raw(self, message: Any) -> bytes:
        return bytes(self.store.serialize_cdr(message, message.__msgtype__))

    def bag(self, path: Path, messages: Sequence[tuple[str, int, Any]], storage: str = "mcap") -> Path:
        """Write (topic, recording time [ns], message) with rosbags."""
        from rosbags.rosbag2 import StoragePlugin, Writer

        plugin = StoragePlugin.MCAP if storage == "mcap" else StoragePlugin.SQLITE3
        with Writer(path, version=8, storage_plugin=plugin) as bag:
            kinds = {topic: message.__msgtype__ for topic, _, message in messages}
            connections = {one: bag.add_connection(one, kind, typestore=self.store) for one, kind in kinds.items()}
            for topic, ns, message in messages:
                bag.write(connections[topic], ns, self.raw(message))
        return path


@pytest.fixture(scope="session")
def ros() -> Ros:
    return Ros()
