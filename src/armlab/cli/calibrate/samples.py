"""Read calibration samples from CSV, MAT or MCAP files, fit them jointly, and report the result."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import count, takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

import armlab
from armlab.cli.support.html_report import HtmlReport, Verdict
from armlab.cli.support.options import Columns, load_robot
from armlab.cli.support.output import note
from armlab.cli.support.results import Results, parameters
from armlab.errors import ConfigError, LogError

if TYPE_CHECKING:
    import numpy as np

    from armlab.estimation import Fit
    from armlab.log.file_formats.column_names import ColumnNames
    from armlab.robots import Robot

SampleFile = Annotated[Path, Parameter(help="CSV, MAT or MCAP files; several files are joined.")]
Deviations = Annotated[list[float] | None, Parameter(consume_multiple=True)]
ArmOfPoses = Annotated[str | None, Parameter(help="Library name or file of the arm, to compute T_base_tool from q.")]
_QUATERNION_LENGTH = 1e-3  # maximum deviation of a norm from 1
_CLOCKS = ("t", "time")
_UNITS = {r"force\d*": "N", r"acc\d*": "m/s^2", r"(position|(pair_)?distance)\d*": "m", r"\w+_[xyz]": "m"}
_TOGETHER = re.compile(r"(?!scans)(\w*?)(\d+|_[xyz])$")  # components of a quantity, which share a unit


@dataclass(frozen=True, eq=False)
class Samples:
    """Contents of a sample file."""

    path: Path
    values: Mapping[str, np.ndarray]  # arrays (N, ...) by name
    source: str  # file name and SHA-256
    units: Mapping[str, str] = field(default_factory=dict)  # units in the file by name
    start: float = 0.0  # s, time on the file's clock at t = 0

    def __contains__(self, name: object) -> bool:
        text = str(name)
        return any(key in self.values for key in (text, f"{text}1", f"{text}1_1", f"{text}_x", f"{text}1_x"))

    @property
    def clock(self) -> np.ndarray:
        """Times (N,) on the file's clock [s]."""
        return self.numbers("t") + self.start

    def numbers(self, name: str) -> np.ndarray:
        array = self._found(name)
        array = array.reshape(-1) if max(array.shape, default=0) == array.size else array
        if array.ndim != 1:
            raise LogError(f"Expected one number per sample of {name} in {self.path}, got shape {array.shape}.")
        return array

    def vectors(self, name: str, sizes: Sequence[int] = ()) -> np.ndarray:
        import numpy as np

        if name not in self.values and f"{name}_x" in self.values:
            array = np.stack([self.numbers(f"{name}_{axis}") for axis in "xyz"], axis=1)
        elif name not in self.values and f"{name}1" in self.values:
            array = np.stack([self._found(column) for column in self._numbered(f"{name}%d")], axis=1)
        else:
            array = self._found(name)
        if array.ndim == 2 and sizes and array.shape[1] not in sizes and array.shape[0] in sizes:
            array = array.T
        if array.ndim != 2 or (sizes and array.shape[1] not in sizes):
            words = " or ".join(f"(N, {k})" for k in sizes) or "(N, k)"
            raise LogError(f"Expected {name} of shape {words} in {self.path}, got {array.shape}. Pass another column.")
        return array

    def points(self, name: str) -> np.ndarray:
        """Return points (N, K, 3) by name: columns NAME1_x, NAME1_y, NAME1_z, NAME2_x ..., or one array."""
        import numpy as np

        if f"{name}1_x" in self.values:
            points = [column.removesuffix("x") for column in self._numbered(f"{name}%d_x")]
            return np.stack([[self._found(point + axis) for axis in "xyz"] for point in points]).transpose(2, 0, 1)
        array = self._found(name) if name in self.values else self.vectors(name, (3,))
        if array.ndim == 2 and array.shape[1] % 3 == 0:
            return array.reshape(len(array), -1, 3)
        if array.ndim == 3 and array.shape[2] != 3 and array.shape[0] == 3:
            array = array.transpose(2, 1, 0)  # samples last, like poses (4, 4, N)
        if array.ndim != 3 or array.shape[2] != 3:
            raise LogError(f"Expected points {name} of shape (N, K, 3) in {self.path}, got {array.shape}.")
        return array

    def poses(self, name: str) -> np.ndarray:
        import numpy as np

        if name not in self.values and f"{name}_x" in self.values:
            ends = next((ends for ends in _ROTATIONS if f"{name}_{ends[0]}" in self.values), ("qw", "qx", "qy", "qz"))
            columns = [self._found(f"{name}_{end}") for end in ("x", "y", "z", *ends)]
            return pose_of(np.stack(columns, axis=1), _ROTATIONS[ends], f"{name}_{ends[0]} ... of {self.path}")
        if name not in self.values and f"{name}1_1" in self.values:
            places = [f"{name}{i}_{j}" for i in range(1, 5) for j in range(1, 5)]
            array = np.stack([self._found(place) for place in places], axis=1)
        else:
            array = self._found(name)
        for T in _readings(array):
            rows = T[np.isfinite(T).all(axis=(1, 2))]
            if len(rows) and np.abs(rows[:, 3] - [0.0, 0.0, 0.0, 1.0]).max() < 1e-6:
                return T
        raise LogError(
            f"Expected homogeneous transformations {name} of shape (N, 4, 4) or (4, 4, N) in {self.path}, got shape "
            f"{array.shape} or a last row other than 0 0 0 1."
        )

    def _numbered(self, pattern: str) -> list[str]:
        """Return the consecutive columns that match a pattern, numbered from 1."""
        return list(takewhile(self.values.__contains__, (pattern % k for k in count(1))))

    def _found(self, name: str) -> np.ndarray:
        if name not in self.values:
            have = ", ".join(self.values) or "none"
            raise LogError(f"Expected {name} in {self.path}, got {have}. Rename the columns; see --help.")
        array = self.values[name]
        if array.dtype.kind not in "biuf":
            raise LogError(f"Expected numbers in {name} of {self.path}, got text such as {str(array.flat[0])!r}.")
        unit, wanted = self.units.get(name), next((u for word, u in _UNITS.items() if re.fullmatch(word, name)), None)
        if wanted is not None and unit not in (None, "", "1", wanted):
            raise LogError(f"Expected {name} of {self.path} in {wanted}, got {unit}. Convert the values.")
        return array.astype(float)


