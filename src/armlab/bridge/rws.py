"""Robot Web Services (RWS): `AbbController` reads the state of an ABB controller, and loads, starts and stops RAPID.

The client abb_robot_client (extra ``abb``) supports RWS 1.0 of RobotWare 6. For RobotWare 7, a transport adapter for
`requests` translates the client's requests to RWS 2.0. The password never appears in a URL, an error, a repr or an
event.
"""

from __future__ import annotations

import json
import os
import re
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Any, NamedTuple
from urllib.parse import parse_qsl, quote, unquote, urlencode, urlsplit, urlunsplit

from armlab.errors import ConfigError, LinkError, MissingExtra

USER, PASSWORD = "ARMLAB_RWS_USER", "ARMLAB_RWS_PASSWORD"
"""Environment variables with the credentials."""

PROGRAMS = {
    "T_ROB1": ("ArmlabJoint", "armlab"),
    "T_ROB_L": ("ArmlabYumiL", "armlab_l"),
    "T_ROB_R": ("ArmlabYumiR", "armlab_r"),
}
"""Guidance module and its UDP device, by motion task."""

INTERFACE = "armlab"
"""Name of the external motion interface that the guidance modules use."""

OLDEST = (6, 7)
"""Oldest supported RobotWare version."""

_DEFAULT_USER = "Default User"  # predefined on every controller
_TIMEOUT = 5.0  # s without receiving a byte
_LONGEST = 20.0  # s: time limit for a complete response, even if its bytes arrive slowly
_LARGEST = 4 << 20  # bytes: maximum size of a response
_SETTLING = 5.0  # s within which motors or RAPID must change state
_FORM, _HAL, _XHTML = (
    "application/x-www-form-urlencoded;v=2.0",
    "application/hal+json;v=2.0",
    "application/xhtml+xml;v=2.0",
)
_MAIN = re.compile(r"^\s*PROC\s+main\s*\(", re.IGNORECASE | re.MULTILINE)
_CODES = {
    -1073445860: "the operating mode does not allow this request. Switch the controller to automatic",
    -1073445859: "another program or the pendant holds mastership. Release it there",
    -1073445862: "another program or the pendant holds mastership. Release it there",
    -1073445867: "the user lacks the required grant. Add the grant in the controller's user authorisation system",
    -1073445863: "the user lacks the required grant. Add the grant in the controller's user authorisation system",
    -1073442809: "RAPID is running. Stop it first",
    -1073442802: "RAPID found a semantic error, such as a second main routine. Check the program on the pendant",
    -1073442803: "RAPID found a syntax error. Check the module",
    -1073442783: "the program pointer is not set. Set the program pointer to main",
    -1073436650: "the motors are off",
}


class RwsError(LinkError):
    """Request refused by the controller, with HTTP status and return code (0 if unknown)."""

    def __init__(self, message: str, status: int = 0, code: int = 0) -> None:
        super().__init__(message)
        self.status, self.code = status, code


@dataclass(frozen=True, slots=True)
class Credentials:
    """User and password of a controller; the password never appears in the repr."""

    user: str
    password: str = field(repr=False)

    @classmethod
    def from_environment(cls, ask: Callable[[str], str] | None = None) -> Credentials:
        """Return the credentials from the environment; `ask` prompts for a missing password."""
        user = os.environ.get(USER) or _DEFAULT_USER
        found = os.environ.get(PASSWORD) or (ask(f"Password of {user!r} on the controller: ") if ask else "")
        if not found:
            raise ConfigError(
                f"Expected the password of the controller in the environment, got no value. Set {PASSWORD}."
            )
        return cls(user, found)


class Task(NamedTuple):
    """Motion task: whether it is selected to run, its execution state and its program modules."""

    name: str
    is_active: bool
    state: str
    modules: tuple[str, ...]


