"""Loops of a graph of frames: a pose around a loop is the identity, but for errors of measurement.

With T the product around a loop and E one of its poses, an error [v; w] of E (v along the axes of its first frame, w
along those of its second) turns and shifts the closure by ``Ad(S^-1) [R_E^T v; w]``, S the product behind E. The sum of
the covariances that this gives is that of the closure error [p; Log R]; ``chi2 = e^T C^-1 e`` has six degrees of
freedom.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armlab.lie import se3, so3

__all__ = ["Edge", "Loop", "LoopCheck", "check", "path", "spanning"]

CHANCE = 1e-3  # of a closure error below which a loop is reported

Steps = list[tuple[int, int]]


@dataclass(frozen=True, eq=False)
class Edge:
    """A measured pose between two frames.

    Attributes
    ----------
    a, b : names of the frames. T : (4, 4) pose of b in a [m].
    cov : (6, 6) covariance of its error [v; w], v along the axes of a [m], w along those of b [rad]; zero when the pose
        is exact, None when nobody knows.
    source : where it comes from, in words.
    """

    a: str
    b: str
    T: np.ndarray
    cov: np.ndarray | None = None
    source: str = ""

    def text(self) -> str:
        """Return the names and the source."""
        return f"{self.a} to {self.b}" + (f" ({self.source})" if self.source else "")


@dataclass(frozen=True)
class Loop:
    """A loop of poses.

    Attributes
    ----------
    frames : names along it; the last is joined to the first. edges : numbers of its poses, as they were added.
    position : closure error [m]. angle : closure error [rad].
    chi2, p : of the closure error given the covariances, and the chance of a larger one; NaN where one is not known.
    words : of each pose.
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
        """True when noise alone would show so large an error once in a thousand loops."""
        return self.p < CHANCE

    def text(self) -> str:
        """Return one line."""
        chance = "" if np.isnan(self.p) else f", chi2 {self.chi2:.3g} of 6, p {self.p:.2g}"
        verdict = f"; does not close: look at {', '.join(self.words)}" if self.beyond else ""
        way = " - ".join([*self.frames, self.frames[0]])
        return f"{way}: {1e3 * self.position:.3g} mm, {1e3 * self.angle:.3g} mrad{chance}{verdict}"


@dataclass(frozen=True)
class LoopCheck:
    """All independent loops of a graph.

    Attributes
    ----------
    loops : in the order in which the poses that close them were added.
    """

    loops: tuple[Loop, ...]

    @property
    def passed(self) -> bool:
        """True when no loop is beyond what its covariances allow."""
        return not any(loop.beyond for loop in self.loops)

    def text(self) -> str:
        """Return one line per loop."""
        return "\n".join(loop.text() for loop in self.loops) or "no loops: nothing to check"


def check(edges: Sequence[Edge]) -> LoopCheck:
    """Return the closure of every independent loop: one per pose that the spanning tree does not need.

    Parameters
    ----------
    edges : measured poses.
    """
    tree = spanning(edges)
    found = []
    for k, edge in enumerate(edges):
        if k in tree:
            continue
        back = path([edges[i] for i in tree], edge.b, edge.a) or []
        found.append(_closure(edges, [(k, 1), *((tree[i], sign) for i, sign in back)]))
    return LoopCheck(tuple(found))


def spanning(edges: Sequence[Edge]) -> list[int]:
    """Return the numbers of the poses of a spanning tree, or of one per part: the earliest that join something new.

    Parameters
    ----------
    edges : measured poses.
    """
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
    """Return the fewest poses from a to b as (number, 1 or -1 against its direction); None when there is no way.

    Parameters
    ----------
    edges : measured poses. a, b : names.
    """
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


def _closure(edges: Sequence[Edge], steps: Steps) -> Loop:
    """Return the closure of a loop with its chance."""
    from scipy.special import chdtrc

    poses = [edges[k].T if sign > 0 else se3.inv(edges[k].T) for k, sign in steps]
    T, C, known = np.eye(4), np.zeros((6, 6)), True
    for (k, sign), pose in zip(reversed(steps), reversed(poses)):  # T is the product behind the pose
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
    numbers = tuple(k for k, _ in steps)
    return Loop(frames, numbers, float(np.linalg.norm(e[:3])), float(np.linalg.norm(e[3:])), chi2, chance, words)


def _squared(e: np.ndarray, C: np.ndarray) -> float:
    """Return ``e^T C^-1 e``; NaN where the covariance is not positive definite, as around a loop of exact poses."""
    try:
        return float(np.sum(np.linalg.solve(np.linalg.cholesky(C), e) ** 2))
    except np.linalg.LinAlgError:
        return float("nan")
