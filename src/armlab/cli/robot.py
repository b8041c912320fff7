"""``armlab robot``: the robots of the library and of the user."""

from __future__ import annotations

from pathlib import Path

from cyclopts import App

__all__ = ["list_robots", "robot", "show"]

robot = App(name="robot", help="List and show robot descriptions.")


@robot.command(name="list")
def list_robots(*, json: bool = False) -> None:
    """List the robots of the library.

    Parameters
    ----------
    json
        Print JSON for scripts.
    """
    from armlab import robots
    from armlab.cli.output import aligned, print_json, result

    found = [robots.load(name) for name in robots.names()]
    if json:
        print_json([{"name": arm.name, "joints": arm.n, "side": arm.side, "hash": arm.hash} for arm in found])
        return
    rows = [("name", "joints", "robot: payload, reach")]
    rows += [(arm.name, str(arm.n), (arm.source.splitlines() or [""])[0].removeprefix("robot: ")) for arm in found]
    result(aligned(rows, right=(1,)))


@robot.command
def show(name: str, *, figure: Path | None = None, json: bool = False, force: bool = False) -> None:
    """Show one robot: joints, limits, gears, home pose; draw it if asked.

    Parameters
    ----------
    name
        Name in the library, or the path of a description.
    figure
        Draw the arm at home into this file; .png, .svg or .pdf.
    json
        Print JSON for scripts.
    force
        Replace an existing figure.
    """
    import numpy as np

    from armlab import robots
    from armlab.cli.output import FIGURES, aligned, check_output, note, print_json, result

    if figure is not None:
        check_output(figure, force, FIGURES)
    arm = robots.load(name)
    if figure is not None:
        from armlab import plots

        plots.robot(arm).figure.savefig(figure, dpi=150)
        note(f"figure: {figure}")
    if json:
        arrays = (
            "q_min",
            "q_max",
            "qd_max",
            "qdd_max",
            "q_home",
            "prismatic",
            "gravity",
            "coupling",
            "screws",
            "T_home",
        )
        words = ("name", "n", "joint_names", "abb_axes", "side", "source", "hash")
        print_json({key: getattr(arm, key) for key in words + arrays})
        return
    result(f"{arm.name}: {arm.n} joints, hash {arm.hash[:16]}\n{arm.source}")
    with np.printoptions(precision=6, suppress=True):
        result(f"gravity {arm.gravity} m/s^2 in base axes\nT_base_tool at q = 0\n{arm.T_home}")
    rows: list[tuple[str, ...]] = [
        ("joint", "kind", "from", "to", "speed", "home", "unit", "torque", "gear", "ABB axis")
    ]
    for i in range(arm.n):
        numbers = [f"{limits[i]:.4g}" for limits in (arm.q_min, arm.q_max, arm.qd_max, arm.q_home)]
        kind, unit = ("slides", "m") if arm.prismatic[i] else ("turns", "rad")
        gear = arm.coupling[i, i]
        words = (f"{arm.tau_max[i]:.4g}", f"{1 / gear:.5g}" if gear else "0", str(arm.abb_axes[i]))
        rows.append((arm.joint_names[i], kind, *numbers, unit, *words))
    result(aligned(rows, right=(2, 3, 4, 5, 7, 8, 9)))
    for i, k in np.argwhere(arm.coupling * (1 - np.eye(arm.n))):
        result(f"the motor of {arm.joint_names[k]} also moves {arm.joint_names[i]}: {arm.coupling[i, k]:.5g} rad/rad")
