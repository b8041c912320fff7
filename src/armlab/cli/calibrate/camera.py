"""``armlab calibrate hand-eye``: calibration from samples, two synchronised files, topics of a ROS bag, or images of a
board."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import armlab
from armlab.cli.calibrate.samples import (
    NOTHING,
    ArmOfPoses,
    Deviations,
    SampleFile,
    Samples,
    Wanted,
    fit_samples,
    measured_rows,
    noise_of,
    read_pair,
    read_samples,
    run_fit,
    tool_poses,
)
from armlab.cli.support.options import seconds_in
from armlab.cli.support.output import note
from armlab.errors import ConfigError, LogError

if TYPE_CHECKING:
    import numpy as np

Setup = Literal["eye_to_hand", "eye_in_hand"]
Join = Literal["nearest", "linear"]
_IMAGES = {".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".webp"}
_ROUNDING = 1e-6  # s, rounding error of Unix time
_PERIODS = 3.0  # default of --max-gap in sample periods of the robot's file


def hand_eye(
    *samples: SampleFile,
    images: Path | None = None,
    board: str | None = None,
    intrinsics: Path | None = None,
    join: Join | None = None,
    max_gap: str | None = None,
    robot_topic: str | None = None,
    camera_topic: str | None = None,
    marker: Path | None = None,
    setup: Setup = "eye_to_hand",
    robot: ArmOfPoses = None,
    noise: Deviations = None,
    noise_robot: tuple[float, float] | None = None,
    robust: bool = False,
    wanted: Wanted = NOTHING,
) -> int:
    """Calibrate a camera (hand-eye) from robot poses and marker poses, marker points or images.

    A file contains the poses T_base_tool and T_cam_marker, one sample per row. The position is T_cam_marker_x, _y, _z
    [m or mm in the header]. The rotation is _qw, _qx, _qy, _qz, or the rotation vector _rx, _ry, _rz of OpenCV and UR,
    or _roll, _pitch, _yaw [rad or deg] with R = Rz(yaw) Ry(pitch) Rx(roll). A pose may also be a matrix, with the
    columns T_cam_marker1_1 ... T_cam_marker4_4; in a MAT file, it has the shape (N, 4, 4) or (4, 4, N). Map other
    column names with --columns, for example T_base_tool:rotvec=actual_TCP_pose_{0..5}. Other rotation formats are wxyz,
    xyzw, rpy, euler_zyx, euler_xyz, euler_zyz and matrix; append _deg for degrees.

    Instead of T_cam_marker, a file may contain the marker points in camera axes, p_cam1_x, p_cam1_y, p_cam1_z, p_cam2_x
    ...; in a MAT file, the array p_cam (N, K, 3). Leave hidden points empty.

    With --images, the file contains a column image (the name of an image in that folder) and either T_base_tool
    or, with --robot, the joint positions q1, q2 ...

    Parameters:
        images: Folder of images of a board, taken at rest.
        board: Type and size of the board [m]: charuco:7x5:0.03:0.022 (number of squares, side lengths of a
            square and a marker), checkerboard:8x5:0.025 (number of inner corners, side length of a square),
            apriltag:36h11:0.05 or aruco:4X4_50:0.05 (family, side length of a tag).
        intrinsics: YAML or JSON file from OpenCV or ROS, with camera_matrix and distortion_coefficients. Default:
            calibrated from the images.
        join: For two synchronised files with a time column t (one with T_base_tool or q, one with T_cam_marker): use
            the nearest or the interpolated robot pose at each camera time.
        max_gap: With --join: largest time difference to a robot pose, such as 20ms; default: three sample periods.
        robot_topic: Topic of the robot poses in a ROS bag: /tf:base->tool0, or a topic with poses.
        camera_topic: Topic of the marker poses in a ROS bag: /tf:camera->marker, or a topic with poses.
        marker: File with the marker points, one per row: marker_x, marker_y, marker_z [m or mm in the header]. Default:
            estimated.
        setup: eye_to_hand: fixed camera, marker on the tool. eye_in_hand: camera on the tool, fixed marker.
        noise: Known standard deviations of the camera: poses [m and rad] or points [m].
        noise_robot: Standard deviations of the robot poses [m and rad], which cannot be identified from samples;
            default: exact poses.
        robust: Detect outliers and exclude them.
    """
    import numpy as np

    _check_options(samples, images, board, intrinsics, join, max_gap, robot_topic, camera_topic, noise)
    if images is not None and board is not None:
        told = {"setup": setup, "noise_robot": noise_robot, "robust": robust}
        return _from_images(samples, images, board, intrinsics, robot, told, wanted)
    kinds: set[bool] = set()
    known = None if marker is None else read_samples(marker)
    body = None if known is None else known.vectors("marker", (3,))

    def parts(read: Samples) -> tuple[np.ndarray, ...]:
        kinds.add("T_cam_marker" in read and known is None)
        seen = read.poses("T_cam_marker") if True in kinds else read.points("p_cam")
        own = None if "T_base_tool" in read else robot
        return measured_rows(read, (tool_poses(read, own), seen))[:2]

    def fit(T_base_tool: np.ndarray, seen: np.ndarray) -> Any:
        told: dict[str, Any] = {"setup": setup, "noise": noise_of(noise), "noise_robot": noise_robot, "robust": robust}
        if True in kinds:
            return armlab.calibrate.fit_hand_eye(T_base_tool, seen, **told)
        return armlab.calibrate.fit_hand_eye_points(
            T_base_tool, seen, marker=body, visible=np.isfinite(seen).all(axis=2), **told
        )

    sources = () if known is None else (known.source,)
    if join is not None or robot_topic is not None:
        wanted.check(wanted.output, (".toml",))
        gap = None if max_gap is None else seconds_in(max_gap, "max-gap")
        both = (
            from_topics(samples[0], robot_topic, camera_topic, join or "linear", gap)
            if robot_topic is not None and camera_topic is not None
            else joined(read_pair(samples, wanted.columns), robot, join or "linear", gap)
        )
        return fit_samples("hand-eye", [both], parts, fit, wanted, sources)
    return run_fit("hand-eye", samples, parts, fit, wanted, sources)


def _check_options(
    samples: Sequence[Path], images: Any, board: Any, intrinsics: Any, join: Any, max_gap: Any, robot_topic: Any,
    camera_topic: Any, noise: Any,
) -> None:  # fmt: skip
    if (images is None) != (board is None):
        raise ConfigError("Expected --images FOLDER and --board BOARD together, got only one of them. Pass both.")
    if images is None and intrinsics is not None:
        raise ConfigError(
            "Expected --intrinsics only with --images, got no --images. Omit --intrinsics, or add --images and --board."
        )
    if (robot_topic is None) != (camera_topic is None):
        raise ConfigError("Expected --robot-topic and --camera-topic together, got only one of them. Pass both.")
    if images is not None and (join or robot_topic or noise):
        raise ConfigError(
            "Expected --images without --join, topics or --noise, got --images with at least one of these options. "
            "Omit --images or the other options."
        )
    if max_gap is not None and join is None and robot_topic is None:
        raise ConfigError(f"Expected --max-gap {max_gap} with --join nearest or linear, got no --join. Add --join.")
    wanted = 1 if images is not None or robot_topic is not None else 2 if join is not None else len(samples)
    if len(samples) != wanted:
        what = {1: "one file (poses with image names, or a bag)", 2: "two files (robot and camera)"}
        raise ConfigError(f"Expected {what[wanted]} with these options, got {len(samples)}.")


def _from_images(
    samples: Sequence[Path], folder: Path, board: str, intrinsics: Path | None, robot: str | None,
    told: Mapping[str, Any], wanted: Wanted,
) -> int:  # fmt: skip
    import numpy as np

    wanted.check(wanted.output, (".toml",))
    read = read_samples(samples[0], wanted.columns)
    if "image" not in read.values:
        raise LogError(
            f"Expected a column named image with the names of the images in {read.path}, got {', '.join(read.values)}. "
            "Add this column, or give its name: --columns image=NAME."
        )
    names, T = [str(name) for name in read.values["image"]], tool_poses(read, robot)
    pictures = _pictures(folder, names, read.path)
    known = None if intrinsics is None else camera_in(intrinsics)
    seen = armlab.calibrate.board_poses(pictures, board, intrinsics=known)
    for line in seen.report().splitlines():
        note(line)

    def fit(T_base_tool: np.ndarray, _: np.ndarray) -> Any:
        return armlab.calibrate.fit_hand_eye_images(T_base_tool, seen, **told)

    return fit_samples("hand-eye", [read], lambda _: (T, np.arange(len(T))), fit, wanted)


def _pictures(folder: Path, names: Sequence[str], path: Path) -> dict[str, np.ndarray]:
    """Return the images of a folder by name, in the order of the samples."""
    from armlab.calibrate.board_images import opencv

    there = {file.name for file in folder.iterdir() if file.suffix.lower() in _IMAGES} if folder.is_dir() else set()
    if not there:
        raise LogError(f"Expected a folder of images ({', '.join(sorted(_IMAGES))}) at {folder}, got no images there.")
    twice = sorted({name for name in names if names.count(name) > 1})
    missing = [name for name in names if Path(name).name not in there]
    if twice or missing:
        what = f"{twice[0]} twice" if twice else f"{len(missing)} missing images, first {missing[0]}"
        raise LogError(f"Expected image names from {folder} in the column image of {path}, got {what}.")
    if rest := sorted(there - {Path(name).name for name in names}):
        note(f"{len(rest)} images in {folder} are not listed in {path.name} and are ignored: {', '.join(rest[:3])}")
    cv2, found = opencv(), {}
    for name in names:
        found[name] = cv2.imread(str(folder / Path(name).name), cv2.IMREAD_GRAYSCALE)
        if found[name] is None:
            raise LogError(f"Expected an image at {folder / Path(name).name}, got a file that OpenCV cannot read.")
    return found


def camera_in(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the camera matrix and the distortion coefficients in an OpenCV, ROS (camera_info) or JSON file."""
    import numpy as np
    from ruamel.yaml import YAML, YAMLError

    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise LogError(f"Expected camera intrinsics at {path}, got: {error}.") from None
    plain = "\n".join(line for line in text.splitlines() if not line.startswith("%")).replace("!!opencv-matrix", "")
    try:
        told = YAML(typ="safe", pure=True).load(plain)
        K, dist = (
            next(told[name] for name in known if name in told)
            for known in (("camera_matrix", "K", "k"), ("distortion_coefficients", "dist_coeffs", "dist", "D", "d"))
        )
        K, dist = (np.array(one["data"] if isinstance(one, dict) else one, dtype=float) for one in (K, dist))
        return K.reshape(3, 3), dist.ravel()
    except (YAMLError, StopIteration, RuntimeError, TypeError, ValueError, KeyError):
        raise LogError(
            f"Expected camera_matrix and distortion_coefficients in the format of OpenCV or ROS in {path}, got other "
            "keys or values."
        ) from None


