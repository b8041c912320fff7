"""``armlab calibrate kinematics`` and ``dual-arm``: calibrate one arm, or two arms that measure each other."""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

import armlab
from armlab.cli.calibrate.samples import NOTHING, Deviations, SampleFile, Wanted, measured_rows, run_fit
from armlab.cli.support.options import load_robot
from armlab.cli.support.output import check_output
from armlab.errors import ConfigError, LogError

if TYPE_CHECKING:
    import numpy as np

    from armlab.cli.calibrate.samples import Samples
    from armlab.estimation import Fit
    from armlab.models import DualArmCorrection
    from armlab.robots import Robot

Harmonics = Annotated[
    list[int] | None,
    Parameter(consume_multiple=True, help="Orders of the periodic joint errors, such as 1 2."),
]
Weak = Annotated[
    Literal["refuse", "prior"],
    Parameter(help="Handling of unidentifiable directions: refuse the fit, or fix them with a prior."),
]
Robust = Annotated[bool, Parameter(help="Detect and exclude outliers.")]
_NUMBERS = {"pose": 2, "position": 1, "distance": 1, "pair_distance": 1, "absolute_a": 2}


def kinematics(
    robot: str,
    *samples: SampleFile,
    anchor: tuple[float, float, float] | None = None,
    length_offset: bool = False,
    noise: Deviations = None,
    free: Literal["all", "offsets", "base_tool"] = "all",
    harmonics: Harmonics = None,
    weak: Weak = "refuse",
    robust: Robust = False,
    corrected: Path | None = None,
    wanted: Wanted = NOTHING,
) -> int:
    """Calibrate an arm from joint positions and measured poses, positions or distances of its tool.

    Each file contains q1 ... qn and at least one kind of measurement: the pose (as for hand-eye calibration), position1
    ... position3, distance, or pair_distance. A distance is measured from a fixed point. A pair_distance is measured
    from the tool position in another sample of the same file; pair_with is the number of that sample, counted from 0.
    Leave missing measurements empty.

    Parameters:
        robot: Library name or robot file of the nominal arm.
        anchor: Approximate position of the fixed point for distances [m].
        length_offset: Identify a constant offset of the distances, for example of a draw-wire sensor.
        noise: Known standard deviations of the measurements in the files, in this order: poses [m and rad], positions
            [m], distances [m], pair distances [m].
        free: Parameters to identify: all; joint offsets, base and tool (offsets); or base and tool (base_tool).
        corrected: Also write the corrected arm as a robot file, .toml.
    """
    arm = load_robot(robot)
    files = () if corrected is None else (corrected,)
    for path in files:
        check_output(path, wanted.force, (".toml",))
    length = 0  # number of samples in the previous files

    def parts(read: Samples) -> tuple[np.ndarray, ...]:
        nonlocal length
        *found, pair = _arm_parts(read, arm)
        pair[:] += length
        length += len(pair)
        return (*found, pair)

    def fit(q: np.ndarray, pose: np.ndarray, position: np.ndarray, *lengths: np.ndarray) -> Any:
        distance, pair_distance, pair = lengths
        told, visible = _kinds({"pose": pose, "position": position, "distance": distance})
        rows = _seen(pair_distance).nonzero()[0]
        if len(rows):
            told["pair_distance"] = (rows, pair[rows].astype(int), pair_distance[rows])
        more: dict[str, Any] = {"anchor": anchor, "length_offset": length_offset, "free": free, "weak": weak}
        more |= {"robust": robust, "harmonics": tuple(harmonics or ()), "visible": visible}
        sizes = _noises(noise, list(told))
        known: Any = sizes if len(told) > 1 else next(iter(sizes.values()), None)
        return armlab.calibrate.fit_kinematics(arm, q, noise=known, **told, **more)

    return run_fit(
        "kinematics", samples, parts, fit, wanted, corrected=lambda found: dict(zip(files, [found.value.robot]))
    )


