"""Kinematic calibration model: unknowns of one arm, and residuals with Jacobian for all kinds of measurement.

The frames E_j are those of `robots.Robot`, with joint axes z: ``T = E_0 Z_1 E_1 ... Z_n E_n``. A step moves each frame
to ``E_j Exp([v; w])``. A motion that commutes with Z_j can be moved from E_{j-1} to E_j without effect (gauge).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from armlab.calibrate.kinematics.measurements import Kind
from armlab.estimation import Measurement
from armlab.kernels import Chain
from armlab.kinematics.forward import frame_poses, twist_jacobian
from armlab.lie import se3, so3
from armlab.models.kinematic_correction import harmonic_basis
from armlab.robots import Robot

# Components of [v; w] that commute with a revolute (False) and with a prismatic (True) joint.
GAUGE: dict[bool, tuple[int, ...]] = {False: (2, 5), True: (0, 1, 2, 5)}
SMALLEST_ROUNDS, SMALLEST_STEP = 20, 1e-12  # to the nearest equivalent frames: maximum steps, step at convergence
TWIST = ("vx", "vy", "vz", "wx", "wy", "wz")
HARMONIC_PRIOR = np.radians(0.1)  # prevents amplitudes of several degrees that compensate for geometric errors


class ArmState(NamedTuple):
    """Unknowns of an arm: frames (n+1, 4, 4), amplitudes (n, 2 m) of harmonics, coefficients (L,) of joint terms."""

    frames: np.ndarray
    amplitudes: np.ndarray
    coefficients: np.ndarray


@dataclass(frozen=True, eq=False)
class Arm:
    """Nominal arm and its samples."""

    robot: Robot  # nominal
    start: np.ndarray  # (n+1, 4, 4) nominal frames; the first may be moved to the measurement frame
    q: np.ndarray  # (N, n) joint positions
    waves: np.ndarray  # (N, n, 2 m) harmonics at q
    terms: np.ndarray  # (N, n, L) joint terms
    orders: tuple[int, ...]  # orders of the harmonics
    chart: str = "local_poe"  # steps move the frames; "poe": steps move the base-frame screws and the home pose

    @classmethod
    def of(cls, robot: Robot, q: np.ndarray, orders: tuple[int, ...], terms: np.ndarray, chart: str) -> Arm:
        return cls(robot, np.array(robot.frames), q, harmonic_basis(q, orders), terms, orders, chart)

    @cached_property
    def n(self) -> int:
        return self.robot.n

    @cached_property
    def size(self) -> int:
        """Number of unknowns, including the gauge."""
        return 6 * (self.n + 1) + self.waves[0].size + self.terms.shape[2]

    @cached_property
    def names(self) -> tuple[str, ...]:
        places = ["base", *(f"link {j}" for j in range(1, self.n)), "tool"]
        frames = [f"{place} {letter}" for place in places for letter in TWIST]
        waves = [f"{what} {k}q" for k in self.orders for what in ("cos", "sin")]
        joints = [f"joint {j + 1} {wave}" for j in range(self.n) for wave in waves]
        return (*frames, *joints, *(f"joint term {i + 1}" for i in range(self.terms.shape[2])))

    @cached_property
    def units(self) -> tuple[str, ...]:
        """Units of the unknowns; for joint terms, rad (or m) per unit of the term."""
        twists = (*("m",) * 3, *("rad",) * 3) * (self.n + 1)
        return (*twists, *("rad",) * self.waves[0].size, *("rad/unit",) * self.terms.shape[2])

    def sizes(self, length: float, angle: float) -> np.ndarray:
        """Return limits (d,): `length` for metres, `angle` for radians, and the equivalent angle for joint terms."""
        twists = np.tile([*(length,) * 3, *(angle,) * 3], self.n + 1)
        parts = [twists, np.full(self.waves[0].size, angle)]
        if self.terms.shape[2]:
            rms = np.sqrt(np.mean(self.terms**2, axis=(0, 1)))
            parts.append(angle / np.where(rms > 0, rms, 1.0))
        return np.concatenate(parts)

    @cached_property
    def unbound(self) -> np.ndarray:
        """Mask (d,) of the unknowns without the gauge; excludes frame motion that commutes with the next joint."""
        kept = np.ones(self.size, dtype=bool)
        for j, slides in enumerate(self.robot.prismatic):
            kept[[6 * j + k for k in GAUGE[bool(slides)]]] = False
        return kept & self.existing

    @cached_property
    def existing(self) -> np.ndarray:
        """Mask (d,) of all unknowns except the harmonics of prismatic joints."""
        kept = np.ones(self.size, dtype=bool)
        waves = np.repeat(~self.robot.prismatic, self.waves.shape[2])
        kept[6 * (self.n + 1) : 6 * (self.n + 1) + len(waves)] = waves
        return kept

    def first(self) -> ArmState:
        return ArmState(self.start, np.zeros(self.waves.shape[1:]), np.zeros(self.terms.shape[2]))

    def plus(self, state: ArmState, x: np.ndarray) -> ArmState:
        frames = se3.exp(x[: 6 * (self.n + 1)].reshape(-1, 6))
        waves = x[6 * (self.n + 1) : self.size - self.terms.shape[2]].reshape(self.waves.shape[1:])
        moved = state.frames @ frames if self.chart == "local_poe" else _turned(state.frames, frames)
        terms = x[self.size - self.terms.shape[2] : self.size]
        return ArmState(moved, state.amplitudes + waves, state.coefficients + terms)

    def move(self, state: ArmState) -> np.ndarray:
        """Return the poses of the frames for every sample (N, n+1, 4, 4); the last frame is the tool."""
        q = self.q
        if self.orders:
            q = q + np.sum(self.waves * state.amplitudes, axis=2)
        if self.terms.shape[2]:
            q = q + self.terms @ state.coefficients
        return frame_poses(Chain(state.frames, self.robot.prismatic), state.frames, q)

    def jacobian(self, state: ArmState, P: np.ndarray, point: np.ndarray, local: bool = False) -> np.ndarray:
        """Return the Jacobian (N, 6, d) of points (N, 3) on the tool, in axes of P; `local`: with respect to steps of
        the frames."""
        J = twist_jacobian(P, point)
        turning = J[:, :, np.arange(self.n), np.where(self.robot.prismatic, 2, 5)]
        flat = J.reshape(len(P), 6, -1)
        parts = [flat if local or self.chart == "local_poe" else flat @ frame_steps(state.frames)]
        if self.orders:
            parts.append((turning[..., None] * self.waves[:, None]).reshape(len(P), 6, -1))
        if self.terms.shape[2]:
            parts.append(turning @ self.terms)
        return parts[0] if len(parts) == 1 else np.concatenate(parts, axis=2)

    def gauge(self, frames: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
        """Return the unobservable directions (d, g) for the given frames, and their names."""
        joints, parts, names = self.moving
        back, count = se3.adjoint_inv(frames[1:]), np.arange(len(joints))
        G = np.zeros((self.size, len(joints)))
        G[6 * joints + parts, count] = 1.0
        G[6 * (joints + 1)[:, None] + np.arange(6), count[:, None]] = -back[joints, :, parts]
        return G, names

    @cached_property
    def moving(self) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
        """Joint, component and name (g,) of each twist that can be moved across a joint without effect."""
        joints, parts, names = [], [], []
        for j, slides in enumerate(self.robot.prismatic):
            for k in GAUGE[bool(slides)]:
                verb = "rotate about" if k == 5 else "translate along" if k == 2 else f"shift {'xy'[k]} of"
                joints.append(j)
                parts.append(k)
                names.append(f"{verb} the axis of joint {j + 1}")
        return np.array(joints), np.array(parts), tuple(names)

    def corrections(self, frames: np.ndarray) -> np.ndarray:
        return se3.log(se3.inv(self.start) @ frames)

    def smallest(self, frames: np.ndarray, base: np.ndarray, tool: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the equivalent frames nearest to the initial frames, and the resulting motion of the base (4, 4).

        `base` (6, b), in measurement axes, and `tool` (6, t) are the unobservable twists of the base and of the tool.
        """
        frames, whole = np.array(frames), np.eye(4)
        rows, columns, _ = self.moving
        for _ in range(SMALLEST_ROUNDS):
            base_steps, tool_steps = (np.zeros((6 * len(frames), one.shape[1])) for one in (base, tool))
            base_steps[:6], tool_steps[-6:] = se3.adjoint_inv(frames[0]) @ base, tool
            G = np.hstack([self.gauge(frames)[0][: len(base_steps)], base_steps, tool_steps])
            _, s, V = np.linalg.svd(G, full_matrices=False)
            W = V[s > 1e-9 * s[0]].T / s[s > 1e-9 * s[0]]  # W W^T = (G^T G)^+
            step = -W @ (W.T @ (G.T @ self.corrections(frames).ravel()))
            twists, turned = np.zeros((self.n, 6)), len(rows) + base.shape[1]
            twists[rows, columns] = step[: len(rows)]
            frames[:-1] = frames[:-1] @ se3.exp(twists)
            frames[1:] = se3.exp(-twists) @ frames[1:]
            move = se3.exp(base @ step[len(rows) : turned])
            frames[0], whole = move @ frames[0], move @ whole
            frames[-1] = frames[-1] @ se3.exp(tool @ step[turned:])
            if np.abs(step).max() < SMALLEST_STEP:
                break
        return frames, whole

    def corrected(self, frames: np.ndarray) -> Robot:
        """Return the robot with the given frames; gravity rotates with the base."""
        robot = self.robot
        links = np.array(robot.links)
        links[1:-1] = frames[1:-1]
        T_base_mount = frames[0] @ se3.inv(links[0])
        turn = T_base_mount[:3, :3] @ robot.T_base_mount[:3, :3].T
        return replace(
            robot,
            links=links,
            T_base_mount=T_base_mount,
            T_flange_tool=se3.inv(links[-1]) @ frames[-1],
            gravity=turn @ robot.gravity,
            source=f"{robot.source}; corrected by armlab.calibrate".lstrip("; "),
        )


