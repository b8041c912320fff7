"""Every kernel in the tables against results computed with 50 digits and more."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import kernels

HERE = Path(__file__).parent
RESULTS = runpy.run_path(str(HERE / "results.py"))
TABLES: dict[str, dict[str, Any]] = RESULTS["tables"]()


@pytest.mark.parametrize("key", TABLES)
def test_errors_stay_within_their_bounds(key: str) -> None:
    found = RESULTS["result"](kernels, key, TABLES[key])
    assert RESULTS["error"](TABLES[key], found) <= RESULTS["bound"](key)


@pytest.mark.parametrize("key", ["groups/so3_log", "chains/rnea 5", "filters/SignalOperator lowpass"])
def test_an_error_in_the_thirteenth_digit_shows(key: str) -> None:
    wanted = TABLES[key]["wanted"]
    assert RESULTS["error"](TABLES[key], wanted) == 0.0
    assert RESULTS["error"](TABLES[key], wanted * (1.0 + 1e-13)) > RESULTS["bound"](key)
    assert not RESULTS["error"](TABLES[key], wanted * float("nan")) <= RESULTS["bound"](key)


@pytest.mark.parametrize("key", [key for key in TABLES if "wrench_interval" in key])
def test_an_interval_holds_the_exact_one(key: str) -> None:
    """What settles ties may only widen it."""
    found = RESULTS["result"](kernels, key, TABLES[key])
    inside = (found - TABLES[key]["wanted"]) * [1.0, -1.0]
    assert inside.max() <= 0.0


@pytest.mark.slow  # 1 to 4 s each: arithmetic of 80 digits in Python
@pytest.mark.parametrize("topic", sorted({key.partition("/")[0] for key in TABLES}))
def test_tables_are_what_makes_them_says(topic: str, tmp_path: Path) -> None:
    """All inputs, and a few samples of every table."""
    subprocess.run([sys.executable, str(HERE / "exact" / "make.py"), "--few", str(tmp_path), topic], check=True)
    made = RESULTS["tables"](tmp_path)
    assert made.keys() == {key for key in TABLES if key.startswith(topic + "/")}
    for key, table in made.items():
        assert inputs(table) == inputs(TABLES[key]), key
        found = ~np.isnan(table["wanted"])
        assert found.any(), key
        assert np.array_equal(table["wanted"][found], TABLES[key]["wanted"][found]), key


def inputs(table: dict[str, Any]) -> dict[tuple[str, str], bytes]:
    return {(part, name): table[part][name].tobytes() for part in table if part != "wanted" for name in table[part]}
