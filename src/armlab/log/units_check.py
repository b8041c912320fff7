"""Checks for wrong units and motor-side values; the error messages state the likely factor."""

from __future__ import annotations

import numpy as np

from armlab.errors import NotExcited, ShapeError
from armlab.robots import Robot

TOLERANCE, CORRELATION = 0.1, 0.98  # relative gain error, and correlation of qd with the derivative of q
BEYOND = 3.0  # multiple of the joint limits; positions beyond it must be in a different unit
FLAT = 0.8  # fraction of rows with the same torque
LIGHT = 0.1  # kg/m^3, torque / (g reach^4): 1 to 60 for arms, < 0.05 for motors of geared arms
HEAVY, DYNAMIC = 12.0, 3.0  # maximum plausible ratio of link weight to torque; allowance for dynamic torque
GEARED = 10.0
MOVED = (0.005, np.deg2rad(1.0))  # m, rad: smallest motion of a joint for the velocity check
FEW = 0.01  # maximum fraction of rows with implausible positions that count as glitches


def has_moved(q: np.ndarray, robot: Robot) -> np.ndarray:
    """Return the joints (n,) whose position (N, n) changed by at least one degree, or 5 mm."""
    return np.ptp(q, axis=0) >= np.where(robot.prismatic, *MOVED)


def check_known(q: np.ndarray, tau: np.ndarray, robot: Robot) -> None:
    """Raise an error for positions in the wrong unit or unmeasured torques; a few wrong rows are ignored."""
    whole = np.isfinite(q).all(axis=1) & np.isfinite(tau).all(axis=1)
    q, tau = q[whole], tau[whole]
    if not len(q):
        return
    check_position(q, robot, FEW)
    moved = has_moved(q, robot)
    if moved.any() and not np.ptp(tau, axis=0).any():
        check_constant(tau, moved, robot)


def check_position(q: np.ndarray, robot: Robot, few: float = 0.0) -> None:
    """Raise an error if q (N, n) is far outside the joint limits in more than the fraction `few` of the rows."""
    limit = np.maximum(np.abs(robot.q_min), np.abs(robot.q_max))
    peak = np.abs(q).max(axis=0)
    far = np.flatnonzero(np.isfinite(limit) & (limit > 0) & (peak > BEYOND * limit))
    far = far[np.mean(np.abs(q[:, far]) > BEYOND * limit[far], axis=0) > few]
    if not len(far):
        return
    words = [
        f"{robot.joint_names[i]} ({peak[i]:.4g}, limit {limit[i]:.4g}: {_side(peak[i] / limit[i], i, robot)})"
        for i in far
    ]
    raise ShapeError(
        f"Expected q in rad (m) on the joint side, within the limits of {robot.name!r}, got {', '.join(words)}. "
        "Convert q."
    )


def _side(times: float, joint: int | np.intp, robot: Robot) -> str:
    """Return the likely unit of a position that is `times` times its limit."""
    gear, found = gears(robot)[joint], []
    unit = ("millimetres, divide by 1000", 1e3) if robot.prismatic[joint] else ("degrees", np.rad2deg(1.0))
    if times <= 1.05 * unit[1]:
        found.append(unit[0])
    if gear >= GEARED and times <= 1.05 * gear:
        found.append(f"motor side, gear ratio {gear:g}, see robots.couplings.motor_to_joint")
    return " or ".join(found) or "no known unit"


def check_velocity(slope: np.ndarray, qd: np.ndarray, moved: np.ndarray, robot: Robot) -> None:
    """Raise an error if qd (N, n) of moved joints (n,) differs from the derivative of q, filtered in the same way."""
    power = np.sum(slope**2, axis=0) + 1e-300
    gain = np.sum(slope * qd, axis=0) / power
    norm = np.sqrt(power * np.sum(qd**2, axis=0) + 1e-300)
    alike = (slope.T @ qd) / np.sqrt(np.outer(power, np.sum(qd**2, axis=0)) + 1e-300)
    correlation = np.sum(slope * qd, axis=0) / norm
    wrong = np.flatnonzero(moved & ((np.abs(gain - 1) > TOLERANCE) | (correlation < CORRELATION)))
    if not len(wrong):
        return
    gear = gears(robot)
    words = []
    for i in wrong:
        other = int(np.argmax(alike[i]))
        if other != i and alike[i, other] > CORRELATION > correlation[i]:
            what = f"the column of {robot.joint_names[other]} matches: wrong joint order"
        else:
            what = _meaning(float(gain[i]), float(correlation[i]), gear[i])
        words.append(f"{robot.joint_names[i]} ({gain[i]:.3g} times: {what})")
    raise ShapeError(
        f"Expected qd to be the derivative of q, but it differs for {', '.join(words)}. "
        "Correct the column, or omit qd to compute it from q."
    )


