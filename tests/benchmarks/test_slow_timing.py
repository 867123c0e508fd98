import pytest
import slow_timing
import timing
from slow_timing import NUM_ROUNDS, time_slow, timed
from timing import COPY, GRID_SAMPLE, Spread, Timing


class Clock:
    """A clock that candidates move on, and the names of those that were called."""

    def __init__(self):
        self.now = 0.0
        self.calls: list[str] = []

    def candidate(self, name: str, *durations: float):
        """Return a function whose calls take these seconds; the last duration holds for all further calls."""

        def call() -> None:
            self.now += durations[min(self.calls.count(name), len(durations) - 1)]
            self.calls.append(name)

        return call


@pytest.fixture
def clock(monkeypatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(slow_timing.benchmark, "timer", lambda: clock.now)

    def measure(candidates, *, references, **_) -> list[Timing]:
        return timing.measure(candidates, references=references, clock=lambda: clock.now)

    monkeypatch.setattr(slow_timing, "measure", measure)
    return clock


@pytest.mark.quick
def test_a_slow_candidate_has_the_median_least_and_most_of_three_rounds(clock):
    # Two calls of the reference warm up before each one that is timed.
    slow, reference = clock.candidate("slow", 4.0, 2.0, 3.0), clock.candidate("reference", 1.0)
    result = time_slow("slow", slow, {"reference": reference})
    assert (clock.calls.count("slow"), clock.calls.count("reference")) == (3, 9)
    assert result == Timing("slow", 1, Spread(3e3, 2e3, 4e3), {"reference": Spread(3, 2, 4)})


def test_slow_candidates_have_few_rounds_and_endless_ones_a_single_call(clock):
    candidates = {
        GRID_SAMPLE: clock.candidate(GRID_SAMPLE, 0.1),
        COPY: clock.candidate(COPY, 0.01),
        "slow": clock.candidate("slow", 2.0),
        "fast": clock.candidate("fast", 0.2),
        "slow to start": clock.candidate("slow to start", 3.0, 0.3),
        "endless": clock.candidate("endless", 60.0),
    }
    timings, notes = timed(candidates, repeats=15, threads=1)
    assert {t.name: t.ratios[GRID_SAMPLE].median for t in timings} == pytest.approx(
        {GRID_SAMPLE: 1, COPY: 0.1, "slow": 20, "fast": 2, "slow to start": 3, "endless": 600}
    )
    assert [t.name for t in timings] == list(candidates)
    assert notes == ["slow: median (least-most) of 3 rounds", "endless: one call"]
    assert (clock.calls.count("endless"), clock.calls.count("slow")) == (1, 2 + NUM_ROUNDS)


def test_a_slow_reference_is_timed_like_a_fast_candidate(clock):
    candidates = {GRID_SAMPLE: clock.candidate(GRID_SAMPLE, 1.0), COPY: clock.candidate(COPY, 0.1)}
    timings, notes = timed(candidates, repeats=15, threads=1)
    assert timings[0].ratios[COPY].median == pytest.approx(10)
    assert notes == []
