"""Signatures and documentation of the compiled kernels; `armlab.kernels` is their public face.

Checked by tests/kernels/test_extension.py against the extension. Methods take any leading batch where shapes begin with
``...``, leave inputs unchanged, write into `out` when that is given, and raise `ShapeError` for wrong arguments.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

_Pair = tuple[np.ndarray, np.ndarray]

class Chain:
    """A serial chain of revolute and prismatic joints, immutable.

    ``T_base_tool(q) = E_0 Z_1(q_1) E_1 ... Z_n(q_n) E_n`` with ``Z(q) = Rz(q)`` (revolute) or ``Tz(q)`` (prismatic):
    the local product of exponentials with every joint axis along z. Link frame i is
    ``T_base_i = E_0 Z_1(q_1) ... E_{i-1} Z_i(q_i)``.

    Every method takes any leading batch and keeps it, accepts read-only input, leaves it unchanged, and writes into
    `out` when that is given. NaN in a sample gives NaN in its result. Argument errors are `ShapeError`.

    Parameters
    ----------
    frames : (n + 1, 4, 4) E_0 ... E_n, rigid to 1e-6 (rotations are then projected on SO(3)) [m].
    prismatic : (n,) bool, True for prismatic joints; n from 1 to 32.
    """

    def __init__(self, frames: Any, prismatic: Any) -> None: ...
    @property
    def n(self) -> int:
        """Number of joints."""

    @property
    def frames(self) -> np.ndarray:
        """(n + 1, 4, 4) a copy of E_0 ... E_n."""

    @property
    def prismatic(self) -> np.ndarray:
        """(n,) bool, True for prismatic joints."""

    def forward(self, q: Any, out: Any = None, threads: int = 1) -> np.ndarray:
        """Return T_base_tool (..., 4, 4) for joint positions `q` (..., n)."""

    def link_transforms(self, q: Any, out: Any = None) -> np.ndarray:
        """Return T_base_i (..., n, 4, 4) of link frames 1 ... n."""

    def jacobian(self, q: Any, tool: bool = False, out: Any = None, threads: int = 1) -> np.ndarray:
        """Return J (..., 6, n), rows [v; w], at the tool point in base axes, or in tool axes when `tool`.

        Column i is ``[z_i x (p - p_i); z_i]`` (revolute) or ``[z_i; 0]`` (prismatic).
        """

    def forward_jacobian(self, q: Any, tool: bool = False, out: _Pair | None = None, threads: int = 1) -> _Pair:
        """Return `forward`, T_base_tool (..., 4, 4), and `jacobian`, J (..., 6, n); `out` is such a pair."""

    def jacobian_derivative(self, q: Any, qd: Any, tool: bool = False, out: Any = None) -> np.ndarray:
        """Return Jd (..., 6, n), the derivative of `jacobian` along the motion `q`, `qd` (..., n).

        Base axes: ``dv_i/dq_j = w_first x v_last`` with first = min(i, j), last = max(i, j), and ``dw_i/dq_j = w_j x
        w_i`` where j < i, else 0. Tool axes: ``d/dt (R^T u) = R^T (ud - w x u)``, w the angular velocity of the tool.
        """

    def rnea(self, q: Any, qd: Any, qdd: Any, gravity: Any, pi: Any, out: Any = None) -> np.ndarray:
        """Return joint torques tau (..., n) of a motion, by recursive Newton-Euler.

        ``F_i = I_i A_i + V_i x* (I_i V_i)`` with ``A_0 = [-g; 0]``; ``tau_i = S_i . sum of F_k, k >= i``.

        Parameters
        ----------
        q, qd, qdd : (..., n) joint positions, velocities, accelerations.
        gravity : (3,) gravity in base axes [m/s^2].
        pi : (n, 10) per link, in link frame i about its origin: m, m cx, m cy, m cz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz.
        out : (..., n) array to write into, or None.
        """

    def rigid_regressor(self, q: Any, qd: Any, qdd: Any, gravity: Any, out: Any = None) -> np.ndarray:
        """Return Y (..., n, 10 n) with ``tau = Y pi.ravel()``, parameters as in `rnea`."""

class Datagrams:
    """Receives and sends on a bound UDP socket of IPv4, never waits and never raises for the socket.

    Parameters
    ----------
    socket : does not block; `close` closes it. With SO_TIMESTAMPNS the kernel's stamps are used.
    kind : named tuple that is made of each datagram: its bytes, (host, port) of the sender, and its arrival on the
        monotonic clock [ns].

    Attributes
    ----------
    errors : socket errors so far.
    """

    def __init__(self, socket: Any, kind: Any) -> None: ...
    def receive(self) -> Any | None:
        """Return the next datagram, None when there is none or the socket reports an error."""

    def send(self, data: bytes, to: tuple[str, int]) -> bool:
        """Send one datagram. Return whether the system took it.

        Parameters
        ----------
        data : its bytes. to : numeric address and port.
        """

    def close(self) -> None:
        """Close the socket."""

    errors: int

class Drive:
    """Drives of n joints.

    Parameters
    ----------
    friction : (11, n) rows viscous, coulomb_pos, coulomb_neg, offset, stribeck, stribeck_speed, delta, resolution,
        root, smooth_speed, load.
    ripple : (3, n) rows cycles, cosine, sine.
    lines : joints (L,) in order, cycles (L,), speeds and widths (n, S), coefficients (L, 1 or 2 directions, S, 2); or
        None.
    map : positions and widths (n, P), speeds and widths (n, S), coefficients (n, 2, P, S); or None.
    warm_up : (5, n) rows of_coulomb, of_viscous, time, reference, start; or None. time 0: no warming up.
    """

    def __init__(
        self,
        friction: np.ndarray,
        ripple: np.ndarray,
        lines: tuple[np.ndarray, ...] | None = None,
        map: tuple[np.ndarray, ...] | None = None,
        warm_up: np.ndarray | None = None,
    ) -> None: ...
    def torque(self, q: np.ndarray, qd: np.ndarray, z: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return the torque (..., n) at positions, velocities and presliding states (..., n)."""

    n: int

