"""What of an identified model can be relied on, in words: tried on a log, judged by its figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from armlab.cli.page import Verdict

if TYPE_CHECKING:
    from armlab.estimation import Fit
    from armlab.log import Table
    from armlab.models import TorqueModel
    from armlab.robots import Robot

__all__ = ["Trial", "judge", "try_out"]

FINE, POOR = 0.10, 0.25  # residual over the torque's deviation
HONEST = (0.92, 0.985)  # share inside 2 sigma
WORSE = 1.5  # unseen over seen residual
STRETCHED = 3.0  # alpha
SLOW, SLOW_SHARE = 0.1, 0.15  # of the speed limit, and of the samples that shall be below it
NARROW = 0.25  # of a joint's range
MOVING = 0.01  # of the peak speed


@dataclass(frozen=True, eq=False)
class Trial:
    """The model on a log of free motion, where the true wrench is zero.

    Attributes
    ----------
    unseen : the log was not part of the fit.
    estimate : columns of `contact.Estimator.run`, and wrench_true, all zeros.
    log : of that motion.
    share : (n,) RMS of the torque error in motion over the torque's deviation.
    force_rms : (3,) false force in motion [N]. coverage : share of the forces inside 2 sigma.
    """

    unseen: bool
    estimate: Table
    log: Table
    share: np.ndarray
    force_rms: np.ndarray
    coverage: float


def try_out(model: TorqueModel, robot: Robot, table: Table, unseen: bool) -> Trial:
    """Run the model over a log of free motion.

    Parameters
    ----------
    model : identified. robot : its arm. table : the log. unseen : it was not part of the fit.
    """
    from armlab.contact import Estimator

    estimate = Estimator(model, robot).run(table).with_column("wrench_true", np.zeros((len(table), 6)))
    qd, error = table["qd"], estimate["tau_error"]
    moving = (np.abs(qd) > MOVING * np.abs(qd).max(axis=0)).any(axis=1) & np.isfinite(error).all(axis=1)
    force = estimate["wrench_hat"][moving, :3]
    sigma = np.sqrt(np.einsum("kii->ki", estimate["wrench_hat_cov"]))[moving, :3]
    return Trial(
        unseen=unseen,
        estimate=estimate,
        log=table,
        share=np.sqrt(np.mean(error[moving] ** 2, axis=0)) / np.std(table["tau"], axis=0),
        force_rms=np.sqrt(np.mean(force**2, axis=0)),
        coverage=float(np.mean(np.abs(force) <= 2 * sigma)),
    )


def judge(fit: Fit[TorqueModel], robot: Robot, tables: Sequence[Table], trial: Trial) -> Verdict:
    """Return what of the model can be relied on, what cannot, and what to log next.

    Parameters
    ----------
    fit : of `identify.fit_dynamics`. robot : its arm. tables : the logs it was fitted to. trial : on one log.
    """
    found = _Sentences()
    _judge_fit(found, fit, trial)
    _judge_honesty(found, fit.value, trial)
    _judge_motion(found, fit, robot, tables)
    return Verdict(tuple(found.good), tuple(found.bad), tuple(found.ahead))


class _Sentences:
    def __init__(self) -> None:
        self.good: list[str] = []
        self.bad: list[str] = []
        self.ahead: list[str] = []


def _judge_fit(found: _Sentences, fit: Fit[TorqueModel], trial: Trial) -> None:
    quality = fit.value.quality
    held_out = quality.rms_cv / quality.torque_sd
    judged = np.isfinite(held_out)  # joints that did not move have no figures
    fine, poor = (held_out <= FINE) | ~judged, judged & (held_out > POOR)
    worst = int(np.nanargmax(held_out)) if judged.any() else 0
    if fine.all():
        found.good.append(
            f"The model leaves {100 * np.nanmin(held_out):.1f} to {100 * np.nanmax(held_out):.1f} % of the torque's "
            "deviation in motion that it has not seen."
        )
    elif fine.any():
        found.good.append(f"{_joints(fine)}: at most {100 * FINE:.0f} % of the torque's deviation is left unexplained.")
    kept = _kept(fit.value)
    if kept:
        found.good.append(f"Kept, because they win on held-out stretches of time: {', '.join(kept)}.")
    if poor.any():
        found.bad.append(
            f"{_joints(poor)}: up to {100 * held_out[worst]:.0f} % of the torque's deviation is left unexplained."
        )
        found.ahead.append(
            f"Look at the residuals of {_joints(poor)}: over speed they show friction, over position ripple or a load "
            "that moves."
        )
    worse = quality.rms_cv > WORSE * quality.rms
    if worse.any():
        found.bad.append(f"{_joints(worse)}: much worse in motion that the model has not seen. Too little was logged.")
        found.ahead.append("Log for longer, or several motions: the model has more parameters than these logs tell.")
    if trial.unseen:
        worse = trial.share > WORSE * held_out
        said = f"{100 * trial.share.min():.1f} to {100 * trial.share.max():.1f} % of the torque's deviation"
        if worse.any():
            found.bad.append(f"{_joints(worse)}: worse in the test log ({said} left) than in held-out blocks.")
            found.ahead.append("Log motions like those of the test log: its speeds, poses or load were not identified.")
        else:
            found.good.append(f"In the test log {said} is left, as in held-out blocks.")


def _kept(model: TorqueModel) -> list[str]:
    """Name the parts of the drives beyond the usual ones."""
    kept = []
    if model.lines is not None:
        kept.append(f"ripple of {_joints(np.isin(np.arange(model.n), model.lines.joint))}")
    if model.friction_map is not None:
        mapped = np.any(model.friction_map.coefficients != 0, axis=(1, 2, 3))
        kept.append(f"friction over position of {_joints(mapped)}")
    if model.warm_up is not None:
        kept.append("warm-up")
    return kept


def _judge_honesty(found: _Sentences, model: TorqueModel, trial: Trial) -> None:
    coverage, alpha = model.quality.coverage, float(np.sqrt(model.covariance.alpha2))
    honest = ~((coverage < HONEST[0]) | (coverage > HONEST[1]))
    where = "test log" if trial.unseen else "log"
    force = " ".join(f"{value:.2f}" for value in trial.force_rms)
    if honest.all():
        found.good.append(
            f"The stated uncertainty is true: {100 * np.nanmin(coverage):.0f} to {100 * np.nanmax(coverage):.0f} % of "
            "the held-out torques lie inside 2 sigma."
        )
    else:
        shares = ", ".join(f"{100 * value:.0f} %" for value in coverage[~honest])
        found.bad.append(f"{_joints(~honest)}: {shares} of the held-out torques lie inside 2 sigma, where 95 % should.")
    if alpha > STRETCHED:
        found.bad.append(f"The torque covariance had to be stretched {alpha:.1f} times to be true: its shape is wrong.")
    if model.momentum is not None:
        worst = float(np.sqrt(max(model.momentum.alpha2_observer, model.momentum.alpha2_kf)))
        if worst > STRETCHED:
            found.bad.append(f"The momentum methods' covariance had to be stretched {worst:.1f} times to be true.")
    sentence = f"Without contact the {where} gives a force of {force} N RMS in x y z, where the truth is zero"
    inside = f"{100 * trial.coverage:.0f} % inside 2 sigma"
    (found.good if trial.coverage >= HONEST[0] else found.bad).append(f"{sentence}; {inside}.")
    friction = model.friction
    wrong = (friction.viscous < 0) | (friction.coulomb_pos < 0) | (friction.coulomb_neg < 0) | (model.rotor < 0)
    if wrong.any():
        found.bad.append(f"{_joints(wrong)}: negative friction or rotor inertia, which no drive has.")


def _judge_motion(found: _Sentences, fit: Fit[TorqueModel], robot: Robot, tables: Sequence[Table]) -> None:
    excitation, training = fit.excitation, fit.value.training
    told = excitation.text().splitlines()[0]
    if told.startswith("excitation good"):
        found.good.append(f"The motion tells all parameters apart (condition {excitation.condition:.0f}).")
    else:
        found.bad.append(f"The motion tells some parameters badly (condition {excitation.condition:.0f}).")
        found.ahead.append(f"Log a longer or richer motion, as of armlab excite; told least: {excitation.weakest}.")
    used = (training.q_max - training.q_min) / (robot.q_max - robot.q_min)
    narrow = used < NARROW
    if narrow.any():
        found.ahead.append(
            f"{_joints(narrow)} moved over less than {100 * NARROW:.0f} % of the range: outside of it the model is "
            "extrapolated. Log there before you work there."
        )
    qd = np.concatenate([np.abs(table["qd"]) for table in tables])
    hasty = np.mean(qd < SLOW * robot.qd_max, axis=0) < SLOW_SHARE
    if hasty.any():
        found.ahead.append(f"{_joints(hasty)}: hardly any slow motion. Log some, friction is known worst there.")
    if not found.ahead:
        found.ahead.append("Nothing: estimate forces with it, and identify again when tool, load or mounting change.")


def _joints(which: np.ndarray) -> str:
    """Name joints by number: "joint 2", "joints 1, 3"."""
    numbered = [str(i + 1) for i in np.flatnonzero(which)]
    return f"joint{'s' if len(numbered) > 1 else ''} {', '.join(numbered)}"
