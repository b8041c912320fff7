"""Write a `Robot` as URDF."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from xml.sax.saxutils import quoteattr

import numpy as np

from armlab.errors import RobotError
from armlab.lie import euler
from armlab.robots import inertia
from armlab.robots.build import RAMP_TIME
from armlab.robots.robot import Mesh, Robot

_NOT_IN_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def write_urdf(
    robot: Robot, friction: Sequence[tuple[float, float]] = (), more: Mapping[str, str] | None = None, prefix: str = ""
) -> str:
    """Return the URDF of a robot; a comment at the top contains `more` and the fields that URDF cannot express.

    `friction`: damping [N m s/rad] and Coulomb friction [N m] of each joint; default: from the robot's
    drives. `prefix` is prepended to the name of each link.
    """
    _check_text(robot)
    drives = dict(robot.drives)
    if not friction and ("damping" in drives or "friction" in drives):
        none = (0.0,) * robot.n
        friction = list(zip(drives.get("damping", none), drives.get("friction", none)))
    base, flange, tool = (f"{prefix}{name}" for name in ("base", "flange", "tool"))
    links = [f"{prefix}mount", *(f"{prefix}link_{i + 1}" for i in range(robot.n))]
    lines = [
        '<?xml version="1.0" encoding="utf-8"?>',
        _comment(robot, more or {}),
        f"<robot name={quoteattr(robot.name)}>",
        f"  <link name={quoteattr(base)}/>",
        *_fixed(base, links[0], robot.T_base_mount, robot),
    ]
    for i, link in enumerate(links):
        lines += _link(robot, i, link)
        if i < robot.n:
            lines += _joint(robot, i, link, links[i + 1], friction[i] if friction else None)
    lines += _fixed(links[-1], flange, robot.links[-1], robot)
    lines += [f"  <link name={quoteattr(flange)}/>", *_fixed(flange, tool, robot.T_flange_tool, robot)]
    return "\n".join([*lines, f"  <link name={quoteattr(tool)}/>", "</robot>", ""])


def _check_text(robot: Robot) -> None:
    files = [mesh.file for meshes in robot.meshes for mesh in meshes]
    for text in (robot.name, robot.source, *robot.ros_joint_names, *files):
        if _NOT_IN_XML.search(text):
            raise RobotError(
                f"Expected text that XML can represent in robot {robot.name!r}, got {text!r}. Correct the text."
            )


def _comment(robot: Robot, more: Mapping[str, str]) -> str:
    """Return the comment with the fields that URDF cannot express."""
    facts = {
        "gravity in the axes of base [m/s^2]": _numbers(robot.gravity),
        "home": _numbers(robot.q_home),
        "gears G, q = G q_motor": "; ".join(_numbers(row) for row in robot.coupling),
        "acceleration limits": _numbers(robot.qdd_max),
        "ABB's axes": " ".join(map(str, robot.abb_axes)),
        "side": robot.side,
        "limits of 1e9": "none" if _has_unlimited(robot) else "",
        **{f"drives: {key}": _numbers(values) for key, values in robot.drives if key not in ("damping", "friction")},
        "source": robot.source,
        **more,
    }
    plain = {
        "gears G, q = G q_motor": np.array_equal(robot.coupling, np.eye(robot.n)),
        "acceleration limits": np.array_equal(robot.qdd_max, robot.qd_max / RAMP_TIME),
        "ABB's axes": robot.abb_axes == tuple(range(1, robot.n + 1)),
    }
    said = [f"{name}: {text}" for name, text in facts.items() if text and not plain.get(name)]
    text = "\n".join(["Written by armlab. Fields that URDF cannot express:", *said])
    while "--" in text:  # not allowed inside a comment
        text = text.replace("--", "- -")
    return f"<!-- {text} -->"


def _has_unlimited(robot: Robot) -> bool:
    return not np.isfinite([robot.qd_max, robot.tau_max]).all() or any(
        _kind(robot, i) != "continuous" and not np.isfinite([robot.q_min[i], robot.q_max[i]]).all()
        for i in range(robot.n)
    )


def _kind(robot: Robot, i: int) -> str:
    if robot.prismatic[i]:
        return "prismatic"
    return "continuous" if np.isinf([robot.q_min[i], robot.q_max[i]]).all() else "revolute"


def _joint(robot: Robot, i: int, parent: str, child: str, friction: tuple[float, float] | None) -> list[str]:
    kind = _kind(robot, i)
    limits = {"effort": robot.tau_max[i], "velocity": robot.qd_max[i]}
    if kind != "continuous":
        limits = {"lower": robot.q_min[i], "upper": robot.q_max[i]} | limits
    words = " ".join(f'{name}="{_limit(value)}"' for name, value in limits.items())
    return [
        f"  <joint name={quoteattr(robot.ros_joint_names[i])} type={quoteattr(kind)}>",
        f'    <parent link="{parent}"/>',
        f'    <child link="{child}"/>',
        f"    {_origin(robot.links[i])}",
        '    <axis xyz="0 0 1"/>',
        f"    <limit {words}/>",
        *([f'    <dynamics damping="{_number(friction[0])}" friction="{_number(friction[1])}"/>'] if friction else []),
        "  </joint>",
    ]


def _limit(value: float) -> str:
    """Return a limit as text; infinity becomes 1e9 [rad, m, rad/s, m/s, N m, N], which the reader converts back to
    infinity."""
    return _number(value) if np.isfinite(value) else ("1e9" if value > 0 else "-1e9")


def _fixed(parent: str, child: str, T_parent_child: np.ndarray, robot: Robot) -> list[str]:
    name = f"{parent}_to_{child}"
    while name in robot.ros_joint_names:
        name += "_"
    return [
        f'  <joint name={quoteattr(name)} type="fixed">',
        f'    <parent link="{parent}"/>',
        f'    <child link="{child}"/>',
        f"    {_origin(T_parent_child)}",
        "  </joint>",
    ]


def _link(robot: Robot, i: int, name: str) -> list[str]:
    inside = []
    if i and robot.inertias is not None and robot.inertias[i - 1, 0] > 0:
        body = inertia.to_body(robot.inertias[i - 1])
        moments = zip(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), body.inertia[np.triu_indices(3)].tolist())
        inside += [
            "    <inertial>",
            f'      <origin xyz="{_numbers(body.centre)}" rpy="0 0 0"/>',
            f'      <mass value="{_number(float(body.mass))}"/>',
            "      <inertia " + " ".join(f'{key}="{_number(value)}"' for key, value in moments) + "/>",
            "    </inertial>",
        ]
    for mesh in robot.meshes[i] if robot.meshes else ():
        inside += _mesh(mesh)
    return [f'  <link name="{name}">', *inside, "  </link>"] if inside else [f'  <link name="{name}"/>']


def _mesh(mesh: Mesh) -> list[str]:
    return [
        f"    <{mesh.kind}>",
        f"      {_origin(mesh.T_link_mesh)}",
        f'      <geometry><mesh filename={quoteattr(mesh.file)} scale="{_numbers(mesh.scale)}"/></geometry>',
        f"    </{mesh.kind}>",
    ]


def _origin(T: np.ndarray) -> str:
    yaw, pitch, roll = euler.to_rpy(T[:3, :3], "zyx")
    return f'<origin xyz="{_numbers(T[:3, 3])}" rpy="{_numbers((roll, pitch, yaw))}"/>'


def _numbers(values: Iterable[float]) -> str:
    return " ".join(map(_number, values))


def _number(value: float) -> str:
    return repr(float(value) + 0.0).removesuffix(".0")  # + 0.0 turns -0.0 into 0.0
