"""Distributions: the sdist contains what building needs, the wheel what running needs; neither needs a network."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SOURCE = ROOT / "src" / "armlab"
PROGRAM = """
import numpy as np
from armlab import kernels, robots
robot = robots.load("yumi_left")
T = robot.chain.forward(np.zeros(robot.n))
print(kernels.__file__, T.shape, bool(abs(np.linalg.det(T[:3, :3]) - 1) < 1e-12))
"""

for requirement in ("build", "scikit_build_core", "nanobind", "cmake"):
    pytest.importorskip(requirement, reason=f"needs {requirement} of the extra dev")
pytestmark = pytest.mark.slow  # a minute: the compiler


def python(*arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run a module of this environment with no package index to ask."""
    known = {k: v for k, v in os.environ.items() if k not in ("CC", "CXX")}
    return subprocess.run(
        [sys.executable, "-m", *arguments],
        env=known | {"PIP_NO_INDEX": "1", "PIP_NO_CACHE_DIR": "1"} | environment,
        capture_output=True,
        text=True,
        check=False,
    )


def files(folder: Path) -> set[str]:
    return {
        str(path.relative_to(folder))
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts and path.suffix != ".so"
    }


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sdist")
    result = python("build", "--sdist", "--no-isolation", "--outdir", str(folder), str(ROOT))
    assert result.returncode == 0, result.stdout + result.stderr
    return next(folder.glob("armlab-*.tar.gz"))


@pytest.fixture(scope="module")
def unpacked(sdist: Path) -> Path:
    with tarfile.open(sdist) as archive:
        archive.extractall(sdist.parent, filter="data")
    return sdist.parent / sdist.name.removesuffix(".tar.gz")


@pytest.fixture(scope="module")
def wheel(unpacked: Path) -> Path:
    """The wheel of the unpacked sdist; not optimised, because that takes the compiler eight times as long."""
    for tool in ("ziglang", "auditwheel"):
        pytest.importorskip(tool, reason=f"needs {tool}: make zig")
    options = [f"WHEEL_OF={unpacked}", f"WHEEL_TO={unpacked.parent}", "WHEEL_FLAGS=-O0"]
    command = ["make", "-C", str(ROOT), "wheel", *options]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    return next(unpacked.parent.glob("armlab-*.whl"))


@pytest.fixture(scope="module")
def programs(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The programs of an environment with only the wheel and the dependencies of armlab."""
    folder = tmp_path_factory.mktemp("new")
    venv.create(folder)
    (site,) = folder.glob("lib/python*/site-packages")
    (site / "needed.pth").write_text("\n".join(path for path in sys.path if Path(path).name.endswith("-packages")))
    result = python("pip", "--python", str(folder), "install", "--no-deps", str(wheel))
    assert result.returncode == 0, result.stdout + result.stderr
    return folder / "bin"


def run(folder: Path, *command: str, **changes: str) -> subprocess.CompletedProcess[str]:
    """Run a program of an environment away from the sources."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("PYTHON", "ARMLAB"))} | changes
    return subprocess.run(
        [str(folder / command[0]), *command[1:]],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )


def test_sdist_holds_what_it_takes_to_build(unpacked: Path) -> None:
    """The sources, the pages a reader looks for, and nothing else from this folder: no tests, no logs, no builds."""
    top = {"CMakeLists.txt", "pyproject.toml", "LICENSE", "README.md", "CHANGELOG.md", "CITATION.cff", "PKG-INFO"}
    assert {path.name for path in unpacked.iterdir()} == top | {"native", "src", "CONTRIBUTING.md"}
    assert files(unpacked / "native") == files(ROOT / "native")
    assert files(unpacked / "src") == files(ROOT / "src")


def test_wheel_holds_the_package_and_its_compiled_core(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if not name.endswith("/")}
    information = {name for name in names if name.split("/")[0].endswith(".dist-info")}
    compiled = {name for name in names if name.startswith("armlab/kernels/_native.") and name.endswith(".so")}
    assert len(compiled) == 1
    assert names - information - compiled == {f"armlab/{name}" for name in files(SOURCE)}
    assert {"armlab/py.typed", "armlab/wire/egm/armlab_egm_pb2.py", "armlab/robots/library/yumi_left.toml"} < names
    assert "armlab/bridge/rapid/ArmlabYumiL.mod" in names
    assert any(name.endswith("licenses/LICENSE") for name in information)


def test_installed_wheel_runs_the_compiled_core(wheel: Path, programs: Path) -> None:
    answer = run(programs, "python", "-W", "error", "-c", PROGRAM).stdout.split()
    assert Path(answer[0]).is_relative_to(programs.parent)
    assert answer[1:] == ["(4,", "4)", "True"]
    assert run(programs, "armlab", "--version").stdout.strip() == wheel.name.split("-")[1]


def test_the_demo_runs_from_the_wheel_without_a_compiler(wheel: Path, programs: Path, tmp_path: Path) -> None:
    """Also on old Linux versions: the wheel links against glibc of 2012, and not against the C++ library."""
    assert "manylinux_2_17" in wheel.name
    run(programs, "armlab", "demo", "--fast", "-o", str(tmp_path / "demo"), PATH=str(programs))
    assert (tmp_path / "demo" / "summary.json").is_file()


@pytest.fixture
def bare(tmp_path: Path) -> Path:
    """A folder of programs without a compiler, but with a build tool, such as pip provides."""
    folder = tmp_path / "bare"
    folder.mkdir()
    tool = shutil.which("ninja") or shutil.which("make")
    if tool is None:
        pytest.skip("needs ninja or make")
    (folder / Path(tool).name).symlink_to(tool)
    return folder


def test_without_a_compiler_pip_says_what_to_install(sdist: Path, bare: Path, tmp_path: Path) -> None:
    command = ("pip", "install", "--no-deps", "--no-build-isolation", "--target", str(tmp_path / "to"), str(sdist))
    result = python(*command, PATH=str(bare))
    assert result.returncode != 0
    said = " ".join((result.stdout + result.stderr).split())
    assert "this machine has no C++ compiler. Install what is missing and try again: " in said
    assert "sudo apt install g++ python3-dev Fedora sudo dnf install gcc-c++ python3-devel macOS xcode-select" in said
    assert not (tmp_path / "to").exists()
