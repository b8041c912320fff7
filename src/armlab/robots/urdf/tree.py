"""URDF: the tree of links and joints in a file, its validation, and its serial arms.

For a file with one arm, ``robots.load("arm.urdf")`` is sufficient. A `Tree` lists the links and joints, returns the
`Robot` between any two links, and resolves mimic joints.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
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
from armlab.robots.build import GRAVITY, dexterous_home, frames_along, from_links
from armlab.robots.robot import Mesh, Robot, body_fault, check_joint_count

JointKind = Literal["revolute", "continuous", "prismatic", "fixed", "floating", "planar"]
SHORTEST_AXIS = 1e-6  # axes below this length have no significant digits
ROUNDING = 0.01  # tolerance of the triangle inequality of moments, for rounded files and thin plates
_TURN_OVER = np.diag([1.0, -1.0, -1.0, 1.0])  # half a turn about x, which reverses the z axis


@dataclass(frozen=True, eq=False)
class Link:
    """Link of a URDF file; quantities are in the link frame.

    Attributes
    ----------
    name : name of the link.
    inertia : (10,) inertial parameters about the origin of its frame (see `robots.inertia`); None: no mass.
    meshes : meshes of the link.
    line : first line of the element in the file.
    """

    name: str
    inertia: np.ndarray | None
    meshes: tuple[Mesh, ...]
    line: int


@dataclass(frozen=True)
class Follow:
    """Mimic relation of a joint: ``q = multiplier q_joint + offset``."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True, eq=False)
