"""Who may connect, who may ask: tokens, certificates, and what is wrong with them."""

from __future__ import annotations

import subprocess
from pathlib import Path
from typing import Any

import pytest

from armlab.bridge.servers.rosbridge.server import Access, read_access
from armlab.errors import ConfigError

TOKEN = "0123456789abcdef-_"


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    path = tmp_path / "token"
    path.write_text(f"{TOKEN}\n")
    path.chmod(0o600)
    return path


def test_without_a_token_everybody_may_ask() -> None:
    access = read_access({})
    assert access.judge(None) is True
    assert access.judge("Bearer whatever") is True
    assert access.context is None
    assert isinstance(access, Access)


def test_with_a_token_those_who_know_it(secret: Path) -> None:
    for access in (read_access({"token_file": str(secret)}), read_access({"token_variable": "T"}, {"T": TOKEN})):
        assert access.judge(f"Bearer {TOKEN}") is True
        assert access.judge(f"bearer  {TOKEN} ") is True
        assert access.judge(None) is False, "reads"
        for wrong in ("", "Bearer", f"Bearer {TOKEN}x", TOKEN, f"Basic {TOKEN}", "Bearer \ud800\u00e4"):
            assert access.judge(wrong) is None
        assert TOKEN not in repr(access)


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o644, 0o660])
def test_a_file_that_others_read_is_no_secret(secret: Path, mode: int) -> None:
    secret.chmod(mode)
    with pytest.raises(ConfigError, match=f"got mode {mode:04o}. chmod 600"):
        read_access({"token_file": str(secret)})


def test_what_is_no_token(tmp_path: Path, secret: Path) -> None:
    with pytest.raises(ConfigError, match="No such file"):
        read_access({"token_file": str(tmp_path / "none")})
    with pytest.raises(ConfigError, match="got both"):
        read_access({"token_file": str(secret), "token_variable": "T"})
    for text in ("", "short", "with spaces in the middle", "\u00e4" * 20):
        with pytest.raises(ConfigError, match=r"at least 16 ASCII characters .* in the variable T") as caught:
            read_access({"token_variable": "T"}, {"T": text})
        assert not text or text not in str(caught.value)


def test_certificates(tmp_path: Path) -> None:
    certificate, key = make_certificate(tmp_path)
    assert read_access({"certificate": certificate, "key": key}).context is not None
    wrong: list[dict[str, Any]] = [
        {"certificate": certificate, "key": certificate},
        {"certificate": str(tmp_path / "none"), "key": key},
    ]
    for options in wrong:
        with pytest.raises(ConfigError, match="Expected a certificate in"):
            read_access(options)
    for name in ("certificate", "key"):
        with pytest.raises(ConfigError, match="got one of them"):
            read_access({name: certificate})


def make_certificate(folder: Path) -> tuple[str, str]:
    """Return a certificate of 127.0.0.1 and its key."""
    certificate, key = str(folder / "certificate.pem"), str(folder / "key.pem")
    words = "req -x509 -newkey ec -pkeyopt ec_paramgen_curve:prime256v1 -nodes -days 2 -subj /CN=127.0.0.1"
    command = ["openssl", *words.split(), "-addext", "subjectAltName=IP:127.0.0.1", "-out", certificate, "-keyout", key]
    subprocess.run(command, check=True, capture_output=True)
    return certificate, key
