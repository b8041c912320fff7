"""Nodes of viser's scene: a `Node` is told only what changed."""

from __future__ import annotations

from typing import Any

import numpy as np

from armlab.live.bodies import Body

__all__ = ["Node", "rgb", "solid"]


class Node:
    """Remembers what it set: viser takes longer to find that a pose is the old one than to send a new one.

    Parameters
    ----------
    handle : of the node; nobody else sets what is set here.

    Attributes
    ----------
    handle : the same.
    """

    def __init__(self, handle: Any) -> None:
        self.handle, self._set = handle, dict[str, tuple[float, ...]]()

    def set(self, **values: tuple[float, ...]) -> None:
        """Set attributes of the handle: ``position``, ``wxyz``, ``scale`` or ``color``.

        Parameters
        ----------
        values : by name.
        """
        for name, value in values.items():
            if self._set.get(name) != value:
                setattr(self.handle, name, value)
                self._set[name] = value


def solid(scene: Any, name: str, body: Body, color: str) -> Any:
    """Add a body and return viser's handle of it.

    Parameters
    ----------
    scene : ``server.scene``. name : of the node. body : in its axes. color : such as "#0072B2".
    """
    return scene.add_mesh_simple(name, body.vertices.astype(np.float32), body.faces.astype(np.uint32), color=rgb(color))


def rgb(color: str) -> tuple[int, int, int]:
    """Return red, green and blue, 0 to 255, of a colour such as "#0072B2".

    Parameters
    ----------
    color : as in style sheets.
    """
    red, green, blue = bytes.fromhex(color.removeprefix("#"))
    return red, green, blue