class Joint:
    """Joint of a URDF file.

    Attributes
    ----------
    name : name of the joint.
    kind : "revolute", "continuous", "prismatic", "fixed", "floating" or "planar".
    parent, child : names of the connected links.
    T_parent_child : (4, 4) pose of the child, and of the joint, in the parent at q = 0.
    axis : (3,) direction of the axis in the child's frame, of any length.
    q_min, q_max : position limits [rad or m]; infinite if unlimited, 0 if a required limit is missing.
    qd_max, tau_max : speed and torque (or force) limits; infinite if unknown.
    follows : mimic relation, or None.
    line : first line of the element in the file.
    damping, friction : viscous and Coulomb friction; 0 where unknown.
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
    damping: float = 0.0
    friction: float = 0.0

    @property
    def moves(self) -> bool:
        return self.kind != "fixed"


@dataclass(frozen=True, eq=False)
class Mimic:
    """Relation between the joints of a chain and the free joints: ``q = matrix q_free + offset``.

    For velocities ``qd = matrix qd_free``, for Jacobians ``J_free = J matrix``, and for torques ``tau_free = matrixᵀ
    tau``.

    Attributes
    ----------
    names : the m free joints, which may lie outside the chain.
    matrix : (n, m) multipliers.
    offset : (n,) offsets.
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
        (..., n) joint positions.

        Raises
        ------
        ShapeError : if the positions are not numbers or the last axis does not have length m.
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
    """Validated links and joints of one file: one root, no loops, unique names.

    Attributes
    ----------
    name : name of the robot in the file.
    file : name of the file, for messages.
    links, joints : links and joints in the order of the file.

    Raises
    ------
    RobotError : if links and joints do not form a tree; the message states file and line.
    """

    name: str
    file: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]

    def __post_init__(self) -> None:
        if not self.links:
            raise RobotError(f"Expected at least one link in {self.file}, got no links.")
        _check_names(self, self.links, "link")
        _check_names(self, self.joints, "joint")
        _check_ends(self)
        _check_roots(self)

    @cached_property
    def root(self) -> str:
        """The link without a parent."""
        return next(link.name for link in self.links if link.name not in self.parent_joints)

    @cached_property
    def parent_joints(self) -> dict[str, Joint]:
        """The parent joint of each link, except the root."""
        return {joint.child: joint for joint in self.joints}

    @cached_property
    def child_joints(self) -> dict[str, tuple[Joint, ...]]:
        """The child joints of each link."""
        below: dict[str, list[Joint]] = {link.name: [] for link in self.links}
        for joint in self.joints:
            below[joint.parent].append(joint)
        return {name: tuple(joints) for name, joints in below.items()}

    @cached_property
    def tips(self) -> tuple[str, ...]:
        """Links at the ends of the moving branches: no joint below, and at least one moving joint above."""
        return self.tips_below(self.root)

    def tips_below(self, base: str) -> tuple[str, ...]:
        """Return the links at the ends of the branches that move relative to a link above them.

        Parameters
        ----------
        base : name of the link.

        Raises
        ------
        UnknownName : if the link does not exist.
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

    def chain(
        self,
        base: str | None = None,
        tip: str | None = None,
        name: str | None = None,
        lock: Mapping[str, float] | None = None,
    ) -> Robot:
        """Return the serial arm between two links; the path may go up the tree.

        The base frame is that of the link `base`; the flange frame is that of `tip`. Fixed joints are merged, as are
        the inertias and meshes of all rigidly attached links. Other moving branches are omitted; a warning states their
        mass. A mimic joint remains an independent joint; see `mimic`.

        The home posture is a non-singular posture near mid-range. Gravity is `GRAVITY` in the axes of the root. The
        axis of a joint traversed from child to parent is reversed, which preserves the sign of its position. A speed or
        effort of 0 means unknown, and a limit of 1e9 or more means unlimited. An inertia that violates the triangle
        inequality is used, and an inertia without a mass is omitted, each with a warning. `Robot.source` lists all
        assumptions and omissions.

        Parameters
        ----------
        base : name of the fixed link; default: the root.
        tip : name of the last link; required if several branches move.
        name : name of the robot; default: the name in the file.
        lock : positions [rad or m] of locked joints, by name; the links behind these joints keep their mass.

        Raises
        ------
        UnknownName : if a link or a locked joint does not exist; the message lists the available names.
        RobotError : if the tip is missing and several branches move; if no joint between base and tip moves; if a joint
            between them is floating or planar, has no axis, no range or reversed limits, or mimics a missing joint;
            or if the inertia of a link is not physically consistent. The message states the file and line. Other parts
            of the file are not checked.
        """
        tree = _locked(self, lock) if lock else self
        names = [link.name for link in tree.links]
        for link in (base, tip):
            if link is not None and link not in names:
                raise UnknownName.among(f"link of {tree.file}", link, names)
        base = tree.root if base is None else base
        tip = _only_tip(tree, base) if tip is None else tip
        way = _way(tree, base, tip)
        joints = [joint for joint, _ in way if joint.moves]
        if not joints:
            raise RobotError(f"Expected a moving joint between {base!r} and {tip!r} of {tree.file}, got none.")
        check_joint_count(tree.name if name is None else name, len(joints))
        for joint in joints:
            _check_joint(tree, joint)
        tree.mimic([joint.name for joint in joints])
        steps, T_last_tip = _steps(tree, way)
        links = {link.name: link for link in tree.links}
        inertias, massless = _inertias(tree, links, steps)
        gravity, assumed = _gravity(tree, base)
        groups = [_rigid(tree, base, np.eye(4)), *(step.T_link_body for step in steps)]
        _warn_of_branches(tree, links, steps)
        robot = from_links(
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
            drives={key: [getattr(joint, key) for joint in joints] for key in ("friction", "damping")},
        )
        return replace(robot, q_home=dexterous_home(robot))

    def mimic(self, joint_names: Iterable[str]) -> Mimic:
        """Return the relation between the joints of a chain and the free (non-mimic) joints.

        Parameters
        ----------
        joint_names : the joints, as in `Robot.joint_names`.

        Raises
        ------
        UnknownName : if a joint does not exist.
        RobotError : if the names are not a sequence.
        """
        joints = {joint.name: joint for joint in self.joints}
        rows: list[tuple[str, float, float]] = []  # leader, multiplier, offset
        for name in members(joint_names, f"names of joints of {self.file}"):
            if name not in joints:
                raise UnknownName.among(f"joint of {self.file}", name, joints)
            rows.append(_leader(self, joints, joints[name]))
        leaders = tuple(dict.fromkeys(leader for leader, _, _ in rows))
        matrix = np.zeros((len(rows), len(leaders)))
        for i, (leader, multiplier, _) in enumerate(rows):
            matrix[i, leaders.index(leader)] = multiplier
        return Mimic(leaders, matrix, np.array([offset for _, _, offset in rows]))

    def __repr__(self) -> str:
        return f"Tree({self.name!r}, {len(self.links)} links, {len(self.joints)} joints)"


def fault(tree: Tree, part: Link | Joint, expected: str, got: object, advice: str = "") -> RobotError:
    """Return an error about a link or joint that states the file and line."""
    return RobotError(f"Expected {expected} in {tree.file}, line {part.line}, got {got}.{advice and ' '}{advice}")


def _check_names(tree: Tree, parts: Sequence[Link | Joint], kind: str) -> None:
    lines: dict[str, int] = {}
    for part in parts:
        if part.name in lines:
            got = f"{part.name!r} again, as in line {lines[part.name]}"
            raise fault(tree, part, f"every {kind} to have a unique name", got)
        lines[part.name] = part.line


def _check_ends(tree: Tree) -> None:
    names = {link.name for link in tree.links}
    above: dict[str, Joint] = {}
    for joint in tree.joints:
        for end, name in (("parent", joint.parent), ("child", joint.child)):
            if name not in names:
                from difflib import get_close_matches

                close = get_close_matches(name, names, n=1)
                advice = f"The closest name is {close[0]!r}." if close else "Add the link or correct the name."
                raise fault(
                    tree, joint, f"the {end} of joint {joint.name!r} to be one of the links", repr(name), advice
                )
        if joint.child in above:
            other = above[joint.child]
            got = f"joint {joint.name!r} in addition to {other.name!r} in line {other.line}"
            advice = "A URDF must be a tree, so remove one of the joints."
            raise fault(tree, joint, f"one joint above link {joint.child!r}", got, advice)
        above[joint.child] = joint


def _check_roots(tree: Tree) -> None:
    below = {joint.child for joint in tree.joints}
    roots = [link for link in tree.links if link.name not in below]
    if len(roots) > 1:
        others = ", ".join(f"{link.name!r} (line {link.line})" for link in roots)
        raise fault(tree, roots[1], "one root link", others, "Connect them with a fixed joint.")
    reached, waiting = set(), [link.name for link in roots]
    while waiting:
        name = waiting.pop()
        reached.add(name)
        waiting += [joint.child for joint in tree.child_joints[name]]
    for joint in tree.joints:
        if joint.child not in reached:  # every link has at most one parent joint, so this joint is on or below a loop
            raise fault(tree, joint, "joints directed away from a single root", f"a loop through joint {joint.name!r}")


def _leader(tree: Tree, joints: dict[str, Joint], joint: Joint) -> tuple[str, float, float]:
    """Return the free joint at the end of a joint's mimic relations (or the joint itself), with factor and offset."""
    multiplier, offset, passed = 1.0, 0.0, {joint.name}
    while joint.follows is not None:
        follows = joint.follows
        leader = joints.get(follows.joint)
        if leader is None or leader.kind in ("fixed", "floating", "planar") or leader.name in passed:
            why = "does not exist" if leader is None else f"is {leader.kind}"
            got = f"{follows.joint!r}, which {'mimics itself' if leader and leader.name in passed else why}"
            raise fault(tree, joint, f"joint {joint.name!r} to mimic a revolute or prismatic joint", got)
        multiplier, offset = multiplier * follows.multiplier, offset + multiplier * follows.offset
        passed.add(leader.name)
        joint = leader
    return joint.name, multiplier, offset