def read_pair(paths: Sequence[Path], columns: str | None) -> list[Samples]:
    """Return the columns of a robot file and a camera file; `columns` maps the names in both files."""
    from armlab.log.file_formats.column_names import ColumnNames

    if columns is None:
        return [read_samples(path) for path in paths]
    names = ColumnNames.of(columns)
    samples = [read_samples(path, names.of_several_files()) for path in paths]
    for name in set(names.entries) - names.optional - {"t"}:
        if not any(name.partition(":")[0] in one.values for one in samples):
            raise LogError(
                f"Expected the columns for {name} in {' or '.join(str(path) for path in paths)}, got neither. Correct "
                f"the source of {name} in --columns."
            )
    return samples


def read_samples(path: Path, columns: str | ColumnNames | None = None) -> Samples:
    """Return the columns of a CSV file, a MAT file or a recording; `columns` specifies any non-standard column
    names."""
    from armlab.log.file_formats.column_names import ColumnNames
    from armlab.log.file_formats.delimited import rows_of, separator_of, text_table
    from armlab.log.file_formats.description import renamed
    from armlab.log.file_formats.mat import read_mat
    from armlab.log.file_formats.opening import file_hash, is_text
    from armlab.log.topics.reader import is_foreign

    source = f"{path.name} sha256 {file_hash(path)}" if path.is_file() else ""
    if path.suffix.lower() == ".mat":
        return Samples(path, read_mat(path), source)
    labels = []
    if is_text(path):
        labels = next(iter(rows_of(path, separator_of(path), 1)), [])
    _check_units(path, labels)
    names = ColumnNames.of(columns) if isinstance(columns, str) else columns
    timed = any(label.split("[")[0].strip() in _CLOCKS for label in labels) or "t" in (names.entries if names else ())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the notes of the table repeat the warnings
        if labels:
            table = text_table(path, None if timed else 1.0, columns=names, keep_start=timed)
        else:
            table = renamed(path, armlab.log.read(path), names)
    for line in table.notes:
        if not line.startswith("image: text"):
            note(f"{path.name}: {line}")
    if is_foreign(path) and "q" in table and columns is None:
        table = table.without(*(name for name in ("q", "qd", "tau") if name in table))
        note(
            f"{path.name}: the joints are ignored, because their order is unknown. To reorder them: armlab log export "
            f"{path.name} samples.csv --robot NAME."
        )
    units = {name: column.unit or "" for name, column in table.columns.items()}
    values = {"t": table.t, **table.values}
    for name in [name for name in values if ":" in name]:
        values[name.partition(":")[0]] = pose_of(values.pop(name), name.partition(":")[2], f"{name} of {path}")
    return Samples(path, values, source, units, table.t0_ns * 1e-9)


