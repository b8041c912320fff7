"""Pose graph: named frames connected by measured poses, loop closure errors, and maximum-likelihood poses.

An error [v; w] of a pose E in a loop changes the closure error by ``Ad(S^-1) [R_E^T v; w]``, with S the product of the
poses that follow E. A pose E measured between frames a and b has the residuals ``p_E - R_a^T (p_b - p_a)`` along the
axes of a and ``Log(R_b^T R_a R_E)`` along the axes of b. Theory: docs/theory/frames.md.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from armlab._display import Shown
from armlab._numbers import still
from armlab.errors import FrameError
from armlab.estimation import Fit, Measurement, NonlinearProblem, nonlinear_least_squares
from armlab.estimation.linear_problem import check_spread
from armlab.frames import inputs
from armlab.lie import se3, so3

P_VALUE = 1e-3  # p-value of a closure error below which a loop is reported

Steps = list[tuple[int, int]]
CLASSES = ("position",) * 3 + ("rotation",) * 3
LIMIT = 0.2  # largest accepted standard deviation: angle [rad]; position, relative to the spread of the frames
PARTS = (("x", "m"), ("y", "m"), ("z", "m"), ("turn x", "rad"), ("turn y", "rad"), ("turn z", "rad"))


class Graph:
    """Named frames and measured poses between them, possibly several between the same two frames."""

    def __init__(self) -> None:
        self._edges: list[Edge] = []

    @property
    def edges(self) -> tuple[Edge, ...]:
        """All poses in the order in which they were added."""
        return tuple(self._edges)

    @property
    def names(self) -> tuple[str, ...]:
        """All frames in the order of first use."""
        return tuple(dict.fromkeys(name for edge in self._edges for name in (edge.a, edge.b)))

    def add(self, a: str, b: str, T_a_b: ArrayLike, cov: ArrayLike | None = None, source: str = "") -> None:
        """Add a measured pose.

        Parameters
        ----------
        a, b : names of two frames, letters and digits only, as in ``T_a_b``. New names are added to the graph.
        T_a_b : (4, 4) pose of b in a [m].
        cov : (6, 6) covariance of the pose error [v; w], v along the axes of a [m], w along the axes of b [rad].
        source : origin of the pose, for reports.

        Raises
        ------
        FrameError : an invalid name, or two equal names.
        ShapeError : an invalid pose or covariance.
        """
        for name in (a, b):
            if not isinstance(name, str) or not name.isalnum():
                raise FrameError(
                    f"Expected a frame name of letters and digits without an underscore, got {name!r}. "
                    "T_base_tool is the pose of tool in base."
                )
        if a == b:
            raise FrameError(f"Expected two different frames, got {a!r} twice. Correct one of the names.")
        T = still(inputs.pose(T_a_b, f"T_{a}_{b}"), f"T_{a}_{b}")
        self._edges.append(Edge(a, b, T, inputs.covariance(cov, 6, f"the covariance of T_{a}_{b}"), str(source)))

    def get(self, a: str, b: str, via: Sequence[str] = ()) -> np.ndarray:
        """Return the pose (4, 4) of b in a along the shortest path; the earliest poses take precedence.

        Parameters
        ----------
        a, b : names of frames.
        via : frames on the path, in order; consecutive frames must have a direct pose.

        Raises
        ------
        FrameError : an unknown name (the message lists the known names), or two frames without a path (the message
            names both).
        """
        _require_known((a, *via, b), self.names)
        if not via:
            return connected(self._edges, a, b)
        ways: Steps = []
        for here, there in pairwise((a, *via, b)):
            direct = [edge for edge in self._edges if {edge.a, edge.b} == {here, there}]
            if not direct:
                near = sorted(
                    {edge.b if edge.a == here else edge.a for edge in self._edges if here in (edge.a, edge.b)}
                )
                raise FrameError(
                    f"Expected a pose between {here!r} and {there!r}, but there is no direct pose. Poses of {here!r}: "
                    f"{', '.join(near)}."
                )
            ways.append((self._edges.index(direct[0]), 1 if direct[0].a == here else -1))
        return composed(self._edges, ways)

    def check(self) -> LoopCheck:
        """Return every independent loop with its closure error and, if the covariances are given, its p-value."""
        return check_loops(self._edges)

    def solve(self, robust: bool = False) -> Fit[FrameSet]:
        """Return the maximum-likelihood poses of all frames, given all measured poses.

        Each pose has a position residual in the axes of its first frame and a rotation residual in the axes of its
        second frame, weighted by its covariance. Without covariances, all poses have the same weight and the noise is
        estimated.

        Parameters
        ----------
        robust : detect poses that are inconsistent with the other poses; `outliers` marks them.

        Raises
        ------
        FrameError : no poses, disconnected frames, or covariances of only some poses.
        NotExcited : too few poses to estimate the noise, or a frame connected only by outliers.
        NotConverged : the iteration did not converge.
        """
        return solve_poses(self._edges, self.names, robust)


@dataclass(frozen=True, eq=False)
class Edge:
    """Pose T (4, 4) of frame b in frame a, with the covariance of its error [v; w]: zero if exact, None if unknown."""

    a: str
    b: str
    T: np.ndarray
    cov: np.ndarray | None = None
    source: str = ""

    def text(self) -> str:
        return f"{self.a} to {self.b}" + (f" ({self.source})" if self.source else "")


@dataclass(frozen=True, repr=False)
class Loop(Shown):
    """Loop of poses with its closure error.

    Attributes
    ----------
    frames : names of the frames along the loop; the last frame is connected to the first.
    edges : indices of the poses of the loop, in the order in which they were added to the graph.
    position : closure error [m].
    angle : closure error [rad].
    chi2 : squared Mahalanobis norm of the closure error; NaN if a covariance is unknown.
    p : p-value of chi2; NaN if a covariance is unknown.
    words : description of each pose.
    """

    frames: tuple[str, ...]
    edges: tuple[int, ...]
    position: float
    angle: float
    chi2: float
    p: float
    words: tuple[str, ...]

    @property
    def beyond(self) -> bool:
        """Whether the p-value of the closure error is below 0.001."""
        return self.p < P_VALUE

    def text(self) -> str:
        """Return one line with the frames, the closure error, its p-value and the suspicious poses."""
        chance = "" if np.isnan(self.p) else f", chi2 {self.chi2:.3g} of 6, p {self.p:.2g}"
        verdict = f"; does not close: check {', '.join(self.words)}" if self.beyond else ""
        way = " - ".join([*self.frames, self.frames[0]])
        return f"{way}: {1e3 * self.position:.3g} mm, {1e3 * self.angle:.3g} mrad{chance}{verdict}"


@dataclass(frozen=True, repr=False)
class LoopCheck(Shown):
    """All independent loops of a graph.

    Attributes
    ----------
    loops : loops in the order of the poses that close them.
    """

    loops: tuple[Loop, ...]

    @property
    def passed(self) -> bool:
        """Whether every closure error is consistent with the covariances."""
        return not any(loop.beyond for loop in self.loops)

    def text(self) -> str:
        """Return one line per loop."""
        return "\n".join(loop.text() for loop in self.loops) or "no loops: nothing to check"


def check_loops(edges: Sequence[Edge]) -> LoopCheck:
    """Return every independent loop with its closure error, one loop per pose outside the spanning tree."""
    tree = spanning(edges)
    found = []
    for k, edge in enumerate(edges):
        if k in tree:
            continue
        back = path([edges[i] for i in tree], edge.b, edge.a) or []
        found.append(_closure(edges, [(k, 1), *((tree[i], sign) for i, sign in back)]))
    return LoopCheck(tuple(found))


def spanning(edges: Sequence[Edge]) -> list[int]:
    """Return the indices of the poses of a spanning forest, preferring the earliest poses."""
    part: dict[str, str] = {}

    def root(name: str) -> str:
        while part.setdefault(name, name) != name:
            name = part[name]
        return name

    tree = []
    for k, edge in enumerate(edges):
        a, b = root(edge.a), root(edge.b)
        if a != b:
            part[b] = a
            tree.append(k)
    return tree


def path(edges: Sequence[Edge], a: str, b: str) -> Steps | None:
    """Return the shortest path from a to b as pairs (index, direction), with direction 1 forwards and -1 backwards;
    None if there is no path."""
    came: dict[str, tuple[str, int, int]] = {a: (a, -1, 1)}
    waiting = deque([a])
    while waiting and b not in came:
        here = waiting.popleft()
        for k, edge in enumerate(edges):
            if here not in (edge.a, edge.b):
                continue
            there, sign = (edge.b, 1) if edge.a == here else (edge.a, -1)
            if there not in came:
                came[there] = (here, k, sign)
                waiting.append(there)
    if b not in came:
        return None
    steps: Steps = []
    while b != a:
        b, k, sign = came[b]
        steps.append((k, sign))
    return steps[::-1]


def connected(edges: Sequence[Edge], a: str, b: str) -> np.ndarray:
    """Return the pose (4, 4) of b in a along the shortest path; raise an error if there is no path."""
    steps = path(edges, a, b)
    if steps is None:
        raise FrameError(f"Expected poses that connect {a!r} and {b!r}, but there is no path. Add the missing pose.")
    return composed(edges, steps)


def _require_known(wanted: Sequence[str], names: Sequence[str]) -> None:
    for name in wanted:
        if name not in names:
            raise FrameError(f"Expected the name of a known frame, got {name!r}. Known: {', '.join(names) or 'none'}.")


def composed(edges: Sequence[Edge], steps: Steps) -> np.ndarray:
    """Return the pose (4, 4) along a path."""
    T = np.eye(4)
    for k, sign in steps:
        T = T @ (edges[k].T if sign > 0 else se3.inv(edges[k].T))
    return T


def _closure(edges: Sequence[Edge], steps: Steps) -> Loop:
    from scipy.special import chdtrc

    poses = [edges[k].T if sign > 0 else se3.inv(edges[k].T) for k, sign in steps]
    T, C, known = np.eye(4), np.zeros((6, 6)), True
    for (k, sign), pose in zip(reversed(steps), reversed(poses)):  # T is the product of the poses that follow this pose
        edge = edges[k]
        turned = np.eye(6)
        turned[:3, :3] = edge.T[:3, :3].T
        behind = se3.inv(T) if sign > 0 else se3.inv(pose @ T)
        J = se3.adjoint(behind) @ turned
        known &= edge.cov is not None
        C += 0.0 if edge.cov is None else J @ edge.cov @ J.T
        T = pose @ T
    e = np.concatenate([T[:3, 3], so3.log(so3.project(T[:3, :3])[0])])
    chi2 = _squared(e, C) if known else float("nan")
    chance = float(chdtrc(6, chi2)) if np.isfinite(chi2) else (0.0 if chi2 > 0 else float("nan"))
    frames = tuple(edges[k].a if sign > 0 else edges[k].b for k, sign in steps)
    words = tuple(edges[k].text() for k, _ in steps)
    position, angle = float(np.linalg.norm(e[:3])), float(np.linalg.norm(e[3:]))
    return Loop(frames, tuple(k for k, _ in steps), position, angle, chi2, chance, words)


def _squared(e: np.ndarray, C: np.ndarray) -> float:
    """Return ``e^T C^-1 e``, or NaN if C is not positive definite, for example for a loop of exact poses."""
    try:
        return float(np.sum(np.linalg.solve(np.linalg.cholesky(C), e) ** 2))
    except np.linalg.LinAlgError:
        return float("nan")


@dataclass(frozen=True, eq=False, repr=False)
class FrameSet(Shown):
    """Consistent poses of named frames.

    Attributes
    ----------
    names : names of the F frames.
    T : (F, 4, 4) poses of the frames in the first frame [m].
    """

    names: tuple[str, ...]
    T: np.ndarray

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "T", still(self.T, "poses T of frames"))

    def get(self, a: str, b: str) -> np.ndarray:
        """Return the pose (4, 4) of b in a.

        Parameters
        ----------
        a, b : names of frames.

        Raises
        ------
        FrameError : an unknown name (the message lists the known names).
        """
        _require_known((a, b), self.names)
        return se3.inv(self.T[self.names.index(a)]) @ self.T[self.names.index(b)]


def solve_poses(edges: Sequence[Edge], names: Sequence[str], robust: bool = False) -> Fit[FrameSet]:
    if not edges:
        raise FrameError("Expected poses between frames, got an empty graph. Use Graph.add.")
    start = np.stack([se3.project(connected(edges, names[0], name))[0] for name in names])
    given = [edge.cov is not None for edge in edges]
    if any(given) and not all(given):
        missing = ", ".join(edge.text() for edge, known in zip(edges, given) if not known)
        raise FrameError(
            f"Expected covariances for all poses or for none, but {missing} has no covariance. Pass cov= for each pose."
        )
    problem = _problem(edges, names)
    found = nonlinear_least_squares(problem, start, robust=robust)
    size = float(np.linalg.norm(found.value[:, :3, 3].std(axis=0)))
    labels = [(f"{name} {part}", unit) for name in names[1:] for part, unit in PARTS]
    limits = np.array([LIMIT * (1.0 if unit == "rad" else size or 1.0) for _, unit in labels])
    labelled, units = tuple(name for name, _ in labels), tuple(unit for _, unit in labels)
    excitation = check_spread(found.rows.J, labelled, units, limits, "frames")
    R = found.value[1:, :3, :3]
    parameters = np.hstack([found.value[1:, :3, 3], so3.log(R)]).ravel()
    residuals = problem.evaluate(found.value)[0].r
    return Fit(
        FrameSet(tuple(names), found.value), labelled, units, parameters, found.cov, found.sigma, residuals,
        len(edges) - int(found.outliers.sum()), excitation, lambda fit: _report(fit, [edge.text() for edge in edges]),
        found.outliers, ("position [m]", "rotation [rad]"),
    )  # fmt: skip


def _problem(edges: Sequence[Edge], names: Sequence[str]) -> NonlinearProblem[np.ndarray]:
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
    return "\n".join([fit.table(), *(f"excluded: {words[k]}" for k in np.flatnonzero(fit.outliers).tolist())])
