"""Run the benchmarks side by side with armlab's peers and write a report.

    python benchmarks/run.py                   all of them
    python benchmarks/run.py --only pose       one
    python benchmarks/run.py --quick           a short look
    python benchmarks/run.py --publish         also write docs/benchmarks.md

A benchmark is a file ``bench_NAME.py`` here with a function ``run(quick) -> list[blocks.Table]``. It runs in a process
of its own, so that none meets what another left behind. Reports go to ``benchmarks/results``.
"""

from __future__ import annotations

import argparse
import sys
from datetime import UTC, datetime
from pathlib import Path

import environment

HERE = Path(__file__).resolve().parent
NAMES = tuple(sorted(path.stem.removeprefix("bench_") for path in HERE.glob("bench_*.py")))


def main() -> int:
    """Prepare the environment, go there, measure, report."""
    parser = argparse.ArgumentParser(description="Benchmarks of armlab beside its peers.")
    parser.add_argument("--only", choices=NAMES, action="append", metavar="NAME", help=f"one of {', '.join(NAMES)}")
    parser.add_argument("--quick", action="store_true", help="a short look")
    parser.add_argument("--publish", action="store_true", help="also write docs/benchmarks.md")
    options = parser.parse_args()
    if options.publish and (options.only or options.quick):
        parser.error("only a whole run is published: leave out --only and --quick")
    if not environment.is_inside():
        environment.prepare()
        environment.enter(__file__, sys.argv[1:])

    import machine
    from measure import measure
    from report import render

    start = datetime.now(UTC)
    sections = [measure(name, options.quick) for name in options.only or NAMES]
    text = render(f"{start:%Y-%m-%d %H:%M} UTC", machine.describe(), sections, options.quick)
    results = HERE / "results"
    results.mkdir(exist_ok=True)
    path = results / f"{start:%Y-%m-%d-%H%M%S}.md"
    path.write_text(text, encoding="utf-8")
    failed = [section.name for section in sections if section.failure]
    if options.publish and not failed:
        (environment.ROOT / "docs" / "benchmarks.md").write_text(text, encoding="utf-8")
    print(text)
    print(f"Report: {path.relative_to(environment.ROOT)}")
    if failed:
        print(f"Failed: {', '.join(failed)}. Nothing was published.", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
