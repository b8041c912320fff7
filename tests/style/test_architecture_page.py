"""The page of the architecture names files that exist."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "architecture.md"


def test_every_file_of_the_page_exists() -> None:
    text = PAGE.read_text(encoding="utf-8")
    named = set(re.findall(r"`((?:src/armlab|tests|native)/[\w./]+)`", text))
    named |= {f"src/armlab/{path}" for path in re.findall(r"`((?:bridge|log|wire)/[\w./]+\.py)`", text)}
    assert len(named) > 30
    missing = sorted(path for path in named if not (ROOT / path).exists())
    assert not missing