def dual_arm(
    robot_a: str,
    robot_b: str,
    *samples: SampleFile,
    closed: bool = False,
    noise: Deviations = None,
    harmonics: Harmonics = None,
    weak: Weak = "refuse",
    robust: Robust = False,
    corrected: tuple[Path, Path] | None = None,
    wanted: Wanted = NOTHING,
) -> int:
    """Calibrate two arms and their relative base pose from measurements of one arm's tool by the other arm.

    Each file contains simultaneous joint positions q_a1 ... q_an and q_b1 ... q_bn, and the pose of tool b relative to
    tool a, as for hand-eye calibration, or its position1 ... position3. The optional pose absolute_a is the pose of
    tool a measured by an external device.

    Parameters:
        robot_a: Library name or robot file of the measuring arm (nominal).
        robot_b: Library name or robot file of the measured arm (nominal).
        closed: The tools are rigidly connected, so no relative measurements are needed.
        noise: Known standard deviations: poses [m and rad] or positions [m], then absolute_a [m and rad].
        corrected: Also write the corrected arms a and b as robot files, .toml.
    """
    kinds = ("pose", "position", "absolute_a")
    arms = load_robot(robot_a), load_robot(robot_b)
    for path in corrected or ():
        check_output(path, wanted.force, (".toml",))

    def parts(read: Samples) -> tuple[np.ndarray, ...]:
        joints = [read.vectors(f"q_{letter}", (arm.n,)) for letter, arm in zip("ab", arms, strict=True)]
        seen = _measurements(read, len(joints[0]), kinds) if not closed or "pose" in read else []
        return measured_rows(read, joints, seen, every=closed)[:-1]

    def fit(q_a: np.ndarray, q_b: np.ndarray, *measured: np.ndarray) -> Any:
        told, visible = _kinds(dict(zip(kinds, measured, strict=False)))  # a closed chain may have no measurements
        sizes = _noises(noise, list(told) or ["pose"])
        more: dict[str, Any] = {"noise": sizes.get("pose", sizes.get("position")), "closed": closed}
        more |= {"noise_absolute": sizes.get("absolute_a"), "weak": weak, "robust": robust}
        more["visible"] = visible.get("pose", visible.get("position"))
        return armlab.calibrate.fit_dual_arm(*arms, q_a, q_b, harmonics=tuple(harmonics or ()), **told, **more)

    def arms_of(found: Fit[DualArmCorrection]) -> dict[Path, Robot]:
        return dict(zip(corrected or (), (found.value.arm_a.robot, found.value.arm_b.robot)))

    return run_fit("dual arm", samples, parts, fit, wanted, corrected=arms_of)


def _arm_parts(read: Samples, arm: Robot) -> tuple[np.ndarray, ...]:
    """Return the joint positions, measured poses, positions, distances and pair distances, and the index of the second
    sample of each pair."""
    import numpy as np

    q = read.vectors("q", (arm.n,))
    seen = _measurements(read, len(q), ("pose", "position", "distance", "pair_distance", "pair_with"))
    *found, rows = measured_rows(read, (q,), seen, every="pair_distance" in read)
    pair = found[-1]
    paired = _seen(found[-2])
    place = np.full(len(q), -1)
    place[rows] = np.arange(len(rows))
    other = pair[paired]
    if not np.all((other >= 0) & (other < len(q)) & (other % 1 == 0)) or np.any(place[other.astype(int)] < 0):
        raise LogError(
            f"Expected pair_with in {read.path} to be the number of another sample with joint positions (0 to "
            f"{len(q) - 1}) wherever pair_distance has a value, got other numbers. Correct the file."
        )
    pair[paired] = place[other.astype(int)]
    return (*found[:-1], pair)


def _measurements(read: Samples, N: int, names: tuple[str, ...]) -> list[np.ndarray]:
    """Return the named measurements; NaN if the file does not contain them."""
    import numpy as np

    if not any(name in read for name in names):
        raise LogError(f"Expected one of the columns {', '.join(names)} in {read.path}, got {', '.join(read.values)}.")
    empty = {"pose": (N, 4, 4), "absolute_a": (N, 4, 4), "position": (N, 1, 3)}
    found = []
    for name in names:
        if name not in read:
            found.append(np.full(empty.get(name, (N,)), np.nan))
        elif name == "position":
            found.append(read.points(name))
        else:
            found.append(read.poses(name) if name in empty else read.numbers(name))
    return found


def _seen(values: np.ndarray) -> np.ndarray:
    """Return a mask of available measurements: (N,), or (N, K) for positions (N, K, 3)."""
    import numpy as np

    lead = 2 if values.shape[2:] == (3,) else 1
    return np.asarray(~np.isnan(values).all(axis=tuple(range(lead, values.ndim))))


def _kinds(measured: dict[str, np.ndarray]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the available measurements and their masks, keyed by kind; complete measurements need no mask."""
    masks = {name: _seen(values) for name, values in measured.items()}
    there = {name: measured[name] for name, mask in masks.items() if mask.any()}
    return there, {name: masks[name] for name in there if not masks[name].all()}


def _noises(values: list[float] | None, names: list[str]) -> dict[str, Any]:
    if values is None:
        return {}
    counts = [_NUMBERS[name] for name in names]
    if sum(counts) != len(values):
        wanted = ", ".join(f"{name}: {'m and rad' if n == 2 else 'm'}" for name, n in zip(names, counts, strict=True))
        raise ConfigError(f"Expected {sum(counts)} numbers for --noise ({wanted}), got {len(values)}.")
    rest = iter(values)
    found = ((name, list(islice(rest, n))) for name, n in zip(names, counts, strict=True))
    return {name: tuple(sizes) if len(sizes) > 1 else sizes[0] for name, sizes in found}
