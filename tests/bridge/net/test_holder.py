"""Who has a port: named by its process, for UDP and for TCP."""

from __future__ import annotations

import os
import socket
import subprocess
import sys

import pytest

from armlab.bridge.net.sockets import holder, program


@pytest.mark.parametrize("kind", ["udp", "tcp"])
def test_a_port_in_use_names_its_holder(kind: str) -> None:
    code = (
        "import socket, sys\n"
        f"s = socket.socket(socket.AF_INET, socket.SOCK_{'DGRAM' if kind == 'udp' else 'STREAM'})\n"
        "s.bind(('127.0.0.1', 0))\n"
        f"{'s.listen()' if kind == 'tcp' else ''}\n"
        "print(s.getsockname()[1], flush=True); sys.stdin.read()"
    )
    command = [sys.executable, "-S", "-c", code]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        number = int(other.stdout.readline())
        assert holder(number, kind).startswith(f"process {other.pid} (")  # type: ignore[arg-type]
        assert holder(number, "tcp" if kind == "udp" else "udp") == ""


def test_nobody_holds_a_free_port() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        number = free.getsockname()[1]
    assert holder(number) == ""


def test_a_connection_is_no_listener() -> None:
    """Nor is a client whose own end has that number."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        with socket.create_connection(server.getsockname()) as client:
            assert holder(client.getsockname()[1], "tcp") == ""
        assert str(os.getpid()) in holder(server.getsockname()[1], "tcp")


def test_a_process_that_is_gone() -> None:
    assert program(os.getpid()).startswith(f"process {os.getpid()} (")
    assert program(2**22 + 1) == f"process {2**22 + 1}"
