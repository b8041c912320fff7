"""Physically consistent inertial parameters nearest to an identified model.

A link is physically consistent if its pseudo-inertia P is positive definite (Wensing, Kim and Slotine 2018). With
Lambda the information matrix of the fitted base parameters,

    minimise  (B pi - base)^T Lambda (B pi - base) + strength d(P, P_0)   over P_i >= 1e-6, rotor >= 0

With fixed friction, the squared residual increases by exactly the first term. Theory: docs/theory/identification.md.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np

from armlab._display import Shown
from armlab._numbers import numbers
from armlab.dynamics import BaseParameters, base_parameters
from armlab.errors import ConfigError, MissingExtra, ModelMismatchError, NotConverged, ShapeError, UnknownName
from armlab.estimation import Fit
from armlab.models import Payload, TorqueModel
from armlab.robots import Robot, inertia

LEAST = 1e-6  # smallest eigenvalue of a pseudo-inertia [kg, kg m^2]
PULLS = ("log-det", "euclidean")
# The cost is flat near the optimum, so the parameter error scales with the square root of the gap. The attainable gap
# depends on the processor; the default of 1e-8 is accepted if no smaller gap is reached.
SOLVER = {"tol_gap_abs": 1e-11, "tol_gap_rel": 1e-11}
SOLVER |= {"reduced_tol_gap_abs": 1e-8, "reduced_tol_gap_rel": 1e-8, "reduced_tol_feas": 1e-6}
WIDTH = 0.05  # minimum radius of gyration of the default prior, as a share of the reach


@dataclass(frozen=True, eq=False, repr=False)
class PhysicallyConsistent(Shown):
    """Torque model with physically consistent links.

    Attributes
    ----------
    model : TorqueModel
        Torque model with these parameters.
    links : array, shape (n, 10), kg, kg m, kg m^2
        m, m c (3), Ixx, Ixy, Iyy, Ixz, Iyz, Izz in link frames, about their origins, as in MuJoCo, URDF and
        `Robot.inertias`. Unidentified directions follow the prior.
    rotor : array, shape (n,), kg m^2
        Rotor inertias.
    growth : float
        Relative increase of the weighted RMS residual.
    distance : float
        Distance of the base parameters from the fit, in standard deviations of white noise: the square root of the
        first term of the cost.
    """

    model: TorqueModel
    links: np.ndarray
    rotor: np.ndarray
    growth: float
    distance: float

    def __post_init__(self) -> None:
        for name in ("links", "rotor"):
            values = np.array(getattr(self, name), dtype=float)
            values.flags.writeable = False
            object.__setattr__(self, name, values)

    def text(self) -> str:
        """Return a table of mass, centre of mass and principal moments of each link, and the residual increase."""
        body, moments = inertia.to_body(self.links), inertia.principal_moments(self.links)
        lines = ["link  mass [kg]  centre of mass [m]        principal moments [kg m^2]     rotor [kg m^2]"]
        for i in range(len(self.links)):
            centre = "  ".join(f"{x:+.3f}" for x in body.centre[i])
            about = "  ".join(f"{x:.2e}" for x in moments[i])
            lines.append(f"{i + 1:4d}  {body.mass[i]:9.3f}  {centre}  {about}  {self.rotor[i]:.3g}")
        return "\n".join([*lines, f"the residual increases by {100 * self.growth:.3g} %"])


def pseudo_inertia(pi: np.ndarray) -> np.ndarray:
    """Return the pseudo-inertia (..., 4, 4): second, first and zeroth mass moments about the frame's origin."""
    pi = numbers(pi, "inertial parameters", ShapeError)
    if pi.shape[-1:] != (10,):
        raise ShapeError(f"Expected inertial parameters of shape (..., 10), got {pi.shape}. See robots.inertia.")
    xx, xy, yy, xz, yz, zz = np.moveaxis(pi[..., 4:], -1, 0)
    half = 0.5 * (xx + yy + zz)
    P = np.empty((*pi.shape[:-1], 4, 4))
    P[..., 0, 0], P[..., 1, 1], P[..., 2, 2] = half - xx, half - yy, half - zz
    P[..., 0, 1] = P[..., 1, 0] = -xy
    P[..., 0, 2] = P[..., 2, 0] = -xz
    P[..., 1, 2] = P[..., 2, 1] = -yz
    P[..., :3, 3] = P[..., 3, :3] = pi[..., 1:4]
    P[..., 3, 3] = pi[..., 0]
    return P


