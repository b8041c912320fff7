"""URDF: the tree of links and joints of a file, its checks, and every serial arm in it.

``robots.load("arm.urdf")`` is enough for a file with one arm. A `Tree` shows what a file holds, gives the `Robot`
between any two links, and knows which joints follow others (mimic).
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import members, numbers
from armlab.errors import RobotError, ShapeError, UnknownName
from armlab.lie import se3
from armlab.robots import inertia
from armlab.robots.build import GRAVITY, frames_along, from_links
from armlab.robots.robot import Mesh, Robot, body_fault, check_joint_count

JointKind = Literal["revolute", "continuous", "prismatic", "fixed", "floating", "planar"]
SHORTEST_AXIS = 1e-6  # of a shorter one no digit is left
ROUNDING = 0.01  # a moment may exceed the sum of the others by this part: digits of files, thin plates
_TURN_OVER = np.diag([1.0, -1.0, -1.0, 1.0])  # half a turn about x: the other direction of the z axis


@dataclass(frozen=True, eq=False)
class Link:
    """One link as the file has it, in its own frame, which need not have an axis along any joint.

    Attributes
    ----------
    name : its name.
    inertia : (10,) inertial parameters about the origin of its frame (see `robots.inertia`), or None without mass.
    meshes : its meshes.
    line : where it begins in the file.
    """

    name: str
    inertia: np.ndarray | None
    meshes: tuple[Mesh, ...]
    line: int


@dataclass(frozen=True)
class Follow:
    """A joint follows another: ``q = multiplier q_joint + offset``."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True, eq=False)
class Joint:
    """One joint as the file has it.

    Attributes
    ----------
    name : its name.
    kind : "revolute", "continuous", "prismatic", "fixed", "floating" or "planar".
    parent, child : names of the links that it joins.
    T_parent_child : (4, 4) pose of the child, and of the joint, in the parent at q = 0.
    axis : (3,) direction of the axis in the child's frame, of any length.
    q_min, q_max : limits of position [rad or m]; infinite where there is none, 0 where the file should say them.
    qd_max, tau_max : limits of speed and of torque or force; infinite where none is known.
    follows : the joint that it follows, or None.
    line : where it begins in the file.
    """

    name: str
    kind: JointKind
    parent: str
    child: str
    T_parent_child: np.ndarray
    axis: np.ndarray
    q_min: float
    q_max: float
    qd_max: float
    tau_max: float
    follows: Follow | None
    line: int

    @property
    def moves(self) -> bool:
        return self.kind != "fixed"


@dataclass(frozen=True, eq=False)
class Mimic:
    """How the joints of a chain follow the free ones: ``q = matrix q_free + offset``.

    Velocities follow as ``qd = matrix qd_free``, Jacobians as ``J_free = J matrix``, torques as
    ``tau_free = matrixᵀ tau``.

    Attributes
    ----------
    names : the m free joints. One that leads may lie outside the chain.
    matrix : (n, m). offset : (n,).
    """

    names: tuple[str, ...]
    matrix: np.ndarray
    offset: np.ndarray

    def positions(self, q_free: ArrayLike) -> np.ndarray:
        """Return the positions of all joints of the chain.

        Parameters
        ----------
        q_free : (..., m) positions of the free joints.

        Returns
        -------
        (..., n).

        Raises
        ------
        ShapeError : when they are no numbers or the last axis is not m long.
        """
        q_free = numbers(q_free, "positions of the free joints", ShapeError)
        if q_free.shape[-1:] != (len(self.names),):
            raise ShapeError(
                f"Expected positions of the free joints {', '.join(self.names)}, shape (..., {len(self.names)}), "
                f"got {q_free.shape}."
            )
        return q_free @ self.matrix.T + self.offset


