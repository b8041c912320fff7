"""``armlab payload``: identify a payload from a log and a model of the unloaded arm."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import armlab
from armlab.cli.support.html_report import HtmlReport, Verdict
from armlab.cli.support.options import Columns, OptionalOutput, load_robot
from armlab.cli.support.output import progress
from armlab.cli.support.results import PLAIN, Results, parameters

if TYPE_CHECKING:
    from armlab.cli.support.html_report import Verdict
    from armlab.estimation import Fit
    from armlab.log import Table
    from armlab.models import Payload, TorqueModel
    from armlab.robots import Robot

LARGEST = 0.1  # maximum relative standard deviation of the mass
LEAST = 3.0  # smallest mass, in standard deviations


def payload(
    robot: str,
    log: Path,
    *,
    model: Path,
    without: Path | None = None,
    mode: Literal["static", "dynamic"] = "static",
    gain: float = 0.05,
    columns: Columns = None,
    output: OptionalOutput = None,
    wanted: Results = PLAIN,
) -> int:
    """Identify a payload at the flange from motor torques: mass, centre of mass and, with --mode dynamic, inertia.

    Prints all quantities with their standard deviations, in flange axes.

    Parameters:
        robot: Library name or robot file of the modelled robot.
        log: Recording of positions, velocities and torques, with the load and without contact.
        model: Model file written by `armlab identify` for the arm without the load.
        without: Recording of the same motion without the load, to cancel model errors.
        mode: static: mass and centre of mass. dynamic: also inertia, which needs fast motion of the wrist.
        gain: Relative standard deviation of the torque constants.
        output: Also save the payload to this .toml file.
    """
    from armlab.cli.support.log_input import model_for, read_log
    from armlab.models.files import load_statistics

    wanted.check(output, (".toml",))
    arm = load_robot(robot)
    known = model_for(model, arm, wanted.force)
    # if saved as a fit, the model includes the uncertainty of friction
    told = replace(armlab.estimation.Fit.load(model), value=known) if load_statistics(model) else known
    table = read_log(log, arm, wanted.force, columns, fit=True)
    empty = None if without is None else read_log(without, arm, wanted.force, columns, fit=True)
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
    """Return the verdict on a payload, with advice."""
    import numpy as np

    from armlab.cli.identify.report import POOR
    from armlab.identify.payload import moving_joints

    mass, sd = fit.value.mass, fit.sd[0]
    found = Verdict()
    if mass < LEAST * sd:
        found.bad.append(
            f"{1e3 * mass:.0f} g is not distinguishable from no load: the standard deviation is {1e3 * sd:.0f} g."
        )
    elif sd > LARGEST * mass:
        found.bad.append(f"The mass has a standard deviation of {100 * sd / mass:.0f} %.")
        found.ahead.append("Record the same motion without the load and pass it with --without.")
    else:
        found.good.append(f"The load is {1e3 * mass:.0f} g with a standard deviation of {100 * sd / mass:.1f} %.")
    joints = moving_joints([table], arm)
    left = np.std(fit.residuals, axis=0) / np.std(table["tau"][:, joints], axis=0)
    if left.max() <= POOR:
        found.good.append(
            f"Arm and load together explain at least {100 * (1 - left.max() ** 2):.1f} % of the torque variance."
        )
    else:
        worst = arm.joint_names[joints[left.argmax()]]
        found.bad.append(f"{worst}: arm and load together leave {100 * left.max():.0f} % of the torque SD unexplained.")
        found.ahead.append(
            "Check the torques in the log, and make sure that the model describes this arm with its current tool."
        )
    found.bad += fit.doubts
    found.ahead += armlab.identify.extrapolation(model, table).warnings
    found.ahead.append(
        "Use the model of the arm unchanged, and ignore the centre of mass."
        if mass < LEAST * sd
        else "Add the load to the model of the arm: models.load(…).added_to(model)."
    )
    return found


def _page(fit: Fit[Payload], model: TorqueModel, table: Table, verdict: Verdict, about: str) -> Any:
    from armlab.plots.style import png

    page = HtmlReport(f"Load of {1e3 * fit.value.mass:.0f} g", about)
    page.verdict(verdict)
    page.section("Load", "In flange axes. The standard deviations include the uncertainty of the torque constants.")
    rows = [("parameter", "value", "standard deviation", "unit")]
    rows += [(n, f"{x:.5g}", f"{s:.2g}", u) for n, x, s, u in zip(fit.names, fit.parameters, fit.sd, fit.units)]
    page.table(rows)
    page.section("Torques", "Measured torque, and modelled torque with the load; the band is 2 sigma of the model.")
    page.figure(png(armlab.plots.torque_fit(fit.value.added_to(model), table)), "measured and modelled joint torques")
    page.section("Report")
    page.verbatim(fit.report())
    return page
