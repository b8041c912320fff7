"""What a process holds, by the kernel's own account."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[2]))

from armlab.errors import ArmlabError
from soak.processes import HEAD, Watch, family, held, label


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
    words = [sys.executable, "-c", "print(flush=True); input()", "-m", "armlab.bridge.servers.serve", "zenoh"]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        try:
            assert child.stdout is not None
            child.stdout.readline()  # before, the kernel may not have its words yet
            assert child.pid in family(os.getpid())
            assert label(child.pid, os.getpid()) == "server zenoh"
        finally:
            child.communicate(b"\n")
    assert child.pid not in family(os.getpid())
    with pytest.raises(OSError, match=r"No such"):
        held(child.pid)


def test_the_last_look_is_at_the_end(tmp_path: Path) -> None:
    with Watch(tmp_path / "held.csv", 1e3, lambda: iter([(os.getpid(), "me")])) as watch:
        while not (tmp_path / "held.csv").exists() or "me" not in (tmp_path / "held.csv").read_text():
            watch.pause(0.01)
    head, *looks = (tmp_path / "held.csv").read_text().splitlines()
    assert head == HEAD
    assert [look.split(",")[1] for look in looks] == ["me", "me"], "at the begin, and when it was over"


def test_who_waits_is_told_that_nobody_looks_any_more(tmp_path: Path) -> None:
    """Fails when the thread only ends: the run would go on without it, and be judged by what it saw."""

    def processes() -> Iterator[tuple[int, str]]:
        yield os.getpid(), "me"
        raise OSError(28, "No space left on device")

    for seconds in (10.0, 0.0):  # who waits, and who comes to the end of the run
        watch = Watch(tmp_path / "held.csv", 1e-3, processes)
        with pytest.raises(ArmlabError, match=r"until the end, got OSError\(28, 'No space"), watch:
            watch.pause(seconds)
