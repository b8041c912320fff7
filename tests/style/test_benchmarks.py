"""The harness of the benchmarks: its arithmetic, its report, and the form of its files. No clock is judged here."""

from __future__ import annotations

import ast
import importlib
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from tests.processes import until

HERE = Path(__file__).parents[2] / "benchmarks"
FILES = sorted(HERE.glob("*.py"))


@pytest.fixture
def harness(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, ModuleType]]:
    """The modules that need no peer."""
    names = ("blocks", "report", "environment", "baseline", "picture", "machine", "measure", "run")
    monkeypatch.syspath_prepend(str(HERE))
    yield {name: importlib.import_module(name) for name in names}
    for name in names:
        sys.modules.pop(name, None)


def constant(*seconds: float) -> Callable[[], np.ndarray]:
    rounds = iter(seconds)
    return lambda: np.array([next(rounds)])


def test_contenders_take_turns(harness: dict[str, ModuleType]) -> None:
    blocks, calls = harness["blocks"], []

    def block(name: str) -> Callable[[], np.ndarray]:
        return lambda: calls.append(name) or np.array([1.0])

    contenders = [blocks.Contender(name, block(name)) for name in "abc"]
    samples = blocks.alternate(contenders, rounds=20)
    rounds = [tuple(calls[k : k + 3]) for k in range(0, len(calls), 3)]
    assert len(rounds) == 21, "one round to warm up, then the measured ones"
    assert all(sorted(one) == ["a", "b", "c"] for one in rounds)
    assert len(set(rounds)) > 3, "the order changes"
    assert [len(one) for one in samples] == [20, 20, 20]


def test_figures_are_medians_and_ratios_of_one_round(harness: dict[str, ModuleType]) -> None:
    blocks = harness["blocks"]
    contenders = [
        blocks.Contender("ours", constant(9.0, 1.0, 2.0, 3.0), "armlab", bar=2.5, over="limit"),
        blocks.Contender("theirs", constant(9.0, 4.0, 8.0, 12.0), bar=0.2),
        blocks.Contender("limit", constant(9.0, 1.0, 1.0, 1.0), "limit"),
    ]
    ours, theirs, limit = blocks.figures(contenders, blocks.alternate(contenders, rounds=3))
    assert (ours.median, ours.minimum, ours.lower, ours.upper) == (2.0, 1.0, 1.5, 2.5), "without the warm-up's 9"
    assert (theirs.ratio, theirs.ratio_lower, theirs.ratio_upper) == (0.25, 0.25, 0.25)
    assert (ours.is_met, theirs.is_met, limit.is_met) == (True, False, None)
    assert ours.multiple == 2.0


def test_a_time_is_not_judged_by_itself(harness: dict[str, ModuleType]) -> None:
    """The same target would be met on one machine and missed on another."""
    blocks = harness["blocks"]
    ours = [blocks.Contender("ours", constant(1.0, 1.0, 1.0), "armlab", bar=2.0)]
    with pytest.raises(ValueError, match="ours to be judged by a ratio, got a target in ms"):
        blocks.table("One pose", "", "ms", ours, rounds=1)
    assert blocks.table("Force", "", "N", ours, rounds=1, warm=False).figures[0].is_met


def test_each_keeps_every_sample(harness: dict[str, ModuleType]) -> None:
    begun: list[int] = []
    seen: list[int] = []
    block = harness["blocks"].each(seen.append, [1, 2, 3], lambda: begun.append(len(seen)))
    assert block().shape == (3,)
    block()
    assert (seen, begun) == ([1, 2, 3, 1, 2, 3], [0, 3])


@pytest.mark.parametrize("got", [[1.0, 2.1], [1.0, np.nan], [1.0]])
def test_contenders_that_disagree_are_not_timed(harness: dict[str, ModuleType], got: list[float]) -> None:
    blocks = harness["blocks"]
    assert blocks.agree("same", [1.0, 2.0 + 1e-12], [1.0, 2.0]) < 1e-11
    with pytest.raises(blocks.Disagreement, match="poses"):
        blocks.agree("poses", got, [1.0, 2.0])