_ROTATIONS = {  # column suffixes of a rotation -> format
    ("qw", "qx", "qy", "qz"): "wxyz",
    ("rx", "ry", "rz"): "rotvec",
    ("roll", "pitch", "yaw"): "rpy",
}
_NUMBERS_OF = {"wxyz": 4, "xyzw": 4, "rotvec": 3, "rpy": 3, "euler_zyx": 3, "euler_xyz": 3, "euler_zyz": 3}
_NUMBERS_OF["matrix"] = 13  # 16 with the position


def pose_of(numbers: np.ndarray, form: str, what: str) -> np.ndarray:
    """Return poses (N, 4, 4) from rows of position [m] and rotation in the given format; empty rows give NaN.

    wxyz, xyzw: quaternion. rotvec: rotation vector, as in OpenCV and UR. rpy: roll, pitch, yaw with R = Rz(yaw)
    Ry(pitch) Rx(roll), as in ROS and URDF. euler_zyx: angles a, b, c with R = Rz(a) Ry(b) Rx(c); similarly for
    euler_xyz and euler_zyz. matrix: 16 numbers, row by row. The suffix _deg means degrees.
    """
    import numpy as np

    kind = form.removesuffix("_deg")
    width = _NUMBERS_OF.get(kind)
    if width is None or (form.endswith("_deg") and width != 3):
        known = ", ".join(_NUMBERS_OF)
        raise ConfigError(f"Expected a rotation as {known}, with _deg for angles in degrees, got {form!r} for {what}.")
    if numbers.ndim != 2 or numbers.shape[1] != 3 + width:
        raise LogError(f"Expected {3 + width} columns for a pose as {form}, got shape {numbers.shape} for {what}.")
    if kind == "matrix":
        return numbers.reshape(-1, 4, 4)
    p, turn = numbers[:, :3], numbers[:, 3:] * (np.pi / 180.0 if form.endswith("_deg") else 1.0)
    gone = np.isnan(numbers).all(axis=1)
    if width == 4:
        length = np.linalg.norm(turn, axis=1)
        bad = np.flatnonzero(np.abs(length - 1.0) > _QUATERNION_LENGTH)
        if len(bad):
            raise LogError(
                f"Expected quaternions of length 1 in {what}, got {length[bad[0]]:.6g} in sample {bad[0]} ({len(bad)} "
                "invalid samples in total). Correct the file."
            )
        turn = turn / length[:, None]
        R = armlab.lie.quaternion.to_matrix(turn if kind == "wxyz" else np.roll(turn, 1, axis=1))
    elif kind == "rotvec":
        R = armlab.lie.so3.exp(turn)
    else:  # rpy lists the angles of euler_zyx in reverse order
        order: Any = "zyx" if kind == "rpy" else kind.removeprefix("euler_")
        R = armlab.lie.euler.from_rpy(turn[:, ::-1] if kind == "rpy" else turn, order)
    T = armlab.lie.se3.from_rp(R, p)
    T[gone] = np.nan  # not measured
    return T


