"""`write_certificates`: files with which a bridge and those who come to it know each other, made with ``openssl``."""

from __future__ import annotations

import ipaddress
import os
import secrets
import subprocess
from collections.abc import Sequence
from pathlib import Path

from armlab.bridge.servers.zenoh.security import BRIDGE, COMMANDER
from armlab.errors import ConfigError

__all__ = ["USERS", "write_certificates"]

USERS = (COMMANDER, BRIDGE, "viewer")
"""Users that get a password each."""

_DAYS = "3650"
_CURVE = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]


def write_certificates(folder: Path, hosts: Sequence[str] = ()) -> list[Path]:
    """Write a lab's authority, the certificate and key of a bridge, and users with their passwords.

    ``lab.pem`` goes to everybody, ``bridge.pem``, ``bridge.key`` and ``users.txt`` stay with the bridge (and with a
    router of the lab), ``USER.secret`` goes to whom it is for; ``lab.key`` signs more bridges and goes nowhere. Keys
    and passwords are readable by their owner alone. An authority or users that are there are kept.

    Parameters
    ----------
    folder : where to. hosts : names and addresses under which the bridge is reached; this computer always is.

    Returns
    -------
    The files that were written.

    Raises
    ------
    ConfigError : no ``openssl``, a name that is none, or a folder that cannot be written.
    """
    names = ["localhost", "127.0.0.1", *hosts]
    for name in names:
        if not name or any(not (letter.isalnum() or letter in ".-:") for letter in name):
            raise ConfigError(f"Expected names or addresses of the bridge's computer, got {name!r}.")
    before = os.umask(0o077)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        written = [] if (folder / "lab.key").exists() else _authority(folder)
        return written + _bridge(folder, names) + _users(folder)
    except OSError as error:
        raise ConfigError(f"Expected a folder to write certificates to, but {error}.") from None
    finally:
        os.umask(before)


def _authority(folder: Path) -> list[Path]:
    key, certificate = folder / "lab.key", folder / "lab.pem"
    subject = ["-subj", "/CN=armlab lab", "-addext", "basicConstraints=critical,CA:TRUE"]
    _openssl("req", "-x509", *_CURVE, "-days", _DAYS, *subject, "-keyout", str(key), "-out", str(certificate))
    return [key, certificate]


def _bridge(folder: Path, names: Sequence[str]) -> list[Path]:
    key, certificate, request = (folder / f"bridge.{end}" for end in ("key", "pem", "csr"))
    extensions = folder / "bridge.ext"
    subjects = ",".join(f"{'IP' if _is_address(name) else 'DNS'}:{name}" for name in names)
    extensions.write_text(
        f"subjectAltName={subjects}\nbasicConstraints=critical,CA:FALSE\nextendedKeyUsage=serverAuth,clientAuth\n",
        encoding="utf-8",
    )
    try:
        _openssl("req", *_CURVE, "-subj", f"/CN={names[-1]}", "-keyout", str(key), "-out", str(request))
        signing = ["-CA", str(folder / "lab.pem"), "-CAkey", str(folder / "lab.key"), "-CAcreateserial"]
        where = ["-extfile", str(extensions), "-days", _DAYS, "-out", str(certificate)]
        _openssl("x509", "-req", "-in", str(request), *signing, *where)
    finally:
        for one in (extensions, request, folder / "lab.srl"):
            one.unlink(missing_ok=True)
    return [key, certificate]


def _users(folder: Path) -> list[Path]:
    path = folder / "users.txt"
    if path.exists():
        return []
    lines = {user: f"{user}:{secrets.token_urlsafe(24)}\n" for user in USERS}
    path.write_text("".join(lines.values()), encoding="utf-8")
    for user, line in lines.items():
        (folder / f"{user}.secret").write_text(line, encoding="utf-8")
    return [path, *(folder / f"{user}.secret" for user in USERS)]


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def _openssl(*words: str) -> None:
    try:
        run = subprocess.run(["openssl", *words], capture_output=True, text=True, check=False, timeout=60.0)
    except FileNotFoundError:
        raise ConfigError("Expected the program openssl to write certificates, got none. Install it.") from None
    if run.returncode:
        raise ConfigError(
            f"Expected openssl to write a certificate, but it said: {' '.join(run.stderr.split())[:300]}."
        )
