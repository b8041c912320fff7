"""Nodes are told only what changed."""

from __future__ import annotations

from typing import Any

import numpy as np

from armlab.live.bodies import arrow
from armlab.live.scene import SceneNode, rgb, solid


class Handle:
    def __init__(self) -> None:
        self.told: list[tuple[str, object]] = []

    def __setattr__(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)
        if name != "told":
            self.told.append((name, value))


def test_the_same_again_is_not_told() -> None:
    handle = Handle()
    node = SceneNode(handle)
    for position in ((0.0, 0.0, 1.0), (0.0, 0.0, 1.0), (0.0, 0.0, 2.0), (0.0, 0.0, 1.0)):
        node.set(position=position, color=(1, 2, 3))
    node.set(color=(3, 2, 1))
    assert handle.told == [
        ("position", (0.0, 0.0, 1.0)),
        ("color", (1, 2, 3)),
        ("position", (0.0, 0.0, 2.0)),
        ("position", (0.0, 0.0, 1.0)),
        ("color", (3, 2, 1)),
    ]


def test_colours_are_read() -> None:
    assert rgb("#0072B2") == (0, 114, 178)


def test_a_body_stands_in_the_scene_in_its_colour(server: Any) -> None:
    body = arrow()
    handle = solid(server.scene, "/arrow", body, "#0072B2")
    assert handle is server.scene.get_handle_by_name("/arrow")
    np.testing.assert_allclose(handle.vertices, body.vertices, atol=1e-7)
    np.testing.assert_array_equal(handle.faces, body.faces)
    assert tuple(handle.color) == rgb("#0072B2")
