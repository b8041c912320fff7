"""`identify`: one torque model from many logs, on any executor, with the same bits as here."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path

from armlab.errors import ArmlabError, LogError, NotExcited
from armlab.estimation import Fit
from armlab.fleet.cache import SumCache
from armlab.fleet.logs import Log, as_table, named
from armlab.fleet.mapping import Progress, each
from armlab.identify.drafting import Draft
from armlab.identify.many import LogSums, Pattern, fit_draft, fit_sums, log_sums, same_rate
from armlab.identify.preparation import prepare_share
from armlab.log import Table
from armlab.models import TorqueModel
from armlab.robots import Robot

__all__ = ["Identified", "identify"]

DRAFT_SECONDS = 200.0  # of the first logs: ten of 20 s


@dataclass(frozen=True, eq=False)
class Identified:
    """What many logs gave.

    Attributes
    ----------
    fit : of the model; `fit.value.sources` names the logs and, with the reason, those that were skipped.
    used : names of the logs behind it, in order. skipped : the reason by name.
    """

    fit: Fit[TorqueModel]
    used: tuple[str, ...]
    skipped: Mapping[str, str]

    def report(self) -> str:
        """Return the report of the fit, then how many logs were used and which were not."""
        lines = [self.fit.report(), "", f"{len(self.used)} logs used, {len(self.skipped)} skipped"]
        return "\n".join([*lines, *(f"skipped {name}: {reason}" for name, reason in self.skipped.items())])


def identify(
    logs: Iterable[Table | str | Path] | str | Path,
    robot: Robot,
    executor: Executor | None = None,
    progress: Progress | None = None,
    cache: Path | None = None,
) -> Identified:
    """Identify the torque model of an arm from many logs of free motion.

    The first few minutes are fitted as `identify.fit_dynamics` does; then every log is reduced to sums by a worker,
    and the sums are added here in the order of the logs: the result has the same bits on any executor.

    Parameters
    ----------
    logs : tables, files or folders of one arm, without contact.
    robot : the arm. Files that are recordings of another are skipped.
    executor : any `concurrent.futures.Executor`, also ``Client.get_executor(pure=False)`` of Dask; none: here.
        Its workers read the files by their paths.
    progress : called with (done, total, what).
    cache : folder that keeps the sums of files, so that ten logs more cost ten logs; none: nothing is kept.

    Returns
    -------
    Identified. A log that cannot be used, or that ended its worker twice, is skipped and named.

    Raises
    ------
    LogError : there are no logs, or all were skipped; says why.
    NotExcited : all logs together do not determine everything, by name.

    References
    ----------
    docs/theory/identification.md, "Many logs". Demmel et al. (2012) for sums of triangular factors.
    """
    jobs = named(logs)
    tell = progress or (lambda done, total, what: None)
    draft, pattern, first = _draft(jobs, robot, tell)
    done = each(_work, jobs, pattern, cache, executor=executor, progress=tell, rows=lambda sums: sums.n)
    lost = [name for name in first if name not in done.results]
    if lost:
        raise LogError(f"Expected {lost[0]} to read as before, but: {done.skipped[lost[0]]}")
    used = list(done.results)
    fit = fit_sums(draft, pattern, [done.results[name] for name in used], [used.index(name) for name in first])
    skipped = tuple(f"{name} skipped: {reason}" for name, reason in done.skipped.items())
    fit = replace(fit, value=replace(fit.value, sources=(*fit.value.sources, *skipped)))
    return Identified(fit, tuple(used), done.skipped)


def _draft(jobs: Mapping[str, Log], robot: Robot, tell: Progress) -> tuple[Draft, Pattern, list[str]]:
    """Fit the first logs that can be used, more of them while they do not tell enough; return the names of these."""
    tables: dict[str, Table] = {}
    waiting, wanted, seconds = iter(jobs.items()), DRAFT_SECONDS, 0.0
    rates: list[float] = []
    reasons: list[str] = []
    while True:
        for name, log in waiting:
            try:
                table = as_table(log, robot)
                rate = prepare_share(table, robot).rate
            except (ArmlabError, OSError) as error:
                reasons.append(f"{name}: {error}")
                continue
            rates.append(rate)
            if not same_rate(rate, rates[0]):
                continue
            tables[name] = table
            seconds += float(table.t[-1])
            if seconds >= wanted:
                break
        else:
            wanted = float("inf")
        if not tables:
            raise LogError(f"Expected a log that can be used among {len(jobs)}, got none. {reasons[0]}")
        try:
            draft, pattern = fit_draft(list(tables.values()), robot, len(jobs), tell)
        except NotExcited:
            if wanted == float("inf"):
                raise
            wanted *= 2.0
        else:
            return draft, pattern, list(tables)


def _work(log: Log, pattern: Pattern, cache: Path | None) -> LogSums:
    """Return the sums of one log, kept ones where there are."""
    if cache is None or isinstance(log, Table) or not log.is_file():
        return log_sums(as_table(log, pattern.robot), pattern)
    known = SumCache(cache, pattern)
    path = known.path(log)
    sums = known.load(path)
    if sums is None:
        sums = log_sums(as_table(log, pattern.robot), pattern)
        known.save(path, sums)
    return sums