def joined(read: Sequence[Samples], robot: str | None, join: Join, gap: float | None) -> Samples:
    """Return the camera samples with the robot poses at the same times."""
    camera = [one for one in read if "T_cam_marker" in one or "p_cam" in one]
    arm = [one for one in read if one not in camera]
    if len(camera) != 1 or len(arm) != 1:
        raise LogError(
            f"Expected T_cam_marker or p_cam in one of {', '.join(one.path.name for one in read)} and T_base_tool or q "
            f"in the other, got the camera's columns in {len(camera)} of these files. Rename the columns, or give "
            "their names with --columns."
        )
    for one in read:
        if "t" not in one.values:
            raise LogError(f"Expected the time column t [s] in {one.path} for --join, got no such column.")
    T = at_times(tool_poses(arm[0], robot), arm[0].clock, camera[0].clock, join, gap, arm[0].path.name)
    values = {**camera[0].values, "T_base_tool": T}
    return Samples(camera[0].path, values, f"{camera[0].source}; {arm[0].source}", camera[0].units)


def at_times(T: np.ndarray, t: np.ndarray, times: np.ndarray, join: Join, gap: float | None, what: str) -> np.ndarray:
    """Return the nearest or interpolated poses (M, 4, 4) at `times`; NaN if no pose is close enough in time."""
    import numpy as np

    from armlab.log.column import pose_between

    whole = np.isfinite(T).all(axis=(1, 2))
    T, t = T[whole], t[whole]
    if not len(t) or (len(t) > 1 and not np.all(np.diff(t) > 0)):
        got = "times that do not increase" if len(t) else "none"
        raise LogError(f"Expected poses of {what} at increasing times, got {got}.")
    if len(t) == 1:  # constant
        return np.broadcast_to(T[0], (len(times), 4, 4)).copy()
    if times[-1] < t[0] or times[0] > t[-1]:
        raise LogError(
            f"Expected data recorded with one clock, got {what} from {t[0]:.3f} to {t[-1]:.3f} s and the camera from "
            f"{times[0]:.3f} to {times[-1]:.3f} s. Record both with the same clock."
        )
    gap = _PERIODS * float(np.median(np.diff(t))) if gap is None else gap
    left = np.clip(np.searchsorted(t, times, side="right") - 1, 0, len(t) - 2)
    before, after = times - t[left], t[left + 1] - times
    nearest = np.where(np.abs(before) <= np.abs(after), left, left + 1)
    near = np.abs(times - t[nearest]) <= gap
    if join == "linear":
        near &= (
            (before >= -_ROUNDING)
            & (after >= -_ROUNDING)
            & ((np.maximum(before, after) <= gap) | (np.minimum(before, after) <= _ROUNDING))
        )
        s = np.clip(before / (before + after), 0.0, 1.0)
        found = pose_between(T[left], T[left + 1], s)
    else:
        found = T[nearest].copy()
    found[~near] = np.nan
    if not near.all():
        note(f"{np.count_nonzero(~near)} of {len(near)} samples have no pose of {what} within {1e3 * gap:.3g} ms")
    return found


