"""Arguments of figures: a robot, numbers, or one sentence."""

from __future__ import annotations

from reprlib import repr as shortened
from typing import Any

import numpy as np

from armlab.errors import RobotError, ShapeError
from armlab.robots import Robot


def arm(value: Any) -> Robot:
    """Return the robot, refusing what is none, such as the name of one."""
    if not isinstance(value, Robot):
        raise RobotError.no_robot(value)
    return value


def numbers(value: Any, what: str) -> np.ndarray:
    """Return real numbers as float64, refusing text, objects and rows of different length."""
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different length
        array = np.array(None)
    if array.dtype.kind not in "biuf":
        raise ShapeError(f"Expected {what} to be real numbers, got {shortened(value)}.")
    return array.astype(np.float64, copy=False)


def length(value: Any, what: str) -> float:
    """Return a length [m], refusing what is no number from 0 on."""
    number = numbers(value, what)
    if number.ndim or not 0.0 <= number < np.inf:
        raise ShapeError(f"Expected {what} to be one length from 0 on [m], got {shortened(value)}. 0 is the default.")
    return float(number)
