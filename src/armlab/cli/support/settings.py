"""User settings: option defaults from files and the environment."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from armlab._files import TomlError, parsed
from armlab.errors import ConfigError


def read_text(path: Path, what: str) -> str:
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ConfigError(f"Expected {what} at {path}, but the file cannot be read: {error.strerror}.") from None
    except UnicodeDecodeError:
        raise ConfigError(f"Expected {what} at {path}, got a file that is not UTF-8 text.") from None


PREFIX = "ARMLAB_"
_CREDENTIALS = ("ARMLAB_RWS_USER", "ARMLAB_RWS_PASSWORD")  # credentials of a controller; never shown as settings
_FILE = "armlab.toml"
_PATHS = ("cell", "logs")  # paths relative to the settings file

_Port = Annotated[int, msgspec.Meta(ge=1, le=65535)]


class UserSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Contents of a settings file.

    Attributes
    ----------
    cell : cell file of `armlab bridge`.
    logs : folder of automatically named recordings.
    ports : UDP ports, keyed by robot name.
    speed : fraction of a robot's speed and acceleration limits, in (0, 1].
    wait : method of waiting for packets.
    """

    cell: str | None = None
    logs: str = "."
    ports: dict[str, _Port] = {}
    speed: Annotated[float, msgspec.Meta(gt=0.0, le=1.0)] = 1.0
    wait: Literal["ahead", "block", "spin"] = "ahead"


@dataclass(frozen=True)
class LoadedSettings:
    """Effective settings and their origins."""

    settings: UserSettings
    origins: Mapping[str, str]  # file, variable or "default", keyed by setting name


def load_settings(environment: Mapping[str, str] | None = None) -> LoadedSettings:
    """Return the effective settings in this folder; `environment` defaults to the environment of the process."""
    variables = os.environ if environment is None else environment
    values: dict[str, Any] = {}
    origins = dict.fromkeys(UserSettings.__struct_fields__, "default")
    sources = [(str(path), _of_file(path)) for path in (user_file(variables), Path(_FILE)) if path.is_file()]
    sources += [(f"${name}", given) for name, given in _of_environment(variables)]
    for origin, given in sources:
        values |= given
        origins |= dict.fromkeys(given, origin)
    return LoadedSettings(UserSettings(**values), origins)


def user_file(environment: Mapping[str, str]) -> Path:
    """Return the path of the user's settings file in the XDG configuration directory."""
    folder = environment.get("XDG_CONFIG_HOME") or "~/.config"
    return Path(folder).expanduser() / "armlab" / _FILE


def log_folder() -> Path:
    """Return the folder of automatically named recordings; create it if missing."""
    folder = Path(load_settings().settings.logs)
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def _of_file(path: Path) -> dict[str, Any]:
    try:
        given = parsed(read_text(path, "settings"))
    except TomlError as error:
        raise ConfigError(f"Expected valid TOML in {path}: {error}.") from None
    return _checked(given, str(path), path.parent, strict=True)


def _of_environment(variables: Mapping[str, str]) -> list[tuple[str, dict[str, Any]]]:
    found = []
    for variable in sorted(variables):
        if not variable.startswith(PREFIX) or variable in _CREDENTIALS:
            continue
        name = variable.removeprefix(PREFIX).lower()
        value: Any = variables[variable]
        if name == "ports":
            value = dict(word.strip().partition("=")[::2] for word in value.split(",") if word)
        found.append((variable, _checked({name: value}, f"${variable}", Path(), strict=False)))
    return found


def _checked(given: dict[str, Any], origin: str, folder: Path, strict: bool) -> dict[str, Any]:
    """Return the validated entries, with paths resolved against this folder."""
    try:
        settings = msgspec.convert(given, UserSettings, strict=strict)
    except msgspec.ValidationError as error:
        known = ", ".join(UserSettings.__struct_fields__)
        raise ConfigError(f"Expected valid settings in {origin}: {error}. Known: {known}.") from None
    values = {name: getattr(settings, name) for name in given}
    for name in _PATHS:
        if values.get(name) is not None:
            values[name] = str(folder / Path(values[name]).expanduser())
    return values
