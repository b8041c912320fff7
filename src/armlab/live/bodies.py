"""Shapes of an arm: capsules made from its description where it has no meshes, joints as drums about their axes."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from armlab.lie import se3
from armlab.robots import Mesh, Robot
from armlab.robots.robot import arm_length, bends

__all__ = ["Surface", "along", "arrow", "bodies", "box", "capsule", "drums", "mesh_bodies"]

_THICK = (0.042, 0.020)  # radius of the first and the last link over the length of the arm
_DRUM = (1.25, 2.6)  # radius and length of a joint over the radius of its link
_STROKE = 0.3  # of a slide without limits, over the length of the arm
_SIDES = 20
_SHAFT, _HEAD = 0.008, (0.02, 0.72)  # of an arrow: radius [m]; radius [m] and where it begins


class Surface(NamedTuple):
    """A closed surface: vertices (V, 3) [m] and faces (F, 3), corners counter-clockwise from outside."""

    vertices: np.ndarray
    faces: np.ndarray

    def moved(self, T_a_b: np.ndarray) -> Surface:
        """Return the body in frame a.

        `T_a_b`: (4, 4), where it is in b now.
        """
        return Surface(self.vertices @ T_a_b[:3, :3].T + T_a_b[:3, 3], self.faces)


def capsule(a: np.ndarray, b: np.ndarray, radius: float) -> Surface:
    """Return all points within a radius of the line from a to b: a cylinder and two half spheres.

    `a`, `b`: (3,) ends of the line; the same make a sphere. `radius`: [m].
    """
    polar = np.linspace(0.0, np.pi, _SIDES + 1)
    polar = np.insert(polar, _SIDES // 2, np.pi / 2)  # the equator twice: one ring for each end
    height = np.where(np.arange(len(polar)) <= _SIDES // 2, np.linalg.norm(b - a), 0.0)
    profile = np.stack([radius * np.sin(polar), radius * np.cos(polar) + height], axis=1)
    return _turned(profile).moved(along(a, b))


def _drum(radius: float, length: float) -> Surface:
    """Return a cylinder about the z axis, centred at the origin."""
    top = length / 2.0
    return _turned(np.array([[0.0, top], [radius, top], [radius, top], [radius, -top], [radius, -top], [0.0, -top]]))


def box(a: np.ndarray, b: np.ndarray, width: float) -> Surface:
    """Return a rod of square section from a to b.

    `a`, `b`: (3,) middles of its ends. `width`: [m].
    """
    h, length = width / 2.0, float(np.linalg.norm(b - a))
    corners = np.array([[x, y, z] for z in (0.0, length) for y in (-h, h) for x in (-h, h)])
    squares = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    faces = np.array([(p, *pair) for p, q, r, s in squares for pair in ((q, r), (r, s))])
    return Surface(corners, faces).moved(along(a, b))


def arrow() -> Surface:
    """Return an arrow from the origin to (0, 0, 1); scaled along z it has the length of a force."""
    return _turned(
        np.array(
            [[0.0, 1.0], [_HEAD[0], _HEAD[1]], [_HEAD[0], _HEAD[1]], [_SHAFT, _HEAD[1]], [_SHAFT, 0.0], [0.0, 0.0]]
        )
    )


def bodies(robot: Robot) -> list[Surface]:
    """Return n + 1 shapes: that from base to joint 1 in base axes, then each link in its link frame, the tool included.

    A link runs along its joint axes and the common normal between them, as in `plots.robot`; it gets thinner towards
    the tool. What slides is a rod along its axis, as long as its stroke.
    """
    length = arm_length(robot)
    radii = length * np.linspace(*_THICK, robot.n + 1)
    shapes = []
    for i, E in enumerate(robot.frames):
        start = robot.T_base_mount[:3, 3] if i == 0 else np.zeros(3)
        axis = robot.T_base_mount[:3, 2] if i == 0 else np.array([0.0, 0.0, 1.0])
        end, towards = E[:3, 3], E[:3, 2]
        points = [start, *bends(start, axis, end, towards), end] if i < robot.n else [start, end]
        points = [np.zeros(3), *points] if i == 0 else points
        parts = [capsule(a, b, radii[i]) for a, b in pairwise(points) if np.linalg.norm(b - a) > 1e-6]
        if i and robot.prismatic[i - 1]:
            limits = np.array([robot.q_min[i - 1], robot.q_max[i - 1]])
            low, high = np.where(np.isfinite(limits), limits, [0.0, _STROKE * length])
            parts.append(box(-max(high, 0.0) * axis, -min(low, 0.0) * axis, 2.0 * radii[i]))
        shapes.append(_together(parts or [capsule(start, start, radii[i])]))
    return shapes


def drums(robot: Robot) -> list[Surface]:
    """Return the n joints, each about the z axis of its link frame."""
    radii = arm_length(robot) * np.linspace(*_THICK, robot.n + 1)[1:]
    return [_drum(_DRUM[0] * radius, _DRUM[1] * radius) for radius in radii]


def along(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return a pose (4, 4) at a whose z axis points to b.

    `a`, `b`: (3,); where they are the same, z stays.
    """
    z = b - a
    z = z / np.linalg.norm(z) if z.any() else np.array([0.0, 0.0, 1.0])
    x = np.cross(np.eye(3)[np.argmin(np.abs(z))], z)
    x /= np.linalg.norm(x)
    return se3.from_rp(np.stack([x, np.cross(z, x), z], axis=1), a)