@dataclass(frozen=True, eq=False)
class Step:
    """Joint on the path, traversed downwards or upwards, with the links rigidly attached on its far side."""

    joint: Joint
    # pose of the joint's armlab frame, z along the axis, in the frame of the previous joint, or in the base
    T_last_link: np.ndarray
    T_link_body: dict[str, np.ndarray]  # pose of each attached link in that frame


def _locked(tree: Tree, lock: Mapping[str, float]) -> Tree:
    """Return the tree with some joints locked at a position."""
    found = {joint.name: joint for joint in tree.joints}
    for name, value in lock.items():
        if name not in found:
            raise UnknownName.among(f"joint of {tree.file}", name, found)
        joint, position = found[name], float(numbers(value, f"position of the locked joint {name!r}"))
        if not joint.moves or not np.isfinite(position):
            raise fault(
                tree, joint, f"a moving joint {name!r} and a finite position", f"a {joint.kind} joint and {value!r}"
            )
        _check_axis(tree, joint)
        axis = position * joint.axis / np.linalg.norm(joint.axis)
        twist = np.concatenate([axis, np.zeros(3)] if joint.kind == "prismatic" else [np.zeros(3), axis])
        found[name] = replace(joint, kind="fixed", T_parent_child=joint.T_parent_child @ se3.exp(twist), follows=None)
    return replace(tree, joints=tuple(found.values()))


