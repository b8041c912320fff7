"""``armlab robot``: library robots and user-defined robots."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import App

import armlab
from armlab.cli.support.options import Force, Json, is_arm_chosen, load_robot
from armlab.cli.support.output import FIGURES, aligned, check_output, note, print_json, result, save_figure
from armlab.errors import ConfigError, ModelMismatchError

if TYPE_CHECKING:
    from armlab.models import TorqueModel
    from armlab.robots import Robot
    from armlab.robots.urdf import Tree

robot: App = App(name="robot", help="List, show, convert and export robot descriptions.")


@robot.command(name="list", help_epilogue="Example: armlab robot list")
def list_robots(*, json: Json = False) -> None:
    """List the robots in the library."""
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
    figure: Path | None = None,
    json: Json = False,
    force: Force = False,
) -> None:
    """Show a robot (joints, limits, gears, home posture), and optionally draw it. For a URDF, show the tree of links.

    With --base, --tip or --lock, show the selected arm of the URDF instead.

    Parameters:
        name: Name in the library, or the path of a description, .toml or .urdf.
        figure: Save a drawing of the arm in its home posture to this .png, .svg or .pdf file.
    """
    from armlab.robots.files import description

    if figure is not None:
        check_output(figure, force, FIGURES)
    elif not is_arm_chosen() and (path := description(name)) is not None and path.suffix == ".urdf":
        _show_tree(armlab.robots.urdf.read(path), json)
        return
    arm = load_robot(name)
    if figure is not None:
        save_figure(armlab.plots.robot(arm), figure)
        note(f"figure: {figure}")
    _show_arm(arm, json)


@robot.command(help_epilogue="Example: armlab robot convert arm.urdf arm.toml --tip tool0")
def convert(source: str, target: Path, *, force: Force = False) -> None:
    """Convert a robot losslessly to TOML, or to URDF for other programs.

    For a URDF, --base, --tip and --lock select the arm.

    Parameters:
        source: Name in the library, or the path of a description, .toml or .urdf.
        target: File to write, .toml or .urdf.
    """
    check_output(target, force, (".toml", ".urdf"))
    arm = load_robot(source)
    armlab.robots.save(arm, target)
    note(f"robot: {target}, joints {', '.join(arm.joint_names)}")


@robot.command(
    help_epilogue="Example: armlab robot export yumi_left yumi.urdf --model model.toml --calibrated arm.toml"
)
def export(
    name: str,
    target: Path,
    *,
    calibrated: Path | None = None,
    model: Path | None = None,
    force: Force = False,
) -> None:
    """Export a robot with its calibrated and identified parameters for other programs.

    Inertias become physically consistent <inertial> elements; unidentifiable parameters are chosen freely and do not
    affect the torques. Viscous and Coulomb friction become <dynamics>. Rotor inertias (armature in Pinocchio and
    MuJoCo) and other friction terms, which URDF cannot express, are written as a comment at the top.

    Parameters:
        name: Name in the library, or the path of a description, .toml or .urdf.
        target: File to write, .urdf or .toml (without friction).
        calibrated: Result of armlab calibrate kinematics or dual-arm for this arm.
        model: Model file written by armlab identify.
    """
    from dataclasses import replace

    from armlab._files import whole_file
    from armlab.identify.consistency import bodies_of
    from armlab.robots.urdf.writing import write_urdf

    check_output(target, force, (".toml", ".urdf"))
    if calibrated is None and model is None:
        raise ConfigError("Expected --calibrated FILE, --model FILE or both, got neither. See armlab robot convert.")
    arm = load_robot(name)
    found = arm if calibrated is None else _calibrated(arm, calibrated)
    if model is None:
        armlab.robots.save(found, target)
    else:
        known = armlab.models.load(model, "torque_model")
        links, rotor, away = bodies_of(known, arm)
        found, known = replace(found, inertias=links), replace(known, rotor=rotor)
        if away > 0.0:
            note(
                "No physically consistent inertias reproduce the torques "
                "of this model: the exported base parameters differ from those of the "
                f"model by {away:.2g} standard deviations in total. To reduce the "
                "uncertainty of the parameters, record a log with a richer motion."
            )
        if target.suffix == ".toml":
            armlab.robots.save(found, target)
        else:
            friction = known.friction
            dry = 0.5 * (friction.coulomb_pos + friction.coulomb_neg)
            with whole_file(target) as part:
                text = write_urdf(found, list(zip(friction.viscous.tolist(), dry.tolist())), _not_in_urdf(known))
                part.write_text(text, encoding="utf-8")
    note(f"robot: {target}, joints {', '.join(found.joint_names)}")


def _calibrated(arm: Robot, path: Path) -> Robot:
    found = armlab.models.load(path)
    parts = [getattr(found, name) for name in ("arm_a", "arm_b") if hasattr(found, name)] or [found]
    for part in parts:
        if isinstance(part, armlab.models.KinematicCorrection) and (len(parts) == 1 or part.robot_hash == arm.hash):
            part.check_robot(arm)
            return part.robot
    raise ModelMismatchError(
        f"Expected a calibration of {arm.name!r} in {path}, got "
        f"{type(found).__name__}. Create a calibration with armlab calibrate kinematics."
    )


def _not_in_urdf(model: TorqueModel) -> dict[str, str]:
    """Return the parts of a model that URDF cannot express."""
    friction = model.friction
    told = {
        "rotor inertia on the joint side [kg m^2]": model.rotor,
        "ratio of measured to true torque": model.gains,
        "Coulomb friction, positive motion [N m]": friction.coulomb_pos,
        "Coulomb friction, negative motion [N m]": friction.coulomb_neg,
        "constant torque [N m]": friction.offset,
        "Stribeck torque [N m]": friction.stribeck,
        "torque per square root of velocity [N m sqrt(s/rad)]": friction.root,
        "friction torque per unit of load torque": friction.load,
    }
    return {name: " ".join(f"{x:.9g}" for x in values) for name, values in told.items()}


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
    rows = [("link", "parent joint", "kind", "from", "to", "unit", "follows"), (tree.root, *[""] * 6)]
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
        note(f"To show one arm, add --tip {' or '.join(tree.tips)}.")


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
