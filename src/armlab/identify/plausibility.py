"""Plausibility of torques: detects a wrong unit, sign or scale per joint.

Friction dissipates power: if friction supplies power in the coarse regression of a joint, the sign of the torque is
reversed. With masses in the robot file, joint torques are compared with the torques r_i required by these masses,
``tau_i = k_i r_i(q, qd, qdd) + rotor qdd + friction + offset``. Otherwise, the joints are compared with each other:
each joint measures k_i times the torque of shared links (`identify.solve.GainProblem`, with an almost flat
prior).
"""

from __future__ import annotations

import numpy as np

from armlab.errors import ShapeError
from armlab.estimation.robust import effective_samples
from armlab.identify.record import Record, Survey
from armlab.identify.regression import Design
from armlab.identify.solve import GAIN_SD, GainProblem, as_read, solved
from armlab.log.units_check import GEARED, gears
from armlab.robots import Robot

DOUBTED, REFUSED = 1.3, 3.0  # ratios of measured to expected torque that raise a doubt and an error
SURE, CERTAIN = 3.0, 5.0  # significance, in standard deviations, required to report a factor and a sign
KNOWN = 0.15  # largest relative SD at which a factor counts as known
SMALL = 0.01  # fraction of the torque below which friction does not determine the sign
LOOSE, ROUNDS = 1.0, 4  # prior SD of almost free gains; iterations of the joint weights
SUSPECT = 1.5  # prior SDs above which the gains are checked with a loose prior


def check_signs(survey: Survey, used: np.ndarray) -> list[str]:
    """Return a sentence listing the selected joints (n,) whose friction supplies power."""
    found = [str(i + 1) for i in np.flatnonzero(used) if _gives_power(survey, int(i))]
    if not found:
        return []
    return [
        f"joint{'s' * (len(found) > 1)} {', '.join(found)}: the torque sign "
        "is probably reversed, because friction appears to drive the motion"
    ]


def _gives_power(survey: Survey, i: int) -> bool:
    """Return whether the identified friction of joint i is significantly negative, so that it drives the joint."""
    F, y, qd = survey.friction(i), survey.tau[survey.rows, i], survey.qd[:, i]
    slope, sd = _slope(F, y, survey.columns(i), F.T @ qd / max(float(np.abs(qd).sum()), 1e-12))
    return slope < -max(CERTAIN * sd, SMALL * float(np.std(y)))


def _slope(X: np.ndarray, y: np.ndarray, others: np.ndarray, of: np.ndarray) -> tuple[float, float]:
    """Return ``of @ b`` and its standard deviation for y ~ X b + others c with coloured residuals."""
    scale = np.maximum(np.sqrt(np.sum(X * X, axis=0)), 1e-12)
    A = np.hstack([X / scale, others / np.maximum(np.sqrt(np.sum(others * others, axis=0)), 1e-12)])
    inverse = np.linalg.pinv(A.T @ A, rcond=1e-9, hermitian=True)
    b = inverse @ (A.T @ y)
    left, w = y - A @ b, np.append(of / scale, np.zeros(others.shape[1]))
    variance = float(np.mean(left * left)) * len(y) / effective_samples(left)
    return float(w @ b), float(np.sqrt(max(variance * (w @ inverse @ w), 0.0)))


