"""URDF reader: builds a `Tree`, keeps line numbers, and rejects document types, entities and xacro."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import get_args
from xml.parsers import expat

import numpy as np

from armlab.errors import RobotError, ShapeError
from armlab.lie import euler, quaternion, se3
from armlab.robots import inertia
from armlab.robots.robot import Mesh
from armlab.robots.urdf.tree import Follow, Joint, JointKind, Link, Tree

MOST_PARTS = 2000  # links or joints per file; a humanoid with two hands has 150
LARGEST = 1e9  # limits of at least this value mean unlimited; other numbers of this size are rejected

DEEPEST = 64  # nesting of elements; URDF needs 5
MOST_BYTES, MOST_ELEMENTS = 1 << 24, 100_000  # a humanoid with two hands has 200 kB and 3000 elements
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
_LIMIT = re.compile(rf"{_NUMBER.pattern}|[+-]?inf(inity)?", re.ASCII | re.IGNORECASE)
_EXPAND = "Expand the file first: xacro robot.xacro > robot.urdf."


def read(path: str | Path) -> Tree:
    """Read a URDF file.

    Parameters
    ----------
    path : path of the file. Expand xacro first: ``xacro robot.xacro > robot.urdf``.

    Raises
    ------
    RobotError : if the file is missing, is not a URDF, or is not a tree; the message states the file, line and remedy.

    References
    ----------
    URDF 1.0, wiki.ros.org/urdf/XML.
    """
    try:
        data = Path(path).read_bytes()
    except (OSError, TypeError, ValueError) as error:  # missing, or not a path
        raise RobotError(f"Expected a URDF file at {path}, got: {error}.") from None
    return parse(data, str(path))


def parse(text: str | bytes, file: str = "the URDF text") -> Tree:
    """Parse a URDF text.

    The reader supports revolute, continuous, prismatic and fixed joints with origin, axis, limits and mimic, as well as
    inertias and meshes by reference. A chain must not include floating or planar joints. Other shapes, materials,
    transmissions and unknown elements are ignored.

    Parameters
    ----------
    text : XML of the description.
    file : name of the file, for messages.

    Raises
    ------
    RobotError : as in `read`.
    """
    if not isinstance(text, str | bytes):
        raise RobotError(f"Expected the text of a URDF, got {text!r}. For a file, call urdf.read.")
    robot = parse_xml(text, file)
    if robot.tag != "robot":
        raise robot.error("<robot> as the outermost element of a URDF", f"<{robot.tag}>")
    for tag in ("link", "joint"):
        if len(parts := robot.all(tag)) > MOST_PARTS:
            raise robot.error(f"at most {MOST_PARTS} {tag}s", len(parts), "Split the file into one file per robot.")
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
    """Return inertial parameters about the link's origin, or None if all are 0, as in links that only define frames."""
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
    axis, dynamics = element.one("axis"), element.one("dynamics")
    damping, friction = (0.0 if dynamics is None else dynamics.number(key, 0.0) for key in ("damping", "friction"))
    return Joint(
        name=element.text("name"), kind=kind, parent=element.need("parent").text("link"),
        child=element.need("child").text("link"), T_parent_child=_origin(element),
        axis=np.array([1.0, 0.0, 0.0]) if axis is None else axis.numbers("xyz", 3), q_min=q_min, q_max=q_max,
        qd_max=qd_max, tau_max=tau_max, follows=None if kind == "fixed" else _follow(element), line=element.line,
        damping=damping, friction=friction,
    )  # fmt: skip


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
    """Return the rotation of ``quat_xyzw``, the alternative to rpy in URDF 1.2."""
    if "rpy" in origin.attributes:
        raise origin.error("either rpy or quat_xyzw of <origin>", "both", "Remove either rpy or quat_xyzw.")
    x, y, z, w = origin.numbers("quat_xyzw", 4)
    try:
        return quaternion.to_matrix([w, x, y, z])
    except ShapeError:
        raise origin.error("quat_xyzw of length 1", f"{x:g} {y:g} {z:g} {w:g}", "Correct it.") from None


def _limits(element: Element, kind: JointKind) -> tuple[float, float, float, float]:
    """Return q_min, q_max, qd_max, tau_max; a missing position limit is 0; a speed or effort of 0 means unlimited."""
    limit = element.one("limit") or Element("limit", {}, element.file, element.line)
    lower, upper = limit.limit("lower", 0.0), limit.limit("upper", 0.0)
    if kind not in ("revolute", "prismatic"):
        lower, upper = -math.inf, math.inf
    return lower, upper, limit.limit("velocity", 0.0) or math.inf, limit.limit("effort", 0.0) or math.inf