def _meaning(gain: float, correlation: float, gear: float) -> str:
    """Return the likely cause of a scale factor between qd and the derivative of q."""
    known = [(1.0, "sign"), (np.rad2deg(1.0), "degrees per second"), (np.deg2rad(1.0), "position in degrees")]
    known += [(1e3, "per millisecond"), (1e-3, "thousandths")]
    if gear >= GEARED:
        known.append((gear, f"motor side, gear ratio {gear:g}"))
        known.append((1.0 / gear, f"position on the motor side, ratio {gear:g}"))
    if abs(correlation) >= CORRELATION:
        for factor, words in known:
            if abs(abs(gain) / factor - 1.0) < TOLERANCE and (factor != 1.0 or gain < 0):
                return words + (" and sign" if gain < 0 and factor != 1.0 else "")
        return "unit"
    return "a different signal, or timestamps of a signal other than q"


def check_torque(q: np.ndarray, tau: np.ndarray, used: np.ndarray, robot: Robot) -> None:
    """Raise an error for torques (N, n) that are constant, or so small that they must be motor-side torques.

    If the robot file has link masses, the torque is compared with the weight of the links; otherwise, it is compared
    with the reach of the arm. For payloads of 0.5 to 300 kg, half the torque range divided by ``g reach^4`` is 1 to 60
    kg/m^3.
    """
    check_constant(tau, used, robot)
    sized = _against_links(q, tau, used, robot) if robot.inertias is not None else _against_reach(tau, used, robot)
    if sized is None:
        return
    joints, evidence = sized
    gear = gears(robot)
    listed = ", ".join(robot.joint_names[i] + (f" (gear ratio {gear[i]:g})" if gear[i] > 1 else "") for i in joints)
    advice = (
        "Convert the torque with robots.couplings.motor_torque_to_joint."
        if np.any(gear[joints] >= GEARED)
        else "Multiply the torque by the gear ratio, and add the coupling to the robot description."
    )
    raise ShapeError(
        f"Expected torque on the joint side in N m, got what appear to be motor torques for {listed}: {evidence}. "
        f"{advice}"
    )


def check_constant(tau: np.ndarray, used: np.ndarray, robot: Robot) -> None:
    """Raise an error if the torques (N, n) of joints (n,) are constant in most rows."""
    share = np.array([np.unique(column, return_counts=True)[1].max() / len(column) for column in tau.T])
    flat = np.flatnonzero(used & (share > FLAT))
    if len(flat):
        names = [robot.joint_names[i] for i in flat]
        spread = [
            "constant torque" if share[i] == 1.0 else f"the same torque in {100 * share[i]:.0f} % of the rows"
            for i in flat
        ]
        listed = ", ".join(f"{a} ({b})" for a, b in zip(names, spread))
        raise NotExcited(
            f"Expected measured torques, got constant values for {listed}. Check that the robot sends torques.",
            names,
            spread,
        )


def _against_links(q: np.ndarray, tau: np.ndarray, used: np.ndarray, robot: Robot) -> tuple[np.ndarray, str] | None:
    """Return the joints whose torque is implausibly small for the weight of the links, and the evidence."""
    still = np.zeros_like(q)
    gravity = robot.chain.rnea(q, still, still, robot.gravity, robot.inertias)
    gravity, varied = gravity - gravity.mean(axis=0), tau - tau.mean(axis=0)
    size = gravity.std(axis=0)
    lifts = used & (size > 0.1 * size.max(initial=0.0)) & (size > 1e-6)
    if not lifts.any():
        return None
    scale = np.where(lifts, np.sum(gravity * varied, axis=0) / np.maximum(np.sum(gravity**2, axis=0), 1e-300), 1.0)
    gear = np.where(gears(robot) >= GEARED, gears(robot), np.inf)
    least = 1.0 / np.minimum(HEAVY, np.sqrt(gear))
    small = lifts & (np.abs(scale) < least) & (varied.std(axis=0) < DYNAMIC * least * size)
    if np.count_nonzero(small) * 2 < np.count_nonzero(lifts):
        return None
    joints = np.flatnonzero(small)
    factors = ", ".join(f"{scale[i]:.2g}" for i in joints)
    return joints, f"{factors} times the weight of the links"


def _against_reach(tau: np.ndarray, used: np.ndarray, robot: Robot) -> tuple[np.ndarray, str] | None:
    """Return the joints whose torque is implausibly small for the reach of the arm, and the evidence."""
    g = float(np.linalg.norm(robot.gravity))
    revolute = used & ~robot.prismatic
    reach = float(np.linalg.norm(robot.frames[1:, :3, 3], axis=1).sum())
    upright = np.abs(robot.screws[:, 3:] @ robot.gravity) > 0.999 * g
    if g == 0 or reach == 0 or not np.any(revolute) or bool(np.all(upright | ~revolute)):
        return None
    swing = 0.5 * float(np.ptp(tau[:, revolute], axis=0).max())
    if swing > LIGHT * g * reach**4:
        return None
    return np.flatnonzero(revolute), f"at most {swing:.2g} N m on an arm with a reach of {reach:.2g} m"


def gears(robot: Robot) -> np.ndarray:
    """Return the absolute gear ratios (n,); 1 if the robot file has none."""
    return np.abs(np.diag(np.linalg.inv(robot.coupling)))
