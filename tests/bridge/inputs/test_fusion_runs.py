"""Sources in a run: beside an arm, from a log again, required ones that fall silent, datagrams."""

from __future__ import annotations

import socket
import struct
import threading
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from armlab import bridge, kinematics
from armlab.bridge import CallableSource, Fusion, Held, Reading, ReplaySource, Source, UdpSource
from armlab.errors import ConfigError, UnknownName
from armlab.log import Column
from armlab.models import ForceSensor
from armlab.robots import Robot
from armlab.state import Command, State

MS = 1_000_000
P = {"p": Column(unit="m")}


def columns(table: Any, name: str) -> dict[str, np.ndarray]:
    return {one: table[one] for one in table.names if one.startswith(f"{name}.")}


def test_in_a_run_and_replayed(play: Any) -> None:
    """Values reach the controller and the log; a replay of the log through the same fusion gives the same rows."""
    seen: list[Mapping[str, Held]] = []

    def controller(state: State) -> Command:
        seen.append(state.sources)
        return Command(state.q_start)

    class Wrench(Source):
        """Every third tick a new wrench."""

        def newest(self) -> Reading:
            k = (self.now_ns - begun) // (3 * MS)
            stamp = begun + 3 * MS * k
            return Reading(self.values({"wrench": np.full(6, 1.0 * k)}), stamp - begun + 1, stamp, k)

    begun = time.monotonic_ns()
    source = Wrench("force", {"wrench": Column((6,))}, 0.003)
    wrenches: list[np.ndarray] = []

    class Feed:
        def row(self, state: State, command: Command | None, tick: Any) -> None:
            wrenches.append(state.wrench)

        def event(self, text: str, warn: bool = False) -> None:
            pass

    run = play(lambda peer: peer.rest(), controller, seconds=0.3, sources=[source], feeds=[Feed()])
    table = run.table
    assert all(held["force"].age < 0.02 for held in seen)
    np.testing.assert_array_equal(table["force.wrench"][:, 0], [wrench[0] for wrench in wrenches])
    np.testing.assert_array_equal(table["force.wrench"], np.repeat(table["force.seq"][:, None], 6, axis=1))
    assert table.units["force.age"] == "s"
    replay = ReplaySource("force", table, 0.003)
    fusion = Fusion([replay])
    start = 10**12
    for row, receive_ns in enumerate(table["receive_ns"] - table["receive_ns"][0]):
        now = start + int(receive_ns)
        again = fusion.record(fusion.tick(now), now)
        for name, column in columns(table, "force").items():
            np.testing.assert_allclose(again[name], column[row], rtol=1e-12, atol=2e-9, err_msg=name)
    with pytest.raises(UnknownName, match="source in this recording"):
        ReplaySource("tracker", table, 0.03)


def test_the_simulated_arm_turns_a_known_mass(robot: Robot) -> None:
    """0.8 kg on a raw sensor: State.wrench is the push alone, wherever the wrist is; NaN when the sensor is silent."""
    m, c, push = 0.8, np.array([0.01, -0.02, 0.06]), np.array([2.0, -1.0, 3.0, 0.1, 0.2, -0.3])
    bias, p = np.array([5.0, -4.0, 3.0, 0.3, 0.2, 0.1]), np.array([0.0, 0.0, -0.04])
    R_tool_sensor = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    sensor = ForceSensor(R_tool_sensor, m, c, bias, position=p, robot_name=robot.name, robot_hash=robot.hash)
    states: list[State] = []

    class Raw(Source):
        """Reads at the posture of the packet before: what it says is exact once the arm stands."""

        def newest(self) -> Reading | None:
            if not states or len(states) > 500:
                return self.last
            R = (kinematics.forward(robot, states[-1].q)[:3, :3] @ R_tool_sensor).T
            felt = m * R @ [0.0, 0.0, -9.80665]
            moment = push[3:] - np.cross(R.T @ R_tool_sensor.T @ p, push[:3])  # at the sensor, not at the tool
            raw = np.r_[R @ push[:3] + felt, R @ moment + np.cross(c, felt)] + bias
            self.last = Reading(self.values({"wrench_raw": raw}), 0, self.now_ns, len(states))
            return self.last

        last: Reading | None = None

    def controller(state: State) -> Command:
        states.append(state)
        turn = np.zeros(7)
        turn[[4, 5]] = 0.5 * (1 - np.cos(2.0 * min(state.t, np.pi / 2)))
        return Command(state.q_start + turn)

    source = Raw("force", {"wrench_raw": Column((6,))}, 0.004, calibration=sensor)
    assert source.robot == robot.name
    with bridge.connect(f"sim://{robot.name}?lockstep=true", robot) as link:
        run = link.run(controller, seconds=2.4, sources=[source])
    q, wrench = np.array([s.q for s in states]), np.array([s.wrench for s in states])
    assert np.isnan(wrench[0]).all()
    moving = slice(5, 300)
    assert np.ptp(q, axis=0)[4] > 0.7
    assert np.abs(wrench[moving] - push).max() < 0.1  # 0.8 kg turned for one packet
    assert np.abs(wrench[450:500] - push).max() < 1e-3  # at rest again, elsewhere, but for the noise of the joints
    table = run.table
    rows = np.isfinite(table["wrench"]).all(axis=1)
    expected = sensor.wrench(table["force.wrench_raw"], kinematics.forward(robot, table["q"]))
    np.testing.assert_allclose(table["wrench"][rows], expected[rows], atol=1e-12)
    assert table.units["force.wrench_raw"] == "N, N m"
    assert np.isnan(wrench[-1]).all()


