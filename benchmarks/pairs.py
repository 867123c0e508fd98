"""Time the writing of pairs, and the effects in a worker of a DataLoader, by frame size, and by their peak memory.

python benchmarks/pairs.py --source DIR [--scene paper_refractive] [--count 200] [--size 360x640] [--workers 1 2]
    [--engines local ray] [--rounds 1] [--tar 25] [--maps png] [--listing 300000] [--only written]
    [--out benchmarks/results/pairs.json]
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import fmean, median
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from timing import RESULTS, count, seconds, size, write_json
from torch.profiler import ProfilerActivity, profile
from torch.utils.benchmark import Timer
from torch.utils.data import DataLoader, Dataset

from torchrefract import (
    DivergenceFree,
    HeterogeneousFog,
    LensDistortion,
    LensFlare,
    ThinPlateSpline,
    Turbulence,
    UniformFog,
)
from torchrefract._io import CONFIG_DIR
from torchrefract.data.pairs.files import FORMATS, decode_pair, encode_pair
from torchrefract.data.pairs.generator import (
    PairGenerator,
    PairTask,
    SourceReader,
)
from torchrefract.data.pairs.sources import find_sources
from torchrefract.data.workers import use_one_thread
from torchrefract.effects.base import Effect

_TOTAL = 3000  # pairs whose time is computed from runs of fewer
PROTOCOL = {
    "written": "A run of torchrefract.generate for each round, engine and number of workers, with its start: pairs a "
    "second, share of the cores' time, and peak memory of all its processes (proportional set size, sampled each "
    "second). After the first pair or tar: seconds and core seconds for a thousand pairs.",
    "engines": f"Medians over the rounds of the seconds and core seconds that {_TOTAL} pairs take, with the start; and "
    "the speed, the time of the first engine in the same round over that of the engine: by seconds, and by core "
    "seconds, which other programs disturb less.",
    "listing": "A folder of that many links to 30 images, 1000 in a drive, until the first pair is written: seconds, "
    "time of cores and peak memory of the main process (proportional set size), for the run that scans it, for one "
    "that reads the list, and for one of 30 images, which shows what the start itself takes.",
    "one_pair": "One pair on one thread: read, degrade and encode; and, as the reference, read the frame and encode "
    "ready arrays. Means over pairs of the median of three calls, s.",
    "loader": "Frames a second from a DataLoader with one worker, which degrades one frame (3, H, W), uint8, by a new "
    "draw in each call.",
    "scaling": "Time of effect(image) on one thread at several sizes, ms, and the slope of log time over log pixels: 1 "
    "is proportional.",
    "memory": "Peak of the memory that torch allocates in effect(image), with the result and without the image, in "
    "multiples of the float32 image.",
}
SCALES = (0.25, 0.5, 1.0)  # of the sides of the frame
_SAMPLES = 12  # pairs that are timed one by one
_SAMPLE_INTERVAL = 1.0  # s, between two readings of the processes


class Run(NamedTuple):
    """Measurements of one run of the command."""

    engine: str
    workers: int
    pairs_per_second: float
    core_share: float
    peak_bytes: int
    disk_bytes_per_pair: float
    start_seconds: float  # until the first pair or tar
    start_core_seconds: float
    seconds_per_thousand: float
    core_seconds_per_thousand: float


def main() -> None:
    """Measure, print and save."""
    args = _parser().parse_args()
    effects, image = make_effects(), torch.rand(1, 3, *args.size)
    parts: dict[str, Callable[[], Any]] = {
        "listing": lambda: measure_listing(args) if args.listing else {},
        "one_pair": lambda: measure_one_pair(args),
        "loader": lambda: {name: measure_loader(effect, image, args.seconds) for name, effect in effects.items()},
        "scaling": lambda: {name: measure_scaling(effect, args.size) for name, effect in effects.items()},
        "memory": lambda: {
            name: peak_bytes(lambda effect=effect: effect(image)) / image.nbytes for name, effect in effects.items()
        },
    }
    results: dict[str, Any] = {}
    if "written" in args.only:
        runs = measure_runs(args)
        results = {"written": [run._asdict() for run in runs], "engines": compare_engines(runs)}
    results |= {name: measure() for name, measure in parts.items() if name in args.only}
    for name, values in results.items():
        print(name, PROTOCOL[name], json.dumps(values, indent=2), sep="\n", end="\n\n")
    conditions = {"cores": os.cpu_count(), "torch": torch.__version__, "size": args.size, "scene": args.scene}
    write_json(args.out, {"protocol": PROTOCOL, "conditions": conditions, **results})


def make_effects() -> dict[str, Effect]:
    """Return each effect with its default ranges, by the name of its class."""
    kinds = (LensDistortion, Turbulence, ThinPlateSpline, DivergenceFree, UniformFog, HeterogeneousFog, LensFlare)
    return {kind.__name__: kind() for kind in kinds}


def measure_runs(args: argparse.Namespace) -> list[Run]:
    """Run the command in each round with each number of workers and each engine."""
    runs = []
    for _ in range(args.rounds):
        for workers in args.workers:
            for engine in args.engines:
                with tempfile.TemporaryDirectory(dir=args.disk) as folder:
                    runs.append(measure_run(args, Path(folder) / "pairs", workers, engine))
                print(runs[-1], file=sys.stderr, flush=True)
    return runs


def compare_engines(runs: Sequence[Run]) -> list[dict[str, Any]]:
    """Compare the engines with the first one, for each number of workers."""
    costs = dict[tuple[int, str], list[np.ndarray]]()  # of each round: seconds and core seconds
    for run in runs:
        start, thousand = run[-4:-2], run[-2:]
        costs.setdefault((run.workers, run.engine), []).append(np.add(start, np.multiply(thousand, _TOTAL / 1000)))
    rows = []
    for (workers, engine), rounds in costs.items():
        reference = next(values for (number, _), values in costs.items() if number == workers)
        wall, cores = np.median(rounds, axis=0).tolist()
        speed, core_speed = np.median(np.divide(reference, rounds), axis=0).tolist()
        row = {"engine": engine, "workers": workers, "seconds": wall, "core_seconds": cores}
        rows.append(row | {"speed": speed, "speed_by_core_seconds": core_speed})
    return rows


def measure_run(args: argparse.Namespace, out: Path, workers: int, engine: str) -> Run:
    """Run the command once."""
    words = [f"scene={args.scene}", f"source={args.source}", f"out={out}", f"count={args.count}", f"workers={workers}"]
    words += [f"size=[{args.size[0]},{args.size[1]}]", f"maps={args.maps}", "license=benchmark", *_scene(args)[1]]
    words += [f"engine={engine}", f"tar={args.tar or 'null'}"]
    start, peak, core_seconds = time.perf_counter(), 0, dict[int, float]()
    first = (0, 0.0, 0.0)  # pairs, seconds and core seconds when some are written
    command = [sys.executable, "-m", "torchrefract.generate", *words]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as run:
        next_sample = start
        while run.poll() is None:
            processes = _descendants(run.pid)
            core_seconds |= {process: used for process in processes if (used := _core_seconds(process))}
            if time.perf_counter() >= next_sample:
                peak, next_sample = max(peak, sum(map(_memory, processes))), time.perf_counter() + _SAMPLE_INTERVAL
            if not first[0]:
                pairs = len(list(out.glob("pairs/*/[0-9]*.clean.png"))) + (args.tar or 0) * len(
                    list(out.glob("tars/[0-9]*"))
                )
                first = pairs, time.perf_counter() - start, sum(core_seconds.values())
            time.sleep(0.2)
    seconds = time.perf_counter() - start
    if run.returncode:
        raise SystemExit(f"torchrefract.generate failed with code {run.returncode}")
    disk = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    used, thousands = sum(core_seconds.values()), (args.count - first[0]) / 1000
    costs = (first[1], first[2], (seconds - first[1]) / thousands, (used - first[2]) / thousands)
    share = used / seconds / max(workers, 1)
    return Run(engine, workers, args.count / seconds, share, peak, disk / args.count, *costs)


def measure_listing(args: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Time the start of a set of many frames, and measure its memory."""
    with tempfile.TemporaryDirectory(dir=args.disk) as name:
        folder = Path(name)
        for number in range(30):
            path = folder / "images" / f"drive{number % 2}" / f"{number:02d}.jpg"
            path.parent.mkdir(parents=True, exist_ok=True)
            pixels = np.random.default_rng(number).integers(0, 256, (32, 48, 3), np.uint8)
            path.write_bytes(cv2.imencode(".jpg", pixels)[1].tobytes())
        images = sorted((folder / "images").rglob("*.jpg"))
        for number in range(args.listing):
            path = folder / "frames" / f"drive{number // 1000:04d}" / f"{number:07d}.jpg"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.hardlink_to(images[number % len(images)])
        runs = {"small": ("images", "small"), "scan": ("frames", "out"), "list": ("frames", "out")}
        return {name: _first_pair(args, folder / source, folder / out) for name, (source, out) in runs.items()}


