import looks
import pytest
import timing
from looks import timed
from timing import COPY, GRID_SAMPLE, Spread, Timing


class Hand:
    """A clock that candidates move on, and who was called."""

    def __init__(self):
        self.now = 0.0
        self.calls: list[str] = []

    def candidate(self, name: str, *lengths: float):
        """Takes so many seconds in its first calls, the last of them in all others."""

        def call() -> None:
            self.now += lengths[min(self.calls.count(name), len(lengths) - 1)]
            self.calls.append(name)

        return call


@pytest.fixture
def hand(monkeypatch) -> Hand:
    hand = Hand()
    monkeypatch.setattr(looks.benchmark, "timer", lambda: hand.now)

    def measure(candidates, *, references, **_) -> list[Timing]:
        found = timing.measure(candidates, references=references, clock=lambda: hand.now)
        return found

    monkeypatch.setattr(looks, "measure", measure)
    return hand


def test_a_slow_candidate_is_looked_at_three_times(monkeypatch):
    clock = iter(range(1000))
    monkeypatch.setattr(looks.benchmark, "timer", lambda: float(next(clock)))
    calls = []
    found = looks.glance("slow", lambda: calls.append("slow"), {"reference": lambda: calls.append("reference")})
    assert calls.count("slow") == 3
    assert calls.count("reference") == 9
    assert found == Timing("slow", 1, Spread(1e3, 1e3, 1e3), {"reference": Spread(1, 1, 1)})


def test_few_looks_tell_the_median_and_both_ends(monkeypatch):
    ticks = iter([0.0, 4.0, 10.0, 11.0, 20.0, 22.0, 30.0, 31.0, 40.0, 43.0, 50.0, 51.0])
    monkeypatch.setattr(looks.benchmark, "timer", lambda: next(ticks))
    found = looks.glance("slow", lambda: None, {"reference": lambda: None})
    assert found.milliseconds == Spread(3e3, 2e3, 4e3)
    assert found.ratios["reference"] == Spread(3.0, 2.0, 4.0)


def test_the_slow_have_few_rounds_and_the_endless_one(hand):
    found = {
        GRID_SAMPLE: hand.candidate(GRID_SAMPLE, 0.1),
        COPY: hand.candidate(COPY, 0.01),
        "slow": hand.candidate("slow", 2.0),
        "quick": hand.candidate("quick", 0.2),
        "slow to start": hand.candidate("slow to start", 3.0, 0.3),
        "endless": hand.candidate("endless", 60.0),
    }
    timings, notes = timed(found, repeats=15, threads=1)
    assert [t.name for t in timings] == list(found)
    ratios = {t.name: t.ratios[GRID_SAMPLE].median for t in timings}
    assert ratios == pytest.approx(
        {GRID_SAMPLE: 1, COPY: 0.1, "slow": 20, "quick": 2, "slow to start": 3, "endless": 600}
    )
    assert notes == ["slow: median (least-most) of 3 rounds", "endless: one call"]
    assert hand.calls.count("endless") == 1
    assert hand.calls.count("slow") == 2 + looks.LOOKS


def test_a_slow_reference_is_measured_like_all_others(hand):
    found = {GRID_SAMPLE: hand.candidate(GRID_SAMPLE, 1.0), COPY: hand.candidate(COPY, 0.1)}
    timings, notes = timed(found, repeats=15, threads=1)
    assert timings[0].ratios[COPY].median == pytest.approx(10)
    assert notes == []
