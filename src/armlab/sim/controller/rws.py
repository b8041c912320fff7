"""Robot Web Services of the simulated controller: `VirtualController` keeps its state, `RwsServer` serves HTTP.

RobotWare 6 uses RWS 1.0 (digest authentication, JSON with ``?json=1``); RobotWare 7 uses RWS 2.0 (TLS, basic
authentication, ``application/hal+json;v=2.0``). Resources and return codes follow public documentation and published
programs; see docs/decisions/abb.md. RAPID is not interpreted: starting a task with EGM instructions opens its EGM
session.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import re
import secrets
import ssl
import threading
from base64 import b64decode
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from http.cookies import SimpleCookie
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qsl, quote, unquote, urlsplit

from armlab.errors import LinkError, UnknownName
from armlab.sim.events import MOTORS, RAPID, StateScript

FAULTS = {
    "version": "the controller has RobotWare 6.05",
    "password": "the server expects a different password",
    "option": "Externally Guided Motion is not installed",
    "manual": "the controller is in manual mode",
    "emergency-stop": "the emergency stop is pressed",
    "guard-stop": "the safety gate is open",
    "motors": "the motors do not switch on",
    "mastership": "another program holds mastership",
    "busy": "another program is running",
    "main": "another module contains a procedure main",
    "module": "the guidance module is loaded with different content",
    "file": "the guidance module in the home folder has different content",
    "semantic": "RAPID rejects the module",
    "device": "no UDP devices are configured",
    "address": "the UDP devices send to another computer",
    "interface": "no external motion interface is configured",
}
"""Selectable faults of the controller, with descriptions."""

_TASKS = {"yumi_left": ("T_ROB_L", "armlab_l"), "yumi_right": ("T_ROB_R", "armlab_r")}
_GUIDANCE = {"T_ROB1": "ArmlabJoint", "T_ROB_L": "ArmlabYumiL", "T_ROB_R": "ArmlabYumiR"}
_OTHER_MAIN = "MODULE MainModule\n  PERS num speed := 50;\n  PROC main()\n    WaitTime 1;\n  ENDPROC\nENDMODULE\n"
_OTHER = "MODULE {}\n  ! edited on the pendant\n  PROC main()\n  ENDPROC\nENDMODULE\n"
_MODULE = re.compile(r"^\s*MODULE\s+(\w+)", re.IGNORECASE | re.MULTILINE)
_MAIN = re.compile(r"^\s*PROC\s+main\s*\(", re.IGNORECASE | re.MULTILINE)
_PERS = re.compile(r"^\s*(?:LOCAL\s+)?PERS\s+(\w+)\s+(\w+)\s*:=\s*(.*?);", re.IGNORECASE | re.MULTILINE)
_SETUP = re.compile(r'EGMSetupUC\s+\w+,\s*\w+,\s*"(\w+)",\s*"(\w+)"')
_LARGEST, _MOST_FILES = 4 << 20, 200
_REALM = "validusers@robapi.abb"
_OK = 294912
_REJECTED = {
    "mode": (403, -1073445860, "operating mode"),
    "master": (403, -1073445859, "mastership is held by another client"),
    "execution": (403, -1073442809, "RAPID execution state"),
    "pointer": (403, -1073442783, "no program pointer"),
    "motors": (403, -1073436650, "mechanical unit is not ready"),
    "semantic": (400, -1073442802, "semantic error in RAPID"),
    "symbol": (400, -1073442816, "no such symbol"),
    "argument": (400, -1073445879, "invalid argument"),
    "url": (404, -1073445866, "unresolved url"),
    "file": (404, -1073438708, "file not found"),
    "full": (400, -1073438719, "device full"),
}


class Rejected(Exception):
    """Rejected request, with the controller's HTTP status, return code and text."""

    def __init__(self, kind: str) -> None:
        super().__init__(kind)
        self.status, self.code, self.text = _REJECTED[kind]


@dataclass
class _Task:
    """Motion task with its modules and the state of its EGM session."""

    name: str
    device: str
    modules: dict[str, str] = field(default_factory=dict)
    is_active: bool = True
    has_pointer: bool = False
    runs: bool = False
    egm: bool = False  # whether EGM was set up since the program pointer was set to main


