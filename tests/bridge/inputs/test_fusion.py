"""The newest of every source at each tick: ages, gaps, staleness, clocks."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from armlab.bridge import Fusion, Held, Reading, Source, TimerSource
from armlab.errors import ConfigError
from armlab.log import Column

MS = 1_000_000
P = {"p": Column(unit="m")}


class Scripted(Source):
    """Readings at given times; what `newest` returns depends on the time of the tick alone."""

    def __init__(self, name: str, times_ns: np.ndarray, clock_ns: int = 0, lost: tuple[int, ...] = (), **options: Any):
        super().__init__(name, P, **options)
        kept = [seq for seq in range(len(times_ns)) if seq not in lost]
        self.arrivals = times_ns[kept]
        self.readings = []
        for row, seq in enumerate(kept):
            receive = int(times_ns[seq])
            values = self.values({"p": float(seq)})
            self.readings.append(Reading(values, receive - clock_ns, receive, seq, seq - row))

    def newest(self) -> Reading | None:
        row = int(np.searchsorted(self.arrivals, self.now_ns, side="right")) - 1
        return self.readings[row] if row >= 0 else None


def scripts(seconds: float) -> list[Scripted]:
    """A force sensor at 1 kHz; a tracker at 30 Hz with jitter, lost frames, and 2 s without any."""
    rng = np.random.default_rng(3)
    force = np.arange(0, int(1e9 * seconds), MS) + rng.integers(0, MS // 20, int(1e3 * seconds))
    frames = np.arange(0, int(1e9 * seconds), 33_333_333)
    stall = (frames > 3e9) & (frames < 5e9)
    track = (frames + rng.integers(0, 12 * MS, len(frames)))[~stall]
    return [
        Scripted("force", force, clock_ns=10**15, period=0.001, role="required"),
        Scripted("tracker", track, lost=(5, 6, 40), period=1 / 30),
    ]


def test_ages_of_the_specified_cell() -> None:
    """Two arms at 4.032 and 4.000 ms look at both: ages, freshness, gaps and staleness are the truth's, to 0.2 ms."""
    made, fusion = scripts(8.0), [Fusion(scripts(8.0)) for _ in range(2)]
    for one, period in zip(fusion, (4_032_000, 4_000_000), strict=True):
        last: dict[str, int] = {}
        for now in range(100 * MS, int(7.9e9), period):
            held = one.tick(now)
            for source in made:
                got = held[source.name]
                row = int(np.searchsorted(source.arrivals, now, side="right")) - 1
                truth = 1e-9 * (now - source.arrivals[row])
                assert abs(got.age - truth) < 0.2e-3
                assert got.fresh == (last.get(source.name) != row)
                assert got.stale == (truth > source.max_age)
                assert np.isnan(got["p"]) == got.stale
                assert got.kept["p"] == source.readings[row].values["p"]
                assert got.gaps == source.readings[row].gaps
                last[source.name] = row
            assert one.missing == ""
            assert abs(held["force"].mapped_ns - held["force"].receive_ns) < 0.2 * MS


def test_stale_sources_are_told_and_a_required_one_is_missing() -> None:
    told: list[str] = []
    source = Scripted("force", np.array([0, MS, 100 * MS, 101 * MS]), period=0.001, role="required")
    fusion = Fusion([source], lambda text, warn=False: told.append(text))
    never = Fusion([Scripted("late", np.array([10 * MS]), period=0.001, role="required")])
    never.tick(0)
    assert never.missing == "late"
    missing = []
    for now in (2 * MS, 20 * MS, 22 * MS, 60 * MS, 101 * MS):
        fusion.tick(now)
        missing.append(fusion.missing)
    assert missing == ["", "", "force", "force", ""]
    assert told == ["The source force is stale: its last reading is 0.021 s old.", "The source force is back."]


def test_what_was_never_seen() -> None:
    held = Fusion([Scripted("late", np.array([10 * MS]), period=0.001)]).tick(0)["late"]
    assert isinstance(held, Held)
    assert held.age == float("inf")
    assert (held.fresh, held.stale, held.receive_ns) == (False, True, 0)
    assert np.isnan(held["p"])