@dataclass(frozen=True)
class ControllerStatus:
    """State of a controller; `mode` and `state` are RWS terms, and `devices` maps names to (address, port)."""

    name: str
    robotware: str
    options: tuple[str, ...]
    mode: str
    state: str
    execution: str
    tasks: tuple[Task, ...]
    devices: Mapping[str, tuple[str, int]]
    interfaces: tuple[str, ...]
    holder: str
    texts: Mapping[tuple[str, str], str] = field(default_factory=dict)

    @property
    def version(self) -> tuple[int, ...]:
        return tuple(int(word) for word in re.findall(r"\d+", self.robotware)[:2])

    @property
    def is_running(self) -> bool:
        return self.execution == "running"

    def mains(self, task: Task) -> list[str]:
        """Return the modules of a task that contain a routine `main`."""
        return [module for module in task.modules if _MAIN.search(self.texts.get((task.name, module), ""))]


def split_host(text: str) -> tuple[list[str], str]:
    """Return the candidate URLs of a controller, and its name in messages."""
    if "@" in text:  # not echoed, because it may contain a password
        raise ConfigError(
            "Expected a controller address without user and password. "
            f"Remove the user and password from the address and set {USER} "
            f"and {PASSWORD}."
        )
    try:
        parts = urlsplit(text if "://" in text else f"//{text}")
        host, port = parts.hostname, parts.port
    except ValueError:
        host, parts, port = None, urlsplit(""), None
    if not host or parts.scheme not in ("", "http", "https") or parts.path.strip("/") or parts.query or parts.fragment:
        raise ConfigError(f"Expected a controller as HOST or HOST:PORT, such as 192.168.125.1, got {text!r}.")
    place = f"[{host}]" if ":" in host else host
    place = place if port is None else f"{place}:{port}"
    return [f"{scheme}://{place}" for scheme in ([parts.scheme] if parts.scheme else ["https", "http"])], place


def open_controller(
    host: str, credentials: Callable[[], Credentials], insecure: bool = False, ca: str = ""
) -> AbbController:
    """Connect to a controller: RobotWare 7 over TLS, or RobotWare 6 over plain HTTP with digest authentication.

    `credentials` is called only after a controller has answered. `insecure` accepts any certificate; `ca` is a file of
    trusted certificates.
    """
    urls, place = split_host(host)
    verify: bool | str = False if insecure else ca or True
    if ca and insecure:
        raise ConfigError("Expected either `ca` or `insecure`, got both. Omit one.")
    _packages()
    failed = None
    for url in urls:
        try:
            scheme = _challenge(url, place, verify)
            break
        except RwsError as error:
            if error.status == _UNVERIFIED:
                raise
            failed = failed or (error if error.status else None)
    else:
        if failed is not None:
            raise failed
        raise LinkError(
            f"Expected a controller with Robot Web Services at {place}, got no answer. Check the cable, address and "
            "port: RobotWare 6 answers on port 80, RobotWare 7 on 443."
        )
    is_rws2 = url.startswith("https:") and scheme == "basic"
    if not is_rws2 and scheme != "digest":
        raise LinkError(
            f"Expected {place} to request digest authentication, or a password over TLS, got {scheme!r}. This is not "
            "an ABB controller with RobotWare 6 or 7; no password was sent."
        )
    return AbbController(url, place, is_rws2, credentials(), verify)


def _packages() -> tuple[Any, Any]:
    try:
        import abb_robot_client.rws
        import requests
    except ImportError:
        raise MissingExtra(
            "Expected the package abb_robot_client for Robot Web Services, but it is not installed. Install it: "
            "pip install 'armlab[abb]'."
        ) from None
    return requests, abb_robot_client.rws.RWS


def _challenge(url: str, place: str, verify: bool | str) -> str:
    """Return the authentication scheme that a server requests, without sending credentials."""
    requests, _ = _packages()
    with requests.Session() as session:
        session.trust_env, session.verify = False, verify
        session.mount(url, _transport()(place, url.startswith("https:")))
        response = session.get(f"{url}/rw/panel/opmode", allow_redirects=False)
    return response.headers.get("WWW-Authenticate", "").partition(" ")[0].lower() or f"HTTP {response.status_code}"


_UNVERIFIED = -1  # status of an RwsError for a rejected certificate