def _first_pair(args: argparse.Namespace, source: Path, out: Path) -> dict[str, float]:
    """Start a run, wait for a new pair, and end the run."""
    words = [
        f"scene={args.scene}",
        f"source={source}",
        f"out={out}",
        "workers=1",
        "license=benchmark",
        *_scene(args)[1],
    ]
    pairs, peak, used, start = set(out.rglob("*.clean.png")), 0, 0.0, time.perf_counter()
    with subprocess.Popen([sys.executable, "-m", "torchrefract.generate", *words], stdout=subprocess.DEVNULL) as run:
        while run.poll() is None and set(out.rglob("*.clean.png")) == pairs:
            peak, used = max(peak, _memory(run.pid)), _core_seconds(run.pid)
            time.sleep(0.1)
        seconds = time.perf_counter() - start
        run.kill()
    return {"seconds": seconds, "core_seconds": used, "main_bytes": peak}


def measure_one_pair(args: argparse.Namespace) -> dict[str, float]:
    """Time single pairs in this process, and the reading and encoding alone."""
    use_one_thread()
    options = {"every": 1, "drive_by": "auto", "val_share": 0.2, "seed": 0}
    sources = find_sources(args.source, size=args.size, **options).limited(_SAMPLES)
    reader, (scene, _) = SourceReader(sources.root, args.size), _scene(args)
    generator = PairGenerator(instantiate(scene), args.scene, reader, 0, args.maps)
    generated, reference = [], []
    for number, source in enumerate(sources.frames()):
        task = PairTask(number, source, 0)
        files = generator.generate(task).data
        arrays = decode_pair({suffix: lambda data=data: data for suffix, data in files.items()})
        generated.append(_median_seconds(lambda task=task: generator.generate(task)))
        reference.append(
            _median_seconds(lambda source=source, arrays=arrays: (reader.read(source), encode_pair(arrays, args.maps)))
        )
    return {"generated": fmean(generated), "read_and_encode": fmean(reference)}


