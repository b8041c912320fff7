"""What `armlab identify` reports of a model: figures for scripts, and the page with tables and pictures."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from armlab.cli.identify_verdict import Trial
from armlab.cli.page import Page, Verdict

if TYPE_CHECKING:
    from armlab.estimation import Fit
    from armlab.log import Table
    from armlab.models import TorqueModel

__all__ = ["numbers", "write"]

Tell = Callable[[float, float, str], None]
Drawing = tuple[str, str, str, Callable[[], bytes]]  # title, what it shows, how to read it, what draws it


def numbers(fit: Fit[TorqueModel], trial: Trial) -> dict[str, Any]:
    """Return the figures of the report for scripts: of the fit, and per joint.

    Parameters
    ----------
    fit : of `identify.fit_dynamics`. trial : the model on one log.
    """
    model = fit.value
    quality, friction, covariance = model.quality, model.friction, model.covariance
    columns = {
        "torque_sd": quality.torque_sd,
        "rms": quality.rms,
        "share_fit": quality.rms / quality.torque_sd,
        "share_held_out": quality.rms_cv / quality.torque_sd,
        "share_test": trial.share if trial.unseen else np.full(model.n, np.nan),
        "coverage": quality.coverage,
        "viscous": friction.viscous,
        "coulomb_pos": friction.coulomb_pos,
        "coulomb_neg": friction.coulomb_neg,
        "offset": friction.offset,
        "stribeck": friction.stribeck,
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


def write(
    path: Path,
    fit: Fit[TorqueModel],
    verdict: Verdict,
    trial: Trial,
    log: Table,
    about: str,
    tell: Tell | None = None,
) -> None:
    """Write the page.

    Parameters
    ----------
    path : HTML file. fit : of `identify.fit_dynamics`. verdict : of `judge`. trial : of `try_out`.
    log : the first that was fitted to. about : which logs, for the line below the title.
    tell : called with (done, total, what).
    """
    from armlab.identify.parameter_table import parameter_rows

    page = Page(f"Torque model of {fit.value.robot_name}", about)
    page.verdict(verdict)
    page.section(
        "Residuals per joint",
        "Of the estimator's causal filter, in motion, as % of the standard deviation (sd) of the measured torque: in "
        "the data of the fit, in held-out blocks, and in the test log. Sigma is what the model states for the torque "
        "error; gamma is how fast it falls with speed.",
    )
    page.table(_residual_rows(fit, trial))
    page.section("Friction per joint", "With standard deviations from drawing blocks of time again.")
    page.table(_friction_rows(fit, trial))
    drawings = _drawings(fit, trial, log)
    for k, (title, alt, caption, draw) in enumerate(drawings):
        if tell is not None:
            tell(k, len(drawings), f"drawing {title.lower()}")
        page.section(title)
        page.figure(draw(), alt, caption)
    page.section("Parameters", "What the motion can tell: of the links only these combinations act on the torques.")
    head = ("value", "standard deviation", "unit", "parameter")
    page.table([head, *parameter_rows(fit)], f"{len(fit.names)} parameters with standard deviations")
    page.section("As printed")
    page.verbatim(fit.report(), "Report of the fit")
    page.write(path)


def _residual_rows(fit: Fit[TorqueModel], trial: Trial) -> list[list[str]]:
    rows = [["joint", "torque sd [N m]", "RMS [N m]", "fit [%]", "held-out [%]", "test [%]", "in 2 sigma [%]"]]
    rows[0] += ["sigma at rest [N m]", "in motion [N m]", "gamma [s/rad]"]
    for joint in numbers(fit, trial)["joints"]:
        shares = [joint[name] for name in ("share_fit", "share_held_out", "share_test", "coverage")]
        row = [str(joint["joint"]), f"{joint['torque_sd']:.3f}", f"{joint['rms']:.3f}"]
        row += [f"{100 * share:.1f}" if np.isfinite(share) else "-" for share in shares]
        row += [f"{joint['sigma_rest']:.3f}", f"{joint['sigma_motion']:.3f}", f"{joint['gamma']:.0f}"]
        rows.append(row)
    return rows


def _friction_rows(fit: Fit[TorqueModel], trial: Trial) -> list[list[str]]:
    from armlab.plots.drives import own_parameters

    columns = {
        "viscous": ("viscous",),
        "coulomb_pos": ("coulomb+", "coulomb"),
        "coulomb_neg": ("coulomb-", "coulomb"),
        "offset": ("offset",),
        "stribeck": ("stribeck",),
    }
    rows = [["joint", "viscous [N m s/rad]", "Coulomb + [N m]", "Coulomb - [N m]", "offset [N m]", "Stribeck [N m]"]]
    rows[0] += ["ripple [N m]", "presliding [rad]"]
    for own, joint in zip(own_parameters(fit), numbers(fit, trial)["joints"], strict=True):
        row = [str(joint["joint"])]
        row += [f"{joint[name]:.3f}{_deviation(fit, own, kinds)}" for name, kinds in columns.items()]
        rows.append([*row, f"{joint['ripple']:.3f}" if joint["ripple"] else "-", f"{joint['delta']:.1e}"])
    return rows


def _deviation(fit: Fit[TorqueModel], own: dict[str, int], kinds: tuple[str, ...]) -> str:
    """Return the deviation of one friction parameter with its sign; nothing when the fit does not have it."""
    place = next((own[kind] for kind in kinds if kind in own), None)
    return "" if place is None else f" ± {fit.sd[place]:.3f}"


def _drawings(fit: Fit[TorqueModel], trial: Trial, log: Table) -> list[Drawing]:
    """Return title, what it shows, how to read it, and what draws it, of each figure."""
    return [*_of_the_torque(fit, trial, log), *_of_the_force(fit, trial)]


def _of_the_torque(fit: Fit[TorqueModel], trial: Trial, log: Table) -> list[Drawing]:
    from armlab import plots

    model, estimate = fit.value, trial.estimate
    shown = "The test log" if trial.unseen else "The first log"
    return [
        (
            "Measured and modelled torque",
            "Torque of each joint over time, measured and modelled, and the residual",
            f"{shown}. What is left should look like noise inside the band.",
            lambda: plots.png(plots.torque_fit(fit, trial.log)),
        ),
        (
            "Residual over speed",
            "Residual torque of each joint over its speed with two-sigma curves",
            "Curves follow the cloud where the covariance is right. A step at zero is Coulomb friction that is wrong.",
            lambda: plots.png(plots.residual_speed(estimate, {"model": model.covariance})),
        ),
        (
            "Friction",
            "Friction of each joint over its speed with uncertainty",
            "Dark: uncertainty of the parameters. Light: with the torque error at that speed, 95 % of the points.",
            lambda: plots.png(plots.friction(fit, estimate)),
        ),
        (
            "Torque ripple",
            "Amplitude of the torque residual over cycles per turn",
            "Peaks that stand still over position are ripple of gears and motors; the dotted ones are in the model.",
            lambda: plots.png(plots.spectrum(model, log)),
        ),
        (
            "How long the residual remembers",
            "Autocorrelation of the residuals over the lag",
            "Coloured residuals make formal deviations too small; those of this report come from blocks.",
            lambda: plots.png(plots.autocorrelation(estimate)),
        ),
    ]


def _of_the_force(fit: Fit[TorqueModel], trial: Trial) -> list[Drawing]:
    from armlab import plots

    shown = "The test log" if trial.unseen else "The first log"
    return [
        (
            "Excitation",
            "Singular values of the regressor",
            "Each point is a direction of the parameters. Those below the upper line need a richer motion.",
            lambda: plots.png(plots.excitation(fit.excitation)),
        ),
        (
            "Force without contact",
            "Estimated wrench over time with two-sigma band; the truth is zero",
            f"{shown} through the estimator. The truth is zero: the band should hold it 95 % of the time.",
            lambda: plots.png(plots.wrench(trial.estimate)),
        ),
        (
            "Observability",
            "Observability per axis over time",
            "1: the torques determine the axis. 0: only the prior speaks.",
            lambda: plots.png(plots.observability(trial.estimate)),
        ),
        (
            "Coverage by speed",
            "Share of forces inside two sigma per bin of speed",
            "A true uncertainty holds 95.4 % at every speed.",
            lambda: plots.png(plots.coverage(trial.estimate)),
        ),
    ]
