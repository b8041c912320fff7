"""The kernels compiled in other ways give the same bits: without vectors, for SSE2, AVX2 and AVX-512."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from armlab.kernels import Chain

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