class _OneFrame(Dataset[torch.Tensor]):
    """One frame, degraded again and again."""

    def __init__(self, effect: Effect, frame: torch.Tensor):
        self.effect, self.frame = effect, frame

    def __len__(self) -> int:
        return 1 << 20

    def __getitem__(self, index: int) -> torch.Tensor:
        return self.effect(self.frame)


def measure_loader(effect: Effect, image: torch.Tensor, seconds: float) -> float:
    """Count the frames a second from a DataLoader with one worker, without the first one."""
    frame = (image[0] * 255).round().to(torch.uint8)
    batches = iter(DataLoader(_OneFrame(effect, frame), batch_size=None, num_workers=1))
    next(batches)
    start, frames = time.perf_counter(), 0
    while frames < 3 or time.perf_counter() - start < seconds:
        next(batches)
        frames += 1
    return frames / (time.perf_counter() - start)


def measure_scaling(effect: Effect, frame_size: tuple[int, int]) -> dict[str, Any]:
    """Time an effect at several sizes."""
    pixels, milliseconds = [], []
    for scale in SCALES:
        image = torch.rand(1, 3, *(max(8, round(scale * side)) for side in frame_size))
        effect(image)
        timer = Timer("effect(image)", globals={"effect": effect, "image": image}, num_threads=1)
        pixels.append(image[0, 0].numel())
        milliseconds.append(1e3 * timer.blocked_autorange(min_run_time=0.2).median)
    return {"pixels": pixels, "milliseconds": milliseconds, "slope": slope(pixels, milliseconds)}


