"""Files whose arrays are far larger than themselves are refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from armlab.errors import LogError
from armlab.log.file_formats.opening import check_unpacked_size


def test_a_thousand_times_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    path.write_bytes(bytes(100_000))
    check_unpacked_size(path, 100_000_000)
    with pytest.raises(LogError, match=r"at most 100000000 bytes in .*a\.h5, 1000 times its size, got 100000001"):
        check_unpacked_size(path, 100_000_001)
    path.write_bytes(b"")
    check_unpacked_size(path, 1 << 26)