def _only_tip(tree: Tree, base: str) -> str:
    tips = tree.tips_below(base)
    if len(tips) != 1:
        more = f" and {len(tips) - 20} more" if len(tips) > 20 else ""
        got = f"several: {', '.join(tips[:20])}{more}. Select the tip with --tip LINK or tip=" if tips else "none"
        raise RobotError(f"Expected one moving branch below link {base!r} of {tree.file}, got {got}.")
    return tips[0]


def _way(tree: Tree, base: str, tip: str) -> list[tuple[Joint, bool]]:
    """Return the joints from base to tip, each with True if it is traversed upwards, from child to parent."""
    above_base, above_tip = _ancestry(tree, base), _ancestry(tree, tip)
    while above_base and above_tip and above_base[-1] is above_tip[-1]:  # common path to the root
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
    """Merge fixed joints; return the moving joints, and the pose of the tip in the frame of the last moving joint."""
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
    """Return the poses of a link at pose T and of all links rigidly attached to it."""
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


def _check_axis(tree: Tree, joint: Joint) -> None:
    if joint.kind in ("floating", "planar"):
        advice = "Choose base and tip on the same side of this joint."
        raise fault(
            tree, joint, "joints with one degree of freedom in an arm", f"{joint.kind} joint {joint.name!r}", advice
        )
    if not np.linalg.norm(joint.axis) > SHORTEST_AXIS:
        expected = f"a non-zero axis of joint {joint.name!r}"
        raise fault(tree, joint, expected, joint.axis.tolist(), "Correct the axis.")


def _check_joint(tree: Tree, joint: Joint) -> None:
    _check_axis(tree, joint)
    if not joint.q_min < joint.q_max:
        got = f"{joint.q_min:g} and {joint.q_max:g} (missing values are 0)"
        advice = "Specify its range, or make it `fixed`, or `continuous` if its rotation is unlimited."
        raise fault(tree, joint, f"lower below upper in joint {joint.name!r}", got, advice)
    if joint.qd_max < 0 or joint.tau_max < 0:
        got = f"velocity {joint.qd_max:g} and effort {joint.tau_max:g}"
        raise fault(tree, joint, f"non-negative speed and effort limits of joint {joint.name!r}", got)


