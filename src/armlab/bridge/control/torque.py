"""Torques on their way to the robot: what is asked for, what may be sent, and an admittance for links without torques.

A torque beside a position or velocity is a feed-forward. A torque alone takes the place of the position loop: the drive
then adds gravity only, and the position sent is the one measured, from which a hold begins.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from armlab.bridge.control.limits import Limits, Reply
from armlab.errors import CommandRefused, ConfigError
from armlab.robots import Robot
from armlab.wire.egm.axes import Linkage

TorqueModel = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""From positions and velocities (n,) to the torques (n,) that a free motion needs."""

_CLIPPED, _SLOWED = 16, 32
_SLACK = 1e-9  # N m: rounding is not a clamp


@dataclass(frozen=True, eq=False)
class Admittance:
    """Velocities in place of torques: ``qd_ref = (tau_ref - tau_model(q, qd)) / D``."""

    damping: np.ndarray
    model: TorqueModel | None = None

    def __post_init__(self) -> None:
        damping = np.asarray(self.damping, dtype=np.float64)
        if damping.ndim != 1 or not np.all((damping > 0.0) & np.isfinite(damping)):
            raise ConfigError(f"Expected a positive damping for each joint, in N m s/rad, got {self.damping}.")
        object.__setattr__(self, "damping", damping)

    def velocity(self, tau: np.ndarray, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        return (tau if self.model is None else tau - self.model(q, qd)) / self.damping


class Torques:
    """The last torque sent, and the next one within the limits.

    ``tau = tau_last + clip(clip(tau_ref, +-tau_max) - tau_last, +-tau_rate T)``; without a reference the torque returns
    to zero at the same rate.
    """

    def __init__(
        self, robot: Robot, limits: Limits, capabilities: frozenset[str], admittance: Admittance | None = None
    ) -> None:
        self._robot, self._limits, self._capabilities = robot, limits, capabilities
        self._linkage = Linkage.of(robot)
        self.admittance = admittance
        self.reset()

    def reset(self) -> None:
        """Forget what was sent: the arm does not follow references."""
        self.memory: np.ndarray | None = None

    def wanted(
        self, q_ref: np.ndarray | None, qd_ref: np.ndarray | None, tau: np.ndarray, q: np.ndarray, qd: np.ndarray
    ) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray | None]:
        """Return the references (n,) for a command with a torque; an admittance makes a velocity of it."""
        if not np.isfinite(tau).all():
            raise CommandRefused(f"Expected finite numbers in Command.tau, got {tau}. NaN never goes to a robot.")
        if self.admittance is None:
            self._check()
            return q_ref, qd_ref, tau
        if q_ref is not None or qd_ref is not None:
            raise CommandRefused(
                "Expected tau alone in the Command, of which the admittance makes qd, got q or qd too."
            )
        return None, self.admittance.velocity(tau, q, qd), None

    def _check(self) -> None:
        if "torque" not in self._capabilities:
            able = ", ".join(sorted(self._capabilities)) or "nothing"
            raise CommandRefused(
                f"Expected no torque in the Command, but tau is set and this link can carry {able} only. Command q or "
                'qd, connect with a codec that carries torques (extension=True), or run with torque="admittance" and a '
                "damping per joint."
            )
        if self._limits.tau_max is None:
            raise CommandRefused(
                f"Expected no torque in the Command, since {self._robot.name} has no torque limits. "
                "Run with limits=Limits.of(robot, tau_max=...)."
            )

    def outside(self, q: np.ndarray, qd: np.ndarray) -> str:
        """Return the sentence why a torque alone is not sent: the arm is beyond its limits; "" when it is not."""
        limits = self._limits
        if self._linkage is not None:  # limits are those of axes
            q, qd = self._linkage.axes(q), self._linkage.axes(qd)
        far = (q < limits.q_min) | (q > limits.q_max)
        fast = np.abs(qd) > limits.qd_max
        if not (far | fast).any():
            return ""
        i = int(np.argmax(far | fast))
        what = f"at {q[i]:.4f}" if far[i] else f"moving at {qd[i]:.4f}"
        within = f"from {limits.q_min[i]:.4f} to {limits.q_max[i]:.4f}" if far[i] else f"up to {limits.qd_max[i]:.4f}"
        return (
            f"Expected a torque alone while the arm is within its limits, but joint {i + 1} "
            f"({self._robot.joint_names[i]}) is {what}, allowed is {within}. The arm holds its position."
        )

    def limited(self, reply: Reply, tau: np.ndarray | None, dt: float, longest: float = np.inf) -> Reply:
        """Return the reply with the torque that may be sent for `tau` (n,), which changes for `longest` at most [s]."""
        tau_max, tau_rate = self._limits.tau_max, self._limits.tau_rate
        if (tau is None and self.memory is None) or tau_max is None or tau_rate is None:
            return reply
        last = np.zeros(self._robot.n) if self.memory is None else self.memory
        wanted = np.zeros(self._robot.n) if tau is None else tau
        clipped, step = np.clip(wanted, -tau_max, tau_max), tau_rate * min(dt, longest)
        sent = last + np.clip(clipped - last, -step, step)
        sent.flags.writeable = False
        bits = _CLIPPED * (np.abs(wanted) > tau_max + _SLACK) + _SLOWED * (np.abs(clipped - last) > step + _SLACK)
        clamped = reply.clamped | bits.astype(np.uint8)
        clamped.flags.writeable = False
        self.memory = sent if tau is not None or sent.any() else None
        return reply._replace(tau=sent, clamped=clamped)


def admittances(
    torque: str, damping: np.ndarray | None, model: TorqueModel | Sequence[TorqueModel] | None, robots: Sequence[Robot]
) -> list[Admittance | None]:
    """Return the admittance of each arm, None where torques are sent or refused."""
    if torque not in ("refuse", "admittance"):
        raise ConfigError(f"Expected torque to be one of refuse, admittance, got {torque!r}.")
    if torque == "refuse":
        if damping is not None or model is not None:
            raise ConfigError('Expected damping and torque_model together with torque="admittance" only.')
        return [None] * len(robots)
    sizes = [robot.n for robot in robots]
    if damping is None or np.shape(damping) != (sum(sizes),):
        raise ConfigError(f"Expected a damping for each of {sum(sizes)} joints, in N m s/rad, got {damping}.")
    parts = np.split(np.asarray(damping, dtype=np.float64), np.cumsum(sizes)[:-1])
    models = list(model) if isinstance(model, Sequence) else [model] * len(robots)
    if len(models) != len(robots) or (len(robots) > 1 and callable(model)):
        raise ConfigError(f"Expected one torque_model per arm, {len(robots)} in all, got {len(models)}.")
    return [Admittance(part, one) for part, one in zip(parts, models, strict=True)]