def test_report_tells_bars_and_noise(harness: dict[str, ModuleType]) -> None:
    blocks, report = harness["blocks"], harness["report"]
    contenders = [
        blocks.Contender("armlab forward", constant(2e-6, 2e-6), "armlab", bar=3.0, over="writing"),
        blocks.Contender("Peer", constant(3e-3, 3e-3), bar=0.0005, note="its best"),
        blocks.Contender("writing", constant(1e-6, 1e-6), "limit"),
    ]
    section = report.Section("pose", [blocks.table("One pose", "A pose.", "µs", contenders, rounds=1)], 0.25, 90.0)
    text = report.render("2026-01-02", ["A machine."], [section], quick=True)
    assert "| One pose | armlab forward | 2 of writing | 3 | met |" in text
    assert re.search(r"\| One pose \| Peer \| 0\.000667 .*\| 0\.0005 \| \*\*missed\*\*: reason unknown \|", text)
    assert "| Peer | 3000 | 3000 | 3000–3000 |" in text
    assert "| pose | 90 | 0.25 |" in text, "how long it took"
    assert "armlab reaches 50 % of this limit" in text
    assert "other processes used 0.25 cores" in text
    assert "The machine was shared" in text
    assert "quick run" in text
    quiet = report.render("2026-01-02", [], [report.Section("pose", section.tables, 0.02)])
    assert "quick run" not in quiet
    assert "shared" not in quiet


@pytest.mark.slow
def test_environment_follows_what_is_installed(harness: dict[str, ModuleType]) -> None:
    environment = harness["environment"]
    assert environment.fingerprint() == environment.fingerprint()
    assert not environment.is_inside(), "the tests run in another environment"


def test_peers_are_pinned_by_name_and_version_only() -> None:
    for name in ("requirements.txt", "requirements_no_deps.txt", "requirements_heavy.txt"):
        lines = [line for line in (HERE / name).read_text().splitlines() if not line.startswith("#")]
        assert lines, name
        assert all(re.fullmatch(r"[\w.-]+==[\w.]+", line) for line in lines), name


def test_files_are_small_and_documented_and_benchmarks_have_one_entry() -> None:
    assert FILES
    for path in FILES:
        text = path.read_text(encoding="utf-8")
        module = ast.parse(text)
        assert ast.get_docstring(module), path.name
        assert len(text.splitlines()) <= 300, path.name
        if path.name.startswith("bench_"):
            (run,) = (n for n in module.body if isinstance(n, ast.FunctionDef) and n.name == "run")
            assert [argument.arg for argument in run.args.args] == ["quick"], path.name
            assert ast.get_docstring(run), path.name


def section(harness: dict[str, ModuleType], ours: float, theirs: float, alone: float = 1.0) -> object:
    """A benchmark with a peer, whose ratios scatter by 2 %, and one without."""
    blocks = harness["blocks"]
    spread = (0.98, 1.0, 1.02)
    peer = [
        blocks.Contender(
            "armlab forward", constant(1.0, *(ours * one for one in spread)), "armlab", bar=2.0, over="writing"
        ),
        blocks.Contender("Peer", constant(1.0, theirs, theirs, theirs), bar=0.5),
        blocks.Contender("writing", constant(1.0, 1.0, 1.0, 1.0), "limit"),
    ]
    lone = [blocks.Contender("armlab alone", constant(1.0, *(alone * one for one in spread)), "armlab")]
    tables = [blocks.table("One pose", "", "s", peer, rounds=3), blocks.table("Alone", "", "s", lone, rounds=3)]
    return harness["report"].Section("pose", tables, 0.0)