def test_a_required_source_that_is_stale_holds_the_arm(play: Any) -> None:
    alive = [True]

    class Sensor(Source):
        kept: Reading | None = None

        def newest(self) -> Reading | None:
            if alive[0]:
                self.kept = Reading(self.values({"p": 1.0}), 0, self.now_ns, self.now_ns)
            return self.kept

    calls: list[float] = []

    def controller(state: State) -> Command:
        calls.append(state.t)
        return Command(qd=np.full(7, 0.1))

    def script(peer: Any) -> None:
        peer.cycles(20)
        assert peer.replies[-1].qd.min() > 0.05
        alive[0] = False
        time.sleep(0.03)
        held = peer.cycles(30)
        called = len(calls)
        assert not held[-1].qd.any()
        alive[0] = True
        peer.cycles(20)
        assert len(calls) > called
        peer.rest()

    run = play(script, controller, sources=[Sensor("sensor", P, 0.004, role="required")], seconds=0.3)
    assert any("The source sensor is stale" in text for _, text in run.events)


def test_sources_are_started_and_closed(play: Any, robot: Robot) -> None:
    done: list[str] = []

    class Sensor(Source):
        def start(self) -> None:
            done.append(f"start {self.name}")
            if self.name == "bad":
                raise ConfigError("Expected a sensor, got none.")

        def close(self) -> None:
            done.append(f"close {self.name}")

        def newest(self) -> None:
            return None

    good, bad = Sensor("good", P, 0.01), Sensor("bad", P, 0.01)
    with bridge.connect("egm://127.0.0.1:0", robot) as link, pytest.raises(ConfigError, match="a sensor"):
        link.run(None, sources=[good, bad])
    assert done == ["start good", "start bad", "close bad", "close good"]


@pytest.mark.slow
def test_ages_of_datagrams(play: Any) -> None:
    """1 s in real time: the sender's own clock is ours, so the age that the loop tells can be compared."""
    sensor = UdpSource("force", P, 0.001, 0, {"seq": "<u4", "stamp_ns": "<i8", "p": "<f8"})
    hand = CallableSource("hand", P, lambda: {"p": 1e-9 * time.monotonic_ns()}, 0.004)
    over = threading.Event()

    def send() -> None:
        seq = 0
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            while not over.wait(0.001):
                if sensor.port:
                    data = struct.pack("<Iqd", seq, time.monotonic_ns(), 0.0)
                    out.sendto(data, ("127.0.0.1", sensor.port))
                    seq += 1

    def script(peer: Any) -> None:
        peer.begin()
        peer.rest(pause=0.004)

    thread = threading.Thread(target=send)
    thread.start()
    run = play(
        script, lambda state: Command(state.q_start), play.link(clock="wall"), sources=[sensor, hand], seconds=1.0
    )
    over.set()
    thread.join()
    table = run.table
    assert np.median(table["force.age"]) < 0.004
    assert np.percentile(np.abs(table["force.delay"]), 90) < 0.2e-3
    assert np.nanmax(table["force.gaps"]) == 0.0
