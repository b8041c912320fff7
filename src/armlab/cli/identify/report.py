"""Report of ``armlab identify``: verdict, numbers for JSON, and HTML page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

import armlab
from armlab.cli.support.html_report import Drawing, HtmlReport, Verdict
from armlab.cli.support.results import Tell

if TYPE_CHECKING:
    from armlab.estimation import Fit
    from armlab.log import Table
    from armlab.models import TorqueModel
    from armlab.robots import Robot

FINE, POOR = 0.10, 0.25  # residual relative to the torque standard deviation
HONEST = (0.92, 0.985)  # fraction of values inside 2 sigma
WORSE = 1.5  # held-out residual relative to the training residual
STRETCHED = 3.0  # covariance scale alpha
SLOW, SLOW_SHARE = 0.1, 0.15  # fraction of the speed limit, and required fraction of samples below it
NARROW = 0.25  # fraction of a joint's range
MOVING = 0.01  # fraction of the peak speed
_FRICTION = {  # names of the identified parameters by field of `models.friction.Friction`
    "viscous": ("viscous",), "coulomb_pos": ("coulomb+", "coulomb"), "coulomb_neg": ("coulomb-", "coulomb"),
    "offset": ("offset",), "stribeck": ("stribeck",), "root": ("root",), "load": ("load",),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class ModelTrial:
    """Evaluation of a model on a log of free motion, where the true wrench is zero."""

    unseen: bool  # True for a separate test log
    estimate: Table  # columns of `contact.Estimator.run`, and wrench_true with zeros
    log: Table
    share: np.ndarray  # (n,) RMS torque error in motion, relative to the torque standard deviation
    force_rms: np.ndarray  # (3,) RMS false force in motion [N]
    coverage: float  # fraction of forces inside 2 sigma


def try_out(model: TorqueModel, robot: Robot, table: Table, unseen: bool) -> ModelTrial:
    estimate = armlab.contact.Estimator(model, robot).run(table).with_column("wrench_true", np.zeros((len(table), 6)))
    qd, error = table["qd"], estimate["tau_error"]
    moving = (np.abs(qd) > MOVING * np.abs(qd).max(axis=0)).any(axis=1) & np.isfinite(error).all(axis=1)
    force = estimate["wrench_hat"][moving, :3]
    sigma = np.sqrt(np.einsum("kii->ki", estimate["wrench_hat_cov"]))[moving, :3]
    return ModelTrial(
        unseen=unseen,
        estimate=estimate,
        log=table,
        share=np.sqrt(np.mean(error[moving] ** 2, axis=0)) / np.std(table["tau"], axis=0),
        force_rms=np.sqrt(np.mean(force**2, axis=0)),
        coverage=float(np.mean(np.abs(force) <= 2 * sigma)),
    )


def judge(fit: Fit[TorqueModel], robot: Robot, tables: Sequence[Table], trial: ModelTrial) -> Verdict:
    """Return the verdict on a model, with advice for the next log."""
    found = Verdict()
    found.bad += [sentence[0].upper() + sentence[1:] + "." * (sentence[-1] != ".") for sentence in fit.doubts]
    _judge_fit(found, fit, trial)
    _judge_honesty(found, fit.value, trial)
    _judge_motion(found, fit, robot, tables)
    return found


def _judge_fit(found: Verdict, fit: Fit[TorqueModel], trial: ModelTrial) -> None:
    quality = fit.value.quality
    held_out = quality.rms_cv / quality.torque_sd
    judged = np.isfinite(held_out)  # NaN for joints that did not move
    fine, poor = (held_out <= FINE) | ~judged, judged & (held_out > POOR)
    worst = int(np.nanargmax(held_out)) if judged.any() else 0
    if fine.all():
        found.good.append(
            f"Held-out residual: {100 * np.nanmin(held_out):.1f} to {100 * np.nanmax(held_out):.1f} % of the torque "
            "standard deviation."
        )
    elif fine.any():
        found.good.append(f"{_joints(fine)}: at most {100 * FINE:.0f} % of the torque SD is unexplained.")
    kept = _kept(fit.value)
    if kept:
        found.good.append(f"Terms kept because they reduce the held-out residual: {', '.join(kept)}.")
    if poor.any():
        found.bad.append(f"{_joints(poor)}: up to {100 * held_out[worst]:.0f} % of the torque SD is unexplained.")
        found.ahead.append(
            f"Inspect the residuals of {_joints(poor)}: a dependence on speed indicates "
            "friction, and a dependence on position indicates ripple or a moving load."
        )
    worse = quality.rms_cv > WORSE * quality.rms
    if worse.any():
        found.bad.append(f"{_joints(worse)}: much larger residual on held-out data. The logs are too short.")
        found.ahead.append("Record longer logs or several motions: these logs do not determine all parameters.")
    if trial.unseen:
        worse = trial.share > WORSE * held_out
        said = f"{100 * trial.share.min():.1f} to {100 * trial.share.max():.1f} % of the torque SD"
        if worse.any():
            found.bad.append(f"{_joints(worse)}: worse in the test log (residual {said}) than in held-out blocks.")
            found.ahead.append(
                "Record motions like those in the test log: the training "
                "data do not cover the speeds, poses or load of that log."
            )
        else:
            found.good.append(f"Test log: residual {said}, consistent with the held-out blocks.")


def _kept(model: TorqueModel) -> list[str]:
    kept = []
    if model.lines is not None:
        kept.append(f"ripple of {_joints(np.isin(np.arange(model.n), model.lines.joint))}")
    if model.friction_map is not None:
        mapped = np.any(model.friction_map.coefficients != 0, axis=(1, 2, 3))
        kept.append(f"position-dependent friction of {_joints(mapped)}")
    if model.warm_up is not None:
        kept.append("warm-up")
    return kept


def _judge_honesty(found: Verdict, model: TorqueModel, trial: ModelTrial) -> None:
    from armlab.identify.validation import ALPHA2_BOUNDS

    coverage, alpha = model.quality.coverage, float(np.sqrt(model.covariance.alpha2))
    honest = ~((coverage < HONEST[0]) | (coverage > HONEST[1]))
    where = "test log" if trial.unseen else "log"
    force = " ".join(f"{value:.2f}" for value in trial.force_rms)
    if honest.all():
        found.good.append(
            f"The uncertainty is well calibrated: 2 sigma contains {100 * np.nanmin(coverage):.0f} to "
            f"{100 * np.nanmax(coverage):.0f} % of the held-out torques."
        )
    else:
        shares = ", ".join(f"{100 * value:.0f} %" for value in coverage[~honest])
        found.bad.append(f"{_joints(~honest)}: {shares} of the held-out torques are within 2 sigma instead of 95 %.")
    if alpha > STRETCHED:
        found.bad.append(
            f"The torque covariance was scaled by {alpha:.1f} to reach 95 % "
            "coverage: it does not describe the distribution of the errors correctly."
        )
    if model.momentum is not None:
        worst = float(np.sqrt(max(model.momentum.alpha2_observer, model.momentum.alpha2_kf)))
        if worst > STRETCHED:
            found.bad.append(f"The momentum methods' covariance was scaled by {worst:.1f} to reach 95 % coverage.")
        ends = {model.momentum.alpha2_observer, model.momentum.alpha2_kf} & {*ALPHA2_BOUNDS}
        if ends:
            found.bad.append(f"The covariance scale of a momentum method is at its bound {max(ends):g}.")
    sentence = f"Without contact, the estimated force in the {where} is {force} N RMS in x, y, z instead of zero"
    inside = f"{100 * trial.coverage:.0f} % within 2 sigma"
    (found.good if trial.coverage >= HONEST[0] else found.bad).append(f"{sentence}; {inside}.")
    friction = model.friction
    wrong = (friction.viscous < 0) | (friction.coulomb_pos < 0) | (friction.coulomb_neg < 0) | (model.rotor < 0)
    if wrong.any():
        found.bad.append(f"{_joints(wrong)}: negative friction or rotor inertia, which is not physical.")


def _judge_motion(found: Verdict, fit: Fit[TorqueModel], robot: Robot, tables: Sequence[Table]) -> None:
    excitation, training = fit.excitation, fit.value.training
    told = excitation.text().splitlines()[0]
    if told.startswith("excitation good"):
        found.good.append(f"The motion identifies all parameters (condition {excitation.condition:.0f}).")
    else:
        found.bad.append(f"The motion identifies some parameters poorly (condition {excitation.condition:.0f}).")
        found.ahead.append(
            f"Record a longer or richer motion, for example with armlab excite; weakest direction: "
            f"{excitation.weakest}."
        )
    used = (training.q_max - training.q_min) / (robot.q_max - robot.q_min)
    narrow = used < NARROW
    if narrow.any():
        found.ahead.append(
            f"{_joints(narrow)} moved over less than {100 * NARROW:.0f} % of the range: the model extrapolates "
            "outside these ranges. Record motions outside these ranges before using the model there."
        )
    qd = np.concatenate([np.abs(table["qd"]) for table in tables])
    hasty = np.mean(qd < SLOW * robot.qd_max, axis=0) < SLOW_SHARE
    if hasty.any():
        found.ahead.append(
            f"{_joints(hasty)}: hardly any slow motion. Record slow motion: friction is least certain at low speed."
        )
    if not found.ahead:
        found.ahead.append(
            "Use the model to estimate forces. Repeat the identification when the tool, load or mounting changes."
        )


def _joints(which: np.ndarray) -> str:
    """Return the joints of a mask as text: "joint 2", "joints 1, 3"."""
    numbered = [str(i + 1) for i in np.flatnonzero(which)]
    return f"joint{'s' if len(numbered) > 1 else ''} {', '.join(numbered)}"


def numbers(fit: Fit[TorqueModel], trial: ModelTrial) -> dict[str, Any]:
    """Return the numbers of the report for JSON, overall and per joint."""
    model = fit.value
    quality, friction, covariance = model.quality, model.friction, model.covariance
    columns = {
        "torque_sd": quality.torque_sd,
        "rms": quality.rms,
        "share_fit": quality.rms / quality.torque_sd,
        "share_held_out": quality.rms_cv / quality.torque_sd,
        "share_test": trial.share if trial.unseen else np.full(model.n, np.nan),
        "coverage": quality.coverage,
        **{name: getattr(friction, name) for name in _FRICTION},
        "contact_doubt": model.contact_doubt,
        "delta": friction.delta,
        "sigma_rest": np.sqrt(covariance.alpha2 * covariance.C0),
        "sigma_motion": np.sqrt(covariance.alpha2 * covariance.Cinf),
        "gamma": covariance.shape,
        "ripple": np.hypot(model.ripple.cosine, model.ripple.sine),
    }
    return {
        "robot": model.robot_name,
        "samples": fit.n,
        "seconds": quality.seconds,
        "alpha": float(np.sqrt(covariance.alpha2)),
        "condition": fit.excitation.condition,
        "weakest": fit.excitation.weakest,
        "false_force_rms": trial.force_rms,
        "false_force_coverage": trial.coverage,
        "joints": [{"joint": i + 1, **{name: v[i] for name, v in columns.items()}} for i in range(model.n)],
    }


def page(fit: Fit[TorqueModel], verdict: Verdict, trial: ModelTrial, log: Table, about: str, tell: Tell) -> HtmlReport:
    from armlab.identify.validation import parameter_rows

    page = HtmlReport(f"Torque model of {fit.value.robot_name}", about)
    page.verdict(verdict)
    page.section(
        "Residuals per joint",
        "Residuals in motion after the estimator's causal filter, in % of the standard deviation (SD) of the measured "
        "torque: training data, held-out blocks, test log. Sigma is the modelled standard deviation of the torque "
        "error; gamma is its decay rate with speed.",
    )
    page.table(_residual_rows(fit, trial))
    page.section("Friction per joint", "Standard deviations come from a block bootstrap.")
    page.table(_friction_rows(fit, trial))
    page.figures(_drawings(fit, trial, log), tell)
    page.section("Parameters", "Identifiable parameters: only these combinations affect the torques.")
    head = ("value", "standard deviation", "unit", "parameter")
    page.table([head, *parameter_rows(fit)], f"{len(fit.names)} parameters with standard deviations")
    page.section("Report")
    page.verbatim(fit.report(), "Report of the fit")
    return page


def _residual_rows(fit: Fit[TorqueModel], trial: ModelTrial) -> list[list[str]]:
    rows = [["joint", "torque sd [N m]", "RMS [N m]", "fit [%]", "held-out [%]", "test [%]", "within 2 sigma [%]"]]
    rows[0] += ["sigma at rest [N m]", "in motion [N m]", "gamma [s/rad]"]
    for joint in numbers(fit, trial)["joints"]:
        shares = [joint[name] for name in ("share_fit", "share_held_out", "share_test", "coverage")]
        row = [str(joint["joint"]), f"{joint['torque_sd']:.3f}", f"{joint['rms']:.3f}"]
        row += [f"{100 * share:.1f}" if np.isfinite(share) else "-" for share in shares]
        row += [f"{joint['sigma_rest']:.3f}", f"{joint['sigma_motion']:.3f}", f"{joint['gamma']:.0f}"]
        rows.append(row)
    return rows


def _friction_rows(fit: Fit[TorqueModel], trial: ModelTrial) -> list[list[str]]:
    from armlab.plots.drives import own_parameters

    rows = [["joint", "viscous [N m s/rad]", "Coulomb + [N m]", "Coulomb - [N m]", "offset [N m]", "Stribeck [N m]"]]
    rows[0] += ["root [N m sqrt(s/rad)]", "load", "ripple [N m]", "presliding [rad]"]
    for own, joint in zip(own_parameters(fit), numbers(fit, trial)["joints"], strict=True):
        row = [str(joint["joint"])]
        for name, kinds in _FRICTION.items():
            place = next((own[kind] for kind in kinds if kind in own), None)
            row.append(f"{joint[name]:.3f}{'' if place is None else f' ± {fit.sd[place]:.3f}'}")
        rows.append([*row, f"{joint['ripple']:.3f}" if joint["ripple"] else "-", f"{joint['delta']:.1e}"])
    return rows


def _drawings(fit: Fit[TorqueModel], trial: ModelTrial, log: Table) -> list[Drawing]:
    model, estimate = fit.value, trial.estimate
    shown = "The test log" if trial.unseen else "The first log"
    return [
        (
            "Measured and modelled torque",
            "Measured and modelled torque of each joint against time, and the residual",
            f"{shown}. The residual should look like noise inside the band.",
            lambda: armlab.plots.torque_fit(fit, trial.log),
        ),
        (
            "Residual over speed",
            "Residual torque of each joint against its speed with 2-sigma curves",
            "95 % of the points should be between the curves. A step at zero indicates wrong Coulomb friction.",
            lambda: armlab.plots.residual_speed(estimate, {"model": model.covariance}),
        ),
        (
            "Friction",
            "Friction of each joint against its speed with uncertainty",
            "Dark band: uncertainty of the parameters. Light band: includes the torque error at that speed; this band "
            "should contain 95 % of the points.",
            lambda: armlab.plots.friction(fit, estimate),
        ),
        (
            "Torque ripple",
            "Amplitude of the torque residual against cycles per revolution",
            "Peaks are caused by gear and motor ripple; dotted lines mark the ripple in the model.",
            lambda: armlab.plots.spectrum(model, log),
        ),
        (
            "Residual autocorrelation",
            "Autocorrelation of the residuals against the lag",
            "Correlated residuals make formal standard deviations too small; this report uses a block bootstrap.",
            lambda: armlab.plots.autocorrelation(estimate),
        ),
        (
            "Excitation",
            "Singular values of the regressor",
            "Each point is a parameter direction. Directions below the upper line need a richer motion.",
            lambda: armlab.plots.excitation(fit.excitation),
        ),
        (
            "Force without contact",
            "Estimated wrench against time with a 2-sigma band; the true wrench is zero",
            f"{shown}, processed by the estimator. The band should contain zero 95 % of the time.",
            lambda: armlab.plots.wrench(estimate),
        ),
        (
            "Observability",
            "Observability of each axis against time",
            "1: determined by the torques. 0: determined by the prior.",
            lambda: armlab.plots.observability(estimate),
        ),
        (
            "Coverage by speed",
            "Fraction of forces within 2 sigma per speed bin",
            "95.4 % at every speed if the uncertainty is well calibrated.",
            lambda: armlab.plots.coverage(estimate),
        ),
    ]