@dataclass(frozen=True, eq=False)
class Tree:
    """Links and joints of one file, checked: one root, no loop, every name once.

    Attributes
    ----------
    name : name of the robot in the file.
    file : the file, for messages.
    links, joints : in the order of the file.

    Raises
    ------
    RobotError : when links and joints are no tree; names file and line.
    """

    name: str
    file: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]

    def __post_init__(self) -> None:
        check_tree(self)

    @cached_property
    def root(self) -> str:
        """The link that hangs on no other."""
        return next(link.name for link in self.links if link.name not in self.parent_joints)

    @cached_property
    def parent_joints(self) -> dict[str, Joint]:
        """The joint above each link but the root."""
        return {joint.child: joint for joint in self.joints}

    @cached_property
    def child_joints(self) -> dict[str, tuple[Joint, ...]]:
        """The joints below each link."""
        below: dict[str, list[Joint]] = {link.name: [] for link in self.links}
        for joint in self.joints:
            below[joint.parent].append(joint)
        return {name: tuple(joints) for name, joints in below.items()}

    @cached_property
    def tips(self) -> tuple[str, ...]:
        """The links at the ends of the branches that move: no joint below, and one above that is not fixed."""
        return self.tips_below(self.root)

    def tips_below(self, base: str) -> tuple[str, ...]:
        """Return the links at the ends of the branches that move with respect to a link above them.

        Parameters
        ----------
        base : name of the link.

        Raises
        ------
        UnknownName : when there is no such link.
        """
        if base not in self.child_joints:
            raise UnknownName.among(f"link of {self.file}", base, self.child_joints)
        tips, waiting = [], [(base, False)]
        while waiting:
            name, moves = waiting.pop()
            below = self.child_joints[name]
            if moves and not below:
                tips.append(name)
            waiting += [(joint.child, moves or joint.moves) for joint in reversed(below)]
        return tuple(tips)

    def chain(self, base: str | None = None, tip: str | None = None, name: str | None = None) -> Robot:
        """Return the serial arm from one link to another, upwards through the tree too.

        Frame `base` is that of the link `base`, the flange that of `tip`. Fixed joints are merged, and so are the
        inertias and meshes of all links rigidly joined to a link of the arm; what hangs on other moving joints is left
        out. Gravity is `GRAVITY` in the axes of the root. A joint that is passed from child to parent turns about the
        opposite axis, so that its position stays what the file means by it. A joint that follows another keeps a
        position of its own: see `mimic`. A speed or effort of 0 stands for none known, a limit of 1e9 or more for none.
        An inertia whose largest principal moment is above the sum of the others, as in no body, is used with a warning.
        What was assumed or left out stands in `Robot.source`.

        Parameters
        ----------
        base : name of the link that stands still; the root unless said.
        tip : name of the link that moves last; need not be said where only one branch moves.
        name : name of the robot; that of the file unless said.

        Raises
        ------
        UnknownName : when a link does not exist; lists those that do.
        RobotError : when the tip is not said and several branches move, when nothing moves between the two, when a
            joint between them is floating or planar, has no axis, no range or limits the wrong way round, or follows
            one that does not exist, and when a link has the inertia of no body; names file and line. What is not part
            of the arm does not matter.
        """

        return build_chain(self, base, tip, name)

    def mimic(self, joint_names: Iterable[str]) -> Mimic:
        """Return how the joints of a chain follow the free ones, those that follow none.

        Parameters
        ----------
        joint_names : the joints, as in `Robot.joint_names`.

        Raises
        ------
        UnknownName : when the file has no such joint.
        RobotError : when the names are no list.
        """

        return follow(self, joint_names)

    def __repr__(self) -> str:
        return f"Tree({self.name!r}, {len(self.links)} links, {len(self.joints)} joints)"


def fault(tree: Tree, part: Link | Joint, expected: str, got: object, advice: str = "") -> RobotError:
    """Return the error that says what was expected of a link or joint, with file and line."""
    return RobotError(f"Expected {expected} in {tree.file}, line {part.line}, got {got}.{advice and ' '}{advice}")


def check_tree(tree: Tree) -> None:
    """Raise `RobotError` unless links and joints are a tree with one root."""
    if not tree.links:
        raise RobotError(f"Expected at least one link in {tree.file}, got none.")
    _check_names(tree, tree.links, "link")
    _check_names(tree, tree.joints, "joint")
    _check_ends(tree)
    _check_roots(tree)


def _check_names(tree: Tree, parts: Sequence[Link | Joint], kind: str) -> None:
    lines: dict[str, int] = {}
    for part in parts:
        if part.name in lines:
            got = f"{part.name!r} again, as in line {lines[part.name]}"
            raise fault(tree, part, f"every {kind} to have a name of its own", got)
        lines[part.name] = part.line


