"""How good a torque model is: held-out residuals, their covariance over velocity, and the report per joint."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from armlab.estimation import Fit
from armlab.identify.covariance import fit_velocity_covariance
from armlab.identify.extrapolation import extrapolation
from armlab.identify.momentum import momentum_noise
from armlab.identify.preparation import Prepared, with_velocity
from armlab.log import Table
from armlab.models import FrictionBound, TorqueModel, VelocityCovariance
from armlab.signals import central_diff, lowpass_offline

__all__ = ["assess", "held_out", "predict", "report"]

SETTLED = 0.01  # variance of the presliding state below which friction is known from motion
ALPHA2_BOUNDS = (0.25, 25.0)
FAST = 0.1  # rad/s: above it the bound on friction holds the model's error in motion


def held_out(folds: list[tuple[TorqueModel, np.ndarray]], data: Prepared) -> tuple[np.ndarray, np.ndarray]:
    """Return causal residuals (N, n) of models that did not see the row, and a mask (N,) of rows in motion.

    Parameters
    ----------
    folds : models and the rows (N,) that each did not see.
    data : the record.
    """
    residuals = np.full(data.q.shape, np.nan)
    moving = np.zeros(len(data.t), dtype=bool)
    for model, rows in folds:
        torque, variance = _causal(model, data)
        residuals[rows] = torque[rows]
        moving[rows] = (variance[rows] < SETTLED * model.friction.static**2).all(axis=1)
    return residuals, moving & np.isfinite(residuals).all(axis=1)


def _causal(model: TorqueModel, data: Prepared) -> tuple[np.ndarray, np.ndarray]:
    """Run the estimator's own residual filter; return filtered residuals and the variance from unknown friction."""
    kernel = model.estimator_kernel(np.ones(6))
    torque, variance = np.empty_like(data.q), np.empty_like(data.q)
    for a, b in data.segments:
        kernel.reset()
        found = kernel.run(data.q[a:b], data.qd[a:b], data.tau[a:b], data.dt[a:b])
        torque[a:b], variance[a:b] = found[3], found[4]
    return torque, variance


def assess(model: TorqueModel, folds: list[tuple[TorqueModel, np.ndarray]], data: Prepared) -> TorqueModel:
    """Return the model with its torque covariance and quality figures.

    Both residuals of the quality, of the fit and held out, pass the estimator's causal filter and count rows in motion:
    so they may be compared.

    Parameters
    ----------
    model : fitted to all data. folds : models for held-out rows.
    data : the record.
    """
    errors, moving = held_out(folds, data)
    e, qd = errors[moving], data.qd[moving]
    covariance = fit_velocity_covariance(e, qd, "exp").value
    ratio = e**2 / covariance.variance(qd)
    alpha2 = float(np.clip(np.quantile(ratio, 0.954) / 4.0, *ALPHA2_BOUNDS))
    scaled = VelocityCovariance("exp", covariance.C0, covariance.Cinf, covariance.shape, alpha2)
    quality = replace(
        model.quality,
        rms=np.sqrt(np.mean(_causal(model, data)[0][moving] ** 2, axis=0)),
        rms_cv=np.sqrt(np.mean(e**2, axis=0)),
        coverage=np.mean(ratio < 4.0 * alpha2, axis=0),
    )
    judged = replace(model, covariance=scaled, bound=_bound(model, scaled, e, qd), quality=quality)
    return replace(judged, momentum=momentum_noise(judged, folds, np.where(moving[:, None], errors, np.nan), data))


def _bound(model: TorqueModel, covariance: VelocityCovariance, e: np.ndarray, qd: np.ndarray) -> FrictionBound:
    """Return the bound on friction near rest; its floor is what 99 % of the errors in motion have beyond 2 sigma."""
    moving = np.where(np.abs(qd) > FAST, np.abs(e), np.nan)
    sigma = np.sqrt(covariance.alpha2 * covariance.Cinf)
    known = np.isfinite(moving).any(axis=0)
    largest = np.where(known, np.nanquantile(np.where(known, moving, 0.0), 0.99, axis=0), 0.0)
    return FrictionBound.of(model.friction, np.maximum(largest - 2.0 * sigma, 0.0))


def predict(model: TorqueModel, table: Table) -> Table:
    """Return the log with tau, tau_model and tau_sigma (N, n) [N m]: measured, modelled, and how surely.

    Measured and modelled torque pass a zero-phase low-pass at the model's cut-off: to that band its covariance belongs.
    Where the arm has rested, tau_sigma holds what static friction may do, as in the estimator. The notes of the result
    say where the log leaves the training data.

    Parameters
    ----------
    model : identified torque model.
    table : log with columns q, tau (N, n), and qd where it was measured, without gaps.
    """
    table = with_velocity(table)
    rate = 1.0 / float(np.median(np.diff(table.t)))
    torque = model.torque(table["q"], table["qd"], central_diff(table["qd"], table.t), table.dt)
    variance = model.estimator_kernel(np.ones(6)).run(table["q"], table["qd"], table["tau"], table.dt)[4]
    warned = extrapolation(model, table).warnings
    return (
        replace(table, notes=(*table.notes, *warned))
        .with_column("tau", lowpass_offline(table["tau"], rate, model.cutoff))
        .with_column("tau_model", lowpass_offline(torque, rate, model.cutoff), unit="N m")
        .with_column("tau_sigma", np.sqrt(variance), unit="N m")
    )


def report(fit: Fit[TorqueModel]) -> str:
    """Return a table per joint: torque, residuals in % of the torque's deviation, friction with deviations."""
    model, q, f = fit.value, fit.value.quality, fit.value.friction
    sd = fit.sd[len(model.base_names) :].reshape(model.n, -1)
    header = (
        "joint",
        "torque sd",
        "rms",
        "fit",
        "held-out",
        "viscous",
        "coulomb +",
        "coulomb -",
        "delta",
        "in 2 sigma",
    )
    units = ("", "N m", "N m", "% of sd", "% of sd", "N m s/rad", "N m", "N m", "rad", "%")
    rows = [
        (
            f"{i + 1}",
            f"{q.torque_sd[i]:.3f}",
            f"{q.rms[i]:.3f}",
            f"{100 * q.rms[i] / q.torque_sd[i]:.2f}",
            f"{100 * q.rms_cv[i] / q.torque_sd[i]:.2f}",
            f"{f.viscous[i]:.3f} +- {sd[i, 0]:.3f}",
            f"{f.coulomb_pos[i]:.3f} +- {sd[i, 1]:.3f}",
            f"{f.coulomb_neg[i]:.3f} +- {sd[i, 2]:.3f}",
            f"{f.delta[i]:.1e}",
            f"{100 * q.coverage[i]:.1f}",
        )
        for i in range(model.n)
    ]
    widths = [max(map(len, column)) for column in zip(header, units, *rows)]
    lines = ["  ".join(f"{cell:>{width}}" for cell, width in zip(row, widths)) for row in (header, units, *rows)]
    return "\n".join([*lines, f"{fit.n} samples, {q.seconds:.1f} s", fit.excitation.text()])
