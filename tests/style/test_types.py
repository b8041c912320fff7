"""The types that a user's checker sees: pyright on the package as an installed library."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

SOURCES = Path(__file__).parents[2] / "src"
WANTED = 0.99


@pytest.mark.slow
def test_the_public_interface_is_typed() -> None:
    """Only generated code remains untyped: the EGM messages accept arbitrary mappings."""
    words = ["pyright", "--verifytypes", "armlab", "--ignoreexternal", "--outputjson", "--pythonpath", sys.executable]
    paths = os.pathsep.join([str(SOURCES), sysconfig.get_path("purelib")])
    environment = {**os.environ, "PYTHONPATH": paths}
    done = subprocess.run(
        [sys.executable, "-m", *words], env=environment, capture_output=True, text=True, check=False, timeout=300
    )
    found = json.loads(done.stdout)["typeCompleteness"]
    missing = [one["name"] for one in found["symbols"] if one["isExported"] and not one["isTypeKnown"]]
    assert found["completenessScore"] >= WANTED, missing
