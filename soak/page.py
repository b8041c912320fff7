"""Documentation page generated from the results of both parts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

__all__ = ["page"]


def page(text: str, results: Mapping[str, Mapping[str, Any]]) -> str:
    """Return the page with updated results.

    Parameters
    ----------
    text : page text. results : `result.json` by part, "real_time" and "lockstep"; missing parts stay unchanged.
    """
    for name, result in results.items():
        before, rest = text.split(f"<!-- {name} -->\n")
        _, after = rest.split(f"<!-- end of {name} -->\n")
        shown = "\n".join(_part(name, result))
        text = f"{before}<!-- {name} -->\n{shown}\n<!-- end of {name} -->\n{after}"
    return text


def _part(name: str, result: Mapping[str, Any]) -> Iterator[str]:
    judged = result["judged"]
    failed = [one for one in judged if not one["is_met"]]
    wall = 1e-9 * (result["end"] - result["begin"])
    robot = max(result["robot_seconds"].values())
    length = f"{wall / 60.0:.1f} minutes" if name == "real_time" else f"{robot / 3600.0:.2f} hours of robot time"
    yield (
        f"{result['date']}, {length}{'' if name == 'real_time' else f' in {wall / 60.0:.0f} minutes'}; "
        f"{len(judged) - len(failed)} of {len(judged)} quantities within their bounds. {' '.join(result['machine'])}"
    )
    if result.get("without"):
        yield f"\nWithout {', '.join(result['without'])}, which were not installed."
    yield from (
        f"\nBeyond its bound: {one['what']}, {one['found']:.4g}{one['unit']}, at most {one['most']:.4g}."
        for one in failed
    )
    yield f"\n![Memory, descriptors, threads and delays over time](_static/soak_{name}.png)\n"
    yield "| process | memory at the end | growth in the second half | descriptors | threads | CPU load |"
    yield "|---|---|---|---|---|---|"
    for process, one in result["held"].items():
        grown = next(
            (each["found"] for each in judged if each["what"].startswith(f"{process}: memory, growth")), float("nan")
        )
        yield (
            f"| {process} | {one['memory'] / 2**20:.1f} MiB | {grown:+.2f} MiB | {one['descriptors']:.0f} "
            f"| {one['threads']:.0f} | {100.0 * one['cpu']:.0f} % |"
        )
    yield "\n| recording | rows | dropped | missed or late | arrival to reply, median | 99 % |"
    yield "|---|---|---|---|---|---|"
    for recording, one in result["recordings"].items():
        yield (
            f"| {recording} | {one['rows']} | {one['dropped']} | {100.0 * one['missed']:.3f} % "
            f"| {1e3 * one['p50']:.2f} ms | {1e3 * one['p99']:.2f} ms |"
        )
    if result["readers"]:
        yield "\n| client | messages | stamp to receipt, median |\n|---|---|---|"
        for client, one in result["readers"].items():
            yield f"| {client} | {one['messages']} | {1e3 * one['delay']:.2f} ms |"
