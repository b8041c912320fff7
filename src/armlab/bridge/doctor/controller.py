"""Checks of an ABB controller via Robot Web Services, with one `Finding` per EGM requirement."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial

from armlab.bridge.doctor.machine import Finding
from armlab.bridge.net.events import Tell
from armlab.bridge.net.sockets import local_addresses
from armlab.bridge.rws import (
    INTERFACE,
    OLDEST,
    PROGRAMS,
    AbbController,
    ControllerStatus,
    Credentials,
    Task,
    open_controller,
    start_steps,
)
from armlab.errors import ConfigError, LinkError, UnknownName

_OPTION = ("689-1", "3124-1", "externally guided motion")
_HOW_TO = "See Controller configuration on the page Connect an ABB robot"
_STATES = {
    "motoron": "motors on",
    "motoroff": "motors off",
    "init": "starting up",
    "guardstop": "guard stop",
    "emergencystop": "emergency stop",
    "emergencystopreset": "emergency stop released, but not reset",
    "sysfail": "system failure",
}
_REMEDIES = {
    "motoroff": "armlab abb start switches the motors on.",
    "init": "Wait until the controller has started.",
    "guardstop": "Close the safety gate or release the protective stop, then acknowledge it.",
    "emergencystop": "Release the emergency stop, then press the motors-on button to reset it.",
    "emergencystopreset": "Press the motors-on button to reset the emergency stop.",
    "sysfail": "Read the event log on the pendant and restart the controller.",
}


def known_tasks(status: ControllerStatus, wanted: Sequence[str] = ()) -> list[Task]:
    """Return the motion tasks with an armlab guidance module, or only those named in `wanted`."""
    found = {task.name: task for task in status.tasks if task.name in PROGRAMS}
    for name in wanted:
        if name not in found:
            raise UnknownName.among("motion task of this controller", name, found)
    if not found:
        names = ", ".join(task.name for task in status.tasks) or "none"
        raise LinkError(
            f"Expected a motion task {', '.join(PROGRAMS)} on the controller, got {names}. Load the module by hand."
        )
    return [found[name] for name in wanted or found]


def senders(status: ControllerStatus) -> dict[int, Task]:
    """Map each destination port in the UDP devices to its sending task."""
    devices = {PROGRAMS[one.name][1]: one for one in known_tasks(status)}
    return {status.devices[name][1]: one for name, one in devices.items() if name in status.devices}


def tasks_for(status: ControllerStatus, ports: Sequence[int]) -> list[Task]:
    """Return the task that sends to each local port."""
    found = senders(status)
    if bad := [finding for finding in port_findings(status, ports) if finding.verdict != "ok"]:
        raise LinkError(
            f"Expected a UDP device of the controller for {bad[0].name}, got {bad[0].value}. {bad[0].advice}"
        )
    return [found[port] for port in ports]


def port_findings(status: ControllerStatus, ports: Sequence[int]) -> list[Finding]:
    """Return one finding per port, which states whether a task sends to it."""
    found = senders(status)
    known = ", ".join(f"{task.name} to {port}" for port, task in found.items()) or "none"
    advice = "Listen on the port of the task, or change the Remote Port Number of its device."
    return [
        Finding.judged(
            f"port {port}, sender", "failure", port not in found, found[port].name if port in found else known, advice
        )
        for port in ports
    ]


def controller_findings(
    status: ControllerStatus, tasks: Sequence[Task], modules: Mapping[str, str] | None = None, replace: bool = False
) -> list[Finding]:
    """Return the findings for a controller; `modules` maps tasks to RAPID code, and `replace` allows overwriting."""
    found = _status_findings(status)
    for task in tasks:
        found += [_module(status, task, (modules or {}).get(task.name, ""), replace), _device(status, task)]
    return found


def require(controller: AbbController, found: Sequence[Finding]) -> None:
    """Raise a LinkError if any finding is a failure."""
    causes = [f"{one.name}: {one.value}. {one.advice}" for one in found if one.verdict == "failure"]
    if causes:
        raise LinkError(f"Expected {controller.place} to be ready for EGM, got {' '.join(causes)}")


def require_rest(controller: AbbController, status: ControllerStatus) -> None:
    """Raise a LinkError if RAPID is running; programs can only be changed and started while RAPID is stopped."""
    if status.is_running:
        busy = ", ".join(task.name for task in status.tasks if task.is_active) or "a task"
        raise LinkError(
            f"Expected RAPID on {controller.place} to be stopped, but task {busy} is busy. Stop RAPID with armlab abb "
            "stop HOST."
        )


def require_loaded(controller: AbbController, tasks: Sequence[Task]) -> None:
    """Raise a LinkError if a task has no guidance module."""
    missing = [task.name for task in tasks if PROGRAMS[task.name][0] not in task.modules]
    if missing:
        raise LinkError(
            f"Expected armlab guidance modules in all tasks on {controller.place}, got none in {', '.join(missing)}. "
            "Load the modules with armlab abb setup HOST."
        )


def _status_findings(status: ControllerStatus) -> list[Finding]:
    robotware = f"{status.name}, RobotWare {status.robotware or 'unknown'}"
    update = (
        f"Update to RobotWare {OLDEST[0]}.{OLDEST[1]:02d} or newer; in "
        "older versions, EGM sends angles in radians and no timestamps."
    )
    option = next((one for one in status.options if any(word in one.lower() for word in _OPTION)), "")
    order = "Order and install Externally Guided Motion (689-1 on RobotWare 6, 3124-1 on 7)."
    automatic = "Switch to automatic mode: in manual mode, only the pendant can start the motors and RAPID."
    motors, is_off = _STATES.get(status.state, status.state), status.state == "motoroff"
    remedy = _REMEDIES.get(status.state, "See the pendant.")
    holder = f"held by {status.holder}" if status.holder else "free"
    is_missing = INTERFACE not in status.interfaces
    interface = f"no {INTERFACE!r} among {', '.join(status.interfaces) or 'none'}" if is_missing else INTERFACE
    add = f"Add External Motion Interface Data {INTERFACE!r} and restart the controller. {_HOW_TO}."
    judged = Finding.judged
    return [
        judged("controller", "failure", status.version < OLDEST, robotware, update),
        judged("EGM option", "failure", not option, option or "missing", order),
        judged("operating mode", "failure", status.mode != "AUTO", status.mode, automatic),
        judged("motors", "warning" if is_off else "failure", status.state != "motoron", motors, remedy),
        judged(
            "mastership",
            "failure",
            bool(status.holder),
            holder,
            "Release mastership in the client that holds it, or wait 5 minutes.",
        ),
        judged("RAPID", "warning", not status.is_running, status.execution, "Start RAPID with armlab abb start HOST."),
        judged("motion interface", "failure", is_missing, interface, add),
    ]


def _module(status: ControllerStatus, task: Task, text: str, replace: bool) -> Finding:
    name, module = f"{task.name}, program", PROGRAMS[task.name][0]
    others = [one for one in status.mains(task) if one != module]
    is_loaded = module in task.modules
    if others and not replace:
        advice = (
            "A task must have exactly one main routine. Unload the other "
            "modules, or save and unload them with armlab abb setup --replace."
        )
        return Finding(name, "failure", f"main is in {', '.join(others)}", advice)
    if is_loaded and text and not replace and not same_text(status.texts.get((task.name, module), ""), text):
        advice = "Run the module unchanged with armlab abb start, or overwrite it with armlab abb setup --replace."
        return Finding(name, "failure", f"{module} is loaded with different content", advice)
    kept = status.texts.get(("$HOME", module), "")
    if text and kept and not replace and not same_text(kept, text):
        advice = "Overwrite the file with armlab abb setup --replace."
        return Finding(name, "failure", f"$HOME/{module}.mod has different content", advice)
    value = f"{module} {'is' if is_loaded else 'is not'} loaded"
    return Finding.judged(
        name, "warning", not is_loaded and not text, value, "Load the module with armlab abb setup HOST."
    )


def same_text(one: str, other: str) -> bool:
    """Return whether two RAPID modules are identical except for line endings."""
    return [line.rstrip() for line in one.strip().splitlines()] == [
        line.rstrip() for line in other.strip().splitlines()
    ]


def _device(status: ControllerStatus, task: Task) -> Finding:
    name, device = f"{task.name}, UDP device", PROGRAMS[task.name][1]
    if device not in status.devices:
        value = f"no {device!r} among {', '.join(status.devices) or 'none'}"
        return Finding(name, "failure", value, f"Add a device {device!r} of type UDPUC and restart. {_HOW_TO}.")
    address, port = status.devices[device]
    own = {"127.0.0.1", *local_addresses().values()}
    advice = (
        f"Set the Remote Address of the device to this computer, {', '.join(sorted(own))}, and restart the controller."
    )
    return Finding.judged(name, "failure", address not in own, f"{device} sends to {address}:{port}", advice)


class RapidRun:
    """Starts RAPID for the runs of a link, unless it is already running, and stops only what it has started."""

    def __init__(self, rws: str, ca: str = "", insecure: str = "false") -> None:
        if insecure.lower() not in ("", "true", "false"):
            raise ConfigError(f"Expected insecure=true or insecure=false in the link, got {insecure!r}.")
        is_insecure = insecure.lower() != "false"
        Credentials.from_environment()  # raises an error before any connection is opened
        self._open = partial(open_controller, rws, Credentials.from_environment, is_insecure, ca)

    @contextmanager
    def running(
        self, ports: Sequence[int], tell: Tell, cancelled: Callable[[], bool] = lambda: False
    ) -> Iterator[None]:
        """Run the guidance modules that send to these ports; leave running modules alone.

        Started modules are stopped at the end, even if an error or interrupt occurs during the start. Once
        `cancelled` returns True, the remaining steps are skipped.
        """
        started = False
        try:
            with self._open() as controller:
                status = controller.status()
                tasks = tasks_for(status, ports)
                require(controller, controller_findings(status, tasks))
                require_loaded(controller, tasks)
                runs = all(task.state == "started" for task in tasks)
                if not runs:
                    require_rest(controller, status)
                for step in () if runs else start_steps(controller, status, tasks):
                    if cancelled():
                        break
                    started = True
                    step.run()
                    tell(f"{controller.place}: {step.text}")
            yield
        finally:
            if started:
                self._stop(tell)

    def _stop(self, tell: Tell) -> None:
        try:
            self._stop_once(tell)
        except KeyboardInterrupt:  # RAPID must not keep running after Ctrl-C
            self._stop_once(tell)
            raise

    def _stop_once(self, tell: Tell) -> None:
        try:
            with self._open() as controller:
                controller.stop()
                tell(f"{controller.place}: stop RAPID")
        except LinkError as error:
            tell(f"RAPID may still be running. {error}", True)
