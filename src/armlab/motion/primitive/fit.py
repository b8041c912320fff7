"""Fit a movement primitive to demonstrations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._numbers import check_name, flag, members, positive
from armlab.errors import ConfigError, ShapeError
from armlab.estimation import Excitation, Fit
from armlab.motion.arguments import at_least_zero, coordinates
from armlab.motion.dmp import Dmp
from armlab.motion.primitive.demonstrations import Demo, ReferenceMotion, aligned, read_demos
from armlab.motion.primitive.equation import SCALINGS, SCHEDULES, placed, time_constants
from armlab.motion.primitive.weights import ENDS, Learned, WeightProblem, block_covariance, learn

METHODS = ("trajectory", "acceleration", "lwr")
WIDTH, LWR_WIDTH = 0.8, 0.55  # standard deviations of the kernels divided by their spacing
MANY = 3  # demonstrations needed for a covariance of their weights
MAX_CONDITION = 1e11
MAX_HOLD = 100.0
UNINFORMATIVE = 0.05  # size relative to the reference below which a demonstration does not determine the weights


def fit_dmp(
    t: ArrayLike | Sequence[ArrayLike],
    y: ArrayLike | Sequence[ArrayLike],
    *,
    method: str = "trajectory",
    n_basis: int = 50,
    schedule: str = "canonical",
    spacing: str = "time",
    scaling: str = "goal",
    convention: str = "lund",
    alpha_z: float = 25.0,
    beta_z: float | None = None,
    ridge: float = 0.0,
    pin: Sequence[str] = ("y0", "g"),
    hold: float = 0.3,
    y0: ArrayLike | None = None,
    v0: ArrayLike | None = None,
    g: ArrayLike | None = None,
    sample_weights: ArrayLike | Sequence[ArrayLike] | None = None,
    bandwidth: float | None = None,
    raw_kernels: bool = False,
    limits: tuple[ArrayLike, ArrayLike] | None = None,
) -> Fit[Dmp]:
    """Fit a movement primitive to one or several demonstrations.

    "trajectory" minimises ``sum |y - y_dmp|^2`` over the weights and any free start, start velocity or goal. The
    problem is linear and needs no derivatives of measurements; with schedule "position", it becomes nonlinear and is
    solved by Gauss-Newton.
    "acceleration" minimises ``sum |f - s psi w x|^2`` with ``f = tau_d^2 ydd - alpha_z (beta_z (g - y) - tau_d yd)``
    from central differences. "lwr" sets the weight of each kernel to the weighted mean ``sum psi x f / sum psi x^2``.
    For the last two methods, the covariance assumes white residuals of f, which does not hold in practice. Several
    demonstrations share the weights, but each demonstration keeps its own duration, start and goal.

    Parameters
    ----------
    t, y : (N,) increasing times [s] and (N, n) positions [rad or m]; or lists of such arrays, one per demonstration.
    method : "trajectory", "acceleration" or "lwr".
    n_basis : number of kernels, 3 to 1000.
    schedule : phase schedule: "canonical", "time", or "position" for motions without reversals or pauses.
    spacing : "time": kernels equally spaced in time; "phase": spaced as in DynamicMovementPrimitives.jl.
    scaling : scaling of the forcing with the goal: "goal", "none", "amplitude" or "rotate" (n = 3).
    convention : choice of alpha_x and tau_d: "lund" or "ijspeert".
    alpha_z, beta_z : spring constants; default of beta_z: alpha_z / 4, for critical damping.
    ridge : penalty on the squared weights; `cov` accounts for the noise, but not for the bias due to the penalty.
    pin : names among "y0", "v0" and "g" that are taken from the first and last samples instead of fitted. The effect
        of a fitted goal is nearly indistinguishable from that of the forcing term.
    hold : standstill time at the goal after the motion, divided by the duration of the motion; 0 if the motion does not
        end at rest. Only for "trajectory".
    y0, v0, g : (n,) known start, velocity and goal.
    sample_weights : (N,) non-negative sample weights, or a list of such arrays.
    bandwidth : bandwidth of the smoothed derivatives [Hz], for "acceleration" and "lwr" with uniform times.
    raw_kernels : use unnormalised kernels as weights, for "lwr".
    limits : lowest (n,) and highest (n,) goal accepted by runs and steppers of the primitive, in the unit of y;
        default: no limits.

    Returns
    -------
    Result of fitting a `Dmp`. `residuals` (N, n) are position residuals for "trajectory", otherwise residuals of f;
    `report` contains the RMSE of the motion.

    Raises
    ------
    ShapeError : wrong shapes, NaN or times that do not increase (with row numbers); a reversal or pause (with the
        sample number) for schedule "position".
    ConfigError, UnknownName : unknown or contradictory options.
    """
    _check_options(method, schedule, scaling, bandwidth, raw_kernels)
    demos = aligned(read_demos(t, y, sample_weights), scaling)
    if schedule == "position":
        _check_monotone(demos)
    n, given = demos[0].y.shape[1], {"y0": y0, "v0": v0, "g": g}
    known = {name: coordinates(a, name, n) for name, a in given.items() if a is not None}
    starts = np.array([known.get("y0", demo.y[0]) for demo in demos])
    goals = np.array([known.get("g", demo.y[-1]) for demo in demos])
    reference = ReferenceMotion.of(demos, scaling, starts, goals)
    alpha = positive(alpha_z, "alpha_z", error=ConfigError)
    alpha_x, tau_d = time_constants(convention, reference.duration, alpha)
    decay, factor = alpha_x * reference.duration / tau_d, LWR_WIDTH if method == "lwr" else WIDTH
    centres, widths = placed(schedule, spacing, n_basis, decay, factor)
    blank = Dmp(
        weights=np.zeros((len(centres), n)),
        centres=centres,
        widths=widths,
        tau_d=tau_d,
        duration=reference.duration,
        y0=reference.y0,
        v0=np.zeros(n),
        g=reference.g,
        extent=reference.extent,
        peak_acceleration=np.max([np.abs(demo.acceleration).max(axis=0) for demo in demos], axis=0),
        monotone=~np.any([demo.behind.any(axis=0) for demo in demos], axis=0),
        alpha_z=alpha,
        beta_z=alpha / 4.0 if beta_z is None else positive(beta_z, "beta_z", error=ConfigError),
        alpha_x=alpha_x,
        schedule=schedule,
        scaling=scaling,
        convention=convention,
        limits=_limits(limits, n),
    )
    pinned, rest, penalty = _pins(pin, known), _hold(hold), at_least_zero(ridge, "ridge")
    ends = reference.scales, starts, goals, pinned, known
    problem = WeightProblem(method, blank, demos, *ends, rest, penalty, bandwidth, raw_kernels)
    learned = learn(problem)
    return _fit(_value(problem, learned, reference), problem, learned)


def _check_options(method: str, schedule: str, scaling: str, bandwidth: float | None, raw_kernels: bool) -> None:
    check_name(method, "method", METHODS)
    check_name(schedule, "schedule", SCHEDULES)
    check_name(scaling, "scaling", SCALINGS)
    if bandwidth is not None and method == "trajectory" and schedule != "position":
        raise ConfigError(
            "Expected a bandwidth only for methods with derivatives, got a bandwidth with 'trajectory'. Omit the "
            "bandwidth."
        )
    if flag(raw_kernels, "raw_kernels") and method != "lwr":
        raise ConfigError(
            f"Expected raw_kernels only with method 'lwr', got raw_kernels with {method!r}. Omit raw_kernels."
        )


def _pins(pin: Sequence[str], known: dict[str, np.ndarray]) -> tuple[str, ...]:
    if isinstance(pin, str):
        raise ConfigError(f"Expected pin to be a tuple of names, got the string {pin!r}. Write ({pin!r},).")
    for name in members(pin, "pin"):
        check_name(name, "end to pin", ENDS)
    return tuple(name for name in pin if name not in known)


def _hold(value: Any) -> float:
    if not at_least_zero(value, "hold") <= MAX_HOLD:
        raise ConfigError(f"Expected a hold of at most {MAX_HOLD:g} times the duration, got {value:g}. Try 0.3.")
    return float(value)


def _limits(limits: Any, n: int) -> np.ndarray | None:
    if limits is None:
        return None
    if not isinstance(limits, Sequence | np.ndarray) or len(limits) != 2:
        raise ShapeError(
            f"Expected limits to be the lowest and the highest goal, each (n,), got {limits!r}. Pass two points."
        )
    return np.array([coordinates(a, "limits", n) for a in limits])


def _check_monotone(demos: list[Demo]) -> None:
    """Raise an error if a coordinate is not monotone, because its position then cannot serve as a phase."""
    for k, demo in enumerate(demos):
        which = f" of demonstration {k}" if len(demos) > 1 else ""
        for i in range(demo.y.shape[1]):
            if demo.y[0, i] == demo.y[-1, i]:
                why = "ends at its start"
            elif (sample := demo.steps_back(i)) is not None:
                why = f"steps back at sample {sample}"
            elif (sample := demo.pauses(i)) is not None:
                why = f"pauses at sample {sample}"
            else:
                continue
            raise ShapeError(
                f"Expected monotone coordinates for schedule 'position', got coordinate {i}{which}, "
                f"which {why}. Use schedule 'canonical' or 'time'."
            )


def _value(problem: WeightProblem, learned: Learned, reference: ReferenceMotion) -> Dmp:
    """Return the fitted primitive, with a start velocity fitted to all demonstrations by least squares."""
    scales, demos = problem.scales, problem.demos
    z = np.array([demo.duration for demo in demos])[:, None] / reference.duration * learned.ends[:, 1]
    squares = (scales**2).sum(axis=0)
    v0 = (scales * z).sum(axis=0) / np.where(squares > 0, squares, 1.0)
    y0, _, g = learned.ends.mean(axis=0)
    each = None
    if len(demos) >= MANY:
        small = abs(scales)[:, None] < UNINFORMATIVE
        each = np.where(small, learned.weights, [learn(one).weights for one in problem.of_each()])
    return replace(problem.blank, weights=learned.weights, y0=y0, v0=v0, g=g, demo_weights=each)


def _fit(dmp: Dmp, problem: WeightProblem, learned: Learned) -> Fit[Dmp]:
    (m, n), demos = dmp.weights.shape, problem.demos
    with_ends = learned.unit.shape[1] > m
    one, names, units = _names(m, n, len(demos), with_ends)
    parts = [learned.weights, learned.ends.reshape(-1, n)] if with_ends else [learned.weights]
    kind = "position" if learned.of_position else "forcing"
    return Fit(
        value=dmp,
        names=names,
        units=units,
        parameters=np.concatenate(parts).T.ravel(),
        cov=block_covariance(learned.unit, learned.sigma),
        sigma=learned.sigma,
        residuals=learned.residuals,
        n=sum(len(demo.t) for demo in demos),
        excitation=Excitation.of(learned.triangle, [one[k] for k in learned.unknowns], MAX_CONDITION),
        summary=lambda fit: _report(fit, problem.method, learned, demos),
        classes=tuple(f"{kind} of coordinate {i} [unit of y]" for i in range(n)),
    )


def _names(m: int, n: int, M: int, with_ends: bool) -> tuple[tuple[str, ...], tuple[str, ...], tuple[str, ...]]:
    """Return the names of the unknowns of one coordinate, and the names and units of all parameters."""
    ends = [f"{name} of demonstration {k}" if M > 1 else name for k in range(M) for name in ENDS]
    one = (*(f"weight {j}" for j in range(m)), *(ends if with_ends else ()))
    units = (*("unit of y",) * m, *(("unit of y", "unit of y/s", "unit of y") * M if with_ends else ()))
    owners = [""] if n == 1 else [f" of coordinate {i}" for i in range(n)]
    return one, tuple([name + owner for owner in owners for name in one]), units * n


def _report(fit: Fit[Dmp], method: str, learned: Learned, demos: list[Demo]) -> str:
    dmp = fit.value
    scaled = ", ".join(map(str, dmp.unscaled))
    lines = [
        f"Movement primitive of {dmp.n} coordinates with {dmp.n_basis} kernels, schedule {dmp.schedule!r}, scaling "
        f"{dmp.scaling!r}, convention {dmp.convention!r}, method {method!r}, {len(demos)} demonstrations.",
        *([f"Coordinates not scaled by the goal because they hardly moved: {scaled}."] if scaled else []),
    ]
    if fit.n <= len(learned.unknowns):
        lines.append(
            f"{fit.n} samples for {len(learned.unknowns)} unknowns: the noise is not identifiable, and sigma and the "
            "standard deviations are meaningless. Use fewer kernels."
        )
    for k, demo in enumerate(demos):
        path = learned.path(dmp, demo, k)
        rmse = np.sqrt(((path - demo.y) ** 2).mean(axis=0))
        lines.append(f"RMSE of the motion of demonstration {k}: {', '.join(f'{e:.3g}' for e in rmse)} [unit of y]")
    return "\n".join([*lines, fit.table()])
