"""`estimate`: the contact force in many logs, on any executor, a file of it for each."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from armlab.contact import Estimator, contacts
from armlab.contact.estimator import Method
from armlab.errors import LogError
from armlab.fleet.logs import Log, as_table, named, targets
from armlab.fleet.mapping import Done, Progress, map_logs
from armlab.identify import with_velocity
from armlab.log import write
from armlab.models import TorqueModel
from armlab.robots import Robot

__all__ = ["Estimated", "estimate"]


@dataclass(frozen=True)
class Estimated:
    """What one log said of the force.

    Attributes
    ----------
    path : file with the columns of the estimate, a row for each of the log.
    rows, seconds : of the log.
    left_out : rows without an estimate.
    contacts : intervals of contact.
    contact_seconds : their sum.
    peak : largest estimated force while in contact [N], NaN without any.
    band : mean 2-sigma of the worst axis [N].
    """

    path: Path
    rows: int
    seconds: float
    left_out: int
    contacts: int
    contact_seconds: float
    peak: float
    band: float


def estimate(
    logs: Iterable[str | Path] | str | Path,
    model: TorqueModel,
    robot: Robot,
    folder: Path,
    executor: Executor | None = None,
    progress: Progress | None = None,
    *,
    method: Method = "map",
    ending: str = ".mcap",
    force: bool = False,
) -> Done[Estimated]:
    """Estimate the contact force in many logs of one arm, each as ``armlab estimate`` does.

    Parameters
    ----------
    logs : files or folders.
    model : of the arm.
    robot : the arm.
    folder : where the files of the estimates go, each whole or not at all.
    executor, progress : see `identify`.
    method : of `contact.Estimator`.
    ending : format of the files.
    force : replace files that exist.

    Returns
    -------
    Done: `Estimated` by name of the log; logs that cannot be used are skipped with a sentence.

    Raises
    ------
    LogError : there are no logs, or all were skipped. ConfigError : a file exists.
    ModelMismatchError : a model of another arm. UnknownName : another method.
    """
    Estimator(model, robot, method)  # a mistake shows before any work
    jobs = named(logs)
    paths = targets(jobs, Path(folder), ending, "_estimate", force)
    work = {name: (log, paths[name]) for name, log in jobs.items()}
    tell = progress or (lambda done, total, what: None)
    shared = model, robot, method
    return map_logs(_work, work, *shared, executor=executor, progress=tell, rows=lambda one: one.rows).some()


def _work(job: tuple[Log, Path], model: TorqueModel, robot: Robot, method: Method) -> Estimated:
    log, path = job
    given = with_velocity(as_table(log, robot))
    table = Estimator(model, robot, method).run(given)
    known = np.isfinite(table["wrench_hat"]).all(axis=1)
    if not known.any():
        raise LogError(f"Expected rows with finite q, qd, tau in {log}, got none among {len(table)}.")
    found = contacts(table)
    inside = np.zeros(len(table), dtype=bool)
    for one in found:
        inside |= (table.t >= one.start) & (table.t <= one.end)
    size = np.linalg.norm(table["wrench_hat"][:, :3], axis=1)
    sigma = np.sqrt(np.diagonal(table["wrench_hat_cov"][known, :3, :3], axis1=1, axis2=2))
    path.parent.mkdir(parents=True, exist_ok=True)
    write(table.select(*(name for name in table.names if name not in given.names)), path, robot)
    return Estimated(
        path=path,
        rows=len(table),
        seconds=float(table.t[-1] - table.t[0]),
        left_out=int(np.count_nonzero(~known)),
        contacts=len(found),
        contact_seconds=sum(one.end - one.start for one in found),
        peak=float(np.nanmax(size[inside])) if (inside & known).any() else float("nan"),
        band=float(2.0 * sigma.mean(axis=0).max()),
    )
