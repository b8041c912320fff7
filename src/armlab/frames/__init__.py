"""Geometry of measured points: planes, lines, circles and spheres with covariance, frames built from them."""

from armlab.frames.building import BuiltFrame, build
from armlab.frames.features import Circle, Line, Plane, Sphere
from armlab.frames.flat import fit_line, fit_plane
from armlab.frames.graph import Graph
from armlab.frames.loops import Edge, Loop, LoopCheck
from armlab.frames.marker_pose import MarkerPoses, marker_pose
from armlab.frames.network import FrameSet
from armlab.frames.offset import OffsetCheck, check_offset
from armlab.frames.projection import distance, intersect, project
from armlab.frames.round import fit_circle, fit_sphere
from armlab.models import register

__all__ = [
    "BuiltFrame",
    "Circle",
    "Edge",
    "FrameSet",
    "Graph",
    "Line",
    "Loop",
    "LoopCheck",
    "MarkerPoses",
    "OffsetCheck",
    "Plane",
    "Sphere",
    "build",
    "check_offset",
    "distance",
    "fit_circle",
    "fit_line",
    "fit_plane",
    "fit_sphere",
    "intersect",
    "marker_pose",
    "project",
]

register("plane", Plane)
register("line", Line)
register("circle", Circle)
register("sphere", Sphere)
register("frame_set", FrameSet)
