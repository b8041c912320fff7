"""Mapping of other programs' column names: ``q=joint_{1..6}_pos [deg],tau=current_{1..6}*12.5``, and presets.

An entry is ``NAME=SOURCE``, optionally with a factor and a unit: ``tau=current_{1..6}*{11.2,11.2,9.8,4.4,4.4,4.4}``.
``{1..6}`` is a range, ``{0..}`` a range up to the last column in the file, and ``{a,b}`` a list. ``{*}`` matches any
text within one topic; the matched text is the joint name. ``|`` separates alternatives; the first name that exists is
used. A source may omit the prefix of a name up to a ``/`` or ``.``: ``position[{0..}]`` finds
``/joint_states/position[0]``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any

import numpy as np

from armlab import glossary
from armlab.errors import ConfigError, LogError, UnknownName
from armlab.log.column import UNITS, natural_key

Arrays = Mapping[str, tuple[np.ndarray, str]]  # name -> values (N, ...) and unit ("" if none)

_ROS_STAMP = "header.stamp.secs,header.stamp.nsecs"
PRESETS = {
    "ur": (  # RTDE recordings of Universal Robots
        "t=timestamp,q=actual_q_{0..},qd=actual_qd_{0..},tau=actual_current_as_torque_{0..},q_ref=target_q_{0..},"
        "qd_ref=target_qd_{0..},tau_ref=target_moment_{0..}"
    ),
    "franka": (  # libfranka's logToCSV (time in ms; older: "duration"), and FrankaState of franka_ros as CSV
        "t=header.stamp [ns]|%time [ns]|time [ms]|duration [ms],q=state.q[{0..}]|field.q{0..}|q[{0..}],"
        "qd=state.dq[{0..}]|field.dq{0..}|dq[{0..}],tau=state.tau_J[{0..}]|field.tau_J{0..}|tau_J[{0..}],"
        "q_ref=state.q_d[{0..}]|field.q_d{0..}|q_d[{0..}],qd_ref=state.dq_d[{0..}]|field.dq_d{0..}|dq_d[{0..}]"
    ),
    "ros": (  # JointState as CSV: rostopic echo -p, bagpy, PlotJuggler (sorted by name), ros2 topic echo --csv
        f"t=field.header.stamp [ns]|{{{_ROS_STAMP}}}|%time [ns]|__time|Time|time,names=name{{0..}}|name_{{0..}}|"
        "name[{0..}],q=position{0..}|position_{0..}|position[{0..}]|{*}/position,qd=velocity{0..}|velocity_{0..}|"
        "velocity[{0..}]|{*}/velocity,tau=effort{0..}|effort_{0..}|effort[{0..}]|{*}/effort"
    ),
    "abb": (  # EGMLogger of abb_libegm: ms and degrees
        "t=TIMESTAMP [ms],q=R_FB_POS_RJ{1..6} [deg],qd=R_FB_VEL_RJ{1..6} [deg/s],q_ref=S_REF_POS_RJ{1..6} [deg],"
        "q_planned=R_PL_POS_RJ{1..6} [deg]"
    ),
    "abb7": (  # the same for a seven-joint arm; joints are ordered from base to tool
        "t=TIMESTAMP [ms],q={R_FB_POS_RJ{1,2},R_FB_POS_EJ1,R_FB_POS_RJ{3..6}} [deg],"
        "qd={R_FB_VEL_RJ{1,2},R_FB_VEL_EJ1,R_FB_VEL_RJ{3..6}} [deg/s],"
        "q_ref={S_REF_POS_RJ{1,2},S_REF_POS_EJ1,S_REF_POS_RJ{3..6}} [deg]"
    ),
}
"""Presets of `columns` and their expansion; only q is required."""

_LABELS = ("q", "qd", "tau")  # columns labelled with joint names
_TAIL = re.compile(
    r"^(?P<names>.*?)(?:\*(?P<factor>[-+.\deE]+|\{[^{}]*\}))?(?:\s*\[(?P<unit>[^\[\]\d{}][^\[\]{}]*)\])?$"
)
_MOST = 1000  # columns per pattern
_WRIST = 3  # index of the first of three identical UR drives
_CORRELATED = 0.7  # minimum accepted correlation between current and target moment after friction is removed from both


@dataclass(frozen=True)
class _Source:
    text: str  # as entered by the user, for error messages
    names: tuple[str, ...]  # patterns without lists
    factors: tuple[float, ...]  # one factor for all names, or one per name
    unit: str


@dataclass(frozen=True)
class ColumnNames:
    """Source names of table columns."""

    entries: Mapping[str, tuple[_Source, ...]]
    optional: frozenset[str] = frozenset()  # columns that a file may lack, as in presets
    presets: tuple[str, ...] = ()
    notes: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, told: str | Mapping[str, Any]) -> ColumnNames:
        if not isinstance(told, str | Mapping):
            raise ConfigError(f"Expected columns as 'q=joint_{{1..6}}' or {{'q': 'joint_{{1..6}}'}}, got {told!r}.")
        entries: dict[str, tuple[_Source, ...]] = {}
        presets: list[str] = []
        optional: set[str] = set()
        for name, sources in _entries(told):
            if sources is None:
                if name not in PRESETS:
                    raise UnknownName.among("preset of columns (or use NAME=SOURCE)", name, PRESETS)
                presets.append(name)
                of_preset = dict(_entries(PRESETS[name]))
                optional |= set(of_preset)
                entries |= {own: _sources(own, text) for own, text in of_preset.items()}
            else:
                optional.discard(name)
                entries[name] = _sources(name, sources)
        if not entries:
            raise ConfigError(f"Expected columns as q=joint_{{1..6}}, or {' or '.join(PRESETS)}, got {told!r}.")
        return cls(entries, frozenset(optional), tuple(presets))

    def of_several_files(self) -> ColumnNames:
        """Return the names with every column optional, for sets of files that each contain only some of the columns."""
        return replace(self, optional=frozenset(self.entries), presets=())

    def found(self, path: Any, arrays: Arrays) -> tuple[dict[str, tuple[np.ndarray, str]], dict[str, tuple[str, ...]]]:
        """Return the arrays keyed by new name, and the joint labels of each column."""
        used: set[str] = set()
        made: dict[str, tuple[np.ndarray, str]] = {}
        labels: dict[str, tuple[str, ...]] = {}
        for name, sources in self.entries.items():
            match = next((hit for one in sources if (hit := _matches(one, arrays))), None)
            if match is None:
                if name not in self.optional:
                    self._refuse(path, name, arrays)
                continue
            source, members, stars = match
            parts = [arrays[one] for one in members]
            empty = all(values.dtype.kind == "f" and np.isnan(values).all() for values, _ in parts)
            if empty and name in self.optional and name != "t":
                continue
            used |= set(members)
            if name == "names":
                labels |= dict.fromkeys(_LABELS, tuple(str(values[0]) for values, _ in parts if len(values)))
            else:
                made[name] = _together(path, name, source, members, parts)
            if stars:
                labels[name] = stars
        if "ur" in self.presets and "tau" not in made:
            self._torque_of_currents(path, arrays, made)
        if self.presets and "q" in self.optional and "q" not in made:
            self._refuse(path, "q", arrays)
        rest = {name: entry for name, entry in arrays.items() if name not in used and name not in made}
        widths = {name: values.shape[1] for name, (values, _) in made.items() if values.ndim > 1}
        return made | rest, {name: own for name, own in labels.items() if widths.get(name) == len(own)}

    def _refuse(self, path: Any, name: str, arrays: Arrays) -> None:
        wanted = " or ".join(one.text for one in self.entries[name])
        preset = f" of the preset {' and '.join(self.presets)}" if name in self.optional else ""
        raise LogError(
            f"Expected columns {wanted} for {name}{preset} in {path}, got {listed(arrays)}. "
            f"{fitting_presets(arrays) or f'Name its source: --columns {name}=NAME_{{1..6}}.'}"
        )

    def _torque_of_currents(self, path: Any, arrays: Arrays, made: dict[str, tuple[np.ndarray, str]]) -> None:
        """Compute the torques of a UR from motor currents; the target moment determines the torque constants."""
        current, target = (_stacked(arrays, f"{one}_current_") for one in ("actual", "target"))
        if current is None:
            return
        moment, qd = made.get("tau_ref"), made.get("qd")
        told = target if target is not None else current
        if moment is None or qd is None or current.shape != moment[0].shape or told.shape != current.shape:
            raise LogError(
                f"Expected torques in {path}, got currents actual_current_0 ... in A. Also record target_moment and "
                "actual_qd, which determine the torque constants, or pass the constants [N m/A]: --columns "
                "'ur,tau=actual_current_{0..5}*{10,10,10,8,8,8}'."
            )
        constants = np.array([_slope(*columns) for columns in zip(told.T, moment[0].T, qd[0].T)])
        known = constants > 0.0
        wrist = np.flatnonzero(known[_WRIST:]) + _WRIST
        guessed = np.flatnonzero(~known[_WRIST:]) + _WRIST if len(wrist) else []
        constants[guessed] = constants[wrist].mean() if len(wrist) else np.nan
        weak = np.flatnonzero(~(constants > 0.0))
        if len(weak):
            currents = ", ".join(f"actual_current_{k}" for k in weak)
            raise LogError(
                f"Expected currents correlated with target_moment in {path}, got uncorrelated currents in {currents}. "
                "Log a motion that loads these joints, or pass the torque constants [N m/A]: --columns "
                "'ur,tau=actual_current_{0..5}*{10,10,10,8,8,8}'."
            )
        made["tau"] = (current * constants, "N m")
        values = ", ".join(f"{k:.4g}" for k in constants)
        self.notes.append(f"tau is actual_current times {values} N m/A, identified from target_moment")
        for k in guessed:
            self.notes.append(
                f"joint {k + 1} carries too little load; the torque constant of the other wrist joints is used"
            )


def listed(names: Iterable[str]) -> str:
    names = list(names)
    return ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")


def fitting_presets(arrays: Arrays) -> str:
    """Return a sentence that names the presets matching the columns of a file, or "" if none matches."""
    fitting = []
    for preset, text in PRESETS.items():
        entries = dict(_entries(text))
        with suppress(LogError):
            if all(any(_matches(one, arrays) for one in _sources(name, entries[name])) for name in ("t", "q")):
                fitting.append(f"--columns {preset}")
    return f"Read these column names with {' or '.join(fitting)}." if fitting else ""


def _entries(told: str | Mapping[str, Any]) -> list[tuple[str, Any]]:
    """Return the name and sources of each entry; the sources of a preset are None."""
    if isinstance(told, Mapping):
        return [(str(name), sources) for name, sources in told.items()]
    parts = [part.strip() for part in _split(told, ",") if part.strip()]
    pairs = [(part.partition("=")[0].strip(), part.partition("=")[2].strip()) for part in parts]
    return [(name, source if "=" in part else None) for part, (name, source) in zip(parts, pairs)]


def _sources(name: str, told: Any) -> tuple[_Source, ...]:
    """Return the alternatives of an entry, which is a string or a list of names."""
    texts = _split(told, "|") if isinstance(told, str) else ["{" + ",".join(map(str, told)) + "}"]
    if not name or not all(text.strip() for text in texts):
        raise ConfigError(f"Expected NAME=SOURCE, such as q=joint_{{1..6}}, got {name}={told}.")
    return tuple(_source(name, text.strip()) for text in texts)


def _source(name: str, text: str) -> _Source:
    found = _TAIL.match(text)
    names = tuple(_listed(found["names"].strip())) if found else ()
    try:
        factor = (found["factor"] or "1").strip("{}") if found else ""
        factors = tuple(float(word) for word in factor.split(","))
    except ValueError:
        factors = ()
    usable = bool(names and factors) and bool(np.isfinite(factors).all()) and 0.0 not in factors
    counts = range(2, _MOST) if any("{" in one for one in names) else [len(names)]  # "{": the file determines the names
    if not usable or len(factors) not in (1, *counts):
        raise ConfigError(
            f"Expected {name}=SOURCE, SOURCE*FACTOR or SOURCE*{{FACTORS}}, optionally followed by [unit], such as "
            f"{name}=joint_{{1..6}} [deg], got {name}={text}."
        )
    return _Source(text, names, factors, (found["unit"] or "").strip() if found else "")


def _split(text: str, mark: str) -> list[str]:
    """Split a string at separators outside braces."""
    parts, depth = [""], 0
    for letter in text:
        depth += (letter == "{") - (letter == "}")
        if letter == mark and depth <= 0:
            parts.append("")
        else:
            parts[-1] += letter
    return parts


def _listed(pattern: str) -> Iterable[str]:
    """Expand a pattern into names; ``{0..}`` and ``{*}`` are left unexpanded."""
    found = _first_braces(pattern)
    if found is None:
        return [pattern] if pattern else []
    before, inside, after = found
    span = re.fullmatch(r"(\d+)\.\.(\d+)", inside)
    if inside == "*" or re.fullmatch(r"\d+\.\.", inside):
        return [f"{before}{{{inside}}}{rest}" for rest in _listed(after) or [""]]
    if span:
        numbers = range(int(span[1]), min(int(span[2]), int(span[1]) + _MOST) + 1)
        heads = [str(k).zfill(len(span[1])) for k in numbers]
    else:
        heads = [name for part in _split(inside, ",") for name in _listed(part.strip())]
    return [before + head + rest for head, rest in product(heads, list(_listed(after)) or [""])]


def _first_braces(pattern: str) -> tuple[str, str, str] | None:
    """Return the text before, inside and after the first pair of braces."""
    start, depth = pattern.find("{"), 0
    for at in range(start, len(pattern)) if start >= 0 else ():
        depth += (pattern[at] == "{") - (pattern[at] == "}")
        if depth == 0:
            return pattern[:start], pattern[start + 1 : at], pattern[at + 1 :]
    return None


def _matches(source: _Source, arrays: Arrays) -> tuple[_Source, list[str], tuple[str, ...]] | None:
    """Return the source with its names replaced by those found in the file, and the joints matched by ``{*}``."""
    members: list[str] = []
    stars: list[str] = []
    for pattern in source.names:
        if "{*}" in pattern:
            found = _of_one_topic(pattern, arrays)
            members += found
            stars += found.values()
        elif counted := re.search(r"\{(\d+)\.\.\}", pattern):
            number = int(counted[1])
            while hit := _one(pattern.replace(counted[0], str(number)), arrays):
                members.append(hit)
                number += 1
        elif hit := _one(pattern, arrays):
            members.append(hit)
        else:
            return None
    return (source, members, tuple(stars)) if members else None


def _of_one_topic(pattern: str, arrays: Arrays) -> dict[str, str]:
    """Return the string matched by ``{*}`` for each name, in the topic with the most matches."""
    before, after = map(re.escape, pattern.split("{*}", 1))
    topics: dict[str, dict[str, str]] = {}
    for name in arrays:
        if hit := re.search(rf"(?:^|/){before}([^/]+){after}$", name):
            topics.setdefault(name[: hit.start()], {})[name] = hit[1]
    largest = [topic for topic, of_one in topics.items() if len(of_one) == max(map(len, topics.values()))]
    if len(largest) > 1:
        raise LogError(
            f"Expected one topic with {pattern}, got {' and '.join(largest)}. Name the topic of each column, such as "
            f"{pattern.replace('{*}', largest[0] + '/{*}')}."
        )
    return topics[largest[0]] if largest else {}


def _one(name: str, arrays: Arrays) -> str | None:
    """Return the matching name in the file: an exact match, or the only name that ends with it after ``/`` or ``.``."""
    if name in arrays:
        return name
    ends = [one for one in arrays if one.endswith((f"/{name}", f".{name}"))]
    return ends[0] if len(ends) == 1 else None


def _together(
    path: Any, name: str, source: _Source, members: Sequence[str], parts: Sequence[tuple[np.ndarray, str]]
) -> tuple[np.ndarray, str]:
    if words := [one for one, (values, _) in zip(members, parts) if values.dtype.kind == "U"]:
        raise LogError(f"Expected numbers in {words[0]} of {path} for {name}, got text. Pass another column.")
    if ":" in name:  # poses have fixed units; the given unit applies to the position
        parts = [
            (values * UNITS.get(source.unit if source.unit and k < 3 else unit, ("", 1.0))[1], "")
            for k, (values, unit) in enumerate(parts)
        ]
        source = replace(source, unit="")
    units = {unit for _, unit in parts} - {""}
    told = {source.unit} - {""}
    plain = source.factors == (1.0,)
    if len(units) > 1 or (plain and units and told and units != told):
        raise LogError(
            f"Expected one unit for {name} in {path}, got {', '.join(sorted(units | told))}. Convert the columns, or "
            "omit the unit."
        )
    unit = (source.unit or (units.pop() if units and plain else "")).strip()
    arrays = [values for values, _ in parts]
    if name == "t" and len(arrays) == 2:  # seconds and nanoseconds
        whole, rest = (values.astype(np.int64) for values in arrays)
        return (whole - (whole[0] if len(whole) else 0)) * 10**9 + rest, "ns"
    symbol = glossary.columns().get(name)
    one_per_row = symbol is None or symbol.shape.count(",") == symbol.shape.count(",)")
    array = arrays[0] if len(arrays) == 1 and (one_per_row or arrays[0].ndim > 1) else np.column_stack(arrays)
    if plain:
        return array, unit
    width = math.prod(array.shape[1:])
    if len(source.factors) not in (1, width):
        raise LogError(f"Expected {width} factors for {name} in {path}, got {len(source.factors)} in {source.text}.")
    return array * np.array(source.factors), unit


def _stacked(arrays: Arrays, stem: str) -> np.ndarray | None:
    names = sorted((name for name in arrays if re.fullmatch(rf"{stem}\d+", name)), key=natural_key)
    return np.column_stack([arrays[name][0] for name in names]) if names else None


def _slope(current: np.ndarray, moment: np.ndarray, qd: np.ndarray) -> float:
    """Return the torque constant [N m/A]; NaN if current and target moment are uncorrelated."""
    whole = np.isfinite(current) & np.isfinite(moment) & np.isfinite(qd)
    friction = np.stack([np.ones(len(qd)), qd, np.sign(qd) * (np.abs(qd) > 1e-3)], axis=1)[whole]
    rest = [x[whole] - friction @ np.linalg.lstsq(friction, x[whole], rcond=None)[0] for x in (current, moment)]
    both = np.sqrt((rest[0] @ rest[0]) * (rest[1] @ rest[1]))
    correlation = rest[0] @ rest[1] / both if both > 0 else 0.0
    return float(rest[1] @ rest[1] / (rest[0] @ rest[1])) if correlation > _CORRELATED else float("nan")