def mesh_bodies(robot: Robot, folders: Sequence[Path] = ()) -> list[Surface | None]:
    """Return n + 1 shapes from the robot's visual meshes (base axes, link frames); None for a link without.

    One warning names all files that are missing or cannot be read. ``package://maker/a/b.stl`` is looked for as
    ``maker/a/b.stl`` and ``a/b.stl`` in each folder.
    """
    missing: list[str] = []
    shapes: list[Surface | None] = []
    for i, link in enumerate(robot.meshes):
        visual = [mesh for mesh in link if mesh.kind == "visual"]
        found = [_read(mesh, folders or [Path()]) for mesh in visual]
        missing += [mesh.file for mesh, one in zip(visual, found) if one is None]
        parts = [one for one in found if one is not None]
        whole = _together(parts) if parts and len(parts) == len(visual) else None
        shapes.append(whole.moved(robot.T_base_mount) if whole is not None and i == 0 else whole)
    if missing:
        warnings.warn(f"no mesh for {', '.join(missing)} of {robot.name}: links without are capsules", stacklevel=2)
    return shapes or [None] * (robot.n + 1)


def _read(mesh: Mesh, folders: Sequence[Path]) -> Surface | None:
    """Return what a file of a mesh holds, in its link frame."""
    import trimesh

    name = mesh.file.removeprefix("file://")
    if name.startswith("package://"):
        name = name.removeprefix("package://")
        names = (name, name.partition("/")[2])
    else:
        names = (name,)
    for path in (folder / name for folder in folders for name in names):
        if path.is_file():
            try:
                read = trimesh.load_mesh(path)
                if not len(read.faces):
                    return None
                return Surface(np.asarray(read.vertices) * mesh.scale, np.asarray(read.faces)).moved(mesh.T_link_mesh)
            except Exception:  # each reader of each format has errors of its own
                return None
    return None


def _turned(profile: np.ndarray) -> Surface:
    """Return the surface that a profile (K, 2) of radius and height, from the top down, makes about the z axis."""
    angle = 2.0 * np.pi * np.arange(_SIDES) / _SIDES
    rings = [np.stack([r * np.cos(angle), r * np.sin(angle), np.full(_SIDES, z)], axis=1) for r, z in profile]
    k, i = np.meshgrid(np.arange(len(profile) - 1), np.arange(_SIDES), indexing="ij")
    upper, lower = k * _SIDES + i, (k + 1) * _SIDES + i
    after = (i + 1) % _SIDES - i
    faces = np.stack([upper, lower, lower + after, upper, lower + after, upper + after], axis=-1).reshape(-1, 3)
    return Surface(np.concatenate(rings), faces)


def _together(parts: Sequence[Surface]) -> Surface:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    faces = [part.faces + start for part, start in zip(parts, starts)]
    return Surface(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))
