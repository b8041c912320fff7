"""A camera and a marker on a robot: which of the two is on the tool, and where both are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from armlab import kernels
from armlab.errors import FrameError, ShapeError, UnknownName

FRAMES = {"eye_to_hand": ("T_tool_marker", "T_base_cam"), "eye_in_hand": ("T_base_marker", "T_tool_cam")}


@dataclass(frozen=True, eq=False)
class HandEye:
    """The two poses that close the loop of robot and camera.

        eye_to_hand:  T_base_tool T_tool_marker     = T_base_cam T_cam_marker
        eye_in_hand:  T_base_tool^-1 T_base_marker  = T_tool_cam T_cam_marker

    Read them by their names: `T_tool_marker` and `T_base_cam`, or `T_base_marker` and `T_tool_cam`.

    Attributes
    ----------
    setup : "eye_to_hand", the camera stands and the marker is on the tool, or "eye_in_hand".
    X : (4, 4) T_tool_marker or T_base_marker; None where only points of a marker of unknown shape were seen.
    Y : (4, 4) T_base_cam or T_tool_cam.
    points : (K, 3) points of the marker in the frame that carries it, tool or base [m]; None where poses were measured.
    """

    setup: str
    X: np.ndarray | None
    Y: np.ndarray
    points: np.ndarray | None = None

    def __post_init__(self) -> None:
        """Check and freeze."""
        if self.setup not in FRAMES:
            raise UnknownName.among("setup", self.setup, FRAMES)
        for name in ("X", "Y", "points"):
            given = getattr(self, name)
            if given is None and name != "Y":
                continue
            values = np.array(given, dtype=float)
            good = values.ndim == 2 and values.shape[1] == 3 if name == "points" else values.shape == (4, 4)
            if not good or not np.isfinite(values).all():
                what = "points (K, 3)" if name == "points" else f"a pose {name} (4, 4)"
                raise ShapeError(f"Expected {what} of a hand-eye calibration, finite, got {values.shape}. Correct it.")
            if name != "points":
                kernels.poses(values, name)
            values.flags.writeable = False
            object.__setattr__(self, name, values)

    @property
    def T_tool_marker(self) -> np.ndarray:
        """Marker on the tool (4, 4); eye_to_hand only."""
        return self._named("T_tool_marker")

    @property
    def T_base_cam(self) -> np.ndarray:
        """Camera that stands (4, 4); eye_to_hand only."""
        return self._named("T_base_cam")

    @property
    def T_base_marker(self) -> np.ndarray:
        """Marker that stands (4, 4); eye_in_hand only."""
        return self._named("T_base_marker")

    @property
    def T_tool_cam(self) -> np.ndarray:
        """Camera on the tool (4, 4); eye_in_hand only."""
        return self._named("T_tool_cam")

    def _named(self, name: str) -> np.ndarray:
        names = FRAMES[self.setup]
        value = dict(zip(names, (self.X, self.Y))).get(name)
        if value is None:
            known = [other for other, pose in zip(names, (self.X, self.Y)) if pose is not None]
            raise FrameError(
                f"Expected a pose that setup {self.setup!r} has, {' or '.join(known)}, got {name}. "
                "Read that, or calibrate the other setup; a marker of unknown shape has points and no pose."
            )
        return value
