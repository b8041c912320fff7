"""Robot Web Services of the simulated controller: tested with third-party clients, then misused."""

from __future__ import annotations

import base64
import http.client
import ssl
from pathlib import Path
from typing import Any

import pytest

from armlab import robots
from armlab.bridge.rws import Credentials, open_controller
from armlab.errors import LinkError, UnknownName
from armlab.sim.arm.arm import LaggingArm
from armlab.sim.controller.controller import SimulatedController
from armlab.sim.controller.rws import FAULTS, RwsServer, VirtualController
from armlab.sim.controller.settings import ControllerSettings
from armlab.sim.events import Surroundings
from armlab.wire.egm.robot_side import RobotSideCodec

from ..processes import RWS_PASSWORD, RWS_USER, RwsController, rws_controller

pytest.importorskip("abb_robot_client", reason="needs abb_robot_client of the extra abb")
MODULE = """MODULE Probe
  PERS num speed := 1.5;
  PROC main()
    EGMSetupUC ROB_L, guide, "armlab", "armlab_l" \\Joint;
  ENDPROC
ENDMODULE
"""


@pytest.mark.parametrize("robotware", ["6.07", "6.10", "7"])
def test_abb_robot_client(tmp_path: Path, robotware: str) -> None:
    """A third-party client for RobotWare 6, unmodified; for 7 over our translating transport."""
    from abb_robot_client.rws import RWS

    with rws_controller(tmp_path, robotware) as served:
        if served.ca is None:
            client = RWS(served.url, RWS_USER, RWS_PASSWORD)
        else:
            credentials = Credentials(RWS_USER, RWS_PASSWORD)
            client = open_controller(served.host, lambda: credentials, ca=str(served.ca))._rws
        assert (client.get_controller_state(), client.get_operation_mode()) == ("motoroff", "AUTO")
        client.upload_file("$HOME/Probe.mod", MODULE.encode())
        assert client.read_file("$HOME/Probe.mod") == MODULE.encode()
        assert client.list_files("$HOME") == ["Probe.mod"]
        client._do_post("rw/mastership/rapid?action=request", {})
        client._do_post("rw/rapid/tasks/T_ROB_L?action=loadmod", {"modulepath": "$HOME/Probe.mod"})
        assert client.get_rapid_variable("Probe/speed", "T_ROB_L") == "1.5"
        client.set_rapid_variable_num("Probe/speed", 2.5, "T_ROB_L")
        assert client.get_rapid_variable_num("Probe/speed", "T_ROB_L") == 2.5
        assert [one["name"] for one in client.get_rapid_variables("T_ROB_L")] == ["speed"]
        client.resetpp()
        client.set_controller_state("motoron")
        client.deactivate_task("T_ROB_L")  # the start selects it again
        assert not client.get_tasks()["T_ROB_L"].active
        client.start(tasks=["T_ROB_L"])
        assert client.get_execution_state().ctrlexecstate == "running"
        assert client.get_tasks()["T_ROB_L"].excstate == "started"
        client.stop()
        assert client.get_execution_state().ctrlexecstate == "stopped"
        client.delete_file("$HOME/Probe.mod")
        assert client.list_files("$HOME") == []
        served.box.event(40160, "Errors in RAPID program")
        (entry,) = client.read_event_log()
        assert (entry.code, entry.msgtype, entry.title) == (40160, 3, "Errors in RAPID program")
        client.close()


def test_rwswrap(tmp_path: Path) -> None:
    """A third-party client for RobotWare 7, unmodified."""
    wrap = pytest.importorskip("rwswrap.RWS", reason="needs rwswrap of the extra dev")
    with rws_controller(tmp_path, "7") as served:
        served.box.files["$HOME/Probe.modx"] = MODULE.encode()
        client = wrap.RWS(served.url, RWS_USER, RWS_PASSWORD, verify=str(served.ca), task="T_ROB_L", module="Probe")
        assert client.load_module("Probe").status_code == 204
        assert client.get_modules() == ["Probe"]
        assert client.set_rapid_variable("speed", 4, module="Probe").status_code == 204
        assert client.get_rapid_variable("speed", module="Probe") == "4"
        assert client.toggle_motors(1).status_code == 204
        assert client.start_RAPID().status_code == 204
        assert client.is_running()
        assert client.stop_RAPID().status_code == 204
        assert client.get_exec_state() == "stopped"
        assert client.toggle_motors(0).status_code == 204
        assert served.box.state == "motoroff"


