"""The page of docs/how_to/web_client.md in headless Chromium, beside the cell of that page."""

from __future__ import annotations

import contextlib
import functools
import http.server
import re
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import robots
from armlab.bridge.cell import parse_cell

from ...bridge.servers.conftest import play
from ...processes import free_port

pytest.importorskip("websockets", reason="the extra net is not installed")
pytestmark = pytest.mark.slow

TEXT = (Path(__file__).parents[3] / "docs" / "how_to" / "web_client.md").read_text(encoding="utf-8")


def block(kind: str) -> str:
    found = re.search(rf"^```{kind}\n(.*?)^```$", TEXT, flags=re.M | re.S)
    assert found is not None
    return found[1]


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: Any) -> None:
        pass


def test_the_page_shows_joint_states_and_is_turned_away_as_a_file(
    browse: Callable[[str], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    port = free_port()
    (tmp_path / "page.html").write_text(block("html").replace("9090", str(port)))
    handler = functools.partial(Quiet, directory=str(tmp_path))
    shown: list[str] = []

    def script() -> None:
        with contextlib.ExitStack() as stack:
            server = stack.enter_context(http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler))
            threading.Thread(target=server.serve_forever, daemon=True).start()
            stack.callback(server.shutdown)
            page = browse(f"http://localhost:{server.server_port}/page.html")
            stack.callback(page.close)
            page.wait("document.querySelectorAll('#joints tr').length === 7")
            shown.append(page.text())
            file = browse((tmp_path / "page.html").as_uri())
            stack.callback(file.close)
            file.wait("!!document.getElementById('said')?.textContent")
            shown.append(file.text())
            page.picture(tmp_path / "page.png")

    cell = parse_cell(f"{block('toml')}port = {port}\n")
    run = play(monkeypatch, cell, script)
    found = re.findall(r"^(\S+)\s+(\S+) rad$", shown[0], flags=re.M)
    assert [name for name, _ in found] == [f"yumi_robl_joint_{k}" for k in range(1, 8)]
    np.testing.assert_allclose([float(q) for _, q in found], robots.load("yumi_left").q_home, rtol=0, atol=1e-3)
    assert shown[1].strip() == "The bridge has gone, or does not let this page connect."
    assert run.statistics["problems"] == []
