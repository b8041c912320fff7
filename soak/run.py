"""Soak tests: hours of operation with all servers, monitored for growth.

    python soak/run.py real_time --seconds 1800     two arms, all servers, ten clients, recording
    python soak/run.py lockstep --seconds 86400     one arm, as fast as possible; --most: wall-clock limit [s]
    python soak/run.py judge FOLDER                 assess the files of an earlier run
    python soak/run.py publish FOLDER ...            write docs/soak.md from assessed runs

All measurements are written to build/soak/PART: `held.csv`, the recordings, `result.json` and `soak.png`. The test
prints a line for each assessed quantity, and exits with status 1 if one is out of bounds. Ctrl-C, SIGTERM and --most
abort the run. An aborted run is still assessed, is reported as "cut off", and exits with status 1.
"""

from __future__ import annotations

import argparse
import json
import math
import shutil
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from machine import describe  # noqa: E402

from armlab.errors import ArmlabError  # noqa: E402
from soak import cell, lockstep, series  # noqa: E402
from soak.figure import draw  # noqa: E402
from soak.judged import judged  # noqa: E402
from soak.page import page  # noqa: E402

__all__ = ["judge", "main", "publish"]

PACKAGES = ("armlab", "numpy", "zstandard", "cyclonedds", "eclipse-zenoh", "websockets", "msgspec")


def main() -> int:
    """Run and assess a part, or assess or publish earlier runs."""
    parser = argparse.ArgumentParser(description="Soak tests: hours of operation, monitored for growth.")
    parts = parser.add_subparsers(dest="part", required=True)
    for name, seconds in (("real_time", 1800.0), ("lockstep", 86400.0)):
        part = parts.add_parser(name)
        part.add_argument("--seconds", type=float, default=seconds, help="duration [s]; robot time in lockstep")
        part.add_argument("--most", type=float, default=math.inf, help="wall-clock limit [s] in lockstep")
        part.add_argument("--folder", type=Path, default=ROOT / "build" / "soak" / name)
    parts.add_parser("judge").add_argument("folder", type=Path)
    parts.add_parser("publish").add_argument("folder", type=Path, nargs="+")
    options = parser.parse_args()
    if options.part == "publish":
        publish(options.folder)
        return 0
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    folder = options.folder.resolve()
    if options.part != "judge":
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        print(f"Soak test {options.part}: {options.seconds:g} s, results in {folder}.", flush=True)
        if options.part == "real_time":
            about = cell.run(folder, options.seconds)
        else:
            about = lockstep.run(folder, options.seconds, options.most)
        about["date"] = time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime(1e-9 * about["begin"]))
        about["machine"] = describe(PACKAGES)
        (folder / "description.json").write_text(json.dumps(about, indent=1))
    return judge(folder)


def judge(folder: Path) -> int:
    """Assess a soak test, draw its figure, print a line for each quantity, and return the exit status."""
    about, held = series.description(folder), series.held(folder)
    recorded, clients = series.recorded(folder), series.clients(folder)
    found = judged(about, held, recorded, clients)
    draw(about, held, recorded, clients, folder / "soak.png")
    result = {
        **about,
        **series.levels(held, recorded, clients),
        "judged": [{**one._asdict(), "is_met": one.is_met} for one in found],
    }
    (folder / "result.json").write_text(json.dumps(result, indent=1, default=str))
    for one in found:
        print(one)
    for name, one in result["recordings"].items():
        print(f"     {name}: {100.0 * one['missed']:.3f} % of the ticks missed or late")
    failed = [one for one in found if not one.is_met]
    print(f"{len(found) - len(failed)} of {len(found)} quantities within bounds. Results: {folder}.")
    return 1 if failed else 0


def publish(folders: Sequence[Path]) -> None:
    """Write results and figures into the documentation page."""
    results = {}
    for folder in folders:
        result = json.loads((folder / "result.json").read_text())
        part = result["part"].replace(" ", "_")
        results[part] = result
        shutil.copyfile(folder / "soak.png", ROOT / "docs" / "_static" / f"soak_{part}.png")
    text = ROOT / "docs" / "soak.md"
    text.write_text(page(text.read_text(), results))


if __name__ == "__main__":
    try:
        sys.exit(main())
    except ArmlabError as error:
        sys.exit(str(error))