def _check_ends(tree: Tree) -> None:
    names = {link.name for link in tree.links}
    above: dict[str, Joint] = {}
    for joint in tree.joints:
        for end, name in (("parent", joint.parent), ("child", joint.child)):
            if name not in names:
                from difflib import get_close_matches

                close = get_close_matches(name, names, n=1)
                advice = f"Perhaps {close[0]!r} is meant." if close else "Add the link or correct the name."
                raise fault(tree, joint, f"the {end} of joint {joint.name!r} among the links", repr(name), advice)
        if joint.child in above:
            other = above[joint.child]
            got = f"joint {joint.name!r} beside {other.name!r} of line {other.line}"
            advice = "A URDF is a tree: cut the loop at one of them."
            raise fault(tree, joint, f"one joint above link {joint.child!r}", got, advice)
        above[joint.child] = joint


def _check_roots(tree: Tree) -> None:
    below = {joint.child for joint in tree.joints}
    roots = [link for link in tree.links if link.name not in below]
    if len(roots) > 1:
        others = ", ".join(f"{link.name!r} (line {link.line})" for link in roots)
        raise fault(tree, roots[1], "one link that hangs on no other", others, "Join them by a fixed joint.")
    reached, waiting = set(), [link.name for link in roots]
    while waiting:
        name = waiting.pop()
        reached.add(name)
        waiting += [joint.child for joint in tree.child_joints[name]]
    for joint in tree.joints:
        if joint.child not in reached:  # every link has one joint above at most, so this one is on a loop or below it
            raise fault(tree, joint, "joints that lead away from one root", f"a loop through joint {joint.name!r}")


def follow(tree: Tree, joint_names: Iterable[str]) -> Mimic:
    joints = {joint.name: joint for joint in tree.joints}
    rows: list[tuple[str, float, float]] = []  # leader, multiplier, offset
    for name in members(joint_names, f"names of joints of {tree.file}"):
        if name not in joints:
            raise UnknownName.among(f"joint of {tree.file}", name, joints)
        rows.append(_leader(tree, joints, joints[name]))
    leaders = tuple(dict.fromkeys(leader for leader, _, _ in rows))
    matrix = np.zeros((len(rows), len(leaders)))
    for i, (leader, multiplier, _) in enumerate(rows):
        matrix[i, leaders.index(leader)] = multiplier
    return Mimic(leaders, matrix, np.array([offset for _, _, offset in rows]))


def _leader(tree: Tree, joints: dict[str, Joint], joint: Joint) -> tuple[str, float, float]:
    """Return the free joint that a joint follows in the end, itself if it is free, with factor and offset."""
    multiplier, offset, passed = 1.0, 0.0, {joint.name}
    while joint.follows is not None:
        follows = joint.follows
        leader = joints.get(follows.joint)
        if leader is None or leader.kind in ("fixed", "floating", "planar") or leader.name in passed:
            why = "does not exist" if leader is None else f"is {leader.kind}"
            got = f"{follows.joint!r}, which {'follows itself' if leader and leader.name in passed else why}"
            raise fault(tree, joint, f"joint {joint.name!r} to follow a joint that turns or slides", got)
        multiplier, offset = multiplier * follows.multiplier, offset + multiplier * follows.offset
        passed.add(leader.name)
        joint = leader
    return joint.name, multiplier, offset


@dataclass(frozen=True, eq=False)
class Step:
    """A joint on the way, passed downwards or upwards, and the links that are rigidly joined behind it."""

    joint: Joint  # the joint
    # pose of the joint's armlab frame, z along the axis, in the frame of the joint before, or in the base
    T_last_link: np.ndarray
    T_link_body: dict[str, np.ndarray]  # pose in that frame of each link that moves with it


def build_chain(tree: Tree, base: str | None, tip: str | None, name: str | None) -> Robot:
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
        meshes=[
            [
                replace(mesh, T_link_mesh=T @ mesh.T_link_mesh)
                for body, T in group.items()
                for mesh in links[body].meshes
            ]
            for group in groups
        ],
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
