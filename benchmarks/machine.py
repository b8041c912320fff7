"""Description of the machine, its limits, and the load from other processes."""

from __future__ import annotations

import contextlib
import ctypes
import os
import platform
import subprocess
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from time import process_time

import numpy as np

PACKAGES = ("armlab", "numpy", "scipy", "protobuf", "rosbags")


def describe(packages: Sequence[str] = ()) -> list[str]:
    """Return sentences on the machine, the versions and the commit.

    `packages` : names of packages to list with their versions; default: armlab, its dependencies and its peers.
    """
    peers = [line.split("==")[0] for file in sorted(Path(__file__).parent.glob("requirements*.txt"))
             for line in file.read_text(encoding="utf-8").splitlines() if "==" in line]  # fmt: skip
    versions = ", ".join(f"{name} {version(name)}" for name in packages or (*PACKAGES, *peers) if _is_here(name))
    return [
        f"{_cpu()}, {os.cpu_count()} cores, {_memory():.0f} GiB, {platform.system()} {platform.release()}, "
        f"Python {platform.python_version()}.",
        f"{versions}.",
        f"Commit {_commit()}. All contenders use one thread.",
    ]


def writer(size: int, fresh: bool) -> Callable[[], None]:
    """Return a function that writes `size` bytes once as fast as the machine allows.

    `fresh` selects newly allocated memory, for which the kernel must first provide pages; otherwise memory is reused.
    """
    if fresh:
        return lambda: np.empty(size // 8).fill(1.0)
    memory = np.ones(size // 8)

    def write() -> None:
        ctypes.memset(memory.ctypes.data, 1, memory.nbytes)

    return write


def arithmetic(n: int = 512) -> Callable[[], float]:
    """Return a function that measures the shortest time [s] of one addition or multiplication on one core.

    It uses a product of n × n matrices in cache, because no other numeric operation is faster.
    """
    a = np.ones((n, n))
    out = np.empty_like(a)

    def seconds() -> float:
        start = process_time()
        np.matmul(a, a, out=out)
        return (process_time() - start) / (2 * n**3)

    return seconds


def family(pid: int) -> Iterator[int]:
    """Yield a process and all its descendants."""
    yield pid
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                yield from family(int(child))


class OtherLoad:
    """Cores used by other processes and the hypervisor during a block: ``with OtherLoad() as load: ...``."""

    def __enter__(self) -> OtherLoad:
        self._start = _clocks()
        return self

    def __exit__(self, *_: object) -> None:
        busy, own, wall = (now - then for now, then in zip(_clocks(), self._start, strict=True))
        self.cores = max(0.0, (busy - own) / wall)


def stolen() -> float:
    """Return the processor time [s] since boot that the hypervisor gave to others, summed over the cores."""
    return _ticks()[7]


def _clocks() -> tuple[float, float, float]:
    """Return the busy time [s] of all cores since boot, of this process with its children, and the wall-clock time."""
    user, nice, system, _idle, _iowait, irq, softirq, steal = _ticks()
    own = os.times()
    return user + nice + system + irq + softirq + steal, sum(own[:4]), own.elapsed


def _ticks() -> list[float]:
    """Return the first eight times [s] of all cores since boot, in the order of /proc/stat."""
    words = Path("/proc/stat").read_text().splitlines()[0].split()[1:9]
    return [int(word) / os.sysconf("SC_CLK_TCK") for word in words]


def _is_here(package: str) -> bool:
    try:
        return bool(version(package))
    except PackageNotFoundError:  # an optional, heavy package
        return False


def _cpu() -> str:
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    family = [line.split(":", 1)[1].strip() for line in lines if line.startswith(("cpu family", "model\t"))]
    return f"{names[0]} (family {family[0]}, model {family[1]})" if names else platform.machine()


def _memory() -> float:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30


def _commit() -> str:
    here = Path(__file__).parent
    command = ["git", "describe", "--always", "--dirty"]
    return subprocess.run(command, cwd=here, capture_output=True, text=True, check=False).stdout.strip() or "unknown"