def mass_factors(survey: Survey, robot: Robot, used: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the ratio (n,) of measured torque to the torque computed from the masses in the robot file, and its SD;
    NaN if unknown."""
    factors = np.full((2, len(used)), np.nan)
    if robot.inertias is None:
        return factors[0], factors[1]
    needed = survey.rigid @ robot.inertias.ravel()
    for i in np.flatnonzero(used):
        others = np.column_stack([survey.qdd[:, i], np.ones(len(survey.rows)), survey.friction(int(i))])
        factors[:, i] = _slope(needed[:, i : i + 1], survey.tau[survey.rows, i], others, np.ones(1))
    return factors[0], factors[1]


def loose_gains(design: Design, method: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the relative gains (n,) of the joints and their standard deviations; NaN if unknown."""
    found = np.full((2, len(design.robot.joint_names)), np.nan)
    if np.all(np.abs(design.gains - 1.0) < SUSPECT * GAIN_SD):
        return found[0], found[1]
    cov = np.zeros((len(design.joints),) * 2)
    for _ in range(ROUNDS):
        solution = solved(design, None, method)
        read = as_read(solution, design.gains)
        problem = GainProblem.of(read, design.residuals(solution.x), design.gains - 1.0, LOOSE)
        x, g = problem.solve()
        if not np.all(np.isfinite(g)) or np.any(g <= -1.0):
            return found[0], found[1]
        design, cov = design.with_gains(1.0 + g), problem.gain_covariance(x, g)
    gains = design.gains
    apart = (np.eye(len(gains)) - 1.0 / len(gains)) / gains  # logarithms without the common factor
    found[:, design.joints] = gains, gains * np.sqrt(np.diag(apart @ cov @ apart.T))
    return found[0], found[1]


def check_factors(factors: np.ndarray, sd: np.ndarray, robot: Robot, masses: bool) -> tuple[list[str], bool]:
    """Return sentences about implausible torque factors (n,), and whether they are errors rather than doubts."""
    known = np.isfinite(factors) & (sd < KNOWN * np.abs(factors))
    if not known.any():
        return [], False
    common = float(np.median(factors[known]))
    shared = masses and common > 0 and abs(np.log(common)) > np.log(DOUBTED) and np.count_nonzero(known) > 1
    reference = common if shared or not masses else 1.0
    said, worst = [], common if shared else 1.0
    if shared:
        said.append(f"torques are {common:.2g} times those required by these masses: {_unit(common, robot, known)}")
    for i in np.flatnonzero(known):
        own = float(factors[i]) / reference
        off = own < 0 or abs(np.log(own)) > np.log(DOUBTED) + SURE * sd[i] / abs(factors[i])
        if off:
            said.append(_named(i, own, robot, "these masses require" if masses else "the other joints imply"))
            worst = max((worst, own), key=lambda x: np.inf if x <= 0 else abs(np.log(x)))
    return said, worst <= 0 or abs(np.log(worst)) > np.log(REFUSED)


def _named(i: int | np.intp, own: float, robot: Robot, what: str) -> str:
    """Return a sentence about joint i, whose torque is `own` times the expected torque."""
    for factor, word in ((0.5, "half"), (2.0, "double")):
        if abs(np.log(abs(own) / factor)) < 0.15 and own > 0:
            return f"joint {i + 1} reads {word} the torque that {what}"
    hint = "" if 1.0 / REFUSED < own < REFUSED else f": {_unit(own, robot, np.arange(len(robot.joint_names)) == i)}"
    return f"joint {i + 1} reads {own:.2g} times the torque that {what}{hint}"


def _unit(factor: float, robot: Robot, joints: np.ndarray) -> str:
    """Return the likely cause of torques that are `factor` times too large."""
    gear = float(np.median(gears(robot)[joints]))
    if factor < 0:
        return "sign reversed"
    if gear >= GEARED and abs(np.log(factor * gear)) < np.log(DOUBTED):
        return f"possibly motor torques, gear ratio {gear:g}? Use robots.couplings.motor_torque_to_joint"
    if factor < 1.0 / REFUSED:
        return "currents in ampere?"
    return "possibly a load, different masses or a different unit"


def raise_unless(force: bool, said: list[str], fault: bool) -> tuple[str, ...]:
    """Return doubts; for errors, raise an exception unless forced."""
    if fault and not force:
        raise ShapeError(
            f"Expected joint-side torques in N m, got: {'; '.join(said)}. Correct the columns or the masses in "
            "the robot file; --force (force=True) fits them unchanged."
        )
    return tuple(said)


def check_torques(data: Record, robot: Robot, used: np.ndarray, force: bool) -> tuple[str, ...]:
    """Return warnings about implausible torques of the selected joints (n,); raise an error for a wrong sign or
    unit."""
    survey = Survey.of(data, robot)
    signs = check_signs(survey, used)
    if signs:
        return raise_unless(force, signs, True)
    said, fault = check_factors(*mass_factors(survey, robot, used), robot, masses=True)
    return raise_unless(force, said, fault)


def check_gains(design: Design, method: str, force: bool) -> tuple[str, ...]:
    """Return doubts about the relative gains of the joints; raise an error for deviations above a factor of three."""
    said, fault = check_factors(*loose_gains(design, method), design.robot, masses=False)
    return raise_unless(force, said, fault)