def _check_units(path: Path, labels: Sequence[str]) -> None:
    """Reject a quantity whose units are given for only some components, because its components would be read in
    different units."""
    groups: dict[str, set[bool]] = {}
    for label in labels:
        found = _TOGETHER.match(label.split("[")[0].strip())
        if found and not re.search(r"\d_\d+$", found[0]):
            groups.setdefault(found[1], set()).add("[" in label)
    for name, told in groups.items():
        if len(told) > 1:
            raise LogError(
                f"Expected a unit for all components of {name} in {path} "
                "or for none, got units for only some components. "
                "Write the unit in every label."
            )


def _readings(array: np.ndarray) -> list[np.ndarray]:
    """Return all interpretations of an array as poses: samples first or last, row-major or column-major."""
    import numpy as np

    if array.ndim == 3:
        found = [array] if array.shape[1:] == (4, 4) else []
        last = np.moveaxis(array, -1, 0)
        return [*found, last, np.swapaxes(last, 1, 2)] if array.shape[:2] == (4, 4) else found  # other programs' HDF5
    if array.ndim == 2 and array.shape[1] == 16:
        rows = array.reshape(-1, 4, 4)
        return [rows, np.swapaxes(rows, 1, 2)]
    return [array[None]] if array.shape == (4, 4) else []


_DEGREES = 20.0  # rad, larger than any joint range


def run_fit(
    job: str,
    files: Sequence[Path],
    parts: Callable[[Samples], tuple[np.ndarray, ...]],
    fit: Callable[..., Any],
    wanted: Wanted,
    sources: Sequence[str] = (),
    corrected: Callable[[Any], Mapping[Path, Robot]] = lambda fit: {},
) -> int:
    """Read sample files, fit them jointly, write the requested output, and return the exit code.

    `parts` extracts arrays of equal length from a file; `fit` receives these arrays, concatenated over all files.
    `corrected` returns the corrected arms of a fit, keyed by output file.
    """
    wanted.check(wanted.output, (".toml",))
    if not files:
        raise ConfigError("Expected sample files, got none. Pass one or more CSV, MAT or MCAP files.")
    samples = [read_samples(path, wanted.columns) for path in files]
    hashes = [one.source.rsplit(" ", 1)[-1] for one in samples]
    twice = next((one.path for i, one in enumerate(samples) if hashes[i] in hashes[:i]), None)
    if twice is not None:
        raise ConfigError(
            f"Expected different files, got {twice} twice. Each sample may be used only once: omit the duplicate file."
        )
    return fit_samples(job, samples, parts, fit, wanted, sources, corrected)


def fit_samples(
    job: str,
    read: Sequence[Samples],
    parts: Callable[[Samples], tuple[np.ndarray, ...]],
    fit: Callable[..., Any],
    wanted: Wanted,
    sources: Sequence[str] = (),
    corrected: Callable[[Any], Mapping[Path, Robot]] = lambda fit: {},
) -> int:
    """Fit samples that have already been read; see `run_fit`."""
    import numpy as np

    arrays = [parts(one) for one in read]
    for part in zip(*arrays, strict=True):
        widths = {array.shape[1:] for array in part}
        if len(widths) > 1:
            shapes = ", ".join(f"{array.shape} in {one.path.name}" for one, array in zip(read, part, strict=True))
            raise LogError(
                f"Expected files with the same measurements, got arrays of shape {shapes}. "
                "Calibrate each file separately."
            )
    joined = [np.concatenate(part) for part in zip(*arrays, strict=True)]
    found = fit(*joined)
    return wanted.save(job, found, (*(one.source for one in read), *sources), corrected(found))


