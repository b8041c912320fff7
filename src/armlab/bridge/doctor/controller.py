"""Checks of an ABB controller via Robot Web Services: one `Finding` per cause that prevents EGM from starting."""

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
    "motoroff": "armlab abb start switches them on.",
    "init": "Wait until the controller has started.",
    "guardstop": "Close the safety gate or release the protective stop, and acknowledge it.",
    "emergencystop": "Release the emergency stop, then press the motors-on button to reset it.",
    "emergencystopreset": "Press the motors-on button to reset the emergency stop.",
    "sysfail": "Read the event log on the pendant and restart the controller.",
}


def known_tasks(status: ControllerStatus, wanted: Sequence[str] = ()) -> list[Task]:
    """Return the motion tasks with an armlab guidance module, or the requested ones among them."""
    found = {task.name: task for task in status.tasks if task.name in PROGRAMS}
    for name in wanted:
        if name not in found:
            raise UnknownName.among("motion task of this controller", name, found)
    if not found:
        names = ", ".join(task.name for task in status.tasks) or "none"
        raise LinkError(f"Expected a motion task {', '.join(PROGRAMS)} on the controller, got {names}. Load by hand.")
    return [found[name] for name in wanted or found]


def senders(status: ControllerStatus) -> dict[int, Task]:
    """Return the task that sends to each port, according to its UDP device."""
    return {status.devices[PROGRAMS[one.name][1]][1]: one for one in known_tasks(status) if _has_device(status, one)}


def tasks_for(status: ControllerStatus, ports: Sequence[int]) -> list[Task]:
    """Return the task that sends to each port of this computer."""
    found = senders(status)
    if bad := [finding for finding in port_findings(status, ports) if finding.verdict != "ok"]:
        raise LinkError(
            f"Expected a UDP device of the controller for {bad[0].name}, got {bad[0].value}. {bad[0].advice}"
        )
    return [found[port] for port in ports]


def port_findings(status: ControllerStatus, ports: Sequence[int]) -> list[Finding]:
    """Return one finding per port: whether a task sends to it."""
    found = senders(status)
    known = ", ".join(f"{task.name} to {port}" for port, task in found.items()) or "none"
    advice = "Open the port of the task, or change Remote Port Number of its device."
    return [
        Finding.judged(
            f"port {port}, sender", "failure", port not in found, found[port].name if port in found else known, advice
        )
        for port in ports
    ]


def controller_findings(
    status: ControllerStatus, tasks: Sequence[Task], modules: Mapping[str, str] | None = None, replace: bool = False
) -> list[Finding]:
    """Return the findings for these tasks; `modules` are texts to load by task; `replace` lets them replace others."""
    checks = (_robotware, _option, _mode, _state, _mastership, _execution, _interface)
    found = [check(status) for check in checks]
    for task in tasks:
        found += [_module(status, task, (modules or {}).get(task.name, ""), replace), _device(status, task)]
    return found


def require(controller: AbbController, found: Sequence[Finding]) -> None:
    """Raise if a finding is a failure."""
    causes = [f"{one.name}: {one.value}. {one.advice}" for one in found if one.verdict == "failure"]
    if causes:
        raise LinkError(f"Expected {controller.place} to be ready for EGM, got {' '.join(causes)}")


def require_rest(controller: AbbController, status: ControllerStatus) -> None:
    """Raise if RAPID is running, because programs may be changed and started only at rest."""
    if status.is_running:
        busy = ", ".join(task.name for task in status.tasks if task.is_active) or "a task"
        raise LinkError(
            f"Expected RAPID on {controller.place} to be stopped, but task {busy} is busy. Stop it with armlab abb "
            "stop HOST."
        )


def require_loaded(controller: AbbController, tasks: Sequence[Task]) -> None:
    """Raise if a task has no guidance module."""
    missing = [task.name for task in tasks if PROGRAMS[task.name][0] not in task.modules]
    if missing:
        raise LinkError(
            f"Expected armlab guidance modules in all tasks on {controller.place}, got none in {', '.join(missing)}. "
            "Load them with armlab abb setup HOST."
        )


def _robotware(status: ControllerStatus) -> Finding:
    oldest = f"{OLDEST[0]}.{OLDEST[1]:02d}"
    value = f"{status.name}, RobotWare {status.robotware or 'unknown'}"
    advice = f"armlab needs RobotWare {oldest} or newer; in older versions, EGM sends radians and no time. Update it."
    return Finding.judged("controller", "failure", status.version < OLDEST, value, advice)


def _option(status: ControllerStatus) -> Finding:
    has = [one for one in status.options if any(word in one.lower() for word in _OPTION)]
    advice = "Order Externally Guided Motion (689-1 on RobotWare 6, 3124-1 on 7) and install it."
    return Finding.judged("EGM option", "failure", not has, has[0] if has else "missing", advice)


