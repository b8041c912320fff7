"""Headless Chromium, driven by its DevTools protocol."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from armlab import live

FLAGS = """--headless=new --disable-gpu --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader
    --ignore-gpu-blocklist --disable-quic --no-first-run --disable-background-networking --disable-component-update
    --disable-sync --window-size=1400,960 --remote-debugging-port=0"""
ONLY_HERE = "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1, EXCLUDE localhost"
ONE_RESOLUTION = "fixedDpr=1"  # on a slow computer, viser lowers its resolution after a few seconds
PATIENCE = 120.0  # s for one answer of a browser that draws without a graphics card on a busy machine


class Page:
    """A page in the browser.

    Attributes
    ----------
    errors : list of str
        Errors on its console.
    requests : list of str
        Addresses requested by it or its workers.
    """

    def __init__(self, socket: Any) -> None:
        self._socket, self._number = socket, 0
        self.errors: list[str] = []
        self.requests: list[str] = []
        for domain in ("Runtime", "Log", "Network", "Page"):
            self.call(f"{domain}.enable")
        self.call("Target.setAutoAttach", autoAttach=True, waitForDebuggerOnStart=False, flatten=True)

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        number, until = self._ask(method, None, **parameters), time.monotonic() + PATIENCE
        while time.monotonic() < until:
            message = json.loads(self._socket.recv(timeout=PATIENCE))
            if message.get("id") == number:
                assert "error" not in message, message["error"]
                return message["result"]
            self._hear(message)
        raise TimeoutError(method)

    def _ask(self, method: str, session: str | None, **parameters: Any) -> int:
        self._number += 1
        request = {"id": self._number, "method": method, "params": parameters}
        self._socket.send(json.dumps(request | ({} if session is None else {"sessionId": session})))
        return self._number

    def _hear(self, event: dict[str, Any]) -> None:
        what, about = event.get("method", ""), event.get("params", {})
        if what == "Target.attachedToTarget":  # a worker: it has the socket to the server
            self._ask("Network.enable", about["sessionId"])  # not awaited: its answer may come after another's
        elif what in ("Network.requestWillBeSent", "Network.webSocketCreated"):
            self.requests.append(about["request"]["url"] if "request" in about else about["url"])
        elif what == "Runtime.exceptionThrown":
            self.errors.append(str(about["exceptionDetails"]))
        elif what == "Runtime.consoleAPICalled" and about["type"] == "error":
            self.errors.append(str(about["args"]))
        elif what == "Log.entryAdded" and about["entry"]["level"] == "error":
            self.errors.append(about["entry"]["text"])

    def close(self) -> None:
        self.call("Page.close")
        self._socket.close()

    def outside(self) -> list[str]:
        here = ("http://127.0.0.1:", "ws://127.0.0.1:", "data:", "blob:")
        return [url for url in self.requests if not url.startswith(here)]

    def value(self, script: str) -> Any:
        found = self.call("Runtime.evaluate", expression=script, returnByValue=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def text(self) -> str:
        return self.value("document.body.innerText")

    def wait(self, script: str) -> None:
        until = time.monotonic() + PATIENCE
        while not self.value(script):
            assert time.monotonic() < until, f"never true: {script}\n{self.text()}"
            time.sleep(0.1)

    def click(self, label: str) -> None:
        """Click the button with this label, once it has stopped moving and nothing covers it."""
        button = f"[...document.querySelectorAll('button')].find(one => one.innerText.trim() === {json.dumps(label)})"
        self.wait(f"!!({button})")
        script = f"""(button => {{
            const r = button.getBoundingClientRect(), at = [r.x + r.width / 2, r.y + r.height / 2];
            return [...at, button.contains(document.elementFromPoint(...at))];
        }})({button})"""
        last, until = None, time.monotonic() + PATIENCE
        while (place := self.value(script)) != last or not place[2]:
            assert time.monotonic() < until, f"the button {label!r} still moves or is covered: {place}"
            last = place
            time.sleep(0.1)
        for kind in ("mousePressed", "mouseReleased"):
            self.call("Input.dispatchMouseEvent", type=kind, x=place[0], y=place[1], button="left", clickCount=1)

    def picture(self, path: Path) -> None:
        path.write_bytes(base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"]))


@pytest.fixture(scope="session")
def _chromium(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    program = shutil.which("chromium") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no Chromium on this computer: apt-get install chromium")
    folder = tmp_path_factory.mktemp("chromium")
    sandbox = ["--no-sandbox"] if os.geteuid() == 0 else []
    command = [program, *FLAGS.split(), ONLY_HERE, *sandbox, f"--user-data-dir={folder}", "about:blank"]
    with (folder / "said.txt").open("w") as said:
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=said)
    port = folder / "DevToolsActivePort"
    until = time.monotonic() + PATIENCE
    while not (port.exists() and port.read_text().strip()):
        assert process.poll() is None, (folder / "said.txt").read_text()
        assert time.monotonic() < until, "Chromium did not open its DevTools"
        time.sleep(0.1)
    yield f"http://127.0.0.1:{port.read_text().split()[0]}"
    process.terminate()
    process.wait(timeout=PATIENCE)


@pytest.fixture(scope="session")
def browse(_chromium: str) -> Callable[[str], Page]:
    from websockets.sync.client import connect

    def open_(address: str) -> Page:
        asked = urllib.request.Request(f"{_chromium}/json/new?about:blank", method="PUT")
        with urllib.request.urlopen(asked, timeout=PATIENCE) as answer:
            about = json.load(answer)
        page = Page(connect(about["webSocketDebuggerUrl"], max_size=None, max_queue=None, proxy=None))
        page.call("Page.navigate", url=address)
        return page

    return open_


@pytest.fixture(scope="session")
def open_page(browse: Callable[[str], Page]) -> Iterator[Callable[[Any], Page]]:
    """Return the connected page of a server, in the foreground: only then does it send images.

    It stays open for the next test, since lighting the scene of a new page takes 20 s.
    """
    pages: dict[str, Page] = {}

    def open_(server: Any) -> Page:
        address = live.address(server)
        if address not in pages:
            pages[address] = browse(f"{address}/?{ONE_RESOLUTION}")
        page, until = pages[address], time.monotonic() + PATIENCE
        while not server.get_clients():
            assert time.monotonic() < until, page.text()
            time.sleep(0.1)
        page.call("Page.bringToFront")
        return page

    yield open_
    for page in pages.values():
        page.close()
