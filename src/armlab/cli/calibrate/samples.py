"""Samples of a calibration from CSV, MAT or MCAP: named poses, vectors, numbers; the fit of all files, its report."""

from __future__ import annotations

import csv
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

import armlab
from armlab.cli.support.html_report import HtmlReport, Verdict
from armlab.cli.support.output import note
from armlab.cli.support.results import Results, parameters
from armlab.errors import ConfigError, LogError

if TYPE_CHECKING:
    import numpy as np

    from armlab.estimation import Fit
    from armlab.robots import Robot

SampleFile = Annotated[Path, Parameter(help="CSV, MAT or MCAP; several are joined.")]
Deviations = Annotated[list[float] | None, Parameter(consume_multiple=True)]
ArmOfPoses = Annotated[str | None, Parameter(help="Name or file of the arm: its joint positions q give T_base_tool.")]
_QUATERNION_LENGTH = 1e-3  # difference from one
_CLOCKS = ("t", "time")
_UNITS = {r"force\d*": "N", r"acc\d*": "m/s^2", r"(position|(pair_)?distance)\d*": "m", r"\w+_[xyz]": "m"}
_TOGETHER = re.compile(r"(?!scans)(\w*?)(\d+|_[xyz])$")  # columns that have one unit


@dataclass(frozen=True, eq=False)
class Samples:
    """What files of samples hold."""

    path: Path  # of the file, for messages
    values: Mapping[str, np.ndarray]  # name -> array (N, ...)
    source: str  # name of the file and its SHA-256
    units: Mapping[str, str] = field(default_factory=dict)  # name -> unit, where the file tells it

    def __contains__(self, name: object) -> bool:
        text = str(name)
        return any(key in self.values for key in (text, f"{text}1", f"{text}1_1", f"{text}_x", f"{text}1_x"))

    def numbers(self, name: str) -> np.ndarray:
        """Return the column (N,) of a name."""
        array = self._found(name)
        array = array.reshape(-1) if max(array.shape, default=0) == array.size else array
        if array.ndim != 1:
            raise LogError(f"Expected one number per sample of {name} in {self.path}, got shape {array.shape}.")
        return array

    def vectors(self, name: str, sizes: Sequence[int] = ()) -> np.ndarray:
        """Return the vectors (N, k) of a name."""
        import numpy as np

        if name not in self.values and f"{name}_x" in self.values:
            array = np.stack([self.numbers(f"{name}_{axis}") for axis in "xyz"], axis=1)
        elif name not in self.values and f"{name}1" in self.values:
            count = next(k for k in range(1, len(self.values) + 2) if f"{name}{k}" not in self.values)
            array = np.stack([self._found(f"{name}{k}") for k in range(1, count)], axis=1)
        else:
            array = self._found(name)
        if array.ndim == 2 and sizes and array.shape[1] not in sizes and array.shape[0] in sizes:
            array = array.T
        if array.ndim != 2 or (sizes and array.shape[1] not in sizes):
            words = " or ".join(f"(N, {k})" for k in sizes) or "(N, k)"
            raise LogError(f"Expected {name} of shape {words} in {self.path}, got {array.shape}. Name another column.")
        return array

    def points(self, name: str) -> np.ndarray:
        """Return the points (N, K, 3) of a name: columns NAME1_x, NAME1_y, NAME1_z, NAME2_x ..., or one array."""
        import numpy as np

        if f"{name}1_x" in self.values:
            count = next(k for k in range(1, len(self.values) + 2) if f"{name}{k}_x" not in self.values)
            places = [[f"{name}{k}_{axis}" for axis in "xyz"] for k in range(1, count)]
            return np.stack([[self._found(place) for place in point] for point in places]).transpose(2, 0, 1)
        array = self._found(name) if name in self.values else self.vectors(name, (3,))
        if array.ndim == 2 and array.shape[1] % 3 == 0:
            return array.reshape(len(array), -1, 3)
        if array.ndim == 3 and array.shape[2] != 3 and array.shape[0] == 3:
            array = array.transpose(2, 1, 0)  # samples last, as poses (4, 4, N)
        if array.ndim != 3 or array.shape[2] != 3:
            raise LogError(f"Expected points {name} of shape (N, K, 3) in {self.path}, got {array.shape}.")
        return array

    def poses(self, name: str) -> np.ndarray:
        """Return the poses (N, 4, 4) of a name."""
        import numpy as np

        if name not in self.values and f"{name}_x" in self.values:
            return self._quaternions(name)
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
            f"Expected poses {name} of shape (N, 4, 4) or (4, 4, N) with the last row 0 0 0 1 in {self.path}, got "
            f"shape {array.shape} without. Save homogeneous transformations."
        )

    def _quaternions(self, name: str) -> np.ndarray:
        import numpy as np

        p, q = (
            np.stack([self._found(f"{name}_{end}") for end in ends], axis=1)
            for ends in (("x", "y", "z"), ("qw", "qx", "qy", "qz"))
        )
        length = np.linalg.norm(q, axis=1)
        bad = np.flatnonzero(np.abs(length - 1.0) > _QUATERNION_LENGTH)
        if len(bad):
            raise LogError(
                f"Expected quaternions of length 1 in {name}_qw ... {name}_qz of {self.path}, got {length[bad[0]]:.6g} "
                f"in sample {bad[0]} ({len(bad)} such samples). Mend the file."
            )
        T = armlab.lie.se3.from_rp(armlab.lie.quaternion.to_matrix(q / length[:, None]), p)
        T[np.isnan(np.hstack([p, q])).all(axis=1)] = np.nan  # not measured at all
        return T

    def _found(self, name: str) -> np.ndarray:
        if name not in self.values:
            have = ", ".join(self.values) or "none"
            raise LogError(f"Expected {name} in {self.path}, got {have}. Name its columns so; --help tells how.")
        array = self.values[name]
        if array.dtype.kind not in "biuf":
            raise LogError(f"Expected numbers in {name} of {self.path}, got words such as {str(array.flat[0])!r}.")
        unit, wanted = self.units.get(name), next((u for word, u in _UNITS.items() if re.fullmatch(word, name)), None)
        if wanted is not None and unit not in (None, "", "1", wanted):
            raise LogError(f"Expected {name} of {self.path} in {wanted}, got {unit}. Convert it.")
        return array.astype(float)


