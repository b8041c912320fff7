"""Every kernel in the tables, compiled and in NumPy, against results computed with 50 digits and more."""

from __future__ import annotations

import runpy
import subprocess
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

HERE = Path(__file__).parent
RESULTS = runpy.run_path(str(HERE / "results.py"))
TABLES: dict[str, dict[str, Any]] = RESULTS["tables"]()
MODULES = [name for name in ("_native", "_reference") if find_spec(f"armlab.kernels.{name}")]


@pytest.mark.parametrize("name", MODULES)
@pytest.mark.parametrize("key", TABLES)
def test_errors_stay_within_their_bounds(key: str, name: str) -> None:
    module = import_module(f"armlab.kernels.{name}")
    found = RESULTS["result"](module, key, TABLES[key])
    assert RESULTS["error"](TABLES[key], found) <= RESULTS["bound"](key)


@pytest.mark.parametrize("key", ["groups/so3_log", "chains/rnea 5", "filters/SignalOperator lowpass"])
def test_an_error_in_the_thirteenth_digit_shows(key: str) -> None:
    wanted = TABLES[key]["wanted"]
    assert RESULTS["error"](TABLES[key], wanted) == 0.0
    assert RESULTS["error"](TABLES[key], wanted * (1.0 + 1e-13)) > RESULTS["bound"](key)
    assert not RESULTS["error"](TABLES[key], wanted * float("nan")) <= RESULTS["bound"](key)


@pytest.mark.parametrize("name", MODULES)
@pytest.mark.parametrize("key", [key for key in TABLES if "wrench_interval" in key])
def test_an_interval_holds_the_exact_one(key: str, name: str) -> None:
    """What settles ties may only widen the compiled one; the other is as HiGHS rounds it."""
    found = RESULTS["result"](import_module(f"armlab.kernels.{name}"), key, TABLES[key])
    inside = (found - TABLES[key]["wanted"]) * [1.0, -1.0]
    assert inside.max() <= (0.0 if name == "_native" else 1e-12)


@pytest.mark.slow  # 5 to 15 s: arithmetic of 80 digits in Python
def test_tables_are_what_makes_them_says(tmp_path: Path) -> None:
    """Of the smallest; the others take a minute."""
    subprocess.run([sys.executable, str(HERE / "exact" / "make.py"), str(tmp_path), "filters"], check=True)
    assert (tmp_path / "filters.json").read_text() == (HERE / "tables" / "filters.json").read_text()
