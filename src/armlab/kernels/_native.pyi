"""Signatures and documentation of the compiled kernels, which are imported from `armlab.kernels`.

tests/kernels/test_extension.py compares the signatures with the extension. Where shapes begin with ``...``, functions
accept any leading axes. They do not modify inputs, write into `out` if given, and raise `ShapeError` for invalid
arguments.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

_Pair = tuple[np.ndarray, np.ndarray]

class Chain:
    """Immutable serial chain of revolute and prismatic joints.

    ``T_base_tool(q) = E_0 Z_1(q_1) E_1 ... Z_n(q_n) E_n`` with ``Z(q) = Rz(q)`` (revolute) or ``Tz(q)`` (prismatic):
    the local product of exponentials with all joint axes along z. Link frame i is ``T_base_i = E_0 Z_1(q_1) ...
    E_{i-1} Z_i(q_i)``. NaN in a sample gives NaN in its result.

    Parameters
    ----------
    frames : (n + 1, 4, 4) poses E_0 ... E_n [m]; rotation errors of up to 1e-6 are removed by projection onto SO(3).
    prismatic : (n,) bool, True for prismatic joints; n from 1 to 32.
    """

    def __init__(self, frames: Any, prismatic: Any) -> None: ...
    @property
    def n(self) -> int:
        """Number of joints."""

    @property
    def frames(self) -> np.ndarray:
        """Copy of E_0 ... E_n (n + 1, 4, 4)."""

    @property
    def prismatic(self) -> np.ndarray:
        """Whether each joint is prismatic (n,)."""

    def forward(self, q: Any, out: Any = None, threads: int = 1) -> np.ndarray:
        """Return T_base_tool (..., 4, 4) for joint positions `q` (..., n)."""

    def link_transforms(self, q: Any, out: Any = None) -> np.ndarray:
        """Return the poses T_base_i (..., n, 4, 4) of link frames 1 ... n."""

    def jacobian(self, q: Any, tool: bool = False, out: Any = None, threads: int = 1) -> np.ndarray:
        """Return J (..., 6, n), rows [v; w], at the tool point, in tool axes if `tool` is set, otherwise in base axes.

        Column i is ``[z_i x (p - p_i); z_i]`` (revolute) or ``[z_i; 0]`` (prismatic).
        """

    def forward_jacobian(self, q: Any, tool: bool = False, out: _Pair | None = None, threads: int = 1) -> _Pair:
        """Return the results of `forward` (..., 4, 4) and `jacobian` (..., 6, n); `out` is a pair of such arrays."""

    def jacobian_derivative(self, q: Any, qd: Any, tool: bool = False, out: Any = None) -> np.ndarray:
        """Return Jd (..., 6, n), the derivative of `jacobian` along the motion `q`, `qd` (..., n).

        In base axes, ``dv_i/dq_j = w_first x v_last`` with first = min(i, j) and last = max(i, j), and ``dw_i/dq_j =
        w_j x w_i`` for j < i, else 0. In tool axes, ``d/dt (R^T u) = R^T (ud - w x u)``, with w the angular velocity of
        the tool.
        """

    def rnea(self, q: Any, qd: Any, qdd: Any, gravity: Any, pi: Any, out: Any = None) -> np.ndarray:
        """Return the joint torques tau (..., n) of a motion by the recursive Newton-Euler algorithm.

        ``F_i = I_i A_i + V_i x* (I_i V_i)`` with ``A_0 = [-g; 0]``, and ``tau_i = S_i . sum of F_k, k >= i``.

        Parameters
        ----------
        q, qd, qdd : (..., n) joint positions, velocities, accelerations.
        gravity : (3,) gravity in base axes [m/s^2].
        pi : (n, 10) m, m cx, m cy, m cz, Ixx, Ixy, Iyy, Ixz, Iyz, Izz of each link i, in frame i about its origin.
        out : (..., n) array for the result, or None.
        """

    def rigid_regressor(self, q: Any, qd: Any, qdd: Any, gravity: Any, out: Any = None) -> np.ndarray:
        """Return the regressor Y (..., n, 10 n): ``tau = Y pi.ravel()``, with arguments as in `rnea`."""

class Datagrams:
    """Nonblocking receiver and sender on a bound IPv4 UDP socket, which counts socket errors instead of raising them.

    Parameters
    ----------
    socket : nonblocking socket, which `close` closes; with SO_TIMESTAMPNS, the kernel's time stamps are used.
    kind : named tuple class for a datagram: its bytes, the sender's (host, port), and the arrival time on the monotonic
        clock [ns].

    Attributes
    ----------
    errors : number of socket errors so far.
    """

    def __init__(self, socket: Any, kind: Any) -> None: ...
    def receive(self) -> Any | None:
        """Return the next datagram, or None if no datagram is waiting or the socket reports an error."""

    def send(self, data: bytes, to: tuple[str, int]) -> bool:
        """Send one datagram to a numeric address and port; return whether the system accepted it."""

    def close(self) -> None:
        """Close the socket."""

    errors: int

class Drive:
    """Friction and ripple of n joint drives.

    Parameters
    ----------
    friction : (11, n) rows viscous, coulomb_pos, coulomb_neg, offset, stribeck, stribeck_speed, delta, resolution,
        root, smooth_speed, load.
    ripple : (3, n) rows cycles, cosine, sine.
    lines : ripple lines, or None: joints (L,) in order, cycles (L,), speeds and widths (n, S), coefficients (L, 1 or 2
        directions, S, 2).
    map : friction map, or None: positions and widths (n, P), speeds and widths (n, S), coefficients (n, 2, P, S).
    warm_up : (5, n) rows of_coulomb, of_viscous, time, reference, start, or None. A time of 0 disables warm-up.
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
    """EGM codec of one arm: EgmRobot to packets, references to EgmSensor.

    Parameters
    ----------
    packet, drop : named tuple classes of the results, `wire.egm.Packet` and `wire.egm.Drop`.
    order : axis number of each joint, counted from 0.
    scale : (n,) SI units per wire unit of each joint.
    external_scale : SI units per wire unit of the first external axes that are not joints of the robot; further axes
        are in degrees.
    extension : whether to write the research extension.

    Raises
    ------
    ShapeError : an axis is missing, or the number of scales is wrong.
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
        """Decode one datagram; return the packet or the drop.

        `robotware` is the version used in the session; with "", it is inferred from the fields.
        """

    def write(self, ref: Any) -> bytes:
        """Return the EgmSensor message for a `wire.egm.Reference`, with the same bytes as protobuf.

        Raises
        ------
        ShapeError : a wrong number of joints.
        """

class InverseSolver:
    """Immutable inverse-kinematics solver of a chain within joint limits.

    The solver runs Levenberg-Marquardt iterations from successive starts and abandons stalled starts early. The starts
    are taken from a table of random postures: from each block, the posture whose tool is nearest to the goal. In the
    second half of the table, every other joint is at a limit, for poses that can be reached only there. The table
    depends only on robot and seed, so the result for a goal is the same alone and in a batch.

    Tasks are identified by their number of rows: 6 pose, 5 position and direction of a tool axis, 3 position, 2
    direction. Statuses: 0 solved; 1 out of reach; 2 limits; 3 singular; 4 iterations; 5 bound (`follow` only).

    Parameters
    ----------
    chain : the chain.
    q_min, q_max : (n,) limits; if infinite, starts are drawn within one revolution, or twice the arm's length.
    q_home : (n,) first posture of the table, within the limits.
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

        `q` is always within the limits; without a solution, it is the posture with the smallest error. The errors are
        the position error [m], the rotation error [rad] (each NaN if the task does not constrain it) and the remaining
        slope of the objective (NaN without an objective). The counts are the total number of steps, the number of
        starts, and the status.

        Parameters
        ----------
        T_base_tool : (..., 4, 4) goals.
        q0 : (n,) or (..., n) first start; None: all starts are taken from the table.
        task : number of rows of the task.
        axis : (3,) direction in tool axes, for tasks with 5 or 2 rows.
        steps : largest number of steps per start.
        starts : largest number of starts.
        position_tolerance, rotation_tolerance : largest errors of a solved goal [m], [rad].
        damping : ``lambda = damping |e|^2``, multiplied by eight after each failure.
        objective : objective for the degrees of freedom that the task leaves: 0 none, 1 posture, 2 limits, 3
            manipulability.
        reference : (n,) or (..., n) reference of objectives 1 and 2; None: zeros.
        scale : (n,) scale of objectives 1 and 2; None: zeros.
        history : whether to return the errors along the successful start, followed by NaN.
        threads : number of threads, 1 to 256.
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
        """Solve from `q0` only, without moving any joint by more than `change`; otherwise like `solve`.

        Intended for paths, where the start is the previous posture. Status 5 reports that the bound stopped the search.
        Without a solution, `q` is the posture with the smallest error within the bound. Damping limits the steps near
        singular postures.
        """

