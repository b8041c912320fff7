"""`Access`: who may connect to the rosbridge server, and who of them may ask for something: token, TLS, web pages."""

from __future__ import annotations

import hmac
import os
import re
import ssl
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from armlab.errors import ConfigError

__all__ = ["Access", "read_access"]

_SHORTEST = 16  # characters of a token
_LOCAL_PAGES = re.compile(r"https?://(localhost|127\.0\.0\.1)(:\d{1,5})?")


@dataclass(frozen=True, repr=False)
class Access:
    """What is asked of clients.

    Attributes
    ----------
    token : that clients show who want more than to read; None when nobody has to. context : of TLS, None without.
    origins : of web pages that may connect, as `websockets` takes them; None stands for programs, which have none.
    """

    token: bytes | None
    context: ssl.SSLContext | None
    origins: tuple[Any, ...]

    def judge(self, authorization: str | None) -> bool | None:
        """Return whether a client may ask for something, None when it must not even connect.

        Parameters
        ----------
        authorization : the header of that name, None without one.
        """
        if self.token is None:
            return True
        if authorization is None:
            return False
        kind, _, shown = authorization.partition(" ")
        is_right = hmac.compare_digest(shown.strip().encode(errors="replace"), self.token)  # in constant time
        return True if is_right and kind.lower() == "bearer" else None


def read_access(options: Mapping[str, Any], environment: Mapping[str, str] | None = None) -> Access:
    """Return what the options of the server say.

    Parameters
    ----------
    options : "token_file" or "token_variable", "certificate" and "key", files in PEM, "origins" of web pages.
    environment : variables; those of the process by default.

    Raises
    ------
    ConfigError : files or variables that are missing, open to others, or hold something else.
    """
    token = _token(options, os.environ if environment is None else environment)
    context = _context(options.get("certificate"), options.get("key"))
    return Access(token, context, (None, _LOCAL_PAGES, *options.get("origins", ())))


def _token(options: Mapping[str, Any], environment: Mapping[str, str]) -> bytes | None:
    file, variable = options.get("token_file"), options.get("token_variable")
    if file and variable:
        raise ConfigError("Expected token_file or token_variable for rosbridge, got both. Take one out.")
    if variable:
        where, text = f"the variable {variable}", environment.get(variable, "")
    elif file:
        where, text = str(file), _secret(Path(file))
    else:
        return None
    token = text.strip()
    if len(token) < _SHORTEST or not token.isascii() or len(token.split()) > 1:
        raise ConfigError(
            f"Expected a token of at least {_SHORTEST} ASCII characters without spaces in {where}, got {len(token)} "
            "characters. Make one: python -c 'import secrets; print(secrets.token_urlsafe())'."
        )
    return token.encode()


def _secret(file: Path) -> str:
    try:
        with file.open(encoding="utf-8", errors="replace") as opened:
            mode = stat.S_IMODE(os.fstat(opened.fileno()).st_mode)
            if mode & 0o077:
                raise ConfigError(
                    f"Expected {file} to be read by its owner only, got mode {mode:04o}. chmod 600 {file}"
                )
            return opened.read(4096)
    except OSError as error:
        raise ConfigError(f"Expected the token of rosbridge in {file}, but {error.strerror}.") from None


def _context(certificate: str | None, key: str | None) -> ssl.SSLContext | None:
    if not certificate and not key:
        return None
    if not certificate or not key:
        raise ConfigError("Expected certificate and key for rosbridge, got one of them. Name both files.")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(certificate, key, password="")
    except (OSError, ValueError) as error:  # ssl.SSLError is an OSError
        raise ConfigError(
            f"Expected a certificate in {certificate} and its key, without a password, in {key}, but {error}."
        ) from None
    return context