def _inertias(tree: Tree, links: dict[str, Link], steps: list[Step]) -> tuple[np.ndarray | None, list[str]]:
    """Return the inertias (n, 10), or None for a file without masses, and the joints that carry no known mass."""
    inertias, massless, odd, weightless = np.zeros((len(steps), 10)), [], [], []
    for pi, step in zip(inertias, steps):
        for name, T in step.T_link_body.items():
            body = links[name].inertia
            if body is None:
                continue
            if body[0] == 0:
                weightless.append(f"{name!r} (line {links[name].line})")
                continue
            wrong = body_fault(body)
            if wrong:
                advice = "Correct it, or remove <inertial> where it is unknown."
                raise fault(tree, links[name], f"a physically consistent inertia in link {name!r}", wrong, advice)
            pi += inertia.transform(T, body)
            moments = inertia.principal_moments(body)
            if moments[2] > (1 + ROUNDING) * (moments[0] + moments[1]):
                odd.append(f"{name!r} (line {links[name].line})")
        if not pi[0]:
            massless.append(step.joint.name)
    if weightless:
        warnings.warn(
            "Expected a nonzero mass for every link with an inertia in "
            f"{tree.file}, got mass 0 in {', '.join(weightless)}. These links "
            "are used without inertia.",
            stacklevel=3,
        )
    if odd:
        warnings.warn(
            f"Expected principal moments of every inertia in {tree.file} to satisfy the triangle inequality, got "
            f"violations at {', '.join(odd)}. These inertias are used unchanged.",
            UserWarning,
            stacklevel=3,
        )
    return (None, []) if len(massless) == len(steps) else (inertias, massless)


def _gravity(tree: Tree, base: str) -> tuple[np.ndarray, str]:
    """Return gravity in base axes, and the underlying assumption as text: root upright, joints between root and base at
    0."""
    R, moving = np.eye(3), []
    for joint in _ancestry(tree, base):
        R = joint.T_parent_child[:3, :3] @ R
        moving += [joint.name] if joint.moves else []
    zero = f" and {', '.join(moving)} at 0" if moving else ""
    return R.T @ GRAVITY, f"assumption: z of {tree.root!r} points up{zero}"


def _source(tree: Tree, base: str, tip: str, steps: list[Step], massless: list[str], gravity: str) -> str:
    """Return notes on the sources of the numbers and on omitted parts, one per line."""
    notes = {
        "geometry": f"{Path(tree.file).name}, from {base!r} to {tip!r}",
        "gravity": gravity,
        "accelerations": "assumption: full speed is reached in 0.1 s",
        "unknown mass behind": ", ".join(massless),
        "omitted branches behind": ", ".join(_side_branches(tree, steps)),
        "mimic joints": ", ".join(step.joint.name for step in steps if step.joint.follows),
    }
    return "\n".join(f"{key}: {text}" for key, text in notes.items() if text)


def _side_branches(tree: Tree, steps: list[Step]) -> dict[str, str]:
    """Return the moving joints that branch off the arm, each with its outer link."""
    found = {}
    for step in steps:
        for name in step.T_link_body:
            below = {joint.name: joint.child for joint in tree.child_joints[name] if joint.moves}
            above = tree.parent_joints.get(name)
            found |= below | ({above.name: above.parent} if above and above.moves else {})
    passed = {step.joint.name for step in steps}
    return {joint: link for joint, link in found.items() if joint not in passed}


def _warn_of_branches(tree: Tree, links: dict[str, Link], steps: list[Step]) -> None:
    """Warn about the mass of each omitted branch that moves with the arm."""
    masses = {}
    for joint, first in _side_branches(tree, steps).items():
        reached, waiting = set(), [first]
        while waiting:
            link = waiting.pop()
            reached.add(link)
            above = tree.parent_joints.get(link)
            ends = [one.child for one in tree.child_joints[link] if one.name != joint]
            ends += [above.parent] if above and above.name != joint else []
            waiting += [end for end in ends if end not in reached]
        bodies = [links[link].inertia for link in reached]
        masses[joint] = sum(float(pi[0]) for pi in bodies if pi is not None)
    heavy = {joint: mass for joint, mass in masses.items() if mass > 0}
    if heavy:
        words = ", ".join(f"{mass:.3g} kg behind {joint}" for joint, mass in heavy.items())
        locks = " ".join(f"--lock {joint}=0" for joint in heavy)
        warnings.warn(
            f"The arm of {tree.file} omits {words}. To keep the mass, lock the joints ({locks}, or lock= in Python).",
            UserWarning,
            stacklevel=4,
        )
