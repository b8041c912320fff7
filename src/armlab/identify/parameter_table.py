"""The parameters of a torque model: value, deviation, unit, and the combination that each stands for."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from armlab.estimation import Fit
    from armlab.models import TorqueModel

__all__ = ["parameter_rows", "parameter_text"]


def parameter_rows(fit: Fit[TorqueModel]) -> list[tuple[str, str, str, str]]:
    """Return value, deviation, unit and name of each parameter as words: base parameters, then those of the drives.

    Parameters
    ----------
    fit : of `fit_dynamics` or `fit_gravity`.
    """
    columns = zip(fit.parameters, fit.sd, fit.units, fit.names, strict=True)
    return [(f"{value:.4g}", f"{sd:.2g}", unit, name) for value, sd, unit, name in columns]


def parameter_text(fit: Fit[TorqueModel]) -> str:
    """Return one line per parameter; numbers first, since the combinations are of any length.

    Parameters
    ----------
    fit : of `fit_dynamics` or `fit_gravity`.
    """
    head, rows = ("value", "sd", "unit", "parameter"), parameter_rows(fit)
    value, sd, unit = (max(map(len, column)) for column in list(zip(head, *rows))[:3])
    lines = [f"{head[0]:>{value}}    {head[1]:<{sd}}  {head[2]:<{unit}}  {head[3]}"]
    lines += [f"{x:>{value}} +- {deviation:<{sd}}  {of:<{unit}}  {name}" for x, deviation, of, name in rows]
    return "\n".join(lines)
