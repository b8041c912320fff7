"""``armlab payload``: payload identification from a log and the model of the arm alone."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

import armlab
from armlab.cli.support.html_report import HtmlReport, Verdict
from armlab.cli.support.output import progress
from armlab.cli.support.results import PLAIN, Results, parameters

if TYPE_CHECKING:
    from armlab.cli.support.html_report import Verdict
    from armlab.estimation import Fit
    from armlab.log import Table
    from armlab.models import Payload, TorqueModel
    from armlab.robots import Robot


LARGEST = 0.1  # share of the mass that its deviation may be
LEAST = 3.0  # deviations that a mass must differ from nothing


def payload(
    robot: str,
    log: Path,
    *,
    model: Path,
    without: Path | None = None,
    mode: Literal["static", "dynamic"] = "static",
    gain: float = 0.05,
    output: Annotated[Path | None, Parameter(alias="-o")] = None,
    wanted: Results = PLAIN,
) -> int:
    """Identify a payload at the flange from motor torques: mass, centre and, with --mode dynamic, inertia.

    Prints each with its deviation, in flange axes.

    Parameters:
        robot: Name in the library, or a robot file; the one the model belongs to.
        log: Recording with the load, without contact, with positions, velocities and torques.
        model: Model file of `armlab identify`, of the arm without the load.
        without: Recording of the same motion without the load: what the model has wrong falls out.
        mode: static: mass and centre. dynamic: inertia too, which needs fast motion of the wrist.
        gain: How well the torque constants are known, as a share.
        output: Also save the load, ends in .toml.
    """
    from armlab.cli.support.log_input import read_log
    from armlab.models.files import load_statistics

    wanted.check(output, (".toml",))
    arm, known = armlab.robots.load(robot), armlab.models.load(model, "torque_model")
    told = (
        armlab.estimation.Fit.load(model) if load_statistics(model) else known
    )  # the fit knows what is uncertain in friction
    table = read_log(log, arm)
    empty = None if without is None else read_log(without, arm)
    with progress("payload") as tell:
        tell(0, 1, f"{mode} fit to {len(table)} rows")
        fit = armlab.identify.fit_payload(table, told, arm, mode, empty, gain_sd=gain)
        tell(1, 1, "done")
    verdict = _judge(fit, known, table, arm)
    load = {"mass": fit.value.mass, "centre": fit.value.centre, "pi": fit.value.pi}
    wanted.say({**load, "parameters": parameters(fit), "samples": fit.n}, fit.report(), verdict)
    code = wanted.keep(verdict, {} if output is None else {output: fit.save})
    about = f"{log.name} of {arm.name}, model {model.name}, mode {mode}."
    wanted.write(
        lambda plots: plots.torque_fit(fit.value.added_to(known), table),
        lambda _: _page(fit, known, table, verdict, about),
    )
    return code


def _judge(fit: Fit[Payload], model: TorqueModel, table: Table, arm: Robot) -> Verdict:
    """Return what can be relied on, what not, and what to do next."""
    import numpy as np

    from armlab.cli.identify.report import POOR
    from armlab.identify.payload import moving_joints

    mass, sd = fit.value.mass, fit.sd[0]
    found = Verdict()
    if mass < LEAST * sd:
        found.bad.append(f"{1e3 * mass:.0f} g cannot be told from no load: one deviation is {1e3 * sd:.0f} g.")
    elif sd > LARGEST * mass:
        found.bad.append(f"The mass is known to {100 * sd / mass:.0f} % only.")
        found.ahead.append("Record the same motion without the load and name it by --without.")
    else:
        found.good.append(f"The load of {1e3 * mass:.0f} g is known to {100 * sd / mass:.1f} %.")
    joints = moving_joints([table], arm)
    left = np.std(fit.residuals, axis=0) / np.std(table["tau"][:, joints], axis=0)
    if left.max() <= POOR:
        found.good.append(
            f"Arm and load together explain {100 * (1 - left.max() ** 2):.1f} % of the torque variance or more."
        )
    else:
        worst = arm.joint_names[joints[left.argmax()]]
        found.bad.append(
            f"{worst}: arm and load together leave {100 * left.max():.0f} % of the torque's deviation unexplained."
        )
        found.ahead.append("Check the log's torques, and that the model is of this arm with the tool that it has now.")
    found.bad += fit.doubts
    found.ahead += armlab.identify.extrapolation(model, table).warnings
    found.ahead.append(
        "Use the model of the arm as it is; nothing is to be read from the centre."
        if mass < LEAST * sd
        else "Add the load to the model of the arm: models.load(…).added_to(model)."
    )
    return found


def _page(fit: Fit[Payload], model: TorqueModel, table: Table, verdict: Verdict, about: str) -> Any:
    from armlab.plots.style import png

    page = HtmlReport(f"Load of {1e3 * fit.value.mass:.0f} g", about)
    page.verdict(verdict)
    page.section("Load", "Flange axes; deviations of one sigma, unknown gains of the joints included.")
    rows = [("parameter", "value", "deviation", "unit")]
    rows += [(n, f"{x:.5g}", f"{s:.2g}", u) for n, x, s, u in zip(fit.names, fit.parameters, fit.sd, fit.units)]
    page.table(rows)
    page.section("Torques", "Measured, and modelled with the load; the band is two sigma of the model.")
    drawn = armlab.plots.torque_fit(fit.value.added_to(model), table)
    page.figure(png(drawn), "measured and modelled torque of each joint")
    page.section("As printed")
    page.verbatim(fit.report())
    return page
