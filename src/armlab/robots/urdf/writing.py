"""`Robot` to the text of a URDF that describes the same arm."""

from __future__ import annotations

import re
from collections.abc import Iterable
from xml.sax.saxutils import quoteattr

import numpy as np

from armlab.errors import RobotError
from armlab.lie import euler
from armlab.robots import inertia
from armlab.robots.build import RAMP_TIME
from armlab.robots.robot import Mesh, Robot

_NOT_IN_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def write_urdf(robot: Robot) -> str:
    """Return the URDF of a robot, with what URDF cannot say in a comment at the top."""
    _check_text(robot)
    links = ["mount", *(f"link_{i + 1}" for i in range(robot.n))]
    lines = [
        '<?xml version="1.0" encoding="utf-8"?>',
        _comment(robot),
        f"<robot name={quoteattr(robot.name)}>",
        '  <link name="base"/>',
        *_fixed("base", "mount", robot.T_base_mount, robot),
    ]
    for i, link in enumerate(links):
        lines += _link(robot, i, link)
        if i < robot.n:
            lines += _joint(robot, i, link, links[i + 1])
    lines += _fixed(links[-1], "flange", robot.links[-1], robot)
    lines += ['  <link name="flange"/>', *_fixed("flange", "tool", robot.T_flange_tool, robot)]
    return "\n".join([*lines, '  <link name="tool"/>', "</robot>", ""])


def _check_text(robot: Robot) -> None:
    files = [mesh.file for meshes in robot.meshes for mesh in meshes]
    for text in (robot.name, robot.source, *robot.ros_joint_names, *files):
        if _NOT_IN_XML.search(text):
            raise RobotError(f"Expected text that XML can hold in robot {robot.name!r}, got {text!r}. Rename it.")


def _comment(robot: Robot) -> str:
    """Return what URDF cannot hold, for the reader."""
    facts = {
        "gravity in the axes of base [m/s^2]": _numbers(robot.gravity),
        "home": _numbers(robot.q_home),
        "gears G, q = G q_motor": "; ".join(_numbers(row) for row in robot.coupling),
        "acceleration limits": _numbers(robot.qdd_max),
        "ABB's axes": " ".join(map(str, robot.abb_axes)),
        "side": robot.side,
        "limits of 1e9": "none" if _has_unlimited(robot) else "",
        "source": robot.source,
    }
    plain = {
        "gears G, q = G q_motor": np.array_equal(robot.coupling, np.eye(robot.n)),
        "acceleration limits": np.array_equal(robot.qdd_max, robot.qd_max / RAMP_TIME),
        "ABB's axes": robot.abb_axes == tuple(range(1, robot.n + 1)),
    }
    said = [f"{name}: {text}" for name, text in facts.items() if text and not plain.get(name)]
    text = "\n".join(["Written by armlab. URDF has no place for:", *said])
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


def _joint(robot: Robot, i: int, parent: str, child: str) -> list[str]:
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
        "  </joint>",
    ]


def _limit(value: float) -> str:
    """URDF has no word for infinity: 1e9 [rad, m, rad/s, m/s, N m, N] stands for it, and is read back as it."""
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
