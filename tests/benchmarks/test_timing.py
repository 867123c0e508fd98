import argparse
import json
from itertools import groupby

import pytest
import timing
import torch
import torch.nn.functional as F
from timing import Bar, Conditions, Spread, Timing, measure, references, save, shape, size, table
from torch.testing import assert_close

from torchrefract import warp


class FakeClock:
    """A clock that only candidates advance, on a machine that becomes slower; it records the calls."""

    def __init__(self, slowdown: float = 0.0):
        self.now = 0.0
        self.slowdown = slowdown
        self.log: list[str] = []

    def __call__(self) -> float:
        return self.now

    def candidate(self, name: str, seconds: float):
        def call() -> None:
            self.log.append(name)
            self.now += seconds * (1 + self.slowdown * self.now)

        return call


def conditions() -> Conditions:
    return Conditions.now(torch.rand(2, 3, 5, 7), threads=1, repeats=15)


@pytest.mark.quick
@pytest.mark.parametrize("seconds", [1e-7, 3e-3, 0.2])
def test_twice_the_work_has_a_ratio_of_two(seconds):
    clock = FakeClock(slowdown=0.001)
    candidates = {"once": clock.candidate("once", seconds), "twice": clock.candidate("twice", 2 * seconds)}
    once, twice = measure(candidates, references=["once"], clock=clock)
    assert once.milliseconds.lower == pytest.approx(1e3 * seconds, rel=0.05)
    assert once.ratios["once"] == Spread(1, 1, 1)
    assert twice.ratios["once"].median == pytest.approx(2, rel=0.01)


def test_candidates_take_turns_and_slow_ones_have_three_rounds():
    clock = FakeClock()
    seconds = {"a": 0.1, "b": 0.1, "slow": 2.0}
    candidates = {name: clock.candidate(name, s) for name, s in seconds.items()}
    *_, slow = measure(candidates, references=["a"], clock=clock)
    turns = [name for name, _ in groupby(clock.log)]
    assert turns == ["a", "b", "slow"] * 4 + ["a", "b"] * 12  # a trial, then 15 rounds
    assert slow.milliseconds == Spread(2e3, 2e3, 2e3)


def test_the_number_of_threads_is_set_and_restored(on_threads):
    on_threads(2)
    threads = set()
    measure({"call": lambda: threads.add(torch.get_num_threads())}, references=["call"], threads=1)
    assert threads == {1}
    assert torch.get_num_threads() == 2


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"references": ["fine"], "repeats": 14}, ValueError, "repeats must be at least 15, got 14"),
        ({"references": ["other"]}, ValueError, r"references must be among the candidates, got \['other'\]"),
        ({"references": ["fine"]}, RuntimeError, "candidate 'broken' failed: ZeroDivisionError"),
    ],
)
def test_invalid_measurements_raise(options, error, message):
    with pytest.raises(error, match=message):
        measure({"fine": lambda: None, "broken": lambda: 1 / 0}, **options)


def test_the_bare_sampler_matches_warp_along_a_weak_lens():
    frame = torch.rand(2, 3, 24, 40)
    flow = timing._weak_lens(frame)
    assert_close(flow.norm(dim=1).max().item(), 4.0, atol=1e-4, rtol=0)
    candidates = references(frame)
    assert_close(candidates[timing.GRID_SAMPLE](), warp(frame, flow)[0])
    grid = timing.sampling_grid(flow)
    assert_close(F.grid_sample(frame, grid, align_corners=False, padding_mode="border"), warp(frame, flow)[0])
    copy = candidates[timing.COPY]()
    assert isinstance(copy, torch.Tensor)
    assert torch.equal(copy, frame)
    assert copy.data_ptr() != frame.data_ptr()


def test_a_saved_run_contains_timings_conditions_and_bars(tmp_path, capsys):
    path = tmp_path / "new" / "run.json"
    timed = Timing("effect", 1, Spread(10.0, 9.0, 11.0), {"reference": Spread(2.0, 1.9, 2.1)})
    bar = Bar("effect", 2.0, "<=", 3.0, "x reference")
    save(path, [timed], conditions(), what="one effect", bars=[bar], extra=1)
    content = json.loads(path.read_text())
    assert (content["what"], content["extra"]) == ("one effect", 1)
    assert content["timings"][0]["ratios"] == {"reference": {"median": 2.0, "lower": 1.9, "upper": 2.1}}
    assert content["bars"][0]["holds"] is True
    assert content["conditions"]["frame"] == [2, 3, 5, 7]
    assert f"written to {path}" in capsys.readouterr().out
    text = table([timed], conditions())
    assert "frame 2x3x5x7 float32, 1 threads, 15 rounds" in text
    assert "2 (1.9-2.1)" in text


def test_sizes_and_shapes_are_parsed():
    assert size("1080x1920") == (1080, 1920)
    assert shape("16x3x1080x1920") == (16, 3, 1080, 1920)
    for parse, text in ((size, "1080"), (size, "0x5"), (shape, "3x4x5"), (shape, "1x3xax5")):
        with pytest.raises(argparse.ArgumentTypeError, match="must be"):
            parse(text)