def measured_rows(
    read: Samples, needed: Sequence[np.ndarray], some: Sequence[np.ndarray] = (), *, every: bool = False
) -> tuple[np.ndarray, ...]:
    """Return the rows with a measurement; recordings also contain rows between the samples of a sensor.

    A row needs values in all arrays of `needed` and, unless `every` is set, in at least one array of `some`. Returns
    the selected rows of all arrays, and the row numbers in the file.
    """
    import numpy as np

    parts = [*needed, *some]
    lengths = [len(part) for part in parts]
    if len(set(lengths)) > 1:
        raise LogError(f"Expected equal sample counts in {read.path}, got {', '.join(map(str, lengths))}.")
    seen = [~np.isnan(part).all(axis=tuple(range(1, part.ndim))) for part in parts]
    there = np.all(seen[: len(needed)], axis=0)
    if some and not every:
        there &= np.any(seen[len(needed) :], axis=0)
    if not there.any():
        raise LogError(f"Expected at least one complete row in {read.path}, got {len(there)} incomplete rows.")
    _require_whole(read, needed, there)
    if not there.all():
        without = np.count_nonzero(~there)
        note(f"{without} of {len(there)} rows of {read.path.name} have no measurement and are ignored")
    if not every:
        there &= _first_times(read, needed, some, there)
    return (*(part[there] for part in parts), np.flatnonzero(there))


def _require_whole(read: Samples, needed: Sequence[np.ndarray], there: np.ndarray) -> None:
    """Reject incomplete poses or vectors, and report the first such row; individual points may be missing."""
    import numpy as np

    for part in needed:
        if part.ndim == 2 or part.shape[1:] == (4, 4):
            bad = np.flatnonzero(there & np.isnan(part).any(axis=tuple(range(1, part.ndim))))
            if len(bad):
                raise LogError(
                    f"Expected complete samples in {read.path}, got missing numbers in {len(bad)} of {len(there)} "
                    f"rows, first in row {bad[0]} (from 0). Correct or delete the whole measurement in these rows."
                )


def _first_times(
    read: Samples, needed: Sequence[np.ndarray], some: Sequence[np.ndarray], there: np.ndarray
) -> np.ndarray:
    """Return a mask (N,) of rows that do not repeat an earlier row; duplicates would bias the noise estimate."""
    import numpy as np

    flat = [np.ascontiguousarray(part.reshape(len(part), -1), dtype=float) for part in (*needed, *some)]
    numbers, name = np.flatnonzero(there), read.path.name
    first = np.zeros(len(there), dtype=bool)
    seen: set[bytes] = set()
    for i in numbers:
        row = b"".join(part[i].tobytes() for part in flat)
        first[i] = row not in seen
        seen.add(row)
    if len(seen) < len(numbers):
        note(f"{len(numbers) - len(seen)} of {len(numbers)} rows of {name} repeat earlier rows and are ignored")
    kept = np.flatnonzero(first)
    for part in flat[len(needed) if some else 1 :]:
        held = np.count_nonzero((part[kept][1:] == part[kept][:-1]).all(axis=1))
        if held and part.shape[1] >= 3:
            note(f"{held} rows of {name} repeat the previous measurement; the sensor may have held its value")
    return first


def noise_of(values: Sequence[float] | None) -> Any:
    """Return the standard deviations as accepted by the fits: None, a number, or a tuple."""
    return None if values is None else values[0] if len(values) == 1 else tuple(values)


def tool_poses(read: Samples, robot: str | None) -> np.ndarray:
    """Return T_base_tool (N, 4, 4) from the file, or computed from the joint positions of the given robot."""
    if robot is None:
        return read.poses("T_base_tool")
    import numpy as np

    arm = load_robot(robot)
    q = read.vectors("q", (arm.n,))
    far = np.nanmax(np.abs(q[:, ~arm.prismatic]), initial=0.0)
    if far > _DEGREES:
        raise LogError(
            f"Expected joint angles q in radians in {read.path}, got up to {far:.4g}, probably in degrees. Write the "
            "unit in the header, such as q1 [deg]."
        )
    return armlab.kinematics.forward(arm, q)


_MANY = 0.3  # maximum plausible fraction of outliers
_FEW = 1.5  # minimum number of measurements per parameter
_ROUGH = {"[m]": 0.01, "[rad]": 0.05}  # maximum plausible standard deviations of sensor noise


