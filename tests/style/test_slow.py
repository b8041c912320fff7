"""`make slow` reads only files that say "slow": each that has slow tests must."""

from __future__ import annotations

import re
from pathlib import Path


def test_a_file_with_slow_tests_says_so(slow_files: set[Path]) -> None:
    """Marks may come from elsewhere, such as the fault matrix. Only files collected in this run are checked."""
    silent = [path.name for path in sorted(slow_files) if not re.search(r"\bslow\b", path.read_text(encoding="utf-8"))]
    assert not silent, f"Expected the word slow in {silent}, else make slow leaves their slow tests out."
