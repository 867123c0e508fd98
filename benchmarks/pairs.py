"""How fast pairs are written to disk, beside decoding and encoding the same pictures and nothing else.

python benchmarks/pairs.py --source DIR [--scene paper_refractive] [--count 1000] [--size 360x640] [--workers N]
    [--maps png] [--kills 0] [--out benchmarks/results/pairs.json]
"""

import argparse
import hashlib
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import fmean, median
from typing import NamedTuple

from hydra.utils import instantiate
from looks import LOOKS, seconds
from omegaconf import OmegaConf
from timing import Bar, count, size

from torchrefract._io import CONFIG_DIR, replace_file
from torchrefract.data.pair_files import FORMATS, decode_pair, encode_pair
from torchrefract.data.pairs.making import Job, Maker, Recipe
from torchrefract.data.pairs.running import work_alone
from torchrefract.data.pairs.sources import Reader, find_sources

WHAT = (
    "A run of torchrefract.generate: pairs a second, its start among the time; the share of the cores' time that it "
    "used, looked at twenty times a second, and the memory of all its processes, shared pages counted once, looked at "
    "every two seconds, since a look takes time from each of them. And one pair on one thread: read, "
    "degraded and encoded, beside reading the same frame and encoding the same arrays: means over pairs, of the median "
    "of three calls each."
)
LIMIT = 1.5
BUSY = 0.85
_TRIED = 24  # pairs that are timed singly
_PAUSE = 0.05  # s, between two looks at the processes: what one uses after the last of them is not counted
_BETWEEN_MEMORY = 2.0  # s, between two at their memory


class Run(NamedTuple):
    """What a run of the command took."""

    pairs: int
    seconds: float
    busy: float  # share of the cores' time
    peak_bytes: int
    disk_bytes: int


class Single(NamedTuple):
    """Means over pairs on one thread, s, as a rate has them."""

    made: float
    bare: float