def slope(sizes: Sequence[float], values: Sequence[float]) -> float:
    """Fit a line to the logarithms and return its slope."""
    return float(np.polyfit(np.log(sizes), np.log(values), 1)[0])


def peak_bytes(call: Callable[[], object]) -> int:
    """Measure the largest total of the memory that torch allocates during a call, its result included."""
    os.environ.setdefault("KINETO_LOG_LEVEL", "9")  # silences the profiler's own log
    call()  # allocations that are kept for later calls do not count
    with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as run:
        result = call()
    held = peak = 0
    results: Any = run.profiler.kineto_results if run.profiler else None
    for event in sorted(
        (event for event in results.events() if event.name() == "[memory]"), key=lambda event: event.start_ns()
    ):
        held += event.nbytes()
        peak = max(peak, held)
    del result
    return peak


def _scene(args: argparse.Namespace) -> tuple[Mapping[str, Any], list[str]]:
    """Return the configuration of the scene, and the option of its width if it has one."""
    cfg: Any = OmegaConf.load(Path(CONFIG_DIR, "scene", f"{args.scene}.yaml"))
    if "width" not in cfg:
        return cfg, []
    cfg.width = args.size[1]
    return cfg, [f"scene.width={args.size[1]}"]


def _median_seconds(call: Callable[[], object]) -> float:
    return median(seconds(call) for _ in range(3))


def _descendants(process: int) -> list[int]:
    """Return a process and all its descendants."""
    processes = [process]
    for parent in processes:
        try:
            processes += [int(child) for child in Path(f"/proc/{parent}/task/{parent}/children").read_text().split()]
        except OSError:
            continue
    return processes


def _memory(process: int) -> int:
    """Return the proportional set size of a process, bytes; 0 if it has ended."""
    try:
        lines = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0
    return sum(1024 * int(line.split()[1]) for line in lines if line.startswith("Pss:"))


def _core_seconds(process: int) -> float:
    """Return the time that a process has used on all cores, s; 0 if it has ended."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--source", type=Path, required=True, help="a folder of frames, or a video")
    parser.add_argument("--scene", default="paper_refractive", help="name of a file in conf/scene, paper_refractive")
    parser.add_argument("--count", type=count(1), default=200, help="number of pairs, 200")
    parser.add_argument("--size", type=size, default=(360, 640), help="height x width of the frames, 360x640")
    parser.add_argument("--workers", type=count(0), nargs="+", default=[1, 2], help="numbers of processes, 1 2")
    parser.add_argument("--engines", choices=("local", "ray"), nargs="+", default=["local"], help="engines, local")
    parser.add_argument("--rounds", type=count(1), default=1, help="number of rounds of runs, 1")
    parser.add_argument("--tar", type=count(1), help="number of pairs in a tar, files")
    parser.add_argument("--maps", choices=FORMATS, default="png", help="format of the maps, png")
    parser.add_argument("--listing", type=count(1), help="number of frames in a folder whose start is timed, none")
    parser.add_argument("--only", choices=PROTOCOL, nargs="+", default=[*PROTOCOL], help="parts to measure, all")
    parser.add_argument("--seconds", type=float, default=2.0, help="duration of a measurement of the loader, 2")
    parser.add_argument("--disk", type=Path, help="folder for temporary pairs, the system's default")
    parser.add_argument("--out", type=Path, default=RESULTS / "pairs.json", help="JSON file to write")
    return parser


if __name__ == "__main__":
    main()
