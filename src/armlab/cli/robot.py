"""``armlab robot``: the robots of the library and of the user."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import App

import armlab
from armlab.cli.support.options import Force, Json
from armlab.cli.support.output import FIGURES, aligned, check_output, note, print_json, result, save_figure

if TYPE_CHECKING:
    from armlab.robots import Robot
    from armlab.robots.urdf import Tree

robot = App(name="robot", help="List, show and convert robot descriptions.")


@robot.command(name="list", help_epilogue="Example: armlab robot list")
def list_robots(*, json: Json = False) -> None:
    """List the robots of the library."""
    found = [armlab.robots.load(name) for name in armlab.robots.names()]
    if json:
        print_json([{"name": arm.name, "joints": arm.n, "side": arm.side, "hash": arm.hash} for arm in found])
        return
    rows = [("name", "joints", "robot: payload, reach")]
    rows += [(arm.name, str(arm.n), (arm.source.splitlines() or [""])[0].removeprefix("robot: ")) for arm in found]
    result(aligned(rows, right=(1,)))


@robot.command(help_epilogue="Example: armlab robot show yumi_left --figure yumi.png")
def show(
    name: str,
    *,
    base: str | None = None,
    tip: str | None = None,
    figure: Path | None = None,
    json: Json = False,
    force: Force = False,
) -> None:
    """Show one robot: joints, limits, gears, home pose; draw it if asked. Of a URDF, show the tree of links.

    Parameters:
        name: Name in the library, or the path of a description, .toml or .urdf.
        base: Link of a URDF that stands still: show the arm that begins there.
        tip: Link of a URDF that moves last: show the arm that ends there.
        figure: Draw the arm at home into this file; .png, .svg or .pdf.
    """
    if figure is not None:
        check_output(figure, force, FIGURES)
    elif Path(name).suffix == ".urdf" and base is None and tip is None:
        _show_tree(armlab.robots.urdf.read(name), json)
        return
    arm = armlab.robots.load(name, base=base, tip=tip)
    if figure is not None:
        save_figure(armlab.plots.robot(arm), figure)
        note(f"figure: {figure}")
    _show_arm(arm, json)


@robot.command(help_epilogue="Example: armlab robot convert arm.urdf arm.toml --tip tool0")
def convert(
    source: str, target: Path, *, base: str | None = None, tip: str | None = None, force: Force = False
) -> None:
    """Write a robot as TOML, which holds all of it, or as URDF for other programs.

    Parameters:
        source: Name in the library, or the path of a description, .toml or .urdf.
        target: File to write, .toml or .urdf.
        base: Link of a URDF that stands still; its root unless said.
        tip: Link of a URDF that moves last; need not be said where only one branch moves.
    """
    check_output(target, force, (".toml", ".urdf"))
    arm = armlab.robots.load(source, base=base, tip=tip)
    armlab.robots.save(arm, target)
    note(f"robot: {target}, joints {', '.join(arm.joint_names)}")


def _show_tree(tree: Tree, json: bool) -> None:
    if json:
        fields = ("name", "kind", "parent", "child", "q_min", "q_max", "qd_max", "tau_max", "line")
        joints = [
            {field: getattr(joint, field) for field in fields}
            | {"follows": asdict(joint.follows) if joint.follows else None}
            for joint in tree.joints
        ]
        links = [link.name for link in tree.links]
        print_json({"name": tree.name, "root": tree.root, "tips": tree.tips, "links": links, "joints": joints})
        return
    result(f"{tree.name}: {len(tree.links)} links, {len(tree.joints)} joints")
    rows = [("link", "joint above", "kind", "from", "to", "unit", "follows"), (tree.root, *[""] * 6)]
    waiting = [(joint, 1) for joint in reversed(tree.child_joints[tree.root])]
    while waiting:
        joint, depth = waiting.pop()
        limited = joint.kind in ("revolute", "prismatic")
        limits = [f"{limit:.4g}" if limited else "" for limit in (joint.q_min, joint.q_max)]
        unit = ("m" if joint.kind == "prismatic" else "rad") if limited else ""
        follows = joint.follows
        rule = f"{follows.multiplier:.4g} {follows.joint} {follows.offset:+.4g}" if follows else ""
        rows.append(("  " * depth + joint.child, joint.name, joint.kind, *limits, unit, rule))
        waiting += [(below, depth + 1) for below in reversed(tree.child_joints[joint.child])]
    result(aligned(rows, right=(3, 4)))
    if tree.tips:
        note(f"One arm of it: --tip {' or '.join(tree.tips)}.")


def _show_arm(arm: Robot, json: bool) -> None:
    import numpy as np

    if json:
        words = ("name", "n", "joint_names", "abb_axes", "side", "source", "hash")
        limits = ("q_min", "q_max", "qd_max", "qdd_max", "tau_max", "q_home")
        arrays = ("prismatic", "gravity", "coupling", "inertias", "screws", "T_home")
        print_json({key: getattr(arm, key) for key in words + limits + arrays})
        return
    result(f"{arm.name}: {arm.n} joints, hash {arm.hash[:16]}\n{arm.source}")
    with np.printoptions(precision=6, suppress=True):
        result(f"gravity {arm.gravity} m/s^2 in base axes\nT_base_tool at q = 0\n{arm.T_home}")
    titles = ("joint", "kind", "from", "to", "speed", "home", "unit", "torque", "mass", "gear", "ABB axis")
    rows: list[tuple[str, ...]] = [titles]
    for i in range(arm.n):
        numbers = [f"{limits[i]:.4g}" for limits in (arm.q_min, arm.q_max, arm.qd_max, arm.q_home)]
        kind, unit = ("slides", "m") if arm.prismatic[i] else ("turns", "rad")
        mass = "-" if arm.inertias is None else f"{arm.inertias[i, 0]:.4g}"
        gear = f"{1 / arm.coupling[i, i]:.5g}" if arm.coupling[i, i] else "0"
        words = (f"{arm.tau_max[i]:.4g}", mass, gear, str(arm.abb_axes[i]))
        rows.append((arm.joint_names[i], kind, *numbers, unit, *words))
    result(aligned(rows, right=(2, 3, 4, 5, 7, 8, 9, 10)))
    for i, k in np.argwhere(arm.coupling * (1 - np.eye(arm.n))):
        result(f"the motor of {arm.joint_names[k]} also moves {arm.joint_names[i]}: {arm.coupling[i, k]:.5g} rad/rad")
