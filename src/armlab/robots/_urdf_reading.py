"""From URDF text to `Tree`."""

from __future__ import annotations

import math
from typing import get_args

import numpy as np

from armlab.errors import ShapeError
from armlab.lie import euler, quaternion, se3
from armlab.robots import inertia
from armlab.robots._xml import Element, parse_xml
from armlab.robots.mesh import Mesh
from armlab.robots.urdf import Follow, Joint, JointKind, Link, Tree

__all__ = ["read_tree"]

MOST_PARTS = 2000  # links, and joints, of a file; a humanoid with two hands has 150


def read_tree(text: str | bytes, file: str) -> Tree:
    """Return the tree that a text describes.

    Parameters
    ----------
    text : the XML.
    file : its name, for messages.

    Raises
    ------
    RobotError : with file and line.
    """
    robot = parse_xml(text, file)
    if robot.tag != "robot":
        raise robot.error("<robot> as the outermost element of a URDF", f"<{robot.tag}>")
    for tag in ("link", "joint"):
        if len(parts := robot.all(tag)) > MOST_PARTS:
            raise robot.error(f"at most {MOST_PARTS} {tag}s", len(parts), "Split the file, one robot in each.")
    return Tree(
        name=robot.text("name"),
        file=file,
        links=tuple(_link(element) for element in robot.all("link")),
        joints=tuple(_joint(element) for element in robot.all("joint")),
    )


def _link(element: Element) -> Link:
    inertial = element.one("inertial")
    return Link(
        name=element.text("name"),
        inertia=None if inertial is None else _inertia(inertial),
        meshes=tuple(_meshes(element)),
        line=element.line,
    )


def _inertia(inertial: Element) -> np.ndarray | None:
    """Return the parameters about the link's origin; None where all are 0, as in links that only name a frame."""
    mass, moments = inertial.need("mass").number("value"), inertial.need("inertia")
    xx, xy, xz, yy, yz, zz = (moments.number(f"i{axes}") for axes in ("xx", "xy", "xz", "yy", "yz", "zz"))
    about_centre = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    if mass == 0 and not about_centre.any():
        return None
    return inertia.transform(_origin(inertial), inertia.from_body(mass, np.zeros(3), about_centre))


def _meshes(link: Element) -> list[Mesh]:
    meshes = []
    for kind in ("visual", "collision"):
        for shape in link.all(kind):
            geometry = shape.one("geometry")
            mesh = None if geometry is None else geometry.one("mesh")
            if mesh is None:
                continue
            scale = mesh.numbers("scale", 3, (1.0, 1.0, 1.0))
            if not scale.all():
                raise mesh.error("a scale other than 0", scale.tolist())
            meshes.append(Mesh(kind, mesh.text("filename"), _origin(shape), scale))
    return meshes


def _joint(element: Element) -> Joint:
    kind = _kind(element)
    q_min, q_max, qd_max, tau_max = _limits(element, kind)
    axis = element.one("axis")
    return Joint(
        name=element.text("name"),
        kind=kind,
        parent=element.need("parent").text("link"),
        child=element.need("child").text("link"),
        T_parent_child=_origin(element),
        axis=np.array([1.0, 0.0, 0.0]) if axis is None else axis.numbers("xyz", 3),
        q_min=q_min,
        q_max=q_max,
        qd_max=qd_max,
        tau_max=tau_max,
        follows=None if kind == "fixed" else _follow(element),
        line=element.line,
    )


def _follow(element: Element) -> Follow | None:
    mimic = element.one("mimic")
    if mimic is None:
        return None
    return Follow(mimic.text("joint"), mimic.number("multiplier", 1.0), mimic.number("offset", 0.0))


def _kind(element: Element) -> JointKind:
    kinds: dict[str, JointKind] = {kind: kind for kind in get_args(JointKind)}
    kind = element.text("type")
    if kind not in kinds:
        raise element.error(f"a joint type among {', '.join(kinds)}", repr(kind))
    return kinds[kind]


def _origin(element: Element) -> np.ndarray:
    """Return the pose ``Rz(yaw) Ry(pitch) Rx(roll)`` at xyz."""
    origin = element.one("origin")
    if origin is None:
        return np.eye(4)
    zeros = (0.0, 0.0, 0.0)
    position = origin.numbers("xyz", 3, zeros)
    if "quat_xyzw" in origin.attributes:
        return se3.from_rp(_rotation(origin), position)
    roll, pitch, yaw = origin.numbers("rpy", 3, zeros)
    return se3.from_rp(euler.rot_z(yaw) @ euler.rot_y(pitch) @ euler.rot_x(roll), position)


def _rotation(origin: Element) -> np.ndarray:
    """Return the rotation of ``quat_xyzw``, which URDF 1.2 has beside rpy."""
    if "rpy" in origin.attributes:
        raise origin.error("rpy or quat_xyzw of <origin>", "both", "Remove one.")
    x, y, z, w = origin.numbers("quat_xyzw", 4)
    try:
        return quaternion.to_matrix([w, x, y, z])
    except ShapeError:
        raise origin.error("quat_xyzw of length 1", f"{x:g} {y:g} {z:g} {w:g}", "Correct it.") from None


def _limits(element: Element, kind: JointKind) -> tuple[float, float, float, float]:
    """Return q_min, q_max, qd_max, tau_max. The format says that positions which are not written are 0.

    A speed or effort of 0 stands for none known, as in the files of many makers and programs.
    """
    infinite = math.inf
    limit = element.one("limit")
    if limit is None:
        limit = Element("limit", {}, element.file, element.line)
    lower, upper = limit.limit("lower", 0.0), limit.limit("upper", 0.0)
    if kind not in ("revolute", "prismatic"):
        lower, upper = -infinite, infinite
    return lower, upper, limit.limit("velocity", 0.0) or infinite, limit.limit("effort", 0.0) or infinite
