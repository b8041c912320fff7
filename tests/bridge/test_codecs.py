"""Codecs by name, also those of other packages."""

from __future__ import annotations

import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from armlab.bridge import connect
from armlab.bridge.link import GROUP, codec_named, codecs_of
from armlab.errors import ConfigError, UnknownName
from armlab.robots import Robot
from armlab.wire.egm import EgmCodec


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A package as pip would install it, with three entry points."""
    (tmp_path / "somesite.py").write_text(
        "from armlab.wire.egm import EgmCodec\n"
        "def good(robot):\n    return EgmCodec(robot, extension=True)\n"
        "def bad(robot):\n    return 5\n"
        "def broken(robot):\n    raise OSError('no licence')\n"
    )
    info = tmp_path / "somesite-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: somesite\nVersion: 1.0\n")
    points = "\n".join(f"{name} = somesite:{name}" for name in ("good", "bad", "broken"))
    (info / "entry_points.txt").write_text(f"[{GROUP}]\n{points}\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "somesite", raising=False)


def test_ours(robot: Robot) -> None:
    codec = codec_named("egm", robot, extension=True)
    assert isinstance(codec, EgmCodec)
    assert "torque" in codec.capabilities


@pytest.mark.usefixtures("package")
def test_an_entry_point(robot: Robot) -> None:
    first, second = codec_named("good", robot), codec_named("good", robot)
    assert first is not second
    assert "measured_torque" in first.capabilities
    with connect("egm://127.0.0.1:0", robot, codec="good") as link:
        assert link.port > 0


@pytest.mark.usefixtures("package")
@pytest.mark.parametrize(
    ("name", "words"), [("bad", "got int without capabilities"), ("broken", "OSError: no licence")]
)
def test_entry_points_that_give_no_codec(robot: Robot, name: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        codec_named(name, robot)


@pytest.mark.usefixtures("package")
def test_unknown_names_list_what_exists(robot: Robot) -> None:
    with pytest.raises(UnknownName, match="bad, broken, egm, good"):
        codec_named("egmri", robot)


def test_an_object_of_ones_own(robot: Robot) -> None:
    own: Any = SimpleNamespace(capabilities=frozenset(("position",)), reset=None, decode=None, encode=None)
    with connect("egm://127.0.0.1:0", robot, codec=own) as link:
        assert link.robot is robot


def test_each_arm_has_its_own_and_one_for_each_rehearsal(robot: Robot) -> None:
    [(own, spares)] = codecs_of("egm", [robot], extension=False, spares=2)
    assert len({id(own), *map(id, spares)}) == 3
    mine = EgmCodec(robot)
    assert codecs_of(mine, [robot], extension=False, spares=2) == [(mine, ())]


def test_an_object_that_is_no_codec_is_refused(robot: Robot) -> None:
    with pytest.raises(ConfigError, match=r"wire\.egm\.Codec, got 5\."):
        connect("egm://127.0.0.1:0", robot, codec=5)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="one codec per arm"):
        codecs_of(EgmCodec(robot), [robot, robot], extension=False, spares=0)
