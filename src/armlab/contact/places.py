"""Places of contact on the tool: three finite numbers in metres, no further off than the arm is long."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import numbers
from armlab.errors import ShapeError
from armlab.robots import Robot
from armlab.robots.robot import arm_length

__all__ = ["check_distance", "contact_point"]


def contact_point(point: ArrayLike, robot: Robot) -> np.ndarray:
    """Return the point (3,) as an array of its own.

    Parameters
    ----------
    point : (3,) tool axes [m]. robot : the arm.

    Raises
    ------
    ShapeError : not three finite numbers, or further from the tool than the arm is long.
    """
    place = np.array(numbers(point, "the contact point", ShapeError))
    if place.shape != (3,) or not np.all(np.isfinite(place)):
        raise ShapeError(f"Expected the contact point as three finite numbers [m], tool axes, got {point!r}.")
    check_distance(place[None], robot)
    return place


def check_distance(places: np.ndarray, robot: Robot) -> None:
    """Refuse places further from the tool than the arm is long: millimetres, as a rule.

    Parameters
    ----------
    places : (M, 3) tool axes [m]. robot : the arm.

    Raises
    ------
    ShapeError : names the distance.
    """
    far, length = float(np.linalg.norm(places, axis=1).max(initial=0.0)), arm_length(robot)
    if far > length:
        raise ShapeError(
            f"Expected a place of contact within {length:.3g} m of the tool, the length of {robot.name!r}, got one "
            f"{far:.4g} m away. Give metres, in tool axes; divide millimetres by 1000."
        )
