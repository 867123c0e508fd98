"""Measure, print and save timings: what all benchmarks share.

Candidates take turns in one process. A round runs each of them once, so that a disturbance of the machine affects all
alike. A ratio is taken within a round; its median and quartiles are over the rounds. `measure` times many short calls,
`alternate` a few long ones.
"""

import argparse
import json
import os
import platform
import subprocess
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import partial
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path
from statistics import quantiles
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils import benchmark

import torchrefract as tr
from torchrefract._io import replace_file
from torchrefract.data.images import fit, read_image

Candidate = Callable[[], object]

GRID_SAMPLE = "bare grid_sample"
COPY = "copy of the frame"
RESULTS = Path(__file__).parent / "results"
TOLERANCE_PX = 0.05
ROUGH_TURBULENCE = partial(
    tr.Turbulence, amplitude_range=(1.2, 1.8), length_range=(40.0, 80.0), aperture_range=(4.0, 6.0)
)

MIN_REPEATS = 15
_SLOW_S = 0.5  # candidates that take longer run in the first rounds only
_STRETCH_S = 0.02  # shortest timed stretch, far above the resolution of the clock and the start of a thread
_MAX_CALLS = 1000
_REFERENCE_FLOW_PX = 4.0

# Warps whose flow is smooth enough for a lattice; call with `tolerance_px` and other arguments of a warp.
WARPS: dict[str, Callable[..., Any]] = {
    "mild lens": partial(tr.LensDistortion, k1_range=(-0.25, -0.25), k2_range=(0.09, 0.09), focal_range=(0.9, 0.9)),
    "thin-plate spline": tr.ThinPlateSpline,
    "Gaussian turbulence": partial(tr.Turbulence, covariance="gaussian", length_range=(40.0, 60.0)),
    "divergence-free": partial(tr.DivergenceFree, length_range=(40.0, 60.0)),
}
PHOTOMETRIC: dict[str, Callable[..., Any]] = {
    "uniform fog": tr.UniformFog,
    "heterogeneous fog": tr.HeterogeneousFog,
    "volumetric fog": partial(tr.HeterogeneousFog, mode="ray", depth=tr.GroundPlaneDepth()),
    "flare": tr.LensFlare,
    "vignetting": tr.Vignetting,
    "chromatic aberration": tr.ChromaticAberration,
    "sun glare": partial(tr.SunGlare, center_x_range=(0.3, 0.7), center_y_range=(0.1, 0.3)),
    "exposure": tr.Exposure,
    "night glow": tr.NightGlow,
    "turbulence blur": partial(
        tr.TurbulenceBlur, cn2_range=(1e-11, 1e-11), focal=4.0, depth=tr.GroundPlaneDepth(focal=4.0)
    ),
}


def effects(tolerance_px: float | None = TOLERANCE_PX) -> dict[str, Any]:
    """Return the warps within a tolerance and the photometric effects, by name."""
    warps = {name: make(tolerance_px=tolerance_px) for name, make in WARPS.items()}
    return warps | {name: make() for name, make in PHOTOMETRIC.items()}


def all_warps(*, tolerance_px: float | None = None, **options: Any) -> tr.Compose:
    """Return a composition of all warps, which samples the image once."""
    warps = [make(tolerance_px=tolerance_px) for make in WARPS.values()]
    return tr.Compose(warps, tolerance_px=tolerance_px, **options)


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
    """Time of one candidate: ms for one call, and multiples of each reference by its name."""

    name: str
    calls: int  # in one timed stretch
    milliseconds: Spread
    ratios: dict[str, Spread]


@dataclass(frozen=True)
class Bar:
    """A limit and the value that was measured against it."""

    name: str
    value: float
    sign: str  # ">=" or "<="
    limit: float
    unit: str

    @property
    def holds(self) -> bool:
        """Return True if the value satisfies the limit."""
        return self.value >= self.limit if self.sign == ">=" else self.value <= self.limit

    def __str__(self) -> str:
        verdict = "holds" if self.holds else "DOES NOT HOLD"
        return f"{self.name}: {_digits(self.value)} {self.unit}, bar {self.sign} {self.limit:g} {self.unit}: {verdict}"


