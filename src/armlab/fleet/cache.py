"""`SumCache`: sums of logs kept on the disk, so that ten logs more cost ten logs and an interrupted run goes on.

A file is named by what its sums depend on: the bytes of the log, the pattern (which holds the robot), the version of
armlab and that of the sums. Plain arrays in the .npz format, never objects; a file that does not read is made anew.
"""

from __future__ import annotations

import hashlib
import os
import zipfile
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from armlab import __version__
from armlab.errors import ShapeError
from armlab.estimation.tsqr import Factors
from armlab.identify.many import LogSums, Pattern
from armlab.models import Training

__all__ = ["SumCache", "default_folder"]

VERSION = 2  # of the sums: another when the same log gives others
_PIECE = 1 << 20
_TRAINING = ("q_min", "q_max", "qd_peak", "speed_share", "rest_share", "longest_rest")


def default_folder() -> Path:
    """Return where the sums of this user are kept."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "armlab" / "sums"


class SumCache:
    """Sums of logs in a folder.

    Parameters
    ----------
    folder : made when it is missing; see `default_folder`. pattern : of the draft.
    """

    def __init__(self, folder: Path, pattern: Pattern) -> None:
        self._folder, self._pattern = folder, pattern.sha256

    def path(self, log: Path) -> Path:
        """Return the file that keeps the sums of a log.

        Parameters
        ----------
        log : file that exists.
        """
        digest = hashlib.sha256(f"{__version__} {VERSION} {self._pattern} ".encode())
        with log.open("rb") as file:
            while part := file.read(_PIECE):
                digest.update(part)
        return self._folder / f"{digest.hexdigest()}.npz"

    def load(self, path: Path) -> LogSums | None:
        """Return the sums kept in a file, None when there are none that read.

        Parameters
        ----------
        path : from `path`.
        """
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as kept:
                return _sums(kept)
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, ShapeError):
            return None

    def save(self, path: Path, sums: LogSums) -> None:
        """Keep sums, whole or not at all; where the disk takes none they are made again the next time.

        Parameters
        ----------
        path : from `path`. sums : of that log.
        """
        groups = {
            f"{name}{g}": part[g]
            for name in ("R", "columns")
            for part in [getattr(sums.factors, name)]
            for g in range(len(part))
        }
        training = {name: getattr(sums.training, name) for name in _TRAINING}
        numbers = {
            "counts": np.array([sums.factors.size, sums.inside, sums.n]),
            "reals": np.array([sums.weight, sums.seconds]),
            "source": np.array(sums.source),
        }
        with suppress(OSError):
            self._folder.mkdir(parents=True, exist_ok=True)
            with TemporaryDirectory(dir=self._folder) as own:  # others may keep the sums of an equal file just now
                part = Path(own, path.name)
                np.savez(part, allow_pickle=False, rows=sums.factors.rows, **groups, **training, **numbers)
                part.replace(path)


def _sums(kept: Any) -> LogSums:
    size, inside, n = kept["counts"].tolist()
    weight, seconds = kept["reals"].tolist()
    classes = range(kept["rows"].shape[1])
    R, columns = (tuple(kept[f"{name}{g}"] for g in classes) for name in ("R", "columns"))
    about = {name: kept[name] for name in _TRAINING}
    about |= {name: float(about[name]) for name in _TRAINING[-2:]}
    factors = Factors(size, columns, R, kept["rows"])
    return LogSums(factors, weight, inside, n, seconds, Training(**about), str(kept["source"]))
