"""Links that are real bodies: the nearest to an identified model whose masses are positive everywhere.

A link is a body exactly when its pseudo-inertia P is positive definite (Wensing, Kim and Slotine 2018). With Lambda the
information of the fit on its base parameters,

    minimise  (B pi - base)^T Lambda (B pi - base) + strength d(P, P_0)   over P_i >= 1e-6, rotor >= 0

which grows the squared residual by exactly the first term, friction held. Theory: docs/theory/identification.md.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np

from armlab._numbers import numbers
from armlab.errors import ConfigError, MissingExtra, ModelMismatchError, NotConverged, ShapeError, UnknownName
from armlab.estimation import Fit
from armlab.identify.regression import BaseParameters, base_parameters
from armlab.models import Payload, TorqueModel
from armlab.robots import Robot, inertia

LEAST = 1e-6  # eigenvalue of a pseudo-inertia [kg, kg m^2]
PULLS = ("log-det", "euclidean")
# The cost is flat about the bodies: its root is their error. How far rounding lets the solver come depends on the
# processor; a gap of 1e-8, its default, is enough where it comes no farther.
SOLVER = {"tol_gap_abs": 1e-11, "tol_gap_rel": 1e-11}
SOLVER |= {"reduced_tol_gap_abs": 1e-8, "reduced_tol_gap_rel": 1e-8, "reduced_tol_feas": 1e-6}
WIDTH = 0.05  # radius of gyration of a default prior, as a share of the reach


@dataclass(frozen=True, eq=False)
class PhysicallyConsistent:
    """Torque model with physically consistent links.

    Attributes
    ----------
    model : TorqueModel
        Torque model with the parameters of these links.
    links : array, shape (n, 10), kg, kg m, kg m^2
        m, m c (3), Ixx, Ixy, Iyy, Ixz, Iyz, Izz in link frames, about their origins, as MuJoCo, URDF and
        `Robot.inertias` take them. Along unidentified directions they are those of the prior.
    rotor : array, shape (n,), kg m^2
        Rotor inertias.
    growth : float
        Relative growth of the weighted RMS residual.
    distance : float
        Distance of the base parameters from the fit, in standard deviations of white noise: the root of the first term
        of the cost.
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
        """Return mass, centre and principal moments of each link, and what it cost."""
        body, moments = inertia.to_body(self.links), inertia.principal_moments(self.links)
        lines = ["link  mass [kg]  centre of mass [m]        principal moments [kg m^2]     rotor [kg m^2]"]
        for i in range(len(self.links)):
            centre = "  ".join(f"{x:+.3f}" for x in body.centre[i])
            about = "  ".join(f"{x:.2e}" for x in moments[i])
            lines.append(f"{i + 1:4d}  {body.mass[i]:9.3f}  {centre}  {about}  {self.rotor[i]:.3g}")
        return "\n".join([*lines, f"the residual grows by {100 * self.growth:.3g} %"])


def pseudo_inertia(pi: np.ndarray) -> np.ndarray:
    """Return the pseudo-inertia (..., 4, 4): second, first and zeroth moments of the mass about the frame's origin."""
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
    """Return the nearest model whose links are bodies, with how much the residual grows.

    Parameters
    ----------
    fit : of `fit_dynamics`, as it was returned: a file does not keep what the log could tell.
    robot : the arm.
    prior : (n, 10) link parameters to pull to, for example of CAD; must be bodies. When left out `robot.inertias`, or
        balls between the joints where there are none.
    pull : "log-det" or "euclidean".
    strength : of the pull; 1 is as much as one deviation of white noise for a divergence of 1.

    Raises
    ------
    MissingExtra : cvxpy is not installed. ModelMismatchError : a model of another robot.
    ConfigError : a fit from a file, or of something else than all base parameters.
    ShapeError : a prior of another shape or that is no body, a strength that is not positive. UnknownName : another
    pull. NotConverged : the solver did not find a solution.

    References
    ----------
    Wensing, Kim and Slotine (2018), Linear matrix inequalities for physically consistent inertial parameter
    identification; Lee, Wensing and Park (2020), Geometric robot dynamic identification, for the log-det divergence.
    """
    if not isinstance(fit, Fit) or not isinstance(fit.value, TorqueModel):
        raise ModelMismatchError(f"Expected the fit of a torque model, got {type(fit).__name__}. See fit_dynamics.")
    model = fit.value
    model.check_robot(robot)
    if pull not in PULLS:
        raise UnknownName.among("pull to the prior", pull, PULLS)
    if not 0 < strength < np.inf:
        raise ShapeError(f"Expected a strength above 0, got {strength}. Leave it out for 1.")
    base = base_parameters(robot)
    root = _information_root(fit, base)
    target = fit.parameters[: len(base.names)]
    links, rotor = _nearest(root, target, base, _prior(prior, robot, model), pull, strength)
    values = base.B @ np.concatenate([links.ravel(), rotor])
    distance = float(np.linalg.norm(root @ (values - target)))
    squares = float(np.sum((fit.residuals / fit.sigma) ** 2))
    growth = float(np.sqrt(1.0 + distance**2 / squares) - 1.0)
    constant = base.D @ np.concatenate([links.ravel(), rotor])  # torque of bodies that the fit took for an offset
    friction = replace(model.friction, offset=model.friction.offset - constant)
    better = replace(model, link_parameters=links, rotor=rotor, base_values=values, friction=friction)
    return PhysicallyConsistent(better, links, rotor, growth, distance)


