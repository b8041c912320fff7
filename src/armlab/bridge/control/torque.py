"""Torque references: checks, limits, and an admittance for links without torque commands.

A torque commanded together with a position or velocity is a feed-forward torque. A torque alone replaces the position
loop; the drive then adds only gravity compensation. The reply also contains the measured position, from which a hold
starts.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from armlab.bridge.control.limits import Limits, Reply
from armlab.errors import CommandRefused, ConfigError
from armlab.estimation.fit import Fit, value_of
from armlab.models import TorqueModel
from armlab.robots import Robot
from armlab.wire.egm.axes import Linkage

TorqueFunction = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Function that returns the torques (n,) of free motion from positions and velocities (n,)."""
FreeTorque = TorqueFunction | TorqueModel | Fit[TorqueModel]

_CLIPPED, _SLOWED = 16, 32
_SLACK = 1e-9  # N m: tolerance, so rounding does not count as a clamp


@dataclass(frozen=True, eq=False)
class Admittance:
    """Converts torques to velocities: ``qd_ref = (tau_ref - tau_model(q, qd)) / D``."""

    damping: np.ndarray
    model: TorqueFunction | None = None

    def __post_init__(self) -> None:
        damping = np.asarray(self.damping, dtype=np.float64)
        if damping.ndim != 1 or not np.all((damping > 0.0) & np.isfinite(damping)):
            raise ConfigError(f"Expected a positive damping [N m s/rad] for each joint, got {self.damping}.")
        object.__setattr__(self, "damping", damping)

    def velocity(self, tau: np.ndarray, q: np.ndarray, qd: np.ndarray) -> np.ndarray:
        return (tau if self.model is None else tau - self.model(q, qd)) / self.damping


class Torques:
    """Tracks the last torque sent and limits the next torque.

    ``tau = tau_last + clip(clip(tau_ref, +-tau_max) - tau_last, +-tau_rate T)``; without a reference, the torque
    returns to zero at the same rate.
    """

    def __init__(
        self, robot: Robot, limits: Limits, capabilities: frozenset[str], admittance: Admittance | None = None
    ) -> None:
        self._robot, self._limits, self._capabilities = robot, limits, capabilities
        self._linkage = Linkage.of(robot)
        self.admittance = admittance
        self.reset()

    def reset(self) -> None:
        """Reset the torque; called when the arm does not follow references."""
        self.memory: np.ndarray | None = None

    def requested(
        self,
        q_ref: np.ndarray | None,
        qd_ref: np.ndarray | None,
        tau: np.ndarray,
        q: np.ndarray,
        qd: np.ndarray,
        measured: bool = True,
    ) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray | None]:
        """Return the references (n,) of a command with a torque; an admittance converts the torque to a velocity.

        `measured` states whether the robot reports torques; a robot without reported torques accepts no torque
        commands.
        """
        if not np.isfinite(tau).all():
            raise CommandRefused(f"Expected finite numbers in Command.tau, got {tau}. NaN is never sent to a robot.")
        if self.admittance is None:
            self._check()
            if not measured and "measured_torque" in self._capabilities:
                raise CommandRefused(
                    f"Expected a Command without torque, because {self._robot.name} reports no torques and has no "
                    "torque-controlled drives. A simulated arm needs masses in its description (<inertial> in a URDF, "
                    'inertias in a TOML file). Otherwise, command q or qd, or run with torque="admittance".'
                )
            return q_ref, qd_ref, tau
        if q_ref is not None or qd_ref is not None:
            raise CommandRefused(
                "Expected only tau in the Command, because the admittance converts tau to qd, but q or qd is set too."
            )
        return None, self.admittance.velocity(tau, q, qd), None

    def _check(self) -> None:
        if "torque" not in self._capabilities:
            able = ", ".join(sorted(self._capabilities)) or "none"
            raise CommandRefused(
                f"Expected a Command without torque, but tau is set (references supported by this link: {able}). "
                "Command q or qd, connect with a codec for torques (extension=True), or run with "
                'torque="admittance" and a damping per joint.'
            )
        if self._limits.tau_max is None:
            raise CommandRefused(
                f"Expected a Command without torque, because {self._robot.name} has no torque limits. "
                "Run with limits=Limits.of(robot, tau_max=...)."
            )

    def outside(self, q: np.ndarray, qd: np.ndarray) -> str:
        """Return an error message if an arm is outside the limits for a torque-only command, otherwise ""."""
        limits = self._limits
        if self._linkage is not None:  # the limits apply to axes
            q, qd = self._linkage.axes(q), self._linkage.axes(qd)
        far = (q < limits.q_min) | (q > limits.q_max)
        fast = np.abs(qd) > limits.qd_max
        if not (far | fast).any():
            return ""
        i = int(np.argmax(far | fast))
        what = f"at {q[i]:.4f}" if far[i] else f"moving at {qd[i]:.4f}"
        within = f"from {limits.q_min[i]:.4f} to {limits.q_max[i]:.4f}" if far[i] else f"up to {limits.qd_max[i]:.4f}"
        return (
            f"Expected the arm to be within its limits for a torque-only command, but joint {i + 1} "
            f"({self._robot.joint_names[i]}) is {what}; the allowed range is {within}. The arm holds its position."
        )

    def limited(self, reply: Reply, tau: np.ndarray | None, dt: float, longest: float = np.inf) -> Reply:
        """Return the reply with the limited torque `tau` (n,); the rate limit uses a step of at most `longest` [s]."""
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
    torque: str, damping: np.ndarray | None, model: FreeTorque | Sequence[FreeTorque] | None, robots: Sequence[Robot]
) -> list[Admittance | None]:
    """Return the admittance of each arm; all are None if torques are not converted."""
    if torque not in ("refuse", "admittance"):
        raise ConfigError(f'Expected torque to be "refuse" or "admittance", got {torque!r}.')
    if torque == "refuse":
        if damping is not None or model is not None:
            raise ConfigError('Expected damping and torque_model only with torque="admittance".')
        return [None] * len(robots)
    sizes = [robot.n for robot in robots]
    if damping is None or np.shape(damping) != (sum(sizes),):
        raise ConfigError(f"Expected a damping [N m s/rad] for each of {sum(sizes)} joints, got {damping}.")
    parts = np.split(np.asarray(damping, dtype=np.float64), np.cumsum(sizes)[:-1])
    models = list(model) if isinstance(model, Sequence) else [model] * len(robots)
    if len(models) != len(robots) or (len(robots) > 1 and model is not None and not isinstance(model, Sequence)):
        raise ConfigError(f"Expected {len(robots)} torque models, one per arm, got {len(models)}.")
    functions = [_function(one, robot) for one, robot in zip(models, robots)]
    return [Admittance(part, one) for part, one in zip(parts, functions, strict=True)]


def _function(model: FreeTorque | None, robot: Robot) -> TorqueFunction | None:
    """Return the torque function of an identified model or its fit; return a function unchanged."""
    known = value_of(model)
    if not isinstance(known, TorqueModel):
        return known
    known.check_robot(robot)
    return lambda q, qd: known.torque(q[None], qd[None])[0]
