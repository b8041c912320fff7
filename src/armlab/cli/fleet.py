"""``armlab fleet``: route, record and list many robots; identify, estimate and export many logs."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter

import armlab
from armlab.cli import DOUBTFUL, FAILED
from armlab.cli.support.options import Columns, ForceMethod, Json, Output, Seconds, load_robot, require_seconds
from armlab.cli.support.output import aligned, check_output, note, print_json, progress, result
from armlab.cli.support.results import Results, parameters
from armlab.errors import ArmlabError, ConfigError

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from armlab.bridge.servers.zenoh.session import LabAddress
    from armlab.robots import Robot

RouterAddress = Annotated[str, Parameter(help="HOST:PORT of the router.")]
Ca = Annotated[
    Path | None, Parameter(help="CA certificate of the router: lab.pem, written by armlab bridge certificates.")
]
Secret = Annotated[Path | None, Parameter(help="Password file (such as viewer.secret), if the router requires one.")]
_ROUTER = "127.0.0.1:7447"
_PORT = 7447
_POLL = 0.2  # s, longest sleep before the clock is checked

fleet: App = App(name="fleet", help="Manage many robots: router, recorder, status list, batch jobs.")


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
    seconds: Seconds = None,
) -> None:
    """Run the Zenoh router that connects bridges and clients, until Ctrl-C.

    Parameters:
        listen: Address of the network interface; remote access requires certificates and users.
        port: TCP port.
        connect: HOST:PORT of another router, whose robots become visible through this router.
        ca: CA certificate of the lab: lab.pem, written by armlab bridge certificates.
        certificate: Certificate of this router: bridge.pem.
        key: Private key of the certificate: bridge.key.
        users: Password file of the users: users.txt.
        secret: Password file for the routers given by --connect: bridge.secret.
    """
    from armlab.bridge.servers.zenoh.security import Security
    from armlab.fleet import Router

    require_seconds(seconds)
    if not 0 <= port < 65536:
        raise ConfigError(f"Expected a port from 0 to 65535, got {port}.")
    with Router(listen, port, connect or (), Security(ca, certificate, key, users, secret)) as running:
        note(f"zenoh router at {running.where}")
        _wait(seconds)


@fleet.command(help_epilogue="Example: armlab fleet record --lab lab1 -o recordings")
def record(
    *,
    output: Output,
    lab: str = "",
    router: RouterAddress = _ROUTER,
    ca: Ca = None,
    secret: Secret = None,
    seconds: Seconds = None,
) -> int:
    """Record all robots that send rows, in one file per robot, until Ctrl-C.

    Parameters:
        output: Folder for the files, LAB-ROBOT.mcap; created if missing.
        lab: Record only this lab.
    """
    from armlab.fleet import FleetRecorder

    require_seconds(seconds)
    if output.exists() and not output.is_dir():
        raise ConfigError(f"Expected a folder for the recordings, got the file {output}. Choose another name.")
    with FleetRecorder(_place(lab, router, ca, secret), output, note) as recorder:
        note(f"recording the robots at {router} into {output}")
        try:
            _wait(seconds)
        finally:
            recorder.close()
            robots = recorder.robots
            counts = ("rows", "lost", "damaged", "refused")
            rows = [(name, *(str(getattr(one, count)) for count in counts)) for name, one in sorted(robots.items())]
            result(aligned([("robot", *counts), *rows], (1, 2, 3, 4)) if robots else "No robots recorded.")
    return FAILED if any(one.failed for one in robots.values()) else 0


@fleet.command(name="list", help_epilogue="Example: armlab fleet list --lab lab1 --json")
def list_fleet(
    *,
    lab: str = "",
    router: RouterAddress = _ROUTER,
    ca: Ca = None,
    secret: Secret = None,
    seconds: float = 2.0,
    json: Json = False,
) -> None:
    """List the robots with running bridges: rate, missing rows, age of the newest row, commanding client.

    Parameters:
        lab: List only this lab.
        seconds: Listening time [s].
    """
    from armlab.fleet import list_robots

    require_seconds(seconds)
    found = list_robots(_place(lab, router, ca, secret), seconds)
    if json:
        print_json([robot._asdict() for robot in found])
        return
    rows: list[list[str]] = [["lab", "robot", "rate [Hz]", "lost", "damaged", "age [s]", "commander"]]
    for one in found:
        age = f"{one.age:.3f}" if one.age == one.age else "no rows"
        counts = [f"{one.rate:.1f}", str(one.loss), str(one.damaged), age]
        rows.append([one.lab, one.robot, *counts, one.commander or "none"])
    result(aligned(rows, (2, 3, 4, 5)) if found else "No robots found.")


def _place(lab: str, router: str, ca: Path | None, secret: Path | None) -> LabAddress:
    from armlab.bridge.servers.zenoh.messages import EVERY
    from armlab.bridge.servers.zenoh.security import Security
    from armlab.bridge.servers.zenoh.session import LabAddress

    return LabAddress.read(f"zenoh://{router}/{lab}")._replace(
        lab=lab or EVERY, security=Security(ca=ca, secret=secret)
    )


def _wait(seconds: float | None) -> None:
    end = float("inf") if seconds is None else time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0.0:
        time.sleep(min(left, _POLL))


@Parameter(name="*")
@dataclass(frozen=True)
class Job:
    """Options common to all batch commands.

    Attributes:
        robot: Library name or robot file; default: the robot named by the recordings.
        workers: Number of processes on this computer.
        dask: Address of a Dask scheduler, tcp://HOST:PORT; its workers need the files at the same paths.
        json: Print JSON for scripts.
        force: Replace existing files, and save a poor model.
    """

    robot: str | None = None
    columns: Columns = None
    workers: int = 1
    dask: str | None = None
    json: bool = False
    force: bool = False

    def arm(self, logs: tuple[Path, ...]) -> Robot:
        """Return the given arm, or the arm named by the first readable recording."""
        from armlab.fleet.logs import named

        if self.robot is not None:
            return load_robot(self.robot)
        for log in named(logs):
            if not log.endswith(".mcap"):
                continue
            try:
                return load_robot(armlab.log.inspect(log).metadata["armlab"]["robot"])
            except (ArmlabError, OSError, KeyError):
                continue
        raise ConfigError("Expected recordings that name a library robot, got none. Add --robot ROBOT.")

    @contextmanager
    def work(self, title: str) -> Iterator[tuple[Executor | None, Callable[[int, int, str], None]]]:
        """Yield the executor and the progress callback of a batch job."""
        from armlab.fleet.mapping import workers

        with workers(self.workers, self.dask) as executor, progress(title) as tell:
            yield executor, tell


@fleet.command(help_epilogue="Example: armlab fleet identify logs/ -o model.toml --workers 4")
def identify(*logs: Path, output: Output, no_cache: bool = False, job: Job = Job()) -> int:
    """Identify gravity, inertia and friction from many logs of one arm; save the model.

    The result is bit-identical for any number of workers. The regression sums of each log are cached, so later runs
    process only new logs. The exit status is 3 if any log is unusable (all such logs are listed) or if the model is
    poor. A poor model is saved only with --force.

    Parameters:
        logs: Recordings of free motion without contact, or folders of recordings.
        output: Output model file, .toml.
        no_cache: Do not cache the sums.
        job: See `Job`.
    """
    from armlab import fleet
    from armlab.cli.identify.report import judge, try_out
    from armlab.cli.support.log_input import read_log
    from armlab.fleet.identification import default_folder

    check_output(output, job.force, [".toml"])
    arm = job.arm(logs)
    cache = None if no_cache else default_folder()
    with job.work("identify") as (executor, tell):
        found = fleet.identify(logs, arm, executor, tell, cache, columns=job.columns)
    first = read_log(Path(found.used[0]), arm, columns=job.columns)
    verdict = judge(found.fit, arm, [first], try_out(found.fit.value, arm, first, unseen=False))
    wanted = Results(json=job.json, force=job.force)
    told = {"parameters": parameters(found.fit), "used": found.used, "skipped": found.skipped}
    wanted.say({"model": str(output), **told}, found.report(), verdict)
    code = wanted.keep(verdict, {output: found.fit.save})
    return DOUBTFUL if found.skipped else code


@fleet.command(help_epilogue="Example: armlab fleet estimate logs/ --model model.toml -o estimates/ --workers 4")
def estimate(
    *logs: Path,
    model: Path,
    output: Output,
    method: ForceMethod = "map",
    csv: bool = False,
    job: Job = Job(),
) -> int:
    """Estimate the contact force in many logs of one arm; write one file per log.

    For each log, prints the length, the number and duration of contacts, the largest force and the mean 2-sigma band.
    Unusable logs are listed, with exit status 3.

    Parameters:
        logs: Recordings with positions, velocities and torques, or folders of recordings.
        model: Model file written by armlab identify.
        output: Folder for the estimates.
        method: Estimation method, as in armlab estimate.
        csv: Write CSV instead of MCAP.
        job: See `Job`.
    """
    from armlab import fleet

    arm, known = job.arm(logs), armlab.models.load(model, "torque_model")
    about = {"method": method, "ending": ".csv" if csv else ".mcap", "force": job.force, "columns": job.columns}
    with job.work("estimate") as (executor, tell):
        done = fleet.estimate(logs, known, arm, output, executor, tell, **about)
    if job.json:
        told = {name: {**vars(one), "path": str(one.path)} for name, one in done.results.items()}
        print_json({"logs": told, "skipped": done.skipped})
    else:
        rows = []
        for name, one in done.results.items():
            forces = [f"{x:.2f}" if math.isfinite(x) else "-" for x in (one.contact_seconds, one.peak, one.band)]
            rows.append([name, f"{one.seconds:.1f}", f"{one.contacts}", *forces])
        head = ["log", "seconds", "contacts", "in contact [s]", "largest [N]", "2-sigma [N]"]
        result(aligned([head, *rows], right=range(1, len(head))))
        _skipped(done.skipped)
    note(f"estimates: {output}")
    return DOUBTFUL if done.skipped else 0


@fleet.command(help_epilogue="Example: armlab fleet export logs/ --format csv -o text/ --workers 4")
def export(
    *logs: Path,
    format: Literal["csv", "mat", "parquet", "h5", "mcap", "rosbag2"],
    output: Output,
    job: Job = Job(),
) -> int:
    """Convert many logs to another format.

    Unreadable logs are listed, with exit status 3.

    Parameters:
        logs: Files of any supported format, or folders of such files.
        format: Output format: csv, mat, parquet, h5, mcap or rosbag2.
        output: Folder for the files.
        job: See `Job`; only mcap output uses the robot.
    """
    from armlab import fleet

    arm = job.arm(logs) if format == "mcap" else None
    with job.work("export") as (executor, tell):
        done = fleet.export(logs, output, f".{format}", executor, tell, robot=arm, force=job.force, columns=job.columns)
    if job.json:
        print_json({"files": {name: str(path) for name, path in done.results.items()}, "skipped": done.skipped})
    else:
        result("\n".join(map(str, done.results.values())))
        _skipped(done.skipped)
    note(f"{len(done.results)} files in {output}")
    return DOUBTFUL if done.skipped else 0


def _skipped(reasons: Mapping[str, str]) -> None:
    for name, reason in reasons.items():
        note(f"skipped {name}: {reason}")
