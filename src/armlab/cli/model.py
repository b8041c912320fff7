"""``armlab model``: show a result file, optionally in the format of another program."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import App, Parameter

import armlab
from armlab.cli.support.output import print_json, result
from armlab.errors import ConfigError

if TYPE_CHECKING:
    import numpy as np

Form = Literal["text", "tf", "urdf", "easy_handeye", "moveit", "json"]

model = App(name="model", help="Show the result of a calibration or an identification.")


@model.command(help_epilogue="Example: armlab model show camera.toml --as tf --frame cam=camera_optical_frame")
def show(
    file: Path,
    *,
    form: Annotated[Form, Parameter(name="--as")] = "text",
    frame: list[str] | None = None,
) -> None:
    """Show a result (poses as matrix and quaternion, parameters with standard deviations), or export it.

    - tf: commands that publish the poses (ros2 run tf2_ros static_transform_publisher ...).
    - urdf: fixed joints with their origins.
    - easy_handeye: the YAML file that the easy_handeye publisher reads (the camera pose).
    - moveit: a ROS 2 launch file in YAML that publishes the camera pose, for use with move_group.
    - json: matrices, positions, quaternions w x y z.

    Parameters:
        file: Result of armlab calibrate or armlab identify.
        form: Output format.
        frame: Name of a frame in the other program, such as base=base_link, tool=tool0, cam=camera_optical_frame or
            marker=board. Repeat the option for each frame.
    """
    from armlab.models.files import load_statistics

    value = armlab.models.load(file)
    names = {key: text for key, _, text in (word.partition("=") for word in frame or ())}
    if bad := [f"{key}={text}" for key, text in names.items() if not key or not text]:
        raise ConfigError(f"Expected --frame FRAME=NAME, such as base=base_link, got {bad[0].rstrip('=')}.")
    poses = poses_of(value)
    if unknown := sorted(set(names) - {end for pair in poses for end in pair}):
        known = ", ".join(dict.fromkeys(end for pair in poses for end in pair)) or "none"
        raise ConfigError(f"Expected --frame with frames of {file}, {known}, got {', '.join(unknown)}.")
    named = {(names.get(a, a), names.get(b, b)): T for (a, b), T in poses.items()}
    if form == "json":
        print_json({"kind": type(value).__name__, "poses": [_numbers(a, b, T) for (a, b), T in named.items()]})
        return
    if form != "text" and not poses:
        raise ConfigError(
            f"Expected poses in {file} for --as {form}, got a {type(value).__name__}, which contains no poses. Export "
            "a torque model with armlab robot export ROBOT arm.urdf --model FILE."
        )
    if form in ("easy_handeye", "moveit"):
        result(_camera(form, value, named, names, file))
    elif form == "text":
        fit = [armlab.estimation.Fit.load(file).report()] if load_statistics(file) else []
        result("\n".join([type(value).__name__, *(_text(a, b, T) for (a, b), T in named.items()), *fit]))
    else:
        result("\n".join({"tf": _tf, "urdf": _urdf}[form](a, b, T) for (a, b), T in named.items()))


def poses_of(value: Any) -> dict[tuple[str, str], np.ndarray]:
    """Return the poses T_a_b of a result, keyed by their frames (a, b)."""
    import numpy as np

    from armlab.models.sensors import FRAMES

    if isinstance(value, armlab.models.HandEye):
        found = dict(zip(FRAMES[value.setup], (value.X, value.Y)))
    else:
        found = {name: getattr(value, name) for name in dir(type(value)) + list(vars(value)) if name.startswith("T_")}
    found = {name: T for name, T in found.items() if isinstance(T, np.ndarray) and T.shape == (4, 4)}
    return {(name.split("_")[1], name.split("_")[2]): T for name, T in found.items() if name.count("_") == 2}


def _position_and_turn(T: np.ndarray) -> tuple[list[float], list[float]]:
    """Return the position and the quaternion w x y z with w >= 0."""
    q = armlab.lie.quaternion.from_matrix(T[:3, :3])
    return (T[:3, 3] + 0.0).tolist(), (q * (1.0 if q[0] >= 0 else -1.0) + 0.0).tolist()


def _numbers(a: str, b: str, T: np.ndarray) -> dict[str, Any]:
    p, q = _position_and_turn(T)
    return {"parent": a, "child": b, "matrix": T.tolist(), "position": p, "quaternion_wxyz": q}


def _text(a: str, b: str, T: np.ndarray) -> str:
    import numpy as np

    p, (w, x, y, z) = _position_and_turn(T)
    with np.printoptions(precision=9, suppress=True):
        matrix = f"{b} in {a} [m]\n{T}\nposition {p[0]:.9g} {p[1]:.9g} {p[2]:.9g}"
    return f"{matrix}, quaternion w {w:.9g} x {x:.9g} y {y:.9g} z {z:.9g}"


def _tf(a: str, b: str, T: np.ndarray) -> str:
    options = " ".join(f"--{name} {value}" for name, value in _components(T).items())
    return f"ros2 run tf2_ros static_transform_publisher {options} --frame-id {a} --child-frame-id {b}"


def _components(T: np.ndarray) -> dict[str, str]:
    """Return the position and the quaternion as text, keyed by component: x, y, z, qx, qy, qz, qw."""
    p, (w, *xyz) = _position_and_turn(T)
    return {name: f"{value:.12g}" for name, value in zip(("x", "y", "z", "qx", "qy", "qz", "qw"), (*p, *xyz, w))}


def _urdf(a: str, b: str, T: np.ndarray) -> str:
    yaw, pitch, roll = armlab.lie.euler.to_rpy(T[:3, :3], "zyx").tolist()
    p, turn = (" ".join(f"{x:.12g}" for x in numbers) for numbers in (T[:3, 3], (roll, pitch, yaw)))
    return (
        f'<joint name="{a}_to_{b}" type="fixed">\n  <parent link="{a}"/>\n  <child link="{b}"/>\n'
        f'  <origin xyz="{p}" rpy="{turn}"/>\n</joint>'
    )


def _camera(form: str, value: Any, named: dict[tuple[str, str], np.ndarray], names: dict[str, str], file: Path) -> str:
    if not isinstance(value, armlab.models.HandEye):
        raise ConfigError(f"Expected a hand-eye calibration in {file} for --as {form}, got a {type(value).__name__}.")
    cam = names.get("cam", "cam")
    (a, b), T = next(((pair, T) for pair, T in named.items() if cam in pair))
    if form == "moveit":
        words = _tf(a, b, T).partition("static_transform_publisher ")[2]
        return (
            "launch:\n- node:\n    pkg: tf2_ros\n    exec: static_transform_publisher\n"
            f'    name: camera_link_broadcaster\n    args: "{words}"'
        )
    frames = {
        "robot_base_frame": names.get("base", "base"),
        "robot_effector_frame": names.get("tool", "tool"),
        "tracking_base_frame": cam,
        "tracking_marker_frame": names.get("marker", "marker"),
    }
    on_hand = "true" if value.setup == "eye_in_hand" else "false"
    parameters = {"eye_on_hand": on_hand, **frames}
    return "\n".join([
        "parameters:", *(f"  {key}: {name}" for key, name in parameters.items()),
        "transformation:", *(f"  {key}: {number}" for key, number in _components(T).items()),
    ])  # fmt: skip
