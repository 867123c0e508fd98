import json
import platform
import subprocess
import sys
from dataclasses import FrozenInstanceError
from itertools import groupby
from pathlib import Path

import pytest
import timing
import torch
from timing import Bar, Conditions, Spread, Timing, measure, references, save, table
from torch.testing import assert_close

from torchrefract.warping.warp import warp

BENCHMARKS = Path(timing.__file__).parent


class FakeClock:
    """A clock that only work moves on, on a machine whose speed may drift; it counts who worked, and when."""

    def __init__(self, drift: float = 0.0):
        self.now = 0.0
        self.drift = drift
        self.log: list[str] = []

    def __call__(self) -> float:
        return self.now

    def work(self, name: str, seconds: float):
        def call() -> None:
            self.log.append(name)
            self.now += seconds * (1 + self.drift * self.now)

        return call


@pytest.fixture
def conditions() -> Conditions:
    return Conditions.now(torch.rand(2, 3, 5, 7), threads=1, repeats=15)


def timed(name: str = "effect", ratio: float = 2.0) -> Timing:
    return Timing(name, 1, Spread(10.0, 9.0, 11.0), {"reference": Spread(ratio, ratio - 0.1, ratio + 0.1)})


@pytest.mark.parametrize("seconds", [1e-7, 3e-3, 0.5])
def test_twice_the_work_has_a_ratio_of_two(seconds):
    clock = FakeClock()
    candidates = {"once": clock.work("once", seconds), "twice": clock.work("twice", 2 * seconds)}
    once, twice = measure(candidates, references=["once"], clock=clock)
    for name, timing_, times in (("once", once, 1), ("twice", twice, 2)):
        assert timing_.name == name
        assert timing_.milliseconds.median == pytest.approx(1e3 * times * seconds, rel=1e-6)
        assert timing_.ratios["once"].median == pytest.approx(times, rel=1e-6)


def test_a_machine_that_slows_down_leaves_the_ratio_as_it_is():
    clock = FakeClock(drift=0.01)
    candidates = {"once": clock.work("once", 0.1), "twice": clock.work("twice", 0.2)}
    once, twice = measure(candidates, references=["once"], clock=clock)
    assert once.milliseconds.upper > 1.05 * once.milliseconds.lower
    assert twice.ratios["once"].median == pytest.approx(2, rel=0.02)
    assert twice.ratios["once"].upper - twice.ratios["once"].lower < 0.01


def test_one_disturbed_round_does_not_show_in_median_and_quartiles():
    clock = FakeClock()
    disturbed = iter(range(10**6))

    def call() -> None:
        clock.now += 5.0 if next(disturbed) == 20 else 0.1

    steady, shaken = measure({"steady": clock.work("steady", 0.1), "shaken": call}, references=["steady"], clock=clock)
    assert_close(torch.tensor([shaken.ratios["steady"].lower, shaken.ratios["steady"].upper]), torch.ones(2))
    assert shaken.milliseconds.median == pytest.approx(steady.milliseconds.median)


def test_candidates_take_turns():
    clock = FakeClock()
    measure({name: clock.work(name, 1.0) for name in "abc"}, references=["a"], repeats=15, clock=clock)
    warm_up_and_rounds = 1 + 15
    assert [name for name, _ in groupby(clock.log)] == list("abc") * warm_up_and_rounds


def test_a_short_candidate_is_called_often_and_a_long_one_once():
    clock = FakeClock()
    short, long = measure(
        {"short": clock.work("short", 1e-3), "long": clock.work("long", 1.0)}, references=["long"], clock=clock
    )
    assert (short.calls, long.calls) == (20, 1)


def test_threads_are_those_asked_for_and_are_set_back(on_threads):
    on_threads(2)
    seen = set()
    measure({"look": lambda: seen.add(torch.get_num_threads())}, references=["look"], threads=1)
    assert seen == {1}
    assert torch.get_num_threads() == 2


def test_a_failing_candidate_is_named():
    def fail() -> None:
        raise KeyError("no lens")

    with pytest.raises(RuntimeError, match="candidate 'broken' failed: KeyError: 'no lens'"):
        measure({"fine": lambda: None, "broken": fail}, references=["fine"])


def test_too_few_rounds_are_refused():
    with pytest.raises(ValueError, match="repeats must be at least 15, got 14"):
        measure({"a": lambda: None}, references=["a"], repeats=14)


def test_a_reference_must_be_a_candidate():
    with pytest.raises(ValueError, match=r"references must be among the candidates, got \['b'\]"):
        measure({"a": lambda: None}, references=["b"])


