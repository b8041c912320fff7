"""Plain NumPy kernels (`tests/oracles`) as contenders."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1]))

from tests import oracles

__all__ = ["oracles"]
