"""Meshes by reference: where the shape of a link is, and at which pose it sits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from armlab._numbers import frozen
from armlab.errors import RobotError
from armlab.lie import se3

__all__ = ["Mesh"]


@dataclass(frozen=True, eq=False)
class Mesh:
    """One mesh of a link, named and never read. Meshes are equal when all their fields are.

    Attributes
    ----------
    kind : "visual" or "collision".
    file : reference as the description has it: a path, or an address such as ``package://maker/link_1.stl``.
    T_link_mesh : (4, 4) pose of the mesh in its link frame, read-only.
    scale : (3,) factors from the numbers of the file to metres, read-only.

    Raises
    ------
    RobotError : when the kind is unknown, the file has no name, the pose is none, or a factor is zero or not finite.
    """

    kind: Literal["visual", "collision"]
    file: str
    T_link_mesh: np.ndarray
    scale: np.ndarray

    def __post_init__(self) -> None:
        """Make the arrays read-only float64 copies and check the fields."""
        for name in ("T_link_mesh", "scale"):
            object.__setattr__(self, name, frozen(getattr(self, name), f"{name} of mesh {self.file!r}"))
        if not isinstance(self.file, str) or not self.file:
            raise RobotError(f"Expected the file name of a mesh, got {self.file!r}.")
        if not isinstance(self.kind, str) or self.kind not in ("visual", "collision"):
            raise RobotError(f'Expected "visual" or "collision" as kind of mesh {self.file!r}, got {self.kind!r}.')
        if self.T_link_mesh.shape != (4, 4) or not se3.is_pose(self.T_link_mesh):
            raise RobotError(f"Expected a pose (4, 4) of mesh {self.file!r}, got {self.T_link_mesh.tolist()}.")
        if self.scale.shape != (3,) or not (np.isfinite(self.scale).all() and self.scale.all()):
            raise RobotError(
                f"Expected 3 finite factors of mesh {self.file!r} other than 0, got {self.scale.tolist()}."
            )

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Mesh):
            return NotImplemented
        return self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle through the constructor, so that the arrays are read-only again."""
        return Mesh, (self.kind, self.file, self.T_link_mesh, self.scale)

    def _key(self) -> tuple[Any, ...]:
        return self.kind, self.file, self.T_link_mesh.tobytes(), self.scale.tobytes()