class _Live(StateScript):
    """State that requests can change."""

    def __init__(self, read: Callable[[], int]) -> None:
        self._read = read

    def at(self, t: float) -> int:
        return self._read()


class VirtualController:
    """State of one controller with the motion tasks of the simulated robots; `to` contains their EGM addresses."""

    def __init__(
        self, robots: Sequence[str], to: Sequence[tuple[str, int]], robotware: str, faults: Sequence[str] = ()
    ) -> None:
        for name in faults:
            if name not in FAULTS:
                raise UnknownName.among("fault of the simulated controller", name, FAULTS)
        self.is_rws2, self.faults, self.lock = robotware == "7", frozenset(faults), threading.RLock()
        names = {"7": "7.10.0", "6.10": "6.10.02"}
        self.robotware = "6.05.00" if "version" in faults else names.get(robotware, f"{robotware}.00")
        self.tasks: list[_Task] = []
        for k, robot in enumerate(robots):
            name, device = _TASKS.get(robot, (f"T_ROB{k + 1}", "armlab" if k == 0 else f"armlab_{k + 1}"))
            self.tasks.append(_Task(name, device))
        places = dict(zip([task.device for task in self.tasks], to, strict=True))
        self.devices = {} if "device" in faults else places
        if "address" in faults:
            self.devices = {name: ("192.0.2.7", port) for name, (_, port) in places.items()}
        self.interfaces = [] if "interface" in faults else ["armlab", "armlab_first"]
        self.mode = "MANR" if "manual" in faults else "AUTO"
        stops = {"emergency-stop": "emergencystop", "guard-stop": "guardstop"}
        self.state = next((state for fault, state in stops.items() if fault in faults), "motoroff")
        self.holder = "RobotStudio" if "mastership" in faults else ""
        self.files: dict[str, bytes] = {}
        self.values: dict[tuple[str, str, str], str] = {}
        self.events: list[tuple[int, str]] = []
        for task in self.tasks:
            self._spoil(task)

    def _spoil(self, task: _Task) -> None:
        module = _GUIDANCE.get(task.name, "ArmlabJoint")
        if "main" in self.faults or "busy" in self.faults:
            self._add(task, _OTHER_MAIN)
        if "module" in self.faults:
            self._add(task, _OTHER.format(module))
        if "file" in self.faults:
            self.files[f"$HOME/{module}.mod"] = _OTHER.format(module).encode()
        if "busy" in self.faults:
            self.state, task.has_pointer, task.runs = "motoron", True, True

    @property
    def is_running(self) -> bool:
        return any(task.runs for task in self.tasks)

    def scene(self, index: int) -> dict[str, Any]:
        """Return the motor, RAPID and EGM state of a task as fields of `Surroundings`."""
        task = self.tasks[index]
        return {
            "motors": _Live(lambda: MOTORS["on" if self.state == "motoron" else "off"]),
            "rapid": _Live(lambda: RAPID["running" if task.runs else "stopped"]),
            "is_open": lambda: task.egm,
        }

    def task(self, name: str) -> _Task:
        found = next((task for task in self.tasks if task.name == name), None)
        if found is None:
            raise Rejected("argument")
        return found

    def switch(self, state: str) -> None:
        if self.mode != "AUTO":
            raise Rejected("mode")
        if state not in ("motoron", "motoroff"):
            raise Rejected("argument")
        if self.state not in ("motoron", "motoroff") or (state == "motoron" and "motors" in self.faults):
            raise Rejected("motors")
        self.state = state
        if state == "motoroff":
            self.stop()

    def load(self, task: _Task, path: str, replace: bool) -> None:
        data = self.files.get(path)
        if data is None:
            raise Rejected("file")
        self._require_rest()
        text = data.decode(errors="replace")
        module = _MODULE.search(text)
        mains = [name for name, other in task.modules.items() if _MAIN.search(other) and name != (module and module[1])]
        if module is None or "ENDMODULE" not in text or "semantic" in self.faults or (mains and _MAIN.search(text)):
            self.event(40160, "Errors in RAPID program")
            raise Rejected("semantic")
        if module[1] in task.modules and not replace:
            raise Rejected("argument")
        self._add(task, text)

    def _add(self, task: _Task, text: str) -> None:
        module = _MODULE.search(text)
        name = module[1] if module else ""
        task.modules[name], task.has_pointer, task.egm = text, False, False
        self.values |= {(task.name, name, symbol): value for _, symbol, value in _PERS.findall(text)}

    def unload(self, task: _Task, module: str) -> None:
        self._require_rest()
        if task.modules.pop(module, None) is None:
            raise Rejected("argument")
        task.has_pointer = task.egm = False

    def reset_pointer(self) -> None:
        self._require_rest()
        for task in self.tasks:
            task.has_pointer, task.egm = any(_MAIN.search(text) for text in task.modules.values()), False

    def start(self) -> None:
        self._require_rest()
        if self.mode != "AUTO":
            raise Rejected("mode")
        if self.state != "motoron":
            raise Rejected("motors")
        active = [task for task in self.tasks if task.is_active]
        if not active or not all(task.has_pointer for task in active):
            raise Rejected("pointer")
        for task in active:
            found = _SETUP.search(next(text for text in task.modules.values() if _MAIN.search(text)))
            if found and (found[2] not in self.devices or found[1] not in self.interfaces):
                self.event(41816, f"EGM cannot use {found[1]} or {found[2]}")
                return  # the program stops at this instruction
        for task in active:
            text = next(text for text in task.modules.values() if _MAIN.search(text))
            task.runs, task.egm = True, bool(_SETUP.search(text))

    def stop(self) -> None:
        for task in self.tasks:
            task.runs = False

    def event(self, number: int, title: str) -> None:
        self.events = [(number, title), *self.events[:99]]

    def put(self, path: str, data: bytes) -> None:
        if path not in self.files and len(self.files) >= _MOST_FILES:
            raise Rejected("full")
        self.files[path] = data

    def symbol(self, words: Sequence[str]) -> tuple[str, str, str]:
        """Return the key of a persistent variable, given by task and name, or by task, module and name."""
        for key in self.values:
            if [key[0], key[2]] == list(words) or list(key) == list(words):
                return key
        raise Rejected("symbol")

    def _require_rest(self) -> None:
        if self.is_running:
            raise Rejected("execution")


