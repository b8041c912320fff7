"""Small files that claim to be huge are refused within seconds, before memory is allocated; measured in a process."""

from __future__ import annotations

import gzip
import struct
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

SECONDS, MEGABYTES = 5.0, 300.0
CHILD = """
import os, re, sys, time
from pathlib import Path
from armlab import log, robots
from armlab.errors import ArmlabError
for path in sys.argv[1:]:
    if os.fork():  # a process for each: what counts is its peak
        os.wait()
        continue
    read = robots.load if path.endswith((".toml", ".urdf")) else log.read
    start, told = time.process_time(), "read"
    try:
        read(path)
    except ArmlabError as error:
        told = str(error)
    peak = re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())
    print(time.process_time() - start, int(peak[1]) / 1024, told.replace("\\n", " "), flush=True)
    os._exit(0)
"""


def zstd_of_zeros(path: Path) -> None:
    """65 kB of repeated bytes in one chunk of 2 GiB."""
    size = (1 << 31) - (1 << 17)
    blocks = [struct.pack("<I", (1 << 17) << 3 | 1 << 1)[:3] + b"\0"] * (size >> 17)
    blocks[-1] = struct.pack("<I", (1 << 17) << 3 | 1 << 1 | 1)[:3] + b"\0"
    packed = b"\x28\xb5\x2f\xfd\xc0\x38" + struct.pack("<Q", size) + b"".join(blocks)
    chunk = (
        struct.pack("<QQQI", 0, 1, size, 0) + struct.pack("<I", 4) + b"zstd" + struct.pack("<Q", len(packed)) + packed
    )
    parts = [(1, struct.pack("<II", 0, 0)), (6, chunk), (15, bytes(4)), (2, bytes(20))]
    records = b"".join(struct.pack("<BQ", kind, len(body)) + body for kind, body in parts)
    path.write_bytes(b"\x89MCAP0\r\n" + records + b"\x89MCAP0\r\n")


def zstd_in_many_chunks(path: Path) -> None:
    """Chunks that are within the limit one by one, but not in total."""
    import zstandard

    packed = zstandard.compress(bytes(1 << 23))
    chunk = (
        struct.pack("<QQQI", 0, 1, 1 << 23, 0)
        + struct.pack("<I", 4)
        + b"zstd"
        + struct.pack("<Q", len(packed))
        + packed
    )
    record = struct.pack("<BQ", 6, len(chunk)) + chunk
    head = struct.pack("<BQ", 1, 8) + bytes(8)
    path.write_bytes(b"\x89MCAP0\r\n" + head + record * 200)


def gzip_of_rows(path: Path) -> None:
    """1.9 MB that unpack to 1.9 GB of short rows."""
    path.write_bytes(gzip.compress(b"t,q1\n") + gzip.compress(b"0,0\n" * (1 << 22), 9) * 115)


def gzip_with_a_word(path: Path) -> None:
    """Numbers, but a word in the last line, so that the column is read again as text."""
    path.write_bytes(gzip.compress(b"t,x\n" + b"1,1\n" * 260_000 + b"1,a\n", 9))


def toml_of_dotted_keys(path: Path) -> None:
    path.write_text(".".join("a" * 50_000) + " = 1")


def toml_of_joints(path: Path) -> None:
    rows = ", ".join(["[0, 0, 0, 0]"] * 20_000)
    path.write_text(f'[robot]\nname = "r"\n[kinematics]\nconvention = "dh_standard"\nrows = [{rows}]\n')


def urdf_of_joints(path: Path) -> None:
    links = [f'<link name="l{i}"/>' for i in range(20_001)]
    joints = [
        f'<joint name="j{i}" type="continuous"><parent link="l{i}"/><child link="l{i + 1}"/></joint>'
        for i in range(20_000)
    ]
    path.write_text("\n".join(['<robot name="r">', *links, *joints, "</robot>"]))


def urdf_of_elements(path: Path) -> None:
    path.write_text('<robot name="r">' + "<a/>" * 4_000_000 + "</robot>")


def mat_of_zeros(path: Path) -> None:
    savemat(path, {"t": np.zeros(1 << 25)}, do_compression=True)


def hdf5_without_data(path: Path) -> None:
    h5py = pytest.importorskip("h5py", reason="needs h5py")
    with h5py.File(path, "w") as file:
        for name, shape in (("t", (1 << 27,)), ("q", (1 << 27, 7))):
            file.create_dataset(name, shape=shape, dtype="f8", chunks=(1 << 20, *shape[1:]), compression="gzip")


def parquet_of_zeros(path: Path) -> None:
    pa = pytest.importorskip("pyarrow", reason="needs pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    zeros = pa.array(np.zeros(1 << 22))
    parquet.write_table(pa.table(dict.fromkeys([f"x{i}" for i in range(8)], zeros)), path, compression="zstd")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads the peak of memory from /proc")
def test_bombs_are_refused_soon(tmp_path: Path) -> None:
    bombs: list[tuple[Callable[[Path], None], str, str]] = [
        (zstd_of_zeros, ".mcap", "Expected an armlab recording"),
        (zstd_in_many_chunks, ".mcap", "chunks that unpack to at most"),
        (gzip_of_rows, ".csv.gz", "got more. If you trust the file, unpack it"),
        (gzip_with_a_word, ".csv.gz", "read"),
        (toml_of_dotted_keys, ".toml", "a dotted key of more than 16 names"),
        (toml_of_joints, ".toml", "a robot file"),
        (urdf_of_joints, ".urdf", "at most"),
        (urdf_of_elements, ".urdf", "at most 100000 elements"),
        (hdf5_without_data, ".h5", "arrays of at most"),
        (parquet_of_zeros, ".parquet", "arrays of at most"),
        (mat_of_zeros, ".mat", "variables of at most 67108864 bytes"),
    ]
    paths = [tmp_path / f"{make.__name__}{ending}" for make, ending, _ in bombs]
    for (make, *_), path in zip(bombs, paths, strict=True):
        make(path)
    command = [sys.executable, "-W", "ignore", "-c", CHILD, *map(str, paths)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    for (make, _, words), line in zip(bombs, done.stdout.splitlines(), strict=True):
        seconds, megabytes, told = line.split(" ", 2)
        assert words in told, make.__name__
        assert float(seconds) < SECONDS, make.__name__
        assert float(megabytes) < MEGABYTES, make.__name__
