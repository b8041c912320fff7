"""Rows as the bridge makes them, and recordings of them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path

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
    """Row i of a made-up run: every number is random, so that a column in the wrong place shows."""

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
            t=i * PERIOD_NS / 1e9,
            dt=PERIOD_NS / 1e9,
            q=q,
            qd=qd,
            tau=tau,
            seq=i + 7,
            missed=int(rng.integers(3)),
            qd_source="measured",
            tau_source="measured",
            q_planned=q_planned,
            wrench_raw=rng.normal(size=6),
            T_frame_tool=T,
            motors=1,
            rapid=2,
            mci=3,
            converged=bool(i % 2),
            utilization=float(rng.uniform(0, 100)),
            robot_ns=START_NS + i * PERIOD_NS,
            t_receive=START_NS + i * PERIOD_NS,
        )
        record = {"fext": rng.normal(size=6), "mode": i % 4, "wrench_hat": rng.normal(size=6)}
        record["wrench_hat_cov"] = rng.normal(size=(6, 6))
        stamp = START_NS + 12_345 + i * PERIOD_NS
        tick = Tick(
            number=i,
            seq_sent=i + 3,
            stamp_ns=stamp,
            receive_ns=stamp - 200,
            send_ns=stamp + 90_000,
            step_ns=int(rng.integers(1000, 90_000)),
            late=bool(rng.integers(2)),
            drops=i // 10,
            q_sent=q_sent,
            qd_sent=qd_sent,
            clamped=rng.integers(0, 16, n).astype(np.uint8),
        )
        return state, Command(q_ref, qd_ref, record=record), tick


@pytest.fixture
def read_spoilt() -> Callable[[Path, Path, int], None]:
    """Cut a file at places all over it, and put wrong bytes into it: a table or one sentence comes of it."""

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
