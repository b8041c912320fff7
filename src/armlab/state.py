"""Input and output of a controller: `State` and `Command`.

A controller is any callable ``State -> Command``. docs/egm.md explains the fields, whose names are those of
`glossary.toml`. Values missing from the packet are NaN, None or empty, never zero.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from armlab._display import Shown

__all__ = ["Command", "State"]

_EMPTY = np.zeros(0)
_EMPTY.flags.writeable = False
_NO_SOURCES: Mapping[str, Any] = MappingProxyType({})


def _nan(*shape: int) -> np.ndarray:
    """Return a read-only array of NaN, for missing values."""
    array = np.full(shape, np.nan)
    array.flags.writeable = False
    return array


def _nothing() -> None:
    """Return None, the default of `State.details`."""


def _known(details: Any) -> Any:
    """Return the decoded details of a copied State."""
    return details


def _kept(kind: type[Any], values: dict[str, Any]) -> Any:
    """Rebuild a copied State with read-only arrays."""
    for value in values.values():
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
    return kind(**values)


_NAN6 = _nan(6)
_NAN44 = _nan(4, 4)


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class State(Shown):
    """Measured state of one arm at one instant, in SI units and kinematic joint order.

    Attributes
    ----------
    t : float, s
        Robot time since guidance began in this session.
    dt : float, s
        Time since the previous state; the nominal period for the first state, and longer after lost packets.
    q : array, shape (n,), rad or m
        Joint positions.
    qd : array, shape (n,), rad/s or m/s
        Joint velocities.
    tau : array, shape (n,), N m or N
        Joint-side torques; NaN if missing.
    qdd : array, shape (n,), rad/s^2 or m/s^2
        Joint accelerations; None if missing.
    seq : int
        The robot's sequence number.
    missed : int
        Number of packets lost before this packet.
    session : int
        Session number, counted from 1.
    qd_source : str
        "measured" or "difference".
    tau_source : str
        "measured", "reference" or "none".
    q_start : array, shape (n,), rad or m
        Position when guidance began.
    q_planned : array, shape (n,), rad or m
        Reference of the robot controller.
    q_sent : array, shape (n,), rad or m
        Position in the previous reply.
    qd_sent : array, shape (n,), rad/s or m/s
        Velocity in the previous reply.
    clamped : array, shape (n,)
        Active limits in the previous reply (bits: 1 position, 2 velocity, 4 acceleration, 8 braking, 16 torque, 32
        torque rate).
    T_frame_tool : array, shape (4, 4), m
        Tool pose reported by the robot controller, in the frame activated by RAPID.
    wrench_raw : array, shape (6,), N and N m
        EGM field measuredForce as received; ABB documents neither its frame nor its sign.
    wrench : array, shape (6,), N and N m
        Calibrated wrench in base axes at the tool point.
    q_ext : array, shape (k,), rad or m
        Positions of external axes.
    motors : int
        Motor state in ABB's enumeration.
    rapid : int
        RAPID state in ABB's enumeration.
    mci : int
        EGM state in ABB's enumeration.
    converged : bool
        Whether the convergence condition of EGMAct is met.
    utilization : float, %
        Utilisation of the robot's motion limits.
    robotware : str
        "6.06", "6.07", "6.10" or "7".
    rapid_data : array, shape (k,)
        Numbers sent by RAPID.
    rapid_digital : bool
        Digital value sent by RAPID.
    robot_ns : int, ns
        Clock of the robot controller.
    t_receive : int, ns
        Arrival time (wall clock).
    sources : mapping
        `bridge.Held` of each source by name: ``state.sources["tracker"]["p"]``.
    robot : str
        Name of the arm.
    age : float, s
        Time from arrival to this tick; 0 for the pacing arm.
    details : callable
        Decodes and returns further fields of the packet (`wire.egm.Details`: planned pose, collision, currents, ...),
        or None if the link or log has none.
    arms : tuple of State
        State of each arm of a link with several arms, whose joint arrays are then concatenated in `q`, `qd`, ...
    """

    t: float
    dt: float
    q: np.ndarray
    qd: np.ndarray
    tau: np.ndarray
    qdd: np.ndarray | None = None
    seq: int = 0
    missed: int = 0
    session: int = 1
    qd_source: str = "difference"
    tau_source: str = "none"
    q_start: np.ndarray = field(default_factory=lambda: _EMPTY)
    q_planned: np.ndarray = field(default_factory=lambda: _EMPTY)
    q_sent: np.ndarray = field(default_factory=lambda: _EMPTY)
    qd_sent: np.ndarray = field(default_factory=lambda: _EMPTY)
    clamped: np.ndarray = field(default_factory=lambda: _EMPTY)
    T_frame_tool: np.ndarray = field(default_factory=lambda: _NAN44)
    wrench_raw: np.ndarray = field(default_factory=lambda: _NAN6)
    wrench: np.ndarray = field(default_factory=lambda: _NAN6)
    q_ext: np.ndarray = field(default_factory=lambda: _EMPTY)
    motors: int = 0
    rapid: int = 0
    mci: int = 0
    converged: bool = False
    utilization: float = float("nan")
    robotware: str = ""
    rapid_data: np.ndarray = field(default_factory=lambda: _EMPTY)
    rapid_digital: bool = False
    robot_ns: int = 0
    t_receive: int = 0
    sources: Mapping[str, Any] = field(default_factory=lambda: _NO_SOURCES)
    robot: str = ""
    age: float = 0.0
    details: Callable[[], Any] = _nothing
    arms: tuple[State, ...] = ()

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle and copy the State with decoded `details` and a plain dict of sources."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        values["sources"] = dict(self.sources)
        if self.details is not _nothing:
            values["details"] = partial(_known, self.details())
        return _kept, (State, values)

    @property
    def pos0(self) -> np.ndarray:
        """Position when guidance began (Robotlab.jl's name for `q_start`)."""
        return self.q_start


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Command(Shown):
    """Next references of an arm.

    ``Command(q)`` commands a position, ``Command(qd=...)`` a velocity that the bridge integrates, and ``Command(q,
    qd)`` both. ``Command()`` holds, and ``Command.stop()`` ends the run normally.

    Attributes
    ----------
    q : array, shape (n,), rad or m
        Joint positions (a list is also accepted); None if not commanded.
    qd : array, shape (n,), rad/s or m/s
        Joint velocities; None if not commanded.
    tau : array, shape (n,), N m or N
        Joint torques; None if not commanded.
    record : mapping
        Values to write to the log, by column name.
    ends : bool
        Whether the command ends the run.
    q_ext : array, shape (k,), rad or m
        Positions of the external axes, in the order of `State.q_ext`; requires `bridge.Limits`; None if not
        commanded.
    rapid_data : sequence of float
        Up to 40 numbers for RAPID (RobotWare 7), sent once; None sends nothing.
    rapid_digital : bool
        Digital value for RAPID (RobotWare 7), sent once; None sends nothing.
    """

    q: np.ndarray | None = None
    qd: np.ndarray | None = None
    tau: np.ndarray | None = None
    record: Mapping[str, Any] = field(default_factory=dict)
    ends: bool = False
    q_ext: np.ndarray | None = None
    rapid_data: Sequence[float] | np.ndarray | None = None
    rapid_digital: bool | None = None

    if TYPE_CHECKING:  # types accepted by the constructor; the fields are arrays

        def __init__(
            self,
            q: ArrayLike | None = None,
            qd: ArrayLike | None = None,
            tau: ArrayLike | None = None,
            record: Mapping[str, Any] = ...,
            ends: bool = False,
            q_ext: ArrayLike | None = None,
            rapid_data: ArrayLike | None = None,
            rapid_digital: bool | None = None,
        ) -> None: ...

    @classmethod
    def stop(cls) -> Command:
        """Return the command that brings the arm to rest and ends the run."""
        return cls(ends=True)