@dataclass(frozen=True)
class _Request:
    """HTTP request with its route groups, form and query fields, body and session."""

    groups: tuple[str, ...]
    form: Mapping[str, str]
    query: Mapping[str, str]
    body: bytes
    session: str


_Answer = Callable[[VirtualController, _Request], Any]


def _state(kind: str, name: str, /, **values: str) -> dict[str, Any]:
    return {"_type": kind, "_title": name, **values}


def _system(box: VirtualController, _: _Request) -> list[dict[str, Any]]:
    option = "3124-1 Externally Guided Motion" if box.is_rws2 else "689-1 Externally Guided Motion (EGM)"
    options = ["RobotWare Base", "English", *([] if "option" in box.faults else [option])]
    kind = "sys-options" if box.is_rws2 else "sys-option"
    listed = [_state(kind, str(k), option=name) for k, name in enumerate(options)]
    version = {"rwversion": box.robotware, "rwversionname": box.robotware}
    system = _state("sys-system" if box.is_rws2 else "sys-system-li", "system", name="armlab_sim", **version)
    return [system, {"_type": "sys-options-li", "_title": "options", "options": listed}]


def _tasks(box: VirtualController, _: _Request) -> list[dict[str, Any]]:
    return [
        _state(
            "rap-task-li",
            task.name,
            name=task.name,
            type="normal",
            taskstate="linked",
            excstate="started" if task.runs else "ready",
            active="On" if task.is_active else "Off",
            motiontask="TRUE",
        )
        for task in box.tasks
    ]


def _modules(box: VirtualController, asked: _Request) -> list[dict[str, Any]]:
    task = box.task(asked.query.get("task") or asked.groups[0])
    names = {"BASE": "SysMod", "user": "SysMod"} | dict.fromkeys(task.modules, "ProgMod")
    return [_state("rap-module-info-li", f"{task.name}/{name}", name=name, type=kind) for name, kind in names.items()]