def physically_consistent(
    fit: Fit[TorqueModel], robot: Robot, prior: np.ndarray | None = None, pull: str = "log-det", strength: float = 1.0
) -> PhysicallyConsistent:
    """Return the nearest physically consistent model and the increase of the residual.

    Parameters
    ----------
    fit : result of `fit_dynamics` in this process; a file does not store the information matrix of the log.
    robot : the arm.
    prior : (n, 10) link parameters to regularise towards, for example from CAD; must be physically consistent. Default:
        `robot.inertias`, or spheres between the joints.
    pull : regularisation: "log-det" or "euclidean".
    strength : weight of the regularisation; 1 makes a divergence of 1 cost as much as one standard deviation of white
        noise.

    Raises
    ------
    MissingExtra : cvxpy is not installed.
    ModelMismatchError : a model of another robot.
    ConfigError : a fit loaded from a file, or a fit without all base parameters.
    ShapeError : a prior that is inconsistent or has the wrong shape, or a non-positive strength.
    UnknownName : unknown `pull`.
    NotConverged : the solver found no solution.

    References
    ----------
    Wensing, Kim and Slotine (2018), Linear matrix inequalities for physically consistent inertial parameter
    identification; Lee, Wensing and Park (2020), Geometric robot dynamic identification (log-det divergence).
    """
    if not isinstance(fit, Fit) or not isinstance(fit.value, TorqueModel):
        raise ModelMismatchError(f"Expected the fit of a torque model, got {type(fit).__name__}. See fit_dynamics.")
    model = fit.value
    model.check_robot(robot)
    if pull not in PULLS:
        raise UnknownName.among("regularisation", pull, PULLS)
    if not 0 < strength < np.inf:
        raise ShapeError(f"Expected a strength above 0, got {strength}. Omit strength to use 1.")
    base = base_parameters(robot)
    root = _information_root(fit, base)
    target = fit.parameters[: len(base.names)]
    links, rotor = _nearest(root, target, base, _prior(prior, robot, model), pull, strength)
    values = base.B @ np.concatenate([links.ravel(), rotor])
    distance = float(np.linalg.norm(root @ (values - target)))
    squares = float(np.sum((fit.residuals / fit.sigma) ** 2))
    growth = float(np.sqrt(1.0 + distance**2 / squares) - 1.0)
    constant = base.D @ np.concatenate([links.ravel(), rotor])  # link torque that the fit attributes to the offset
    friction = replace(model.friction, offset=model.friction.offset - constant)
    better = replace(model, link_parameters=links, rotor=rotor, base_values=values, friction=friction)
    return PhysicallyConsistent(better, links, rotor, growth, distance)


def bodies_of(model: TorqueModel, robot: Robot) -> tuple[np.ndarray, np.ndarray, float]:
    """Return consistent links (n, 10) and rotors (n,) that reproduce a model's torques, and the remaining deviation.

    Unidentifiable parameters are kept close to the prior, subject to ``B pi = base``. If that is infeasible, the
    nearest feasible base parameters are used, and their distance from the model, in standard deviations, is returned.
    """
    model.check_robot(robot)
    if model.quasi_static:
        raise ConfigError(
            "Expected a model with inertia, got a model with only gravity and friction. Identify from a log of fast "
            "motion."
        )
    links, rotor, n = model.link_parameters, model.rotor, robot.n
    if np.linalg.eigvalsh(pseudo_inertia(links)).min() > LEAST and rotor.min() >= 0.0:
        return np.array(links), np.array(rotor), 0.0
    base, cvxpy, prior = base_parameters(robot), _cvxpy(), _prior(None, robot, model)
    target = base.B @ np.concatenate([links.ravel(), rotor])
    moments = pseudo_inertia(prior).sum(axis=0)
    scale = np.diag([*[np.sqrt(np.trace(moments[:3, :3]) / moments[3, 3])] * 3, 1.0])
    expand, back = _parameters_of(scale), np.linalg.inv(scale)
    bodies = [cvxpy.Variable((4, 4), symmetric=True) for _ in range(n)]
    turning = cvxpy.Variable(n, nonneg=True)
    pi = cvxpy.hstack([*(expand @ cvxpy.vec(S, order="C") for S in bodies), turning])
    starts = [back @ pseudo_inertia(one) @ back for one in prior]
    far = sum(cvxpy.trace(np.linalg.inv(S0) @ S) - cvxpy.log_det(S) for S, S0 in zip(bodies, starts))
    floors = [S >> 10.0 * LEAST * back @ back for S in bodies]
    size = np.abs(base.B).max(axis=1)
    try:
        exact = [*floors, (base.B / size[:, None]) @ pi == target / size]
        _solve(cvxpy, cvxpy.Problem(cvxpy.Minimize(far), exact))
        found = np.asarray(pi.value)
        found = found + np.linalg.pinv(base.B) @ (target - base.B @ found)  # exact, unlike the solver
        away = 0.0
    except NotConverged:
        values, vectors = np.linalg.eigh(model.base_cov)
        root = (vectors / np.sqrt(np.maximum(values, 1e-12 * values.max()))).T
        _solve(cvxpy, cvxpy.Problem(cvxpy.Minimize(cvxpy.sum_squares((root @ base.B) @ pi - root @ target)), floors))
        found = np.asarray(pi.value)
        away = float(np.linalg.norm(root @ (base.B @ found - target)))
    return found[: 10 * n].reshape(n, 10), np.maximum(found[10 * n :], 0.0), away