@cache
def _transport() -> Any:
    """Return a `requests` transport that limits the time and size of responses and raises one-sentence errors."""
    requests, _ = _packages()

    class Transport(requests.adapters.HTTPAdapter):  # type: ignore[misc]
        def __init__(self, place: str, is_rws2: bool) -> None:
            super().__init__()
            self._place, self._is_rws2 = place, is_rws2

        def send(self, request: Any, **options: Any) -> Any:
            if self._is_rws2:
                _to_rws2(request)
            options |= {"stream": True, "timeout": _TIMEOUT}
            end = time.monotonic() + _LONGEST
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # urllib3 warns about --insecure
                    response = super().send(request, **options)
                    body = b""
                    for piece in response.raw.stream(1 << 16, decode_content=True):
                        body += piece
                        if len(body) > _LARGEST or time.monotonic() > end:
                            response.close()
                            break
            except (requests.RequestException, requests.packages.urllib3.exceptions.HTTPError, OSError) as error:
                raise _unreachable(self._place, error) from None
            if len(body) > _LARGEST or time.monotonic() > end:
                raise RwsError(
                    f"Expected an answer of at most {_LARGEST} bytes within {_LONGEST:g} s from {self._place}, got a "
                    "larger or slower answer."
                )
            response._content = _from_rws2(response, body) if self._is_rws2 else body
            response._content_consumed = True
            _check(self._place, request, response)
            return response

    return Transport


def _unreachable(place: str, error: Exception) -> RwsError:
    if "CERTIFICATE_VERIFY_FAILED" in str(error) or "doesn't match" in str(error):
        return RwsError(
            f"Expected the certificate of {place} to be signed by a trusted authority, but it is not. Pass the "
            "controller's own certificate with --ca FILE (?ca=FILE in a link), or accept any certificate on a private "
            "network with --insecure (?insecure=true).",
            _UNVERIFIED,
        )
    if "certificate bundle" in str(error):
        return RwsError("Expected a certificate file for --ca, but it does not exist. Check its path.", _UNVERIFIED)
    kind = "no answer in time" if "timed out" in str(error).lower() else "no connection"
    return RwsError(
        f"Expected an answer from the controller {place}, got {kind}. Check the cable, the address and the port."
    )


def _check(place: str, request: Any, response: Any) -> None:
    """Raise an error if the controller refused a request, except for a digest authentication challenge."""
    status = response.status_code
    if status == 401:
        challenge = response.headers.get("WWW-Authenticate", "").lower()
        if "Authorization" in request.headers and "stale=true" not in challenge.replace('"', "").replace(" ", ""):
            raise RwsError(
                f"Expected {place} to accept the user and password, but "
                f"the controller refused them. Check {USER} and {PASSWORD}.",
                status,
            )
        return
    if 300 <= status < 400:
        raise RwsError(
            f"Expected an answer from {place}, got a redirect to another host; redirects are not followed.", status
        )
    if status < 400:
        return
    code, said = 0, ""
    with suppress(ValueError, TypeError, KeyError, AttributeError):
        found = json.loads(response._content)["_embedded"]["status"]
        code, said = int(found["code"]), " ".join(str(found.get("msg", "")).split())[:200]
    if status == 503:
        said = "too many sessions are open; wait a minute"
    why = _CODES.get(code) or said or response.reason or "no reason"
    what = f"{request.method} {urlsplit(request.url).path}"
    raise RwsError(f"Expected {place} to accept {what}, got HTTP {status}, code {code}: {why}.", status, code)


_RWS2_PATHS = (  # path with action in RWS 1.0, path in RWS 2.0
    (r"/rw/panel/ctrlstate(\?setctrlstate)?$", r"/rw/panel/ctrl-state"),
    (r"/rw/rapid/tasks/([^/]+)\?((?:de)?activate)$", r"/rw/rapid/tasks/\2"),
    (r"/rw/rapid/modules/([^/]+)\?module-text$", r"/rw/rapid/tasks/{task}/modules/\1/text"),
    (r"/rw/rapid/modules$", r"/rw/rapid/tasks/{task}/modules"),
    (r"/rw/rapid/symbol/data/(.+?)(\?set)?$", r"/rw/rapid/symbol/\1/data"),
    (r"/rw/rapid/symbols\?search-symbols$", r"/rw/rapid/symbols/search"),
    (r"/rw/mastership/rapid(\?(\w+))?$", r"/rw/mastership/edit?\2"),
    (r"/rw/cfg/SIO/COM_TRP/", r"/rw/cfg/SIO/UDPUC_HOST/"),
    (r"\?(\w+)$", r"/\1"),
    (r"\?$", ""),
)


