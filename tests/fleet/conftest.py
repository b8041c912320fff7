"""An arm, and logs of the short arm in a folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from armlab import log, robots
from armlab.robots import Robot


@pytest.fixture(scope="session")
def robot() -> Robot:
    return robots.load("yumi_right")


@pytest.fixture(scope="session")
def folder(short_arm, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Six logs of 10 s."""
    folder = tmp_path_factory.mktemp("logs")
    for k in range(6):
        log.write(short_arm.log(k, 1000), folder / f"log{k}.parquet")
    return folder


@pytest.fixture(scope="module")
def early() -> Iterator[None]:
    """Use only the first two logs for the draft, so that the others are new to it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("armlab.fleet.identification.DRAFT_SECONDS", 15.0)
        yield