def _mode(status: ControllerStatus) -> Finding:
    advice = (
        "Switch to automatic mode: in manual mode, only the pendant with its enabling device can start the "
        "motors and RAPID."
    )
    return Finding.judged("operating mode", "failure", status.mode != "AUTO", status.mode, advice)


def _state(status: ControllerStatus) -> Finding:
    value = _STATES.get(status.state, status.state)
    verdict = "warning" if status.state == "motoroff" else "failure"
    advice = _REMEDIES.get(status.state, "See the pendant.")
    return Finding.judged("motors", verdict, status.state != "motoron", value, advice)


def _mastership(status: ControllerStatus) -> Finding:
    value = f"held by {status.holder}" if status.holder else "free"
    return Finding.judged("mastership", "failure", bool(status.holder), value, "Release it there, or wait 5 minutes.")


def _execution(status: ControllerStatus) -> Finding:
    return Finding.judged(
        "RAPID", "warning", not status.is_running, status.execution, "armlab abb start HOST starts it."
    )


def _interface(status: ControllerStatus) -> Finding:
    is_missing = INTERFACE not in status.interfaces
    value = f"no {INTERFACE!r} among {', '.join(status.interfaces) or 'none'}" if is_missing else INTERFACE
    advice = f"Add External Motion Interface Data {INTERFACE!r} and restart the controller. {_HOW_TO}."
    return Finding.judged("motion interface", "failure", is_missing, value, advice)


def _module(status: ControllerStatus, task: Task, text: str, replace: bool) -> Finding:
    name, module = f"{task.name}, program", PROGRAMS[task.name][0]
    others = [one for one in status.mains(task) if one != module]
    is_loaded = module in task.modules
    if others and not replace:
        advice = "A task must have exactly one main. Unload it, or let armlab abb setup --replace save and unload it."
        return Finding(name, "failure", f"main is in {', '.join(others)}", advice)
    if is_loaded and text and not replace and not same_text(status.texts.get((task.name, module), ""), text):
        advice = "armlab abb start runs it unchanged; armlab abb setup --replace overwrites it."
        return Finding(name, "failure", f"{module} is loaded with different content", advice)
    kept = status.texts.get(("$HOME", module), "")
    if text and kept and not replace and not same_text(kept, text):
        advice = "armlab abb setup --replace overwrites it."
        return Finding(name, "failure", f"$HOME/{module}.mod has different content", advice)
    value = f"{module} {'is' if is_loaded else 'is not'} loaded"
    return Finding.judged(name, "warning", not is_loaded and not text, value, "armlab abb setup HOST loads it.")


def same_text(one: str, other: str) -> bool:
    """Return whether two RAPID modules are identical except for line endings."""
    return [line.rstrip() for line in one.strip().splitlines()] == [
        line.rstrip() for line in other.strip().splitlines()
    ]


def _has_device(status: ControllerStatus, task: Task) -> bool:
    return PROGRAMS[task.name][1] in status.devices


def _device(status: ControllerStatus, task: Task) -> Finding:
    name, device = f"{task.name}, UDP device", PROGRAMS[task.name][1]
    if not _has_device(status, task):
        value = f"no {device!r} among {', '.join(status.devices) or 'none'}"
        return Finding(name, "failure", value, f"Add a device {device!r} of type UDPUC and restart. {_HOW_TO}.")
    address, port = status.devices[device]
    own = {"127.0.0.1", *local_addresses().values()}
    advice = f"Set its Remote Address to this computer, {', '.join(sorted(own))}, and restart the controller."
    return Finding.judged(name, "failure", address not in own, f"{device} sends to {address}:{port}", advice)


class RapidRun:
    """RAPID during the runs of a link: started if it is at rest, and stopped only if it was started here."""

    def __init__(self, rws: str, ca: str = "", insecure: str = "false") -> None:
        if insecure.lower() not in ("", "true", "false"):
            raise ConfigError(f"Expected insecure=true or insecure=false in the link, got {insecure!r}.")
        is_insecure = insecure.lower() != "false"
        Credentials.from_environment()  # before anything is opened
        self._open = partial(open_controller, rws, Credentials.from_environment, is_insecure, ca)

    @contextmanager
    def running(
        self, ports: Sequence[int], tell: Tell, cancelled: Callable[[], bool] = lambda: False
    ) -> Iterator[None]:
        """Run the guidance modules that send to these ports; leave modules that are already running alone.

        Modules that were started are stopped, even after an error or interrupt during their start. `cancelled` stops
        the sequence of steps.
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
        except KeyboardInterrupt:  # Ctrl-C must not leave RAPID running
            self._stop_once(tell)
            raise

    def _stop_once(self, tell: Tell) -> None:
        try:
            with self._open() as controller:
                controller.stop()
                tell(f"{controller.place}: stop RAPID")
        except LinkError as error:
            tell(f"RAPID may still run. {error}", True)
