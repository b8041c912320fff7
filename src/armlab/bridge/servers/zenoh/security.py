"""`Security`: certificates, passwords and access rules at one end of a Zenoh link."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from armlab.bridge.servers.zenoh.messages import EVERY, key
from armlab.errors import ConfigError

COMMANDER = "commander"
"""Name of the user who may send commands and set parameters."""

BRIDGE = "bridge"
"""User name of bridges; only this user may publish through a remote router."""

USERS = (COMMANDER, BRIDGE, "viewer")
"""Names of all users; each has a password."""

_LARGEST = 2**20  # maximum number of characters in a user file
_SERVED = ("state", "live", "view", "events", "status", "parameters", "answer/**", "alive")


@dataclass(frozen=True)
class Security:
    """Credential files at one end of a link."""

    ca: Path | None = None  # certificate of the lab's certificate authority; enables TLS
    certificate: Path | None = None  # certificate of this end, for listening
    key: Path | None = None
    users: Path | None = None  # lines "user:password" of the allowed users, of whom only `COMMANDER` may send commands
    secret: Path | None = None  # one line "user:password", the credentials of this end

    def __post_init__(self) -> None:
        for path in (self.ca, self.certificate, self.key, self.users, self.secret):
            if path is not None and not _is_file(path):
                raise ConfigError(
                    f"Expected a file at {path}, found none. Create the file with armlab bridge certificates."
                )
        for path in (self.key, self.users, self.secret):
            if path is not None and path.stat().st_mode & 0o077:
                raise ConfigError(f"Expected {path} to be readable only by its owner. Run chmod 600 {path}.")
        if (self.certificate is None) != (self.key is None) or (self.certificate is not None and self.ca is None):
            raise ConfigError("Expected all of `certificate`, `key` and `ca`, got only some of them.")
        if self.secret is not None:
            _own(self.secret)
        if self.users is not None and COMMANDER not in dict(_lines(self.users)):
            raise ConfigError(f"Expected a line {COMMANDER}:PASSWORD in {self.users}, got none. Add it.")

    @classmethod
    def of(cls, options: Any) -> Security:
        """Return the security settings in a table or in link options."""
        names = [name for name in cls.__dataclass_fields__ if options.get(name)]
        try:
            return cls(**{name: Path(options[name]).expanduser() for name in names})
        except (RuntimeError, ValueError) as error:  # an unknown ~user, or a NUL byte
            raise ConfigError(
                f"Expected files on this computer, got {str(error).rstrip('.')}. Use absolute paths."
            ) from None

    @property
    def is_safe(self) -> bool:
        """Whether the link is encrypted and users need passwords, so clients on other computers may send commands."""
        return None not in (self.ca, self.certificate, self.key, self.users)

    def values(self, listens: bool) -> dict[str, Any]:
        found: dict[str, Any] = {}
        if self.ca is not None:
            found["transport/link/tls/root_ca_certificate"] = str(self.ca.absolute())
        if self.certificate is not None and self.key is not None:
            found["transport/link/tls/listen_certificate"] = str(self.certificate.absolute())
            found["transport/link/tls/listen_private_key"] = str(self.key.absolute())
        if self.secret is not None:
            user, password = _own(self.secret)
            found["transport/auth/usrpwd/user"], found["transport/auth/usrpwd/password"] = user, password
        if self.users is not None and listens:
            found["transport/auth/usrpwd/dictionary_file"] = str(self.users.absolute())
            found["access_control"] = _rules()
        return found


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # the name is too long
        return False


def _own(path: Path) -> tuple[str, str]:
    lines = _lines(path)
    if len(lines) != 1:
        raise ConfigError(f"Expected one line USER:PASSWORD in {path}, got {len(lines)}.")
    return lines[0]


def _lines(path: Path) -> list[tuple[str, str]]:
    found = []
    with path.open(encoding="utf-8", errors="replace") as opened:
        text = opened.read(_LARGEST)
    for number, line in enumerate(text.splitlines(), 1):
        if line.strip():
            user, colon, password = line.strip().partition(":")
            if not (user and colon and password):
                raise ConfigError(f"Expected USER:PASSWORD in line {number} of {path}.")
            found.append((user, password))
    return found


def _rules() -> dict[str, Any]:
    """Return the access rules: anyone may read, query and stop; only `COMMANDER` may send commands; only bridges
    publish."""
    everything = "armlab/**"
    commands = [key(EVERY, EVERY, what) for what in ("command/**", "param/**")]
    reading = ["declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber"]
    serving, answering = ["put", "delete", "liveliness_token"], ["reply", "declare_queryable"]
    rules = [
        _rule("out", "egress", [*reading, *serving, *answering], [everything]),
        _rule("ask", "ingress", reading, [everything]),
        _rule("stop", "ingress", ["put"], [key(EVERY, EVERY, "stop")]),
        _rule("command", "ingress", ["put"], commands),
        _rule("serve", "ingress", serving, [key(EVERY, EVERY, what) for what in _SERVED]),
        _rule("answer", "ingress", answering, [everything]),
    ]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [
            {"id": "everybody"},
            {"id": COMMANDER, "usernames": [COMMANDER]},
            {"id": BRIDGE, "usernames": [BRIDGE]},
        ],
        "policies": [
            {"rules": ["out", "ask", "stop"], "subjects": ["everybody"]},
            {"rules": ["command"], "subjects": [COMMANDER]},
            {"rules": ["serve", "answer"], "subjects": [BRIDGE]},
        ],
    }


def _rule(name: str, flow: str, messages: list[str], keys: list[str]) -> dict[str, Any]:
    return {"id": name, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys}