def from_topics(path: Path, robot_topic: str, camera_topic: str, join: Join, gap: float | None) -> Samples:
    """Return the poses of two topics of a bag at the camera's times."""
    from armlab.log.file_formats.opening import origin

    tables = armlab.log.read_topics(path)
    camera = _edges(tables, camera_topic, path)
    times = max((t for t, _ in camera), key=len)
    poses = {
        name: _chained(edges, times, join, gap, f"{topic} in {path.name}")
        for name, edges, topic in (
            ("T_cam_marker", camera, camera_topic), ("T_base_tool", _edges(tables, robot_topic, path), robot_topic)
        )
    }  # fmt: skip
    return Samples(path, poses, origin(path))


def _chained(
    edges: Sequence[tuple[np.ndarray, np.ndarray]], times: np.ndarray, join: Join, gap: float | None, what: str
) -> np.ndarray:
    import numpy as np

    T = np.broadcast_to(np.eye(4), (len(times), 4, 4))
    for t, step in edges:
        T = T @ at_times(step, t, times, join, gap, what)
    return T


def _edges(tables: Mapping[str, Any], topic: str, path: Path) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the times and poses of the transforms between two frames, or of a topic with poses."""
    name, _, pair = topic.partition(":")
    if not pair:
        found = [table for key, table in tables.items() if key.split(" ")[0] == name]
        poses = [(one, column) for one in found for column in one.names if one[column].shape[1:] == (4, 4)]
        if len(poses) != 1:
            raise LogError(
                f"Expected one pose per message on {name} in {path}, got {len(poses)}. Topics: {', '.join(tables)}. "
                "For transforms, give the frames as /tf:PARENT->CHILD."
            )
        table, column = poses[0]
        return [(table.t + table.t0_ns * 1e-9, table[column])]
    start, arrow, goal = (part.strip("/ ") for part in pair.partition("->"))
    steps: dict[str, dict[str, tuple[np.ndarray, np.ndarray]]] = {}
    for table in tables.values():
        for column in (one for one in table.names if one.startswith(("tf.", "tf_static."))):
            parent = table.columns[column].frame or ""
            child = column.partition(".")[2].removeprefix(f"{parent}.")
            t, T = table.t + table.t0_ns * 1e-9, table[column]
            t, T = (t[:1], T[:1]) if column.startswith("tf_static.") else (t, T)
            steps.setdefault(parent, {})[child] = (t, T)
            steps.setdefault(child, {})[parent] = (t, armlab.lie.se3.inv(T))
    way = _way(steps, start, goal) if arrow else []
    if not way:
        raise LogError(
            f"Expected transforms from {start or 'PARENT'} to {goal or 'CHILD'} in {path}, got frames "
            f"{', '.join(sorted(steps)) or 'none'}. Pass them as /tf:PARENT->CHILD."
        )
    return way


def _way(steps: Mapping[str, Mapping[str, Any]], start: str, goal: str) -> list[Any]:
    """Return the transforms along the shortest path between two frames; empty if there is no path."""
    came: dict[str, tuple[str, Any]] = {start: ("", None)}
    waiting = deque([start])
    while waiting and goal not in came:
        here = waiting.popleft()
        for there, step in steps.get(here, {}).items():
            if there not in came:
                came[there] = (here, step)
                waiting.append(there)
    way = []
    while goal in came and goal != start:
        goal, step = came[goal]
        way.append(step)
    return way[::-1]
