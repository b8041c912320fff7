"""URDF: the tree of links and joints that a file describes, and every serial arm in it.

``robots.load("arm.urdf")`` is enough for a file with one arm. A `Tree` shows what a file holds, gives the `Robot`
between any two links, and knows which joints follow others (mimic).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import numbers
from armlab.errors import RobotError, ShapeError, UnknownName
from armlab.robots.mesh import Mesh
from armlab.robots.robot import Robot

__all__ = ["Follow", "Joint", "Link", "Mimic", "Tree", "parse", "read"]

JointKind = Literal["revolute", "continuous", "prismatic", "fixed", "floating", "planar"]


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
    """A joint follows another: ``q = multiplier q_joint + offset``.

    Attributes
    ----------
    joint : the one that it follows.
    multiplier, offset : factor, and position where the other is at 0.
    """

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
        """Whether it is anything but fixed."""
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
        """Check the structure."""
        from armlab.robots._urdf_structure import check_tree

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
        from armlab.robots._urdf_chain import build_chain

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
        from armlab.robots._urdf_structure import follow

        return follow(self, joint_names)

    def __repr__(self) -> str:
        return f"Tree({self.name!r}, {len(self.links)} links, {len(self.joints)} joints)"


def read(path: str | Path) -> Tree:
    """Return what a URDF file describes.

    Parameters
    ----------
    path : the file. Expand xacro first: ``xacro robot.xacro > robot.urdf``.

    Raises
    ------
    RobotError : when the file is missing, is no URDF, or is no tree; names file and line, and what to do.

    References
    ----------
    The format: URDF 1.0, wiki.ros.org/urdf/XML.
    """
    try:
        data = Path(path).read_bytes()
    except (OSError, TypeError, ValueError) as error:  # not there; no path at all
        raise RobotError(f"Expected a URDF file at {path}, got: {error}.") from None
    return parse(data, str(path))


def parse(text: str | bytes, file: str = "the URDF text") -> Tree:
    """Return what a URDF text describes.

    Joints revolute, continuous, prismatic and fixed with origin, axis, limits and mimic; floating and planar ones,
    which no chain may pass; inertias; meshes by reference. Other shapes, materials, transmissions and unknown
    elements are passed over.

    Parameters
    ----------
    text : the XML.
    file : its name, for messages.

    Raises
    ------
    RobotError : as `read`.
    """
    from armlab.robots._urdf_reading import read_tree

    if not isinstance(text, str | bytes):
        raise RobotError(f"Expected the text of a URDF, got {text!r}. Of a file: urdf.read.")
    return read_tree(text, file)
