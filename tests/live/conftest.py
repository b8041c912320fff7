"""One server for all tests without a browser; each begins with an empty scene and panel."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from armlab import live


@pytest.fixture(scope="session")
def _server() -> Iterator[Any]:
    pytest.importorskip("viser", reason="the view in the browser needs the extra `live`")
    server = live.start(0)
    yield server
    live.stop(server)


@pytest.fixture
def server(_server: Any) -> Any:
    _server.scene.reset()
    _server.gui.reset()
    return _server