def test_packets_follow_rapid() -> None:
    """No packets before RAPID runs; guidance while it runs; packets without guidance after it stops, until the program
    pointer is set to main."""
    robot = robots.load("yumi_left")
    box = VirtualController(["yumi_left"], [("127.0.0.1", 6511)], "6.10")
    arm = LaggingArm(robot)
    task = SimulatedController(arm, RobotSideCodec(robot), ControllerSettings(), Surroundings(**box.scene(0)))

    def phases(cycles: int) -> list[str]:
        found: list[str] = []
        for _ in range(cycles):
            packet = task.packet()
            task.advance()
            found.append(task.phase if packet else "silent")
        return list(dict.fromkeys(found))

    assert phases(100) == ["silent"]
    box.put("$HOME/Probe.mod", MODULE.encode())
    box.load(box.task("T_ROB_L"), "$HOME/Probe.mod", False)
    box.reset_pointer()
    box.switch("motoron")
    box.start()
    assert phases(100) == ["silent", "guiding"]
    box.switch("motoroff")
    assert phases(10) == ["streaming"]
    assert not box.is_running
    box.reset_pointer()
    assert phases(100)[-1] == "silent"


def ask(served: RwsController, method: str, path: str, body: bytes = b"", **headers: str) -> tuple[int, bytes]:
    if served.ca is None:
        connection = http.client.HTTPConnection(served.host, timeout=20)
    else:
        context = ssl.create_default_context(cafile=served.ca)
        connection = http.client.HTTPSConnection(served.host, timeout=20, context=context)
    given = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, path, body, given)
    answer = connection.getresponse()
    found = answer.status, answer.read()
    connection.close()
    return found


BASIC = "Basic " + base64.b64encode(f"{RWS_USER}:{RWS_PASSWORD}".encode()).decode()
FORM, HAL = "application/x-www-form-urlencoded;v=2.0", "application/hal+json;v=2.0"
MISUSE: list[tuple[int, str, str, bytes, dict[str, str]]] = [
    (401, "GET", "/rw/system", b"", {}),
    (401, "GET", "/rw/system", b"", {"Authorization": "Basic !!!"}),
    (401, "GET", "/rw/system", b"", {"Authorization": 'Digest username="operator"'}),
    (406, "GET", "/rw/system", b"", {"Authorization": BASIC, "Accept": "application/json"}),
    (415, "POST", "/rw/rapid/execution/start", b"", {"Authorization": BASIC}),
    (404, "GET", "/rw/panel/ctrlstate", b"", {"Authorization": BASIC}),
    (404, "GET", "/fileservice/../etc/passwd", b"", {"Authorization": BASIC}),
    (400, "GET", "/rw/rapid/tasks/T_ROB9/modules", b"", {"Authorization": BASIC}),
    (403, "POST", "/rw/rapid/execution/resetpp", b"", {"Authorization": BASIC, "Content_Type": FORM}),
    (403, "POST", "/rw/rapid/execution/start", b"", {"Authorization": BASIC, "Content_Type": FORM}),
    (413, "GET", "/rw/system", b"", {"Authorization": BASIC, "Content_Length": "9" * 30}),
    (413, "GET", "/rw/system", b"", {"Authorization": BASIC, "Content_Length": "-1"}),
]


def test_misuse_is_refused(tmp_path: Path) -> None:
    with rws_controller(tmp_path, "7") as served:
        found = [ask(served, method, path, body, **headers)[0] for _, method, path, body, headers in MISUSE]
        assert found == [status for status, *_ in MISUSE]
        assert ask(served, "GET", "/rw/system", Authorization=BASIC, Accept=HAL)[0] == 200
    with rws_controller(tmp_path, "6.10") as served:
        forged = 'Digest username="operator", nonce="0", uri="/rw/system", response="\u00e9"'
        assert ask(served, "GET", "/rw/system", Authorization=forged)[0] == 401
        assert ask(served, "GET", "/rw/system", Authorization=BASIC)[0] == 401


REFUSED: list[tuple[type[Exception], str, Any]] = [
    (UnknownName, "guard-stop", lambda: VirtualController(["yumi_left"], [("h", 1)], "7", ["guard"])),
    (LinkError, "only over TLS", lambda: RwsServer(VirtualController([], [], "7"), 0, "", "")),
]


@pytest.mark.parametrize(("error", "words", "make"), REFUSED)
def test_wrong_input(error: type[Exception], words: str, make: Any) -> None:
    with pytest.raises(error, match=words):
        make()


def test_a_port_in_use_is_named(tmp_path: Path) -> None:
    with rws_controller(tmp_path) as served, pytest.raises(LinkError, match="Choose another"):
        RwsServer(served.box, int(served.host.rpartition(":")[2]), "", "")


def test_every_fault_changes_the_controller() -> None:
    def seen(*faults: str) -> str:
        box = VirtualController(["yumi_left"], [("127.0.0.1", 6511)], "6.10", faults)
        return repr({k: v for k, v in vars(box).items() if k not in ("lock", "faults")})

    assert {fault for fault in FAULTS if seen(fault) == seen()} == {"password", "option", "motors", "semantic"}
