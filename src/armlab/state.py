"""What a controller sees and what it returns: `State` and `Command`.

A controller is any callable ``State -> Command``. Fields follow docs/egm (names of `glossary.toml`).
Values that the robot did not send are NaN arrays, NaN, None or empty, never zeros.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import numpy as np

__all__ = ["Command", "State"]

_EMPTY = np.zeros(0)
_EMPTY.flags.writeable = False
_NO_SOURCES: Mapping[str, Any] = MappingProxyType({})


def _nan(*shape: int) -> np.ndarray:
    """Return a read-only array of NaN: a value the robot did not send."""
    array = np.full(shape, np.nan)
    array.flags.writeable = False
    return array


def _nothing() -> None:
    """Return None: a source that says no more than the State."""


_NAN6 = _nan(6)
_NAN44 = _nan(4, 4)


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """One sample of one arm, SI units, kinematic joint order.

    Attributes
    ----------
    t : seconds of robot time since guidance began in this session.
    dt : seconds since the previous state (nominal period for the first; larger after lost packets).
    seq, missed, session : the robot's sequence number, packets lost before this one, session number from 1.
    q, qd, tau : (n,) joint positions [rad or m], velocities, joint-side torques [N m]; `tau` is NaN when not sent.
    qdd : (n,) joint accelerations when the source has them, else None.
    qd_source : "measured" or "difference".
    tau_source : "measured", "reference" or "none".
    q_start : (n,) position when guidance began.
    q_planned : (n,) the controller's own reference.
    q_sent, qd_sent, clamped : (n,) the previous reply and its clamps (bits: 1 position, 2 velocity, 4 acceleration, 8
        braking, 16 torque, 32 torque rate).
    T_frame_tool : (4, 4) pose reported by the controller, in the frame that RAPID activated.
    wrench_raw : (6,) measuredForce as sent [N, N m], frame and sign not documented by ABB.
    wrench : (6,) calibrated force sensor, base axes, at the tool point.
    q_ext : positions of external axes.
    motors, rapid, mci : state numbers as received (ABB's enumerations).
    converged : window of EGMAct is met.
    utilization : percent.
    robotware : "6.06", "6.07", "6.10" or "7".
    rapid_data, rapid_digital : values from RAPID.
    robot_ns : controller clock, int64 nanoseconds.
    t_receive : arrival, int64 nanoseconds.
    sources : what each source has at this tick by name (`bridge.Held`): ``state.sources["tracker"]["p"]``.
    robot : name of the arm.
    age : seconds from arrival to this tick, 0 for the arm that paces.
    details : called without arguments, returns what else the packet says (`wire.egm.Details`: planned pose, collision,
        currents, ...), read then; None for a link or a log that has nothing more.
    arms : the State of each arm when several are fused; `q` and the other joint arrays are then one arm after another.
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

    @property
    def pos0(self) -> np.ndarray:
        """Position when guidance began: the name that Robotlab.jl used for `q_start`."""
        return self.q_start


@dataclass(frozen=True, slots=True, eq=False)
class Command:
    """What the arm shall do next.

    ``Command(q)`` is a position; ``Command(qd=...)`` a velocity that the bridge integrates;
    ``Command(q, qd)`` both; ``Command()`` holds; ``Command.stop()`` ends the run normally.

    Attributes
    ----------
    q, qd, tau : (n,) references [rad, rad/s, N m] or None for "not commanded".
    q_ext : (k,) references of the external axes beyond the robot's joints [rad or m], in the order of `State.q_ext`, or
        None. Needs limits of these axes, see `bridge.Limits`.
    rapid_data : at most 40 numbers for RAPID, or None.
    rapid_digital : the digital value for RAPID, or None. The numbers go out with the one reply to this command
        (RobotWare 7).
    record : values of the controller's own, by column name, written to the log.
    ends : True for the command that ends the run.
    """

    q: np.ndarray | None = None
    qd: np.ndarray | None = None
    tau: np.ndarray | None = None
    record: Mapping[str, Any] = field(default_factory=dict)
    ends: bool = False
    q_ext: np.ndarray | None = None
    rapid_data: Sequence[float] | np.ndarray | None = None
    rapid_digital: bool | None = None

    @classmethod
    def stop(cls) -> Command:
        """Return the command that brings the arm to rest and ends the run."""
        return cls(ends=True)