def physically_consistent_load(fit: Fit[Payload]) -> Fit[Payload]:
    """Return the nearest physically consistent payload, measured in standard deviations of the fit.

    ``minimise (pi - pi_fit)^T cov^-1 (pi - pi_fit)`` over positive semidefinite pseudo-inertias.

    Parameters
    ----------
    fit : result of `fit_payload` in mode "dynamic"; its covariance is kept.

    Raises
    ------
    MissingExtra : cvxpy is not installed.
    ConfigError : a fit of only mass and centre of mass, which is always consistent.
    NotConverged : the solver found no solution.
    """
    if len(fit.parameters) != 10:
        raise ConfigError(f"Expected a load with inertia, got {len(fit.parameters)} parameters. Use mode='dynamic'.")
    cvxpy, far = _cvxpy(), float(np.linalg.norm(fit.value.centre)) or 1.0
    scale = np.diag([far, far, far, 1.0])
    expand = _parameters_of(scale)
    body = cvxpy.Variable((4, 4), PSD=True)
    root = np.linalg.inv(np.linalg.cholesky(fit.cov))
    away = (root @ expand) @ cvxpy.vec(body, order="C") - root @ fit.parameters
    _solve(cvxpy, cvxpy.Problem(cvxpy.Minimize(cvxpy.sum_squares(away))))
    pi = expand @ _at_least(scale @ body.value @ scale, scale, 0.0)
    distance = float(np.linalg.norm(root @ (pi - fit.parameters)))
    text = fit.report()

    def summary(moved: Fit[Payload]) -> str:
        return (
            f"{moved.table()}\nmoved by {distance:.2g} standard deviations to become physically consistent; "
            f"before the change:\n{text}"
        )

    return replace(fit, value=replace(fit.value, pi=pi), parameters=pi, summary=summary)


def _information_root(fit: Fit[TorqueModel], base: BaseParameters) -> np.ndarray:
    """Return R (p, p) such that ``R^T R`` is the information matrix of the base parameters for fixed friction."""
    p, known = len(base.names), fit.excitation
    if tuple(fit.value.base_names) != base.names or fit.names[:p] != base.names:
        raise ConfigError(
            "Expected a fit of all base parameters of the robot, got other parameters. Use identify.fit_dynamics."
        )
    if known.vectors.shape != (len(fit.names),) * 2:
        raise ConfigError(
            "Expected the fit returned by fit_dynamics, got a fit without the information from the log, for example "
            "from a file. Repeat the identification from the log."
        )
    whole = known.singular_values[:, None] * known.vectors.T * known.scale
    return np.linalg.qr(whole[:, :p])[1]


def _prior(prior: np.ndarray | None, robot: Robot, model: TorqueModel) -> np.ndarray:
    """Return the prior link parameters (n, 10)."""
    if prior is None and robot.inertias is not None:
        links = np.array(robot.inertias)
        bodies = np.linalg.eigvalsh(pseudo_inertia(links)).min(axis=1) > LEAST
        return np.where(bodies[:, None], links, _balls(robot, model))
    if prior is None:
        return _balls(robot, model)
    links = np.asarray(prior, dtype=float)
    if links.shape != (robot.n, 10) or not np.isfinite(links).all():
        raise ShapeError(f"Expected a prior of shape ({robot.n}, 10), got {links.shape}. Pass ten numbers per link.")
    least = np.linalg.eigvalsh(pseudo_inertia(links)).min(axis=1)
    if np.any(least <= 0):
        listed = ", ".join(f"link {i + 1}" for i in np.flatnonzero(least <= 0))
        raise ShapeError(
            f"Expected a consistent prior, got inconsistent parameters for {listed}. See robots.inertia.from_body."
        )
    return links