def test_a_source_that_breaks_its_promises_grows_old() -> None:
    told: list[str] = []

    class Broken(Source):
        def newest(self) -> Any:
            k = self.now_ns // MS
            if k == 0:
                return Reading(self.values({"p": 1.0}), 0, self.now_ns, 0)
            if k < 50:
                raise OSError("unplugged")
            return Reading({"p": np.zeros(3)}, 0, self.now_ns, k) if k < 60 else "nothing"

    fusion = Fusion([Broken("s", P, 0.001)], lambda text, warn=False: told.append(text))
    ages = [fusion.tick(k * MS)["s"].age for k in range(70)]
    np.testing.assert_allclose(ages, 1e-3 * np.arange(70))
    assert [text.partition(":")[0] for text in told if "problem" in text] == ["The source s has a problem"] * 3
    assert any("OSError: unplugged" in text for text in told)


@pytest.mark.parametrize(
    "wrong",
    [
        {"seq": None}, {"seq": 10**400}, {"seq": float("nan")}, {"source_ns": float("inf")}, {"source_ns": 10**400},
        {"source_ns": "1"}, {"source_ns": [1]}, {"receive_ns": None}, {"receive_ns": float("nan")}, {"gaps": "x"},
        {"values": {"p": "far"}}, {"values": {"p": np.array(1j)}}, {"values": {"p": None}}, {"values": None},
    ],
    ids=repr,
)  # fmt: skip
def test_a_reading_that_is_none_does_not_stop_the_loop(wrong: dict[str, Any]) -> None:
    told: list[str] = []

    class Odd(Source):
        def newest(self) -> Reading:
            k = self.now_ns // MS
            good = Reading(self.values({"p": 1.0}), self.now_ns, self.now_ns, k)
            return good if k != 1 else good._replace(**wrong)

    fusion = Fusion([Odd("s", P, 0.001)], lambda text, warn=False: told.append(text))
    for k in range(3):
        held = fusion.tick(k * MS)
        fusion.record(held, k * MS)
        assert held["s"]["p"] == 1.0
        assert held["s"].age == (1e-3 if k == 1 else 0.0)
    assert [text.partition(":")[0] for text in told] == ["The source s has a problem"]


def test_a_reading_stamped_in_the_future_is_stale() -> None:
    """A wall clock in place of the monotonic one: such a reading would be fresh for ever, also when its source died."""
    told: list[str] = []

    class Ahead(Source):
        def newest(self) -> Reading:
            return Reading(self.values({"p": 1.0}), 0, 10**18, 0)

    fusion = Fusion([Ahead("s", P, 0.001, role="required")], lambda text, warn=False: told.append(text))
    held = fusion.tick(10**12)["s"]
    assert held.stale
    assert np.isnan(held["p"])
    assert fusion.missing == "s"
    assert any("time.monotonic_ns()" in text for text in told)


def test_a_restart_of_the_numbers_maps_the_clock_anew() -> None:
    told: list[str] = []

    class Restarting(Source):
        def newest(self) -> Reading:
            k = self.now_ns // MS
            seq, clock = (k, 5) if k < 50 else (k - 50, 20 * MS)
            return Reading(self.values({"p": 0.0}), 10**9 + self.now_ns - clock, self.now_ns, seq)

    fusion = Fusion([Restarting("s", P, 0.001)], lambda text, warn=False: told.append(text))
    for k in range(60):
        held = fusion.tick(k * MS)["s"]
        assert abs(held.mapped_ns - k * MS) <= 5
    assert told == ["The source s began anew: number 0 after 49."]


def test_wrong_sets_of_sources() -> None:
    one, two = TimerSource("a", 0.01), TimerSource("b", 0.01)
    for sources, words in (([one, one], "different names"), ([one, two], "at most one"), ([object()], "got object")):
        with pytest.raises(ConfigError, match=words):
            Fusion(sources)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="role pacing"):
        next(Fusion([TimerSource("a", 0.01, role="optional")]).ticks(0.1))


def test_a_timer_paces_rows_without_a_robot() -> None:
    timer = TimerSource("clock", 0.002)
    fusion = Fusion([timer])
    timer.start()
    counts = [int(held["clock"]["count"]) for held in fusion.ticks(0.1)]
    assert counts == sorted(set(counts))
    assert 5 <= len(counts) <= 51
