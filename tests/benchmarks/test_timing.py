import json
from itertools import groupby
from typing import Any

import pytest
import torch
from timing import Bar, Conditions, Spread, Timing, alternate, measure, save, table


class FakeClock:
    """A clock that only candidates advance, on a machine that becomes slower; it records the calls."""

    def __init__(self, slowdown: float = 0.0):
        self.now, self.slowdown = 0.0, slowdown
        self.log: list[str] = []

    def __call__(self) -> float:
        return self.now

    def candidate(self, name: str, seconds: float):
        def call() -> None:
            self.log.append(name)
            self.now += seconds * (1 + self.slowdown * self.now)

        return call


@pytest.mark.quick
@pytest.mark.parametrize("seconds", [1e-7, 0.2])
def test_twice_the_work_has_a_ratio_of_two(seconds):
    clock = FakeClock(slowdown=0.001)
    candidates = {"once": clock.candidate("once", seconds), "twice": clock.candidate("twice", 2 * seconds)}
    once, twice = measure(candidates, references=["once"], clock=clock)
    assert once.milliseconds.lower == pytest.approx(1e3 * seconds, rel=0.05)
    assert once.ratios["once"] == Spread(1, 1, 1)
    assert twice.ratios["once"].median == pytest.approx(2, rel=0.01)


@pytest.mark.quick
def test_candidates_take_turns_and_slow_ones_have_three_rounds():
    clock = FakeClock()
    candidates = {name: clock.candidate(name, s) for name, s in {"a": 0.1, "b": 0.1, "slow": 2.0}.items()}
    *_, slow = measure(candidates, references=["a"], clock=clock)
    turns = [name for name, _ in groupby(clock.log)]
    assert turns == ["a", "b", "slow"] * 4 + ["a", "b"] * 12  # a trial, then 15 rounds
    assert slow.milliseconds == Spread(2e3, 2e3, 2e3)


@pytest.mark.quick
def test_long_calls_alternate_after_one_untimed_round():
    clock = FakeClock(slowdown=1.0)  # the time doubles with every second
    candidates = {"one": clock.candidate("one", 1.0), "two": clock.candidate("two", 2.0)}
    one, two = alternate(candidates, reference="one", rounds=3, clock=clock)
    assert clock.log == ["one", "two"] * 4
    # The clock shows 1 and 5 s after the untimed calls, then 11, 35; 71, 215; 431, 1295 s.
    assert (one.milliseconds.median, two.milliseconds.median) == (36e3, 144e3)
    assert two.ratios["one"] == Spread(4, 4, 4)
    (single,) = alternate({"one": clock.candidate("one", 1.0)}, reference="one", rounds=1, clock=clock)
    assert single.ratios["one"] == Spread(1, 1, 1)


@pytest.mark.quick
def test_invalid_measurements_raise_and_restore_the_number_of_threads(on_threads):
    on_threads(2)
    candidates = {"fine": lambda: None, "broken": lambda: 1 / 0}
    cases: tuple[tuple[dict[str, Any], type[Exception], str], ...] = (
        ({"references": ["fine"], "repeats": 14}, ValueError, "repeats must be at least 15, got 14"),
        ({"references": ["other"]}, ValueError, r"references must be among the candidates, got \['other'\]"),
        ({"references": ["fine"]}, RuntimeError, "candidate 'broken' failed: ZeroDivisionError"),
    )
    for options, error, message in cases:
        with pytest.raises(error, match=message):
            measure(candidates, threads=1, **options)
    assert torch.get_num_threads() == 2


@pytest.mark.quick
def test_a_saved_run_contains_timings_conditions_and_bars(tmp_path):
    path, conditions = tmp_path / "new" / "run.json", Conditions.now(torch.rand(2, 3, 5, 7), threads=1, repeats=15)
    timed = Timing("effect", 1, Spread(10.0, 9.0, 11.0), {"reference": Spread(2.0, 1.9, 2.1)})
    bars = [Bar("effect", 2.0, "<=", 3.0, "x reference"), Bar("effect", 2.0, ">=", 3.0, "x reference")]
    save(path, [timed], conditions, what="one effect", bars=bars, extra=1)
    content = json.loads(path.read_text())
    assert (content["what"], content["extra"]) == ("one effect", 1)
    assert content["timings"][0]["ratios"] == {"reference": {"median": 2.0, "lower": 1.9, "upper": 2.1}}
    assert [bar["holds"] for bar in content["bars"]] == [True, False]
    assert content["conditions"]["frame"] == [2, 3, 5, 7]
    text = table([timed], conditions)
    assert "frame 2x3x5x7 float32, 1 threads, 15 rounds" in text
    assert "2 (1.9-2.1)" in text
    assert text.endswith(table([timed]))