@dataclass(slots=True)
class Element:
    """XML element whose methods raise `RobotError` with file and line."""

    tag: str
    attributes: dict[str, str]
    file: str
    line: int
    children: list[Element] = field(default_factory=list)

    def error(self, expected: str, got: object, advice: str = "") -> RobotError:
        """Return an error about this element."""
        return RobotError(f"Expected {expected} in {self.file}, line {self.line}, got {got}.{advice and ' '}{advice}")

    def all(self, tag: str) -> list[Element]:
        return [child for child in self.children if child.tag == tag]

    def one(self, tag: str) -> Element | None:
        found = self.all(tag)
        if len(found) > 1:
            got = f"another <{tag}> in line {found[0].line}"
            raise found[1].error(f"one <{tag}> inside <{self.tag}>", got, "Remove one of them.")
        return found[0] if found else None

    def need(self, tag: str) -> Element:
        found = self.one(tag)
        if found is None:
            raise self.error(f"a <{tag}> inside <{self.tag}>", "none", "Add it.")
        return found

    def text(self, name: str) -> str:
        """Return a required, non-empty attribute."""
        value = self.attributes.get(name, "")
        if not value.strip():
            raise self.error(f"the attribute {name} of <{self.tag}>", "none", "Add it.")
        if "${" in value or "$(" in value:
            raise self.error(f"plain text in {name} of <{self.tag}>", f"the xacro expression {value!r}", _EXPAND)
        return value

    def numbers(self, name: str, count: int, default: tuple[float, ...] | None = None) -> np.ndarray:
        """Return `count` space-separated numbers; for a missing attribute, return the default if there is one."""
        if name not in self.attributes and default is not None:
            return np.array(default)
        words = self.text(name).split()
        if len(words) != count:
            raise self.error(f"{count} numbers in {name} of <{self.tag}>", repr(self.attributes[name]))
        return np.array([self._number(name, word) for word in words])

    def number(self, name: str, default: float | None = None) -> float:
        return float(self.numbers(name, 1, None if default is None else (default,))[0])

    def limit(self, name: str, default: float) -> float:
        """Return one limit; values of `LARGEST` or more are infinite."""
        word = self.attributes.get(name, "").strip()
        if _LIMIT.fullmatch(word):
            value = float(word)
            return value if abs(value) < LARGEST else float(np.copysign(np.inf, value))
        return self.number(name, default)

    def _number(self, name: str, word: str) -> float:
        if not _NUMBER.fullmatch(word):
            raise self.error(f"a finite number in {name} of <{self.tag}>", repr(word), "Correct it.")
        value = float(word)
        if not abs(value) < LARGEST:
            raise self.error(
                f"numbers below {LARGEST:g} in {name} of <{self.tag}>", word, "Correct the value; units are SI."
            )
        return value


def parse_xml(data: str | bytes, file: str) -> Element:
    """Return the root element of an XML text of limited size and depth; reject document types, entities and xacro."""
    if len(data) > MOST_BYTES:
        raise RobotError(f"Expected XML of at most {MOST_BYTES >> 20} MiB in {file}, got {len(data)} bytes.")
    parser = expat.ParserCreate()
    top = Element("", {}, file, 1)
    open_elements = [top]
    count = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal count
        count += 1
        element = Element(tag, attributes, file, parser.CurrentLineNumber)
        if count > MOST_ELEMENTS:
            raise element.error(f"at most {MOST_ELEMENTS} elements", "more")
        if tag.startswith("xacro:"):
            raise element.error("a URDF", f"the xacro element <{tag}>", _EXPAND)
        if len(open_elements) > DEEPEST:
            raise element.error(f"elements nested at most {DEEPEST} deep", f"a deeper <{tag}>")
        open_elements[-1].children.append(element)
        open_elements.append(element)

    def document_type(name: str, *_: object) -> None:
        place = Element(name, {}, file, parser.CurrentLineNumber)
        raise place.error(
            "XML without a document type",
            "a <!DOCTYPE>",
            "Remove the document type declaration, because a URDF needs no entities.",
        )

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _tag: open_elements.pop()
    parser.StartDoctypeDeclHandler = document_type
    try:
        parser.Parse(data, True)
    except RobotError:  # a subclass of ValueError, with its message already complete
        raise
    except expat.ExpatError as error:
        reason = expat.ErrorString(error.code)
        raise RobotError(f"Expected XML in {file}, line {error.lineno}, got: {reason}.") from None
    except (ValueError, LookupError) as error:  # unknown or wrong encoding
        raise RobotError(f"Expected XML in {file}, line {parser.CurrentLineNumber}, got: {error}.") from None
    return top.children[0]
