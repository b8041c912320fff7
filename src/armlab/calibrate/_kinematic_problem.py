"""Residuals of a kinematic calibration with their Jacobian, for one arm and any kinds of measurement.

Position residuals are differences in the measurement frame, rotations are ``Log(R^T R_measured)``, never the twist in
the base frame: that turns noise of rotation into noise of position through the lever arm.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from armlab.calibrate._arm import Arm, ArmState, Motion, frame_steps
from armlab.calibrate._kinematic_data import Kind
from armlab.estimation import Measurement
from armlab.lie import se3, so3

HARMONIC_PRIOR = np.radians(0.1)  # without it amplitudes run to degrees against the geometry


class State(NamedTuple):
    """The unknowns: the arm, points (K, 3) in tool axes, anchor (3,), offset and scale (2,) of lengths."""

    arm: ArmState
    points: np.ndarray
    anchor: np.ndarray
    length: np.ndarray


@dataclass(frozen=True, eq=False)
class KinematicProblem:
    """One arm, what was measured, and which unknowns there are.

    Attributes
    ----------
    arm : the arm. kinds : what was measured. active : (d,) mask of the components of a step.
    points : number of tool points that are unknown. prior : (metres, radians) of the links, or None.
    """

    arm: Arm
    kinds: tuple[Kind, ...]
    active: np.ndarray
    points: int
    prior: tuple[float, float] | None

    @cached_property
    def size(self) -> int:
        """Number of unknowns, gauge included: arm, points, anchor, offset and scale of lengths."""
        return self.arm.size + 3 * self.points + 5

    @property
    def waves(self) -> int:
        """Number of amplitudes."""
        return self.arm.waves[0].size

    @property
    def tool_held(self) -> bool:
        """True where several tool points are all that is known of the tool: they move, its frame does not."""
        return self.points > 0 and all(kind.name == "position" for kind in self.kinds)

    @property
    def names(self) -> tuple[str, ...]:
        """Name of every unknown."""
        points = [f"point {k + 1} {letter}" for k in range(self.points) for letter in "xyz"]
        return (*self.arm.names, *points, "anchor x", "anchor y", "anchor z", "length offset", "length scale")

    @property
    def units(self) -> tuple[str, ...]:
        """Unit of every unknown."""
        return (*self.arm.units, *("m",) * (3 * self.points + 4), "-")

    def sizes(self, length: float, angle: float) -> np.ndarray:
        """Return (d,) a length for metres, an angle for radians and for the scale of lengths."""
        lengths = np.full(3 * self.points + 4, length)
        return np.concatenate([self.arm.sizes(length, angle), lengths, [angle]])

    def values(self, state: State) -> np.ndarray:
        """Return all unknowns (d,); frames by the twists that lead to them from the start."""
        arm = state.arm
        twists = self.arm.corrections(arm.frames).ravel()
        joints = [arm.amplitudes.ravel(), arm.coefficients]
        return np.concatenate([twists, *joints, state.points.ravel(), state.anchor, state.length])

    def gauge(self, state: State, used: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
        """Return directions (d, g) that nothing sees and that move what is used only, and their names."""
        arm, a = self.arm, self.arm.size
        inner, names = arm.gauge(state.arm.frames)
        G = np.zeros((self.size, len(names)))
        G[:a] = inner
        if self.tool_held:  # what goes through the last joint reaches the points, not the tool
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
        """Return the state after a step of the active components."""
        x = np.zeros(self.size)
        x[self.active] = y
        a, b = self.arm.size, self.arm.size + 3 * self.points
        moved = self.arm.plus(state.arm, x[:a])
        return State(
            moved, state.points + x[a:b].reshape(-1, 3), state.anchor + x[b : b + 3], state.length + x[b + 3 :]
        )

    def evaluate(self, state: State) -> list[Measurement]:
        """Return residuals with their derivatives by the active components."""
        found = [chosen(one, self.active) for one in self.measurements(state)]
        return [*found, *(chosen(one, self.active) for one in self.priors(state))]

    def measurements(self, state: State, local: bool = False) -> list[Measurement]:
        """Return residuals of the data with their derivatives by all components.

        Parameters
        ----------
        local : derivatives by steps of the frames, whatever the chart.
        """
        motion = self.arm.move(state.arm)
        J = self.arm.jacobian(state.arm, motion.P, motion.T[:, :3, 3], local)
        found: list[Measurement] = []
        for kind in self.kinds:
            make = {"pose": self._pose, "position": self._position, "distance": self._distance}.get(kind.name)
            found += [self._pair(kind, state, motion, J)] if make is None else make(kind, state, motion, J, local)
        return found

    def priors(self, state: State, local: bool = False) -> Iterator[Measurement]:
        """Yield what is known before: amplitudes are small; links are nearly nominal, if they are to be held."""
        arm, d = self.arm, self.size
        if arm.orders:
            yield amplitude_prior(arm, state.arm, d)
        if self.prior is not None and arm.n > 1:
            yield link_prior(arm, state.arm, self.prior, d, local=local)

    def _pose(self, kind: Kind, state: State, motion: Motion, J: np.ndarray, local: bool) -> list[Measurement]:
        rows, T, measured = np.flatnonzero(kind.visible), motion.T, kind.values
        if len(rows) < len(T):
            T, measured, J = T[rows], measured[rows], J[rows]
        r, J = pose_residual(T, measured, J)
        if len(kind.kept) < 6:
            r, J = r[:, kind.kept], J[:, kind.kept]
        return [Measurement(r, self._wide(J), kind.noise(rows), kind.classes, rows)]

    def _position(self, kind: Kind, state: State, motion: Motion, J: np.ndarray, local: bool) -> list[Measurement]:
        found = []
        for k in range(kind.values.shape[1]):
            rows, T = np.flatnonzero(kind.visible[:, k]), motion.T
            if not self.points:
                r, wide = kind.values[rows, 0] - T[rows, :3, 3], self._wide(-J[rows, :3])
            else:
                point = T[:, :3, 3] + T[:, :3, :3] @ state.points[k]
                r = (kind.values[:, k] - point)[rows]
                wide = self._wide(-self.arm.jacobian(state.arm, motion.P, point, local)[rows, :3])
                a = self.arm.size + 3 * k
                wide[:, :, a : a + 3] = -T[rows, :3, :3]
            found.append(Measurement(r[:, kind.kept], wide[:, kind.kept], kind.noise(rows), kind.classes, rows))
        return found

    def _distance(self, kind: Kind, state: State, motion: Motion, J: np.ndarray, local: bool) -> list[Measurement]:
        rows = np.flatnonzero(kind.visible)
        away = motion.T[rows, :3, 3] - state.anchor
        length, along = _lengths(away)
        wide = self._wide(-state.length[1] * (along[:, None] @ J[rows, :3]))
        b = self.arm.size + 3 * self.points
        wide[:, 0, b : b + 3] = state.length[1] * along
        r = _instrument(wide, kind.values[rows], length, state.length)
        return [Measurement(r, wide, kind.noise(rows), kind.classes, rows)]

    def _pair(self, kind: Kind, state: State, motion: Motion, J: np.ndarray) -> Measurement:
        rows = np.flatnonzero(kind.visible)
        i, j = (np.zeros((2, 0), dtype=int) if kind.pairs is None else kind.pairs)[:, rows]
        length, along = _lengths(motion.T[i, :3, 3] - motion.T[j, :3, 3])
        wide = self._wide(-state.length[1] * (along[:, None] @ (J[i, :3] - J[j, :3])))
        r = _instrument(wide, kind.values[rows], length, state.length)
        return Measurement(r, wide, kind.noise(rows), kind.classes, rows + self.first_pair)

    @property
    def first_pair(self) -> int:
        """Number of the first pair among samples: they come after the rows of q, or alone."""
        return 0 if all(kind.name == "pair_distance" for kind in self.kinds) else len(self.arm.q)

    def _wide(self, J: np.ndarray) -> np.ndarray:
        """Return derivatives by the arm with zeros for the other unknowns."""
        wide = np.zeros((*J.shape[:2], self.size))
        wide[:, :, : J.shape[2]] = J
        return wide


def pose_residual(T: np.ndarray, measured: np.ndarray, J: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return residuals (N, 6) of poses and their derivatives, from the motion J (N, 6, d) of the tool, base axes."""
    R = T[:, :3, :3].transpose(0, 2, 1)
    turn = so3.log(R @ measured[:, :3, :3])
    r = np.concatenate([measured[:, :3, 3] - T[:, :3, 3], turn], axis=1)
    moved = np.empty_like(J)
    np.negative(J[:, :3], out=moved[:, :3])
    np.matmul(-(so3.left_jacobian_inv(turn) @ R), J[:, 3:], out=moved[:, 3:])
    return r, moved


