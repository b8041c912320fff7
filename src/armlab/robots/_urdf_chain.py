"""From `Tree` to `Robot`: the arm between two links, with all that is rigidly joined to it."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from armlab.errors import RobotError, UnknownName
from armlab.lie import se3
from armlab.robots import inertia
from armlab.robots._axes import frames_along
from armlab.robots._consistency import body_fault, check_joint_count
from armlab.robots._urdf_structure import fault, follow
from armlab.robots.build import GRAVITY, from_links
from armlab.robots.mesh import Mesh
from armlab.robots.robot import Robot

if TYPE_CHECKING:
    from armlab.robots.urdf import Joint, Link, Tree

__all__ = ["build_chain"]

SHORTEST_AXIS = 1e-6  # of a shorter one no digit is left
ROUNDING = 0.01  # a moment may exceed the sum of the others by this part: digits of files, thin plates
_TURN_OVER = np.diag([1.0, -1.0, -1.0, 1.0])  # half a turn about x: the other direction of the z axis


@dataclass(frozen=True, eq=False)
class Step:
    """A joint on the way, passed downwards or upwards, and the links that are rigidly joined behind it.

    Attributes
    ----------
    joint : the joint.
    T_last_link : pose of the joint's armlab frame, z along the axis, in the frame of the joint before, or in the base.
    T_link_body : pose in that frame of each link that moves with it.
    """

    joint: Joint
    T_last_link: np.ndarray
    T_link_body: dict[str, np.ndarray]


def build_chain(tree: Tree, base: str | None, tip: str | None, name: str | None) -> Robot:
    """Return the serial arm from one link to another. See `Tree.chain`.

    Parameters
    ----------
    tree : links and joints.
    base, tip, name : of the arm.
    """
    names = [link.name for link in tree.links]
    for link in (base, tip):
        if link is not None and link not in names:
            raise UnknownName.among(f"link of {tree.file}", link, names)
    base = tree.root if base is None else base
    tip = _only_tip(tree, base) if tip is None else tip
    way = _way(tree, base, tip)
    joints = [joint for joint, _ in way if joint.moves]
    if not joints:
        raise RobotError(f"Expected a joint that moves between {base!r} and {tip!r} of {tree.file}, got none.")
    check_joint_count(tree.name if name is None else name, len(joints))
    for joint in joints:
        _check_joint(tree, joint)
    follow(tree, [joint.name for joint in joints])
    steps, T_last_tip = _steps(tree, way)
    links = {link.name: link for link in tree.links}
    inertias, massless = _inertias(tree, links, steps)
    gravity, assumed = _gravity(tree, base)
    groups = [_rigid(tree, base, np.eye(4)), *(step.T_link_body for step in steps)]
    return from_links(
        tree.name if name is None else name,
        np.array([*(step.T_last_link for step in steps), T_last_tip]),
        [joint.kind == "prismatic" for joint in joints],
        q_min=[joint.q_min for joint in joints],
        q_max=[joint.q_max for joint in joints],
        qd_max=[joint.qd_max for joint in joints],
        tau_max=[joint.tau_max for joint in joints],
        joint_names=[joint.name for joint in joints],
        gravity=gravity,
        inertias=inertias,
        meshes=[[_moved(mesh, T) for body, T in group.items() for mesh in links[body].meshes] for group in groups],
        source=_source(tree, base, tip, steps, massless, assumed),
    )


def _only_tip(tree: Tree, base: str) -> str:
    tips = tree.tips_below(base)
    if len(tips) != 1:
        more = f" and {len(tips) - 20} more" if len(tips) > 20 else ""
        got = f"several: {', '.join(tips[:20])}{more}. Say which is the tip" if tips else "none"
        raise RobotError(f"Expected one branch that moves below link {base!r} of {tree.file}, got {got}.")
    return tips[0]


def _way(tree: Tree, base: str, tip: str) -> list[tuple[Joint, bool]]:
    """Return the joints from base to tip, each with whether it is passed upwards, from child to parent."""
    above_base, above_tip = _ancestry(tree, base), _ancestry(tree, tip)
    while above_base and above_tip and above_base[-1] is above_tip[-1]:  # the way to the root that both share
        above_base.pop()
        above_tip.pop()
    return [*((joint, True) for joint in above_base), *((joint, False) for joint in reversed(above_tip))]


def _ancestry(tree: Tree, link: str) -> list[Joint]:
    """Return the joints from a link up to the root."""
    joints = []
    while link in tree.parent_joints:
        joints.append(tree.parent_joints[link])
        link = joints[-1].parent
    return joints


def _steps(tree: Tree, way: list[tuple[Joint, bool]]) -> tuple[list[Step], np.ndarray]:
    """Merge the fixed joints; return the moving ones and the pose of the tip in the frame of the last."""
    turns = iter(se3.from_rp(frames_along(np.array([joint.axis for joint, _ in way if joint.moves]))))
    steps, T = [], np.eye(4)
    for joint, upwards in way:
        T_parent_child = joint.T_parent_child
        if not joint.moves:
            T = T @ (se3.inv(T_parent_child) if upwards else T_parent_child)
            continue
        T_child_link = next(turns) @ _TURN_OVER if upwards else next(turns)
        before = T @ T_child_link if upwards else T @ T_parent_child @ T_child_link
        T_link_child = se3.inv(T_child_link)
        T = T_link_child @ se3.inv(T_parent_child) if upwards else T_link_child
        steps.append(Step(joint, before, _rigid(tree, joint.parent if upwards else joint.child, T)))
    return steps, T


def _rigid(tree: Tree, link: str, T: np.ndarray) -> dict[str, np.ndarray]:
    """Return the poses of all links that are rigidly joined to a link at pose T, itself first."""
    poses, waiting = {}, [(link, T)]
    while waiting:
        name, T = waiting.pop()
        poses[name] = T
        above = tree.parent_joints.get(name)
        if above and not above.moves and above.parent not in poses:
            waiting.append((above.parent, T @ se3.inv(above.T_parent_child)))
        for joint in tree.child_joints[name]:
            if not joint.moves and joint.child not in poses:
                waiting.append((joint.child, T @ joint.T_parent_child))
    return poses


def _check_joint(tree: Tree, joint: Joint) -> None:
    if joint.kind in ("floating", "planar"):
        advice = "Choose base and tip on one side of it."
        raise fault(
            tree, joint, "joints of one degree of freedom in an arm", f"{joint.kind} joint {joint.name!r}", advice
        )
    if not np.linalg.norm(joint.axis) > SHORTEST_AXIS:
        expected = f"the direction of the axis of joint {joint.name!r}"
        raise fault(tree, joint, expected, joint.axis.tolist(), "Write one other than zero.")
    if not joint.q_min < joint.q_max:
        got = f"{joint.q_min:g} and {joint.q_max:g} (what is not written is 0)"
        advice = "Write its range, or make it `fixed`, or `continuous` if it turns without end."
        raise fault(tree, joint, f"lower below upper in joint {joint.name!r}", got, advice)
    if joint.qd_max < 0 or joint.tau_max < 0:
        got = f"velocity {joint.qd_max:g} and effort {joint.tau_max:g}"
        raise fault(tree, joint, f"positive limits of speed and effort of joint {joint.name!r}", got)


def _inertias(tree: Tree, links: dict[str, Link], steps: list[Step]) -> tuple[np.ndarray | None, list[str]]:
    """Return the inertias (n, 10), None if the file has none, and the joints behind which no mass is known."""
    inertias, massless, odd = np.zeros((len(steps), 10)), [], []
    for pi, step in zip(inertias, steps):
        for name, T in step.T_link_body.items():
            body = links[name].inertia
            if body is None:
                continue
            wrong = body_fault(body)
            if wrong:
                advice = "Correct it, or remove <inertial> where nothing is known."
                raise fault(tree, links[name], f"mass and inertia of a body in link {name!r}", wrong, advice)
            pi += inertia.transform(T, body)
            moments = inertia.principal_moments(body)
            if moments[2] > (1 + ROUNDING) * (moments[0] + moments[1]):
                odd.append(f"{name!r} (line {links[name].line})")
        if not pi[0]:
            massless.append(step.joint.name)
    if odd:
        warnings.warn(
            f"Expected of every inertia in {tree.file} that no principal moment exceeds the sum of the others, as in "
            f"every body; got more at {', '.join(odd)}. They are used as they are; MuJoCo refuses them.",
            UserWarning,
            stacklevel=4,
        )
    return (None, []) if len(massless) == len(steps) else (inertias, massless)


def _gravity(tree: Tree, base: str) -> tuple[np.ndarray, str]:
    """Return gravity in base axes, the root being upright and joints above the base at 0, and these words."""
    R, moving = np.eye(3), []
    for joint in _ancestry(tree, base):
        R = joint.T_parent_child[:3, :3] @ R
        moving += [joint.name] if joint.moves else []
    zero = f" and {', '.join(moving)} at 0" if moving else ""
    return R.T @ GRAVITY, f"assumption: z of {tree.root!r} points up{zero}"


def _moved(mesh: Mesh, T: np.ndarray) -> Mesh:
    return Mesh(mesh.kind, mesh.file, T @ mesh.T_link_mesh, mesh.scale)


def _source(tree: Tree, base: str, tip: str, steps: list[Step], massless: list[str], gravity: str) -> str:
    """Return line by line where the numbers come from, and what was left out."""
    passed = {step.joint.name for step in steps}
    notes = {
        "geometry": f"{Path(tree.file).name}, from {base!r} to {tip!r}",
        "gravity": gravity,
        "accelerations": "assumption: full speed in 0.1 s",
        "no mass known behind": ", ".join(massless),
        "left out, behind joints": ", ".join(_side_branches(tree, steps, passed)),
        "follow other joints": ", ".join(step.joint.name for step in steps if step.joint.follows),
    }
    return "\n".join(f"{key}: {text}" for key, text in notes.items() if text)


def _side_branches(tree: Tree, steps: list[Step], passed: Iterable[str]) -> list[str]:
    """Return the moving joints that hang on the arm and are no part of it."""
    found = {}
    for step in steps:
        for name in step.T_link_body:
            joints = [*tree.child_joints[name], *filter(None, [tree.parent_joints.get(name)])]
            found |= {joint.name: None for joint in joints if joint.moves and joint.name not in passed}
    return list(found)
