"""Text files that the user wrote by hand."""

from __future__ import annotations

from pathlib import Path

from armlab.errors import ConfigError

__all__ = ["read_text"]


def read_text(path: Path, what: str) -> str:
    """Return the text of a file.

    Parameters
    ----------
    path : of the file. what : is expected there, for the message, with its article.

    Raises
    ------
    ConfigError : it cannot be read, or holds no text in UTF-8.
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise ConfigError(f"Expected {what} at {path}, but it cannot be read: {error.strerror}.") from None
    except UnicodeDecodeError:
        raise ConfigError(f"Expected {what} at {path}, got a file that is no text in UTF-8.") from None
