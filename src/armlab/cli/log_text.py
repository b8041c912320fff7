"""What ``armlab log show`` tells of a log: as text, and as data for scripts."""

from __future__ import annotations

from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

    from armlab.log import Table
    from armlab.log.recording.inspection import Inspection

__all__ = ["data_of", "parameters_data", "parameters_text", "text_of"]

_EVENTS_SHOWN = 20


def data_of(file: Path, kind: str, held: Inspection | None, tables: Mapping[str, Table]) -> dict[str, Any]:
    """Return what is shown of a log, for scripts.

    Parameters
    ----------
    file : the log. kind : its format. held : of a recording, what it holds besides its tables.
    tables : one by robot, by topic of another program's log, under "" where there is one only.
    """
    told = [_table_data(table) for table in tables.values()]
    several = "robots" if held and held.robots else "tables"
    rows = told[0] if list(tables) == [""] else {several: dict(zip(tables, told, strict=True))}
    return {"file": str(file), **rows, **(_recording_data(held) if held else {"format": kind})}


def text_of(file: Path, kind: str, held: Inspection | None, tables: Mapping[str, Table]) -> str:
    """Return what is shown of a log, for people; see `data_of`."""
    return _text(held, tables) if held else _exchanged_text(file, kind, tables)


def parameters_text(held: Inspection) -> str:
    """Return the history of the parameters."""
    from datetime import UTC, datetime

    told = [
        (one.stamp_ns, f"{one.name} = {one.value}, {f'set by {one.who} ({one.sequence})' if one.sequence else one.who}")
        for one in held.parameters
    ]
    told += [(event.stamp_ns, event.text) for event in held.events if event.text.startswith("A setting of ")]
    lines = [
        f"{datetime.fromtimestamp(stamp_ns / 1e9, UTC):%Y-%m-%d %H:%M:%S.%f} UTC  {text}"
        for stamp_ns, text in sorted(told, key=itemgetter(0))
    ]
    last = (held.summary or {}).get("parameters") or {}
    ends = [f"At the end: {', '.join(f'{name} = {value}' for name, value in last.items())}."] if last else []
    return "\n".join([*lines, *ends]) or "This log has no parameters."


def parameters_data(held: Inspection) -> dict[str, Any]:
    """Return the history of the parameters, for scripts."""
    return {
        "parameters": [
            {"stamp_ns": one.stamp_ns, "name": one.name, "value": one.value, "who": one.who, "sequence": one.sequence}
            for one in held.parameters
        ],
        "parameters_at_end": (held.summary or {}).get("parameters") or {},
    }


def _table_data(table: Table) -> dict[str, Any]:
    """Return what is shown of any log, for scripts."""
    from armlab.log.table import component_names, statistics, timing

    holes = table.missing()
    columns = {}
    for name in table.names:
        about, stats = table.columns[name], statistics(table[name])
        columns[name] = {"shape": list(about.shape), "unit": about.unit, "frame": about.frame, "kind": about.kind}
        columns[name] |= {"missing": holes.get(name, (0, ()))[0], "components": component_names(table, name)}
        columns[name] |= {key: stats[key] for key in ("min", "max", "mean", "sigma")}
    return {
        **timing(table),
        "clock": table.clock,
        "t0_ns": table.t0_ns,
        "sha256": table.sha256,
        "columns": columns,
        "notes": table.notes,
        "source": table.source,
    }


def _recording_data(held: Inspection) -> dict[str, Any]:
    """Return what is shown of a recording besides, for scripts."""
    return {
        "format": "MCAP",
        "bytes": held.size,
        "finished": held.finished,
        "torn_bytes": held.torn,
        "metadata": held.metadata,
        "topics": [{"name": t.name, "type": t.type, "messages": t.messages} for t in held.topics],
        "attachments": {name: len(data) for name, data in held.attachments.items()},
        "events": [{"stamp_ns": event.stamp_ns, "text": event.text} for event in held.events],
        **parameters_data(held),
        "summary": held.summary,
    }


def _exchanged_text(file: Path, kind: str, tables: Mapping[str, Table]) -> str:
    """Return what is shown of a log that is no recording."""
    first = min(tables.values(), key=lambda table: table.t0_ns, default=None)
    sources = [f"source: {entry}" for entry in first.source] if first else []
    head = [f"{file}: {kind}, began {_began(first.t0_ns if first else 0)}", *sources]
    return "\n\n".join(["\n".join(head), *_table_texts(tables)])


def _table_texts(tables: Mapping[str, Table]) -> list[str]:
    """Return rows, notes and columns of each table, with its name where there are several."""
    from armlab.cli.output import aligned
    from armlab.log.table import table_text

    blocks = [] if tables else ["no topic with numbers"]
    for name, table in tables.items():
        first, *rest = table_text(table).splitlines()
        first = f"{name}: {first}" if name else first
        blocks.append("\n".join([first, *(line for line in rest if line.startswith("note:"))]))
        blocks.append(aligned(_column_rows(table), right=(4, 5, 6)))
    return blocks


def _began(t0_ns: int) -> str:
    from datetime import UTC, datetime

    if not t0_ns:
        return "-"
    return datetime.fromtimestamp(t0_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def _text(held: Inspection, tables: Mapping[str, Table]) -> str:
    from armlab.cli.output import aligned

    state = "finished" if held.finished else f"not finished, {held.torn} bytes torn"
    began = min((table.t0_ns for table in tables.values()), default=0)
    blocks = [f"{held.path}: {held.size / 1e6:.2f} MB, {state}, began {_began(began)}"]
    for about in held.metadata.values():
        blocks.append(
            aligned(
                [(key, value) for key, value in about.items() if value and "\n" not in value and key != "attachments"]
            )
        )
    blocks += _table_texts(tables)
    blocks.append(aligned([("attachment", "bytes"), *((n, str(len(d))) for n, d in held.attachments.items())], (1,)))
    lines = [f"{_when(event.stamp_ns, began):>12}  {event.text}" for event in held.events[:_EVENTS_SHOWN]]
    more = len(held.events) - len(lines)
    blocks.append("\n".join(["events", *lines, *([f"and {more} more (--json shows all)"] if more > 0 else [])]))
    return "\n\n".join(block for block in blocks if block)


def _when(stamp_ns: int, t0_ns: int) -> str:
    """Return seconds since the first row; "-" where the stamp is on another clock, as in lockstep."""
    seconds = (stamp_ns - t0_ns) / 1e9
    return f"{seconds:.3f} s" if abs(seconds) < 30 * 86_400 else "-"


def _column_rows(table: Table) -> list[tuple[str, ...]]:
    """Return one row per column: shape of a row, unit, frame, missing, minimum and maximum over its components."""
    import numpy as np

    from armlab.log.table import statistics

    holes = table.missing()
    rows: list[tuple[str, ...]] = [("column", "shape", "unit", "frame", "missing", "min", "max")]
    for name in table.names:
        column, stats = table.columns[name], statistics(table[name])
        known = ~np.isnan(stats["min"])
        numbers = [f"{f(stats[k][known]):.6g}" if known.any() else "-" for k, f in (("min", np.min), ("max", np.max))]
        shape = "x".join(map(str, column.shape)) or "1"
        rows.append((name, shape, column.unit or "", column.frame or "-", str(holes.get(name, (0,))[0]), *numbers))
    return rows