def _balls(robot: Robot, model: TorqueModel) -> np.ndarray:
    """Return spheres centred halfway to the next joint, with a total mass that matches the torques of the log."""
    way = robot.frames[1:, :3, 3]
    length = np.linalg.norm(way, axis=1)
    reach = length.sum()
    mass = 2.0 * model.quality.torque_sd.max() / (9.81 * reach) / robot.n
    about = mass * np.maximum(length / 3.0, WIDTH * reach)[:, None, None] ** 2 * np.eye(3)
    return inertia.from_body(np.full(robot.n, mass), way / 2, about)


def _nearest(
    root: np.ndarray, target: np.ndarray, base: BaseParameters, prior: np.ndarray, pull: str, strength: float
) -> tuple[np.ndarray, np.ndarray]:
    """Solve the semidefinite program; return links (n, 10) and rotors (n,)."""
    cvxpy = _cvxpy()
    n = len(prior)
    moments = pseudo_inertia(prior).sum(axis=0)
    scale = np.diag([*[np.sqrt(np.trace(moments[:3, :3]) / moments[3, 3])] * 3, 1.0])  # entries of similar magnitude
    expand = _parameters_of(scale)
    back = np.linalg.inv(scale)
    bodies = [cvxpy.Variable((4, 4), symmetric=True) for _ in range(n)]
    rotor = cvxpy.Variable(n, nonneg=True)
    values = base.B[:, 10 * n :] @ rotor
    cost = 0.0
    for i, S in enumerate(bodies):
        values = values + (base.B[:, 10 * i : 10 * i + 10] @ expand) @ cvxpy.vec(S, order="C")
        S0 = back @ pseudo_inertia(prior[i]) @ back
        if pull == "log-det":
            cost = cost + cvxpy.trace(np.linalg.inv(S0) @ S) - cvxpy.log_det(S)
        else:
            cost = cost + cvxpy.sum_squares(S - S0) / np.sum(S0 * S0)
    cost = cvxpy.sum_squares(root @ values - root @ target) + strength * cost
    problem = cvxpy.Problem(cvxpy.Minimize(cost), [S >> LEAST * back @ back for S in bodies])
    _solve(cvxpy, problem)
    found = np.stack([expand @ _at_least(scale @ S.value @ scale, scale, LEAST) for S in bodies])
    return found, np.maximum(rotor.value, 0.0)


def _solve(cvxpy: Any, problem: Any) -> None:
    """Solve the optimisation problem; raise an error if there is no solution."""
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Solution may be inaccurate", UserWarning)  # SOLVER sets the accuracy
            problem.solve(solver="CLARABEL", **SOLVER)
    except cvxpy.SolverError as error:
        raise NotConverged(
            f"Expected physically consistent parameters near the fit, got no solution: {error}. Try another strength."
        ) from None
    if problem.status not in ("optimal", "optimal_inaccurate"):
        raise NotConverged(f"Expected a solution near the fit, got status {problem.status!r}. Try another strength.")


def _at_least(P: np.ndarray, scale: np.ndarray, least: float) -> np.ndarray:
    """Return the scaled pseudo-inertia (16,) with eigenvalues raised to at least `least`, to compensate for solver
    errors."""
    values, vectors = np.linalg.eigh(P)
    back = np.linalg.inv(scale)
    return (back @ (vectors * np.maximum(values, least)) @ vectors.T @ back).ravel()


def _parameters_of(scale: np.ndarray) -> np.ndarray:
    """Return the matrix (10, 16) that maps the entries of a scaled pseudo-inertia to the parameters."""
    columns = []
    for entry in np.eye(16).reshape(16, 4, 4):
        P = scale @ (0.5 * (entry + entry.T)) @ scale
        about = np.trace(P[:3, :3]) * np.eye(3) - P[:3, :3]
        columns.append([P[3, 3], *P[:3, 3], *about[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]])
    return np.array(columns).T


def _cvxpy() -> Any:
    """Import cvxpy, or raise an error with the installation command."""
    try:
        return import_module("cvxpy")
    except ImportError:
        raise MissingExtra(
            "Expected the package cvxpy for physically consistent links, but it is not installed. Install it: pip "
            "install 'armlab[sdp]'."
        ) from None
