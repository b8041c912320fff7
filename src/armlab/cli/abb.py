"""``armlab abb``: set up, start and stop an EGM program on an ABB controller via Robot Web Services."""

from __future__ import annotations

import getpass
import sys
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from armlab.cli.support.options import Json
from armlab.cli.support.output import note, print_findings, result
from armlab.errors import LinkError

if TYPE_CHECKING:
    from armlab.bridge.rws import AbbController, ControllerStatus, SetupStep, Task

abb: App = App(
    name="abb",
    help="Set up an ABB controller via Robot Web Services: program, motors, RAPID. RobotWare 6 and 7.",
    help_epilogue="The user name and password are read from ARMLAB_RWS_USER and ARMLAB_RWS_PASSWORD, or armlab prompts "
    "for the password. Exit codes: 0 success, 1 not ready or refused (with the reason), 3 success with warnings.",
)

Insecure = Annotated[bool, Parameter(help="Accept any TLS certificate; use this only on a private network.")]
Ca = Annotated[Path | None, Parameter(help="Certificate file of the controller or its certificate authority.")]
DryRun = Annotated[bool, Parameter(help="Check and list the steps without changing anything.")]
Tasks = Annotated[
    list[str] | None,
    Parameter(
        name="--task",
        help="Motion task; repeat the option for several tasks. Default: all tasks whose names armlab recognises.",
    ),
]


def connected(host: str, insecure: bool, ca: Path | None) -> AbbController:
    """Return the controller at a host; the password is read from the environment or prompted for."""
    from armlab.bridge.rws import Credentials, open_controller

    ask = getpass.getpass if sys.stdin.isatty() else None
    return open_controller(host, lambda: Credentials.from_environment(ask), insecure, str(ca or ""))


@abb.command(help_epilogue="Example: armlab abb status 192.168.125.1")
def status(host: str, *, task: Tasks = None, insecure: Insecure = False, ca: Ca = None, json: Json = False) -> int:
    """Check a controller: version, options, mode, motors, tasks, programs and EGM configuration. Changes nothing.

    Exit codes: 0 ready, 3 warnings, 1 failures.

    Parameters:
        host: Address of the controller, such as 192.168.125.1 or 127.0.0.1:8080.
    """
    from armlab.bridge.doctor.controller import controller_findings, known_tasks

    with connected(host, insecure, ca) as controller:
        found = controller.status(texts=True)
        return print_findings(controller_findings(found, known_tasks(found, task or ())), json)


@abb.command(help_epilogue="Example: armlab abb setup 192.168.125.1 --dry-run")
def setup(
    host: str,
    *,
    task: Tasks = None,
    modules: Path | None = None,
    replace: bool = False,
    dry_run: DryRun = False,
    insecure: Insecure = False,
    ca: Ca = None,
) -> None:
    """Upload and load the guidance modules, set the program pointer, switch the motors on, and start RAPID.

    The modules hold the arm in place until a program on this computer commands it.

    Parameters:
        host: Address of the controller, such as 192.168.125.1.
        modules: Folder with your own versions of the modules, such as ArmlabJoint.mod; armlab supplies any missing
            modules.
        replace: Overwrite modules and files that differ, and save and unload any other module with a main routine.
    """
    from armlab.bridge.doctor.controller import controller_findings, known_tasks, require, require_rest
    from armlab.bridge.rws import setup_steps, start_steps

    with connected(host, insecure, ca) as controller:
        found = controller.status(texts=True)
        tasks = known_tasks(found, task or ())
        texts = {one.name: _module(one.name, modules) for one in tasks}
        require(controller, controller_findings(found, tasks, texts, replace))
        require_rest(controller, found)
        _take([*setup_steps(controller, found, tasks, texts), *start_steps(controller, found, tasks)], dry_run)
        _tell(found, tasks, dry_run)


@abb.command(help_epilogue="Example: armlab abb start 192.168.125.1 --task T_ROB_L")
def start(host: str, *, task: Tasks = None, dry_run: DryRun = False, insecure: Insecure = False, ca: Ca = None) -> None:
    """Switch the motors on and start the loaded guidance modules from main.

    Parameters:
        host: Address of the controller, such as 192.168.125.1.
    """
    from armlab.bridge.doctor.controller import controller_findings, known_tasks, require, require_loaded, require_rest
    from armlab.bridge.rws import start_steps

    with connected(host, insecure, ca) as controller:
        found = controller.status(texts=True)
        tasks = known_tasks(found, task or ())
        require(controller, controller_findings(found, tasks))
        require_loaded(controller, tasks)
        require_rest(controller, found)
        _take(start_steps(controller, found, tasks), dry_run)
        _tell(found, tasks, dry_run)


@abb.command(help_epilogue="Example: armlab abb stop 192.168.125.1")
def stop(host: str, *, dry_run: DryRun = False, insecure: Insecure = False, ca: Ca = None) -> None:
    """Stop RAPID in all tasks; the motors stay on.

    Parameters:
        host: Address of the controller, such as 192.168.125.1.
    """
    from armlab.bridge.rws import SetupStep

    with connected(host, insecure, ca) as controller:
        if controller.runs():
            _take([SetupStep("stop RAPID", controller.stop)], dry_run)
        else:
            note("RAPID is already stopped.")


def _module(task: str, folder: Path | None) -> str:
    """Return the source of a task's guidance module: the user's version if present, otherwise armlab's."""
    from armlab.bridge.rws import PROGRAMS
    from armlab.cli.support.settings import read_text

    name = f"{PROGRAMS[task][0]}.mod"
    if folder is not None and (folder / name).exists():
        return read_text(folder / name, "a RAPID module")
    return files("armlab.bridge").joinpath("rapid", name).read_text(encoding="utf-8")


def _take(steps: Sequence[SetupStep], dry_run: bool) -> None:
    for step in steps:
        if dry_run:
            result(f"would {step.text}")
            continue
        try:
            step.run()
        except LinkError as error:
            raise LinkError(f"Expected to {step.text}, but it failed. {error}") from None
        result(f"done: {step.text}")


def _tell(found: ControllerStatus, tasks: Sequence[Task], dry_run: bool) -> None:
    from armlab.bridge.rws import PROGRAMS

    if not dry_run:
        for task in tasks:
            address, port = found.devices[PROGRAMS[task.name][1]]
            note(f"{task.name} sends EGM packets to {address}, port {port}.")