def frame_steps(frames: np.ndarray) -> np.ndarray:
    """Return the matrix (d, d) that converts steps of the base-frame screws and the home pose to frame steps.

    With ``C_j = E_0 ... E_j``, the screw of joint j + 1 is ``Ad(C_j) e_z``. Steps ``C_j Exp(x_j)`` for all j change the
    frames to ``E_j Exp(x_j - Ad(E_j^-1) x_{j-1})``.
    """
    m = len(frames)
    steps = np.eye(6 * m)
    for j, back in enumerate(se3.adjoint_inv(frames[1:]), start=1):
        steps[6 * j : 6 * j + 6, 6 * j - 6 : 6 * j] = -back
    return steps


def _turned(frames: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return the frames (n+1, 4, 4) after steps of the products E_0 ... E_j, each in its own axes."""
    moved = np.empty_like(frames)
    moved[0] = frames[0] @ steps[0]
    moved[1:] = se3.inv(steps[:-1]) @ frames[1:] @ steps[1:]
    return moved


class State(NamedTuple):
    """Unknowns: the arm, points (K, 3) in tool axes, anchor (3,), and length offset and scale (2,)."""

    arm: ArmState
    points: np.ndarray
    anchor: np.ndarray
    length: np.ndarray


@dataclass(frozen=True, eq=False)
class KinematicProblem:
    """One arm with its measurements and unknowns."""

    arm: Arm
    kinds: tuple[Kind, ...]  # measurements
    active: np.ndarray  # (d,) mask of the components of a step
    points: int  # number of unknown tool points
    prior: tuple[float, float] | None  # standard deviations (metres, radians) of the links; None: no prior

    @cached_property
    def size(self) -> int:
        """Number d of unknowns, including the gauge: arm, points, anchor, length offset and scale."""
        return self.arm.size + 3 * self.points + 5

    @property
    def n(self) -> int:
        return len(self.arm.q)

    @property
    def rows(self) -> int:
        """Number of residual rows: one per sample, then one per pair."""
        return self.first_pair + max((len(kind.values) for kind in self.kinds if kind.pairs is not None), default=0)

    @property
    def waves(self) -> int:
        return self.arm.waves[0].size

    @property
    def tool_held(self) -> bool:
        """Whether several tool points alone define the tool; the fit then moves the points, not the tool frame."""
        return self.points > 0 and all(kind.name == "position" for kind in self.kinds)

    @property
    def names(self) -> tuple[str, ...]:
        points = [f"point {k + 1} {letter}" for k in range(self.points) for letter in "xyz"]
        return (*self.arm.names, *points, "anchor x", "anchor y", "anchor z", "length offset", "length scale")

    @property
    def units(self) -> tuple[str, ...]:
        return (*self.arm.units, *("m",) * (3 * self.points + 4), "-")

    def sizes(self, length: float, angle: float) -> np.ndarray:
        """Return limits (d,): `length` for metres, `angle` for radians and for the length scale."""
        lengths = np.full(3 * self.points + 4, length)
        return np.concatenate([self.arm.sizes(length, angle), lengths, [angle]])

    def values(self, state: State) -> np.ndarray:
        """Return all unknowns (d,); frames are twists relative to the start."""
        arm = state.arm
        twists = self.arm.corrections(arm.frames).ravel()
        joints = [arm.amplitudes.ravel(), arm.coefficients]
        return np.concatenate([twists, *joints, state.points.ravel(), state.anchor, state.length])

    def gauge(self, state: State, used: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
        """Return the unobservable directions (d, g) in the space of the fitted unknowns, and their names."""
        arm, a = self.arm, self.arm.size
        inner, names = arm.gauge(state.arm.frames)
        G = np.zeros((self.size, len(names)))
        G[:a] = inner
        if self.tool_held:  # gauge motion across the last joint moves the points
            tool = G[6 * arm.n : 6 * arm.n + 6].copy()
            G[6 * arm.n : 6 * arm.n + 6] = 0.0
            for k, point in enumerate(state.points):
                G[a + 3 * k : a + 3 * k + 3] = tool[:3] + np.cross(tool[3:].T, point).T
        out = G[~used]
        if not np.abs(out).max(initial=0.0) > 0:
            return G, names
        _, singular, rows = np.linalg.svd(out)
        mixed = rows[np.count_nonzero(singular > 1e-9) :]
        return G @ mixed.T, tuple(_mixture(row, names) for row in mixed)

    def retract(self, state: State, y: np.ndarray) -> State:
        x = np.zeros(self.size)
        x[self.active] = y
        a, b = self.arm.size, self.arm.size + 3 * self.points
        moved = self.arm.plus(state.arm, x[:a])
        return State(
            moved, state.points + x[a:b].reshape(-1, 3), state.anchor + x[b : b + 3], state.length + x[b + 3 :]
        )

    def evaluate(self, state: State) -> list[Measurement]:
        found = [chosen(one, self.active) for one in self.measurements(state)]
        return [*found, *(chosen(one, self.active) for one in self.priors(state))]

    def measurements(self, state: State, local: bool = False) -> list[Measurement]:
        """Return the residuals and their derivatives with respect to all unknowns (if `local`, with respect to
        increments of the frames)."""
        P = self.arm.move(state.arm)
        J = self.arm.jacobian(state.arm, P, P[:, -1, :3, 3], local)
        found: list[Measurement] = []
        for kind in self.kinds:
            if kind.name == "pose":
                found.append(self._pose(kind, P[:, -1], J))
            elif kind.name == "position":
                found += self._position(kind, state, P, J, local)
            else:
                found.append(self._length(kind, state, P[:, -1, :3, 3], J[:, :3]))
        return found

    def priors(self, state: State, local: bool = False) -> Iterator[Measurement]:
        """Yield the priors on the amplitudes and, if requested, on the links."""
        arm, d = self.arm, self.size
        if arm.orders:
            yield amplitude_prior(arm, state.arm, d)
        if self.prior is not None and arm.n > 1:
            yield link_prior(arm, state.arm, self.prior, d, local=local)

    def _pose(self, kind: Kind, T: np.ndarray, J: np.ndarray) -> Measurement:
        rows = np.flatnonzero(kind.visible)
        r, J = pose_residual(T[rows], kind.values[rows], J[rows])
        return Measurement(r[:, kind.kept], self._wide(J[:, kind.kept]), kind.noise(rows), kind.classes, rows)

    def _position(self, kind: Kind, state: State, P: np.ndarray, J: np.ndarray, local: bool) -> list[Measurement]:
        found, T = [], P[:, -1]
        for k in range(kind.values.shape[1]):
            rows = np.flatnonzero(kind.visible[:, k])
            if not self.points:
                r, wide = kind.values[rows, 0] - T[rows, :3, 3], self._wide(-J[rows, :3])
            else:
                point = T[:, :3, 3] + T[:, :3, :3] @ state.points[k]
                r = (kind.values[:, k] - point)[rows]
                wide = self._wide(-self.arm.jacobian(state.arm, P, point, local)[rows, :3])
                a = self.arm.size + 3 * k
                wide[:, :, a : a + 3] = -T[rows, :3, :3]
            found.append(Measurement(r[:, kind.kept], wide[:, kind.kept], kind.noise(rows), kind.classes, rows))
        return found

    def _length(self, kind: Kind, state: State, p: np.ndarray, J: np.ndarray) -> Measurement:
        """Return the distance residuals of tool points p (N, 3) to the anchor or, for pairs, to each other."""
        rows, (offset, scale) = np.flatnonzero(kind.visible), state.length
        if kind.pairs is None:
            sample, away, moved = rows, p[rows] - state.anchor, J[rows]
        else:
            i, j = kind.pairs[:, rows]
            sample, away, moved = rows + self.first_pair, p[i] - p[j], J[i] - J[j]
        length = np.linalg.norm(away, axis=1)
        along = away / np.where(length > 0, length, 1.0)[:, None]
        wide = self._wide(-scale * (along[:, None] @ moved))
        if kind.pairs is None:
            b = self.arm.size + 3 * self.points
            wide[:, 0, b : b + 3] = scale * along
        wide[:, 0, -2], wide[:, 0, -1] = -1.0, -length
        r = (kind.values[rows] - scale * length - offset)[:, None]
        return Measurement(r, wide, kind.noise(rows), kind.classes, sample)

    @property
    def first_pair(self) -> int:
        """Sample index of the first pair, after the rows of q."""
        return 0 if all(kind.name == "pair_distance" for kind in self.kinds) else len(self.arm.q)

    def _wide(self, J: np.ndarray) -> np.ndarray:
        """Return the derivatives with respect to the arm, padded with zeros for the other unknowns."""
        wide = np.zeros((*J.shape[:2], self.size))
        wide[:, :, : J.shape[2]] = J
        return wide


def pose_residual(T: np.ndarray, measured: np.ndarray, J: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the residuals (N, 6) of poses and their derivatives, given the pose Jacobian J (N, 6, d) in base axes."""
    R = T[:, :3, :3].transpose(0, 2, 1)
    turn = so3.log(R @ measured[:, :3, :3])
    r = np.concatenate([measured[:, :3, 3] - T[:, :3, 3], turn], axis=1)
    moved = np.empty_like(J)
    np.negative(J[:, :3], out=moved[:, :3])
    np.matmul(-(so3.left_jacobian_inv(turn) @ R), J[:, 3:], out=moved[:, 3:])
    return r, moved


def amplitude_prior(arm: Arm, state: ArmState, size: int, at: int = 0) -> Measurement:
    """Return the prior on the amplitudes of the harmonics; the unknowns of the arm begin at index `at`."""
    first = at + 6 * (arm.n + 1)
    J = np.eye(size)[first : first + state.amplitudes.size, None]
    cov = np.full(1, HARMONIC_PRIOR**2)
    return Measurement(state.amplitudes.reshape(-1, 1), J, cov, ("prior",), prior=True)


def link_prior(
    arm: Arm, state: ArmState, prior: tuple[float, float], size: int, at: int = 0, local: bool = False
) -> Measurement:
    """Return the prior on the links, excluding base and tool; the unknowns of the arm begin at index `at`."""
    twists = arm.corrections(state.frames)[1:-1]
    steps = np.eye(6 * (arm.n + 1)) if local or arm.chart == "local_poe" else frame_steps(state.frames)
    J = np.zeros((arm.n - 1, 6, size))
    J[:, :, at : at + len(steps)] = se3.left_jacobian_inv(-twists) @ steps[6:-6].reshape(arm.n - 1, 6, -1)
    cov = np.repeat(np.square(prior), 3)
    return Measurement(twists, J, cov, ("prior",) * 6, prior=True)


def _mixture(row: np.ndarray, names: Sequence[str]) -> str:
    """Return the names of the largest components of a combination."""
    order = [int(i) for i in np.argsort(-np.abs(row))]
    return " with ".join(names[i] for i in order[:3] if abs(row[i]) > 0.3 * abs(row[order[0]]))


def chosen(one: Measurement, active: np.ndarray) -> Measurement:
    return Measurement(one.r, one.J[:, :, active], one.cov, one.classes, one.sample, one.prior)
