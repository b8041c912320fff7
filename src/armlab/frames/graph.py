"""Named frames joined by measured poses: any pose along the way, the error of every loop, the most likely set.

A graph belongs to its user: there is no global one.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from armlab.errors import FrameError
from armlab.estimation import Fit
from armlab.frames import _check, loops, network
from armlab.frames.loops import Edge, LoopCheck
from armlab.frames.network import FrameSet
from armlab.lie import se3

__all__ = ["Graph"]


class Graph:
    """Named frames and the poses between them; several between the same two frames are welcome."""

    def __init__(self) -> None:
        self._edges: list[Edge] = []

    @property
    def edges(self) -> tuple[Edge, ...]:
        """All poses, in the order in which they were added."""
        return tuple(self._edges)

    @property
    def names(self) -> tuple[str, ...]:
        """All frames, in the order in which they were first named."""
        return tuple(dict.fromkeys(name for edge in self._edges for name in (edge.a, edge.b)))

    def add(self, a: str, b: str, T_a_b: ArrayLike, cov: ArrayLike | None = None, source: str = "") -> None:
        """Add a measured pose.

        Parameters
        ----------
        a, b : names of two frames, words without an underscore, as in ``T_a_b``. New ones become known.
        T_a_b : (4, 4) pose of b in a [m].
        cov : (6, 6) covariance of its error [v; w], v along the axes of a, w along those of b.
        source : where it comes from, for reports.

        Raises
        ------
        FrameError : a name that is none, or the same twice. ShapeError : no pose, or no covariance.
        """
        for name in (a, b):
            if not isinstance(name, str) or not name.isalnum():
                raise FrameError(
                    f"Expected the name of a frame, letters and digits without an underscore, got {name!r}. "
                    "T_base_tool is the pose of tool in base."
                )
        if a == b:
            raise FrameError(f"Expected two frames, got {a!r} twice. A frame has no pose in itself.")
        T = np.array(_check.pose(T_a_b, f"T_{a}_{b}"))
        T.flags.writeable = False
        self._edges.append(Edge(a, b, T, _check.covariance(cov, 6, f"the covariance of T_{a}_{b}"), str(source)))

    def get(self, a: str, b: str, via: Sequence[str] = ()) -> np.ndarray:
        """Return the pose (4, 4) of b in a, composed along the way with the fewest poses, the earliest added first.

        Parameters
        ----------
        a, b : names of frames.
        via : frames on the way, in order; each must be joined to the next by a pose of its own.

        Raises
        ------
        FrameError : an unknown name, with those that are known; frames that no pose joins, with both names.
        """
        for name in (a, *via, b):
            if name not in self.names:
                raise FrameError(
                    f"Expected the name of a known frame, got {name!r}. Known: {', '.join(self.names) or 'none'}."
                )
        T = np.eye(4)
        if not via:
            return self._along(T, loops.path(self._edges, a, b), a, b)
        stops = (a, *via, b)
        for here, there in pairwise(stops):
            direct = [edge for edge in self._edges if {edge.a, edge.b} == {here, there}]
            if not direct:
                raise FrameError(
                    f"Expected a pose between {here!r} and {there!r}, got none. Joined to {here!r}: "
                    f"{', '.join(self._neighbours(here))}."
                )
            T = self._along(T, [(self._edges.index(direct[0]), 1 if direct[0].a == here else -1)], here, there)
        return T

    def check(self) -> LoopCheck:
        """Return every independent loop with its closure error and, where covariances are known, its chance."""
        return loops.check(self._edges)

    def solve(self, robust: bool = False) -> Fit[FrameSet]:
        """Return the most likely poses of all frames, given all measured poses at once.

        Each pose has a residual of position, in the axes of its first frame, and of rotation, in those of its second,
        weighted by its covariance. Without any covariance all poses count alike and the noise is estimated.

        Parameters
        ----------
        robust : find poses that do not fit the others; `outliers` marks them.

        Raises
        ------
        FrameError : no poses, frames that nothing joins, or covariances of some poses only.
        NotExcited : too few poses to estimate the noise; outliers left a frame without a pose.
        NotConverged : the iteration did not.
        """
        return network.solve(self._edges, self.names, robust)

    def _along(self, T: np.ndarray, steps: Iterable[tuple[int, int]] | None, a: str, b: str) -> np.ndarray:
        if steps is None:
            raise FrameError(f"Expected poses that join {a!r} and {b!r}, got none on any way. Add the missing pose.")
        for k, sign in steps:
            T = T @ (self._edges[k].T if sign > 0 else se3.inv(self._edges[k].T))
        return T

    def _neighbours(self, name: str) -> list[str]:
        return sorted({edge.b if edge.a == name else edge.a for edge in self._edges if name in (edge.a, edge.b)})
