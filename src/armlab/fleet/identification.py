"""`identify` fits one torque model to many logs with bit-identical results on any executor; `SumCache` stores the sums.

With a cache, adding ten logs takes only as long as processing those ten logs, and an interrupted run can be resumed.
The name of a cache file is a hash of everything that determines its sums: the bytes of the log, its column names, the
pattern (which includes the robot), the armlab version and the version of the sums. The file contains plain arrays in
the .npz format, never objects; an unreadable file is rewritten.
"""

from __future__ import annotations

import hashlib
import math
import os
import zipfile
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from armlab import __version__
from armlab.errors import LogError, NotExcited, ShapeError
from armlab.estimation import Fit
from armlab.estimation.tsqr import Factors
from armlab.fleet.logs import Log, as_table, named
from armlab.fleet.mapping import Progress, map_logs
from armlab.identify.dynamics import FitProblem
from armlab.identify.friction_structure import Chooser, FrictionStructure, StructureChoice, choose
from armlab.identify.many import LogSums, Pattern, fit_draft, fit_sums, log_sums, same_rate
from armlab.identify.record import prepare_share
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.models.torque import Training
from armlab.robots import Robot

DRAFT_SECONDS = 200.0  # s, total duration of the first logs: ten logs of 20 s
AT_ONCE = 4  # maximum number of logs tested at once


@dataclass(frozen=True, eq=False)
class Identified:
    """Result of the identification from many logs.

    Attributes
    ----------
    fit : fit of the model; `fit.value.sources` lists the logs used and, with the reasons, the skipped logs.
    used : names of the logs used for the fit, in order.
    skipped : reasons for skipping logs, by name.
    """

    fit: Fit[TorqueModel]
    used: tuple[str, ...]
    skipped: Mapping[str, str]

    def report(self) -> str:
        """Return the report of the fit, the number of logs used, and the skipped logs."""
        lines = [self.fit.report(), "", f"{len(self.used)} logs used, {len(self.skipped)} skipped"]
        return "\n".join([*lines, *(f"skipped {name}: {reason}" for name, reason in self.skipped.items())])


def identify(
    logs: Iterable[Table | str | Path] | str | Path,
    robot: Robot,
    executor: Executor | None = None,
    progress: Progress | None = None,
    cache: Path | None = None,
    *,
    columns: str | None = None,
) -> Identified:
    """Identify the torque model of an arm from many logs of free motion.

    The first few minutes are fitted as in `identify.fit_dynamics`. Workers then reduce every log to sums. This process
    adds the sums in the order of the logs, so the result is bit-identical for any executor.

    Parameters
    ----------
    logs : tables, files or folders of one arm, without contact.
    robot : the arm; recordings of other arms are skipped.
    executor : any `concurrent.futures.Executor`, including ``Client.get_executor(pure=False)`` of Dask. Dask workers
        must be able to read the files at the same paths. None: run in this process.
    progress : called with (done, total, what).
    cache : folder for the cached sums of each file; None: no cache.
    columns : column names in files from other programs, see `log.read`.

    Returns
    -------
    Identified. A log is skipped and listed if it is unusable, crashes its worker twice, or repeats the rows of an
    earlier log.

    Raises
    ------
    LogError : no logs were given, or all were skipped (the error states the reason).
    NotExcited : the logs together do not determine all parameters; the error names the undetermined parameters.

    References
    ----------
    docs/theory/identification.md, "Many logs". Demmel et al. (2012) for sums of triangular factors.
    """
    jobs = named(logs)
    tell = progress or (lambda done, total, what: None)
    draft, pattern, first, refused = _draft(jobs, robot, executor, tell, columns)
    rest = {name: log for name, log in jobs.items() if name not in refused}
    done = map_logs(_work, rest, pattern, cache, columns, executor=executor, progress=tell, rows=lambda sums: sums.n)
    lost = [name for name in first if name not in done.results]
    if lost:
        raise LogError(f"Expected {lost[0]} to remain readable, but: {done.skipped[lost[0]]}")
    copies = _copies({}, {name: sums.source.rpartition(":")[2] for name, sums in done.results.items()})
    used = [name for name in done.results if name not in copies]
    fit = fit_sums(draft, pattern, [done.results[name] for name in used], [used.index(name) for name in first])
    reasons = {**refused, **done.skipped, **copies}
    skipped = {name: reasons[name] for name in jobs if name in reasons}
    sources = tuple(f"{name} skipped: {reason}" for name, reason in skipped.items())
    fit = replace(fit, value=replace(fit.value, sources=(*fit.value.sources, *sources)))
    return Identified(fit, tuple(used), skipped)


