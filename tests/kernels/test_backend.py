"""The facade: which backend is in use, and the NumPy reference on request."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from armlab import kernels
from armlab.kernels import _reference

PROGRAM = """
import warnings
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    from armlab import kernels
print(kernels.backend, kernels.Chain.__module__, [str(w.message) for w in caught if w.category is RuntimeWarning])
"""


def run(program: str, backend: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"ARMLAB_KERNELS": backend}
    return subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=False)


def test_reference_on_request_warns() -> None:
    result = run(PROGRAM, "reference")
    assert result.stdout.startswith("reference armlab.kernels._reference.chain ['armlab runs its NumPy reference")
    assert "ARMLAB_KERNELS=reference" in result.stdout


def test_reference_when_the_extension_is_missing() -> None:
    """A missing extension is survived with a warning, unless it was asked for."""
    hide = "import sys; sys.modules['armlab.kernels._native'] = None\n"
    assert "the extension cannot be imported" in run(hide + PROGRAM, "").stdout
    refused = run(hide + PROGRAM, "native").stderr
    assert "Expected the compiled kernels, as ARMLAB_KERNELS=native asks, got none: " in refused
    assert "import of armlab.kernels._native halted" in refused


def test_reference_when_the_extension_is_older_than_the_sources() -> None:
    """Sources that were updated without building: the extension lacks what the facade wants."""
    old = "import sys, types; sys.modules['armlab.kernels._native'] = types.ModuleType('old')\n"
    result = run(old + PROGRAM, "")
    assert result.stdout.startswith("reference ")
    assert "the extension is older than the sources; build it again, `make -B setup`" in result.stdout
    assert "older than the sources" in run(old + PROGRAM, "native").stderr


def test_unknown_backend() -> None:
    assert "Expected ARMLAB_KERNELS to be native or reference, got 'fortran'" in run(PROGRAM, "fortran").stderr


def test_backend_names_the_module_in_use() -> None:
    assert kernels.backend in ("native", "reference")
    assert (kernels.Chain is _reference.Chain) == (kernels.backend == "reference")


@pytest.mark.skipif(kernels.backend == "reference", reason="needs the extension")
def test_both_backends_offer_the_same() -> None:
    from armlab.kernels import _native

    for name in _reference.__all__:
        ours, theirs = getattr(_native, name), getattr(_reference, name)
        missing = {part for part in dir(theirs) if not part.startswith("_")} - set(dir(ours))
        assert not missing or not isinstance(theirs, type), f"{name}: {missing}"
