"""Planes, lines, circles and spheres fitted to measured points, with covariance, and frames built from them."""

from armlab.frames.circle_sphere import fit_circle, fit_sphere
from armlab.frames.construction import BuiltFrame, build, distance, intersect, project
from armlab.frames.features import Circle, Line, Plane, Sphere
from armlab.frames.marker import MarkerPoses, marker_pose
from armlab.frames.plane_line import OffsetCheck, check_offset, fit_line, fit_plane
from armlab.frames.pose_graph import FrameSet, Graph, Loop, LoopCheck
from armlab.models import register

__all__ = [
    "BuiltFrame", "Circle", "FrameSet", "Graph", "Line", "Loop", "LoopCheck", "MarkerPoses", "OffsetCheck", "Plane",
    "Sphere", "build", "check_offset", "distance", "fit_circle", "fit_line", "fit_plane", "fit_sphere", "intersect",
    "marker_pose", "project",
]  # fmt: skip

register("plane", Plane)
register("line", Line)
register("circle", Circle)
register("sphere", Sphere)
register("frame_set", FrameSet)