def _to_rws2(request: Any) -> None:
    """Convert an RWS 1.0 request to RWS 2.0 in place."""
    parts = urlsplit(request.url)
    query = dict(parse_qsl(parts.query, keep_blank_values=True))
    query.pop("json", None)
    action = query.pop("action", "") or query.pop("resource", "")
    if "speedratio" in parts.path:  # this path keeps its action
        query |= {"action": action} if action else {}
        action = ""
    path = f"{parts.path}?{action}" if action else parts.path
    for pattern, replacement in _RWS2_PATHS:
        path = re.sub(pattern, replacement, path)
    if "{task}" in path:
        path = path.replace("{task}", quote(query.pop("task", "")))
    if path == "/rw/rapid/execution/start":
        query["mastership"] = "implicit"
    if activated := re.match(r"/rw/rapid/tasks/([^/]+)$", parts.path) if "activate" in action else None:
        request.prepare_body({"task": unquote(activated[1])}, None)
    request.url = urlunsplit((*parts[:2], path, urlencode(query), ""))
    is_file = path.startswith("/fileservice/")
    request.headers["Accept"] = _XHTML if is_file and request.method == "GET" and not parts.query else _HAL
    if request.method != "GET":
        request.headers["Content-Type"] = "text/plain;v=2.0" if is_file else _FORM


def _from_rws2(response: Any, body: bytes) -> bytes:
    """Convert the body of an RWS 2.0 response to RWS 1.0."""
    if "json" not in response.headers.get("Content-Type", ""):
        return body
    try:
        document = json.loads(body)
        states = [*document.get("state", []), *document.get("_embedded", {}).get("resources", [])]
    except (ValueError, TypeError, AttributeError):
        return body
    response.headers["Content-Type"] = "application/json"
    return json.dumps({"_embedded": {"_state": states, "status": document.get("status", {})}}).encode()


