"""Access control over Zenoh, on this computer: passwords, certificates, one user with command rights."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab.bridge.cell import listening
from armlab.bridge.servers.hub import Hub
from armlab.bridge.servers.zenoh.feed import robots_at
from armlab.bridge.servers.zenoh.messages import Attachment, key
from armlab.bridge.servers.zenoh.process import ZenohProcess
from armlab.bridge.servers.zenoh.security import BRIDGE, COMMANDER, Security
from armlab.bridge.servers.zenoh.session import LabAddress, open_near, queried, wait_for_router
from armlab.cli.bridge import write_certificates
from armlab.errors import ConfigError, LinkError
from armlab.robots import Robot

from ....processes import free_port
from ..conftest import cell_of, until
from .conftest import Running, heard

pytestmark = pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")
Start = Callable[..., Running]
Open = Callable[..., Any]


@pytest.fixture(scope="session")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lab")
    write_certificates(folder)
    return folder


def bridge_files(lab: Path) -> dict[str, str]:
    files = {"ca": "lab.pem", "certificate": "bridge.pem", "key": "bridge.key", "users": "users.txt"}
    return {name: str(lab / file) for name, file in files.items()}


def user(lab: Path, name: str) -> dict[str, str]:
    return {"lab": "lab1", "ca": str(lab / "lab.pem"), "secret": str(lab / f"{name}.secret")}


def test_a_commander_commands_and_a_viewer_reads(start: Start, session: Open, lab: Path, robot: Robot) -> None:
    one = start(**bridge_files(lab))
    assert one.exchange.outlets["zenoh"].where[0].startswith("tls/127.0.0.1:")  # type: ignore[index]
    port = one.options["port"]
    commander, viewer = session(port, **user(lab, "commander")), session(port, **user(lab, "viewer"))
    rows = {name: heard(who, key("lab1", robot.name, "live")) for name, who in (("c", commander), ("v", viewer))}
    until(lambda: one.row() and all(rows.values()))
    assert robots_at(viewer) == [("lab1", robot.name)]
    assert queried(viewer, key("lab1", robot.name, "param/gain"), 5.0)
    where, wanted = key("lab1", robot.name, "command/position"), np.asarray(robot.q_home) + 0.01
    count = iter(range(10**6))

    def put(who: Any, sender: bytes) -> Any:
        who.put(where, wanted.tobytes(), attachment=Attachment(sender, next(count), 0).pack())
        who.put(key("lab1", robot.name, "param/gain"), "0.75")
        return one.commanded()

    sent = len(rows["v"])
    until(lambda: put(viewer, b"v" * 16) is None and len(rows["v"]) > sent + 200)
    assert not one.exchange.arbiter.obeyed[robot.name], "a viewer's commands vanish"
    assert not one.exchange.arbiter.refused
    assert one.exchange.parameters.gain == 0.5
    until(lambda: put(commander, b"c" * 16) is not None)
    until(lambda: one.exchange.poll() or one.exchange.parameters.gain == 0.75)
    assert list(one.exchange.arbiter.obeyed[robot.name]) == [f"zenoh {(b'c' * 16).hex()}"]
    until(lambda: viewer.put(key("lab1", robot.name, "stop"), b"") or (one.row() and one.exchange.arbiter.stopped))


@pytest.mark.slow
def test_who_is_not_let_in(start: Start, lab: Path, tmp_path: Path, robot: Robot) -> None:
    one = start(**bridge_files(lab))
    write_certificates(tmp_path / "other")
    other = tmp_path / "other"
    for name, text in (("wrong", "commander:guess\n"), ("unknown", "mallory:guess\n")):
        (other / f"{name}.secret").write_text(text)
        (other / f"{name}.secret").chmod(0o600)
    right = user(lab, "commander")
    for options in (
        {**right, "secret": str(other / "wrong.secret")},
        {**right, "secret": str(other / "unknown.secret")},
        {**right, "secret": ""},
        {**right, "ca": str(other / "lab.pem")},
        {**right, "ca": ""},
    ):
        with pytest.raises(LinkError, match="got no connection"):
            LabAddress.of("127.0.0.1", one.options["port"], options).open(0.7)
    one.row()
    assert not one.exchange.arbiter.refused
    assert not one.exchange.arbiter.obeyed[robot.name]


def test_passwords_alone_do_not_encrypt_but_keep_viewers_from_commanding(
    start: Start, session: Open, lab: Path, robot: Robot
) -> None:
    one = start(users=str(lab / "users.txt"))
    viewer = session(one.options["port"], lab="lab1", secret=str(lab / "viewer.secret"))
    rows = heard(viewer, key("lab1", robot.name, "live"))

    def read() -> bool:
        data = np.asarray(robot.q_home).tobytes()
        viewer.put(key("lab1", robot.name, "command/position"), data, attachment=Attachment(b"v" * 16, 1, 0).pack())
        return one.commanded() is None and len(rows) > 100

    until(read)


def test_commands_beyond_this_computer_need_both(lab: Path) -> None:
    files = bridge_files(lab)
    assert listening(["zenoh=127.0.0.1"], cell_of("zenoh")) == {"zenoh": "127.0.0.1"}
    for names in ((), ("ca", "certificate", "key"), ("users",)):
        cell = cell_of("zenoh", "".join(f'{name} = "{files[name]}"\n' for name in names))
        with pytest.raises(ConfigError, match="needs a secret and encryption"):
            listening(["zenoh=0.0.0.0"], cell)
    cell = cell_of("zenoh", "".join(f'{name} = "{path}"\n' for name, path in files.items()))
    assert listening(["zenoh=0.0.0.0"], cell) == {"zenoh": "0.0.0.0"}


def test_commands_through_a_router_elsewhere_need_both(robot: Robot) -> None:
    hub = Hub([robot], ["zenoh"], about={"commands": ["zenoh"]})
    options = {"lab": "lab", "host": "127.0.0.1", "port": free_port(), "router": "192.168.1.9:7447"}
    with hub.open("zenoh") as feed, pytest.raises(ConfigError, match="7447 is on another computer"):
        ZenohProcess(feed, options)
    hub.close()


def test_a_bridge_comes_to_a_router_with_passwords(lab: Path) -> None:
    files, far, own = bridge_files(lab), free_port(), free_port()
    open_near("127.0.0.1", far, security=Security.of(files))
    secret = {"secret": str(lab / "bridge.secret")}
    place = f"127.0.0.1:{far}"
    reading, where = open_near("127.0.0.1", own, place, Security.of({"ca": files["ca"], **secret}))
    assert where == f"tls (zenoh, only through the router at {place})"
    assert wait_for_router(reading, 20.0)
    _, where = open_near("127.0.0.1", own, place, Security.of({**files, **secret}), commands=True)
    assert where == f"tls/127.0.0.1:{own} (zenoh, through the router at {place})"
    LabAddress.of("127.0.0.1", own, user(lab, "commander")).open(20.0)


def test_configuration(lab: Path) -> None:
    values = Security.of(bridge_files(lab)).values(listens=True)
    rules = values["access_control"]
    assert (rules["enabled"], rules["default_permission"]) == (True, "deny")
    assert [one.get("usernames") for one in rules["subjects"]] == [None, [COMMANDER], [BRIDGE]]
    commands = next(rule for rule in rules["rules"] if rule["id"] == "command")
    assert (commands["flows"], commands["messages"]) == (["ingress"], ["put"])
    assert commands["key_exprs"] == ["armlab/*/*/command/**", "armlab/*/*/param/**"]
    assert "access_control" not in Security.of(user(lab, "viewer")).values(listens=False)
    assert Security().values(listens=True) == {}


def test_files_that_do_not_fit(lab: Path, tmp_path: Path) -> None:
    texts = {"open": "a:b\n", "users": "viewer:x\n\n", "two": "a:b\nc:d\n", "bad": "nothing\n"}
    files = {name: tmp_path / name for name in texts}
    for name, file in files.items():
        file.write_text(texts[name])
        file.chmod(0o644 if name == "open" else 0o600)
    for options, words in (
        ({"secret": tmp_path / "none"}, "found none"),
        ({"secret": tmp_path / ("long" * 100)}, "found none"),
        ({"secret": files["open"]}, "chmod 600"),
        ({"secret": files["two"]}, "got 2"),
        ({"secret": files["bad"]}, "line 1 of"),
        ({"users": files["users"]}, "commander:PASSWORD"),
        ({"certificate": lab / "bridge.pem", "ca": lab / "lab.pem"}, "all of"),
        ({"certificate": lab / "bridge.pem", "key": lab / "bridge.key"}, "all of"),
    ):
        with pytest.raises(ConfigError, match=words):
            Security(**options)
    for name in ("~nobody-has-this-name/secret", "~\0/secret"):
        with pytest.raises(ConfigError, match="files on this computer"):
            Security.of({"secret": name})
