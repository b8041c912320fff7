"""``armlab fleet``: the verbs over many robots."""

from __future__ import annotations

import json
import socket
import threading
from pathlib import Path

import pytest

from armlab import cli
from armlab.cli.fleet import fleet, list_fleet, record, router
from armlab.fleet import Router


@pytest.fixture
def port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_the_verbs_are_there() -> None:
    assert {fleet[name].default_command for name in ("router", "record", "list")} == {router, record, list_fleet}


def test_a_router_says_where_it_listens(port: int, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["fleet", "router", "--port", str(port), "--seconds", "0"]) == 0
    assert capsys.readouterr().err == f"zenoh router at tcp/127.0.0.1:{port}\n"


def test_a_router_beyond_this_computer_asks_for_users(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["fleet", "router", "--listen", "0.0.0.0"]) == cli.WRONG_USE
    assert "Expected certificates and users" in capsys.readouterr().err


def test_an_empty_fleet(port: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with Router(port=port):
        where = ["--router", f"127.0.0.1:{port}"]
        assert cli.main(["fleet", "list", *where, "--seconds", "0"]) == 0
        assert capsys.readouterr().out == "No robot is there.\n"
        assert cli.main(["fleet", "list", *where, "--json"]) == 0
        assert json.loads(capsys.readouterr().out) == []
        assert cli.main(["fleet", "record", *where, "-o", str(tmp_path / "new"), "--seconds", "0"]) == 0
        assert capsys.readouterr().out == "No robot came.\n"
    assert threading.active_count() < 20  # what listened has ended


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        ("list --router nowhere:port", cli.WRONG_USE, "Expected a place like zenoh://"),
        ("list --lab *", cli.WRONG_USE, "Expected a place like zenoh://"),
        ("list --ca none.pem", cli.WRONG_USE, "Expected the file none.pem"),
        ("record -o taken", cli.WRONG_USE, "Expected a folder for the recordings, got the file taken"),
        ("router --port 70000", cli.WRONG_USE, "Expected a port from 0 to 65535"),
    ],
)
def test_wrong_words_get_a_sentence(
    words: str,
    code: int,
    said: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "taken").write_text("mine")
    assert cli.main(["fleet", *words.split()]) == code
    assert said in capsys.readouterr().err