def main() -> None:
    """Measure, print and save; where a bar does not hold it is said, and is no failure of this command."""
    args = _parser().parse_args()
    with tempfile.TemporaryDirectory(dir=args.room) as room:
        words = command(args, Path(room) / "pairs")
        found = measured(words, args.count, Path(room) / "pairs", cores=args.workers)
        broken = killed(args, Path(room), random.Random(0)) if args.kills else None
    single = one_by_one(args)
    bars = [
        Bar("the time of a pair", single.made / single.bare, "<=", LIMIT, "x bare decode and encode"),
        Bar("the cores' time", found.busy, ">=", BUSY, "of all"),
    ]
    print(WHAT, "")
    print(f"{found.pairs} pairs in {found.seconds:.1f} s: {found.pairs / found.seconds:.2f} a second on {args.workers}")
    print(f"{found.peak_bytes / 1e6:.0f} MB of memory at most, {found.disk_bytes / found.pairs / 1e6:.3f} MB a pair")
    print(f"one pair {1e3 * single.made:.1f} ms, bare {1e3 * single.bare:.1f} ms", *bars, sep="\n")
    if broken is not None:
        shown = f": {', '.join(broken[:3])}" if broken else ""
        print(f"after {args.kills} kills {len(broken)} files differ from those of a run that was not killed{shown}")
    content = {
        "what": WHAT,
        "words": words,
        "cores": os.cpu_count(),
        "run": found._asdict(),
        "single": single._asdict(),
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    with replace_file(args.out) as path:
        path.write_text(json.dumps(content | {"differ_after_kills": broken}, indent=2) + "\n", encoding="utf-8")
    print(f"written to {args.out}")


def command(args: argparse.Namespace, out: Path) -> list[str]:
    """The words that write the pairs."""
    scene = [f"scene={args.scene}", *([f"scene.width={args.size[1]}"] if "width" in _scene(args.scene) else [])]
    frame = f"size=[{args.size[0]},{args.size[1]}]"
    rest = [f"source={args.source}", f"out={out}", f"count={args.count}", f"workers={args.workers}", frame]
    return [sys.executable, "-m", "torchrefract.generate", *scene, *rest, f"maps={args.maps}", "license=benchmark"]


def measured(words: Sequence[str], pairs: int, out: Path, *, cores: int) -> Run:
    """A run of the command."""
    start, peak, used = time.perf_counter(), 0, dict[int, float]()
    looked = start
    with subprocess.Popen(words, stdout=subprocess.DEVNULL) as run:
        while run.poll() is None:
            family = _family(run.pid)
            if time.perf_counter() - looked > _BETWEEN_MEMORY:
                peak, looked = max(peak, sum(map(_memory, family))), time.perf_counter()
            # The system adds up what workers have used only for who waits for them, which a server of forks does not.
            used |= {process: own for process in family if (own := _used(process))}
            time.sleep(_PAUSE)
    took = time.perf_counter() - start
    if run.returncode:
        raise SystemExit(f"the run ended with {run.returncode}")
    disk = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    return Run(pairs, took, sum(used.values()) / took / cores, peak, disk)


def killed(args: argparse.Namespace, room: Path, dice: random.Random) -> list[str]:
    """The files of a run that is killed so often, at random moments, which differ from those of the other one."""
    words = command(args, room / "killed")
    for _ in range(args.kills):
        with subprocess.Popen(words, stdout=subprocess.DEVNULL) as run:
            there = len(list((room / "killed").rglob("*.png")))
            # Not in the seconds of its start: where it writes.
            while run.poll() is None and len(list((room / "killed").rglob("*.png"))) == there:
                time.sleep(0.01)
            time.sleep(dice.uniform(0, 1))
            run.send_signal(signal.SIGKILL)
    subprocess.run(words, stdout=subprocess.DEVNULL, check=True)
    whole, broken = (_sums(room / name) for name in ("pairs", "killed"))
    return sorted({name for name, _ in whole.items() ^ broken.items()})


def one_by_one(args: argparse.Namespace) -> Single:
    """Pairs made by this process, on one thread."""
    work_alone()
    cfg = _scene(args.scene)
    if "width" in cfg:
        cfg["width"] = args.size[1]
    options = {"every": 1, "drive_by": "auto", "val_share": 0.2, "seed": 0}
    sources = find_sources(args.source, size=args.size, **options).thinned(_TRIED)
    reader = Reader(sources.root, args.size)
    maker = Maker(Recipe(instantiate(cfg), args.scene, sources.root, args.size, 0, args.maps))
    made, bare = [], []
    for job in (Job(i, source, 0) for i, source in enumerate(sources.frames)):
        files = maker.make(job).data
        arrays = decode_pair({suffix: lambda data=data: data for suffix, data in files.items()})
        made.append(_typical(lambda job=job: maker.make(job)))
        bare.append(_typical(lambda job=job, arrays=arrays: (reader.read(job.source), encode_pair(arrays, args.maps))))
    return Single(fmean(made), fmean(bare))


def _typical(call: Callable[[], object]) -> float:
    return median(seconds(call) for _ in range(LOOKS))


def _scene(name: str) -> dict[str, object]:
    scene = OmegaConf.to_container(OmegaConf.load(Path(CONFIG_DIR, "scene", f"{name}.yaml")))
    return {str(key): value for key, value in scene.items()} if isinstance(scene, dict) else {}


def _sums(out: Path) -> dict[str, str]:
    files = (path for path in out.rglob("*") if path.is_file())
    return {path.relative_to(out).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def _family(process: int) -> list[int]:
    """A process and all that come of it."""
    found = [process]
    for parent in found:
        try:
            found += [int(child) for child in Path(f"/proc/{parent}/task/{parent}/children").read_text().split()]
        except OSError:
            continue
    return found


def _memory(process: int) -> int:
    """Bytes of a process, its part of what it shares; 0 for one that is gone."""
    try:
        lines = Path(f"/proc/{process}/smaps_rollup").read_text().splitlines()
    except OSError:
        return 0
    return sum(1024 * int(line.split()[1]) for line in lines if line.startswith("Pss:"))


def _used(process: int) -> float:
    """Seconds of a core that a process has used; 0 for one that is gone."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--source", type=Path, required=True, help="a folder of frames, or a video")
    parser.add_argument("--scene", default="paper_refractive", help="one of conf/scene, paper_refractive")
    parser.add_argument("--count", type=count(1), default=1000, help="pairs, 1000")
    parser.add_argument("--size", type=size, default=(360, 640), help="height x width of the frames, 360x640")
    parser.add_argument("--workers", type=count(1), default=os.cpu_count() or 1, help="processes, as many as cores")
    parser.add_argument("--maps", choices=FORMATS, default="png", help="the form of the maps, png")
    parser.add_argument("--kills", type=count(0), default=0, help="kill a second run so often, and compare, 0")
    parser.add_argument("--room", type=Path, help="a folder for the pairs, which are removed; a temporary one")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "pairs.json", help="the JSON")
    return parser


if __name__ == "__main__":
    main()