def read_samples(path: Path) -> Samples:
    """Return the columns of a CSV file, a MAT file, or a recording."""
    from armlab.log.file_formats.mat import read_mat
    from armlab.log.file_formats.opening import file_hash, is_text
    from armlab.log.topics.reader import is_foreign

    source = f"{path.name} sha256 {file_hash(path)}" if path.is_file() else ""
    if path.suffix.lower() == ".mat":
        return Samples(path, read_mat(path), source)
    labels, separator = _header(path) if is_text(path) else ([], ",")
    _check_units(path, labels)
    timed = any(label.split("[")[0].strip() in _CLOCKS for label in labels)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the notes of the table say the same and are shown below
        if labels and (separator != "," or not timed):
            table = armlab.log.read_csv(path, rate=None if timed else 1.0, separator=separator)
        else:
            table = armlab.log.read(path)
    for line in table.notes:
        note(f"{path.name}: {line}")
    if is_foreign(path) and "q" in table:
        table = table.without(*(name for name in ("q", "qd", "tau") if name in table))
        note(
            f"{path.name}: its joints are in an order of its own and are left out. For samples with joints, armlab log "
            f"export {path.name} samples.csv --robot NAME puts them into the order of the robot."
        )
    units = {name: column.unit or "" for name, column in table.columns.items()}
    return Samples(path, {"t": table.t, **table.values}, source, units)


