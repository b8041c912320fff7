"""A real roscore, and rospy programs under the system's Python; the tests are skipped if these are not installed."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import pytest

from ....processes import free_port

PYTHON = "/usr/bin/python3"
PATIENCE = 60.0  # s; only a test that fails waits so long


def end(process: subprocess.Popen[bytes]) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGTERM)
    try:
        process.wait(10.0)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


class Ros:
    def __init__(self, folder: Path) -> None:
        self.port = free_port()
        self.uri = f"http://127.0.0.1:{self.port}"
        self.folder = folder
        kept = {name: value for name, value in os.environ.items() if name not in ("VIRTUAL_ENV", "PYTHONHOME")}
        self.environment = {**kept, "ROS_MASTER_URI": self.uri, "ROS_IP": "127.0.0.1", "ROS_HOME": str(folder)}
        self.processes: list[subprocess.Popen[bytes]] = []
        self.master = self.start()

    def start(self) -> subprocess.Popen[bytes]:
        master = self.run(["roscore", "-p", str(self.port)])
        until = time.monotonic() + PATIENCE
        while True:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", self.port), 1.0):
                return master
            assert time.monotonic() < until, "no roscore"
            assert master.poll() is None, "roscore ended"
            time.sleep(0.05)

    def run(self, command: list[str], output: int | IO[bytes] = subprocess.DEVNULL) -> subprocess.Popen[bytes]:
        process = subprocess.Popen(
            command, env=self.environment, stdout=output, stderr=subprocess.DEVNULL, start_new_session=True
        )
        self.processes.append(process)
        return process

    def program(self, text: str, *words: str) -> subprocess.Popen[bytes]:
        return self.run([PYTHON, "-c", text, *words], subprocess.PIPE)

    def close(self) -> None:
        for process in reversed(self.processes):
            end(process)
            if process.stdout is not None:
                process.stdout.close()


@pytest.fixture(scope="module")
def ros(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Ros]:
    if shutil.which("roscore") is None:
        pytest.skip("roscore is not installed (Debian: ros-core)")
    if subprocess.run([PYTHON, "-c", "import rospy, sensor_msgs.msg"], capture_output=True, check=False).returncode:
        pytest.skip(f"rospy or sensor_msgs is not installed for {PYTHON} (Debian: python3-rospy python3-sensor-msgs)")
    with contextlib.closing(Ros(tmp_path_factory.mktemp("ros"))) as made:
        yield made
