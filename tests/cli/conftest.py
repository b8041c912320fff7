"""Shared helpers of the command tests."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
import pytest

from armlab.cli import main


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Callable[..., pytest.CaptureResult[str]]:
    """Return a function that runs a command in this process, checks its exit code and returns its output."""

    def run(words: Iterable[object], code: int = 0) -> pytest.CaptureResult[str]:
        found = main([str(word) for word in words])
        said = capsys.readouterr()
        assert found == code, said.err
        return said

    return run


def samples_csv(path: Path, columns: dict[str, np.ndarray]) -> Path:
    """Write poses (N, 4, 4), points (N, K, 3), vectors (N, k) and numbers (N,) as CSV; NaN is an empty cell."""
    flat: dict[str, np.ndarray] = {}
    for name, value in columns.items():
        if value.shape[1:] == (4, 4):
            flat |= {f"{name}{i + 1}_{j + 1}": value[:, i, j] for i in range(4) for j in range(4)}
        elif value.ndim == 3:
            flat |= {
                f"{name}{k + 1}_{axis}": value[:, k, i] for k in range(value.shape[1]) for i, axis in enumerate("xyz")
            }
        else:
            flat |= {f"{name}{k + 1}": value[:, k] for k in range(value.shape[1])} if value.ndim == 2 else {name: value}
    rows = [",".join("" if np.isnan(x) else repr(float(x)) for x in row) for row in zip(*flat.values(), strict=True)]
    path.write_text("\n".join([",".join(flat), *rows]), encoding="utf-8")
    return path
