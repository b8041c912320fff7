"""Tables of an estimate: per axis, per contact, and the columns that are written."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from armlab.contact import Contact, Hypotheses
    from armlab.log import Table

__all__ = ["AXES", "axes", "columns", "contact_rows", "limits", "places", "rows"]

COLUMNS = ("wrench_hat", "wrench_hat_cov", "observability", "wrench_flags", "wrench_active", "wrench_interval")
AXES = ("f_x", "f_y", "f_z", "m_x", "m_y", "m_z")


def axes(table: Table) -> list[dict[str, float | str]]:
    """Return range, RMS, mean 2-sigma and observability of each axis of the wrench.

    Parameters
    ----------
    table : of `contact.Estimator.run`.
    """
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
            **_limits(table, i),
        }
        for i in range(6)
    ]


def _limits(table: Table, axis: int) -> dict[str, float]:
    """Return the median lower and upper limit of an axis and the share of rows in which they exclude zero."""
    if "wrench_interval" not in table:
        return {}
    low, high = table["wrench_interval"][:, axis].T
    if not np.isfinite(low).any():
        return {"limit_low": np.nan, "limit_high": np.nan, "proven": 0.0}
    proven = float(np.mean((low > 0) | (high < 0)))
    return {"limit_low": float(np.nanmedian(low)), "limit_high": float(np.nanmedian(high)), "proven": proven}


def limits(table: Table, contact: Contact) -> list[tuple[float, float]]:
    """Return the median limits of the force in x, y, z during a contact; nothing without the method "interval".

    Parameters
    ----------
    table : of `contact.Estimator.run`. contact : found in it.
    """
    if "wrench_interval" not in table:
        return []
    inside = table["wrench_interval"][(table.t >= contact.start) & (table.t <= contact.end), :3]
    inside = inside[np.isfinite(inside).all(axis=(1, 2))]
    return [(float(low), float(high)) for low, high in np.median(inside, axis=0)] if len(inside) else []


def rows(table: Table) -> list[tuple[str, ...]]:
    """Return the table per axis as words, its head first.

    Parameters
    ----------
    table : of `contact.Estimator.run`.
    """
    words = {"min": "min", "max": "max", "rms": "rms", "two_sigma": "2-sigma", "observability": "observability"}
    if "wrench_interval" in table:
        words |= {"limit_low": "limit from", "limit_high": "limit to", "proven": "share beyond zero"}
    lines = ((str(axis["axis"]), *(f"{axis[key]:.2f}" for key in words)) for axis in axes(table))
    return [("axis", *words.values()), *lines]


def columns(table: Table, believed: Hypotheses | None) -> Table:
    """Return what is written of an estimate: its columns, and the probability of each place of the contact.

    Those are columns p_none, p_point, p_link_1 and so on, of the window nearest to the row.

    Parameters
    ----------
    table : of `contact.Estimator.run`. believed : of `contact.hypotheses`, or None.
    """
    written = table.select(*(name for name in COLUMNS if name in table))
    if believed is not None:
        middles = 0.5 * (believed.t[1:] + believed.t[:-1])
        nearest = np.searchsorted(middles, table.t)
        for k, name in enumerate(believed.names):
            written = written.with_column(f"p_{name.replace(' ', '_')}", believed.posterior[nearest, k], unit="1")
    return written


def places(contacts: Sequence[Contact], believed: Hypotheses | None) -> list[tuple[Contact, str]]:
    """Return each contact with what is believed of its place, in words.

    Parameters
    ----------
    contacts : found. believed : of `contact.hypotheses`; without it the words are empty.
    """
    return [(c, "" if believed is None else believed.during(c.start, c.end)) for c in contacts]


def contact_rows(table: Table, contacts: Sequence[Contact], believed: Hypotheses | None) -> list[tuple[str, ...]]:
    """Return the contacts as words, the head first; forces with their limits where the method tells any.

    Parameters
    ----------
    table : of `contact.Estimator.run`. contacts : found in it. believed : of `contact.hypotheses`, or None.
    """
    found: list[tuple[str, ...]] = [
        ("from [s]", "to [s]", "f_x [N]", "f_y [N]", "f_z [N]", "2-sigma [N]", "where it may be")
    ]
    for c, place in places(contacts, believed):
        within = [f" ({low:+.2f} to {high:+.2f})" for low, high in limits(table, c)] or [""] * 3
        forces = (f"{force:+.2f}{limit}" for force, limit in zip(c.force, within, strict=True))
        found.append((f"{c.start:.2f}", f"{c.end:.2f}", *forces, f"{c.band:.2f}", place or "-"))
    return found