@dataclass(frozen=True)
class Conditions:
    """Conditions of a run; None if unknown."""

    date: str
    commit: str | None  # ends in "-dirty" if tracked files differ from the commit
    device: str
    cpu: str | None
    load: float | None  # mean number of busy threads of the machine over the minute before
    torch: str
    python: str
    packages: dict[str, str]  # versions of the packages that change timings
    threads: int
    repeats: int
    frame: tuple[int, ...]  # (B, C, H, W)
    dtype: str

    @staticmethod
    def now(frame: Tensor, *, threads: int, repeats: int) -> "Conditions":
        """Return the conditions of a run that starts now on this frame."""
        return Conditions(
            date=datetime.now(UTC).isoformat(timespec="seconds"),
            commit=commit(),
            device=torch.cuda.get_device_name(frame.device) if frame.device.type == "cuda" else frame.device.type,
            cpu=_cpu(),
            load=os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
            torch=torch.__version__,
            python=platform.python_version(),
            packages={name: metadata.version(name) for name in ("numpy", "numba", "triton") if find_spec(name)},
            threads=threads,
            repeats=repeats,
            frame=tuple(frame.shape),
            dtype=str(frame.dtype).removeprefix("torch."),
        )


def measure(
    candidates: Mapping[str, Candidate],
    *,
    references: Sequence[str] = (GRID_SAMPLE,),
    repeats: int = MIN_REPEATS,
    slow_repeats: int = 3,
    threads: int = 1,
    clock: Callable[[], float] = benchmark.timer,
) -> list[Timing]:
    """Time all candidates in turns and return their timings, in order.

    Two untimed calls precede each timed stretch of a fast candidate, so that memory and caches are in the state of
    steady use. A candidate that takes 0.5 s or more has few rounds of one call.

    Args:
        candidates: functions to call, by name.
        references: names of the candidates to divide by.
        repeats: number of rounds, at least 15.
        slow_repeats: number of rounds of slow candidates, at least 2.
        threads: number of torch's threads on the CPU.
        clock: returns seconds; the default waits for an accelerator first.

    Raises:
        ValueError: if there are too few rounds, or a reference is not a candidate.
        RuntimeError: if a candidate fails; the message names it.
    """
    if repeats < MIN_REPEATS:
        raise ValueError(f"repeats must be at least {MIN_REPEATS}, got {repeats}")
    if missing := [name for name in references if name not in candidates]:
        raise ValueError(f"references must be among the candidates, got {missing}")
    previous = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        trials = {name: _named_seconds(name, call, 1, 1, clock) for name, call in candidates.items()}
        is_slow = {name: trials[name] >= _SLOW_S and name not in references for name in candidates}
        calls = {name: max(1, min(_MAX_CALLS, round(_STRETCH_S / max(trials[name], 1e-9)))) for name in candidates}
        rounds = [
            {
                name: _named_seconds(name, call, calls[name], 0 if is_slow[name] else 2, clock)
                for name, call in candidates.items()
                if i < slow_repeats or not is_slow[name]
            }
            for i in range(repeats)
        ]
    finally:
        torch.set_num_threads(previous)
    return [_timing(name, calls[name], [r for r in rounds if name in r], references) for name in candidates]


def alternate(
    candidates: Mapping[str, Candidate],
    *,
    reference: str,
    rounds: int,
    clock: Callable[[], float] = benchmark.timer,
) -> list[Timing]:
    """Time calls of a second or more, such as training steps: one call of each candidate in turn, once in every round.

    Args:
        candidates: functions to call, by name; each is called once before the first round.
        reference: name of the candidate to divide by.
        rounds: number of rounds.
        clock: returns seconds; the default waits for an accelerator first.
    """
    for call in candidates.values():
        call()
    times = [{name: seconds(call, clock=clock) for name, call in candidates.items()} for _ in range(rounds)]
    return [_timing(name, 1, times, [reference]) for name in candidates]


