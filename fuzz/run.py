"""Coverage-guided fuzzing of the decoders (atheris): `python fuzz/run.py [TARGET ...] [--seconds 600]`.

Seed inputs are in `fuzz/corpus/TARGET`. New inputs are saved in `build/fuzz/TARGET`, from which the next run continues.
Failing inputs are saved in `build/fuzz/failed`; `python fuzz/run.py TARGET FILE ...` replays them without atheris.
After a fix, add the input to the corpus, which a test replays.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import re
import subprocess
import sys
import tempfile
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CORPUS, BUILD = ROOT / "fuzz" / "corpus", ROOT / "build" / "fuzz"
TOGETHER = 2  # targets fuzzed in parallel
TIMEOUT, MEMORY, LONGEST = 20, 2048, 32768  # limits for one input: time [s] on a busy machine, memory [MiB], size [B]


def main() -> int:
    """Run the command line; return 1 if a target failed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="*", help="targets, default: all; files after a single target are run once")
    parser.add_argument("--seconds", type=int, default=600, help="duration per target [s]")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    sys.path.insert(0, str(ROOT))
    if given.here:
        return fuzz(given.what[0], given.seconds, given.seed)
    files = [Path(one) for one in given.what[1:] if Path(one).is_file()]
    if files:
        return replay(given.what[0], files)
    if importlib.util.find_spec("atheris") is None:
        print("Expected atheris, but it is not installed. If your Python has a wheel: pip install 'armlab[fuzz]'.")
        return 1
    names = given.what or sorted(one.name for one in CORPUS.iterdir())
    with tempfile.TemporaryDirectory(prefix="armlab-fuzz-") as folder, ThreadPoolExecutor(TOGETHER) as pool:
        results = list(pool.map(lambda name: aside(name, given.seconds, given.seed, folder), names))
    for line in results:
        print(line)
    return int(any("failed" in line for line in results))


def replay(name: str, files: list[Path]) -> int:
    """Replay inputs once, without atheris."""
    from fuzz.targets import TARGETS

    for path in files:
        TARGETS[name](path.read_bytes())
    return 0


def aside(name: str, seconds: int, seed: int, folder: str) -> str:
    """Fuzz one target in a separate process; return the result in one line."""
    BUILD.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, __file__, name, "--here", f"--seconds={seconds}", f"--seed={seed}"]
    environment = {
        **os.environ,
        "TMPDIR": folder,
        "OMP_NUM_THREADS": "1",
        "PYTHONHASHSEED": "0",
    }  # for reproducible runs
    log = BUILD / f"{name}.log"
    with log.open("wb") as out:
        status = subprocess.run(command, stdout=out, stderr=out, env=environment, cwd=ROOT, check=False).returncode
    text = log.read_text(errors="replace")
    runs = re.findall(r"number_of_executed_units: (\d+)", text) or re.findall(r"#(\d+)\s", text) or ["0"]
    edges = re.findall(r"cov: (\d+)", text) or ["0"]
    about = f"{name}: {runs[-1]} executions, {edges[-1]} edges"
    if status == 0:
        return about
    errors = re.findall(r"(?m)^(?:[\w.]*(?:Error|Exception|Refused)\b.*|.*ERROR: .*)$", text)
    kept = re.findall(r"Test unit written to (\S+)", text)
    return f"{about}, failed: {errors[0][:200] if errors else f'status {status}'} {kept[-1] if kept else log}"


def fuzz(name: str, seconds: int, seed: int) -> int:
    """Fuzz one target in this process, which atheris terminates."""
    import atheris

    warnings.simplefilter("ignore")
    sys.path.insert(0, str(ROOT / "src"))  # the loader of an editable installation does not support instrumentation
    sys.meta_path.sort(key=lambda finder: "editable" in type(finder).__module__)  # kept for the compiled extension
    with atheris.instrument_imports(include=["armlab"]):
        from fuzz.targets import TARGETS

        target = TARGETS[name]
        for path in sorted((CORPUS / name).iterdir()):
            target(path.read_bytes())  # also instruments imports within functions
    found, failed = BUILD / name, BUILD / "failed"
    found.mkdir(parents=True, exist_ok=True)
    failed.mkdir(exist_ok=True)
    options = {
        "max_total_time": seconds,
        "seed": seed,
        "timeout": TIMEOUT,
        "rss_limit_mb": MEMORY,
        "max_len": LONGEST,
        "print_final_stats": 1,
        "artifact_prefix": f"{failed}/{name}-",
    }
    words = [f"-{option}={value}" for option, value in options.items()]
    atheris.Setup([sys.argv[0], *words, str(found), str(CORPUS / name)], target)
    atheris.Fuzz()
    return 0


if __name__ == "__main__":
    sys.exit(main())
