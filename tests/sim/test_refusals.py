"""Invalid inputs of the simulator, each with its error and words that the message must contain."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from armlab import identify, robots
from armlab.errors import ConfigError, LinkError, RobotError, ShapeError, UnknownName
from armlab.sim.arm.arm import LaggingArm, Sensors, SimulatedArm, record
from armlab.sim.arm.mismatch import Mismatch
from armlab.sim.arm.truth import synthetic_truth
from armlab.sim.controller.channel import UdpClient
from armlab.sim.controller.controller import PacketBuilder, SimulatedController
from armlab.sim.controller.cycles import Timing
from armlab.sim.controller.guidance import ExternalAxes
from armlab.sim.controller.settings import ControllerSettings, FaultRates
from armlab.sim.events import MOTORS, RAPID, AppliedWrench, Grip, HandPath, StateScript
from armlab.sim.experiments.cell import cell
from armlab.sim.two_link import TwoLink, forward, inverse, inverse_dynamics, mass_matrix, rhs
from armlab.wire.egm.robot_side import RobotSideCodec

ROBOT = robots.load("yumi_left")
TRUTH = synthetic_truth(ROBOT)
SWAY = identify.dither(ROBOT.q_home, 2.0)
INF, NAN = np.inf, np.nan


def arm(**knobs: float) -> SimulatedArm:
    return SimulatedArm(ROBOT, TRUTH, mismatch=Mismatch(**knobs))  # type: ignore[arg-type]


def client(host: str = "127.0.0.1", phase: float = 0.0) -> UdpClient:
    controller = SimulatedController(LaggingArm(ROBOT), RobotSideCodec(ROBOT), ControllerSettings())
    return UdpClient(controller, host, 6510, phase=phase)


def wrenches(t: list[float], shape: tuple[int, int]) -> AppliedWrench:
    return AppliedWrench(np.array(t), np.zeros(shape))


def path(t: list[float], q: Any) -> HandPath:
    return HandPath(np.array(t), np.array(q))


REFUSED: list[tuple[type[Exception], str, Callable[[], object]]] = [
    (ShapeError, "6 joints", lambda: SimulatedArm(robots.load("irb2400"), TRUTH)),
    (ShapeError, "posture", lambda: SimulatedArm(ROBOT, TRUTH, q=np.full(7, NAN))),
    (ConfigError, "jitter", lambda: record(arm(jitter=0.003), SWAY)),
    (ShapeError, "7 joints", lambda: record(arm(), identify.dither(np.zeros(6), 2.0))),
    (ShapeError, "wrench", lambda: record(arm(), SWAY, lambda t: np.zeros((3, 6)))),
    (RobotError, "no masses", lambda: synthetic_truth(robots.load("dh_test"))),
    (ConfigError, "-1", lambda: TRUTH.with_payload(-1.0, np.zeros(3))),
    (ConfigError, "mass", lambda: Mismatch(mass=-0.1)),
    (ConfigError, "lost", lambda: Mismatch(lost=1.0)),
    (ConfigError, "torque_delay", lambda: Mismatch(torque_delay=1.5)),  # type: ignore[arg-type]
    (ConfigError, "payload", lambda: Mismatch(payload=NAN)),
    (UnknownName, "utilizationRate", lambda: PacketBuilder(RobotSideCodec(ROBOT), 0.004, fields=["utilisation"])),
    (ConfigError, "external", lambda: ExternalAxes(-1, ControllerSettings())),
    (ConfigError, "external", lambda: ExternalAxes(7, ControllerSettings())),
    (ConfigError, "gain", lambda: ControllerSettings(gain=21.0)),
    (ConfigError, "gain", lambda: ControllerSettings(gain=NAN)),
    (ConfigError, "filter", lambda: ControllerSettings(filter=0.0)),
    (ConfigError, "level", lambda: ControllerSettings(level=3)),
    (ConfigError, "period", lambda: ControllerSettings(period=5e-5)),
    (ConfigError, "stream", lambda: ControllerSettings(stream=INF)),
    *(
        (UnknownName, f"{name} of the simulated controller", lambda name=name: ControllerSettings(**{name: "sideways"}))  # type: ignore[arg-type]
        for name in ("program", "stream_queue", "queue", "mode", "activated")
    ),
    (ConfigError, "loss", lambda: FaultRates(loss=1.1)),
    (ConfigError, "state to measure, got none", lambda: Sensors(TRUTH, Mismatch(), 0.004, 0).measure()),
    (ConfigError, "period", lambda: SimulatedArm(ROBOT, TRUTH, period=0.0)),
    (ConfigError, "pause", lambda: FaultRates(pause=(1.0, INF))),
    (ConfigError, "until", lambda: FaultRates(until=NAN)),
    (ConfigError, "burst", lambda: FaultRates(burst=0)),
    (ConfigError, "delay", lambda: FaultRates(delay=(-1.0, 0.0))),
    (LinkError, "no-such-host", lambda: client("no-such-host.invalid")),
    (ConfigError, "phase", lambda: client(phase=-0.001)),
    (ConfigError, "phase", lambda: client(phase=0.004032)),
    (ConfigError, "phase", lambda: client(phase=NAN)),
    (ConfigError, "seconds", lambda: Timing(seconds=-1.0)),
    (ConfigError, "seconds", lambda: Timing(seconds=NAN)),
    (ConfigError, "patience", lambda: Timing(patience=NAN)),
    (ConfigError, "gone", lambda: Timing(gone=-1.0)),
    (ShapeError, "one wrench per time", lambda: wrenches([0.0, 1.0], (3, 6))),
    (ShapeError, "one wrench per time", lambda: wrenches([0.0, 1.0], (2, 5))),
    (ShapeError, "row 2", lambda: wrenches([0.0, NAN], (2, 6))),
    (ShapeError, "row 3", lambda: wrenches([0.0, 1.0, 1.0], (3, 6))),
    *(
        (ConfigError, "grip", lambda times=times: Grip(*times))
        for times in ((1.0, 1.0), (2.0, 1.0), (NAN, 1.0), (0, INF))
    ),
    (ShapeError, "at least two rows", lambda: path([0.0], [[1.0]])),
    (ShapeError, "increasing times", lambda: path([0.0, 0.0], [[1.0], [2.0]])),
    (ShapeError, "finite", lambda: path([0.0, 1.0], [[1.0], [NAN]])),
    (ShapeError, "postures", lambda: path([0.0, 1.0], [1.0, 2.0])),
    *(
        (ConfigError, "with increasing times", lambda text=text: StateScript(text, MOTORS))
        for text in ("0:on,0:off", "x:on", "nan:on", "2:on,1:off")
    ),
    (UnknownName, "running", lambda: StateScript("0:runing", RAPID)),
    (ConfigError, "'lpoe' or 'dh', got 'urdf'", lambda: cell(1).kinematics(truth="urdf")),
    (ConfigError, "one to three plates, got 4", lambda: cell(1).laser(plates=4)),
    (ShapeError, "shape", lambda: forward([1.0, 2.0, 3.0])),
    (ShapeError, "q", lambda: mass_matrix("12")),
    (ShapeError, "positions and velocities", lambda: rhs([1.0, 2.0], [0.0, 0.0])),
    (ShapeError, "qd", lambda: inverse_dynamics([0.0, 0.0], [0.0], [0.0, 0.0])),
    (UnknownName, "down", lambda: inverse([0.5, 0.5], "left")),  # pyright: ignore[reportArgumentType]
    (ConfigError, "m2", lambda: TwoLink(m2=0.0)),
    (ConfigError, "coulomb", lambda: TwoLink(coulomb=-1.0)),
    (ConfigError, "gravity", lambda: TwoLink(gravity=NAN)),
]


@pytest.mark.parametrize(("error", "words", "misuse"), REFUSED, ids=[f"{i}-{row[1]}" for i, row in enumerate(REFUSED)])
def test_a_refusal_is_a_sentence_with_words(error: type[Exception], words: str, misuse: Callable[[], object]) -> None:
    with pytest.raises(error, match=words) as caught:
        misuse()
    assert str(caught.value).startswith("Expected ")
    assert str(caught.value)[-1] in ".?"
