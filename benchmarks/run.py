"""Run the benchmarks of armlab and its peers, and write a report.

    python benchmarks/run.py                   all benchmarks, 50 minutes on an idle machine with two cores
    python benchmarks/run.py --only pose       one benchmark
    python benchmarks/run.py --quick           quick look
    python benchmarks/run.py --publish         also write the two pages and the picture in docs, and the baseline

A benchmark is a file ``bench_NAME.py`` in this folder with a function ``run(quick) -> list[blocks.Table]``. It runs in
a separate process, so benchmarks do not affect each other. The report (Markdown and a picture) goes to
``benchmarks/results``. It states the duration of each benchmark, and compares the figures with the baseline of
the last published run.
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import environment

if TYPE_CHECKING:  # these modules need the peers' environment
    from report import Section

HERE = Path(__file__).resolve().parent
DOCS = HERE.parent / "docs"
NAMES = tuple(sorted(path.stem.removeprefix("bench_") for path in HERE.glob("bench_*.py")))


def main() -> int:
    """Prepare and enter the environment, measure, and report."""
    parser = argparse.ArgumentParser(description="Benchmarks of armlab and its peers.")
    parser.add_argument("--only", choices=NAMES, action="append", metavar="NAME", help=f"one of {', '.join(NAMES)}")
    parser.add_argument("--quick", action="store_true", help="quick look, too short for conclusions")
    parser.add_argument("--publish", action="store_true", help="also write the pages in docs and the baseline")
    options = parser.parse_args()
    if options.publish and (options.only or options.quick):
        parser.error("only a complete run can be published: omit --only and --quick")
    if not environment.is_inside():
        environment.prepare()
        environment.enter(__file__, sys.argv[1:])
    return _measured(options.only or NAMES, options.quick, bool(options.only), options.publish)


def _measured(names: Sequence[str], quick: bool, some: bool, publish: bool) -> int:
    import baseline
    import machine
    import picture
    from measure import measure
    from report import summary

    start, about = datetime.now(UTC), machine.describe()
    date = f"{start:%Y-%m-%d %H:%M} UTC"
    path = HERE / "results" / f"{start:%Y-%m-%d-%H%M%S}.md"
    path.parent.mkdir(exist_ok=True)
    sections: list[Section] = []
    for k, name in enumerate(names, start=1):
        minutes = (datetime.now(UTC) - start).total_seconds() / 60.0
        print(f"Measuring {name} ({k} of {len(names)}, {minutes:.0f} min) ...", flush=True)
        sections.append(measure(name, quick))
        _write(path, date, about, sections, quick, some)  # after each benchmark, to keep the results of an aborted run
    drawn = path.with_suffix(".png")
    shown = drawn.name if picture.draw(f"{date}. {about[0]}", sections, drawn) else ""
    text = _write(path, date, about, sections, quick, some, shown)
    failed = [section.name for section in sections if section.failure]
    if publish and not failed:
        page = "_static/benchmarks.png"
        (DOCS / "benchmarks.md").write_text(summary(date, about, sections, page), encoding="utf-8")
        (DOCS / "benchmarks_all.md").write_text(text.replace(f"({shown})", f"({page})"), encoding="utf-8")
        shutil.copy(drawn, DOCS / "_static" / "benchmarks.png")
        baseline.store(date, about[0], sections)
    print(text)
    print(f"Report: {path.relative_to(environment.ROOT)}, with its picture in the same folder")
    if failed:
        print(f"Failed: {', '.join(failed)}. Nothing was published.", file=sys.stderr)
    return 1 if failed else 0


def _write(
    path: Path,
    date: str,
    about: Sequence[str],
    sections: Sequence[Section],
    quick: bool,
    some: bool,
    picture: str = "",
) -> str:
    import baseline
    from report import render

    compared = baseline.render(baseline.compare(about[0], sections, whole=not some))
    text = render(date, about, sections, quick, picture, compared)
    path.write_text(text, encoding="utf-8")
    return text


if __name__ == "__main__":
    sys.exit(main())