def _draft(
    jobs: Mapping[str, Log], robot: Robot, executor: Executor | None, tell: Progress, columns: str | None
) -> tuple[FitProblem, Pattern, list[str], Mapping[str, str]]:
    """Fit as many of the first usable logs as the model needs.

    Also return the names of the fitted logs, and the reasons why the logs before and between them are unusable. Workers
    test each log before it is read in this process, so a log that crashes its reader does not crash this process.
    """
    tried = _Tried(jobs, (robot, columns), executor, lambda: tell(0, 5, "reading the first logs"))
    wanted = DRAFT_SECONDS
    while True:
        names = tried.of(wanted)
        if not names:
            reasons = [f"{name}: {reason}" for name, reason in tried.refused.items()]
            raise LogError(f"Expected a usable log among {len(jobs)}, got none. {reasons[0]}")
        try:
            try:
                tables = [as_table(jobs[name], robot, columns) for name in names]
            except OSError as error:
                raise LogError(f"Expected the first logs to remain readable, but: {error}") from None
            draft, pattern = fit_draft(tables, robot, len(jobs), tell, _chooser(executor, tell))
        except NotExcited:
            if tried.all and names == tried.of(math.inf):  # workers may have tested more logs than the fit needed
                raise
            wanted = 2.0 * max(wanted, sum(tried.known[name][1] for name in names))
        else:
            return draft, pattern, names, tried.refused


class _Tried:
    """Rate and duration of each of the first logs, or the reason why the log is unusable."""

    def __init__(
        self,
        jobs: Mapping[str, Log],
        arm: tuple[Robot, str | None],
        executor: Executor | None,
        tell: Callable[[], None],
    ) -> None:
        self._jobs, self._arm, self._executor, self._tell = jobs, arm, executor, tell
        self._waiting = list(jobs)[::-1]
        self._at_once = 1 if executor is None else min(getattr(executor, "_max_workers", AT_ONCE), AT_ONCE)
        self.known: dict[str, tuple[float, float]] = {}  # rate [Hz] and duration [s]
        self._rows: dict[str, str] = {}
        self.refused: dict[str, str] = {}

    @property
    def all(self) -> bool:
        return not self._waiting

    def of(self, wanted: float) -> list[str]:
        """Return the names of the first logs with equal rates that add up to at least `wanted` seconds, or of all such
        logs if the total is shorter."""
        while True:
            names, seconds = [], 0.0
            rates = [rate for rate, _ in self.known.values()]
            for name, (rate, length) in self.known.items():
                if seconds < wanted and same_rate(rate, rates[0]):
                    names.append(name)
                    seconds += length
            if seconds >= wanted or self.all:
                return names
            some = [self._waiting.pop() for _ in range(min(self._at_once, len(self._waiting)))]
            done = map_logs(
                _try, {name: self._jobs[name] for name in some}, *self._arm,
                executor=self._executor, progress=lambda done, total, what: self._tell(),
            )  # fmt: skip
            copies = _copies(self._rows, {name: sha256 for name, (*_, sha256) in done.results.items()})
            self.known |= {name: found[:2] for name, found in done.results.items() if name not in copies}
            self.refused |= {**done.skipped, **copies}


