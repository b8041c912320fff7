"""Paths by which programs read the data of a bridge server, with one function per path.

A reader receives a number of joint states and then prints a line for each message; see `path_ends`.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from path_ends import ROBOT
from path_zenoh import Key

from armlab import robots
from armlab.bridge.cell import parse_cell
from armlab.bridge.servers.ros.topics import store
from armlab.bridge.servers.row import MAGIC, RowSchema

HERE = Path(__file__).resolve().parent
PEERS = HERE.parent / "tests" / "bridge" / "servers" / "ros" / "peers"
SYSTEM = "/usr/bin/python3"
PATIENCE = 30.0  # s


class Way(NamedTuple):
    """Server settings and reader command.

    Attributes
    ----------
    server, table : name of the server, and the lines of its table in a cell file.
    reader : command for a number of joint states. environment : extra variables of reader and writer.
    writer : command of a bare publisher of the same messages, or None.
    kinds : "J" joint states, "W" wrenches; a complete row is "J".
    """

    server: str
    table: str
    reader: Callable[[int], Sequence[str]]
    environment: Mapping[str, str]
    writer: Sequence[str] | None = None
    kinds: str = "JW"

    def options(self) -> dict[str, Any]:
        """Return the settings of the server."""
        text = f'[[robots]]\nname = "{ROBOT}"\nlink = "sim://{ROBOT}"\n'
        if self.server == "local":
            return {"path": self.table}
        servers = parse_cell(f"{text}[servers.{self.server}]\n{self.table}\n").servers
        return {**servers[self.server], "host": "127.0.0.1"}


def dds_python(opened: ExitStack) -> Way | None:
    """cyclonedds in Python with its own codec."""
    domain = str(_domain())
    return _dds(lambda count: [sys.executable, str(HERE / "path_dds.py"), "read", domain, str(count)])


def dds_cyclone(opened: ExitStack) -> Way | None:
    """Cyclone DDS in C; None if its tools are missing."""
    return _dds(_node(_built("cyclone", opened))) if shutil.which("idlc") else None


def dds_fast(opened: ExitStack) -> Way | None:
    """Fast DDS in C++; None if its tools are missing."""
    return _dds(_node(_built("fast", opened))) if shutil.which("fastddsgen") else None


def rmw_zenoh(opened: ExitStack) -> Way | None:
    """Peer that receives the messages of an rmw_zenoh node, but decodes only their stamps."""
    from armlab.bridge.servers.ros.rmw_zenoh import Names

    names, keys = Names(0, "1"), []
    for kind, topic, type_ in (
        ("J", "joint_states", "sensor_msgs/msg/JointState"),
        ("W", "wrench", "geometry_msgs/msg/WrenchStamped"),
    ):
        name = names.data(f"/{ROBOT}/{topic}", type_)
        keys.append(Key(name, kind, 4, True, bytes(store().serialize_cdr(_message(type_), type_)).hex()))
    return _zenoh("rmw_zenoh", "domain = 0", keys)


def zenoh(opened: ExitStack) -> Way | None:
    """Plain peer that reads the rows sent to controllers."""
    size = RowSchema.of([robots.load(ROBOT)]).size
    return _zenoh("zenoh", "", [Key(f"armlab/lab/{ROBOT}/live", "J", 32, False, MAGIC.hex() + "00" * (size - 4))])


def zenoh_feed(opened: ExitStack) -> Way | None:
    """`ZenohFeed`."""
    port = _free_port()
    return Way("zenoh", f"port = {port}", _program("path_feed.py", "zenoh", f"zenoh://127.0.0.1:{port}"), {}, kinds="J")


def rosbridge(opened: ExitStack) -> Way | None:
    """Client that uses only websockets."""
    port = _free_port()
    return Way(
        "rosbridge", f"port = {port}", _program("path_rosbridge.py", "read", port), {}, _writer("rosbridge", port)
    )


def roslibpy(opened: ExitStack) -> Way | None:
    """roslibpy; None if it is missing."""
    port = _free_port()
    if find_spec("roslibpy") is None:
        return None
    return Way("rosbridge", f"port = {port}", _program("path_roslibpy.py", port), {}, _writer("rosbridge", port))


def ros1(opened: ExitStack) -> Way | None:
    """A real ROS 1 master and rospy; None if they are missing."""
    look = [SYSTEM, "-c", "import rospy, sensor_msgs.msg, geometry_msgs.msg"]
    if shutil.which("roscore") is None or subprocess.run(look, capture_output=True, check=False).returncode:
        return None
    folder, port = opened.enter_context(tempfile.TemporaryDirectory(ignore_cleanup_errors=True)), _free_port()
    master = f"http://127.0.0.1:{port}"
    environment = {"ROS_MASTER_URI": master, "ROS_IP": "127.0.0.1", "ROS_HOME": folder}
    _roscore(opened, port, environment)
    words = [SYSTEM, str(HERE / "path_ros1.py")]
    return Way(
        "ros1", f'master = "{master}"', lambda count: [*words, "read", str(count)], environment, [*words, "write"]
    )


def plotjuggler(opened: ExitStack) -> Way | None:
    """Datagram receiver."""
    port = _free_port(socket.SOCK_DGRAM)
    reader, writer = _program("path_plotjuggler.py", "read", port), _writer("plotjuggler", port)
    return Way("plotjuggler", f"port = {port}", reader, {}, writer, "J")


def labcomm(opened: ExitStack) -> Way | None:
    """`LabCommClient` on the port of fused rows."""
    port = _free_port()
    table = f"ports = {{{ROBOT} = 0}}\nparameters = 0\nrows = {port}"
    return Way("labcomm", table, _program("path_feed.py", "labcomm", port), {}, kinds="J")


def local(opened: ExitStack) -> Way | None:
    """`LocalFeed`, a Unix socket; its table contains the path of the socket."""
    folder = opened.enter_context(tempfile.TemporaryDirectory())
    path = Path(folder) / "armlab" / "cell.sock"
    path.parent.mkdir(mode=0o700)
    return Way("local", str(path), _program("path_feed.py", "local", "cell"), {"XDG_RUNTIME_DIR": folder}, kinds="J")


Make = Callable[[ExitStack], Way | None]
WAYS: dict[str, Make] = {
    "ros2, DDS to Python, cyclonedds": dds_python,
    "ros2, DDS to C, Cyclone DDS": dds_cyclone,
    "ros2, DDS to C++, Fast DDS": dds_fast,
    "rmw_zenoh to a plain Zenoh peer": rmw_zenoh,
    "rosbridge to websockets": rosbridge,
    "rosbridge to roslibpy": roslibpy,
    "ros1 to rospy": ros1,
    "zenoh to a plain Zenoh peer": zenoh,
    "zenoh to ZenohFeed": zenoh_feed,
    "plotjuggler to a UDP socket": plotjuggler,
    "labcomm to LabCommClient": labcomm,
    "local to LocalFeed": local,
}

ONE_EACH = tuple(name for name in WAYS if not name.endswith((" Cyclone DDS", " Fast DDS", "roslibpy", "ZenohFeed")))
"""One path per server."""


def _program(name: str, *words: Any) -> Callable[[int], list[str]]:
    return lambda count: [sys.executable, str(HERE / name), *map(str, words), str(count)]


def _writer(name: str, port: int) -> list[str]:
    return [sys.executable, str(HERE / f"path_{name}.py"), "write", str(port)]


def _built(name: str, opened: ExitStack) -> str:
    folder = Path(opened.enter_context(tempfile.TemporaryDirectory()))
    command = ["make", "-f", str(PEERS / "Makefile"), name]
    subprocess.run(command, cwd=folder, env={"PATH": "/usr/bin:/bin"}, check=True, stdout=subprocess.DEVNULL)
    return str(folder / name)


def _domain() -> int:
    return 1 + os.getpid() % 100


def _node(program: str) -> Callable[[int], list[str]]:
    return lambda count: [program, str(_domain()), str(count), "0", "0"]


def _dds(reader: Callable[[int], list[str]]) -> Way:
    settings = {"CYCLONEDDS_URI": f"file://{PEERS}/loopback.xml"}
    writer = [sys.executable, str(HERE / "path_dds.py"), "write", str(_domain())]
    return Way("ros2", f"domain = {_domain()}", reader, settings, writer)


def _zenoh(server: str, table: str, keys: Sequence[Key]) -> Way:
    port, words = _free_port(), [json.dumps(key) for key in keys]
    program = [sys.executable, str(HERE / "path_zenoh.py")]
    return Way(
        server,
        f"port = {port}\n{table}",
        lambda count: [*program, "read", str(port), str(count), *words],
        {},
        [*program, "write", str(port), *words],
        "".join(key.kind for key in keys),
    )


def _message(type_: str) -> Any:
    """Return a message of the same length as the server's messages."""
    types = store().types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](0, 0), "")
    if type_.endswith("JointState"):
        values = [np.arange(7.0) for _ in range(3)]
        return types[type_](header, [f"yumi_robl_joint_{k}" for k in range(1, 8)], *values)
    vector = types["geometry_msgs/msg/Vector3"](0.0, 1.0, 2.0)
    return types[type_](header, types["geometry_msgs/msg/Wrench"](vector, vector))


def _roscore(opened: ExitStack, port: int, environment: Mapping[str, str]) -> None:
    """Start a master, and wait until it responds; at the end, stop it and all its descendants."""
    master = subprocess.Popen(
        ["roscore", "-p", str(port)],
        env={**os.environ, **environment},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )

    def end() -> None:
        for sign in (signal.SIGTERM, signal.SIGKILL):  # a master that has just started may miss the first request
            with contextlib.suppress(ProcessLookupError):
                os.killpg(master.pid, sign)
            with contextlib.suppress(subprocess.TimeoutExpired):
                master.wait(10.0)
                return

    opened.callback(end)
    until = time.monotonic() + PATIENCE
    while True:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 1.0):
            return
        if time.monotonic() > until or master.poll() is not None:
            raise RuntimeError("Expected roscore to respond, but it does not.")
        time.sleep(0.05)


def _free_port(kind: int = socket.SOCK_STREAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
