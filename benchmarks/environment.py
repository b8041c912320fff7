"""Benchmark environment: armlab (installed as by a user) and its peers. Standard library only."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
HOME = ROOT / ".bench-venv"
PYTHON = HOME / "bin" / "python"
STAMP = HOME / ".installed"
REQUIREMENTS = ROOT / "benchmarks" / "requirements.txt"
NO_DEPS = ROOT / "benchmarks" / "requirements_no_deps.txt"
CONSTRAINTS = ROOT / "constraints.txt"

# one thread; compiled kernels or an error, but never silently the reference kernels
SETTINGS = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}


def fingerprint() -> str:
    """Return a hash of everything that determines the installation."""
    files = [REQUIREMENTS, NO_DEPS, CONSTRAINTS, ROOT / "pyproject.toml", ROOT / "CMakeLists.txt"]
    files += sorted(path for path in (ROOT / "native").rglob("*") if path.is_file())
    files += sorted(p for p in (ROOT / "src").rglob("*") if p.is_file() and p.suffix not in (".pyc", ".so"))
    digest = hashlib.sha256(sys.version.encode())
    for file in files:
        digest.update(str(file.relative_to(ROOT)).encode() + b"\0" + file.read_bytes() + b"\0")
    return digest.hexdigest()


def prepare() -> None:
    """Create the environment, or update it if armlab or the list of peers has changed."""
    wanted = fingerprint()
    if STAMP.exists() and STAMP.read_text() == wanted:
        return
    print(f"Installing armlab and its peers into {HOME.name} (about two minutes the first time).", flush=True)
    if not PYTHON.exists():
        subprocess.run([sys.executable, "-m", "venv", str(HOME)], check=True)
    install = [str(PYTHON), "-m", "pip", "--disable-pip-version-check", "install", "--quiet"]
    # a separate build directory, because the editable installation in .venv uses another one
    subprocess.run(
        [*install, "-r", str(REQUIREMENTS), "-C", f"build-dir={HOME / 'build'}", str(ROOT)],
        check=True,
        env={**os.environ, "PIP_CONSTRAINT": str(CONSTRAINTS)},
    )
    subprocess.run([*install, "--no-deps", "-r", str(NO_DEPS)], check=True)
    STAMP.write_text(wanted)


def enter(script: str, arguments: list[str]) -> None:
    """Replace this process with the same script in the environment."""
    os.execve(PYTHON, [str(PYTHON), script, *arguments], {**os.environ, **SETTINGS})


def is_inside() -> bool:
    """Return whether this process already runs in the environment with its settings."""
    return Path(sys.prefix).resolve() == HOME and all(os.environ.get(k) == v for k, v in SETTINGS.items())
