"""What the tests of all commands share."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import pytest

from armlab.cli import main


@pytest.fixture
def command(capsys: pytest.CaptureFixture[str]) -> Callable[..., pytest.CaptureResult[str]]:
    """Return a function that runs a command in this process, checks its exit code and returns what it said."""

    def run(words: Iterable[object], code: int = 0) -> pytest.CaptureResult[str]:
        found = main([str(word) for word in words])
        said = capsys.readouterr()
        assert found == code, said.err
        return said

    return run