def _copies(known: dict[str, str], rows: Mapping[str, str]) -> dict[str, str]:
    """Return the reason for skipping each log that repeats the rows of an earlier log; `known` maps row hashes to
    names."""
    return {
        name: f"it repeats the rows of {known[sha256]}, which would count the same data twice"
        for name, sha256 in rows.items()
        if known.setdefault(sha256, name) != name
    }


def _try(log: Log, robot: Robot, columns: str | None) -> tuple[float, float, str]:
    """Return the rate [Hz] of a usable log, its last time [s], and the SHA-256 of its rows."""
    table = as_table(log, robot, columns)
    return prepare_share(table, robot).rate, float(table.t[-1]), table.sha256


def _chooser(executor: Executor | None, tell: Progress) -> Chooser:
    """Return the function that selects the friction structure of the joints on an executor."""

    def choose_all(choices: Iterable[StructureChoice]) -> list[FrictionStructure]:
        joints = {f"joint {number + 1}": choice for number, choice in enumerate(choices)}
        done = map_logs(
            choose, joints, executor=executor, kind="joint",
            progress=lambda done, total, what: tell(2, 5, f"friction structure, {done} of {total} joints"),
        )  # fmt: skip
        if done.skipped:
            name, reason = next(iter(done.skipped.items()))
            raise LogError(f"Expected a friction structure for {name}, but its selection failed: {reason}")
        return list(done.results.values())

    return choose_all


def _work(log: Log, pattern: Pattern, cache: Path | None, columns: str | None) -> LogSums:
    """Return the sums of one log, from the cache if available."""
    if cache is None or isinstance(log, Table) or not log.is_file():
        return log_sums(as_table(log, pattern.robot, columns), pattern)
    known = SumCache(cache, pattern, columns)
    path = known.path(log)
    sums = known.load(path)
    if sums is None:
        sums = log_sums(as_table(log, pattern.robot, columns), pattern)
        known.save(path, sums)
    return sums


VERSION = 2  # version of the sums, increased when the same log gives different sums
_PIECE = 1 << 20
_TRAINING = ("q_min", "q_max", "qd_peak", "speed_share", "rest_share", "longest_rest")


def default_folder() -> Path:
    """Return the folder of this user's cached sums."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "armlab" / "sums"


class SumCache:
    """Cache of sums in a folder, which is created if missing."""

    def __init__(self, folder: Path, pattern: Pattern, columns: str | None = None) -> None:
        self._folder, self._pattern = folder, f"{pattern.sha256} {columns or ''}"

    def path(self, log: Path) -> Path:
        digest = hashlib.sha256(f"{__version__} {VERSION} {self._pattern} ".encode())
        with log.open("rb") as file:
            while part := file.read(_PIECE):
                digest.update(part)
        return self._folder / f"{digest.hexdigest()}.npz"

    def load(self, path: Path) -> LogSums | None:
        """Return the sums in a file, or None if it is missing or damaged."""
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as kept:
                size, inside, n = kept["counts"].tolist()
                weight, seconds = kept["reals"].tolist()
                classes = range(kept["rows"].shape[1])
                R, columns = (tuple(kept[f"{name}{g}"] for g in classes) for name in ("R", "columns"))
                about = {name: kept[name] for name in _TRAINING}
                about |= {name: float(about[name]) for name in _TRAINING[-2:]}
                factors = Factors(size, columns, R, kept["rows"])
                return LogSums(factors, weight, inside, n, seconds, Training(**about), str(kept["source"]))
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, ShapeError):
            return None

    def save(self, path: Path, sums: LogSums) -> None:
        """Write sums atomically; after a disk error they are recomputed in the next run."""
        groups = {
            f"{name}{g}": part[g]
            for name, part in (("R", sums.factors.R), ("columns", sums.factors.columns))
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
            with TemporaryDirectory(dir=self._folder) as own:  # another process may save the same sums at the same time
                part = Path(own, path.name)
                np.savez(part, allow_pickle=False, rows=sums.factors.rows, **groups, **training, **numbers)
                part.replace(path)
