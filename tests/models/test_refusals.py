"""Refusals of the package: an input, its error, and words that the sentence must have."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from armlab import models, robots
from armlab.errors import ConfigError, FrameError, ModelMismatchError, RobotError, ShapeError, UnknownName
from armlab.models import Accelerometer, ForceSensor, HandEye, LaserSensor, Payload, velocity_covariance
from armlab.models.files import kind_of, register
from armlab.models.friction import Friction, FrictionBound, FrictionMap, RadialBasis, RippleLines, WarmUp, speed_basis
from armlab.models.kinematic_correction import KinematicCorrection
from armlab.models.torque import SPEED_EDGES, CoupledMotors, Quality, Training
from armlab.models.uncertainty import MomentumNoise

ONE, TWO = np.ones(1), np.ones(2)
NAN = np.array([np.nan])
POSE, BINS = np.eye(4), 2 * len(SPEED_EDGES)
SPEEDS, WIDTHS = (np.tile(part, (2, 1)) for part in speed_basis(-1.0, 1.0))
ROBOT = robots.load("irb2400")

FRICTION = Friction(*[TWO] * 8)
BOUND = FrictionBound(TWO, TWO, TWO)
BASIS = RadialBasis(np.tile([0.0, 1.0], (2, 1)), np.ones((2, 2)), np.tile([0.1, 1.0], (2, 1)), np.ones((2, 2)))
LINES = RippleLines([1, 1], [100.0, 200.0], SPEEDS, WIDTHS, np.ones((2, 1, 8, 2)))
WARM = WarmUp(*[TWO] * 5)
MOTORS = CoupledMotors(np.ones((1, 3)), *[ONE] * 4)
QUALITY = Quality(*[TWO] * 4, 60.0)
TRAINING = Training(-TWO, TWO, TWO, np.ones((2, BINS)) / BINS, 0.1, 0.5)
NOISE = MomentumNoise(TWO, TWO)
FORCE = ForceSensor(np.eye(3), 1.0, np.zeros(3), np.zeros(6))
ACCELEROMETER = Accelerometer(np.eye(3), np.zeros(3))
LASER = LaserSensor(POSE, np.eye(3)[:2], np.ones(2), ("a", "b"))
HAND_EYE = HandEye("eye_to_hand", POSE, POSE)
PAYLOAD = Payload("arm", "hash", np.zeros(10), POSE)
CORRECTION = KinematicCorrection(ROBOT, ROBOT.name, ROBOT.hash, (1,), np.zeros((6, 2)), np.zeros(1), np.zeros((55, 55)))
COVARIANCE = {"kind": "exp", "C0": [2.0], "Cinf": [1.0], "shape": [1.0]}

FIELDS: list[tuple[Any, dict[str, Any], str]] = [
    (FRICTION, {"viscous": [np.nan, 1.0]}, "finite viscous"),
    (FRICTION, {"delta": np.zeros(2)}, "delta > 0"),
    (FRICTION, {"smooth_speed": -TWO}, "smooth_speed >= 0"),
    (FRICTION, {"offset": ONE}, "like the other fields"),
    *((BOUND, {name: wrong * TWO}, "friction bound") for name, wrong in (("torque", -1), ("speed", 0), ("floor", -1))),
    (BASIS, {"speeds": BASIS.speeds - 0.1}, "speeds above 0"),
    (BASIS, {"position_widths": np.zeros((2, 2))}, "positive widths"),
    (BASIS, {"speeds": BASIS.speeds[:1]}, "shape"),
    (FrictionMap(BASIS, np.zeros((2, 2, 2, 2))), {"coefficients": np.zeros((2, 2, 2, 4))}, "coefficients"),
    (LINES, {"joint": [1, 0]}, "ascending order of joints"),
    (LINES, {"widths": 0 * WIDTHS}, "ascending speeds"),
    (LINES, {"cycles": [1.0, np.nan]}, "finite cycles"),
    (LINES, {"coefficients": np.ones((2, 3, 8, 2))}, "coefficients"),
    (WARM, {"power": 0 * TWO}, "power > 0"),
    (WARM, {"time": np.nan * TWO}, "finite time"),
    (WARM, {"start": ONE}, "one number per joint"),
    (MOTORS, {"inertia": TWO}, "finite inertia of shape .* for 1 coupled motors"),
    (MOTORS, {"smooth_speed": 0 * ONE}, "smooth_speed > 0"),
    (QUALITY, {"coverage": ONE}, r"coverage with one number per joint, got shape \(1,\)"),
    (
        TRAINING,
        {"speed_share": np.ones((2, 4))},
        r"speed_share of shape \(2, 12\) for the training, got shape \(2, 4\)",
    ),
    (TRAINING, {"q_max": np.array([1.0, np.nan])}, "finite q_max"),
    (TRAINING, {"rest_share": 1.5}, "rest share from 0 to 1"),
    (TRAINING, {"longest_rest": np.nan}, "duration of at least 0 s"),
    (NOISE, {"memory": np.zeros(2)}, "memory > 0"),
    (NOISE, {"qd_noise": -TWO}, "memory > 0"),
    (NOISE, {"memory": ONE}, "memory > 0"),
    (NOISE, {"alpha2_kf": 0.0}, "memory > 0"),
    (FORCE, {"R_tool_sensor": np.diag([1.0, 1.0, -1.0])}, "a rotation"),
    (FORCE, {"R_tool_sensor": np.eye(4)}, r"finite R_tool_sensor of shape \(3, 3\)"),
    (FORCE, {"mass": -0.1}, "mass of at least 0 kg"),
    (FORCE, {"mass": np.nan}, "mass of at least 0 kg"),
    (FORCE, {"centre": np.array([np.nan, 0.0, 0.0])}, "finite centre"),
    (FORCE, {"bias": np.full(6, np.nan)}, "finite bias"),
    (FORCE, {"gravity": np.array([0.0, 0.0, np.inf])}, "finite gravity"),
    (FORCE, {"position": np.zeros(2)}, "finite position"),
    (FORCE, {"sign": 0}, r"sign of a force sensor to be \+1 or -1"),
    (ACCELEROMETER, {"R_tool_sensor": np.diag([1.0, 1.0, -1.0])}, "a rotation"),
    (ACCELEROMETER, {"bias": np.full(3, np.nan)}, "finite bias"),
    (ACCELEROMETER, {"gravity": np.zeros(2)}, "finite gravity"),
    (ACCELEROMETER, {"scale": 0.0}, "scale above zero"),
    (LASER, {"T_tool_sensor": 2.0 * POSE}, "T_tool_sensor"),
    (LASER, {"normals": 2.0 * np.eye(3)[:2]}, "unit normals"),
    (LASER, {"offsets": ONE}, "offsets of shape"),
    (HAND_EYE, {"Y": POSE[:3]}, "pose Y"),
    (HAND_EYE, {"X": 2.0 * POSE}, "rotation"),
    (HAND_EYE, {"points": np.full((2, 3), np.nan)}, r"points \(K, 3\)"),
    (PAYLOAD, {"pi": np.zeros(4)}, r"pi of shape \(10,\)"),
    (PAYLOAD, {"pi": np.full(10, np.nan)}, "finite"),
    (CORRECTION, {"amplitudes": np.zeros((6, 3))}, r"amplitudes of shape \(6, 2\)"),
]


@pytest.mark.parametrize(("value", "change", "words"), FIELDS)
def test_fields_that_are_wrong(value: Any, change: dict[str, Any], words: str) -> None:
    with pytest.raises(ShapeError, match=words):
        replace(value, **change)


CALLS: list[tuple[type[Exception], str, Callable[[], Any]]] = [
    (ShapeError, "2 Gaussians", lambda: speed_basis(1.0, 1.0)),
    (UnknownName, "const, exp, step", lambda: velocity_covariance("linear", [1.0], [1.0])),
    (ShapeError, "C0 >= Cinf > 0", lambda: velocity_covariance("exp", [1.0], [2.0], [1.0])),
    *((ShapeError, "finite", partial(velocity_covariance, **{**COVARIANCE, **wrong}))
      for wrong in ({"alpha2": np.nan}, {"alpha2": 0.0}, {"alpha2": np.inf}, {"shape": NAN}, {"C0": [np.inf]})),
    (ShapeError, "Expected", partial(velocity_covariance, **{**COVARIANCE, "shape": [-1.0]})),
    (ShapeError, r"readings \(\.\.\., 6\)", lambda: FORCE.contact(np.zeros(3), POSE)),
    (ShapeError, "T_base_tool", lambda: FORCE.wrench(np.zeros(6), np.eye(3))),
    (ShapeError, "T_base_tool", lambda: FORCE.unloaded(np.zeros(6))),
    (UnknownName, "sensor", lambda: FORCE.contact(np.zeros(6), POSE, frame="sensor")),  # type: ignore[arg-type]
    (ShapeError, "readings", lambda: ACCELEROMETER.acceleration(np.zeros(2), POSE)),
    (ShapeError, "points", lambda: LASER.points(np.zeros(3), POSE)),
    (UnknownName, "eye_in_hand, eye_to_hand", lambda: HandEye("eye", POSE, POSE)),
    (FrameError, "T_tool_marker or T_base_cam, got T_tool_cam", lambda: HAND_EYE.T_tool_cam),
    (ModelMismatchError, "got 'irb120'", lambda: CORRECTION.check_robot(robots.load("irb120"))),
    (RobotError, "Load the robot first", lambda: CORRECTION.check_robot("irb2400")),  # type: ignore[arg-type]
    (RobotError, "Load the robot first", lambda: replace(CORRECTION, robot="irb2400")),  # type: ignore[arg-type]
    (ShapeError, r"q of shape \(..., 6\)", lambda: CORRECTION.joints(np.zeros((4, 5)))),
    (ShapeError, "was fitted with L = 1", lambda: CORRECTION.joints(np.zeros((4, 6)))),
    (ConfigError, "file format, got float", lambda: kind_of(1.0)),
    (ConfigError, "got complex", lambda: models.save(1j, "none.toml")),
    (ConfigError, "a unique kind", lambda: register("payload", Friction)),
    (ConfigError, "a dataclass", lambda: register("test_float", float)),
]  # fmt: skip


@pytest.mark.parametrize(("error", "words", "call"), CALLS)
def test_calls_that_are_wrong(error: type[Exception], words: str, call: Callable[[], Any]) -> None:
    with pytest.raises(error, match=words):
        call()


def test_parts_of_another_robot(model) -> None:
    CORRECTION.check_robot(ROBOT)
    seven, wrist = replace(PAYLOAD, robot_hash="other"), CoupledMotors(np.eye(7)[:1], *[ONE] * 4)
    kernel, zero, rows = replace(model, coupled=wrist).estimator_kernel(np.ones(6)), np.zeros(7), np.zeros((5, 7))
    for error, words, call in (
        (ModelMismatchError, "arm", lambda: seven.added_to(model)),
        (ModelMismatchError, "yumi_right", lambda: model.check_robot(robots.load("yumi_right"))),
        (ShapeError, "gains above 0", lambda: replace(model, gains=-np.ones(7))),
        (ShapeError, r"gains of shape \(7,\)", lambda: replace(model, gains=np.ones(3))),
        (ShapeError, "line speeds", lambda: replace(model, lines=LINES)),
        (ShapeError, "map positions", lambda: replace(model, friction_map=FrictionMap(BASIS, np.zeros((2, 2, 2, 2))))),
        (ShapeError, "tau", lambda: kernel.step(zero, zero, zero[:6], 0.004)),
        (ShapeError, "qd", lambda: kernel.run(rows, rows[:, :1], rows, np.full(5, 0.004))),
        (ShapeError, "coupled motors for 7 joints", lambda: replace(model, coupled=MOTORS)),
    ):
        with pytest.raises(error, match=words):
            call()


def test_arrays_are_read_only(model) -> None:
    assert np.isnan(replace(QUALITY, rms=[1.0, np.nan]).rms[1]), "a joint that could not be judged"
    for array in (
        NOISE.memory,
        TRAINING.qd_peak,
        QUALITY.rms,
        CORRECTION.cov,
        FORCE.bias,
        HAND_EYE.X,
        replace(model).gains,
    ):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 1.0
