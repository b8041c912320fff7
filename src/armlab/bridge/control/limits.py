"""`Limits` of a run, the `Limiter` that applies them, and errors for refused commands."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from armlab import kernels
from armlab._display import Shown
from armlab.errors import CommandRefused, ConfigError
from armlab.robots import Robot
from armlab.state import Command
from armlab.wire.egm import Beside
from armlab.wire.egm.axes import Linkage

ENTRY = 0.05
"""Default maximum distance between the first commanded position and the held position [rad or m]."""

_TORQUE_RISE = 0.1  # s from zero to the torque limit
_SPEED_RISE = 0.1  # s from rest to full speed, for axes with an unknown acceleration limit


@dataclass(frozen=True, eq=False, repr=False)
class Limits(Shown):
    """Per-joint limits on the references sent.

    Attributes
    ----------
    q_min : array, shape (n,), rad or m
        Lower position limits.
    q_max : array, shape (n,), rad or m
        Upper position limits.
    qd_max : array, shape (n,), rad/s or m/s
        Speed limits.
    qdd_max : array, shape (n,), rad/s^2 or m/s^2
        Acceleration limits.
    jump : array, shape (n,), rad or m
        Maximum step from the last position sent, in excess of ``qd_max dt``.
    entry : array, shape (n,), rad or m
        Maximum distance between the first commanded position and the held position; at most `jump`.
    tau_max : array, shape (n,), N m or N
        Torque limits; if None, torque commands are refused.
    tau_rate : array, shape (n,), N m/s or N/s
        Torque rate limits; if None, torque commands are refused.
    external : Limits
        Limits of the external axes (see `Limits.of_axes`); if None, commands to these axes are refused.
    following_error : array, shape (n,), rad or m
        Maximum distance between feedback and reference, in excess of 0.05 s times the reference speed; default: `jump`.
    lag : float, s
        Time constant of the arm's response to its reference: 1/k for a gain k of EGM's position loop (0.2 s for the
        default of 5 1/s). To compensate, the reference starts braking earlier, by a distance of lag times speed.

    Raises
    ------
    ConfigError
        Different shapes, NaN, q_min not below q_max, any other limit not above 0, entry above jump, a negative lag, or
        only one of the two torque limits.
    """

    q_min: np.ndarray
    q_max: np.ndarray
    qd_max: np.ndarray
    qdd_max: np.ndarray
    jump: np.ndarray
    entry: np.ndarray
    tau_max: np.ndarray | None = None
    tau_rate: np.ndarray | None = None
    external: Limits | None = None
    following_error: np.ndarray | None = None
    lag: float = 0.2

    def __post_init__(self) -> None:
        if self.following_error is None:
            object.__setattr__(self, "following_error", self.jump)
        if not (isinstance(self.lag, int | float) and 0.0 <= self.lag < np.inf):
            raise ConfigError(f"Expected Limits with a lag of at least 0 s, got {self.lag!r}.")
        shape = np.shape(self.q_min)
        if (self.tau_max is None) != (self.tau_rate is None):
            raise ConfigError(f"Expected tau_max and tau_rate together, got {self.tau_max} and {self.tau_rate}.")
        torque = () if self.tau_max is None else ("tau_max", "tau_rate")
        for name in ("q_min", "q_max", "qd_max", "qdd_max", "jump", "entry", "following_error", *torque):
            if len(shape) != 1 or np.shape(getattr(self, name)) != shape:
                got = f"{name} of shape {np.shape(getattr(self, name))} and q_min of {shape}"
                raise ConfigError(f"Expected all Limits to have the same shape (n,), got {got}.")
        if not np.all(self.q_min < self.q_max):  # also rejects NaN, which would disable a limit
            raise ConfigError(f"Expected Limits with q_min below q_max, got {self.q_min} and {self.q_max}.")
        for name in ("qd_max", "qdd_max", "jump", "entry", "following_error", *torque):
            if not np.all(getattr(self, name) > 0.0):
                raise ConfigError(f"Expected Limits with {name} above 0 for each joint, got {getattr(self, name)}.")
        if not np.all(self.entry <= self.jump):
            raise ConfigError(
                "Expected Limits.entry to be at most Limits.jump for "
                f"each joint, got {self.entry} and {self.jump}. A first position further away would "
                "be rejected as a jump: reduce Limits.entry, and approach the position gradually."
            )

    @classmethod
    def of(
        cls,
        robot: Robot,
        *,
        margin: float = 0.01,
        speed: float = 1.0,
        entry: float = ENTRY,
        tau_max: float | np.ndarray | None = None,
        external: Limits | None = None,
        following_error: float | np.ndarray | None = None,
        lag: float = 0.2,
    ) -> Limits:
        """Return limits derived from a robot description.

        Parameters
        ----------
        robot : Robot
            The robot.
        margin : float, rad or m
            Distance between the position limits and the joint limits of the robot.
        speed : float
            Fraction of the robot's speed and acceleration limits, in (0, 1].
        entry : float, rad or m
            See `Limits`; reduced to 0.02 m for prismatic joints.
        tau_max : float or array, shape (n,), N m or N
            Torque limits, reached after 0.1 s at the earliest; default: the torque limits of the robot, if known.
        external : Limits
            Limits of the external axes; see `of_axes`.
        following_error : float or array, shape (n,), rad or m
            See `Limits`; default: 0.1 rad, or 0.02 m for prismatic joints.
        lag : float, s
            See `Limits`.

        Raises
        ------
        ConfigError
            A speed outside (0, 1], an entry above 0.1 rad, or a margin that is negative or leaves no joint range.
        """
        if not 0.0 < speed <= 1.0 or not entry > 0.0 or not margin >= 0.0:
            raise ConfigError(
                f"Expected speed in (0, 1], entry above 0 and margin of at least 0, got {speed}, {entry} and {margin}."
            )
        q_min, q_max = robot.q_min + margin, robot.q_max - margin
        if not np.all(q_min < q_max):
            raise ConfigError(f"Expected a margin that leaves room between the joint limits, got {margin}.")
        jump = np.where(robot.prismatic, 0.02, 0.1)
        most = np.broadcast_to(robot.tau_max if tau_max is None else tau_max, (robot.n,)).astype(np.float64)
        torque = (most, most / _TORQUE_RISE) if np.isfinite(most).all() else (None, None)
        speeds = speed * robot.qd_max, speed * robot.qdd_max
        near = np.where(robot.prismatic, np.minimum(entry, jump), entry)
        apart = jump if following_error is None else np.broadcast_to(following_error, (robot.n,)).astype(np.float64)
        return cls(q_min, q_max, *speeds, jump, near, *torque, external, apart, lag)

    @classmethod
    def of_axes(
        cls,
        q_min: Sequence[float] | np.ndarray,
        q_max: Sequence[float] | np.ndarray,
        qd_max: Sequence[float] | np.ndarray,
    ) -> Limits:
        """Return limits of external axes: full speed after 0.1 s, jumps up to 0.1 rad or m, entry within 0.05 rad or m.

        Parameters
        ----------
        q_min : array, shape (k,), rad or m
            Lower position limits.
        q_max : array, shape (k,), rad or m
            Upper position limits.
        qd_max : array, shape (k,), rad/s or m/s
            Speed limits.

        Raises
        ------
        ConfigError
            See `Limits`.
        """
        low, high, fastest = (np.asarray(values, dtype=np.float64) for values in (q_min, q_max, qd_max))
        return cls(low, high, fastest, fastest / _SPEED_RISE, np.full(low.shape, 0.1), np.full(low.shape, ENTRY))


class Reply(NamedTuple):
    """Limited reference."""

    q: np.ndarray
    qd: np.ndarray
    clamped: np.ndarray
    ratio: float = 1.0
    refused: int = 0
    tau: np.ndarray | None = None
    free: bool = False
    beside: Beside | None = None


Memory = tuple[np.ndarray, np.ndarray | None]
"""Last position, velocity and acceleration sent (3, n), and the last commanded position."""


class Limiter:
    """Tracks the last reference sent and limits the next reference with `kernels.limit_reference`."""

    def __init__(self, limits: Limits, reach: tuple[Any, Any] = (-np.inf, np.inf)) -> None:
        self._reach = reach
        self._bounds = np.stack((limits.q_min, limits.q_max, limits.qd_max, limits.qdd_max, limits.jump))
        self._lag = limits.lag
        self._none = np.zeros(len(limits.q_min), dtype=np.uint8)
        self._none.flags.writeable = False
        self.memory: Memory = np.zeros((3, len(limits.q_min))), None

    @property
    def q(self) -> np.ndarray:
        return self.sent(self.memory)

    def sent(self, memory: Memory) -> np.ndarray:
        """Return the last position sent (n,) in the state `memory`."""
        return memory[0][0]

    @property
    def at_rest(self) -> bool:
        return not self.memory[0][1:].any()

    def rest(self, q: np.ndarray) -> Reply:
        """Set the reference to `q` (n,) at zero speed, for an arm that does not follow references."""
        q = np.minimum(np.maximum(q, self._reach[0]), self._reach[1])
        sent = np.stack((q, np.zeros_like(q), np.zeros_like(q)))
        sent.flags.writeable = False
        self.memory = sent, None
        return Reply(sent[0], sent[1], self._none)

    def follow(self, q: np.ndarray, qd: np.ndarray) -> Reply:
        """Track a freely moving arm: the next reference starts from the position `q` and velocity `qd` (n,)."""
        sent = np.stack((q, qd, qd))
        sent.flags.writeable = False
        self.memory = sent, None
        return Reply(sent[0], sent[2], self._none, free=True)

    def hold(self, dt: float, longest: float = np.inf) -> Reply:
        """Come to rest within the acceleration limits, then hold the position; see `step`."""
        return self.step(None, None, dt, longest)

    def step(self, q: np.ndarray | None, qd: np.ndarray | None, dt: float, longest: float = np.inf) -> Reply:
        """Return the limited reference for a position `q` (n,), a velocity `qd` (n,), both, or neither (hold)."""
        bounds = self._bounds
        if dt > longest:
            bounds = bounds.copy()
            bounds[2] *= longest / dt
        before, asked = self.memory
        sent, clamped, ratio, refused = kernels.limit_reference(before, bounds, dt, q, asked, qd, self._lag)
        self.memory = sent, None if q is None or refused else q.copy()
        return Reply(sent[0], sent[2], clamped, ratio, refused)


class LinkedLimiter(Limiter):
    """`Limiter` in axis space, for coupled axes: limits apply to axes, but the controller commands joints."""

    def __init__(self, limits: Limits, linkage: Linkage, reach: tuple[Any, Any] = (-np.inf, np.inf)) -> None:
        super().__init__(limits, reach)
        self._linkage = linkage

    def sent(self, memory: Memory) -> np.ndarray:
        return self._linkage.joints(memory[0][0])

    def rest(self, q: np.ndarray) -> Reply:
        return self._linkage.from_axes(super().rest(self._linkage.axes(q)))

    def follow(self, q: np.ndarray, qd: np.ndarray) -> Reply:
        return self._linkage.from_axes(super().follow(self._linkage.axes(q), self._linkage.axes(qd)))

    def step(self, q: np.ndarray | None, qd: np.ndarray | None, dt: float, longest: float = np.inf) -> Reply:
        wanted, speed = (None if values is None else self._linkage.axes(values) for values in (q, qd))
        return self._linkage.from_axes(super().step(wanted, speed, dt, longest))


def limiter_of(limits: Limits, robot: Robot) -> Limiter:
    """Return the limiter of a robot, in axis space if axes are coupled."""
    linkage, reach = Linkage.of(robot), (robot.q_min, robot.q_max)
    return Limiter(limits, reach) if linkage is None else LinkedLimiter(limits, linkage, reach)


def axes_of(robot: Robot) -> Callable[[np.ndarray], np.ndarray]:
    """Return the function that maps joint positions (n,) to axis positions, to which the limits apply."""
    linkage = Linkage.of(robot)
    return (lambda joints: joints) if linkage is None else linkage.axes


JointName = Callable[[int], str]
"""Function that maps a joint index (from 0) to the joint name."""

_DOUBLE = np.dtype(np.float64)
_REAL = "f", "i", "u"  # dtype kinds; other kinds would be converted to numbers silently
_NUMBERS = "q", "qd", "tau", "q_ext", "rapid_data"


def requested(command: Command, robot: Robot) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray | None]:
    """Return the position, velocity and torque (n,) of a command (None if unset); raise an error if one is invalid."""
    if not isinstance(command, Command):
        raise CommandRefused(
            f"Expected the controller to return a Command or None, got {type(command).__name__}. "
            "Write Command(q) for positions, Command(qd=...) for velocities."
        )
    q, qd, tau, shape = command.q, command.qd, command.tau, robot.q_max.shape
    if type(q) is np.ndarray and q.dtype == _DOUBLE and q.shape == shape and qd is tau is None:
        return np.ascontiguousarray(q), None, None  # fast path for the common case
    return (
        None if q is None else _vector("q", q, robot),
        None if qd is None else _vector("qd", qd, robot),
        None if tau is None else _vector("tau", tau, robot),
    )


def _vector(name: str, values: Any, robot: Robot) -> np.ndarray:
    try:
        array = numbers(values)
    except Exception as error:  # a controller may return anything
        raise CommandRefused(
            f"Expected {robot.n} numbers in Command.{name} for {robot.name}, got {values!r} ({error})."
        ) from error
    if array.shape != (robot.n,):
        raise CommandRefused(
            f"Expected Command.{name} of shape ({robot.n},) for {robot.name}, got {array.shape}. "
            f"Pass one value per joint: {', '.join(robot.joint_names)}."
        )
    return np.ascontiguousarray(array, dtype=np.float64)


def numbers(values: Any) -> np.ndarray:
    array = np.asarray(values)
    if array.dtype.kind not in _REAL:
        raise TypeError(f"of type {array.dtype}")
    return array


def kept(command: Command | None) -> Command | None:
    """Return a command with copied arrays, because the controller may reuse its arrays."""
    if not isinstance(command, Command):
        return command
    return replace(command, **{name: _copied(getattr(command, name)) for name in _NUMBERS})


def _copied(values: Any) -> Any:
    try:
        return None if values is None else np.array(values)
    except Exception:  # a controller may return anything
        return values


def refusal(refused: int, q: np.ndarray | None, qd: np.ndarray | None, sent: np.ndarray, robot: Robot) -> str:
    """Return the error message for a reference that the limiter refused."""
    i = abs(refused) - 1
    joint, axes = joint_name(robot, i), axes_of(robot)
    if refused > 0 or q is None:  # only a position can jump
        got = ", ".join(f"{name} = {values[i]}" for name, values in (("q", q), ("qd", qd)) if values is not None)
        return f"Expected finite numbers in the Command, got {got} for {joint}. NaN is never sent to a robot."
    return _jumped(axes(q), axes(sent), i, robot, joint)


def jump_refusal(q: np.ndarray, sent: np.ndarray, jump: np.ndarray, robot: Robot, name: JointName) -> str:
    """Return an error message if `q` (n,) is further than `jump` (n,) from the last position sent, otherwise ""."""
    axes = axes_of(robot)
    q, sent = axes(q), axes(sent)
    excess = np.abs(q - sent) - jump
    i = int(np.argmax(excess))
    return "" if excess[i] <= 0.0 else _jumped(q, sent, i, robot, name(i))  # NaN is refused


def _jumped(q: np.ndarray, sent: np.ndarray, i: int, robot: Robot, joint: str) -> str:
    return (
        f"Expected a position near the last position sent, {sent[i]:.4f}, for {joint} of {robot.name}, got {q[i]:.4f}: "
        f"a jump of {abs(q[i] - sent[i]):.4f}. Move there gradually. {causes(robot)}"
    )


def entry_refusal(
    q: np.ndarray,
    held: np.ndarray,
    entry: np.ndarray,
    robot: Robot,
    name: JointName | None = None,
    where: str = "holds",
) -> str:
    """Return an error message if the first position is too far from the held (or actual) position, otherwise ""."""
    axes = axes_of(robot)
    q, held = axes(q), axes(held)
    distance = np.abs(q - held)
    far = ~(distance <= entry) & ~np.isnan(q)  # a NaN command is refused elsewhere; a NaN position counts as far
    if not far.any():
        return ""
    i = int(np.argmax(np.where(far, distance / entry, 0.0)))
    joint = joint_name(robot, i) if name is None else name(i)
    return (
        f"Expected the first position within {entry[i]:g} of where the arm {where}, got {q[i]:.4f} for {joint} of "
        f"{robot.name}, which {where} at {held[i]:.4f}. Begin there. {causes(robot)}"
    )


def joint_name(robot: Robot, i: int, first: int | None = None, by_axis: bool = False) -> str:
    """Return the name of joint i (from 0) and its index in the client's message."""
    if first is not None:
        return f"{robot.ros_joint_names[i]} (number {first + i + 1} of the message)"
    if by_axis:
        return f"{robot.joint_names[i]} (number {robot.abb_axes[i]} of the vector)"
    return f"joint {i + 1} ({robot.joint_names[i]})"


def causes(robot: Robot) -> str:
    """Return the usual causes of a jump and, for coupled axes, a note that the numbers are axis positions."""
    usual = "Usual causes are degrees instead of radians, or a different joint order."
    are_joints = Linkage.of(robot) is None
    return usual if are_joints else f"{usual} The numbers are positions of ABB's axes, which may combine joints."
