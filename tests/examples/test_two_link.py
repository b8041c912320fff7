"""The demonstration of the ancestor with the two-link arm says what it should: repeated, pushed, recovered."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

import numpy as np
import pytest

from armlab.motion import TwoDofDmp
from armlab.sim import two_link

EXAMPLE = Path(__file__).parents[2] / "examples" / "28_two_link.py"


def test_the_arm_repeats_is_pushed_and_arrives(capsys: pytest.CaptureFixture[str]) -> None:
    program = runpy.run_path(str(EXAMPLE))
    assert (program["motion"].TwoDofDmp, program["two_link"]) == (TwoDofDmp, two_link)
    program["main"]()
    repeated, pushed, end = (float(x) for x in re.findall(r"([\d.]+) mm", capsys.readouterr().out))
    assert repeated < 1.0
    assert pushed > 50.0
    assert end < 0.1
    np.testing.assert_allclose(two_link.forward(two_link.inverse(program["POINTS"])), program["POINTS"], atol=1e-12)