@pytest.mark.parametrize("size", [(1, 1), (24, 40)])
def test_the_bare_sampler_looks_inward_in_the_frame_by_4_px_at_most(monkeypatch, size):
    grids = []
    monkeypatch.setattr(timing.F, "torch", lambda frame, grid, **_: grids.append(grid))
    references(torch.rand(2, 3, *size))[timing.GRID_SAMPLE]()
    grid = grids[0]
    assert grid.shape == (2, *size, 2)
    assert grid.is_contiguous()
    height, width = size
    position = ((grid + 1) * torch.tensor([width, height]) - 1) / 2
    last = torch.tensor([width - 1, height - 1])
    assert ((position >= -1e-4) & (position <= last + 1e-4)).all()
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    moved = position - torch.stack([columns, rows], dim=-1)
    length = 4.0 if height * width > 1 else 0.0
    assert_close(moved.norm(dim=-1).amax().item(), length, atol=1e-4, rtol=0)
    assert_close(moved[:, 0, 0], -moved[:, -1, -1], atol=1e-4, rtol=0)
    assert (moved[:, 0, 0] >= 0).all()


def test_the_references_do_a_look_up_and_a_copy():
    frame = torch.rand(1, 3, 12, 16)
    found = references(frame)
    flow = timing._weak_lens(frame)
    assert_close(found[timing.GRID_SAMPLE](), warp(frame, flow)[0])
    copy = found[timing.COPY]()
    assert isinstance(copy, torch.Tensor)
    assert torch.equal(copy, frame)
    assert copy.data_ptr() != frame.data_ptr()


def test_a_saved_run_holds_everything(tmp_path, conditions):
    path = tmp_path / "new" / "run.json"
    save(path, [timed()], conditions, what="one effect", bars=[Bar("effect", 2.0, "<=", 3.0, "x reference")])
    content = json.loads(path.read_text())
    assert content["what"] == "one effect"
    assert content["timings"] == [
        {
            "name": "effect",
            "calls": 1,
            "milliseconds": {"median": 10.0, "lower": 9.0, "upper": 11.0},
            "ratios": {"reference": {"median": 2.0, "lower": 1.9, "upper": 2.1}},
        }
    ]
    assert content["bars"] == [
        {"name": "effect", "value": 2.0, "sign": "<=", "limit": 3.0, "unit": "x reference", "holds": True}
    ]
    keys = "date commit device cpu keeps_freed_memory load torch python opencv threads repeats frame dtype"
    assert list(content["conditions"]) == keys.split()
    assert content["conditions"]["frame"] == [2, 3, 5, 7]
    assert content["conditions"]["torch"] == torch.__version__
    assert content["conditions"]["device"] == "cpu"


def test_a_run_that_cannot_be_written_leaves_the_old_file(tmp_path, conditions, monkeypatch):
    path = tmp_path / "run.json"
    save(path, [timed(ratio=2.0)], conditions, what="old")
    before = path.read_bytes()

    def full_disk(*_) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full_disk)
    with pytest.raises(OSError, match="No space left"):
        save(path, [timed(ratio=9.0)], conditions, what="new")
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_without_a_repository_there_is_no_commit(monkeypatch):
    def no_git(*_, **__):
        raise subprocess.CalledProcessError(128, "git")

    monkeypatch.setattr(subprocess, "run", no_git)
    assert Conditions.now(torch.rand(1, 3, 2, 2), threads=1, repeats=15).commit is None


@pytest.mark.parametrize(("ratio", "holds"), [(0.25, True), (0.2501, False)])
def test_a_bar_holds_up_to_its_limit(ratio, holds):
    bar = Bar("fog", ratio, "<=", 0.25, "x reference")
    assert bar.holds is holds
    assert ("DOES NOT HOLD" in str(bar)) is not holds


def test_the_table_names_each_candidate_with_its_ratio(conditions):
    text = table([timed("one", 2.0), timed("other", 0.5)], conditions)
    rows = {line.split()[0]: line for line in text.splitlines() if line.startswith(("one", "other"))}
    assert "2 (1.9-2.1)" in rows["one"]
    assert "0.5 (0.4-0.6)" in rows["other"]
    assert "frame 2x3x5x7 float32, 1 threads, 15 rounds, on cpu" in text


def test_large_ratios_are_printed_in_full():
    assert str(Spread(1234.6, 0.01234, 99.96)) == "1235 (0.0123-100)"


def test_a_timing_cannot_be_changed():
    with pytest.raises(FrozenInstanceError):
        timed().name = "other"  # pyright: ignore[reportAttributeAccessIssue]  # what is tested


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="only glibc can be told to keep freed memory")
def test_freed_memory_stays_with_the_process():
    script = """
import resource, torch, timing
faults = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_minflt
def work():
    for _ in range(5):
        kept = [torch.ones(6_000_000) for _ in range(3)]
work(); start = faults(); work(); by_default = faults() - start
assert timing.keep_freed_memory()
work(); start = faults(); work(); print(by_default, faults() - start)
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=BENCHMARKS, capture_output=True, text=True, check=True)
    by_default, kept = map(int, done.stdout.split())
    assert by_default > 1000
    assert kept < 100