def seconds(
    call: Candidate, *, number: int = 1, warmup: int = 0, clock: Callable[[], float] = benchmark.timer
) -> float:
    """Return the seconds of one call, as the mean of `number` calls after `warmup` untimed ones."""
    for _ in range(warmup):
        call()
    start = clock()
    for _ in range(number):
        call()
    return (clock() - start) / number


def _named_seconds(name: str, call: Candidate, number: int, warmup: int, clock: Callable[[], float]) -> float:
    try:
        return seconds(call, number=number, warmup=warmup, clock=clock)
    except Exception as error:  # raised again with the name of the candidate
        raise RuntimeError(f"candidate {name!r} failed: {type(error).__name__}: {error}") from error


def _timing(name: str, calls: int, rounds: Sequence[Mapping[str, float]], references: Iterable[str]) -> Timing:
    ratios = {reference: _spread([r[name] / r[reference] for r in rounds]) for reference in references}
    return Timing(name, calls, _spread([1e3 * r[name] for r in rounds]), ratios)


def references(frame: Tensor) -> dict[str, Candidate]:
    """Return the references for a frame (B, C, H, W): a bare bilinear F.grid_sample and a copy.

    The grid is precomputed and contiguous. Like a weak lens, it samples up to 4 px toward the center, always inside the
    frame. On the CPU, F.grid_sample uses one thread for each sample of the batch.
    """
    grid = sampling_grid(_weak_lens(frame))
    return {
        GRID_SAMPLE: lambda: F.grid_sample(frame, grid, mode="bilinear", align_corners=False),
        COPY: frame.clone,
    }


def sampling_grid(flow: Tensor) -> Tensor:
    """Return the grid of F.grid_sample(align_corners=False), (B, H, W, 2), for a flow (B, 2, H, W), px."""
    height, width = flow.shape[2:]
    x = torch.arange(width, dtype=flow.dtype, device=flow.device)
    y = torch.arange(height, dtype=flow.dtype, device=flow.device)[:, None]
    u, v = flow.unbind(1)
    return torch.stack([(2 * (x + u) + 1) / width - 1, (2 * (y + v) + 1) / height - 1], dim=-1)


def _weak_lens(frame: Tensor) -> Tensor:
    """Return flow(p) = -a r^2 p / |p|_corner, (B, 2, H, W), px, with p from the center and r = 1 in the corners."""
    batch, _, height, width = frame.shape
    x = torch.arange(width, device=frame.device).float() - (width - 1) / 2
    y = torch.arange(height, device=frame.device).float()[:, None] - (height - 1) / 2
    corner = max((width - 1) ** 2 + (height - 1) ** 2, 1) ** 0.5 / 2
    inward = -_REFERENCE_FLOW_PX / corner**3 * (x * x + y * y)
    return torch.stack([inward * x, inward * y]).expand(batch, -1, -1, -1)


def table(timings: Sequence[Timing], conditions: Conditions | None = None) -> str:
    """Format the timings, median and quartiles, below the conditions of the run if they are given."""
    names = list(timings[0].ratios)
    head = ["candidate", "ms", *(f"x {name}" for name in names)]
    rows = [[t.name, str(t.milliseconds), *(str(t.ratios[name]) for name in names)] for t in timings]
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in (head, *rows)]
    rule = "  ".join("-" * width for width in widths)
    return "\n".join([*([] if conditions is None else [_describe(conditions), ""]), lines[0], rule, *lines[1:]])


