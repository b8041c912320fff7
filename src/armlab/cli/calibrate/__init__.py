"""``armlab calibrate``: camera, sensors, arms from files of samples."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from cyclopts import App

import armlab
from armlab.cli.calibrate.arms import dual_arm, kinematics
from armlab.cli.calibrate.samples import (
    NOTHING,
    ArmOfPoses,
    Deviations,
    SampleFile,
    Wanted,
    measured_rows,
    noise_of,
    run_fit,
    tool_poses,
)
from armlab.errors import ConfigError, LogError

if TYPE_CHECKING:
    import numpy as np

    from armlab.cli.calibrate.samples import Samples

__all__ = []


calibrate = App(name="calibrate", help="Calibrate a camera, a force sensor, an arm or a line scanner from samples.")
calibrate.command(
    kinematics,
    help_epilogue="Example: armlab calibrate kinematics irb2400 samples.csv -o found.toml --corrected mine.toml",
)
calibrate.command(
    dual_arm,
    name="dual-arm",
    help_epilogue="Example: armlab calibrate dual-arm yumi_left yumi_right samples.csv -o arms.toml",
)


@calibrate.command(
    name="hand-eye", help_epilogue="Example: armlab calibrate hand-eye samples.csv --robust -o camera.toml"
)
def hand_eye(
    *samples: SampleFile,
    marker: Path | None = None,
    setup: Literal["eye_to_hand", "eye_in_hand"] = "eye_to_hand",
    robot: ArmOfPoses = None,
    noise: Deviations = None,
    noise_robot: tuple[float, float] | None = None,
    robust: bool = False,
    wanted: Wanted = NOTHING,
) -> int:
    """Find camera and marker from poses of the robot and of the marker, or from points of the marker.

    A file has the poses T_base_tool and T_cam_marker, one sample per row: as T_cam_marker_x, _y, _z [m or mm in the
    header], _qw, _qx, _qy, _qz; as T_cam_marker1_1 ... T_cam_marker4_4; in a MAT file as (N, 4, 4) or (4, 4, N).
    Instead of T_cam_marker it may have points of the marker in camera axes, p_cam1_x, p_cam1_y, p_cam1_z, p_cam2_x ...;
    in a MAT file p_cam (N, K, 3). A point that was not seen is empty.

    Parameters:
        marker: File with the places of the points on the marker, a row each: marker_x, marker_y, marker_z [m or mm in
            the header]. They are found when left out.
        setup: eye_to_hand: the camera stands, the marker is on the tool. eye_in_hand: the other way round.
        noise: Deviations of the camera where they are known: m and rad of poses, m of points.
        noise_robot: Deviations of the poses of the robot, m and rad, where it is not exact: samples cannot tell them.
        robust: Find wrong samples and leave them out.
    """
    import numpy as np

    from armlab.cli.calibrate.samples import read_samples

    kinds: set[bool] = set()
    known = None if marker is None else read_samples(marker)
    body = None if known is None else known.vectors("marker", (3,))

    def parts(read: Samples) -> tuple[np.ndarray, ...]:
        kinds.add("T_cam_marker" in read and known is None)
        seen = read.poses("T_cam_marker") if True in kinds else read.points("p_cam")
        return measured_rows(read, (tool_poses(read, robot), seen))[:2]

    def fit(T_base_tool: np.ndarray, seen: np.ndarray) -> Any:
        told: dict[str, Any] = {"setup": setup, "noise": noise_of(noise), "noise_robot": noise_robot, "robust": robust}
        if True in kinds:
            return armlab.calibrate.fit_hand_eye(T_base_tool, seen, **told)
        return armlab.calibrate.fit_hand_eye_points(
            T_base_tool, seen, marker=body, visible=np.isfinite(seen).all(axis=2), **told
        )

    return run_fit("hand-eye", samples, parts, fit, wanted, () if known is None else (known.source,))


@calibrate.command(name="force-sensor", help_epilogue="Example: armlab calibrate force-sensor rest.csv -o sensor.toml")
def force_sensor(
    *samples: SampleFile,
    robot: ArmOfPoses = None,
    wrench: str | None = None,
    gravity: tuple[float, float, float] | None = None,
    unknown_gravity: bool = False,
    sign: Literal[1, -1] = 1,
    mass: float | None = None,
    no_bias: bool = False,
    noise: Deviations = None,
    robust: bool = False,
    wanted: Wanted = NOTHING,
) -> int:
    """Find axes, load and bias of a force sensor from readings at rest in many orientations.

    A file has the poses T_base_tool, as for hand-eye, and force1 ... force3, or wrench_raw1 ... wrench_raw6 with
    torques, N and N m, sensor axes; in a MAT file force (N, 3) or wrench_raw (N, 6).

    Parameters:
        wrench: Name of the readings in the file, where it is another one.
        gravity: In base axes, m/s^2; downwards when left out.
        unknown_gravity: Find the direction of gravity too.
        sign: 1 when the sensor reads the weight that hangs on it, -1 when it reads the reaction.
        mass: What hangs on the sensor, kg, where it is known.
        no_bias: Readings without weight are zero.
        noise: Deviation of forces, N, and of torques, N m, where they are known.
        robust: Find samples with contact and leave them out.
    """
    if gravity is not None and unknown_gravity:
        raise ConfigError("Expected --gravity or --unknown-gravity, got both. Leave one out.")
    told = "unknown" if unknown_gravity else gravity
    more: dict[str, Any] = {} if told is None else {"gravity": told}

    def parts(read: Samples) -> tuple[np.ndarray, ...]:
        name = wrench or ("force" if "force" in read else "wrench_raw")
        return measured_rows(read, (tool_poses(read, robot), read.vectors(name, (3, 6))))[:2]

    def fit(T_base_tool: np.ndarray, reading: np.ndarray) -> Any:
        return armlab.calibrate.fit_force_sensor(
            T_base_tool, reading, sign=sign, bias=not no_bias, mass=mass, noise=noise_of(noise), robust=robust, **more
        )

    return run_fit("force sensor", samples, parts, fit, wanted)


@calibrate.command(help_epilogue="Example: armlab calibrate accelerometer rest.csv --scale -o accelerometer.toml")
def accelerometer(
    *samples: SampleFile,
    robot: ArmOfPoses = None,
    gravity: tuple[float, float, float] | None = None,
    scale: bool = False,
    noise: float | None = None,
    robust: bool = False,
    wanted: Wanted = NOTHING,
) -> int:
    """Find axes and bias of an accelerometer on the tool from readings at rest in many orientations.

    A file has the poses T_base_tool, as for hand-eye, and acc1, acc2, acc3, m/s^2, sensor axes, upwards at rest; in a
    MAT file acc (N, 3).

    Parameters:
        gravity: In base axes, m/s^2; downwards when left out.
        scale: Find the scale of the readings too.
        noise: Deviation of a reading, m/s^2, where it is known.
        robust: Find samples that were not at rest and leave them out.
    """
    more: dict[str, Any] = {} if gravity is None else {"gravity": gravity}

    def parts(read: Samples) -> tuple[np.ndarray, ...]:
        return measured_rows(read, (tool_poses(read, robot), read.vectors("acc", (3,))))[:2]

    def fit(T_base_tool: np.ndarray, acc: np.ndarray) -> Any:
        return armlab.calibrate.fit_accelerometer(T_base_tool, acc, scale=scale, noise=noise, robust=robust, **more)

    return run_fit("accelerometer", samples, parts, fit, wanted)


@calibrate.command(help_epilogue="Example: armlab calibrate laser scans.csv --robust -o scanner.toml")
def laser(
    *samples: SampleFile,
    robot: ArmOfPoses = None,
    noise: tuple[float, float] | None = None,
    robust: bool = False,
    wanted: Wanted = NOTHING,
) -> int:
    """Find a line scanner on the tool from scans of flat plates.

    A file has the poses T_base_tool, as for hand-eye, the lines scans1 ... scans4 (point x, y, direction x, y in the
    laser plane), and plane, the number of the plate.

    Parameters:
        noise: Deviations of a point, m, and of the angle of a line, rad, where they are known.
        robust: Find wrong scans and leave them out.
    """
    import numpy as np

    def parts(read: Samples) -> tuple[np.ndarray, ...]:
        return measured_rows(read, (tool_poses(read, robot), read.vectors("scans", (4,)), read.numbers("plane")))[:3]

    def fit(T_base_tool: np.ndarray, scans: np.ndarray, plane: np.ndarray) -> Any:
        labels = plane.astype(int)
        if not np.array_equal(labels, plane):
            raise LogError(f"Expected whole numbers in plane, one per plate, got {plane[labels != plane][0]:g}.")
        return armlab.calibrate.fit_laser_plane(T_base_tool, scans, labels, noise=noise, robust=robust)

    return run_fit("laser", samples, parts, fit, wanted)
