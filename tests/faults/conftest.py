"""The bench."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from .bench import Bench


@pytest.fixture
def make_bench(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> Callable[[], Bench]:
    """Return a factory of benches, each with its own virtual time; only one runs at a time."""
    return lambda: Bench(monkeypatch, tmp_path_factory.mktemp("logs"))


@pytest.fixture
def bench(make_bench: Callable[[], Bench]) -> Bench:
    return make_bench()
