"""The kernels on older processors: which results are bit-identical, and by how much the rest differ."""

from __future__ import annotations

import os
import runpy
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

SCRIPT = Path(__file__).with_name("results.py")
RESULTS = runpy.run_path(str(SCRIPT))
TABLES = RESULTS["tables"]()
SAMPLES = TABLES | {f"many {key}": table for key, table in RESULTS["many"]().items()}
PLAIN_C = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-AVX512F,-FMA,-FMA4"}  # exp, sin ... without fused multiply-add
EMULATOR = shutil.which("qemu-x86_64") or shutil.which("qemu-x86_64-static")
OF_THE_C_LIBRARY = 4.0  # roundings; 2 were found: its functions differ in the last digit in one of a thousand calls
PROCESSORS = {"SSE": "Nehalem", "AVX2": "Haswell"}

pytestmark = [
    pytest.mark.slow,  # 1 to 10 s each: a program, emulated or not
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc chooses its functions by the processor"),
]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., dict[str, np.ndarray]]:
    """Return a function that runs `results.py` in a separate process and returns its results by name."""
    folder, known = tmp_path_factory.mktemp("results"), {}

    def results(processor: str | None = None, **environment: str) -> dict[str, np.ndarray]:
        key = (processor, *sorted(environment.items()))
        if key not in known:
            path = folder / f"{len(known)}.npz"
            emulator = [] if processor is None else [str(EMULATOR), "-cpu", processor]
            alone = [*emulator, sys.executable, "-c", "import numpy"]
            if emulator and subprocess.run(alone, timeout=300, check=False, capture_output=True).returncode:
                pytest.skip(f"NumPy itself does not start on {processor} as {EMULATOR} emulates it")
            command = [*emulator, sys.executable, "-W", "ignore", str(SCRIPT), str(path)]
            done = subprocess.run(command, timeout=300, env=os.environ | environment, capture_output=True, text=True)
            assert done.returncode == 0, done.stderr
            with np.load(path) as arrays:
                known[key] = {name.replace(":", "/"): arrays[name] for name in arrays.files}
        return known[key]

    return results


Run = Callable[..., dict[str, np.ndarray]]


def differing(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> set[str]:
    assert one.keys() == other.keys() == SAMPLES.keys()
    return {key for key in one if one[key].tobytes() != other[key].tobytes()}


@pytest.mark.skipif(EMULATOR is None, reason="qemu-user is not installed")
@pytest.mark.parametrize("level", PROCESSORS)
def test_same_bits_on_an_emulated_processor(level: str, run: Run) -> None:
    """With the same C library functions, only the compiled kernel code differs."""
    assert differing(run(**PLAIN_C), run(processor=PROCESSORS[level], **PLAIN_C)) == set()


def test_the_c_library_without_fused_multiply_add(run: Run) -> None:
    """Its exp, sin, tanh ... then round differently. Rotations, rigid motions and joint chains are not affected."""
    plain, here = run(**PLAIN_C), run()
    for key in differing(plain, here):
        topic = key.removeprefix("many ").partition("/")[0]
        assert topic not in ("chains", "groups", "limits")
        most = OF_THE_C_LIBRARY if topic == "filters" else RESULTS["bound"](key)  # the others amplify it
        assert RESULTS["error"](SAMPLES[key] | {"wanted": here[key]}, plain[key]) <= most
    for key, table in TABLES.items():
        assert RESULTS["error"](table, plain[key]) <= RESULTS["bound"](key), key


def test_same_bits_with_any_number_of_threads(run: Run) -> None:
    one, four = (run(OMP_NUM_THREADS=count, OPENBLAS_NUM_THREADS=count) for count in ("1", "4"))
    assert differing(one, four) == set()
