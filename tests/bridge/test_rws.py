"""Robot Web Services client: servers trusted with a password, odd answers, and RAPID around a run."""

from __future__ import annotations

import logging
import socket
import threading
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest

from armlab import bridge, robots
from armlab.bridge.doctor.controller import RapidRun, controller_findings, known_tasks, tasks_for
from armlab.bridge.net.events import nobody
from armlab.bridge.rws import PASSWORD, USER, Credentials, open_controller, setup_steps, split_host
from armlab.errors import ConfigError, LinkError, MissingExtra, UnknownName

from ..processes import RWS_PASSWORD, RWS_USER, free_port, rws_controller

pytest.importorskip("abb_robot_client", reason="needs abb_robot_client of the extra abb")
OURS = Credentials(RWS_USER, RWS_PASSWORD)


@pytest.fixture(autouse=True)
def credentials(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(USER, RWS_USER)
    monkeypatch.setenv(PASSWORD, RWS_PASSWORD)


@contextmanager
def odd_server(status: int = 200, body: bytes = b"", **headers: str) -> Iterator[tuple[str, list[str]]]:
    """Request digest authentication, then send the given answer; yield the address and the received credentials."""
    received: list[str] = []

    class Odd(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            given = self.headers.get("Authorization", "")
            challenge = headers.get("challenge", 'Digest realm="r", nonce="n", qop="auth"')
            if given:
                received.append(given)
            self.send_response(status if given else 401)
            for name, value in (headers if given else {"WWW-Authenticate": challenge}).items():
                self.send_header(name.replace("_", "-"), value)
            self.end_headers()
            self.wfile.write(body if given else b"")

        do_POST = do_GET

        def log_message(self, format: str, *args: object) -> None: ...

    server = HTTPServer(("127.0.0.1", 0), Odd)
    thread = threading.Thread(target=server.serve_forever, args=(0.05,))
    thread.start()
    try:
        yield f"127.0.0.1:{server.server_port}", received
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


JSON = "application/json"
ODD: list[tuple[str, int, bytes, dict[str, str]]] = [
    ("user and password", 401, b"", {"WWW_Authenticate": 'Digest realm="r", nonce="n", qop="auth"'}),
    ("got a redirect to another host", 302, b"", {"Location": "http://192.0.2.1/"}),
    ("HTTP 404", 404, b"<html>", {"Content_Type": "text/html"}),
    ("too many sessions", 503, b"", {}),
    ("lacks the required grant", 403, b'{"_embedded": {"status": {"code": -1073445863}}}', {"Content_Type": JSON}),
    ("HTTP 403", 403, b'{"_embedded": {"status": {"code": "x"}}}', {"Content_Type": JSON}),
    ("HTTP 500", 500, b'[["code"]]', {"Content_Type": JSON}),
    ("at most", 200, b"x" * ((4 << 20) + 1), {"Content_Type": JSON}),
    ("got unexpected data", 200, b"hello", {"Content_Type": JSON}),
    ("got unexpected data", 200, b"hello", {}),
    ("got unexpected data", 200, b"null", {"Content_Type": JSON}),
    ("got unexpected data", 200, b'{"_embedded": {}}', {"Content_Type": JSON}),
    ("got unexpected data", 200, b'{"_embedded": {"_state": [1]}}', {"Content_Type": JSON}),
    ("no connection", 200, b"short", {"Content_Type": JSON, "Content_Length": "100"}),
]


@pytest.mark.parametrize(("words", "status", "body", "headers"), ODD)
def test_odd_answers_are_one_sentence(words: str, status: int, body: bytes, headers: dict[str, str]) -> None:
    with odd_server(status, body, **headers) as (host, _), open_controller(host, lambda: OURS) as controller:
        with pytest.raises(LinkError, match=words) as caught:
            controller.status()
        assert str(caught.value).startswith("Expected ")


def test_a_password_is_sent_in_digests_or_over_trusted_tls_only(tmp_path: Path) -> None:
    with odd_server(challenge="Basic realm=r") as (host, received):
        with pytest.raises(LinkError, match="no password was sent"):
            open_controller(host, lambda: OURS)
        assert received == []
    with rws_controller(tmp_path, "7") as served:
        with pytest.raises(LinkError, match="--insecure"):
            open_controller(served.host, lambda: pytest.fail("asked for a password"))
        with pytest.raises(LinkError, match="a certificate file"):
            open_controller(served.host, lambda: OURS, ca=str(tmp_path / "none.pem"))
        for verify in ({"insecure": True}, {"ca": str(served.ca)}):
            with open_controller(served.host, lambda: OURS, **verify) as controller:  # type: ignore[arg-type]
                assert controller.status().robotware == "7.10.0"


def test_slow_and_silent_servers_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armlab.bridge.rws._TIMEOUT", 0.1)
    with socket.create_server(("127.0.0.1", 0)) as silent, pytest.raises(LinkError, match="no answer"):
        open_controller(f"127.0.0.1:{silent.getsockname()[1]}", lambda: OURS)
    with odd_server(200, b"{}", Content_Type=JSON) as (host, _), open_controller(host, lambda: OURS) as controller:
        monkeypatch.setattr("armlab.bridge.rws._TIMEOUT", 20.0)
        monkeypatch.setattr("armlab.bridge.rws._LONGEST", -1.0)
        with pytest.raises(LinkError, match="within -1 s"):
            controller.status()


def test_neither_proxies_nor_stored_passwords_are_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("http_proxy", "https_proxy"):
        monkeypatch.setenv(name, f"http://127.0.0.1:{free_port()}")
    (tmp_path / "netrc").write_text(f"default login {RWS_USER} password {RWS_PASSWORD}")
    monkeypatch.setenv("NETRC", str(tmp_path / "netrc"))
    with odd_server() as (host, received), open_controller(host, lambda: OURS):
        assert received == []
    with rws_controller(tmp_path) as served, open_controller(served.host, lambda: OURS) as controller:
        assert controller.status().mode == "AUTO"


HOSTS: list[tuple[type[Exception], str, Callable[[], object]]] = [
    (ConfigError, USER, lambda: split_host(f"me:{RWS_PASSWORD}@192.0.2.1")),
    (ConfigError, "HOST:PORT", lambda: split_host("192.0.2.1:port")),
    (ConfigError, "HOST:PORT", lambda: split_host("ftp://192.0.2.1")),
    (ConfigError, "HOST:PORT", lambda: split_host("192.0.2.1/rw")),
    (ConfigError, "HOST:PORT", lambda: split_host("")),
    (ConfigError, "Omit one", lambda: open_controller("192.0.2.1", lambda: OURS, True, "ca.pem")),
    (LinkError, "port 80, RobotWare 7 on 443", lambda: open_controller(f"127.0.0.1:{free_port()}", lambda: OURS)),
    (ConfigError, "without a password", lambda: link(f"egm://me:{RWS_PASSWORD}@127.0.0.1:0")),
    (ConfigError, "without a password", lambda: link(f"egm://127.0.0.1:0?rws=me:{RWS_PASSWORD}@192.0.2.1")),
    (ConfigError, "only the options rws=HOST", lambda: link("egm://127.0.0.1:0?insecure=true")),
    (ConfigError, "only the options rws=HOST", lambda: link("egm://127.0.0.1:0?rws=h&seed=1")),
    (ConfigError, "insecure=true", lambda: link("egm://127.0.0.1:0?rws=h&insecure=maybe")),
]


def link(url: str) -> object:
    return bridge.connect(url, robots.load("yumi_left"))


@pytest.mark.parametrize(("error", "words", "make"), HOSTS)
def test_wrong_addresses(error: type[Exception], words: str, make: Callable[[], object]) -> None:
    with pytest.raises(error, match=words) as caught:
        make()
    assert RWS_PASSWORD not in str(caught.value)


def test_credentials(monkeypatch: pytest.MonkeyPatch) -> None:
    assert RWS_PASSWORD not in f"{OURS!r} {OURS}"
    monkeypatch.delenv(USER)
    assert Credentials.from_environment().user == "Default User"
    monkeypatch.delenv(PASSWORD)
    assert Credentials.from_environment(lambda text: "typed").password == "typed"
    with pytest.raises(ConfigError, match=PASSWORD):
        link("egm://127.0.0.1:0?rws=192.0.2.1")


@pytest.mark.parametrize("robotware", ["6.10", "7"])
def test_no_text_holds_the_password(tmp_path: Path, robotware: str, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    with rws_controller(tmp_path, robotware, ["password"]) as served:
        controller = open_controller(served.host, lambda: OURS, ca=str(served.ca or ""))
        with pytest.raises(LinkError, match="user and password, but the controller refused them") as caught:
            controller.status()
    error: BaseException | None = caught.value
    texts = [caplog.text, repr(controller), repr(vars(controller))]
    while error is not None:
        frames = traceback.TracebackException.from_exception(error, capture_locals=True)
        texts.append("".join(frames.format()))
        error = error.__context__
    assert "urllib3" in texts[0]
    told = "\n".join(texts).lower()
    for form in (RWS_PASSWORD, "b3BlcmF0b3I6a2VwdC1mcm9t"):  # base64, as in basic authentication
        assert form.lower() not in told


def module(side: str) -> str:
    device = f"armlab_{side.lower()}"
    setup = f'EGMSetupUC ROB_{side}, guide, "armlab", "{device}";'
    return f"MODULE ArmlabYumi{side}\nPROC main()\n{setup}\nENDPROC\nENDMODULE"


def test_rapid_runs_around_a_run_and_only_if_it_was_started_for_it(tmp_path: Path) -> None:
    with rws_controller(tmp_path, robots=["yumi_left", "yumi_right"]) as served:
        rapid, told = RapidRun(served.host), []
        with pytest.raises(LinkError, match="armlab abb setup"), rapid.running([6511], nobody):
            pass
        with open_controller(served.host, lambda: OURS) as controller:
            status = controller.status(texts=True)
            for step in setup_steps(controller, status, known_tasks(status), {f"T_ROB_{x}": module(x) for x in "LR"}):
                step.run()
            assert served.box.holder == ""
            with controller.mastership():
                assert controller.status().holder == ""
        with rapid.running([6512, 6511], lambda text, *_: told.append(text)):
            assert [task.runs for task in served.box.tasks] == [True, True]
            with rapid.running([6511], nobody):
                pass
            assert served.box.is_running  # RAPID was already running
        assert not served.box.is_running
        assert [text.partition(": ")[2] for text in told][-2:] == ["start RAPID in T_ROB_R, T_ROB_L", "stop RAPID"]
        with rapid.running([6512, 6511], nobody, lambda: True):
            assert not served.box.is_running  # interrupted before

        def lost(text: str, *_: Any) -> None:
            if "start RAPID" in text:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt), rapid.running([6512, 6511], lost):
            pass
        assert not served.box.is_running
        with pytest.raises(LinkError, match="got T_ROB_L to 6511, T_ROB_R to 6512"), rapid.running([6519], nobody):
            pass
        with rapid.running([6511], nobody):
            assert [task.runs for task in served.box.tasks] == [True, False]
            with pytest.raises(LinkError, match="busy"), rapid.running([6512], nobody):
                pass
    with pytest.raises(LinkError, match="no answer"), rapid.running([6511], nobody):
        pass


def load(served: Any, text: str) -> None:
    served.box.put("$HOME/A.mod", text.encode())
    served.box.load(served.box.task("T_ROB_L"), "$HOME/A.mod", False)


def test_a_controller_that_is_gone_at_the_end_is_a_warning(tmp_path: Path) -> None:
    told: list[tuple[str, bool]] = []
    with rws_controller(tmp_path) as served:
        load(served, module("L"))
        running = RapidRun(served.host).running([6511], lambda text, warn=False, each=False: told.append((text, warn)))
        running.__enter__()
    running.__exit__(None, None, None)
    assert told[-1][0].startswith("RAPID may still be running")
    assert told[-1][1]


def test_a_program_that_stops_at_once_is_named_by_the_event_log(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setattr("armlab.bridge.rws._SETTLING", 0.2)
    with rws_controller(tmp_path) as served, open_controller(served.host, lambda: OURS) as controller:
        load(served, module("L").replace("armlab_l", "other"))
        served.box.reset_pointer()
        controller.motors_on()
        with pytest.raises(LinkError, match="41816 EGM cannot use armlab or other"):
            controller.start(["T_ROB_L"])


def test_tasks_that_armlab_does_not_know(tmp_path: Path) -> None:
    served = rws_controller(tmp_path, robots=["irb120", "irb120"])
    with served as at, open_controller(at.host, lambda: OURS) as controller:
        status = controller.status()
    assert [task.name for task in known_tasks(status)] == ["T_ROB1"]
    assert [task.name for task in tasks_for(status, [6511])] == ["T_ROB1"]
    with pytest.raises(UnknownName, match="T_ROB1"):
        known_tasks(status, ["T_ROB2"])
    assert {one.verdict for one in controller_findings(status, known_tasks(status))} == {"ok", "warning"}


def test_without_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "abb_robot_client", None)
    with pytest.raises(MissingExtra, match="armlab\\[abb\\]"):
        open_controller("192.0.2.1", lambda: OURS)
