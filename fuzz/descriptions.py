"""Descriptions: robots, cells, models, addresses."""

from __future__ import annotations

import contextlib
import tempfile
from pathlib import Path
from typing import Any

from armlab import models, robots
from armlab.bridge.cell import parse_cell
from armlab.bridge.servers.zenoh.session import LabAddress
from armlab.bridge.urls import addresses
from armlab.errors import ArmlabError
from armlab.models.files import encode, load_statistics
from armlab.robots import urdf

_FOLDER = tempfile.TemporaryDirectory(prefix="armlab-fuzz-")


def _text(data: bytes) -> str:
    return data.decode("utf-8", errors="replace")


def robot_urdf(data: bytes) -> None:
    """URDF or xacro input; an arm in it must survive a round trip through a robot file."""
    try:
        tree = urdf.parse(data)
        tree.mimic([joint.name for joint in tree.joints])
    except ArmlabError:
        return
    for tip in (None, *(link.name for link in tree.links[-2:])):
        try:
            arm = tree.chain(None, tip)
            text = robots.to_toml(arm)
        except ArmlabError:
            continue
        assert robots.from_toml(text, "a").hash == arm.hash


def robot_toml(data: bytes) -> None:
    """Robot file with DH rows, POE or screws; writing it again must preserve every bit."""
    try:
        arm = robots.from_toml(_text(data), "a.toml")
        text = robots.to_toml(arm)
    except ArmlabError:
        return
    assert robots.from_toml(text, "b.toml").hash == arm.hash


def cell(data: bytes) -> None:
    """Cell file, or URL of a link."""
    for read in (parse_cell, LabAddress.read, lambda url: addresses([url], 1)):
        with contextlib.suppress(ArmlabError):
            read(_text(data))


def model(data: bytes) -> None:
    """Model file of any kind; saving it again must preserve the value."""
    path, again = Path(_FOLDER.name) / "a.toml", Path(_FOLDER.name) / "b.toml"
    path.write_bytes(data)
    with contextlib.suppress(ArmlabError):
        load_statistics(path)
    try:
        value = models.load(path)
        models.save(value, again)
    except ArmlabError:
        return
    assert _told(models.load(again)) == _told(value)


def _told(value: Any) -> str:
    from armlab.models import TorqueModel
    from armlab.models.files import torque_tables

    return repr({**torque_tables(value), "meta": 0} if isinstance(value, TorqueModel) else encode(value))