class AbbController:
    """Connection to an ABB controller via Robot Web Services, created by `open_controller`; context manager."""

    def __init__(
        self, url: str, place: str, is_rws2: bool, credentials: Credentials, verify: bool | str = True
    ) -> None:
        requests, client = _packages()
        self.place, self.is_rws2 = place, is_rws2
        self._rws = client(url, credentials.user, credentials.password)
        if is_rws2:
            self._rws.auth = requests.auth.HTTPBasicAuth(credentials.user, credentials.password)
        self._rws._session.trust_env, self._rws._session.verify = False, verify
        self._rws._session.mount(url, _transport()(place, is_rws2))

    def __repr__(self) -> str:
        return f"<Controller {self.place}, RWS {2 if self.is_rws2 else 1}.0>"

    def __enter__(self) -> AbbController:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Log out; a controller allows only a few sessions."""
        self._rws.close()

    def status(self, texts: bool = False) -> ControllerStatus:
        """Return the state of the controller; `texts` adds the source text of all program modules."""
        system = self._states("rw/system")
        version = next((str(one["rwversion"]) for one in system if "rwversion" in one), "")
        moving = [one for one in self._ask(self._rws.get_tasks).values() if one.motiontask]
        tasks = tuple(Task(one.name, one.active, one.excstate, self._modules(one.name)) for one in moving)
        found = {}
        if texts:
            found = {(task.name, name): self.module_text(task.name, name) for task in tasks for name in task.modules}
            ours = [PROGRAMS[task.name][0] for task in tasks if task.name in PROGRAMS]
            found |= {("$HOME", name): (self.file(f"{name}.mod") or b"").decode(errors="replace") for name in ours}
        return ControllerStatus(
            name=next((str(one["name"]) for one in system if "name" in one), ""),
            robotware=next((str(one["rwversionname"]) for one in system if "rwversionname" in one), "") or version,
            options=tuple(_options(system)),
            mode=self._ask(self._rws.get_operation_mode),
            state=self._ask(self._rws.get_controller_state),
            execution=self._ask(self._rws.get_execution_state).ctrlexecstate,
            tasks=tasks,
            devices=self._devices(),
            interfaces=tuple(self._instances("MOC/EXT_MOTION_DATA")),
            holder=self._holder(),
            texts=found,
        )

    def module_text(self, task: str, module: str) -> str:
        """Return the source text of a loaded module, or "" if the controller does not provide it."""
        states = self._states(f"rw/rapid/modules/{quote(module)}?resource=module-text&task={quote(task)}")
        text = next((str(one["module-text"]) for one in states if "module-text" in one), "")
        return unquote(text) if "\n" not in text and re.search("%0[aAdD]", text) else text

    def file(self, name: str) -> bytes | None:
        """Return a file from the controller's home folder, or None if it does not exist."""
        try:
            return self._ask(self._rws.read_file, f"$HOME/{name}")
        except RwsError as error:
            if error.status == 404:
                return None
            raise

    def upload(self, name: str, text: str) -> None:
        """Write a file to the controller's home folder."""
        self._ask(self._rws.upload_file, f"$HOME/{name}", text.encode())

    @contextmanager
    def mastership(self) -> Iterator[None]:
        """Hold RAPID mastership, which is required to change programs."""
        self._post("rw/mastership/rapid?action=request")
        try:
            yield
        finally:
            with suppress(RwsError):
                self._post("rw/mastership/rapid?action=release")

    def load(self, task: str, name: str) -> None:
        """Load a file from the controller's home folder into a task; replace a module of the same name."""
        self._post(f"rw/rapid/tasks/{quote(task)}?action=loadmod", modulepath=f"$HOME/{name}", replace="true")

    def unload(self, task: str, module: str) -> None:
        self._post(f"rw/rapid/tasks/{quote(task)}?action=unloadmod", module=module)

    def pointer_to_main(self) -> None:
        """Set the program pointer of all tasks to main."""
        self._ask(self._rws.resetpp)

    def motors_on(self) -> None:
        self._ask(self._rws.set_controller_state, "motoron")
        self._wait(lambda: self._ask(self._rws.get_controller_state) == "motoron", "the motors to switch on")

    def start(self, tasks: Sequence[str]) -> None:
        """Start RAPID in the given motion tasks, deselect all other tasks, and check that RAPID is running."""
        self._ask(self._rws.start, "forever", list(tasks))
        self._wait(self.runs, "RAPID to run")

    def stop(self) -> None:
        """Stop RAPID and check that it has stopped."""
        self._ask(self._rws.stop)
        self._wait(lambda: not self.runs(), "RAPID to stop")

    def runs(self) -> bool:
        return self._ask(self._rws.get_execution_state).ctrlexecstate == "running"

    def _wait(self, is_done: Callable[[], bool], what: str) -> None:
        end = time.monotonic() + _SETTLING
        while not is_done():
            if time.monotonic() > end:
                raise LinkError(
                    f"Expected {what} on {self.place} within {_SETTLING:g} s, got no change. Event log: "
                    f"{self.last_event() or 'no error'}."
                )
            time.sleep(0.1)

    def last_event(self) -> str:
        """Return the number and title of the newest error in the event log, or "" if there is none."""
        with suppress(LinkError):
            for entry in self._ask(self._rws.read_event_log):
                if entry.msgtype == 3:
                    return f"{entry.code} {entry.title}"
        return ""

    def _modules(self, task: str) -> tuple[str, ...]:
        states = self._states(f"rw/rapid/modules?task={quote(task)}")
        return tuple(str(one["name"]) for one in states if one.get("type") == "ProgMod" and "name" in one)

    def _devices(self) -> dict[str, tuple[str, int]]:
        found = {}
        for name, attributes in self._instances("SIO/COM_TRP").items():
            if attributes.get("Type", "UDPUC") == "UDPUC":
                port = attributes.get("RemotePortNumber", "")
                address = attributes.get("RemoteAddress") or attributes.get("RemoteAdress", "")  # ABB's spelling
                found[name] = (address, int(port) if port.isascii() and port.isdigit() else 0)
        return found

    def _instances(self, kind: str) -> dict[str, dict[str, str]]:
        """Return the attributes of all instances of a system parameter type, by name; empty for an unknown type."""
        try:
            states = self._states(f"rw/cfg/{kind}/instances")
        except RwsError as error:
            if error.status in (400, 404):
                return {}
            raise
        found = {}
        for one in states:
            attributes = {str(a.get("_title")): str(a.get("value", "")) for a in one.get("attrib", [])}
            name = attributes.get("Name") or attributes.get("name") or str(one.get("_title", "")).rpartition("/")[2]
            found[name] = attributes
        return found

    def _holder(self) -> str:
        """Return the other client that holds RAPID mastership, or "" if mastership is free or not reported."""
        try:
            states = self._states("rw/mastership/rapid")
        except RwsError as error:
            if error.status in (400, 404):
                return ""
            raise
        for one in states:
            is_ours = str(one.get("mastershipheldbyme", "")).lower() == "true"
            if one.get("mastership", "nomaster") not in ("nomaster", "internal") and not is_ours:
                return str(one.get("application") or one.get("alias") or one["mastership"])
        return ""

    def _states(self, path: str) -> list[dict[str, Any]]:
        return self._ask(lambda: [dict(one) for one in self._rws._do_get(path)["_embedded"]["_state"]])

    def _post(self, path: str, **form: str) -> None:
        self._ask(self._rws._do_post, path, form)

    def _ask(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call the client library; convert any exception to a one-sentence error."""
        try:
            return function(*arguments)
        except LinkError:
            raise
        except Exception as error:
            raise RwsError(
                f"Expected Robot Web Services answers from {self.place}, got unexpected data "
                f"({type(error).__name__}: {str(error)[:200]}). Check "
                "that the device at this address is an ABB controller."
            ) from None


def _options(states: Any) -> Iterator[str]:
    """Yield the option names at all levels of a response."""
    for one in states if isinstance(states, list) else []:
        if isinstance(one, dict):
            if "option" in one:
                yield str(one["option"])
            for value in one.values():
                yield from _options(value)


class SetupStep(NamedTuple):
    """Setup step: its description and the function that performs it."""

    text: str
    run: Callable[[], None]


def setup_steps(
    controller: AbbController, status: ControllerStatus, tasks: Sequence[Task], modules: Mapping[str, str]
) -> list[SetupStep]:
    """Return the steps that save and unload other main modules and load `modules` (text by task); stop RAPID first."""
    steps = []
    for task in tasks:
        module, text = PROGRAMS[task.name][0], modules[task.name]
        for other in status.mains(task):
            if other != module:
                copy, its_text = f"{other}_before_armlab.mod", status.texts[task.name, other]
                save, unload = partial(controller.upload, copy, its_text), partial(controller.unload, task.name, other)
                steps += [
                    SetupStep(f"save {other} of {task.name} as $HOME/{copy}", save),
                    SetupStep(f"unload {other} from {task.name}", partial(_held, controller, unload)),
                ]
        name = f"{module}.mod"
        upload, load = partial(controller.upload, name, text), partial(controller.load, task.name, name)
        steps += [
            SetupStep(f"upload $HOME/{name}, {len(text)} bytes", upload),
            SetupStep(f"load the module into {task.name}", partial(_held, controller, load)),
        ]
    return steps


def start_steps(controller: AbbController, status: ControllerStatus, tasks: Sequence[Task]) -> list[SetupStep]:
    """Return the steps that start RAPID after the modules have been loaded."""
    names = [task.name for task in tasks]
    steps = [SetupStep("set the program pointer to main", partial(_held, controller, controller.pointer_to_main))]
    if status.state != "motoron":
        steps.append(SetupStep("switch the motors on", controller.motors_on))
    return [*steps, SetupStep(f"start RAPID in {', '.join(names)}", partial(controller.start, names))]


def _held(controller: AbbController, function: Callable[[], None]) -> None:
    with controller.mastership():
        function()
