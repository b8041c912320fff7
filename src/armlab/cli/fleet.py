"""``armlab fleet``: the same jobs over many logs and many robots."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter

from armlab.errors import ConfigError

if TYPE_CHECKING:
    from armlab.bridge.servers.zenoh import Place

__all__ = ["fleet", "list_fleet", "record", "router"]

_ROUTER = "127.0.0.1:7447"
_PORT = 7447
_LOOK = 0.2  # s between two looks at the clock

fleet = App(name="fleet", help="Many robots and many logs: a router, recordings of all robots, one list of them.")


@fleet.command(help_epilogue="Example: armlab fleet router --listen 192.168.1.9 --users lab/users.txt")
def router(
    *,
    listen: str = "127.0.0.1",
    port: int = _PORT,
    connect: list[str] | None = None,
    ca: Path | None = None,
    certificate: Path | None = None,
    key: Path | None = None,
    users: Path | None = None,
    secret: Path | None = None,
    seconds: float | None = None,
) -> None:
    """Be the Zenoh router through which bridges and their readers find each other, until Ctrl-C.

    Parameters
    ----------
    listen
        Address of the network card; beyond this computer only with certificates and users.
    port
        TCP port.
    connect
        HOST:PORT of another router, whose robots are seen through this one too.
    ca, certificate, key, users, secret
        Files of armlab bridge certificates: lab.pem, bridge.pem, bridge.key, users.txt; for --connect bridge.secret.
    seconds
        Time after which to end [s].
    """
    from armlab.bridge.servers.zenoh import Security
    from armlab.cli.output import note
    from armlab.fleet import Router

    _check(seconds)
    if not 0 <= port < 65536:
        raise ConfigError(f"Expected a port from 0 to 65535, got {port}.")
    with Router(listen, port, connect or (), Security(ca, certificate, key, users, secret)) as running:
        note(f"zenoh router at {running.where}")
        _wait(seconds)


@fleet.command(help_epilogue="Example: armlab fleet record --lab lab1 -o recordings")
def record(
    *,
    output: Annotated[Path, Parameter(alias="-o")],
    lab: str = "",
    router: str = _ROUTER,
    ca: Path | None = None,
    secret: Path | None = None,
    seconds: float | None = None,
) -> int:
    """Record every robot whose rows come, each in a file of its own, until Ctrl-C.

    Parameters
    ----------
    output
        Folder for the files, LAB-ROBOT.mcap; made if it is not there.
    lab
        Record this lab only.
    router
        HOST:PORT of the router.
    ca, secret
        Files of armlab bridge certificates, for a router that asks for them: lab.pem, viewer.secret.
    seconds
        Time after which to end [s].
    """
    from armlab.cli import FAILED
    from armlab.cli.output import aligned, note, result
    from armlab.fleet import FleetRecorder

    _check(seconds)
    if output.exists() and not output.is_dir():
        raise ConfigError(f"Expected a folder for the recordings, got the file {output}. Choose another name.")
    with FleetRecorder(_place(lab, router, ca, secret), output, note) as recorder:
        note(f"recording the robots at {router} into {output}")
        try:
            _wait(seconds)
        finally:
            recorder.close()
            robots = recorder.robots
            rows = [["robot", "rows", "lost", "damaged", "refused"]]
            for name, one in sorted(robots.items()):
                rows.append([name, *map(str, (one.rows, one.lost, one.damaged, one.refused))])
            result(aligned(rows, (1, 2, 3, 4)) if robots else "No robot came.")
    return FAILED if any(one.failed for one in robots.values()) else 0


@fleet.command(name="list", help_epilogue="Example: armlab fleet list --lab lab1 --json")
def list_fleet(
    *,
    lab: str = "",
    router: str = _ROUTER,
    ca: Path | None = None,
    secret: Path | None = None,
    seconds: float = 2.0,
    json: bool = False,
) -> None:
    """List the robots whose bridges are there: rate, rows that did not come, age of the newest row, commander.

    Parameters
    ----------
    lab
        List this lab only.
    router
        HOST:PORT of the router.
    ca, secret
        Files of armlab bridge certificates, for a router that asks for them: lab.pem, viewer.secret.
    seconds
        Time to listen [s].
    json
        Print JSON.
    """
    from armlab.cli.output import aligned, print_json, result
    from armlab.fleet import list_robots

    _check(seconds)
    found = list_robots(_place(lab, router, ca, secret), seconds)
    if json:
        print_json([robot._asdict() for robot in found])
        return
    rows: list[list[str]] = [["lab", "robot", "rate [Hz]", "lost", "damaged", "age [s]", "commander"]]
    for one in found:
        age = f"{one.age:.3f}" if one.age == one.age else "no rows"
        counts = [f"{one.rate:.1f}", str(one.loss), str(one.damaged), age]
        rows.append([one.lab, one.robot, *counts, one.commander or "nobody"])
    result(aligned(rows, (2, 3, 4, 5)) if found else "No robot is there.")


fleet.command(
    "armlab.cli.fleet_logs:identify",
    name="identify",
    help_epilogue="Example: armlab fleet identify logs/ -o model.toml --workers 4",
)
fleet.command(
    "armlab.cli.fleet_logs:estimate",
    name="estimate",
    help_epilogue="Example: armlab fleet estimate logs/ --model model.toml -o estimates/ --workers 4",
)
fleet.command(
    "armlab.cli.fleet_logs:export",
    name="export",
    help_epilogue="Example: armlab fleet export logs/ --format csv -o text/ --workers 4",
)


def _place(lab: str, router: str, ca: Path | None, secret: Path | None) -> Place:
    from armlab.bridge.servers.zenoh import EVERY, Place, Security

    return Place.read(f"zenoh://{router}/{lab}")._replace(lab=lab or EVERY, security=Security(ca=ca, secret=secret))


def _check(seconds: float | None) -> None:
    if seconds is not None and not seconds >= 0.0:
        raise ConfigError(f"Expected seconds of at least 0 s, got {seconds}.")


def _wait(seconds: float | None) -> None:
    end = float("inf") if seconds is None else time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0.0:
        time.sleep(min(left, _LOOK))
