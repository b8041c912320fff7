"""Directions of one arm that measurements may not see, each with its name."""

from __future__ import annotations

import numpy as np

from armlab.calibrate._arm import Arm, ArmState
from armlab.calibrate._kinematic_problem import KinematicProblem, State
from armlab.calibrate._kinematic_rank import Suspect
from armlab.lie import se3, so3

LITTLE = 0.35  # rad or m: a joint that moves less is named where something is missing
STILL = 1e-3
TURNED, SHIFTED = 0.5, 0.3  # rad, and share of the reach, by which no link is away from its description


def far_links(arm: Arm, frames: np.ndarray, whose: str = "") -> list[str]:
    """Return what a report says of the link that is farthest from its description, if it is far."""
    twists = arm.corrections(frames)[1:-1]
    if not len(twists):
        return []
    shift, turn = np.linalg.norm(twists[:, :3], axis=1), np.linalg.norm(twists[:, 3:], axis=1)
    reach = float(np.linalg.norm(arm.start[1:, :3, 3], axis=1).sum()) or 1.0
    share = np.maximum(turn / TURNED, shift / (SHIFTED * reach))
    j = int(np.argmax(share))
    if share[j] < 1.0:
        return []
    return [
        f"link {j + 1}{whose} is {shift[j]:.2g} m and {turn[j]:.2g} rad from its description: a reversed joint, an "
        "offset of a joint, left-handed measurements, another arm?"
    ]


def joints_at_rest(arm: Arm, frames: np.ndarray, at: int, size: int, whose: str = "") -> list[Suspect]:
    """Return for each joint that moves little what goes through it from one frame to the next."""
    found = []
    reach = np.ptp(arm.q, axis=0)
    for j in np.flatnonzero(reach < LITTLE):
        Z, middle = np.eye(4), float(np.mean(arm.q[:, j]))
        if arm.robot.prismatic[j]:
            Z[2, 3] = middle
        else:
            Z[:3, :3] = so3.exp([0.0, 0.0, middle])
        D = np.zeros((size, 6))
        D[at + 6 * j : at + 6 * j + 6] = np.eye(6)
        D[at + 6 * j + 6 : at + 6 * j + 12] = -se3.adjoint_inv(Z @ frames[j + 1])
        unit = "mm" if arm.robot.prismatic[j] else "deg"
        moved = reach[j] * 1000.0 if arm.robot.prismatic[j] else np.degrees(reach[j])
        name = f"joint {j + 1}{whose} " + ("did not move" if reach[j] < STILL else f"moved by only {moved:.2g} {unit}")
        found.append(Suspect(name, D, f"Move joint {j + 1}{whose} over its range."))
    return found


def arm_scale(arm: Arm, frames: np.ndarray) -> np.ndarray:
    """Return the direction (d,) in which all lengths of the arm grow."""
    direction = np.zeros(arm.size)
    direction[: 6 * len(frames)].reshape(-1, 6)[:, :3] = np.einsum("jba,jb->ja", frames[:, :3, :3], frames[:, :3, 3])
    return direction


def never_seen(problem: KinematicProblem, state: State) -> list[Suspect]:
    """Return what a kind of measurement may never see: where the base stands, how the tool is turned, all positions."""
    arm, size = problem.arm, problem.size
    frames, b = state.arm.frames, arm.size + 3 * problem.points
    shifts = np.zeros((size, 6))
    shifts[:6] = se3.adjoint_inv(frames[0])
    shifts[b : b + 3] = np.hstack([np.eye(3), -so3.hat(state.anchor)])  # the anchor goes with the base
    found = [
        Suspect(f"measurement frame, {verb} {letter}", shifts[:, [k]])
        for k, (verb, letter) in enumerate((verb, letter) for verb in ("shift along", "turn about") for letter in "xyz")
    ]
    if not problem.points:
        turns = np.zeros((size, 3))
        turns[6 * arm.n + 3 : 6 * arm.n + 6] = np.eye(3)
        found += [Suspect(f"tool orientation about {'xyz'[k]}", turns[:, [k]]) for k in range(3)]
    places = arm.names
    if all(kind.name == "pose" and kind.kept.min() >= 3 for kind in problem.kinds):
        for j in range(arm.n + 1):
            for k in range(3):
                column = np.zeros((size, 1))
                column[6 * j + k] = 1.0
                found.append(Suspect(f"{places[6 * j + k]} (only orientation is measured)", column))
    return found


def may_be_missing(problem: KinematicProblem, state: State) -> list[Suspect]:
    """Return what the data may fail to see."""
    arm, size = problem.arm, problem.size
    a, b = arm.size, arm.size + 3 * problem.points
    found = joints_at_rest(arm, state.arm.frames, 0, size)
    if not problem.points and not arm.robot.prismatic[-1]:
        found.append(_on_last_axis(arm, state.arm, size))
    scale = np.zeros((size, 1))
    scale[:a, 0] = arm_scale(arm, state.arm.frames)
    scale[a:b, 0] = state.points.ravel()
    if problem.points and problem.tool_held:
        scale[6 * arm.n : 6 * arm.n + 6] = 0.0
        scale[a:b, 0] += np.tile(state.arm.frames[-1, :3, :3].T @ state.arm.frames[-1, :3, 3], problem.points)
    scale[b : b + 3, 0] = state.anchor
    scale[-1] = -state.length[1]
    advice = "Measure one length that is known, or give the scale of the instrument."
    return [*found, Suspect("overall scale", scale, advice)]


def _on_last_axis(arm: Arm, state: ArmState, size: int) -> Suspect:
    """Return tilts of the last axis about the tool point."""
    D = np.zeros((size, 2))
    D[6 * arm.n - 6 : 6 * arm.n - 3] = so3.hat([0.0, 0.0, state.frames[-1, 2, 3]])[:, :2]
    D[6 * arm.n - 3 : 6 * arm.n] = np.eye(3)[:, :2]
    name = f"tool point lies on the axis of joint {arm.n}"
    return Suspect(name, D, f"Mount the target away from the axis of joint {arm.n}.")
