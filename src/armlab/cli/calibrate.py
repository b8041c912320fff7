"""``armlab calibrate``: camera, force sensor, arm or line scanner from files of samples."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import App, Parameter

from armlab.cli.calibrate_report import Wanted

if TYPE_CHECKING:
    from armlab.cli.calibrate_input import Samples

__all__ = ["calibrate", "force_sensor", "hand_eye", "kinematics", "laser"]

calibrate = App(name="calibrate", help="Calibrate a camera, a force sensor, an arm or a line scanner from samples.")

_flat = Parameter(name="*")
_several = Parameter(consume_multiple=True)


@calibrate.command(name="hand-eye")
def hand_eye(
    samples: Path,
    *,
    setup: Literal["eye_to_hand", "eye_in_hand"] = "eye_to_hand",
    robot: str | None = None,
    noise: tuple[float, float] | None = None,
    robust: bool = False,
    wanted: Annotated[Wanted, _flat] = Wanted(),  # noqa: B008 - frozen
) -> int:
    """Find camera and marker from poses of the robot and of the marker.

    The file has the poses T_base_tool and T_cam_marker, one sample per row: as T_cam_marker_x, _y, _z [m or mm in the
    header], _qw, _qx, _qy, _qz; as T_cam_marker1_1 ... T_cam_marker4_4; in a MAT file as (N, 4, 4) or (4, 4, N).

    Parameters
    ----------
    samples : Path
        CSV, MAT or MCAP.
    setup : str
        eye_to_hand: the camera stands, the marker is on the tool. eye_in_hand: the other way round.
    robot : str
        Name or file of the arm: its joint positions q give T_base_tool.
    noise : tuple
        Deviations of the camera, m and rad, where they are known.
    robust : bool
        Find wrong samples and leave them out.
    wanted : Wanted
        What to write.
    """
    from armlab.calibrate import fit_hand_eye

    def fit(read: Samples) -> Any:
        T_base_tool, T_cam_marker = _measured(read, _tool(read, robot), read.poses("T_cam_marker"))
        return fit_hand_eye(T_base_tool, T_cam_marker, setup=setup, noise=noise, robust=robust)

    return _run("hand-eye", samples, fit, wanted)


@calibrate.command(name="force-sensor")
def force_sensor(
    samples: Path,
    *,
    robot: str | None = None,
    wrench: str | None = None,
    gravity: tuple[float, float, float] | None = None,
    unknown_gravity: bool = False,
    sign: Literal[1, -1] = 1,
    mass: float | None = None,
    no_bias: bool = False,
    noise: Annotated[list[float] | None, _several] = None,
    robust: bool = False,
    wanted: Annotated[Wanted, _flat] = Wanted(),  # noqa: B008 - frozen
) -> int:
    """Find axes, load and bias of a force sensor from readings at rest in many orientations.

    The file has the poses T_base_tool, as for hand-eye, and force1 ... force3, or wrench_raw1 ... wrench_raw6 with
    torques, N and N m, sensor axes; in a MAT file force (N, 3) or wrench_raw (N, 6).

    Parameters
    ----------
    samples : Path
        CSV, MAT or MCAP.
    robot : str
        Name or file of the arm: its joint positions q give T_base_tool.
    wrench : str
        Name of the readings in the file, where it is another one.
    gravity : tuple
        In base axes, m/s^2; downwards when left out.
    unknown_gravity : bool
        Find the direction of gravity too.
    sign : int
        1 when the sensor reads the weight that hangs on it, -1 when it reads the reaction.
    mass : float
        What hangs on the sensor, kg, where it is known.
    no_bias : bool
        Readings without weight are zero.
    noise : list
        Deviation of forces, N, and of torques, N m, where they are known.
    robust : bool
        Find samples with contact and leave them out.
    wanted : Wanted
        What to write.
    """
    from armlab.calibrate import fit_force_sensor
    from armlab.errors import ConfigError

    if gravity is not None and unknown_gravity:
        raise ConfigError("Expected --gravity or --unknown-gravity, got both. Leave one out.")
    told = "unknown" if unknown_gravity else gravity
    more: dict[str, Any] = {} if told is None else {"gravity": told}

    def fit(read: Samples) -> Any:
        name = wrench or ("force" if "force" in read else "wrench_raw")
        T_base_tool, reading = _measured(read, _tool(read, robot), read.vectors(name, (3, 6)))
        return fit_force_sensor(
            T_base_tool, reading, sign=sign, bias=not no_bias, mass=mass, noise=_noise(noise), robust=robust, **more
        )

    return _run("force sensor", samples, fit, wanted)


@calibrate.command
def kinematics(
    robot: str,
    samples: Path,
    *,
    noise: Annotated[list[float] | None, _several] = None,
    free: Literal["all", "offsets", "base_tool"] = "all",
    harmonics: Annotated[list[int] | None, _several] = None,
    weak: Literal["refuse", "prior"] = "refuse",
    robust: bool = False,
    corrected: Path | None = None,
    wanted: Annotated[Wanted, _flat] = Wanted(),  # noqa: B008 - frozen
) -> int:
    """Calibrate an arm from joint positions and measured poses or positions of its tool.

    The file has q1 ... qn, and the measured pose, as for hand-eye, or position1 ... position3.

    Parameters
    ----------
    robot : str
        Name in the library, or a robot file: the nominal arm.
    samples : Path
        CSV, MAT or MCAP.
    noise : list
        Deviations of a pose, m and rad, or of a position, m, where they are known.
    free : str
        What may be wrong: all; offsets: joint offsets, base and tool; base_tool.
    harmonics : list
        Orders of joint errors that repeat with the turn, such as 1 2.
    weak : str
        What the samples do not tell: refuse, or hold it by a prior.
    robust : bool
        Find wrong samples and leave them out.
    corrected : Path
        Also write the corrected arm as a robot file, ends in .toml.
    wanted : Wanted
        What to write.
    """
    from armlab import robots
    from armlab.calibrate import fit_kinematics
    from armlab.cli.output import check_output, note
    from armlab.errors import LogError

    arm = robots.load(robot)
    if corrected is not None:
        check_output(corrected, wanted.force, (".toml",))

    def fit(read: Samples) -> Any:
        if ("pose" in read) == ("position" in read):
            raise LogError(f"Expected either pose or position in {read.path}, got {', '.join(read.values)}.")
        kind = "pose" if "pose" in read else "position"
        measured = read.poses("pose") if kind == "pose" else read.vectors("position", (3,))
        q, measured = _measured(read, read.vectors("q", (arm.n,)), measured)
        told: dict[str, Any] = {kind: measured, "free": free, "weak": weak, "robust": robust}
        found = fit_kinematics(arm, q, noise=_noise(noise), harmonics=tuple(harmonics or ()), **told)
        if corrected is not None:
            robots.save(found.value.robot, corrected)
            note(f"robot: {corrected}")
        return found

    return _run("kinematics", samples, fit, wanted)


@calibrate.command
def laser(
    samples: Path,
    *,
    robot: str | None = None,
    noise: tuple[float, float] | None = None,
    robust: bool = False,
    wanted: Annotated[Wanted, _flat] = Wanted(),  # noqa: B008 - frozen
) -> int:
    """Find a line scanner on the tool from scans of flat plates.

    The file has the poses T_base_tool, as for hand-eye, the lines scans1 ... scans4 (point x, y, direction x, y in the
    laser plane), and plane, the number of the plate.

    Parameters
    ----------
    samples : Path
        CSV, MAT or MCAP.
    robot : str
        Name or file of the arm: its joint positions q give T_base_tool.
    noise : tuple
        Deviations of a point, m, and of the angle of a line, rad, where they are known.
    robust : bool
        Find wrong scans and leave them out.
    wanted : Wanted
        What to write.
    """
    from armlab.calibrate import fit_laser_plane

    def fit(read: Samples) -> Any:
        parts = _measured(read, _tool(read, robot), read.vectors("scans", (4,)), read.numbers("plane"))
        T_base_tool, scans, plane = parts
        return fit_laser_plane(T_base_tool, scans, plane.astype(int), noise=noise, robust=robust)

    return _run("laser", samples, fit, wanted)


def _run(job: str, path: Path, fit: Callable[[Samples], Any], wanted: Wanted) -> int:
    """Read, fit, and write what is wanted."""
    from armlab.cli.calibrate_input import read_samples

    wanted.check()
    read = read_samples(path)
    wanted.write(job, fit(read), read.source)
    return 0


def _noise(values: list[float] | None) -> Any:
    return None if values is None else values[0] if len(values) == 1 else tuple(values)


def _tool(read: Samples, robot: str | None) -> Any:
    """Return T_base_tool as it was recorded, or of the joint positions of the arm."""
    if robot is None:
        return read.poses("T_base_tool")
    from armlab import robots
    from armlab.kinematics import forward

    arm = robots.load(robot)
    return forward(arm, read.vectors("q", (arm.n,)))


def _measured(read: Samples, *parts: Any) -> tuple[Any, ...]:
    """Return the rows in which every part was measured; recordings have rows between the samples of a sensor."""
    import numpy as np

    from armlab.cli.output import note
    from armlab.errors import LogError

    lengths = [len(part) for part in parts]
    if len(set(lengths)) > 1:
        raise LogError(f"Expected as many samples of each kind in {read.path}, got {', '.join(map(str, lengths))}.")
    there = np.all([~np.isnan(part.reshape(len(part), -1)).all(axis=1) for part in parts], axis=0)
    if not there.all():
        without, name = np.count_nonzero(~there), read.path.name
        note(f"{without} of {len(there)} rows of {name} have no measurement and do not count")
    return tuple(part[there] for part in parts)
