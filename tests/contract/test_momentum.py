"""The compiled momentum filter gives what the NumPy reference gives."""

from __future__ import annotations

import numpy as np
import pytest

from armlab.kernels import _reference

native = pytest.importorskip("armlab.kernels._native", reason="the extension is not built here", exc_type=ImportError)


@pytest.mark.parametrize(("n", "m"), [(1, 1), (2, 6), (6, 6), (7, 6), (7, 13), (9, 15)])
def test_steps_agree(n: int, m: int) -> None:
    rng = np.random.default_rng(n + 100 * m)
    x, root = rng.standard_normal(n + m), rng.standard_normal((n + m, n + m))
    P, G = root @ root.T, rng.standard_normal((n, m))
    for _ in range(30):
        u, y, spread = *rng.standard_normal((2, n)), rng.standard_normal((n, n))
        a = np.where(rng.random(m) < 0.3, 0.0, rng.uniform(0, 30, m))
        arguments = (x, P, G, u, y, 1e-3 * spread @ spread.T, 0.004, rng.uniform(0.1, 1, n), rng.uniform(0.1, 1, m), a)
        ours, wanted = native.momentum_step(*arguments), _reference.momentum_step(*arguments)
        for a_, b in zip(ours, wanted):
            np.testing.assert_allclose(a_, b, rtol=0, atol=1e-12 * np.abs(b).max())
        x, P = wanted
