"""The relay by itself: it ends by a sentence where it cannot begin. With a master: see test_process."""

from __future__ import annotations

import ast
import socket
import subprocess
import sys
from pathlib import Path

from armlab.bridge.ros1 import relay


def test_main_without_rospy_ends_with_a_sentence() -> None:
    """Under this Python, which has no rospy; `main` is run as the program it is."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with ours, theirs:
        command = [sys.executable, "-I", relay.__file__]
        done = subprocess.run(command, stdin=theirs.fileno(), capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "Install python3-rospy." in done.stderr
    assert relay.main.__doc__


def test_it_needs_the_standard_library_only_and_an_old_python() -> None:
    tree = ast.parse(Path(relay.__file__).read_text(encoding="utf-8"), feature_version=(3, 6))
    names = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    names |= {str(node.module) for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
    assert names <= sys.stdlib_module_names
