"""Rows of a design in pieces: together they are all of it, once for each reading."""

from __future__ import annotations

import numpy as np

from armlab.identify import regression
from armlab.identify.regression import DesignRows


def test_pieces_are_all_rows_of_all_joints_and_come_again(monkeypatch) -> None:
    monkeypatch.setattr(regression, "AT_ONCE", 4)
    rng = np.random.default_rng(0)
    tau, trust, block = rng.standard_normal((10, 2)), rng.uniform(0, 1, (10, 2)), np.arange(10) // 3
    rigid, local = [rng.standard_normal((10, w)) for w in (3, 2)], [rng.standard_normal((10, k)) for k in (1, 2)]
    columns = [np.array([0, 1, 2, 4]), np.array([1, 2, 5, 6])]
    rows = DesignRows(tau, rigid, local, columns, block, trust)
    for found in (list(rows), list(rows)):
        assert [piece.group for piece in found] == [0, 0, 0, 1, 1, 1]
        for joint in range(2):
            own = [piece for piece in found if piece.group == joint]
            whole = np.hstack([rigid[joint], local[joint]])
            np.testing.assert_array_equal(np.vstack([piece.A for piece in own]), whole * trust[:, joint, None])
            np.testing.assert_array_equal(np.concatenate([piece.y for piece in own]), (tau * trust)[:, joint])
            np.testing.assert_array_equal(np.concatenate([piece.block for piece in own]), block)
            assert all(piece.columns is columns[joint] for piece in own)
    plain = list(DesignRows(tau, rigid, local, columns, block, None))
    np.testing.assert_array_equal(np.concatenate([piece.y for piece in plain]), tau.T.ravel())
