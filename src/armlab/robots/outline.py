"""The outline of an arm, from its joint axes alone: what is drawn of it where it has no meshes."""

from __future__ import annotations

import numpy as np

from armlab.robots.robot import Robot

__all__ = ["arm_length", "bends"]

_PARALLEL = 0.03  # axes that make a smaller angle [rad] have no common normal worth drawing


def arm_length(robot: Robot) -> float:
    """Return the length of the stretched arm from mount to tool [m], the measure of what is drawn on it; 1 for none.

    Parameters
    ----------
    robot : the arm.
    """
    steps = np.linalg.norm(np.concatenate([robot.links, robot.T_flange_tool[None]])[:, :3, 3], axis=1)
    strokes = np.nan_to_num(np.maximum(-robot.q_min, robot.q_max), posinf=0.0)[robot.prismatic]
    return float(steps.sum() + strokes.sum()) or 1.0


def bends(a: np.ndarray, along_a: np.ndarray, b: np.ndarray, along_b: np.ndarray) -> list[np.ndarray]:
    """Return where a link between two joint axes bends: the ends of their common normal, or the foot of a parallel one.

    Parameters
    ----------
    a, b : (3,) points of the axes. along_a, along_b : (3,) unit vectors.
    """
    across = b - a
    cosine = along_a @ along_b
    sine2 = 1 - cosine**2
    if sine2 < _PARALLEL**2:
        return [a + (across @ along_a) * along_a]
    s = (across @ along_a - cosine * (across @ along_b)) / sine2
    t = (cosine * (across @ along_a) - across @ along_b) / sine2
    return [a + s * along_a, b + t * along_b]
