"""How everything here is timed: candidates take turns in one process, and each is told as a multiple of a reference.

A round runs every candidate once, so that what disturbs the machine disturbs all alike; a ratio is taken within a
round, and its median and quartiles over the rounds. The stretch that is timed follows two calls that are not, which
bring memory and caches to the state that steady use of that candidate alone would have; a short candidate is called
several times in it.

Where the C library allows, memory that is freed stays with the process. By default glibc gives it back and takes it
anew once enough is free at the top of its heap, which depends on what ran before: page faults would then be counted
against any candidate that is unlucky.
"""

import json
import os
import platform
import subprocess
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from statistics import quantiles
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils import benchmark

from torchrefract._io import replace_file
from torchrefract._memory import keep_freed_memory
from torchrefract.warping.grid import pixel_axes, sampler_grid

Candidate = Callable[[], object]

GRID_SAMPLE = "bare grid_sample"
COPY = "copy of the frame"

FEWEST_REPEATS = 15
_STRETCH_S = 0.02  # a timed stretch lasts this long at least: far above the clock's grain and a thread's start
_MOST_CALLS = 1000
_REFERENCE_FLOW_PX = 4.0
_OPENCV = ("opencv-contrib-python-headless", "opencv-contrib-python", "opencv-python-headless", "opencv-python")


@dataclass(frozen=True)
class Spread:
    """Median and quartiles over the rounds."""

    median: float
    lower: float
    upper: float

    def __str__(self) -> str:
        return f"{_digits(self.median)} ({_digits(self.lower)}-{_digits(self.upper)})"


@dataclass(frozen=True)
class Timing:
    """What one candidate took: ms a call, and multiples of each reference by its name."""

    name: str
    calls: int  # in one timed stretch
    milliseconds: Spread
    ratios: dict[str, Spread]


@dataclass(frozen=True)
class Bar:
    """What an issue asks for, beside what was measured."""

    name: str
    value: float
    sign: str  # ">=" or "<="
    limit: float
    unit: str

    @property
    def holds(self) -> bool:
        """Whether the measured value keeps the limit."""
        return self.value >= self.limit if self.sign == ">=" else self.value <= self.limit

    def __str__(self) -> str:
        verdict = "holds" if self.holds else "DOES NOT HOLD"
        return f"{self.name}: {_digits(self.value)} {self.unit}, bar {self.sign} {self.limit:g} {self.unit}: {verdict}"


@dataclass(frozen=True)
class Conditions:
    """What a timing depends on beside the code, None where it cannot be known."""

    date: str
    commit: str | None  # with "-dirty" behind it where tracked files differ from the commit
    device: str
    cpu: str | None
    keeps_freed_memory: bool
    load: float | None  # of the machine when the run began: mean number of busy threads over a minute
    torch: str
    python: str
    opencv: str | None
    threads: int
    repeats: int
    frame: tuple[int, ...]  # (B, C, H, W)
    dtype: str

    @staticmethod
    def now(frame: Tensor, *, threads: int, repeats: int) -> "Conditions":
        """Those of a run that starts now, on this frame."""
        return Conditions(
            date=datetime.now(UTC).isoformat(timespec="seconds"),
            commit=_commit(),
            device=torch.cuda.get_device_name(frame.device) if frame.device.type == "cuda" else frame.device.type,
            cpu=_cpu(),
            keeps_freed_memory=keep_freed_memory(),
            load=os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
            torch=torch.__version__,
            python=platform.python_version(),
            opencv=_opencv(),
            threads=threads,
            repeats=repeats,
            frame=tuple(frame.shape),
            dtype=str(frame.dtype).removeprefix("torch."),
        )


def measure(
    candidates: Mapping[str, Candidate],
    *,
    references: Sequence[str],
    repeats: int = FEWEST_REPEATS,
    threads: int = 1,
    clock: Callable[[], float] = benchmark.timer,
) -> list[Timing]:
    """What each candidate takes, in their order.

    Args:
        candidates: what to call, by name.
        references: the candidates that ratios are taken to.
        repeats: rounds, at least 15.
        threads: of torch, on the CPU.
        clock: seconds; the default waits for an accelerator to finish before it looks.

    Raises:
        ValueError: too few rounds; a reference that is no candidate.
        RuntimeError: a candidate that fails, named.
    """
    if repeats < FEWEST_REPEATS:
        raise ValueError(f"repeats must be at least {FEWEST_REPEATS}, got {repeats}")
    if unknown := [name for name in references if name not in candidates]:
        raise ValueError(f"references must be among the candidates, got {unknown}")

    def seconds(name: str, calls: int) -> float:
        timer = benchmark.Timer("call()", globals={"call": candidates[name]}, timer=clock, num_threads=threads)
        try:
            return timer.timeit(calls).median
        except Exception as error:  # raised again, with the candidate's name
            raise RuntimeError(f"candidate {name!r} failed: {type(error).__name__}: {error}") from error

    calls = {name: _calls(seconds(name, 1)) for name in candidates}
    rounds = [{name: seconds(name, calls[name]) for name in candidates} for _ in range(repeats)]
    return [
        Timing(
            name,
            calls[name],
            milliseconds=_spread(1e3 * times[name] for times in rounds),
            ratios={reference: _spread(times[name] / times[reference] for times in rounds) for reference in references},
        )
        for name in candidates
    ]