def _module_text(box: VirtualController, asked: _Request) -> list[dict[str, Any]]:
    name = asked.groups[-1]
    text = box.task(asked.query.get("task") or asked.groups[0]).modules.get(name)
    if text is None:
        raise Rejected("argument")
    shown = {"module-text": text if box.is_rws2 else quote(text)}  # as RobotWare 6 sends it
    return [_state("rap-module-text", name, **{"change-count": "1"}, **shown)]


def _load(box: VirtualController, asked: _Request) -> None:
    path, replace = asked.form.get("modulepath", ""), asked.form.get("replace", "false")
    box.load(box.task(asked.groups[0]), path if path.startswith("$") else f"${path}", replace == "true")


def _select(active: bool) -> Callable[[VirtualController, _Request], None]:
    def select(box: VirtualController, asked: _Request) -> None:
        box.task(asked.form.get("task") or "".join(asked.groups)).is_active = active

    return select


def _request(box: VirtualController, asked: _Request) -> None:
    if box.holder not in ("", asked.session):
        raise Rejected("master")
    box.holder = asked.session


def _release(box: VirtualController, asked: _Request) -> None:
    if box.holder == asked.session:
        box.holder = ""


def _held(box: VirtualController, asked: _Request) -> list[dict[str, Any]]:
    is_ours = box.holder == asked.session
    application = box.holder if box.holder == "RobotStudio" else "RobAPI2-Client"
    return [
        _state(
            "msh-resource",
            "edit",
            mastership="remote" if box.holder else "nomaster",
            mastershipheldbyme="TRUE" if is_ours else "FALSE",
            application=application if box.holder else "",
        )
    ]


def _mastered(change: Callable[[VirtualController, _Request], None]) -> _Answer:
    """Wrap a change that requires mastership; RobotWare 6 acquires mastership implicitly if it is free."""

    def answer(box: VirtualController, asked: _Request) -> None:
        implicit = not box.is_rws2 or asked.query.get("mastership") == "implicit"
        if box.holder != asked.session and not (implicit and not box.holder):
            raise Rejected("master")
        change(box, asked)

    return answer


def _devices(box: VirtualController, _: _Request) -> list[dict[str, Any]]:
    address = "RemoteAddress" if box.is_rws2 else "RemoteAdress"  # ABB's spelling
    rows = {
        name: {"Name": name, "Type": "UDPUC", address: host, "RemotePortNumber": str(port)}
        for name, (host, port) in box.devices.items()
    }
    other = {} if box.is_rws2 else {"TCPIP1": {"Name": "TCPIP1", "Type": "TCP/IP"}}
    return _instances({**other, **rows})


def _interfaces(box: VirtualController, _: _Request) -> list[dict[str, Any]]:
    return _instances({name: {"name": name} for name in box.interfaces})


def _instances(rows: Mapping[str, Mapping[str, str]]) -> list[dict[str, Any]]:
    return [
        {
            "_type": "cfg-dt-instance-li",
            "_title": name,
            "attrib": [_state("cfg-ia-t", key, value=value) for key, value in row.items()],
        }
        for name, row in rows.items()
    ]


def _symbols(box: VirtualController, asked: _Request) -> list[dict[str, Any]]:
    block = asked.form.get("blockurl", "RAPID").split("/")[1:]
    return [
        _state("rap-symproppers-li", name, name=name, symburl="/".join(("RAPID", task, module, name)), symtyp="per")
        for task, module, name in box.values
        if not block or block[0] == task
    ]


def _value(box: VirtualController, asked: _Request) -> list[dict[str, Any]]:
    key = box.symbol(asked.groups[0].split("/"))
    return [_state("rap-data", "/".join(("RAPID", *key)), value=box.values[key])]


def _set_value(box: VirtualController, asked: _Request) -> None:
    box.values[box.symbol(asked.groups[0].split("/"))] = asked.form.get("value", "")


def _events(box: VirtualController, _: _Request) -> list[dict[str, Any]]:
    empty = {"desc": "", "conseqs": "", "causes": "", "actions": "", "argc": "0"}
    return [
        _state("elog-message-li", f"/rw/elog/0/{len(box.events) - k}", msgtype="3", code=str(number), title=title)
        | {"tstamp": "2026-01-01 T 00:00:00", **empty}
        for k, (number, title) in enumerate(box.events)
    ]


