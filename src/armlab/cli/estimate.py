"""``armlab estimate``: the contact wrench in a log, with its uncertainty."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from armlab.log import Table

__all__ = ["estimate"]

AXES = ("f_x", "f_y", "f_z", "m_x", "m_y", "m_z")


def estimate(
    robot: str, log: Path, *, model: Path, figure: Path | None = None, json: bool = False, force: bool = False
) -> int:
    """Estimate the contact force in a log with a model.

    Prints, per axis, the range of the estimate, its mean 2-sigma band and how well the arm could see that axis, then
    each interval of contact with its mean force.

    Parameters
    ----------
    robot : str
        Name in the library, or a robot file; the one the model belongs to.
    log : Path
        Recording with positions, velocities and torques.
    model : Path
        Model file of `armlab identify`.
    figure : Path
        Also draw the estimate with its 2-sigma band into this PNG, SVG or PDF.
    json : bool
        Print JSON for scripts.
    force : bool
        Replace an existing figure.
    """
    from armlab import log as logs
    from armlab import models, robots
    from armlab.cli.output import FIGURES, check_output, note, print_json, result
    from armlab.contact import INVALID, Estimator, contacts
    from armlab.errors import LogError

    if figure is not None:
        check_output(figure, force, FIGURES)
    estimator = Estimator(models.load(model), robots.load(robot))
    table = estimator.run(logs.read(log))
    invalid = int((table["wrench_flags"] & INVALID).astype(bool).sum())
    if invalid == len(table):
        raise LogError(
            f"Expected rows with finite q, qd, tau in {log}, got none among {len(table)}. "
            "Record with the research extension, which sends torques."
        )
    if invalid:
        note(f"{invalid} of {len(table)} rows are not finite and have no estimate")
    found = contacts(table)
    if json:
        print_json({"rows": len(table), "contacts": [vars(contact) for contact in found], "axes": _per_axis(table)})
    else:
        result(_text(table))
        for contact in found:
            f = "  ".join(f"{value:+.2f}" for value in contact.force)
            span = f"{contact.start:7.2f} to {contact.end:7.2f} s"
            result(f"contact {span}   force [N]  {f}   2-sigma {contact.band:.2f}")
        if not found:
            result("no contact: the force band never excludes zero for 0.2 s")
    if figure is not None:
        from armlab import plots

        plots.wrench(table).savefig(figure, dpi=150)
        note(f"figure: {figure}")
    return 0


def _per_axis(table: Table) -> list[dict[str, float | str]]:
    import numpy as np

    F, observability = table["wrench_hat"], table["observability"]
    sigma = np.sqrt(np.einsum("kii->ki", table["wrench_hat_cov"]))
    return [
        {
            "axis": AXES[i],
            "min": float(np.nanmin(F[:, i])),
            "max": float(np.nanmax(F[:, i])),
            "rms": float(np.sqrt(np.nanmean(F[:, i] ** 2))),
            "two_sigma": float(2 * np.nanmean(sigma[:, i])),
            "observability": float(np.nanmean(observability[:, i])),
        }
        for i in range(6)
    ]


def _text(table: Table) -> str:
    from armlab.cli.output import aligned

    rows = [("axis", "min", "max", "rms", "2-sigma", "observability")]
    rows += [
        (str(a["axis"]), *(f"{a[key]:.2f}" for key in ("min", "max", "rms", "two_sigma", "observability")))
        for a in _per_axis(table)
    ]
    return aligned(rows, right=(1, 2, 3, 4, 5))