def amplitude_prior(arm: Arm, state: ArmState, size: int, at: int = 0) -> Measurement:
    """Return the prior on the amplitudes of harmonics; the arm's unknowns begin at `at`."""
    first = at + 6 * (arm.n + 1)
    J = np.eye(size)[first : first + state.amplitudes.size, None]
    cov = np.full(1, HARMONIC_PRIOR**2)
    return Measurement(state.amplitudes.reshape(-1, 1), J, cov, ("prior",), prior=True)


def link_prior(
    arm: Arm, state: ArmState, prior: tuple[float, float], size: int, at: int = 0, local: bool = False
) -> Measurement:
    """Return the prior on the frames between the joints, none on base and tool; the arm's unknowns begin at `at`."""
    twists = arm.corrections(state.frames)[1:-1]
    steps = np.eye(6 * (arm.n + 1)) if local or arm.chart == "local_poe" else frame_steps(state.frames)
    J = np.zeros((arm.n - 1, 6, size))
    J[:, :, at : at + len(steps)] = se3.left_jacobian_inv(-twists) @ steps[6:-6].reshape(arm.n - 1, 6, -1)
    cov = np.repeat(np.square(prior), 3)
    return Measurement(twists, J, cov, ("prior",) * 6, prior=True)


def _mixture(row: np.ndarray, names: Sequence[str]) -> str:
    """Name a combination by its largest parts."""
    order = [int(i) for i in np.argsort(-np.abs(row))]
    return " with ".join(names[i] for i in order[:3] if abs(row[i]) > 0.3 * abs(row[order[0]]))


def chosen(one: Measurement, active: np.ndarray) -> Measurement:
    return Measurement(one.r, one.J[:, :, active], one.cov, one.classes, one.sample, one.prior)


def _lengths(away: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    length = np.linalg.norm(away, axis=1)
    return length, away / np.where(length > 0, length, 1.0)[:, None]


def _instrument(wide: np.ndarray, measured: np.ndarray, length: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Write the derivatives by offset and scale into the last two columns; return the residuals (N, 1)."""
    wide[:, 0, -2], wide[:, 0, -1] = -1.0, -length
    return (measured - known[1] * length - known[0])[:, None]