def _files(box: VirtualController, asked: _Request) -> list[dict[str, Any]] | bytes:
    path = asked.groups[0]
    if path in box.files:
        return box.files[path]
    if not path.rstrip("/").endswith(("$HOME", "$TEMP")):
        raise Rejected("file")
    inside = [name.removeprefix(f"{path}/") for name in box.files if name.startswith(path)]
    return [_state("fs-file", name) for name in inside]


def _delete(box: VirtualController, asked: _Request) -> None:
    if box.files.pop(asked.groups[0], None) is None:
        raise Rejected("file")


_ROUTES: tuple[tuple[str, str, str, _Answer], ...] = (  # method, RWS 1.0 path with its action, RWS 2.0 path, handler
    ("GET", "/rw/system", "/rw/system", _system),
    ("GET", "/rw/panel/opmode", "/rw/panel/opmode", lambda b, _: [_state("pnl-opmode", "opmode", opmode=b.mode)]),
    (
        "GET",
        "/rw/panel/ctrlstate",
        "/rw/panel/ctrl-state",
        lambda b, _: [_state("pnl-ctrlstate", "ctrl-state", ctrlstate=b.state)],
    ),
    (
        "POST",
        r"/rw/panel/ctrlstate\?setctrlstate",
        "/rw/panel/ctrl-state",
        lambda b, r: b.switch(r.form.get("ctrl-state", "")),
    ),
    (
        "GET",
        "/rw/rapid/execution",
        "/rw/rapid/execution",
        lambda b, _: [
            _state("rap-execution", "execution", ctrlexecstate=("stopped", "running")[b.is_running], cycle="forever")
        ],
    ),
    ("POST", r"/rw/rapid/execution\?start", "/rw/rapid/execution/start", _mastered(lambda b, _: b.start())),
    ("POST", r"/rw/rapid/execution\?stop", "/rw/rapid/execution/stop", lambda b, _: b.stop()),
    (
        "POST",
        r"/rw/rapid/execution\?resetpp",
        "/rw/rapid/execution/resetpp",
        _mastered(lambda b, _: b.reset_pointer()),
    ),
    ("GET", "/rw/rapid/tasks", "/rw/rapid/tasks", _tasks),
    ("POST", r"/rw/rapid/tasks/(\w+)\?activate", "/rw/rapid/tasks/activate", _select(True)),
    ("POST", r"/rw/rapid/tasks/(\w+)\?deactivate", "/rw/rapid/tasks/deactivate", _select(False)),
    ("POST", r"/rw/rapid/tasks/(\w+)\?loadmod", r"/rw/rapid/tasks/(\w+)/loadmod", _mastered(_load)),
    (
        "POST",
        r"/rw/rapid/tasks/(\w+)\?unloadmod",
        r"/rw/rapid/tasks/(\w+)/unloadmod",
        _mastered(lambda b, r: b.unload(b.task(r.groups[0]), r.form.get("module", ""))),
    ),
    ("GET", "/rw/rapid/modules", r"/rw/rapid/tasks/(\w+)/modules", _modules),
    ("GET", r"/rw/rapid/modules/(\w+)\?module-text", r"/rw/rapid/tasks/(\w+)/modules/(\w+)/text", _module_text),
    ("POST", r"/rw/rapid/symbols\?search-symbols", "/rw/rapid/symbols/search", _symbols),
    ("GET", "/rw/rapid/symbol/data/RAPID/(.+)", "/rw/rapid/symbol/RAPID/(.+)/data", _value),
    ("POST", r"/rw/rapid/symbol/data/RAPID/(.+)\?set", "/rw/rapid/symbol/RAPID/(.+)/data", _mastered(_set_value)),
    ("GET", "/rw/mastership/rapid", "/rw/mastership/edit", _held),
    ("POST", r"/rw/mastership(?:/rapid)?\?request", "/rw/mastership(?:/edit)?/request", _request),
    ("POST", r"/rw/mastership(?:/rapid)?\?release", "/rw/mastership(?:/edit)?/release", _release),
    ("GET", "/rw/cfg/SIO/COM_TRP/instances", "/rw/cfg/SIO/UDPUC_HOST/instances", _devices),
    ("GET", "/rw/cfg/MOC/EXT_MOTION_DATA/instances", "/rw/cfg/MOC/EXT_MOTION_DATA/instances", _interfaces),
    ("GET", "/rw/elog/0/?", "/rw/elog/0/?", _events),
    ("GET", "/fileservice/(.+)", "/fileservice/(.+)", _files),
    ("PUT", "/fileservice/(.+)", "/fileservice/(.+)", lambda b, r: b.put(r.groups[0], r.body)),
    ("DELETE", "/fileservice/(.+)", "/fileservice/(.+)", _delete),
    ("GET", "/logout", "/logout", lambda b, r: [_release(b, r)][:0]),
    ("POST", "/users/.*", "/rw/(?:infostream/disconnectclient|_istream/streamdisconnect)", lambda b, r: None),
)
_AS_RESOURCES = (_tasks, _devices, _interfaces, _events, _files)  # RWS 2.0 embeds these as resources


