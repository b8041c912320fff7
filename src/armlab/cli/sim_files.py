"""Files of ``armlab sim``: the operator's wrench, the hand's path, the exact state."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

import numpy as np

from armlab.cli.texts import read_text
from armlab.errors import ConfigError, LogError
from armlab.sim.events import AppliedWrench, HandPath

if TYPE_CHECKING:
    from armlab.sim.controller.channel import UdpClient
    from armlab.sim.controller.controller import SimulatedController

__all__ = ["Written", "read_hand", "read_operator", "truth_writer"]

_OPERATOR = ("t", "fx", "fy", "fz", "mx", "my", "mz")
_SHOWN = 80  # characters of a wrong line that a message quotes


def read_operator(path: Path) -> AppliedWrench:
    """Return the operator described by a CSV file with the header ``t,fx,fy,fz,mx,my,mz``.

    Parameters
    ----------
    path : the file; one row per time, times increasing.

    Raises
    ------
    ConfigError : when the file cannot be read or a row is wrong; names file and line.
    """
    table = _read(path, _OPERATOR, "an operator file")
    return AppliedWrench(table[:, 0], table[:, 1:])


def read_hand(path: Path, n: int) -> HandPath:
    """Return the path of a hand described by a CSV file with the header ``t,q1,q2,...``.

    Parameters
    ----------
    path : the file; at least two rows, times increasing. n : number of joints.

    Raises
    ------
    ConfigError : when the file cannot be read or a row is wrong; names file and line.
    """
    table = _read(path, ("t", *(f"q{i + 1}" for i in range(n))), "a hand path")
    if len(table) < 2:
        raise ConfigError(f"Expected at least two rows in {path}, got {len(table)}.")
    return HandPath(table[:, 0], table[:, 1:])


def _read(path: Path, names: Sequence[str], what: str) -> np.ndarray:
    """Return the numbers of a CSV file whose first column is a time that increases."""
    header, *lines = read_text(path, what).splitlines() or [""]
    if tuple(word.strip() for word in header.split(",")) != tuple(names):
        raise ConfigError(f"Expected the header {','.join(names)} in line 1 of {path}, got {header[:_SHOWN]!r}.")
    rows: list[list[float]] = []
    for number, line in enumerate(lines, start=2):
        if not line.strip():
            continue
        row = _numbers(line.split(","))
        if len(row) != len(names) or not all(math.isfinite(value) for value in row):
            raise ConfigError(f"Expected {len(names)} numbers in line {number} of {path}, got {line[:_SHOWN]!r}.")
        if rows and row[0] <= rows[-1][0]:
            raise ConfigError(
                f"Expected times that increase in line {number} of {path}, got {row[0]:g} s after {rows[-1][0]:g} s."
            )
        rows.append(row)
    return np.array(rows).reshape(len(rows), len(names))


def _numbers(words: Iterable[str]) -> list[float]:
    """Return the words as numbers; nothing when one of them is none."""
    try:
        return [float(word) for word in words]
    except ValueError:
        return []


class Written:
    """A text file that is written from its beginning; what goes wrong names it.

    Parameters
    ----------
    path : the file.

    Raises
    ------
    LogError : it cannot be opened, written or closed, as on a full disk; also from its methods.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        with self._named():
            self._file: TextIO = path.open("w", encoding="utf-8")

    def __enter__(self) -> Written:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        with self._named(quiet=kind is not None):  # an error that is on its way already says more
            self._file.close()

    def write(self, text: str) -> None:
        """Add a text.

        Parameters
        ----------
        text : with its line ends.
        """
        with self._named():
            self._file.write(text)

    @contextlib.contextmanager
    def _named(self, quiet: bool = False) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            if not quiet:
                raise LogError(
                    f"Expected to write {self._path}, got: {error.strerror}. Make room there or choose another file."
                ) from None


def truth_writer(file: Written, controller: SimulatedController) -> Callable[[UdpClient], None]:
    """Write the header of the truth file and return what writes a row per packet.

    Parameters
    ----------
    file : open for writing. controller : of the arm whose exact state is written.
    """
    joints = {"q": "rad", "qd": "rad/s", "qdd": "rad/s^2", "tau": "N m", "tau_friction": "N m"}
    n = controller.arm.robot.n
    header = ["robot_ns", "session", "seq", "t [s]"]
    header += [f"wrench_true{i + 1} [{'N' if i < 3 else 'N m'}]" for i in range(6)]
    header += [f"{name}{i + 1} [{unit}]" for name, unit in joints.items() for i in range(n)]
    file.write(",".join(header) + "\n")

    def write(_: UdpClient) -> None:
        sample = controller.arm.sample
        numbers = np.concatenate([sample.wrench, *(getattr(sample, name) for name in joints)])
        stamp = f"{controller.robot_ns},{controller.session},{controller.seq - 1},{controller.guidance_time:.6f}"
        file.write(stamp + "," + ",".join(map(repr, numbers.tolist())) + "\n")

    return write
