"""Files with which a bridge and those who come to it know each other."""

from __future__ import annotations

import re
import shutil
import ssl
import subprocess
from pathlib import Path

import pytest

from armlab.cli import main
from armlab.cli.bridge import USERS, write_certificates
from armlab.errors import ConfigError

pytestmark = pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed")


def test_certificates_are_of_the_lab_s_authority(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "lab"
    assert main(["bridge", "certificates", str(folder), "--host", "192.168.1.5", "--host", "lab-pc"]) == 0
    shown = capsys.readouterr().out.split()
    assert sorted(shown) == sorted(str(path) for path in folder.iterdir())
    check = ["openssl", "verify", "-CAfile", str(folder / "lab.pem"), str(folder / "bridge.pem")]
    assert subprocess.run(check, capture_output=True, text=True, check=False).stdout.endswith("OK\n")
    text = ["openssl", "x509", "-in", str(folder / "bridge.pem"), "-noout", "-ext", "subjectAltName"]
    names = subprocess.run(text, capture_output=True, text=True, check=True).stdout
    assert re.search("DNS:localhost, IP Address:127.0.0.1, IP Address:192.168.1.5, DNS:lab-pc", names)
    ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(folder / "bridge.pem", folder / "bridge.key")
    assert {path.stat().st_mode & 0o077 for path in folder.iterdir()} == {0}
    users = (folder / "users.txt").read_text().splitlines()
    assert [line.partition(":")[0] for line in users] == ["commander", "bridge", "viewer"] == list(USERS)
    assert (folder / "commander.secret").read_text().strip() == users[0]
    assert len({line.partition(":")[2] for line in users}) == 3


def test_authority_and_users_are_kept(tmp_path: Path) -> None:
    write_certificates(tmp_path)
    kept = {name: (tmp_path / name).read_bytes() for name in ("lab.key", "lab.pem", "users.txt", "commander.secret")}
    before = (tmp_path / "bridge.key").read_bytes()
    assert [path.name for path in write_certificates(tmp_path, ["robot-pc"])] == ["bridge.key", "bridge.pem"]
    assert {name: (tmp_path / name).read_bytes() for name in kept} == kept
    assert (tmp_path / "bridge.key").read_bytes() != before


def test_what_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match="names or addresses"):
        write_certificates(tmp_path, ["a,DNS:b"])
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="Expected a folder"):
        write_certificates(tmp_path / "file")
    (tmp_path / "lab.key").write_text("no key")
    with pytest.raises(ConfigError, match="openssl to write a certificate"):
        write_certificates(tmp_path)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(ConfigError, match="Expected the program openssl"):
        write_certificates(tmp_path / "other")
