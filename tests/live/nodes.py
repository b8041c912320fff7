"""Nodes of the scene as numbers."""

from __future__ import annotations

from typing import Any

import numpy as np

from armlab.lie import quaternion, se3


def node(server: Any, name: str) -> Any:
    found = server.scene.get_handle_by_name(name)
    assert found is not None, name
    return found


def pose(handle: Any) -> np.ndarray:
    return se3.from_rp(quaternion.to_matrix(handle.wxyz), handle.position)


def link(arm: str, number: int) -> str:
    """Return the name of a link's node: nested below the previous links."""
    return f"/{arm}/arm" + "".join(f"/link_{i}" for i in range(1, number + 1))


def tool(server: Any, arm: str, n: int) -> np.ndarray:
    found = np.eye(4)
    for i in range(1, n + 1):
        found = found @ pose(node(server, link(arm, i)))
    return found @ pose(node(server, f"{link(arm, n)}/tool"))


def tip(arrow: Any) -> np.ndarray:
    return (pose(arrow) @ [0.0, 0.0, arrow.scale[2], 1.0])[:3]