def physically_consistent_load(fit: Fit[Payload]) -> Fit[Payload]:
    """Return the nearest load that is a body, in deviations of the fit.

    ``minimise (pi - pi_fit)^T cov^-1 (pi - pi_fit)`` over pseudo-inertias that are not negative.

    Parameters
    ----------
    fit : of `fit_payload` in mode "dynamic". The covariance stays that of the fit.

    Raises
    ------
    MissingExtra : cvxpy is not installed. ConfigError : a fit of mass and centre only, which is a body as it is.
    NotConverged : the solver did not find a solution.
    """
    if len(fit.parameters) != 10:
        raise ConfigError(
            f"Expected a load with inertia, got {len(fit.parameters)} parameters. Fit it with mode='dynamic'."
        )
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
        return f"{moved.table()}\nmoved by {distance:.2g} deviations to a body; before:\n{text}"

    return replace(fit, value=replace(fit.value, pi=pi), parameters=pi, summary=summary)


def _information_root(fit: Fit[TorqueModel], base: BaseParameters) -> np.ndarray:
    """Return R (p, p) with ``R^T R`` the information on the base parameters, friction held."""
    p, known = len(base.names), fit.excitation
    if tuple(fit.value.base_names) != base.names or fit.names[:p] != base.names:
        raise ConfigError("Expected a fit of all base parameters of the robot, got another. Use identify.fit_dynamics.")
    if known.vectors.shape != (len(fit.names),) * 2:
        raise ConfigError(
            "Expected the fit as fit_dynamics returned it, got one without the information of the log, as files are. "
            "Identify again from the log."
        )
    whole = known.singular_values[:, None] * known.vectors.T * known.scale
    return np.linalg.qr(whole[:, :p])[1]


def _prior(prior: np.ndarray | None, robot: Robot, model: TorqueModel) -> np.ndarray:
    """Return the link parameters (n, 10) to pull to."""
    if prior is None and robot.inertias is not None:
        links = np.array(robot.inertias)
        bodies = np.linalg.eigvalsh(pseudo_inertia(links)).min(axis=1) > LEAST
        return np.where(bodies[:, None], links, _balls(robot, model))
    if prior is None:
        return _balls(robot, model)
    links = np.asarray(prior, dtype=float)
    if links.shape != (robot.n, 10) or not np.isfinite(links).all():
        raise ShapeError(f"Expected a prior of shape ({robot.n}, 10), got {links.shape}. Give ten numbers per link.")
    least = np.linalg.eigvalsh(pseudo_inertia(links)).min(axis=1)
    if np.any(least <= 0):
        listed = ", ".join(f"link {i + 1}" for i in np.flatnonzero(least <= 0))
        raise ShapeError(f"Expected bodies as prior, got none for {listed}. See robots.inertia.from_body.")
    return links


def _balls(robot: Robot, model: TorqueModel) -> np.ndarray:
    """Return balls half-way to the next joint; together as heavy as the torques of the log let expect."""
    way = robot.frames[1:, :3, 3]
    length = np.linalg.norm(way, axis=1)
    reach = length.sum()
    mass = 2.0 * model.quality.torque_sd.max() / (9.81 * reach) / robot.n
    about = mass * np.maximum(length / 3.0, WIDTH * reach)[:, None, None] ** 2 * np.eye(3)
    return inertia.from_body(np.full(robot.n, mass), way / 2, about)


def _nearest(
    root: np.ndarray, target: np.ndarray, base: BaseParameters, prior: np.ndarray, pull: str, strength: float
) -> tuple[np.ndarray, np.ndarray]:
    """Solve the semidefinite programme; return links (n, 10) and rotors (n,)."""
    cvxpy = _cvxpy()
    n = len(prior)
    moments = pseudo_inertia(prior).sum(axis=0)
    scale = np.diag([*[np.sqrt(np.trace(moments[:3, :3]) / moments[3, 3])] * 3, 1.0])  # entries of one size
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
    """Solve, or say that there is no solution."""
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Solution may be inaccurate", UserWarning)  # see SOLVER for how much
            problem.solve(solver="CLARABEL", **SOLVER)
    except cvxpy.SolverError as error:
        raise NotConverged(f"Expected bodies near the fit, got no solution: {error}. Try another strength.") from None
    if problem.status not in ("optimal", "optimal_inaccurate"):
        raise NotConverged(f"Expected bodies near the fit, got solver status {problem.status!r}. Try another strength.")


def _at_least(P: np.ndarray, scale: np.ndarray, least: float) -> np.ndarray:
    """Return the scaled pseudo-inertia (16,) with eigenvalues of at least `least`, which solvers meet to rounding."""
    values, vectors = np.linalg.eigh(P)
    back = np.linalg.inv(scale)
    return (back @ (vectors * np.maximum(values, least)) @ vectors.T @ back).ravel()


def _parameters_of(scale: np.ndarray) -> np.ndarray:
    """Return the matrix (10, 16) from the entries of a scaled pseudo-inertia to the parameters."""
    columns = []
    for entry in np.eye(16).reshape(16, 4, 4):
        P = scale @ (0.5 * (entry + entry.T)) @ scale
        about = np.trace(P[:3, :3]) * np.eye(3) - P[:3, :3]
        columns.append([P[3, 3], *P[:3, 3], *about[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]])
    return np.array(columns).T


def _cvxpy() -> Any:
    """Return cvxpy, or say how to get it."""
    try:
        return import_module("cvxpy")
    except ImportError:
        raise MissingExtra(
            "Expected cvxpy for links that are bodies, got none. Install it: pip install 'armlab[sdp]'."
        ) from None