def markdown(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Format rows of cells as a table in Markdown."""
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *rows))


def save(
    path: Path,
    timings: Sequence[Timing],
    conditions: Conditions,
    *,
    what: str,
    bars: Sequence[Bar] = (),
    **more: Any,
) -> None:
    """Write a run as JSON.

    Args:
        path: the file; its folder is created.
        timings, conditions: of the run.
        what: description of what was measured.
        bars: limits.
        more: other entries of the file.
    """
    content = {
        "what": what,
        "conditions": asdict(conditions),
        "timings": [asdict(timing) for timing in timings],
        "bars": [asdict(bar) | {"holds": bar.holds} for bar in bars],
        **more,
    }
    write_json(path, content)


def write_json(path: Path, content: object) -> None:
    """Write a JSON file, whose folder is created, and print its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with replace_file(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    print(f"written to {path}")


def parser(
    description: str | None, *, out: Path, frame_size: tuple[int, int] = (1080, 1920), has_real: bool = False
) -> argparse.ArgumentParser:
    """Return a parser with the options that the benchmarks share.

    Args:
        description: docstring of the script; its first line is the help text.
        out: default path of the file or folder that is written.
        frame_size: default height and width of the frames, px.
        has_real: True adds the option of `frame_of`.
    """
    options = argparse.ArgumentParser(description=(description or "").splitlines()[0])
    size_help = "height x width of the frames, {}x{}".format(*frame_size)
    options.add_argument("--size", type=size, default=frame_size, help=size_help)
    options.add_argument("--threads", type=count(1), default=2, help="threads of torch on the CPU, 2")
    options.add_argument("--repeats", type=count(MIN_REPEATS), default=MIN_REPEATS, help="rounds, 15 or more")
    options.add_argument("--out", type=Path, default=out, help=f"where to write, {out.name}")
    if has_real:
        options.add_argument("--real", type=Path, help="picture to use as the frame; the default is noise")
    return options


def frame_of(path: Path | None, size: tuple[int, int]) -> Tensor:
    """Return a picture cropped to a size, or noise if there is no path: (1, 3, H, W)."""
    return torch.rand(1, 3, *size) if path is None else fit(read_image(path), size)[None].contiguous()


def size(text: str) -> tuple[int, int]:
    """Parse HEIGHTxWIDTH, px."""
    height, width = _sides(text, 2, "HEIGHTxWIDTH in px")
    return height, width


def shape(text: str) -> tuple[int, ...]:
    """Parse BATCHxCHANNELSxHEIGHTxWIDTH."""
    return _sides(text, 4, "BATCHxCHANNELSxHEIGHTxWIDTH")


def _sides(text: str, number: int, form: str) -> tuple[int, ...]:
    sides = text.split("x")
    if len(sides) != number or not all(side.isdecimal() and int(side) for side in sides):
        raise argparse.ArgumentTypeError(f"must be {form}, got {text!r}")
    return tuple(int(side) for side in sides)


def count(low: int) -> Callable[[str], int]:
    """Return a parser of whole numbers of at least `low`."""

    def parse(text: str) -> int:
        if not text.isdecimal() or int(text) < low:
            raise argparse.ArgumentTypeError(f"must be a whole number of at least {low}, got {text!r}")
        return int(text)

    return parse


def _digits(value: float) -> str:
    """Format a number with three significant digits and without an exponent."""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def _spread(values: Sequence[float]) -> Spread:
    lower, median, upper = quantiles(values, n=4, method="inclusive") if len(values) > 1 else 3 * list(values)
    return Spread(median, lower, upper)


def _describe(conditions: Conditions) -> str:
    c = conditions
    load = "" if c.load is None else f", load before {c.load:.1f}"
    packages = "".join(f", {name} {version}" for name, version in c.packages.items())
    return "\n".join(
        [
            f"frame {'x'.join(map(str, c.frame))} {c.dtype}, {c.threads} threads, {c.repeats} rounds, on {c.device}",
            f"{c.cpu}, torch {c.torch}, Python {c.python}{packages}{load}",
            f"{c.date}, commit {c.commit}; median (quartiles)",
        ]
    )


def commit() -> str | None:
    """Return the commit of the working tree, with `-dirty` if files differ from it; None without git."""
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
