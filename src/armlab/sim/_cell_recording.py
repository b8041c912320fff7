"""A hand-eye experiment while the arm moves: joints at 250 Hz on one clock, a camera on another that jitters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from armlab.kinematics import forward
from armlab.lie import se3
from armlab.robots import Robot, load
from armlab.sim._cell_hand_eye import CAMERA, noisy, rotations

if TYPE_CHECKING:
    from armlab.log import Table

RATE = 250.0  # Hz
REACH = 0.7  # rad, either way
SLOW, FAST = 0.05, 0.12  # Hz
AHEAD = 0.2  # s between the first row of the arm and the first image


@dataclass(frozen=True, eq=False)
class MovingSights:
    """Two recordings of one motion, and the truth behind them.

    `arm` has the joint positions q; `camera` the poses T_cam_marker at the times at which it looked; `T_tool_marker`
    and `T_base_cam` are true.
    """

    robot: Robot
    arm: Table
    camera: Table
    T_tool_marker: np.ndarray
    T_base_cam: np.ndarray


def moving_sights(seed: Any, looked: np.ndarray) -> MovingSights:
    """Return both recordings of a smooth motion of an IRB 2400.

    Parameters
    ----------
    seed : of the generator. looked : (N,) times of the images [s].
    """
    from armlab.log import Column, Table  # here: a simulator that only sends starts without them

    rng, robot = np.random.default_rng(seed), load("irb2400")
    frequency, phase = rng.uniform(SLOW, FAST, robot.n), rng.uniform(-np.pi, np.pi, robot.n)
    looked = looked + AHEAD

    def joints(t: np.ndarray) -> np.ndarray:
        return REACH * np.sin(2.0 * np.pi * frequency * t[:, None] + phase)

    X = se3.from_rp(rotations(rng, 1)[0], 0.1 * rng.standard_normal(3))
    Y = se3.from_rp(rotations(rng, 1)[0], rng.standard_normal(3))
    seen = noisy(rng, se3.inv(Y) @ forward(robot, joints(looked)) @ X, CAMERA)
    t = np.arange(0.0, looked[-1] + AHEAD, 1.0 / RATE)
    arm = Table(t, {"q": joints(t)})
    camera = Table(looked, {"T_cam_marker": seen}, {"T_cam_marker": Column(unit="1", kind="pose")})
    return MovingSights(robot, arm, camera, X, Y)