class EgmMessages:
    """Datagrams of EGM for one arm: EgmRobot to packets, references to EgmSensor.

    Parameters
    ----------
    packet, drop : named tuples to make, `wire.egm.Packet` and `wire.egm.Drop`.
    order : axis of each joint, from 0. scale : (n,) SI per wire unit of each joint.
    external_scale : SI per wire unit of the first external axes beyond the robot's own; further ones are in degrees.
    extension : write the research extension.

    Raises
    ------
    ShapeError : an axis that is missing, or not (n,) scales.
    """

    def __init__(
        self,
        packet: Any,
        drop: Any,
        order: Sequence[int],
        scale: np.ndarray,
        external_scale: np.ndarray,
        extension: bool,
    ) -> None: ...
    def read(self, data: bytes, robotware: str) -> Any:
        """Return the packet, or the drop.

        Parameters
        ----------
        data : one datagram. robotware : flavour of the session, "" to decide by the fields present.
        """

    def write(self, ref: Any) -> bytes:
        """Return the bytes of an EgmSensor, as protobuf would write it.

        Parameters
        ----------
        ref : a `wire.egm.Reference`.

        Raises
        ------
        ShapeError : another number of joints.
        """

class InverseSolver:
    """Inverse kinematics of a chain within joint limits, immutable.

    Levenberg-Marquardt from one start after the other. Starts that stall are given up early;
    the next is taken from a table of random postures, in each block of it the one whose tool is nearest to the goal. In
    the second half of the table every other joint is at a limit, for the poses that are reached only so.
    The table depends on the robot and the seed alone: a goal has the same answer in a batch and alone.

    Tasks are told by their number of rows: 6 pose, 5 position and direction of a tool axis, 3 position, 2 direction.
    Statuses: 0 solved; 1 out of reach; 2 limits; 3 singular; 4 iterations; 5 bound (`follow` only).

    Parameters
    ----------
    chain : the chain.
    q_min, q_max : (n,) limits, maybe infinite: then starts come from one turn, or twice the arm's length.
    q_home : (n,) the first posture of the table, within the limits.
    seed : 0 to 2^64 - 1.
    """

    def __init__(self, chain: Chain, q_min: Any, q_max: Any, q_home: Any, seed: int = 0) -> None: ...
    def solve(
        self,
        T_base_tool: Any,
        q0: Any = None,
        task: int = 6,
        axis: Any = (0.0, 0.0, 1.0),
        steps: int = 100,
        starts: int = 100,
        position_tolerance: float = 1e-9,
        rotation_tolerance: float = 1e-9,
        damping: float = 0.1,
        objective: int = 0,
        reference: Any = None,
        scale: Any = None,
        history: bool = False,
        threads: int = 1,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
        """Return q (..., n), errors (..., 3), counts (..., 3) and the history (..., steps + 1, 2) or None.

        Counts are steps of all starts, starts, status. Without a solution `q` is the posture with the least error. It
        is always within the limits. Errors are those of position [m] and rotation [rad], NaN where the task does not
        ask for them, and the slope of the objective that is left, NaN without one.

        Parameters
        ----------
        T_base_tool : (..., 4, 4) goals.
        q0 : (n,) or (..., n) the first start; None: all starts come from the table.
        task : rows of the task.
        axis : (3,) the direction in tool axes, for tasks of 5 and 2 rows.
        steps : per start.
        starts : how many.
        position_tolerance, rotation_tolerance : errors at which a goal is solved [m], [rad].
        damping : ``lambda = damping |e|^2``, eight times that after each failure.
        objective : of the joints that the task leaves free, 0 none, 1 posture, 2 limits, 3 manipulability.
        reference : (n,) or (..., n), and scale : (n,), of the objectives 1 and 2; None: zeros.
        history : the errors along the start that gave the result, NaN after its end.
        threads : 1 to 256.
        """

    def follow(
        self,
        T_base_tool: Any,
        q0: Any,
        change: float = np.inf,
        task: int = 6,
        axis: Any = (0.0, 0.0, 1.0),
        steps: int = 100,
        position_tolerance: float = 1e-9,
        rotation_tolerance: float = 1e-9,
        damping: float = 0.1,
        objective: int = 0,
        reference: Any = None,
        scale: Any = None,
        history: bool = False,
        threads: int = 1,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
        """Solve from `q0` alone, and move no joint further than `change` from it; parameters and results as in `solve`.

        For paths, where the start is the previous posture: the result is near it or status 5 says that the bound stops
        it; damping bounds the steps near singular postures. `q` is the posture with the least error within the bound.
        """

class MessageCopier:
    """Copies the numbers of messages into the rows of arrays, channel by channel, where all are laid out as expected.

    Several threads may copy at the same time, into different rows.

    Parameters
    ----------
    channels : of each its number; the bytes of an example message; pairs (start, stop) of the bytes in it that all
        messages have; pairs of the numbers to copy; and the arrays to write into, with a row for every message of the
        file: sequence numbers (N,) uint32, log times (N,) int64, and one of N rows for every pair of numbers.

    Raises
    ------
    ShapeError : places outside the message; arrays that are read-only, not contiguous or of another size.
    """

    def __init__(self, channels: Sequence[tuple[Any, ...]]) -> None: ...
    def copy(self, data: bytes | memoryview, first: Sequence[int], count: Sequence[int]) -> list[bool]:
        """Return of which channels all messages are copied; the rows of the others hold nothing of use.

        Parameters
        ----------
        data : the records of a chunk, unpacked.
        first, count : of each channel the row of its first message, and how many it must have; -1 leaves it out.

        Raises
        ------
        ShapeError : rows that the arrays do not have.
        """

class MomentumEstimator:
    """Contact wrench from joint motion and torque by the momentum, one sample at a time.

    Parameters
    ----------
    chain, gravity, links, rotor, drive, gains, gain_variance, covariance, prior, point : as of `WrenchEstimator`.
    memory : (n,) correlation time of the torque error [s].
    qd_noise : (n,) deviation of the measured velocity.
    rate : (6,) intensity of the wrench's random walk [N^2/s, (N m)^2/s]. leak : (6,) of the wrench [1/s].
    gain : of the observer [1/s].
    filters : True for the Kalman filter, False for the observer.
    biased : the filter carries a friction error per joint.
    """

    def __init__(
        self,
        chain: Chain,
        gravity: np.ndarray,
        links: np.ndarray,
        rotor: np.ndarray,
        drive: Drive,
        gains: np.ndarray,
        gain_variance: float,
        covariance: np.ndarray,
        prior: np.ndarray,
        memory: np.ndarray,
        qd_noise: np.ndarray,
        rate: np.ndarray,
        leak: np.ndarray,
        gain: float,
        filters: bool,
        biased: bool,
        point: np.ndarray | None = None,
    ) -> None: ...
    def reset(self) -> None:
        """Forget everything but the parameters."""

    def step(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, dt: float) -> tuple[Any, ...]:
        """Advance by one sample; returns what `WrenchEstimator.step` does, without an interval.

        The torque error is what the low-pass shows (observer), or what the estimate explains (filter). A sample that is
        not finite gives NaN and changes nothing.
        """

    def run(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, dt: np.ndarray) -> tuple[Any, ...]:
        """Step along a record (N, n) with steps dt (N,); return the outputs of `step` stacked over N."""

    def tare(self) -> bool:
        """Call what the torques show now friction, not contact: the posterior of all else given a wrench of zero.

        False, and nothing done, unless every joint rests and the filter carries a friction error.
        """

class Obstacles:
    """Obstacles and the rule by which they are avoided.

    Parameters
    ----------
    arm : 2 or 3 axes of the space, or a `Chain`. links : (B,) from 1, that carry the bodies of an arm.
    bodies : (B, 7) ends and radius of capsules in the axes of their links [m]; of no meaning in space.
    clearance, reach : [m]. by_potential : instead of steering.
    """

    def __init__(
        self, arm: Any, links: Any, bodies: Any, clearance: float, reach: float, by_potential: bool = False
    ) -> None: ...
    def place(self, capsules: Any) -> None:
        """Put obstacles from now on.

        Parameters
        ----------
        capsules : (K, 10) ends [m], radius [m], velocity [m/s]; in the plane the third numbers are 0.
        """

    def advance(self, dt: float) -> None:
        """Let the obstacles go on.

        Parameters
        ----------
        dt : [s].
        """

    def distance(self, y: Any) -> np.ndarray:
        """Return the least distance (...) of any surface [m]; infinite without obstacles.

        Parameters
        ----------
        y : (..., n).
        """

    def add(self, y: Any, yd: Any, g: Any, ydd: Any) -> np.ndarray:
        """Return the acceleration (n,) with what obstacles add.

        Parameters
        ----------
        y, yd, g, ydd : (n,) position, velocity, goal, and acceleration without obstacles.
        """

class Primitive:
    """Spring, damper and forcing of n coordinates with m kernels.

    Parameters
    ----------
    centres, widths : (m,) of the kernels; widths are standard deviations. weights : (m, n).
    alpha, stiffness : damping and stiffness of the spring, in units of tau. decay, pace : of the phase.
    phase : "canonical", "time", "position" or "periodic".

    Raises
    ------
    ShapeError : parameters that do not fit together, are not finite or not positive.
    """

    def __init__(
        self,
        centres: Any,
        widths: Any,
        weights: Any,
        alpha: float,
        stiffness: float,
        decay: float,
        pace: float,
        phase: str,
    ) -> None: ...
    def basis(self, x: Any, out: Any = None) -> np.ndarray:
        """Return the normalised kernels (..., m) at phases (...)."""

    def design(self, x: Any, factors: Any, rows: int, columns: int) -> np.ndarray:
        """Return zeros (columns, rows) with the kernels at phases (N,), times factors (N,), in their corner [:m, :N].

        Raises
        ------
        ShapeError : other shapes, not finite, less room than that.
        """

    def forcing(self, x: Any, out: Any = None) -> np.ndarray:
        """Return the forcing (..., n) at phases (...), or (..., n) where every coordinate has its own."""

    def rollout(
        self, t: Any, tau: float, y0: Any, v0: Any, g: Any, scale: Any, weights: Any = None
    ) -> tuple[np.ndarray, ...]:
        """Return y, yd, ydd, x and f over times (N,).

        Parameters
        ----------
        t : (N,) increasing. tau : time constant [s]. y0, v0, g, scale : (n,) or (K, n). weights : (K, m, n) or None.

        Raises
        ------
        ShapeError : arguments that do not fit together or are not finite.
        """

    def response(self, t: Any, tau: float, longest: float) -> tuple[np.ndarray, np.ndarray]:
        """Return position and velocity (N, m + 3) that each kernel alone, then y0, v0 and g, make.

        Parameters
        ----------
        t : (N,) increasing. tau : time constant [s]. longest : of a step [s].

        Raises
        ------
        ShapeError : a position phase, whose response is not linear.
        """

class PrimitiveStepper:
    """One run of a primitive.

    Parameters
    ----------
    primitive : what runs. filter : rate of the goal filter times tau; 0: the goal changes at once.
    around : what it goes around, and moves on.
    """

    def __init__(self, primitive: Primitive, filter: float = 0.0, around: Obstacles | None = None) -> None: ...
    def start(self, y0: Any, v0: Any, g: Any, scale: Any, tau: float) -> None:
        """Begin at phase time 0.

        Parameters
        ----------
        y0, v0, g, scale : (n,). tau : time constant [s].
        """

    def step(self, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Advance by dt and return y, yd, ydd.

        Parameters
        ----------
        dt : above zero [s].
        """

    def change_goal(self, g: Any, scale: Any, limit: Any = None) -> None:
        """Go for another goal from now on.

        Parameters
        ----------
        g, scale : (n,). limit : (n,) largest deceleration of the brake, 0 where there is none; None without brakes.
        """

    def change_tau(self, tau: float) -> None:
        """Go on with another time constant.

        Parameters
        ----------
        tau : above zero [s].
        """

    def follow(self, t: Any) -> tuple[np.ndarray, ...]:
        """Return y, yd, ydd and the forcing over times, each (N, n).

        Parameters
        ----------
        t : (N,) times, the first of which is now [s].
        """

    def outputs(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return y, yd, ydd as they are now."""

    elapsed: float
    forcing: np.ndarray
    tau: float

class RigidBody:
    """A `Chain` with masses, immutable: inverse and forward dynamics, their parts and derivatives.

    Leading axes broadcast and are kept; NaN in a sample gives NaN in its results. `armlab.dynamics` documents the
    quantities, and the tests judge them by Pinocchio.

    Parameters
    ----------
    chain : Chain
    gravity : (3,) in base axes [m/s^2].
    pi : (n, 10) as in `Chain.rnea`.
    motors : (n, n) inertia of the motors as the joints feel it, or None.
    """

    def __init__(self, chain: Chain, gravity: Any, pi: Any, motors: Any = None) -> None: ...
    def rnea(self, q: Any, qd: Any, qdd: Any, f_ext: Any = None, out: Any = None) -> np.ndarray:
        """Return tau (..., n); f_ext (..., 6) is a wrench at the tool point, base axes."""

    def rnea_derivatives(
        self, q: Any, qd: Any, qdd: Any, f_ext: Any = None, out: Any = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return dtau/dq, dtau/dqd and M (..., n, n)."""

    def forward_dynamics(self, q: Any, qd: Any, tau: Any, f_ext: Any = None, out: Any = None) -> np.ndarray:
        """Return qdd (..., n)."""

    def forward_dynamics_derivatives(
        self, q: Any, qd: Any, tau: Any, f_ext: Any = None, out: Any = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return dqdd/dq, dqdd/dqd and M^-1 (..., n, n)."""

    def gravity_torque(self, q: Any, out: Any = None) -> np.ndarray:
        """Return tau (..., n) at rest."""

    def coriolis_torque(self, q: Any, qd: Any, out: Any = None) -> np.ndarray:
        """Return C qd (..., n)."""

    def coriolis_matrix(self, q: Any, qd: Any, out: Any = None) -> np.ndarray:
        """Return C (..., n, n) of Christoffel symbols."""

    def mass_matrix(self, q: Any, out: Any = None) -> np.ndarray:
        """Return M (..., n, n): column j is the torque of a unit acceleration of joint j."""

    def momentum(self, q: Any, qd: Any, out: _Pair | None = None) -> _Pair:
        """Return p = M qd and beta = C^T qd (..., n) of the links, without motors.

        With l_i the momentum of links i ... n and V_i the twist of link i: ``p_i = S_i . l_i, beta_i = l_i . (V_i x
        S_i)``; rnea without gravity is dp/dt - beta. `MomentumEstimator` is built on it.
        """

    def energy(self, q: Any, qd: Any, out: _Pair | None = None) -> _Pair:
        """Return kinetic and potential energy (...)."""

class RotationStepper:
    """One run of orientations, sample by sample.

    Parameters
    ----------
    primitive : of three coordinates, with a phase of time.

    Raises
    ------
    ShapeError : another primitive.
    """

    def __init__(self, primitive: Primitive) -> None: ...
    def start(self, q0: Any, w0: Any, goal: Any, map: Any, tau: float) -> None:
        """Begin at phase time 0 with orientation (4,), angular velocity (3,), goal (4,) and map (3, 3)."""

    def change_goal(self, goal: Any, map: Any) -> None:
        """Go to another goal from now on."""

    def change_tau(self, tau: float) -> None:
        """Go on with another time constant."""

    def step(self, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Advance by dt and return q, w, wd."""

    def outputs(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return q, w and wd as they are now."""

    elapsed: float
    tau: float

class RowEncoder:
    """Makes the messages of rows by patching templates, with their records and index entries.

    Parameters
    ----------
    topics : (channel, always, columns, variants, is_pose) each.
        always : each row has this message, not only those with one of its columns.
        columns : (start, nothing, optional) each: where a column begins in the row, the bytes that stand for missing,
        and whether messages without it have a template of their own.
        variants : (message, copies) for each set of optional columns that are there, the first of them the lowest bit;
        copies : (place in the message, place in the row, bytes) each. The message has a stamp behind its encapsulation.
        is_pose : the one copy writes position xyz and quaternion xyzw of the homogeneous matrix in the row.

    Raises
    ------
    ShapeError : topics that contradict themselves.
    """

    def __init__(self, topics: Sequence[tuple[Any, ...]]) -> None: ...
    def encode(
        self, rows: Sequence[bytes], first: int | None = None, at: int = 0
    ) -> tuple[bytes, dict[int, bytes], int, int]:
        """Return records, index entries by channel, and the earliest and the latest stamp [ns].

        Parameters
        ----------
        rows : at least one. first : sequence number of the first row, counted on; None takes those of the ticks.
        at : place of the first record in the chunk.

        Raises
        ------
        ShapeError : no row, or one that is too short for its columns.
        """

class RowPacker:
    """Packs what is known of a tick, attributes of three objects, into one row of bytes.

    Parameters
    ----------
    kinds : classes of the three objects, called "state", "command" and "tick" in `places`: dataclasses with slots or
        named tuples; an object of another class is asked for its attributes. A command may be None.
    places : of the columns in the row, one behind the other: (column, source, field, form, nothing, detail).
        source, field : object and attribute; source "record" is the value by this name in the attribute `record` of
        the command, else of the tick.
        form : "count" int64, "real" float64, "flag" one byte or int64, "code" the number that the mapping `detail`
        gives a text, 0 for others; "doubles" exactly as many as fit, none or None for missing; "fitting" the same, and
        missing where others come; "padded" at most as many as fit; "bits" exactly as many bytes as fit, "wide" exactly
        as many int64, None for missing; "said" one number or flag, None for missing; "heard" a flag that is missing
        when it is False and the column `detail` is missing; "blank" what is written by somebody else.
        nothing : the bytes of a missing value; of "count", "real", "flag", "code" only their number counts.
    seldom : name of the first column of those at the end that a row leaves out when all of them are missing.
    """

    def __init__(self, kinds: tuple[type, type, type], places: Sequence[tuple[Any, ...]], seldom: str) -> None: ...
    def pack(self, state: Any, command: Any, tick: Any) -> bytes:
        """Return one row. Values are copied.

        Raises
        ------
        ShapeError : an array has the wrong number of values; names the column.
        AttributeError, TypeError, ValueError, OverflowError : an object or a value is none that can be packed.
        """

class SignalOperator:
    """Operator with memory: one sample in, one sample out, with the true step h since the last one.

    ::

        trapezoid    y += h (x + x_prev) / 2          first output init
        euler        y += h x                         first output init + dt x_0
        difference   y = (x - x_prev) / h             first output 0, or (x_0 - init) / dt
        exponential  y = a y + (1 - a) x, a = exp(-h / T)   first output x_0, or one step of dt from init
        lowpass      y'' + 2 z w y' + w^2 y = w^2 x   first output init, or x_0
        slope        y' of lowpass                    first output 0
        notch        x - 2 z / w y' of lowpass        first output x_0

    The oscillators are solved exactly for an input that is a straight line between samples: with slope
    ``s = (x - x_prev) / h`` and lag ``2 z / w s``, the distance ``e = y - x_prev + lag`` and its rate ``u = y' - s``
    move freely, ``[e; u] <- exp([[0, 1], [-w^2, -2 z w]] h) [e; u]``.

    A sample that is not finite gives NaN, changes nothing and is counted in `skipped`; its time belongs to the next
    step. A step longer than 1.5 dt (1.5 times the first step where dt is NaN) is counted in `gaps`.

    Parameters
    ----------
    kind : see above. a : time constant T [s], or angular frequency w [rad/s]. b : damping ratio z < 1.
    dt : nominal step [s]; NaN when every sample has a time stamp.
    init : None, a number, or the shape of a sample.
    """

    def __init__(self, kind: str, a: float, b: float, dt: float, init: np.ndarray | float | None = None) -> None: ...
    def reset(self, init: np.ndarray | float | None = None) -> None:
        """Forget all samples; start again from init."""

    def step(self, x: np.ndarray | float, t: float | None = None) -> np.ndarray | float:
        """Advance by one sample and return the output."""

    def run(self, x: np.ndarray, t: np.ndarray | None = None) -> np.ndarray:
        """Step along samples (N, ...) and return the outputs stacked over N."""

    gaps: int
    longest_gap: float
    skipped: int

class TwoDof:
    """The law above for one primitive on its way to one goal.

    Parameters
    ----------
    primitive : spring, basis and weights. tau : its time constant [s].
    y0, g, scale : (n,) start, from which the position phase counts, goal, and factor of the forcing.
    gains : (5,) kp [1/s^2], kv [1/s], kc, alpha_e [1/s], e_max, which may be infinite.
    dead_zone, unit : (n,) of the error e.

    Raises
    ------
    ShapeError : wrong shapes, more than 32 coordinates, or numbers that are not finite or out of their range.
    """

    def __init__(
        self,
        primitive: Primitive,
        tau: float,
        y0: np.ndarray,
        g: np.ndarray,
        scale: np.ndarray,
        gains: np.ndarray,
        dead_zone: np.ndarray,
        unit: np.ndarray,
    ) -> None: ...
    def advance(self, state: np.ndarray, dt: float, steps: int, driven: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return the state (5 n + 2,) after dt seconds.

        Parameters
        ----------
        state : (5 n + 2,). dt : seconds, made in `steps` equal steps, at least one.
        driven : (n,) velocity with which something else moves ya; NaN where ya'' is ya_ref''.
        speed : (3,) v at the beginning and at the end, linear between them, and v' after the end.

        Raises
        ------
        ShapeError : wrong shapes, no step, or a dt that is negative or not finite.
        """

    def reference(self, state: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return (3, n) yc', yc'' and ya_ref'' of a state (5 n + 2,), at the end of `speed` (3,).

        Raises
        ------
        ShapeError : wrong shapes.
        """

    def slopes(self, state: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return the time derivative (5 n + 2,) of a state whose ya'' is ya_ref'', at the end of `speed` (3,).

        Raises
        ------
        ShapeError : wrong shapes.
        """

    def follow(
        self, state: np.ndarray, dt: float, steps: int, speed: np.ndarray, ya: np.ndarray, yad: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the state dt seconds later, when ya and ya' (n,) are measured, and `reference` of it.

        In between ya moves with the velocity that was measured before. A sample that is not finite is passed over: ya
        goes on as it did.

        Raises
        ------
        ShapeError : as `advance`.
        """

    def time_constant(self, state: np.ndarray) -> float:
        """Return tau_a [s] of a state (5 n + 2,).

        Raises
        ------
        ShapeError : wrong shape.
        """

    n: int

class WrenchEstimator:
    """Contact wrench from joint motion and torque, one sample at a time.

    Parameters
    ----------
    chain : kinematics and dynamics kernel.
    gravity : (3,) [m/s^2], base axes.
    links : (n, 10) link parameters. rotor : (n,) rotor inertia.
    drive : friction and ripple of as many joints.
    gains : (n,) torque as it is read over true torque. gain_variance : of what they have in common.
    covariance : (5, n) rows C0, Cinf, shape, kind (0 exp, 1 step, 2 const), doubt of a contact's torque as a share;
        C0 and Cinf already scaled.
    bound : (3, n) rows torque, speed, floor of the bound on low-speed friction.
    prior : (6,) prior variances of the wrench.
    cutoff : corner of the low-pass [Hz].
    method : 0 map, 1 bounded, 2 clip, 3 interval, 4 ls, 5 lund, 6 ols.
    point : (3,) the contact in tool axes, or None when the whole wrench is unknown.
    """

    def __init__(
        self,
        chain: Chain,
        gravity: np.ndarray,
        links: np.ndarray,
        rotor: np.ndarray,
        drive: Drive,
        gains: np.ndarray,
        gain_variance: float,
        covariance: np.ndarray,
        bound: np.ndarray,
        prior: np.ndarray,
        cutoff: float,
        method: int = 0,
        point: np.ndarray | None = None,
    ) -> None: ...
    def reset(self) -> None:
        """Forget everything but the parameters."""

    def step(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, dt: float) -> tuple[Any, ...]:
        """Advance by one sample.

        Returns F (6,), P (6, 6), observability (6,), filtered tau_e (n,), its variance (n,), flags, active joints (n,)
        and, for the method "interval", the interval (6, 2), else None. A sample that is not finite, or whose torque
        error would not be, or dt <= 0, gives NaN everywhere and leaves the state unchanged.
        """

    def run(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, dt: np.ndarray) -> tuple[Any, ...]:
        """Step along a record (N, n) with steps dt (N,); return the outputs of `step` stacked over N."""

def basis_weights(x: np.ndarray, centres: np.ndarray, widths: np.ndarray) -> np.ndarray:
    """Return Gaussians ``exp(-((x - c) / w)^2)`` divided by their sum, (N, m); x outside the centres counts as the end.

    Parameters
    ----------
    x : (N,).
    centres, widths : (m,) ascending; positive.
    """

def euler_from_rpy(rpy: Any, first: int, middle: int, last: int, out: Any = None) -> np.ndarray:
    """The product of the three turns."""

def euler_to_rpy(R: Any, first: int, middle: int, last: int, out: Any = None) -> np.ndarray:
    """The angles, by what the first two turns make of the last axis; then the first is undone to see the last alone."""

def follow_path(
    solver: InverseSolver,
    T_base_tool: Any,
    q0: Any = None,
    change: Any = None,
    task: int = 6,
    axis: Any = (0.0, 0.0, 1.0),
    steps: int = 100,
    starts: int = 100,
    position_tolerance: float = 1e-9,
    rotation_tolerance: float = 1e-9,
    damping: float = 0.1,
    objective: int = 0,
    reference: Any = None,
    scale: Any = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return q (N, n), errors (N, 3) and counts (N, 3) along a path.

    Every row is descended to from the row before plus its last step (without what the tool did not feel of that),
    within `change`. Where that fails: from random starts about the row before; then further away; then, on another
    branch, from the solver's table. Errors are as in `InverseSolver.solve`. Counts are steps, status, whether the row
    is on another branch. A row whose status is not 0 breaks the path: with errors within the tolerances `q` is a
    solution beyond the break, otherwise the posture with the least error.

    Parameters
    ----------
    solver : the arm and its limits.
    T_base_tool : (N, 4, 4) goals, one after the other.
    q0 : (n,) where the first row starts from; None: the solver's table.
    change : (n,) how far a joint may move from row to row, maybe infinite; None: 0.05 rad and five times the length of
        the pose step.
    task, axis, steps, starts, position_tolerance, rotation_tolerance, damping, objective, scale : as in
        `InverseSolver.solve`; the starts are those of a search for another branch.
    reference : (n,) or (N, n), as there.
    """

def await_datagram(sockets: Sequence[int], poll_ns: int, end_ns: int) -> bool:
    """Wait without the interpreter until a socket has something to read. Return False at the end and after a signal.

    Sleeps until `poll_ns`, then asks again and again until `end_ns`, both on the monotonic clock.
    """

def filled(kind: Any, slots: tuple[Any, ...], values: tuple[Any, ...]) -> Any:
    """Return an instance of a class whose slots hold the values, made without its constructor."""

def filtered_velocity(q: np.ndarray, last: np.ndarray, velocity: np.ndarray, dt: float, cutoff: float) -> np.ndarray:
    """Return the velocity (n,) after a step from `last` to `q`, through a low-pass of first order [Hz]; read-only."""

def implausible(
    q: np.ndarray, before: np.ndarray | None, bounds: np.ndarray, margin: float, step: float, seconds: float
) -> int:
    """Return i (from 1) when joint i is outside its range, -i when it moved too far since `before`, else 0.

    `bounds`: lowest and highest positions and speeds (3, n). Outside: by more than `margin`. Too far: by more than
    ``step + speed * seconds``. The worst joint counts, and the first that is not a number before any.
    """

def following_error(
    q: np.ndarray,
    reference: np.ndarray,
    speed: np.ndarray,
    fastest: np.ndarray,
    allowed: np.ndarray,
    kept: float,
    lag: float,
) -> tuple[np.ndarray, int, bool]:
    """Return the speeds ``max(kept * fastest, |speed|)``, the joint furthest from its reference, and if it is near.

    Near is ``|reference - q| <= allowed + lag * speeds``; all (n,).
    """

def limit_reference(
    sent: np.ndarray,
    bounds: np.ndarray,
    period: float,
    q_ref: np.ndarray | None = None,
    q_last: np.ndarray | None = None,
    qd_ref: np.ndarray | None = None,
    lag: float = 0.0,
) -> tuple[np.ndarray, np.ndarray, float, int]:
    """Return the reference to send next: where it is, how it moves, which limits acted, and whether it was refused.

    With T the time since the last reference, a the acceleration limit, and ``S(d, L)`` the fastest velocity after which
    an arm that is late by L can still stop within d, whatever the next steps last: ``S (T + L) + S^2 / (2 a) = d``.
    From S braking with a suffices ever after::

        position   v* = v_r + sign(e) S(|e|, 0),  e = q_last - q,  v_r = (q_ref - q_last) / T
                   that is (q_ref - q) / T when the reference can be followed, and catching up without overshoot
        velocity   v* = qd_ref;      hold   v* = 0
        v* is scaled for all joints by one ratio so that |v*| <= qd_max
        v  = v* within v_prev +- a T, then within [-S(q - q_min, lag), S(q_max - q, lag)]
        q' = q + v T, kept within the limits; a joint that is outside may only come back

    The speed sent is v; when both are given it is qd_ref within v +- a T, through the same limits.

    Parameters
    ----------
    sent : (3, n) previous reply: position, step velocity, speed.
    bounds : (5, n) q_min, q_max, qd_max, qdd_max, jump; infinite where there is no limit.
    period : T, seconds.
    q_ref : (n,) position asked for, or None.
    q_last : (n,) position asked for before this one; None when there was none.
    qd_ref : (n,) velocity asked for, or None. Without both the arm is brought to rest.
    lag : time by which the arm follows its reference late [s]: the margin before its limits is lag times the speed.

    Returns
    -------
    (3, n) new `sent`; (n,) uint8 bits (1 position, 2 velocity, 4 acceleration, 8 braking); both are read-only;
    velocity ratio in (0, 1]; 0, or i when joint i (from 1) is not finite, or -i when it jumps by more than
    ``jump + qd_max T``. A refused reference holds instead.
    """

def model_torque(
    chain: Chain,
    gravity: np.ndarray,
    links: np.ndarray,
    rotor: np.ndarray,
    drive: Drive,
    q: np.ndarray,
    qd: np.ndarray,
    qdd: np.ndarray,
    dt: np.ndarray | None = None,
    out: np.ndarray | None = None,
) -> np.ndarray:
    """Return ``rnea + rotor qdd + drives`` (N, n) along a record, with z from 0 at the first row.

    A row with a number that is not finite gives NaN and leaves the state of the drives alone.

    Parameters
    ----------
    chain, gravity, links, rotor : of the rigid body, see `Chain.rnea`; rotor (n,).
    drive : of as many joints.
    q, qd, qdd : (N, n) in time order.
    dt : (N,) step of each row [s]; without it the drives do not warm up.
    out : (N, n) to write into.
    """

def momentum_step(
    x: np.ndarray,
    P: np.ndarray,
    G: np.ndarray,
    u: np.ndarray,
    y: np.ndarray,
    R: np.ndarray,
    h: float,
    Qp: np.ndarray,
    q: np.ndarray,
    a: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return state (n+m,) and covariance (n+m, n+m) after a step of h seconds and a measurement of the momentum.

    One step of `MomentumEstimator`; the tests hold its laws on it.

    Parameters
    ----------
    x, P : state [p; z] and its covariance before the step.
    G : (n, m) what the hidden inputs do to the momentum. u : (n,) the known input, mean over the step.
    y : (n,) measured momentum. R : (n, n) its covariance.
    h : step [s]. Qp : (n,) intensity of the torque error [(N m)^2 s]. q, a : (m,) intensity and leak of the inputs.
    """

def poses(T: Any, name: str) -> np.ndarray:
    """Return poses (..., 4, 4) as float64, refusing the first that is none.

    Parameters
    ----------
    T : (..., 4, 4).
    name : how error messages call it.

    Raises
    ------
    ShapeError
        When the shape is another, the rotation is none, or the last row is not (0, 0, 0, 1).
    """

def presliding(q: np.ndarray, delta: np.ndarray, resolution: np.ndarray) -> np.ndarray:
    """Return the presliding state z (N, n) in [-1, 1] along positions `q` (N, n) [rad], from 0 at the first row.

    ``z_k = s + (z_{k-1} - s) exp(-|dy_k| / delta)``, s = sign(dy_k), where y follows q with a play of +-resolution, so
    that the last digit of an encoder at rest does not wear the state down. A row with a NaN gives NaN and changes
    nothing.

    Parameters
    ----------
    q : (N, n) positions in time order.
    delta : (n,) presliding distance [rad].
    resolution : (n,) half the play [rad].
    """

def quaternion_from_matrix(R: Any, out: Any = None) -> np.ndarray:
    """Divide the row of 4 q qᵀ with the largest diagonal by its length (Shepperd 1978)."""

def quaternion_multiply(p: Any, q: Any, out: Any = None) -> np.ndarray:
    """``(p_w q_w - p_v · q_v, p_w q_v + q_w p_v + p_v × q_v)``."""

def quaternion_slerp(a: Any, b: Any, s: Any, out: Any = None) -> np.ndarray:
    """``(a sin((1-s)Ω) ± b sin(sΩ)) / sin Ω``, Ω at most a quarter turn of the unit sphere."""

def quaternion_to_matrix(quaternion: Any, out: Any = None) -> np.ndarray:
    """``I + 2 w hat(v) + 2 hat(v)²`` of the unit quaternion (w, v)."""

def rotation_rollout(
    primitive: Primitive, t: Any, tau: float, q0: Any, w0: Any, goal: Any, map: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return orientations q (N, 4), angular velocities and accelerations (N, 3) over times (N,).

    Parameters
    ----------
    primitive : of three coordinates, with a phase of time. t : (N,) increasing [s]. tau : time constant [s].
    q0, goal : (4,) wxyz. w0 : (3,). map : (3, 3).

    Raises
    ------
    ShapeError : arguments that do not fit together or are not finite.
    """

def rotations(R: Any, name: str) -> np.ndarray:
    """Return rotations (..., 3, 3) as float64, refusing the first that is off by more than 1e-6.

    Parameters
    ----------
    R : (..., 3, 3).
    name : how error messages call it.

    Raises
    ------
    ShapeError
        When the shape is another, ``max|RᵀR - I| > 1e-6``, the determinant is negative, or an entry is infinite.
    """

def se3_adjoint(T_a_b: Any, out: Any = None) -> np.ndarray:
    """``[[R, hat(p) R], [0, R]]``."""

def se3_exp(xi: Any, out: Any = None) -> np.ndarray:
    """``[[exp(w), V v], [0, 1]]`` with V the left Jacobian of w."""

def se3_interpolate(T_a: Any, T_b: Any, s: Any, screw: bool = False, out: Any = None) -> np.ndarray:
    """``T_a exp(s log(T_a⁻¹ T_b))`` when `screw`, otherwise the position along a line and the rotation as above."""

def se3_inv(T: Any, out: Any = None) -> np.ndarray:
    """``[[Rᵀ, -Rᵀ p], [0, 1]]``."""

def se3_left_jacobian(xi: Any, out: Any = None) -> np.ndarray:
    """``[[J, Q], [0, J]]``: J of w, and Q its derivative in the direction v."""

def se3_left_jacobian_inv(xi: Any, out: Any = None) -> np.ndarray:
    """The same of the inverse of J."""

def se3_log(T: Any, out: Any = None) -> np.ndarray:
    """``[V⁻¹ p; w]`` with V the left Jacobian of w."""

def se3_transform_wrench(T_a_b: Any, wrench_b: Any, out: Any = None) -> np.ndarray:
    """``f_a = R f_b``, ``m_a = R m_b + p × f_a``."""

def so3_angle(R_a: Any, R_b: Any, out: Any = None) -> np.ndarray:
    """``2 atan2(abs(v), w)`` of the quaternion of ``R_aᵀ R_b``."""

def so3_exp(w: Any, out: Any = None) -> np.ndarray:
    """``I + sin θ/θ hat(w) + 2 sin²(θ/2)/θ² hat(w)²``."""

def so3_interpolate(R_a: Any, R_b: Any, s: Any, out: Any = None) -> np.ndarray:
    """``R_a exp(s log(R_aᵀ R_b))``, from the nearer end, which is exact that way."""

def so3_left_jacobian(w: Any, out: Any = None) -> np.ndarray:
    """``I + (1 - cos θ)/θ² hat(w) + (θ - sin θ)/θ³ hat(w)²``."""

def so3_left_jacobian_inv(w: Any, out: Any = None) -> np.ndarray:
    """``I - hat(w)/2 + (1 - θ/2 cot(θ/2))/θ² hat(w)²``."""

def so3_log(R: Any, out: Any = None) -> np.ndarray:
    """``2 atan2(abs(v), w) v/abs(v)`` of the quaternion (w, v)."""

def solve_wrench(
    A: np.ndarray, error: np.ndarray, variance: np.ndarray, bound: np.ndarray, prior: np.ndarray, method: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int, float, bool]:
    """Return x (k,), its covariance (k, k), active joints (n,), iterations, KKT residual and whether x is undetermined.

    x and its covariance are NaN where the numbers do not determine them. One solution of `WrenchEstimator`; the tests
    hold its laws on it.

    Parameters
    ----------
    A : (k, n) rows of the Jacobian for the k unknowns.
    error, variance, bound : (n,) torque errors [N m], variances [(N m)^2] above zero, bounds [N m] not below it.
    prior : (k,) prior variances of the unknowns, above zero.
    method : 0 map, 1 bounded, 2 clip, 3 interval, 4 ls, 5 lund, 6 ols.
    """

def wrench_interval(
    A: np.ndarray, error: np.ndarray, spread: np.ndarray, box: np.ndarray
) -> tuple[np.ndarray | None, np.ndarray]:
    """Return the smallest and largest value (k, 2) of each unknown in {x : |error - A^T x| <= spread, |x| <= box}.

    None when the set is empty; then the mask (n,) marks joints that contradict each other. NaN for torque errors or
    rows of the Jacobian that are not finite.

    Parameters
    ----------
    A : (k, n) rows of the Jacobian. error, spread : (n,) [N m]. box : (k,) largest values.
    """
