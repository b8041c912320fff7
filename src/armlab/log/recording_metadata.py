"""What a recording says of itself: metadata and attachments, without secrets."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import platform
import subprocess
import sys
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from armlab.errors import RobotError
from armlab.log.redaction import SECRET, redacted

if TYPE_CHECKING:
    from armlab.robots import Robot

__all__ = ["attached", "described", "metadata", "revision"]

ROBOT = "robot.toml"
_PATIENCE = 2.0  # s for git


def metadata(robot: Robot, attachments: Mapping[str, bytes], note: str) -> dict[str, str]:
    """Return the metadata record of a recording; values of secret options are replaced.

    Parameters
    ----------
    robot : the arm. attachments : as they are written, for their hashes. note : the user's.
    """
    from armlab import __version__

    return {
        "version": __version__,
        "revision": revision(Path.cwd()),
        "command": " ".join(_without_secrets(sys.argv)),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "robot": robot.name,
        "robot_hash": robot.hash,
        "attachments": json.dumps({name: hashlib.sha256(data).hexdigest() for name, data in attachments.items()}),
        "note": note,
    }


def attached(robot: Robot, attachments: Mapping[str, bytes]) -> dict[str, bytes]:
    """Return the attachments of a recording: the description of the robot, and what is given, secrets replaced.

    Parameters
    ----------
    robot : the arm. attachments : name -> bytes; of settings (TOML, JSON, YAML, INI) the values of secret keys go.
    """
    from armlab.robots import to_toml

    found: dict[str, bytes] = {}
    with contextlib.suppress(RobotError):  # a name that cannot stand in a file must not cost the recording
        found[ROBOT] = to_toml(robot).encode()
    for name, data in attachments.items():
        found[name] = redacted(name, data)
    return found


def described(attachments: Mapping[str, bytes], name: str, origin: str) -> Robot | None:
    """Return the robot of a name as the attachments of a recording describe it, None where none of them does.

    Parameters
    ----------
    attachments : name -> bytes; robot.toml, robot-2.toml of the other arm. name : of the robot. origin : for messages.

    Raises
    ------
    RobotError : a description that is none.
    """
    from armlab.robots import from_toml

    found = (
        from_toml(text.decode(errors="replace"), f"{origin}, {file}")
        for file, text in attachments.items()
        if file.startswith("robot") and file.endswith(".toml")
    )
    return next((robot for robot in found if robot.name == name), None)


@cache
def revision(folder: Path) -> str:
    """Return the commit of the git repository that a folder is in, with + where files differ; empty without one."""
    words = ["git", "-C", str(folder), "describe", "--always", "--abbrev=40", "--exclude=*", "--dirty=+"]
    try:
        alone = {**os.environ, "GIT_OPTIONAL_LOCKS": "0"}  # it only looks
        done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=_PATIENCE, env=alone)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def _without_secrets(words: list[str]) -> list[str]:
    """Replace what follows an option whose name tells a secret, and what such an option equals."""
    kept: list[str] = []
    hide = False
    for word in words:
        option, equals, _ = word.partition("=")
        secret = option.startswith("-") and bool(SECRET.search(option))
        kept.append("***" if hide else f"{option}=***" if secret and equals else word)
        hide = secret and not equals
    return kept