def references(frame: Tensor) -> dict[str, Candidate]:
    """What the work on a frame (B, C, H, W) is held against: a bare bilinear F.grid_sample, and a copy.

    The grid is ready made, contiguous, and looks up to 4 px inward, in the frame everywhere, as a weak lens does. On
    the CPU F.grid_sample threads over the batch alone, so a single frame keeps one thread busy.
    """
    grid = sampler_grid(_weak_lens(frame)).contiguous()
    return {
        GRID_SAMPLE: lambda: F.grid_sample(frame, grid, mode="bilinear", align_corners=False),
        COPY: frame.clone,
    }


def table(timings: Sequence[Timing], conditions: Conditions) -> str:
    """The timings for a person to read, median and quartiles, under what they were taken with."""
    held_against = list(timings[0].ratios)
    head = ["candidate", "ms", *(f"x {name}" for name in held_against)]
    rows = [[t.name, str(t.milliseconds), *(str(t.ratios[name]) for name in held_against)] for t in timings]
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in (head, *rows)]
    rule = "  ".join("-" * width for width in widths)
    return "\n".join([_describe(conditions), "", lines[0], rule, *lines[1:]])


def save(path: Path, timings: Sequence[Timing], conditions: Conditions, *, what: str, bars: Sequence[Bar] = ()) -> None:
    """A run as JSON, the file there whole or not at all; its folder is made.

    Args:
        path: the file.
        timings, conditions: of the run.
        what: what was compared, in words.
        bars: the limits it was held against.
    """
    content: dict[str, Any] = {
        "what": what,
        "conditions": asdict(conditions),
        "timings": [asdict(timing) for timing in timings],
        "bars": [asdict(bar) | {"holds": bar.holds} for bar in bars],
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with replace_file(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def _digits(value: float) -> str:
    """Three digits that count, none of them as a power of ten."""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def _calls(seconds: float) -> int:
    return max(1, min(_MOST_CALLS, round(_STRETCH_S / max(seconds, 1e-9))))


def _spread(values: Iterable[float]) -> Spread:
    lower, median, upper = quantiles(values, n=4, method="inclusive")
    return Spread(median, lower, upper)


def _weak_lens(frame: Tensor) -> Tensor:
    """(B, 2, H, W), px: flow(p) = -a r^2 p / |p|_corner, p from the center and r = 1 in the corners."""
    batch, _, height, width = frame.shape
    x, y = pixel_axes(height, width, dtype=torch.float32, device=frame.device)
    x, y = x - (width - 1) / 2, y - (height - 1) / 2
    corner = max((width - 1) ** 2 + (height - 1) ** 2, 1) ** 0.5 / 2
    inward = -_REFERENCE_FLOW_PX / corner**3 * (x * x + y * y)
    return torch.cat([inward * x, inward * y], dim=1).expand(batch, -1, -1, -1)


def _describe(conditions: Conditions) -> str:
    c = conditions
    busy = "" if c.load is None else f", load before {c.load:.1f}"
    return "\n".join(
        [
            f"frame {'x'.join(map(str, c.frame))} {c.dtype}, {c.threads} threads, {c.repeats} rounds, on {c.device}",
            f"{c.cpu}, torch {c.torch}, Python {c.python}, OpenCV {c.opencv}{busy}",
            f"freed memory {'stays with the process' if c.keeps_freed_memory else 'goes as the C library has it'}",
            f"{c.date}, commit {c.commit}; median (quartiles)",
        ]
    )


def _commit() -> str | None:
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    try:
        done = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return None
    return done.stdout.strip()


def _cpu() -> str | None:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, platform.processor() or None)


def _opencv() -> str | None:
    for name in _OPENCV:
        try:
            return metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return None