class MessageCopier:
    """Copier of numbers from messages into array rows, for channels whose messages all have the same layout.

    Several threads may copy into different rows at the same time.

    Parameters
    ----------
    channels : one tuple per channel: the channel number, the bytes of an example message, pairs (start, stop) of the
        bytes common to all messages, pairs of the numbers to copy, and the output arrays. The output arrays have one
        row per message of the file: sequence numbers (N,) uint32, log times (N,) int64, and an array of N rows for each
        pair of numbers.

    Raises
    ------
    ShapeError : positions outside the message, or arrays that are read-only, not contiguous or of the wrong size.
    """

    def __init__(self, channels: Sequence[tuple[Any, ...]]) -> None: ...
    def copy(self, data: bytes | memoryview, first: Sequence[int], count: Sequence[int]) -> list[bool]:
        """Copy a chunk; return for each channel whether all messages were copied. Otherwise, its rows are invalid.

        Parameters
        ----------
        data : decompressed records of the chunk.
        first, count : for each channel, the row of its first message and the expected number of messages; -1 skips it.

        Raises
        ------
        ShapeError : rows outside the arrays.
        """

class MomentumEstimator:
    """Momentum-based estimator of the contact wrench from joint motion and torque, one sample at a time.

    Parameters
    ----------
    chain, gravity, links, rotor, drive, gains, gain_variance, covariance, prior : as in `WrenchEstimator`.
    point, doubt_columns, doubt_cov, doubt_mean : as in `WrenchEstimator`.
    memory : (n,) correlation time of the torque error [s].
    qd_noise : (n,) standard deviation of the measured velocity.
    rate : (6,) intensity of the random walk of the wrench [N^2/s, (N m)^2/s].
    leak : (6,) leak of the wrench [1/s].
    gain : observer gain [1/s].
    filters : True for the Kalman filter, False for the observer.
    biased : whether the filter estimates a friction error per joint.
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
        doubt_columns: np.ndarray | None = None,
        doubt_cov: np.ndarray | None = None,
        doubt_mean: np.ndarray | None = None,
    ) -> None: ...
    def reset(self) -> None:
        """Reset everything except the parameters."""

    def step(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, dt: float) -> tuple[Any, ...]:
        """Advance by one sample; return the outputs of `WrenchEstimator.step` without the interval.

        The torque error is low-pass filtered (observer), or is the part explained by the estimate (Kalman filter). A
        non-finite sample gives NaN and leaves the state unchanged.
        """

    def run(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, dt: np.ndarray) -> tuple[Any, ...]:
        """Step along a record (N, n) with time steps dt (N,); return the outputs of `step` stacked over N."""

    def tare(self) -> bool:
        """Attribute the current torque error to friction, assuming zero wrench; return whether this was possible.

        All joints must be at rest, and the filter must estimate friction errors; otherwise, nothing changes.
        """

class Obstacles:
    """Obstacles and avoidance rule of a movement primitive.

    Parameters
    ----------
    arm : number of dimensions of the space (2 or 3), or a `Chain`.
    links : (B,) link number of each body of an arm, counted from 1.
    bodies : (B, 7) ends and radius of the capsules in link axes [m]; unused for a space.
    clearance : smallest allowed distance from the obstacle surfaces [m].
    reach : distance within which obstacles act [m].
    by_potential : whether to use the potential instead of steering.
    """

    def __init__(
        self, arm: Any, links: Any, bodies: Any, clearance: float, reach: float, by_potential: bool = False
    ) -> None: ...
    def place(self, capsules: Any) -> None:
        """Replace the obstacles.

        `capsules`: (K, 10) ends [m], radius [m] and velocity [m/s]; in two dimensions, third coordinates are 0.
        """

    def advance(self, dt: float) -> None:
        """Move the obstacles by dt [s]."""

    def distance(self, y: Any) -> np.ndarray:
        """Return the smallest distance (...) [m] from y (..., n) to an obstacle surface; infinite without obstacles."""

    def add(self, y: Any, yd: Any, g: Any, ydd: Any) -> np.ndarray:
        """Return the acceleration (n,) with avoidance.

        `y`, `yd`, `g`, `ydd`: (n,) position, velocity, goal, and acceleration without avoidance.
        """

class Primitive:
    """Spring, damper and forcing term of n coordinates with m kernels.

    Parameters
    ----------
    centres, widths : (m,) kernel centres and widths (standard deviations).
    weights : (m, n) kernel weights.
    alpha, stiffness : spring damping and stiffness for time in units of tau.
    decay, pace : decay rate of the phase, and speed of the time phase.
    phase : "canonical", "time", "position" or "periodic".

    Raises
    ------
    ShapeError : inconsistent, non-finite or non-positive parameters.
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
        """Return an array (columns, rows): kernels at phases (N,) times factors (N,) in [:m, :N], zeros elsewhere.

        Raises
        ------
        ShapeError : wrong shapes, non-finite values, or too few rows or columns.
        """

    def forcing(self, x: Any, out: Any = None) -> np.ndarray:
        """Return the forcing term (..., n) at phases (...), or at phases (..., n), one per coordinate."""

    def rollout(
        self, t: Any, tau: float, y0: Any, v0: Any, g: Any, scale: Any, weights: Any = None
    ) -> tuple[np.ndarray, ...]:
        """Return y, yd, ydd, x and f at times (N,).

        Parameters
        ----------
        t : (N,) increasing times [s].
        tau : time constant [s].
        y0, v0, g, scale : (n,) or (K, n) start position, start velocity, goal, and forcing term factor.
        weights : (K, m, n) kernel weights, or None.

        Raises
        ------
        ShapeError : inconsistent or non-finite arguments.
        """

    def response(self, t: Any, tau: float, longest: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the position and velocity responses (N, m + 3) to each kernel, then to y0, v0 and g.

        Parameters
        ----------
        t : (N,) increasing times [s].
        tau : time constant [s].
        longest : longest integration step [s].

        Raises
        ------
        ShapeError : a position phase, whose response is not linear.
        """

class PrimitiveStepper:
    """Sample-by-sample execution of a primitive.

    Parameters
    ----------
    primitive : primitive to run.
    filter : rate of the goal filter times tau; with 0, goal changes are immediate.
    around : obstacles to avoid, which the stepper advances in time.
    """

    def __init__(self, primitive: Primitive, filter: float = 0.0, around: Obstacles | None = None) -> None: ...
    def start(self, y0: Any, v0: Any, g: Any, scale: Any, tau: float) -> None:
        """Start at phase time 0 with y0, v0, g and scale (n,), and time constant tau [s]."""

    def step(self, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Advance by dt > 0 [s]; return y, yd, ydd."""

    def change_goal(self, g: Any, scale: Any, limit: Any = None) -> None:
        """Change the goal.

        `g`, `scale`: (n,) goal and forcing term factor. `limit`: (n,) largest deceleration of the brake, 0 for
        coordinates without a brake; None: no brake.
        """

    def change_tau(self, tau: float) -> None:
        """Change the time constant, tau > 0 [s]."""

    def follow(self, t: Any) -> tuple[np.ndarray, ...]:
        """Return y, yd, ydd and the forcing term, each (N, n), at times (N,) [s] that start at the current time."""

    def outputs(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the current y, yd, ydd."""

    elapsed: float
    forcing: np.ndarray
    tau: float

class RigidBody:
    """Immutable `Chain` with masses: inverse and forward dynamics, their terms and derivatives.

    Leading axes broadcast. NaN in a sample gives NaN in its results. `armlab.dynamics` documents the quantities; the
    tests compare them with Pinocchio.

    Parameters
    ----------
    chain : the chain.
    gravity : (3,) in base axes [m/s^2].
    pi : (n, 10) as in `Chain.rnea`.
    motors : (n, n) motor inertia reflected to the joints, or None.
    """

    def __init__(self, chain: Chain, gravity: Any, pi: Any, motors: Any = None) -> None: ...
    def rnea(self, q: Any, qd: Any, qdd: Any, f_ext: Any = None, out: Any = None) -> np.ndarray:
        """Return tau (..., n); f_ext (..., 6) is the external wrench at the tool point, in base axes."""

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
        """Return C (..., n, n) from Christoffel symbols."""

    def mass_matrix(self, q: Any, out: Any = None) -> np.ndarray:
        """Return M (..., n, n): column j contains the torques for a unit acceleration of joint j."""

    def momentum(self, q: Any, qd: Any, out: _Pair | None = None) -> _Pair:
        """Return p = M qd and beta = C^T qd (..., n) of the links, without motors.

        With l_i the momentum of links i ... n and V_i the twist of link i, ``p_i = S_i . l_i`` and ``beta_i = l_i .
        (V_i x S_i)``. `rnea` without gravity equals dp/dt - beta, which `MomentumEstimator` uses.
        """

    def energy(self, q: Any, qd: Any, out: _Pair | None = None) -> _Pair:
        """Return the kinetic and potential energy (...) [J]."""

class RotationStepper:
    """Sample-by-sample execution of an orientation primitive.

    Parameters
    ----------
    primitive : primitive with three coordinates and a time phase.

    Raises
    ------
    ShapeError : any other primitive.
    """

    def __init__(self, primitive: Primitive) -> None: ...
    def start(self, q0: Any, w0: Any, goal: Any, map: Any, tau: float) -> None:
        """Start at phase time 0 with orientation (4,), angular velocity (3,), goal (4,) and map (3, 3)."""

    def change_goal(self, goal: Any, map: Any) -> None:
        """Change the goal (4,) and the map (3, 3)."""

    def change_tau(self, tau: float) -> None:
        """Change the time constant [s]."""

    def step(self, dt: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Advance by dt [s]; return q, w, wd."""

    def outputs(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the current q, w and wd."""

    elapsed: float
    tau: float

class RowEncoder:
    """Encoder of rows as message records with index entries, by patching templates.

    Parameters
    ----------
    topics : (channel, always, columns, variants, is_pose) per topic.
        always : whether every row has this message, or only rows with one of its columns.
        columns : (start, nothing, optional) per column: its offset in the row, the bytes of a missing value, and
        whether messages without it have a separate template.
        variants : (message, copies) for each subset of the optional columns, with the first column as the lowest bit.
        copies : (offset in the message, offset in the row, bytes) each. The stamp follows the encapsulation.
        is_pose : whether the only copy converts a homogeneous matrix in the row to position xyz and quaternion xyzw.

    Raises
    ------
    ShapeError : inconsistent topics.
    """

    def __init__(self, topics: Sequence[tuple[Any, ...]]) -> None: ...
    def encode(
        self, rows: Sequence[bytes], first: int | None = None, at: int = 0
    ) -> tuple[bytes, dict[int, bytes], int, int]:
        """Return records, index entries by channel, and the earliest and latest stamp [ns].

        Parameters
        ----------
        rows : at least one row.
        first : sequence number of the first row; None: use the tick numbers of the rows.
        at : offset of the first record in the chunk.

        Raises
        ------
        ShapeError : no rows, or a row that is too short for its columns.
        """

class RowPacker:
    """Packer that writes the data of a tick, stored as attributes of three objects, into one row of bytes.

    Parameters
    ----------
    kinds : classes of the three objects, called "state", "command" and "tick" in `places`: dataclasses with slots or
        named tuples. Objects of other classes are read through their attributes. A command may be None.
    places : consecutive columns of the row: (column, source, field, form, nothing, detail).
        source, field : object and attribute; for source "record", the entry of this name in the attribute `record` of
        the command, else of the tick.
        form : "count" int64; "real" float64; "flag" one byte or int64; "code" the number that the mapping `detail`
        assigns to a text (0 for other texts); "doubles" exactly the column's size, empty or None if missing; "fitting"
        the same, with other sizes treated as missing; "padded" at most the column's size; "bits" exactly the column's
        size in bytes, "wide" exactly the column's size in int64, None if missing; "said" one number or flag, or None;
        "heard" a flag that is missing if it is False and the column `detail` is missing; "blank" reserved space.
        nothing : the bytes of a missing value; for "count", "real", "flag" and "code", only their length is used.
    seldom : name of the first trailing column that a row may omit; these columns are omitted if all are missing.
    """

    def __init__(self, kinds: tuple[type, type, type], places: Sequence[tuple[Any, ...]], seldom: str) -> None: ...
    def pack(self, state: Any, command: Any, tick: Any) -> bytes:
        """Return one row, with copies of the values.

        Raises
        ------
        ShapeError : an array has the wrong number of values; the message names the column.
        AttributeError, TypeError, ValueError, OverflowError : an object or value that cannot be packed.
        """

class SignalOperator:
    """Stateful streaming operator: one output per sample, with the actual time step h since the previous sample.

    ::

        trapezoid    y += h (x + x_prev) / 2          first output init
        euler        y += h x                         first output init + dt x_0
        difference   y = (x - x_prev) / h             first output 0, or (x_0 - init) / dt
        exponential  y = a y + (1 - a) x, a = exp(-h / T)   first output x_0, or one step of dt from init
        lowpass      y'' + 2 z w y' + w^2 y = w^2 x   first output init, or x_0
        slope        y' of lowpass                    first output 0
        notch        x - 2 z / w y' of lowpass        first output x_0

    Second-order operators are solved exactly for an input that is linear between samples. With the slope
    ``s = (x - x_prev) / h`` and the lag ``2 z / w s``, the error ``e = y - x_prev + lag`` and its rate ``u = y' - s``
    follow the unforced system: ``[e; u] <- exp([[0, 1], [-w^2, -2 z w]] h) [e; u]``.

    A non-finite sample gives NaN, leaves the state unchanged and is counted in `skipped`; its time is added to the next
    step. Steps longer than 1.5 dt (1.5 times the first step if dt is NaN) are counted in `gaps`.

    Parameters
    ----------
    kind : operator, one of the names above.
    a : time constant T [s], or angular frequency w [rad/s].
    b : damping ratio z < 1.
    dt : nominal step [s]; NaN if every sample has a time stamp.
    init : None, a number, or an array with the shape of a sample.
    """

    def __init__(self, kind: str, a: float, b: float, dt: float, init: np.ndarray | float | None = None) -> None: ...
    def reset(self, init: np.ndarray | float | None = None) -> None:
        """Discard all samples and restart from `init`."""

    def step(self, x: np.ndarray | float, t: float | None = None) -> np.ndarray | float:
        """Advance by one sample; return the output."""

    def run(self, x: np.ndarray, t: np.ndarray | None = None) -> np.ndarray:
        """Process samples (N, ...); return the outputs stacked over N."""

    gaps: int
    longest_gap: float
    skipped: int

class TwoDof:
    """Two-degree-of-freedom control law (docs/theory/two_dof_dmp.md) of a primitive with one goal.

    Parameters
    ----------
    primitive : spring, basis and weights.
    tau : time constant of the primitive [s].
    y0, g, scale : (n,) start (reference of the position phase), goal, and forcing term factor.
    gains : (5,) kp [1/s^2], kv [1/s], kc, alpha_e [1/s], e_max (may be infinite).
    dead_zone, unit : (n,) dead zone and unit of the error e.

    Raises
    ------
    ShapeError : wrong shapes, more than 32 coordinates, or non-finite or out-of-range numbers.
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
        """Return the state (5 n + 2,) after dt [s].

        Parameters
        ----------
        state : (5 n + 2,) state at the beginning.
        dt : duration [s].
        steps : number of equal steps into which dt is divided, at least 1.
        driven : (n,) externally imposed velocity of ya; NaN for coordinates with ya'' = ya_ref''.
        speed : (3,) v at the beginning and at the end, linear in between, and v' after the end.

        Raises
        ------
        ShapeError : wrong shapes, no steps, or a negative or non-finite dt.
        """

    def reference(self, state: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return yc', yc'' and ya_ref'' (3, n) of a state (5 n + 2,), at the end of `speed` (3,).

        Raises
        ------
        ShapeError : wrong shapes.
        """

    def slopes(self, state: np.ndarray, speed: np.ndarray) -> np.ndarray:
        """Return the time derivative (5 n + 2,) of a state with ya'' = ya_ref'', at the end of `speed` (3,).

        Raises
        ------
        ShapeError : wrong shapes.
        """

    def follow(
        self, state: np.ndarray, dt: float, steps: int, speed: np.ndarray, ya: np.ndarray, yad: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the state after dt [s], given measured ya and ya' (n,), and its `reference`.

        Between samples, ya moves with the previously measured velocity. Non-finite samples are ignored, and ya keeps
        moving.

        Raises
        ------
        ShapeError : as for `advance`.
        """

    def time_constant(self, state: np.ndarray) -> float:
        """Return tau_a [s] of a state (5 n + 2,).

        Raises
        ------
        ShapeError : wrong shape.
        """

    n: int

class WrenchEstimator:
    """Estimator of the contact wrench from joint motion and torque, one sample at a time.

    Parameters
    ----------
    chain : kinematics and dynamics kernel.
    gravity : (3,) gravity in base axes [m/s^2].
    links : (n, 10) link parameters.
    rotor : (n,) rotor inertia.
    drive : friction and ripple of the n joints.
    gains : (n,) ratio of measured to true torque.
    gain_variance : variance of the common factor of all gains.
    covariance : (5, n) rows C0, Cinf, shape, kind (0 exp, 1 step, 2 const), relative uncertainty of the contact torque;
        C0 and Cinf are already scaled.
    bound : (3, n) rows torque, speed and floor of the low-speed friction bound.
    prior : (6,) prior variances of the wrench.
    cutoff : cut-off frequency of the low-pass filter [Hz].
    method : 0 map, 1 bounded, 2 clip, 3 interval, 4 ls, 5 lund, 6 ols.
    point : (3,) contact point in tool axes; None: estimate the full wrench.
    doubt_columns : (n, W) columns of the uncertain parameters of each joint, padded with -1; or None. Columns are
        ordered as links (10 n), rotors (n), and the friction of the joint: viscous, Coulomb per direction, offset,
        Stribeck, root, load.
    doubt_cov : (n, W, W) covariances of these parameters, or None; only the lower triangle is used.
    doubt_mean : (n,) torque variance to subtract, or None.
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
        doubt_columns: np.ndarray | None = None,
        doubt_cov: np.ndarray | None = None,
        doubt_mean: np.ndarray | None = None,
    ) -> None: ...
    def reset(self) -> None:
        """Reset everything except the parameters."""

    def step(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, dt: float) -> tuple[Any, ...]:
        """Advance by one sample.

        Returns F (6,), P (6, 6), observability (6,), filtered tau_e (n,), its variance (n,), flags, active joints (n,)
        and, for the method "interval", the interval (6, 2), else None. A non-finite sample or torque error, or dt <= 0,
        gives NaN everywhere and leaves the state unchanged.
        """

    def run(self, q: np.ndarray, qd: np.ndarray, tau: np.ndarray, dt: np.ndarray) -> tuple[Any, ...]:
        """Step along a record (N, n) with time steps dt (N,); return the outputs of `step` stacked over N."""

def basis_weights(x: np.ndarray, centres: np.ndarray, widths: np.ndarray) -> np.ndarray:
    """Return Gaussians ``exp(-((x - c) / w)^2)`` (N, m), normalised to sum 1; x is clipped to the range of centres.

    Parameters
    ----------
    x : (N,).
    centres, widths : (m,) ascending; positive.
    """

def euler_from_rpy(rpy: Any, first: int, middle: int, last: int, out: Any = None) -> np.ndarray:
    """Return the product of the rotations about the axes `first`, `middle` and `last` (0 x, 1 y, 2 z)."""

def euler_to_rpy(R: Any, first: int, middle: int, last: int, out: Any = None) -> np.ndarray:
    """Return the angles; the first two follow from the rotated last axis, the third after undoing the first."""

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

    Each row is solved from the previous row plus its last step (without the self-motion part), within `change`. If this
    fails, the search continues from random starts around the previous row, then further away, and finally on another
    branch, from the solver's table. Errors are as in `InverseSolver.solve`. Counts are steps, status, and whether the
    row is on another branch. A row with nonzero status breaks the path. If its errors are within the tolerances, `q` is
    a solution beyond the break; otherwise, it is the posture with the smallest error.

    Parameters
    ----------
    solver : the arm and its limits.
    T_base_tool : (N, 4, 4) successive goals.
    q0 : (n,) start of the first row; None: the solver's table.
    change : (n,) largest change of each joint per row, possibly infinite; None: 0.05 rad plus five times the length of
        the pose step.
    task, axis, steps, starts, position_tolerance, rotation_tolerance, damping, objective, scale : as in
        `InverseSolver.solve`; `starts` applies to the search for another branch.
    reference : (n,) or (N, n), as in `InverseSolver.solve`.
    """

def await_datagram(sockets: Sequence[int], poll_ns: int, end_ns: int) -> bool:
    """Wait with the interpreter lock released until a socket is readable; return False on timeout or after a signal.

    The function sleeps until `poll_ns`, then polls until `end_ns`; both are monotonic clock times.
    """

def filled(kind: Any, slots: tuple[Any, ...], values: tuple[Any, ...]) -> Any:
    """Return an instance of a class with its slots filled with the values, without calling the constructor."""

def filtered_velocity(q: np.ndarray, last: np.ndarray, velocity: np.ndarray, dt: float, cutoff: float) -> np.ndarray:
    """Return the read-only velocity (n,) after a step from `last` to `q`, filtered by a first-order low-pass [Hz]."""

def implausible(
    q: np.ndarray, before: np.ndarray | None, bounds: np.ndarray, margin: float, step: float, seconds: float
) -> int:
    """Return i (from 1) if joint i is outside its range, -i if joint i moved too far since `before`, else 0.

    `bounds`: (3, n) lowest positions, highest positions and speeds. A joint is outside its range if it exceeds the
    range by more than `margin`. It moved too far if it moved by more than ``step + speed * seconds``. The result is the
    first non-finite joint or, if there is none, the joint with the largest violation.
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
    """Return speeds ``max(kept * fastest, |speed|)``, the joint furthest from its reference, and whether it is near.

    The joint is near if ``|reference - q| <= allowed + lag * speeds``; all arrays are (n,).
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
    """Return the next reference: position and velocity, active limits, velocity ratio, and rejected joint.

    Let T be the time since the last reference and a the acceleration limit. ``S(d, L)`` is the highest velocity from
    which an arm with lag L can still stop within d, for any length of the next steps: ``S (T + L) + S^2 / (2 a) = d``.
    Braking from S with a is then always sufficient::

        position   v* = v_r + sign(e) S(|e|, 0),  e = q_last - q,  v_r = (q_ref - q_last) / T
                   equal to (q_ref - q) / T if the reference can be followed; otherwise it catches up without overshoot
        velocity   v* = qd_ref;      hold   v* = 0
        v* is scaled by one ratio for all joints so that |v*| <= qd_max
        v  = v* within v_prev +- a T, then within [-S(q - q_min, lag), S(q_max - q, lag)]
        q' = q + v T, kept within the limits; a joint outside them may only move back

    The speed sent is v. If both position and velocity are given, it is qd_ref within v +- a T, subject to the same
    limits.

    Parameters
    ----------
    sent : (3, n) previous reply: position, step velocity, speed.
    bounds : (5, n) q_min, q_max, qd_max, qdd_max, jump; infinite without a limit.
    period : time T since the last reference [s].
    q_ref : (n,) requested position, or None.
    q_last : (n,) previously requested position, or None.
    qd_ref : (n,) requested velocity, or None. Without position and velocity, the arm is brought to rest.
    lag : lag of the arm behind its reference [s]; the margin to the limits is lag times speed.

    Returns
    -------
    (3, n) new `sent`; (n,) uint8 bits (1 position, 2 velocity, 4 acceleration, 8 braking); both are read-only; velocity
    ratio in (0, 1]; 0, or i if joint i (from 1) is not finite, or -i if it jumps by more than ``jump + qd_max T``.
    After a rejected reference, the arm holds.
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
    """Return ``rnea + rotor qdd + drives`` (N, n) along a record, with the presliding state z = 0 at the first row.

    A row with a non-finite number gives NaN and leaves the drive state unchanged.

    Parameters
    ----------
    chain, gravity, links : rigid body as in `Chain.rnea`.
    rotor : (n,) rotor inertia.
    drive : friction and ripple of the n joints.
    q, qd, qdd : (N, n) in time order.
    dt : (N,) step of each row [s]; without it, the drives do not warm up.
    out : (N, n) array for the result.
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
    """Return the state (n+m,) and covariance (n+m, n+m) after a step of h seconds and a momentum measurement.

    This is one step of `MomentumEstimator`, exposed for the tests of the estimator equations.

    Parameters
    ----------
    x, P : state [p; z] and its covariance, both before the step.
    G : (n, m) effect of the hidden inputs on the momentum.
    u : (n,) mean of the known input over the step.
    y : (n,) measured momentum.
    R : (n, n) covariance of the measured momentum.
    h : step [s].
    Qp : (n,) intensity of the torque error [(N m)^2 s].
    q, a : (m,) intensity and leak of the inputs.
    """

def poses(T: Any, name: str) -> np.ndarray:
    """Return poses (..., 4, 4) as float64; raise an error that describes the first invalid pose.

    Parameters
    ----------
    T : (..., 4, 4).
    name : name in error messages.

    Raises
    ------
    ShapeError : a wrong shape, an invalid rotation, or a last row other than (0, 0, 0, 1).
    """

def presliding(q: np.ndarray, delta: np.ndarray, resolution: np.ndarray) -> np.ndarray:
    """Return the presliding state z (N, n) in [-1, 1] along positions `q` (N, n) [rad], from 0 at the first row.

    ``z_k = s + (z_{k-1} - s) exp(-|dy_k| / delta)`` with s = sign(dy_k). y follows q with a backlash of +-resolution,
    so encoder quantisation at rest does not change the state. A row with NaN gives NaN and leaves the state unchanged.

    Parameters
    ----------
    q : (N, n) positions in time order.
    delta : (n,) presliding distance [rad].
    resolution : (n,) half the backlash [rad].
    """

def quaternion_from_matrix(R: Any, out: Any = None) -> np.ndarray:
    """Return the row of 4 q qᵀ with the largest diagonal entry, divided by its length (Shepperd 1978)."""

def quaternion_multiply(p: Any, q: Any, out: Any = None) -> np.ndarray:
    """Return ``(p_w q_w - p_v · q_v, p_w q_v + q_w p_v + p_v × q_v)``."""

def quaternion_slerp(a: Any, b: Any, s: Any, out: Any = None) -> np.ndarray:
    """Return ``(a sin((1-s)Ω) ± b sin(sΩ)) / sin Ω`` with Ω ≤ π/2."""

def quaternion_to_matrix(quaternion: Any, out: Any = None) -> np.ndarray:
    """Return ``I + 2 w hat(v) + 2 hat(v)²`` of the unit quaternion (w, v)."""

def rotation_rollout(
    primitive: Primitive, t: Any, tau: float, q0: Any, w0: Any, goal: Any, map: Any
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return orientations q (N, 4), angular velocities and accelerations (N, 3) at times (N,).

    Parameters
    ----------
    primitive : primitive with three coordinates and a time phase.
    t : (N,) increasing times [s].
    tau : time constant [s].
    q0, goal : (4,) start and goal orientations, wxyz.
    w0 : (3,) angular velocity at the start.
    map : (3, 3) map of the forcing term.

    Raises
    ------
    ShapeError : inconsistent or non-finite arguments.
    """

def rotations(R: Any, name: str) -> np.ndarray:
    """Return rotations (..., 3, 3) as float64; raise an error that describes the first invalid rotation.

    Parameters
    ----------
    R : (..., 3, 3).
    name : name in error messages.

    Raises
    ------
    ShapeError : a wrong shape, ``max|RᵀR - I| > 1e-5``, a negative determinant, or an infinite entry.
    """

def se3_adjoint(T_a_b: Any, out: Any = None) -> np.ndarray:
    """Return ``[[R, hat(p) R], [0, R]]``."""

def se3_exp(xi: Any, out: Any = None) -> np.ndarray:
    """Return ``[[exp(w), V v], [0, 1]]`` with V the left Jacobian of w."""

def se3_interpolate(T_a: Any, T_b: Any, s: Any, screw: bool = False, out: Any = None) -> np.ndarray:
    """Return ``T_a exp(s log(T_a⁻¹ T_b))`` if `screw` is set, else linear positions and `so3_interpolate`."""

def se3_inv(T: Any, out: Any = None) -> np.ndarray:
    """Return ``[[Rᵀ, -Rᵀ p], [0, 1]]``."""

def se3_left_jacobian(xi: Any, out: Any = None) -> np.ndarray:
    """Return ``[[J, Q], [0, J]]`` with J the left Jacobian of w, and Q its derivative in the direction v."""

def se3_left_jacobian_inv(xi: Any, out: Any = None) -> np.ndarray:
    """Return the inverse of `se3_left_jacobian`."""

def se3_log(T: Any, out: Any = None) -> np.ndarray:
    """Return ``[V⁻¹ p; w]`` with V the left Jacobian of w."""

def se3_transform_wrench(T_a_b: Any, wrench_b: Any, out: Any = None) -> np.ndarray:
    """Return ``f_a = R f_b`` and ``m_a = R m_b + p × f_a``."""

def so3_angle(R_a: Any, R_b: Any, out: Any = None) -> np.ndarray:
    """Return ``2 atan2(abs(v), w)`` of the quaternion of ``R_aᵀ R_b``."""

def so3_exp(w: Any, out: Any = None) -> np.ndarray:
    """Return ``I + sin θ/θ hat(w) + 2 sin²(θ/2)/θ² hat(w)²``."""

def so3_interpolate(R_a: Any, R_b: Any, s: Any, out: Any = None) -> np.ndarray:
    """Return ``R_a exp(s log(R_aᵀ R_b))``, computed from the nearer end, so both ends are exact."""

def so3_left_jacobian(w: Any, out: Any = None) -> np.ndarray:
    """Return ``I + (1 - cos θ)/θ² hat(w) + (θ - sin θ)/θ³ hat(w)²``."""

def so3_left_jacobian_inv(w: Any, out: Any = None) -> np.ndarray:
    """Return ``I - hat(w)/2 + (1 - θ/2 cot(θ/2))/θ² hat(w)²``."""

def so3_log(R: Any, out: Any = None) -> np.ndarray:
    """Return ``2 atan2(abs(v), w) v/abs(v)`` of the quaternion (w, v)."""

def solve_wrench(
    A: np.ndarray, error: np.ndarray, variance: np.ndarray, bound: np.ndarray, prior: np.ndarray, method: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int, float, bool]:
    """Return x (k,), its covariance (k, k), active joints (n,), iterations, KKT residual and whether x is undetermined.

    x and its covariance are NaN where the data do not determine them. This is one solution step of `WrenchEstimator`,
    exposed for the tests of the estimator equations.

    Parameters
    ----------
    A : (k, n) rows of the Jacobian for the k unknowns.
    error, variance, bound : (n,) torque errors [N m], positive variances [(N m)^2], non-negative bounds [N m].
    prior : (k,) positive prior variances of the unknowns.
    method : 0 map, 1 bounded, 2 clip, 3 interval, 4 ls, 5 lund, 6 ols.
    """

def wrench_interval(
    A: np.ndarray, error: np.ndarray, spread: np.ndarray, box: np.ndarray
) -> tuple[np.ndarray | None, np.ndarray]:
    """Return the smallest and largest value (k, 2) of each unknown in {x : |error - A^T x| <= spread, |x| <= box}.

    If the set is empty, the values are None, and the mask (n,) marks contradictory joints. The values are NaN if torque
    errors or rows of the Jacobian are non-finite.

    Parameters
    ----------
    A : (k, n) rows of the Jacobian.
    error, spread : (n,) torque errors and their largest deviations [N m].
    box : (k,) largest absolute values of the unknowns.
    """
