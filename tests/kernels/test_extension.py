"""The compiled extension: the error without it, its stub, and the same bits from every compiler."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armlab import kernels
from armlab.kernels import Chain

STUB = ast.parse((Path(kernels.__file__).parent / "_native.pyi").read_text(encoding="utf-8"))
PUBLIC = {node.name: node for node in STUB.body if isinstance(node, ast.ClassDef | ast.FunctionDef)}


@pytest.mark.parametrize("extension", ["None", "types.ModuleType('old')"])
def test_without_the_extension_one_sentence_says_what_to_install(extension: str) -> None:
    program = f"import sys, types; sys.modules['armlab.kernels._native'] = {extension}; import armlab.kernels"
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False).stderr
    assert "MissingExtra: Expected the compiled kernels of this armlab version, got none" in said
    assert "Install an armlab wheel, or install a C++ compiler and run `make -B setup`" in said


def test_the_stub_has_every_kernel_and_no_other() -> None:
    assert (
        set(PUBLIC)
        == {name for name in dir(kernels._native) if not name.startswith("_")}
        == set(dir(kernels)) & set(PUBLIC)
    )


def parameters(node: ast.FunctionDef) -> list[str]:
    found = [a.arg for a in (*node.args.args, *node.args.kwonlyargs)]
    return found[1:] if found[:1] == ["self"] else found


def compiled_parameters(function: Any) -> list[str]:
    signature = (function.__doc__ or "").splitlines()[0]
    while "[" in signature:
        signature = re.sub(r"\[[^][]*\]", "", signature)
    found = re.findall(r"[(,] ?\*{0,2}(\w+)(?=[:,)=])", signature.partition(" ->")[0])
    return found[1:] if found[:1] == ["self"] else found


@pytest.mark.parametrize("name", PUBLIC)
def test_the_stub_is_of_the_extension(name: str) -> None:
    """Methods, properties, and the names of parameters in their order."""
    kernel, node = getattr(kernels, name), PUBLIC[name]
    if isinstance(node, ast.FunctionDef):
        assert parameters(node) == compiled_parameters(kernel)
        return
    listed = {part.name: part for part in node.body if isinstance(part, ast.FunctionDef)}
    attributes = {part.target.id for part in node.body if isinstance(part, ast.AnnAssign)}
    assert {part for part in dir(kernel) if not part.startswith("_")} == set(listed) - {"__init__"} | attributes
    for method, part in listed.items():
        if not part.decorator_list:
            assert parameters(part) == compiled_parameters(getattr(kernel, method)), method


NATIVE = Path(__file__).resolve().parents[2] / "native"
JOINTS, COUNT = 7, 23
PROGRAM = f"""
#include <cstdio>
#include "array/batch.h"
#include "math/arm/kinematics.h"
using namespace armlab;
int main() {{
  static double frames[16 * {JOINTS + 1}], prismatic[{JOINTS}], q[{JOINTS * COUNT}];
  static double T[16 * {COUNT}], J[{6 * JOINTS * COUNT}];
  bool slides[{JOINTS}];
  std::size_t read = std::fread(frames, 8, 16 * {JOINTS + 1}, stdin) + std::fread(prismatic, 8, {JOINTS}, stdin);
  read += std::fread(q, 8, {JOINTS * COUNT}, stdin);
  for (int i = 0; i < {JOINTS}; ++i) slides[i] = prismatic[i] != 0.0;
  const Chain chain({JOINTS}, frames, slides);
  run_batch<1, 2>({COUNT}, {{Reading{{q, {JOINTS}}}}}, {{Writing{{T, 16}}, Writing{{J, {6 * JOINTS}}}}},
                  [&](const auto &in, const auto &out) {{ jacobian(chain, in[0], false, out[1]).write(out[0]); }});
  std::fwrite(T, 8, 16 * {COUNT}, stdout);
  std::fwrite(J, 8, {6 * JOINTS * COUNT}, stdout);
  return read == {16 * (JOINTS + 1) + JOINTS + JOINTS * COUNT} ? 0 : 1;
}}
"""
ONE_LEVEL = "-DARMLAB_VECTORISED="
WAYS = {
    "plain": ["-DARMLAB_PLAIN"],
    "sse2": [ONE_LEVEL],
    "avx2": [ONE_LEVEL, "-march=x86-64-v3"],
    "avx512vl": [ONE_LEVEL, "-march=x86-64-v4"],
}
PROCESSOR = Path("/proc/cpuinfo").read_text() if Path("/proc/cpuinfo").exists() else ""
COMPILER = shutil.which("c++")


@pytest.mark.slow  # 4 s each: the compiler
@pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")
@pytest.mark.parametrize("way", WAYS)
def test_same_bits_however_compiled(way: str, tmp_path: Path) -> None:
    if way.startswith("avx") and way not in PROCESSOR:
        pytest.skip(f"this processor has no {way}")
    rng = np.random.default_rng(0)
    frames = np.tile(np.eye(4), (JOINTS + 1, 1, 1))
    for frame, alpha in zip(frames, (0.3, np.pi / 2, -np.pi / 2, 0.0, np.pi, 1.1, np.pi / 2, 0.2)):
        c, s = np.cos(alpha), np.sin(alpha)
        frame[1:3, 1:3] = [[c, -s], [s, c]]
        frame[:3, 3] = rng.normal(size=3)
    prismatic = np.arange(JOINTS) == 3
    q = rng.uniform(-4, 4, (COUNT, JOINTS))
    q[5, 2], q[9, 0] = 1e7, np.nan
    source, program = tmp_path / "kernels.cpp", tmp_path / "kernels"
    source.write_text(PROGRAM)
    options = ["-std=c++17", "-O2", "-ffp-contract=off", "-Wno-psabi", "-I", str(NATIVE), *WAYS[way]]
    subprocess.run(
        [str(COMPILER), *options, str(source), str(NATIVE / "math/arm/chain.cpp"), "-o", str(program)], check=True
    )
    given = b"".join(array.astype(np.float64).tobytes() for array in (frames, prismatic, q))
    out = np.frombuffer(subprocess.run([str(program)], input=given, capture_output=True, check=True).stdout)
    T, J = Chain(frames, prismatic).forward_jacobian(q)
    np.testing.assert_array_equal(out, np.concatenate([T.ravel(), J.ravel()]))
