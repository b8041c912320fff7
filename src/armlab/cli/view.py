"""``armlab view``: show a log or a running bridge in the browser."""

from __future__ import annotations

import select
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, TYPE_CHECKING, Any
from urllib.parse import urlsplit

import armlab
from armlab.cli.support.options import Columns, load_robot, mesh_option
from armlab.cli.support.output import note, result
from armlab.errors import ConfigError, LinkError

if TYPE_CHECKING:
    from armlab.models import TorqueModel

_START, _END = 30.0, 5.0  # s, timeouts for the start and the end of a view
ABOVE = 5  # parent folders searched for a mesh package


def view(
    *what: str,
    live: bool = False,
    fleet: bool = False,
    zenoh: str = "",
    robot: list[str] | None = None,
    model: list[Path] | None = None,
    columns: Columns = None,
    cell: str = "",
    port: int | None = None,
    package_path: list[Path] | None = None,
    force: bool = False,
) -> None:
    """Show logs in the browser until Ctrl-C; with --live a running bridge, with --fleet all robots at a router.

    Prints the address of the page. The page can be opened only on this computer; for remote viewing, forward the port
    with ssh -L. A view is read-only: it cannot delay or command the bridge. The view waits for the bridge to start, and
    reconnects after a restart.

    Parameters:
        what: Log files of one or more arms; with --live, the name of an arm (default: all arms).
        live: Show one of your running bridges, or a remote bridge with --zenoh.
        fleet: Show all robots listed by armlab fleet list; --zenoh selects another router or one lab.
            Robots are added as they appear and marked when they disappear.
        zenoh: Address of the bridge or router, such as zenoh://192.168.1.5:7447/lab1; with --fleet
            zenoh://127.0.0.1:7447.
        robot: Library name or robot file, one per log without an embedded robot description. Also needed to show
            meshes, which recordings and bridges do not contain. Mesh files are searched for in the folder of the robot
            file and in its parent folders. A recording or bridge of another robot is rejected.
        model: Model file written by `armlab identify`, used to estimate the force if the log or bridge has no estimate;
            one per arm.
        cell: With --live: name of the cell; required if several cells are running.
        port: Port of the page; default: the first free port from 8080.
        package_path: Folder with mesh packages (package://NAME/... in a URDF); may be repeated.
            The folders in ROS_PACKAGE_PATH and AMENT_PREFIX_PATH are also searched.
        force: Show a recording even if its description of the arm (tool, mount, limits) differs.
    """
    if fleet:
        if what or live or robot or model or cell or package_path:
            raise ConfigError("Expected only --zenoh and --port with --fleet, got other options. Omit the others.")
        _watch_fleet(zenoh, port)
        return
    known = [armlab.models.load(path, "torque_model") for path in model or ()]
    if not live:
        for option, value in (("--cell", cell), ("--zenoh", zenoh)):
            if value:
                raise ConfigError(f"Expected {option} {value} together with --live, got logs. Omit one of them.")
        _play(what, robot or (), known, port, package_path, force, columns)
        return
    if cell and zenoh:
        raise ConfigError(
            "Expected either --cell for a bridge on this computer or --zenoh, "
            f"got both, {cell} and {zenoh}. Omit one of these options."
        )
    if len(what) > 1:
        raise ConfigError(f"Expected one arm with --live, got {', '.join(what)}. Omit the names to see all arms.")
    from armlab.live.live_bridge import watch

    arm, names = what[0] if what else None, robot or ()
    meshes = _mesh_folders(names, package_path)
    described = [load_robot(name) for name in names]
    options: dict[str, Any] = {"models": known, "described": described, "meshes": meshes, "port": port}
    watch(arm, cell=cell, zenoh=zenoh, **options, opened=_open, tell=note)


def _watch_fleet(url: str, port: int | None) -> None:
    from armlab.bridge.servers.zenoh.messages import EVERY
    from armlab.bridge.servers.zenoh.session import LabAddress
    from armlab.live.fleet_view import watch_fleet

    place = LabAddress.read(url or "zenoh://127.0.0.1")
    has_lab = urlsplit(url).path.strip("/") != ""
    watch_fleet(place if has_lab else place._replace(lab=EVERY), port=port, opened=_open, tell=note)


def _play(
    paths: Sequence[str],
    names: Sequence[str],
    models: Sequence[TorqueModel],
    port: int | None,
    packages: Sequence[Path] | None,
    force: bool,
    columns: str | None,
) -> None:
    if not paths:
        raise ConfigError("Expected at least one log to show, got none. Pass a file, or --live for a bridge.")
    note(f"reading {', '.join(paths)}")
    known = [load_robot(name) for name in names]
    arms = armlab.live.read_arms(paths, known, models, force=force, columns=columns)
    server = armlab.live.start(port, label=" ".join(Path(path).name for path in paths))
    try:
        player = armlab.live.Player(server, arms, meshes=_mesh_folders(names, packages))
        _open(armlab.live.address(server))
        player.run()
    finally:
        armlab.live.stop(server)


def _mesh_folders(robots: Sequence[str], packages: Sequence[Path] | None) -> list[Path]:
    """Return the search path for meshes: the given folders, then the folder of each robot file and its parents."""
    from armlab.robots.files import description

    for folder in packages or ():
        if not folder.is_dir():
            raise ConfigError(
                f"Expected --package-path with a folder, got {folder}. Pass the folder that contains the packages."
            )
    files = [path.resolve() for path in map(description, robots) if path is not None and path.is_file()]
    return [*(packages or ()), *(folder for file in files for folder in file.parents[:ABOVE]), Path()]


def _open(url: str) -> None:
    """Print the address, and flush it for programs that read it."""
    result(f"View: {url}")
    sys.stdout.flush()


@contextmanager
def beside(cell: str, robot: str | None = None) -> Iterator[str]:
    """Show a bridge in the browser during the block, from a separate process; yields the address.

    `robot`: arm as typed by the user; the meshes of this arm are added.
    """
    words = [sys.executable, "-m", "armlab", "view", "--live", "--cell", cell, *(mesh_option(robot) if robot else ())]
    with TemporaryFile("w+") as said:
        options: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": said}
        # in a separate session: Ctrl-C then reaches only the caller, which first brings the arm to rest
        process = subprocess.Popen(words, text=True, start_new_session=True, **options)
        try:
            yield _first_line(process, said)
        finally:
            process.terminate()
            try:
                process.communicate(timeout=_END)
            except subprocess.TimeoutExpired:
                process.kill()
                process.communicate()


def _first_line(process: subprocess.Popen[str], said: IO[str]) -> str:
    """Return the first line printed by a view, which appears once the page can be opened."""
    out = process.stdout
    came = out is not None and select.select([out], [], [], _START)[0]
    line = out.readline().strip() if out is not None and came else ""
    if not line:
        said.seek(0)
        why = said.read().strip().removeprefix("armlab: ")
        raise LinkError(
            why or f"Expected the view to start within {_START:g} s, but it did not. Run the command without --view."
        )
    return line