def _header(path: Path) -> tuple[list[str], str]:
    """Return the labels of a text file and what separates them; none where `log.read` says what is wrong."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            line = file.readline()
    except (OSError, UnicodeDecodeError):
        return [], ","
    separator = next((mark for mark in ",;\t" if mark in line), ",")
    return next(csv.reader([line], delimiter=separator), []), separator


def _check_units(path: Path, labels: Sequence[str]) -> None:
    """Refuse components of which some have a unit and others none: they would be read in different ones."""
    groups: dict[str, set[bool]] = {}
    for label in labels:
        found = _TOGETHER.match(label.split("[")[0].strip())
        if found and not re.search(r"\d_\d+$", found[0]):
            groups.setdefault(found[1], set()).add("[" in label)
    for name, told in groups.items():
        if len(told) > 1:
            raise LogError(
                f"Expected a unit for all components of {name} in {path} or for none, got it for some. "
                "Write it into every label."
            )


def _readings(array: np.ndarray) -> list[np.ndarray]:
    """Return how numbers may be read as poses: samples first or last, rows or columns first."""
    import numpy as np

    if array.ndim == 3:
        found = [array] if array.shape[1:] == (4, 4) else []
        last = np.moveaxis(array, -1, 0)
        return [*found, last, np.swapaxes(last, 1, 2)] if array.shape[:2] == (4, 4) else found  # HDF5 of other programs
    if array.ndim == 2 and array.shape[1] == 16:
        rows = array.reshape(-1, 4, 4)
        return [rows, np.swapaxes(rows, 1, 2)]
    return [array[None]] if array.shape == (4, 4) else []


_DEGREES = 20.0  # rad that no joint turns


def run_fit(
    job: str,
    files: Sequence[Path],
    parts: Callable[[Samples], tuple[np.ndarray, ...]],
    fit: Callable[..., Any],
    wanted: Wanted,
    sources: Sequence[str] = (),
    corrected: Callable[[Any], Mapping[Path, Robot]] = lambda fit: {},
) -> int:
    """Read files of samples, fit all of them together, write what is wanted, and return the exit code.

    `parts` takes arrays of equal length out of one file; `fit` takes these arrays, joined over the files. `corrected`
    names the files of arms that come out of a fit.
    """
    import numpy as np

    wanted.check(wanted.output, (".toml",))
    if not files:
        raise ConfigError("Expected files of samples, got none. Give one or more CSV, MAT or MCAP files.")
    read = [read_samples(path) for path in files]
    hashes = [one.source.rsplit(" ", 1)[-1] for one in read]
    twice = next((one.path for i, one in enumerate(read) if hashes[i] in hashes[:i]), None)
    if twice is not None:
        raise ConfigError(f"Expected different files, got {twice} again. Samples count once: leave it out.")
    arrays = [parts(one) for one in read]
    for part in zip(*arrays, strict=True):
        widths = {array.shape[1:] for array in part}
        if len(widths) > 1:
            shapes = ", ".join(f"{array.shape} in {one.path.name}" for one, array in zip(read, part, strict=True))
            raise LogError(f"Expected files that measured the same, got arrays of {shapes}. Calibrate them one by one.")
    joined = [np.concatenate(part) for part in zip(*arrays, strict=True)]
    found = fit(*joined)
    return wanted.save(job, found, (*(one.source for one in read), *sources), corrected(found))


def measured_rows(
    read: Samples, needed: Sequence[np.ndarray], some: Sequence[np.ndarray] = (), *, every: bool = False
) -> tuple[np.ndarray, ...]:
    """Return the rows in which something was measured; recordings have rows between the samples of a sensor.

    A row has all arrays of `needed`, and one of `some` unless `every`. Returns the rows of `needed`, those of `some`,
    and their numbers in the file.
    """
    import numpy as np

    parts = [*needed, *some]
    lengths = [len(part) for part in parts]
    if len(set(lengths)) > 1:
        raise LogError(f"Expected as many samples of each kind in {read.path}, got {', '.join(map(str, lengths))}.")
    seen = [~np.isnan(part).all(axis=tuple(range(1, part.ndim))) for part in parts]
    there = np.all(seen[: len(needed)], axis=0)
    if some and not every:
        there &= np.any(seen[len(needed) :], axis=0)
    if not there.any():
        raise LogError(f"Expected rows in which all was measured in {read.path}, got none of {len(there)}.")
    _require_whole(read, needed, there)
    if not there.all():
        without = np.count_nonzero(~there)
        note(f"{without} of {len(there)} rows of {read.path.name} have no measurement and do not count")
    if not every:
        there &= _first_times(read, needed, some, there)
    return (*(part[there] for part in parts), np.flatnonzero(there))


def _require_whole(read: Samples, needed: Sequence[np.ndarray], there: np.ndarray) -> None:
    """Refuse rows with some of the numbers of a pose or a vector, by their place in the file; points may be hidden."""
    import numpy as np

    for part in needed:
        if part.ndim == 2 or part.shape[1:] == (4, 4):
            bad = np.flatnonzero(there & np.isnan(part).any(axis=tuple(range(1, part.ndim))))
            if len(bad):
                raise LogError(
                    f"Expected whole samples in {read.path}, got numbers missing in {len(bad)} of {len(there)} rows, "
                    f"first in row {bad[0]} (from 0). Empty all of the measurement of such a row, or mend it."
                )


def _first_times(
    read: Samples, needed: Sequence[np.ndarray], some: Sequence[np.ndarray], there: np.ndarray
) -> np.ndarray:
    """Return which rows (N,) are no copy of an earlier one: the same sample twice tells nothing new of the noise."""
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
        note(f"{len(numbers) - len(seen)} of {len(numbers)} rows of {name} are copies of others and count once")
    kept = np.flatnonzero(first)
    for part in flat[len(needed) if some else 1 :]:
        if part.shape[1] >= 3:
            held = np.count_nonzero((part[kept][1:] == part[kept][:-1]).all(axis=1))
            if held:
                note(f"{held} rows of {name} repeat the measurement of the row before: held values?")
    return first


def noise_of(values: Sequence[float] | None) -> Any:
    """Return the deviations as the fits take them: None, one number, or a tuple."""
    return None if values is None else values[0] if len(values) == 1 else tuple(values)


def tool_poses(read: Samples, robot: str | None) -> np.ndarray:
    """Return T_base_tool (N, 4, 4) as it was recorded, or of the joint positions of a robot that is named."""
    if robot is None:
        return read.poses("T_base_tool")
    import numpy as np

    arm = armlab.robots.load(robot)
    q = read.vectors("q", (arm.n,))
    far = np.nanmax(np.abs(q[:, ~arm.prismatic]), initial=0.0)
    if far > _DEGREES:
        raise LogError(
            f"Expected joint angles q in radians in {read.path}, got up to {far:.4g}. These seem to be degrees: write "
            "their unit into the header, q1 [deg]."
        )
    return armlab.kinematics.forward(arm, q)


_MANY = 0.3  # share of samples beyond which those left out are no outliers
_FEW = 1.5  # measurements per parameter
_ROUGH = {"[m]": 0.01, "[rad]": 0.05}  # beyond it is no noise of a sensor, but records that do not fit


@Parameter(name="*")
@dataclass(frozen=True)
class Wanted(Results):
    """Output options of a calibration."""

    output: Annotated[
        Path | None, Parameter(alias="-o", help="Save the result with its covariance, ends in .toml.")
    ] = None

    def save(self, job: str, fit: Fit[Any], sources: tuple[str, ...], arms: Mapping[Path, Robot]) -> int:
        """Print the fit, write the files that are wanted, corrected arms among them, and return the exit code."""
        verdict = judge(fit)
        self.say({**numbers(fit), "sources": list(sources)}, fit.report(), verdict)
        saves: dict[Path, Callable[[Path], object]] = {
            path: partial(armlab.robots.save, arm) for path, arm in arms.items()
        }
        if self.output is not None:
            saves[self.output] = partial(fit.save, sources=sources)
        code = self.keep(verdict, saves)
        self.write(lambda plots: plots.calibration(fit), lambda _: _page(job, fit, verdict, sources))
        return code


NOTHING = Wanted()


def numbers(fit: Fit[Any]) -> dict[str, Any]:
    """Return the fit as numbers for scripts."""
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
    """Return what can be relied on, what not, and what to do next."""
    import numpy as np

    found = Verdict()
    left, total = int(fit.outliers.sum()), len(fit.outliers)
    found.good.append(f"{fit.n} samples identify all {fit.excitation.expected} directions asked for.")
    if fit.excitation.held:
        found.good.clear()
        found.bad.append(f"A prior fixes what the samples do not identify: {'; '.join(fit.excitation.held)}.")
    if left > _MANY * total:
        found.bad.append(f"{left} of {total} samples were left out: these are not a few mistakes.")
        found.ahead.append("Look for the cause in pairing, clocks and units before you use the result.")
    elif left:
        found.ahead.append(f"Look at the {left} samples that were left out.")
    found.bad.extend(f"{line[:1].upper()}{line[1:]}" for line in fit.doubts)
    for name, sigma in zip(fit.classes, fit.sigma.ravel().tolist(), strict=False):
        if sigma > _ROUGH.get(f"[{name.rpartition('[')[2]}", np.inf):
            found.bad.append(f"Noise of {name} of {sigma:.2g} is no noise of a sensor: some samples are wrong, or all.")
            found.ahead.append("Look for them with --robust, and check pairing, units and frames.")
    if np.isfinite(fit.residuals).sum() < _FEW * len(fit.names):
        found.bad.append("There are hardly more measurements than parameters: noise and deviations are guesses.")
        found.ahead.append("Take more samples.")
    found.ahead.append(f"The worst direction is {fit.excitation.weakest}; samples that excite it improve most.")
    return found


def _page(job: str, fit: Fit[Any], verdict: Verdict, sources: tuple[str, ...]) -> Any:
    from armlab.plots.style import png

    page = HtmlReport(f"Calibration: {job}", f"From {'; '.join(sources)}.")
    page.verdict(verdict)
    page.section("Residuals, ellipses, excitation", "In standard deviations of the noise; a straight line is normal.")
    page.figure(png(armlab.plots.calibration(fit)), "residuals per sample, quantiles, ellipses, singular values")
    page.section("Parameters")
    rows = zip(fit.names, fit.parameters, fit.sd, fit.units, strict=True)
    page.table([
        ["parameter", "value", "deviation", "unit"],
        *([name, f"{value:.6g}", f"{sd:.2g}", unit] for name, value, sd, unit in rows),
    ])  # fmt: skip
    page.section("In words")
    page.verbatim(fit.report())
    return page