@Parameter(name="*")
@dataclass(frozen=True)
class Wanted(Results):
    """Options common to all calibrations: column names and output."""

    columns: Columns = None
    output: Annotated[
        Path | None, Parameter(alias="-o", help="Save the result with its covariance to this .toml file.")
    ] = None

    def save(self, job: str, fit: Fit[Any], sources: tuple[str, ...], arms: Mapping[Path, Robot]) -> int:
        """Print the fit, write the requested files, including corrected arms, and return the exit code."""
        verdict = judge(fit)
        self.say({**numbers(fit), "sources": list(sources)}, fit.report(), verdict)
        saves: dict[Path, Callable[[Path], object]]
        saves = {path: partial(armlab.robots.save, arm) for path, arm in arms.items()}
        if self.output is not None:
            saves[self.output] = partial(fit.save, sources=sources)
        code = self.keep(verdict, saves)
        self.write(lambda plots: plots.calibration(fit), lambda _: _page(job, fit, verdict, sources))
        return code


NOTHING = Wanted()


def numbers(fit: Fit[Any]) -> dict[str, Any]:
    found = fit.excitation
    return {
        "parameters": parameters(fit),
        "noise": dict(zip(fit.classes, fit.sigma.ravel().tolist(), strict=False)),
        "samples": fit.n,
        "outliers": fit.outliers.nonzero()[0],
        "excitation": {
            "rank": found.rank, "expected": found.expected, "condition": found.condition, "weakest": found.weakest,
            "held": list(found.held),
        },
    }  # fmt: skip


def judge(fit: Fit[Any]) -> Verdict:
    """Return the verdict on a fit, with advice."""
    import numpy as np

    found = Verdict()
    left, total = int(fit.outliers.sum()), len(fit.outliers)
    found.good.append(f"{fit.n} samples identify all {fit.excitation.expected} requested directions.")
    if fit.excitation.held:
        found.good.clear()
        found.bad.append(
            f"A prior fixes directions that the samples do not identify: {'; '.join(fit.excitation.held)}."
        )
    if left > _MANY * total:
        found.bad.append(f"{left} of {total} samples were excluded as outliers, which is too many.")
        found.ahead.append("Check the pairing, clocks and units before using the result.")
    elif left:
        found.ahead.append(f"Inspect the {left} excluded samples.")
    found.bad.extend(f"{line[:1].upper()}{line[1:]}" for line in fit.doubts)
    for name, sigma in zip(fit.classes, fit.sigma.ravel().tolist(), strict=False):
        if sigma > _ROUGH.get(f"[{name.rpartition('[')[2]}", np.inf):
            found.bad.append(
                f"The noise of {name} is {sigma:.2g}, which is too large for a sensor. Some samples are probably wrong."
            )
            found.ahead.append("Find outliers with --robust, and check the pairing, units and frames.")
    if np.isfinite(fit.residuals).sum() < _FEW * len(fit.names):
        found.bad.append(
            "There are few measurements per parameter, so the noise and standard deviations are unreliable."
        )
        found.ahead.append("Take more samples.")
    found.ahead.append(f"The weakest direction is {fit.excitation.weakest}: add samples that excite it.")
    return found


def _page(job: str, fit: Fit[Any], verdict: Verdict, sources: tuple[str, ...]) -> Any:
    from armlab.plots.style import png

    page = HtmlReport(f"Calibration: {job}", f"From {'; '.join(sources)}.")
    page.verdict(verdict)
    page.section(
        "Residuals, ellipses, excitation",
        "Residuals are in standard deviations of the noise. A straight quantile plot indicates normally distributed "
        "residuals.",
    )
    page.figure(png(armlab.plots.calibration(fit)), "residuals per sample, quantiles, ellipses, singular values")
    page.section("Parameters")
    rows = zip(fit.names, fit.parameters, fit.sd, fit.units, strict=True)
    page.table([
        ["parameter", "value", "standard deviation", "unit"],
        *([name, f"{value:.6g}", f"{sd:.2g}", unit] for name, value, sd, unit in rows),
    ])  # fmt: skip
    page.section("Report")
    page.verbatim(fit.report())
    return page
