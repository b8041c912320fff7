"""The ways by which a ROS program reads joint states and wrenches: a function each, which others are added beside.

A client takes a number of joint states and then prints a line for each message: "J" for joint states or "W" for
wrenches, the stamp in the message, and when it was received [ns, wall clock].
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

PEERS = Path(__file__).resolve().parents[1] / "tests" / "bridge" / "ros" / "peers"


class Way(NamedTuple):
    """How to serve and how to listen.

    Attributes
    ----------
    server, options : see `servers.server_command`. client : command for a number of joint states.
    environment : of the client, besides ours.
    """

    server: str
    options: Mapping[str, Any]
    client: Callable[[int], Sequence[str]]
    environment: Mapping[str, str]


def dds_python(folder: Path) -> Way | None:
    """cyclonedds in Python, with its own codec."""
    return _dds([sys.executable, str(PEERS / "cyclone.py")])


def dds_cyclone(folder: Path) -> Way | None:
    """Cyclone DDS in C; None where its tools are missing."""
    return _dds(_built("cyclone", folder)) if shutil.which("idlc") else None


def dds_fast(folder: Path) -> Way | None:
    """Fast DDS in C++; None where its tools are missing."""
    return _dds(_built("fast", folder)) if shutil.which("fastddsgen") else None


WAYS: dict[str, Callable[[Path], Way | None]] = {
    "DDS to Python, cyclonedds": dds_python,
    "DDS to C, Cyclone DDS": dds_cyclone,
    "DDS to C++, Fast DDS": dds_fast,
}


def _built(name: str, folder: Path) -> list[str]:
    command = ["make", "-f", str(PEERS / "Makefile"), name]
    subprocess.run(command, cwd=folder, env={"PATH": "/usr/bin:/bin"}, check=True, stdout=subprocess.DEVNULL)
    return [str(folder / name)]


def _dds(words: Sequence[str]) -> Way:
    from armlab.bridge.ros.dds_domain import configuration

    domain = 1 + os.getpid() % 100
    options = {"domain": domain, "host": "127.0.0.1"}
    settings = {"CYCLONEDDS_URI": configuration("127.0.0.1")}
    return Way("ros2", options, lambda count: [*words, str(domain), str(count), "0", "0"], settings)
