"""The most likely poses of all frames of a graph, given all measured poses between them.

With X_a the pose of frame a in the first frame, the pose E_k measured between a and b has the residuals

    r_t = p_E - R_a^T (p_b - p_a)          along the axes of a
    r_R = Log(R_b^T R_a R_E)               along the axes of b

minimised together, whitened by the covariance of E_k, by Gauss-Newton over the poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armlab._numbers import still
from armlab.errors import FrameError
from armlab.estimation import Fit, Measurement, NonlinearProblem, check_spread, nonlinear_least_squares
from armlab.frames import loops
from armlab.frames.loops import Edge
from armlab.lie import se3, so3

__all__ = ["FrameSet", "solve"]

CLASSES = ("position",) * 3 + ("rotation",) * 3
LIMIT = 0.2  # rad, and share of the size of the set [m]
PARTS = (("x", "m"), ("y", "m"), ("z", "m"), ("turn x", "rad"), ("turn y", "rad"), ("turn z", "rad"))


@dataclass(frozen=True, eq=False)
class FrameSet:
    """Poses of named frames that agree with each other.

    Attributes
    ----------
    names : of the frames. T : (F, 4, 4) their poses in the first of them [m].
    """

    names: tuple[str, ...]
    T: np.ndarray

    def __post_init__(self) -> None:
        """Freeze the poses."""
        T = still(self.T, "poses T of frames")
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "T", T)

    def get(self, a: str, b: str) -> np.ndarray:
        """Return the pose (4, 4) of b in a.

        Parameters
        ----------
        a, b : names of frames.

        Raises
        ------
        FrameError : an unknown name, with those that are known.
        """
        for name in (a, b):
            if name not in self.names:
                raise FrameError(f"Expected the name of a known frame, got {name!r}. Known: {', '.join(self.names)}.")
        return se3.inv(self.T[self.names.index(a)]) @ self.T[self.names.index(b)]


def solve(edges: Sequence[Edge], names: Sequence[str], robust: bool = False) -> Fit[FrameSet]:
    """Return the most likely poses; see `Graph.solve`.

    Parameters
    ----------
    edges : measured poses. names : of the frames. robust : find poses that do not fit the others.
    """
    start = _start(edges, names)
    given = [edge.cov is not None for edge in edges]
    if any(given) and not all(given):
        missing = ", ".join(edge.text() for edge, known in zip(edges, given) if not known)
        raise FrameError(f"Expected covariances of all poses or of none, got none of {missing}. Say how sure they are.")
    problem = _problem(edges, names)
    found = nonlinear_least_squares(problem, start, robust=robust)
    size = float(np.linalg.norm(found.value[:, :3, 3].std(axis=0)))
    labels = [(f"{name} {part}", unit) for name in names[1:] for part, unit in PARTS]
    limits = np.array([LIMIT * (1.0 if unit == "rad" else size or 1.0) for _, unit in labels])
    excitation = check_spread(
        found.rows.J, [name for name, _ in labels], [unit for _, unit in labels], limits, "frames"
    )
    R = found.value[1:, :3, :3]
    parameters = np.hstack([found.value[1:, :3, 3], so3.log(R)]).ravel()
    residuals = problem.evaluate(found.value)[0].r
    return Fit(
        value=FrameSet(tuple(names), found.value),
        names=tuple(name for name, _ in labels),
        units=tuple(unit for _, unit in labels),
        parameters=parameters,
        cov=found.cov,
        sigma=found.sigma,
        residuals=residuals,
        n=len(edges) - int(found.outliers.sum()),
        excitation=excitation,
        summary=lambda fit: _report(fit, [edge.text() for edge in edges]),
        outliers=found.outliers,
        classes=("position [m]", "rotation [rad]"),
    )


def _start(edges: Sequence[Edge], names: Sequence[str]) -> np.ndarray:
    """Return the poses (F, 4, 4) along the fewest measured ones."""
    if not edges:
        raise FrameError("Expected poses between frames, got none. Graph.add takes them.")
    start = np.zeros((len(names), 4, 4))
    for k, name in enumerate(names):
        steps = loops.path(edges, names[0], name)
        if steps is None:
            raise FrameError(f"Expected poses that join {names[0]!r} and {name!r}, got none. Add the missing pose.")
        T = np.eye(4)
        for i, sign in steps:
            T = T @ (edges[i].T if sign > 0 else se3.inv(edges[i].T))
        start[k] = se3.project(T)[0]
    return start


def _problem(edges: Sequence[Edge], names: Sequence[str]) -> NonlinearProblem[np.ndarray]:
    """Return residuals with their Jacobian, and the retraction."""
    index = {name: k for k, name in enumerate(names)}
    first, second = np.array([index[edge.a] for edge in edges]), np.array([index[edge.b] for edge in edges])
    measured = np.stack([se3.project(edge.T)[0] for edge in edges])
    known = [edge.cov for edge in edges if edge.cov is not None]
    cov = np.stack(known) if known else None
    rows = np.arange(len(edges))

    def evaluate(T: np.ndarray) -> list[Measurement]:
        R_a, R_b = T[first, :3, :3], T[second, :3, :3]
        back = np.swapaxes(R_a, 1, 2)
        p = np.einsum("kij,kj->ki", back, T[second, :3, 3] - T[first, :3, 3])
        R = back @ R_b
        turn = so3.log(np.swapaxes(R, 1, 2) @ measured[:, :3, :3])
        bend = so3.left_jacobian_inv(turn)
        J = np.zeros((len(edges), 6, len(names), 6))
        J[rows, :3, first, :3] = back
        J[rows, :3, first, 3:] = -so3.hat(p)
        J[rows, 3:, first, 3:] = bend @ np.swapaxes(R, 1, 2)
        J[rows, :3, second, :3] = -back
        J[rows, 3:, second, 3:] = -bend
        r = np.hstack([measured[:, :3, 3] - p, turn])
        return [Measurement(r, J[:, :, 1:].reshape(len(edges), 6, -1), cov, CLASSES)]

    def retract(T: np.ndarray, x: np.ndarray) -> np.ndarray:
        step = x.reshape(-1, 6)
        moved = T.copy()
        moved[1:, :3, 3] += step[:, :3]
        moved[1:, :3, :3] = T[1:, :3, :3] @ so3.exp(step[:, 3:])
        return moved

    return NonlinearProblem(evaluate, retract, what="frames")


def _report(fit: Fit[FrameSet], words: Sequence[str]) -> str:
    """Return the table with the poses that were left out by name."""
    lines = [fit.table()]
    lines += [f"left out: {words[k]}" for k in np.flatnonzero(fit.outliers).tolist()]
    return "\n".join(lines)