class RwsServer:
    """HTTP interface of a `VirtualController` on 127.0.0.1, in its own threads; RWS 2.0 requires a TLS context."""

    def __init__(
        self, box: VirtualController, port: int, user: str, password: str, tls: ssl.SSLContext | None = None
    ) -> None:
        if box.is_rws2 and tls is None:
            raise LinkError("Expected a TLS context for RWS 2.0, got none. RobotWare 7 answers only over TLS.")
        expected = secrets.token_hex() if "password" in box.faults else password
        handler = type("Handler", (_Handler,), {"box": box, "user": user, "expected": expected, "nonces": set()})
        try:
            self._server = _QuietServer(("127.0.0.1", port), handler)
        except OSError as error:
            raise LinkError(
                f"Expected a free TCP port for Robot Web Services, got {port}: {error.strerror}. Choose another port."
            ) from None
        if box.is_rws2 and tls is not None:
            self._server.socket = tls.wrap_socket(self._server.socket, server_side=True, do_handshake_on_connect=False)
        self.port = int(self._server.server_address[1])
        threading.Thread(target=self._server.serve_forever, name="RWS", daemon=True, args=(0.1,)).start()

    def close(self) -> None:
        """Stop the server."""
        self._server.shutdown()
        self._server.server_close()


class _QuietServer(ThreadingHTTPServer):
    daemon_threads, block_on_close = True, False

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore clients that disconnect."""


class _Handler(BaseHTTPRequestHandler):
    box: VirtualController
    user: str
    expected: str
    nonces: set[str]
    protocol_version, timeout, server_version = "HTTP/1.1", 10.0, "ABB-sim"
    disable_nagle_algorithm = True

    def log_message(self, format: str, *args: object) -> None:
        """Log nothing, because headers contain credentials."""

    def do_GET(self) -> None:
        """Answer a request of any method."""
        size = self.headers.get("Content-Length", "0")
        if not size.isdigit() or int(size[:12]) > _LARGEST:
            self.close_connection = True
            self._send(413, b"")
            return
        body = self.rfile.read(int(size))
        if not (self._is_basic() if self.box.is_rws2 else self._is_digest()):
            self._send(401, b"", {"WWW-Authenticate": self._challenge()})
        elif refusal := self._wrong_type():
            self._send(refusal, b"")
        else:
            self._answer(body)

    do_POST = do_PUT = do_DELETE = do_GET

    def _answer(self, body: bytes) -> None:
        parts = urlsplit(self.path)
        query = dict(parse_qsl(parts.query, keep_blank_values=True))
        is_form = self.command == "POST"
        form = dict(parse_qsl(body.decode(errors="replace"), keep_blank_values=True)) if is_form else {}
        action = "" if self.box.is_rws2 else query.get("action") or query.get("resource") or ""
        path = unquote(parts.path) + (f"?{action}" if action else "")
        try:
            with self.box.lock:
                answer, found = self._route(path, form, query, body)
        except Rejected as rejected:
            self._send(rejected.status, self._document([], {"code": rejected.code, "msg": rejected.text}))
            return
        if found is None:
            self._send(201 if self.command == "PUT" else 204, b"")
        elif isinstance(found, bytes):
            self._send(200, found, {"Content-Type": "application/octet-stream"})
        else:
            self._send(200, self._document(found, {"code": _OK}, answer in _AS_RESOURCES))

    def _route(self, path: str, form: Mapping[str, str], query: Mapping[str, str], body: bytes) -> tuple[_Answer, Any]:
        for method, first, second, answer in _ROUTES:
            match = re.fullmatch(second if self.box.is_rws2 else first, path)
            if match and method == self.command:
                return answer, answer(self.box, _Request(match.groups(), form, query, body, self._session()))
        raise Rejected("url")

    def _document(self, states: list[dict[str, Any]], status: dict[str, Any], embedded: bool = False) -> bytes:
        links = {"base": {"href": "/"}}
        if not self.box.is_rws2:
            body = {"status": status} if status["code"] != _OK else {"_state": states}
            return json.dumps({"_links": links, "_embedded": body}).encode()
        if embedded:
            return json.dumps({"_links": links, "_embedded": {"resources": states}}).encode()
        return json.dumps({"_links": links, "status": status, **({"state": states} if states else {})}).encode()

    def _session(self) -> str:
        cookie = SimpleCookie(self.headers.get("Cookie", "")).get("ABBCX")
        self._cookie = cookie.value if cookie else secrets.token_hex(8)
        return self._cookie

    def _wrong_type(self) -> int:
        """Return the HTTP status for a media type without the RWS 2.0 version, or 0 for a correct media type."""
        if not self.box.is_rws2:
            return 0
        accept = self.headers.get("Accept", "*/*")
        if "v=2.0" not in accept and "*/*" not in accept:
            return 406
        has_type = "v=2.0" in self.headers.get("Content-Type", "")
        return 415 if self.command in ("POST", "PUT") and not has_type else 0

    def _is_basic(self) -> bool:
        kind, _, word = self.headers.get("Authorization", "").partition(" ")
        try:
            given = b64decode(word, validate=True)
        except ValueError:
            return False
        return kind == "Basic" and hmac.compare_digest(given, f"{self.user}:{self.expected}".encode())

    def _is_digest(self) -> bool:
        kind, _, words = self.headers.get("Authorization", "").partition(" ")
        given = {key: quoted or bare for key, quoted, bare in re.findall(r'(\w+)=(?:"([^"]*)"|([^\s,]+))', words)}
        if kind != "Digest" or given.get("nonce") not in self.nonces or given.get("uri") != self.path:
            return False
        first = _md5(f"{self.user}:{_REALM}:{self.expected}")
        middle = ":".join(given.get(name, "") for name in ("nonce", "nc", "cnonce", "qop"))
        right = _md5(f"{first}:{middle}:{_md5(f'{self.command}:{self.path}')}")
        is_user = given.get("username") == self.user
        return is_user and hmac.compare_digest(given.get("response", "").encode(), right.encode())

    def _challenge(self) -> str:
        if self.box.is_rws2:
            return f'Basic realm="{_REALM}"'
        nonce = secrets.token_hex(16)
        if len(self.nonces) > 1000:
            self.nonces.clear()
        self.nonces.add(nonce)
        return f'Digest realm="{_REALM}", domain="127.0.0.1", qop="auth", nonce="{nonce}", opaque="", algorithm="MD5"'

    def _send(self, status: int, body: bytes, headers: Mapping[str, str] | None = None) -> None:
        kind = "application/hal+json;v=2.0" if self.box.is_rws2 else "application/json"
        self.send_response(status)
        if cookie := getattr(self, "_cookie", ""):
            self.send_header("Set-Cookie", f"ABBCX={cookie}; path=/")
        for name, value in {"Content-Type": kind, "Content-Length": str(len(body)), **(headers or {})}.items():
            if status != 204 or name not in ("Content-Length", "Content-Type"):
                self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)


def _md5(text: str) -> str:
    return hashlib.md5(text.encode(), usedforsecurity=False).hexdigest()
