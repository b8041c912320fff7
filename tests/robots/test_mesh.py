"""A mesh is a reference with a pose, checked and compared by content."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from armlab.errors import RobotError
from armlab.lie import se3
from armlab.robots import Mesh

FILE = "package://maker/link_1.stl"
GOOD = {"kind": "visual", "file": FILE, "T_link_mesh": np.eye(4), "scale": (1, 1, 1)}


def test_equal_by_content_and_read_only() -> None:
    T_link_mesh = se3.exp([1, 2, 3, 0.1, 0.2, 0.3])
    mesh = Mesh("collision", FILE, T_link_mesh, np.array([0.001, 0.001, -0.001]))
    twin = pickle.loads(pickle.dumps(mesh))
    assert twin == mesh
    assert hash(twin) == hash(mesh)
    assert mesh != Mesh("visual", FILE, T_link_mesh, mesh.scale)
    assert mesh != Mesh("collision", FILE, np.eye(4), mesh.scale)
    assert mesh != FILE
    T_link_mesh[0, 3] = 9.0
    assert mesh.T_link_mesh[0, 3] != 9.0
    for array in (twin.T_link_mesh, twin.scale):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0.0


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"kind": "picture"}, 'Expected "visual" or "collision" as kind of mesh .* got \'picture\''),
        ({"file": ""}, "Expected the file name of a mesh, got ''"),
        ({"T_link_mesh": 2 * np.eye(4)}, r"Expected a pose \(4, 4\) of mesh"),
        ({"T_link_mesh": np.eye(3)}, r"Expected a pose \(4, 4\) of mesh"),
        ({"scale": (1, 0, 1)}, "Expected 3 finite factors of mesh .* other than 0"),
        ({"scale": (1, np.nan, 1)}, "Expected 3 finite factors"),
        ({"scale": "one"}, "Expected scale of mesh .* to be real numbers, got 'one'"),
        ({"file": 5}, "Expected the file name of a mesh, got 5"),
        ({"scale": (1, 1)}, "Expected 3 finite factors"),
    ],
)
def test_what_is_no_mesh_is_refused(wrong: dict, sentence: str) -> None:
    with pytest.raises(RobotError, match=sentence):
        Mesh(**(GOOD | wrong))