@pytest.fixture
def baseline(harness: dict[str, ModuleType], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    """The module, with its own file that contains one run."""
    baseline = harness["baseline"]
    monkeypatch.setattr(baseline, "PATH", tmp_path / "baseline.json")
    baseline.store("2026-01-02", "Fast.", [section(harness, 1.0, 4.0)])
    return baseline


def test_baseline_compares_ratios_of_any_machine_and_times_of_the_same(
    harness: dict[str, ModuleType], baseline: ModuleType
) -> None:
    elsewhere = baseline.compare("Slow.", [section(harness, 3.0, 12.0, alone=3.0)], whole=True)
    assert [(one.contender, one.kind, one.is_clear) for one in elsewhere.changes] == [("Peer", "ratio", False)]
    assert (elsewhere.gone, elsewhere.new) == ([], []), "a time is there, and not compared"
    here = baseline.compare("Fast.", [section(harness, 1.0, 4.0, alone=1.5)], whole=True)
    assert [(one.contender, one.is_clear) for one in here.changes] == [("Peer", False), ("armlab alone", True)]
    assert here.changes[1].times == pytest.approx(1.5)


def test_baseline_compares_values_that_are_no_times_on_any_machine(
    harness: dict[str, ModuleType], baseline: ModuleType
) -> None:
    def errors(newtons: float) -> object:
        contenders = [harness["blocks"].Contender("estimate", constant(1.0, newtons), "armlab")]
        table = harness["blocks"].table("Force", "", "N", contenders, rounds=1)
        return harness["report"].Section("force", [table], 0.0)

    baseline.store("2026-01-02", "Fast.", [errors(1.0)])
    (change,) = baseline.compare("Slow.", [errors(2.0)], whole=True).changes
    assert (change.kind, change.times, change.is_clear) == ("value", 2.0, True)


def test_baseline_names_what_became_slower(harness: dict[str, ModuleType], baseline: ModuleType) -> None:
    text = "\n".join(baseline.render(baseline.compare("Slow.", [section(harness, 2.0, 4.0)], whole=True)))
    assert re.search(r"1 differ by more than 10 % with disjoint quartiles .*, 1 of them for the worse", text)
    assert "| One pose | Peer | ratio | 0.25 | 0.5 | 2.00 |" in text
    better = "\n".join(baseline.render(baseline.compare("Slow.", [section(harness, 0.5, 4.0)], whole=True)))
    assert re.search(r"1 differ by more than 10 % with disjoint quartiles .*, 0 of them for the worse", better)


def test_what_was_measured_once_must_change_by_half(harness: dict[str, ModuleType]) -> None:
    def is_clear(before: tuple[float, ...], now: tuple[float, ...]) -> bool:
        return harness["baseline"].Change("Path", "armlab", "time", before, now).is_clear

    assert is_clear((1.0, 0.9, 1.1), (1.4, 1.3, 1.5))
    assert not is_clear((1.0, 1.0, 1.0), (1.4, 1.4, 1.4)), "its noise is not known"
    assert is_clear((1.0, 1.0, 1.0), (1.6, 1.6, 1.6))
    assert not is_clear((1.0, 0.8, 1.5), (1.4, 1.3, 1.5)), "quartiles overlap"


def test_baseline_tells_what_only_one_run_has(harness: dict[str, ModuleType], baseline: ModuleType) -> None:
    part = harness["report"].Section("pose", [], 0.0)
    assert baseline.compare("Fast.", [part], whole=True).gone == ["One pose: Peer", "Alone: armlab alone"]
    assert baseline.compare("Fast.", [part], whole=False).gone == [], "only some benchmarks ran"
    baseline.store("2026-01-02", "Fast.", [part])
    assert baseline.compare("Fast.", [section(harness, 1.0, 4.0)], whole=True).new == [
        "One pose: Peer",
        "Alone: armlab alone",
    ]
    baseline.PATH.unlink()
    assert baseline.render(baseline.compare("Fast.", [part], whole=True)) == []


@pytest.mark.slow
def test_picture_has_a_row_per_table(harness: dict[str, ModuleType], tmp_path: Path) -> None:
    picture, path = harness["picture"], tmp_path / "report.png"
    sections = [section(harness, 1.0, 4.0)]
    assert picture._rows(sections, picture._over_peer) == {"One pose": [("Peer", 0.25, 0.2475, 0.2525, True)]}
    assert [dot.name for dot in picture._rows(sections, picture._over_bar)["One pose"]] == ["armlab forward", "Peer"]
    assert picture.draw("A machine.", sections, path)
    assert path.read_bytes().startswith(b"\x89PNG")
    assert not picture.draw("A machine.", [harness["report"].Section("pose", [], 0.0)], path)


def test_a_bar_of_nothing_at_all_has_no_place_in_the_picture(harness: dict[str, ModuleType]) -> None:
    """The ratio to a target of zero, such as no missing rows, is undefined."""
    one = harness["blocks"].Figure("local", "armlab", "", 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0)
    assert one.is_met
    assert harness["picture"]._over_bar(one) is None


def test_what_fails_is_run_once_more(harness: dict[str, ModuleType], monkeypatch: pytest.MonkeyPatch) -> None:
    measure, report = harness["measure"], harness["report"]

    def told(*failures: str) -> list[str]:
        tries = iter(failures)
        monkeypatch.setattr(measure, "_tried", lambda name, quick: report.Section(name, [], 0.0, failure=next(tries)))
        text = report.render("2026-01-02", [], [measure.measure("pose", False)])
        return [line for line in text.splitlines() if "failed" in line]

    assert told("") == []
    assert told("late", "") == ["**pose failed at first:** late"]
    assert told("late", "later") == ["**pose failed:** later", "**pose failed at first:** late"]


@pytest.mark.parametrize("deaf", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_what_hangs_is_ended(
    harness: dict[str, ModuleType], monkeypatch: pytest.MonkeyPatch, tmp_path: Path, deaf: bool
) -> None:
    """Also if no signal reaches it, as in a blocking compiled function; processes it started are ended too."""
    mask = "signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGALRM])" if deaf else "pass"
    (tmp_path / "bench_hangs.py").write_text(
        f"""
import pathlib, signal, subprocess, time
def run(quick):
    {mask}
    with subprocess.Popen(["sleep", "600"], start_new_session=True) as child:
        pathlib.Path({str(tmp_path / "child")!r}).write_text(str(child.pid))
        try:
            while True:
                try:
                    time.sleep(600)
                except Exception:
                    pass
        finally:
            child.kill()
"""
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr(harness["measure"], "LIMIT", 3.0 if deaf else 1.0)
    monkeypatch.setattr(harness["measure"], "GRACE", 2.0 if deaf else 60.0)
    failure = harness["measure"]._tried("hangs", False).failure
    assert failure == ("TimeoutError: took more than 3 s" if deaf else "TooLong: took more than 1 s")
    until(lambda: is_over((tmp_path / "child").read_text()))


def is_over(pid: str) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True


@pytest.fixture
def run(harness: dict[str, ModuleType], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> ModuleType:
    """`run.py` in an empty repository, on a machine without peers."""
    (tmp_path / "docs" / "_static").mkdir(parents=True)
    (tmp_path / "benchmarks").mkdir()
    run = harness["run"]
    monkeypatch.setattr(run, "HERE", tmp_path / "benchmarks")
    monkeypatch.setattr(run, "DOCS", tmp_path / "docs")
    monkeypatch.setattr(harness["environment"], "ROOT", tmp_path)
    monkeypatch.setattr(harness["baseline"], "PATH", tmp_path / "benchmarks" / "baseline.json")
    monkeypatch.setattr(harness["machine"], "describe", lambda: ["Fast.", "peer 1.0."])
    monkeypatch.setattr(harness["picture"], "draw", lambda head, sections, path: path.write_bytes(b"drawn") > 0)
    return run


def test_second_run_is_compared_with_the_published_one(
    harness: dict[str, ModuleType], run: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    short, page = run.DOCS / "benchmarks.md", run.DOCS / "benchmarks_all.md"
    picture = run.DOCS / "_static" / "benchmarks.png"

    def measured(ours: float, failure: str = "", publish: bool = True) -> int:
        made = {"pose": section(harness, ours, 4.0), "lie": harness["report"].Section("lie", [], 0.0, failure=failure)}
        monkeypatch.setattr(harness["measure"], "measure", lambda name, quick: made[name])
        return run._measured(list(made), False, False, publish)

    assert (measured(1.0, failure="Disagreement"), measured(1.0, publish=False)) == (1, 0)
    assert not any(one.exists() for one in (short, page, picture, harness["baseline"].PATH)), (
        "a failure, and not asked for"
    )
    assert measured(1.0) == 0
    first = page.read_text(encoding="utf-8")
    assert "Fast." in first
    assert "(_static/benchmarks.png)" in first
    assert "Compared with the baseline" not in first
    assert picture.read_bytes() == b"drawn"
    assert "| One pose | 1 s | Peer | 0.25 | 2 of 2 |" in short.read_text(encoding="utf-8")
    assert measured(2.0) == 0
    assert "| One pose | Peer | ratio | 0.25 | 0.5 | 2.00 |" in page.read_text(encoding="utf-8")
    assert measured(2.0) == 0
    assert "0 differ by more than 10 %" in page.read_text(encoding="utf-8"), "with the last one published"
    assert "Measuring lie (2 of 2, 0 min) ..." in capsys.readouterr().out
