"""Whether links and joints are a tree, and which joints follow which."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from armlab._numbers import members
from armlab.errors import RobotError, UnknownName

if TYPE_CHECKING:
    from armlab.robots.urdf import Joint, Link, Mimic, Tree

__all__ = ["check_tree", "fault", "follow"]


def fault(tree: Tree, part: Link | Joint, expected: str, got: object, advice: str = "") -> RobotError:
    """Return the error that says what was expected of a link or joint, with file and line.

    Parameters
    ----------
    tree : its file is named.
    part : its line is named.
    expected, got, advice : the sentence.
    """
    return RobotError(f"Expected {expected} in {tree.file}, line {part.line}, got {got}.{advice and ' '}{advice}")


def check_tree(tree: Tree) -> None:
    """Raise `RobotError` unless links and joints are a tree with one root.

    Parameters
    ----------
    tree : links and joints.
    """
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
            raise fault(
                tree,
                part,
                f"every {kind} to have a name of its own",
                f"{part.name!r} again, as in line {lines[part.name]}",
            )
        lines[part.name] = part.line


def _check_ends(tree: Tree) -> None:
    """Both links of every joint exist, and no link hangs on two joints."""
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
    """Return how joints follow the free ones. See `Tree.mimic`.

    Parameters
    ----------
    tree : the joints.
    joint_names : those of the chain.
    """
    from armlab.robots.urdf import Mimic

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
