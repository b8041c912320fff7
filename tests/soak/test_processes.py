"""What a process holds, by the kernel's own account."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[2]))

from soak.processes import family, held, label


def test_memory_and_descriptors_of_a_process_are_counted(tmp_path: Path) -> None:
    """Fails when pages of files count, or when only what is resident at the start does."""
    memory, descriptors, threads, cpu = held(os.getpid())
    files = [(tmp_path / f"{k}").open("w") for k in range(5)]
    try:
        more = bytearray(os.urandom(1)) * 2**25
        after = held(os.getpid())
    finally:
        for file in files:
            file.close()
    assert abs(after[0] - memory - len(more)) < 2**21
    assert after[1] == descriptors + 5
    assert after[2] == threads >= 1
    assert after[3] >= cpu > 0.0
    assert next(family(os.getpid())) == os.getpid()
    assert label(os.getpid(), os.getpid()) == "loop and recorder"


def test_what_a_process_started_belongs_to_it_until_it_ends() -> None:
    words = [sys.executable, "-c", "input()", "-m", "armlab.bridge._serve", "zenoh"]
    with subprocess.Popen(words, stdin=subprocess.PIPE) as child:
        try:
            assert child.pid in family(os.getpid())
            assert label(child.pid, os.getpid()) == "server zenoh"
        finally:
            child.communicate(b"\n")
    assert child.pid not in family(os.getpid())
    with pytest.raises(OSError, match=r"No such"):
        held(child.pid)
