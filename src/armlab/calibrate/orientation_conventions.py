"""Orientations in another convention: quaternions with another order of components, transposed matrices.

Both records with the wrong order of quaternions keep the rotations of ``A X = Y B`` true: ``q_A = q_Y q_B q_X^-1`` is a
rotation of four numbers, and whatever order these have it stays one. Only positions show it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from armlab.lie import quaternion

SUSPECT = 0.02  # residual, of the spread or rad, from which other readings are tried
MUCH_BETTER = 0.3  # share of the residual that the right reading leaves at most
FITS = 0.1  # of the spread, that it leaves at most
ROBOT, MARKER = "T_base_tool", "T_cam_marker"


class Reading(NamedTuple):
    """What orientations may have been, in words, and the poses (N, 3, 3), (N, 3) that they then are."""

    text: str
    R: np.ndarray
    t: np.ndarray


def readings(R: np.ndarray, t: np.ndarray) -> list[Reading]:
    """Return the other readings of poses; what is wrong is said of "{}"."""
    q = quaternion.from_matrix(R)
    return [
        Reading(
            "The quaternions of {} are x, y, z, w taken as w, x, y, z.", quaternion.to_matrix(np.roll(q, 1, -1)), t
        ),
        Reading(
            "The quaternions of {} are w, x, y, z taken as x, y, z, w.", quaternion.to_matrix(np.roll(q, -1, -1)), t
        ),
        Reading("The rotations of {} are transposed: those of the inverse.", R.transpose(0, 2, 1), t),
    ]


def readings_of_robot(R: np.ndarray, t: np.ndarray) -> Iterator[Reading]:
    """Yield readings of the poses of the robot, and of their inverses, which they are where the eye is in the hand."""
    yield from readings(R, t)
    back = R.transpose(0, 2, 1)
    for one in readings(back, -(back @ t[:, :, None])[:, :, 0]):
        again = np.ascontiguousarray(one.R.transpose(0, 2, 1))
        yield Reading(one.text, again, -(again @ one.t[:, :, None])[:, :, 0])
