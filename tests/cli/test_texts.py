"""Files written by hand: read, or a sentence."""

from __future__ import annotations

from pathlib import Path

import pytest

from armlab.cli.support.settings import read_text
from armlab.errors import ConfigError


def test_text_with_or_without_a_byte_order_mark(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes("\ufeffspeed = 1 # µ".encode())
    assert read_text(tmp_path / "a", "settings") == "speed = 1 # µ"


@pytest.mark.parametrize(
    ("name", "said"), [("none", "No such file"), ("", "Is a directory"), ("junk", "no text in UTF-8")]
)
def test_what_cannot_be_read_is_named(name: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "junk").write_bytes(b"\xff\xfe\x00\xd8")
    with pytest.raises(ConfigError, match=rf"^Expected a cell at {tmp_path}.*{said}.*\.$"):
        read_text(tmp_path / name, "a cell")
