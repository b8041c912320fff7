"""``armlab calibrate``: calibrate cameras, sensors and arms from sample files."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

from cyclopts import App

import armlab
from armlab.cli.calibrate.arms import dual_arm, kinematics
from armlab.cli.calibrate.camera import hand_eye
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

calibrate: App = App(
    name="calibrate", help="Calibrate a camera, a force sensor, an arm or a line scanner from samples."
)
calibrate.command(
    kinematics,
    help_epilogue="Example: armlab calibrate kinematics irb2400 samples.csv -o found.toml --corrected mine.toml",
)
calibrate.command(
    dual_arm,
    name="dual-arm",
    help_epilogue="Example: armlab calibrate dual-arm yumi_left yumi_right samples.csv -o arms.toml",
)
calibrate.command(
    hand_eye,
    name="hand-eye",
    help_epilogue="Example: armlab calibrate hand-eye samples.csv --robust -o camera.toml",
)


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
    """Identify the axes, load and bias of a force sensor from readings at rest in many orientations.

    Each file contains the poses T_base_tool, as for hand-eye calibration, and either force1 ... force3 or wrench_raw1
    ... wrench_raw6 (with torques) in sensor axes [N, N m]. A MAT file contains force (N, 3) or wrench_raw (N, 6).

    Parameters:
        wrench: Name of the column with the readings; default: see above.
        gravity: Gravity vector in base axes [m/s^2]; default: pointing down.
        unknown_gravity: Also identify the direction of gravity.
        sign: 1 if the sensor measures the weight of its load, -1 if it measures the reaction.
        mass: Known mass of the load [kg].
        no_bias: Assume zero bias.
        noise: Known standard deviations of forces [N] and torques [N m].
        robust: Detect samples with contact and exclude them.
    """
    if gravity is not None and unknown_gravity:
        raise ConfigError("Expected --gravity or --unknown-gravity, got both. Omit one.")
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
    """Identify the axes and bias of a tool-mounted accelerometer from readings at rest in many orientations.

    Each file contains the poses T_base_tool, as for hand-eye calibration, and the acceleration acc1, acc2, acc3 in
    sensor axes [m/s^2], which points upwards at rest. A MAT file must contain acc (N, 3).

    Parameters:
        gravity: Gravity vector in base axes [m/s^2]; default: pointing down.
        scale: Also identify the scale of the readings.
        noise: Known standard deviation of a reading [m/s^2].
        robust: Detect samples in motion and exclude them.
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
    """Calibrate a tool-mounted line scanner from scans of flat plates.

    Each file contains the poses T_base_tool, as for hand-eye calibration, the lines scans1 ... scans4 (point x, y and
    direction x, y in the laser plane), and the plate number in the column plane.

    Parameters:
        noise: Known standard deviations of a point [m] and a line angle [rad].
        robust: Detect outliers among the scans and exclude them.
    """
    import numpy as np

    def parts(read: Samples) -> tuple[np.ndarray, ...]:
        return measured_rows(read, (tool_poses(read, robot), read.vectors("scans", (4,)), read.numbers("plane")))[:3]

    def fit(T_base_tool: np.ndarray, scans: np.ndarray, plane: np.ndarray) -> Any:
        labels = plane.astype(int)
        if not np.array_equal(labels, plane):
            raise LogError(f"Expected integers in the column plane, one per plate, got {plane[labels != plane][0]:g}.")
        return armlab.calibrate.fit_laser_plane(T_base_tool, scans, labels, noise=noise, robust=robust)

    return run_fit("laser", samples, parts, fit, wanted)
