"""The baselines on both tasks, effect by effect, beside what needs no network; and what the paper reports.

python benchmarks/table1.py --source FRAMES [--form small|paper] [--rows resunet_undistort segformer_deweather ...]
    [--frames 0] [--steps 10 50 250] [--sampled 8] [--threads 2] [--out benchmarks/results/table1]

Rows whose training is in `--out` are loaded, what was stopped goes on, the others are trained. `--frames` of the drives
held out are scored, 0 for all; of a diffusion model `--sampled`, with each number of steps. The best constant flow
knows which effect it undoes; the mix is the mean of its effects.
"""

import argparse
import json
import math
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from statistics import median

import torch
from arguments import count
from looks import seconds
from restoration_scores import METRIC_SIZE, MIX, Restore, Scores, corrupted, effects_of, mean, references, score
from torch.utils.data import DataLoader, Subset

from torchrefract._files import replacing
from torchrefract.data.frame_folder import FrameFolder
from torchrefract.restoration.diffusion import Diffusion
from torchrefract.restoration.loading import Loaded, load_model
from torchrefract.restoration.tasks import Restored
from torchrefract.types import Frame, Pair

TASKS = ("undistort", "deweather")
ROWS = tuple(f"{model}_{task}" for task in TASKS for model in ("resunet", "segformer", "ddpm"))
# PSNR in dB and endpoint error in px at 1920 x 1080, as the paper has them, of its own frames.
PAPER = {
    "undistort": {"ResUNet": (23.24, 5.76), "SegFormer": (16.29, 69.82), "DDPM": (22.80, 6.01)},
    "deweather": {"ResUNet": (32.54, None), "SegFormer": (28.99, None), "DDPM": (30.80, None)},
}
_BATCH = 8


@dataclass(frozen=True)
class Line:
    """What one method reaches on one effect."""

    task: str
    effect: str
    method: str
    scores: Scores
    frames: int
    size: tuple[int, int]
    parameters: int | None = None
    milliseconds: float | None = None  # of one frame of that size


def main() -> None:
    """Train or load, score, print and save."""
    args = _parser().parse_args()
    torch.set_num_threads(args.threads)
    lines = list[Line]()
    for task in TASKS:
        rows = [row for row in args.rows if row.endswith(task)]
        models = {row: load_model(trained(row, args)) for row in rows}
        lines += scored(task, models, args)
    text = page(lines)
    print(text)
    args.out.mkdir(parents=True, exist_ok=True)
    for name, content in (("table.md", text), ("table.json", json.dumps([asdict(line) for line in lines], indent=2))):
        with replacing(args.out / name) as path:
            path.write_text(content + "\n", encoding="utf-8")
    print(f"written to {args.out}; each row has its curves.png and panel.png")


def trained(row: str, args: argparse.Namespace) -> Path:
    """The best checkpoint of a row, which is trained first, or further, where that is not done."""
    runs = sorted(args.out.glob(f"{row}*"), key=lambda run: run.stat().st_mtime)
    done = next((run for run in runs if (run / "curves.png").is_file()), None)
    if done is None:
        done = args.out / f"{row}_{len(runs)}"
        stopped = next((run / "last.ckpt" for run in reversed(runs) if (run / "last.ckpt").is_file()), None)
        words = [f"+experiment=table1_{row}{'_small' if args.form == 'small' else ''}", f"data.root={args.source}"]
        words += [] if stopped is None else [f"ckpt_path={stopped}"]
        subprocess.run([sys.executable, "-m", "torchrefract.train", *words, f"hydra.run.dir={done}"], check=True)
    return done / "best.ckpt"


def scored(task: str, models: dict[str, Loaded], args: argparse.Namespace) -> Iterator[Line]:
    """The lines of a task: those of no network first, for each size of frames that models were trained on."""
    for size in dict.fromkeys(loaded.size for loaded in models.values()):
        own = {row: loaded for row, loaded in models.items() if loaded.size == size}
        frames = _frames(args.source, size, args.frames)
        effects = effects_of(task, size[1])
        pairs = {name: corrupted(frames, effect) for name, (effect, _) in effects.items()}
        found = dict[str, dict[str, Scores]]()
        for name, (effect, _) in effects.items():
            for rival, scores in references(task, effect, frames, pairs[name]).items():
                found.setdefault(rival, {})[name] = scores
        for rival, each in found.items():
            yield from _lines(task, rival, each, sum(len(frame.key) for frame in frames), size)
        for loaded in own.values():
            yield from _of_model(task, loaded, pairs, args)


def _of_model(task: str, loaded: Loaded, pairs: dict[str, list[Pair]], args: argparse.Namespace) -> Iterator[Line]:
    model = loaded.model
    parameters = sum(parameter.numel() for parameter in model.network.parameters())  # pyright: ignore[reportAttributeAccessIssue, reportCallIssue]  # of every Learner
    sampled = isinstance(model, Diffusion)
    few = {name: _thinned(batches, args.sampled if sampled else 0) for name, batches in pairs.items()}
    for steps in args.steps if sampled else [0]:
        if sampled:
            model.steps = steps
        each = {name: score(_restored(model, batches), batches) for name, batches in few.items()}
        call = partial(_call, model, next(iter(few.values()))[0].degraded[:1])
        milliseconds = 1e3 * median(seconds(call, before=i == 0) for i in range(3))
        name = f"{loaded.name}, {steps} steps" if sampled else loaded.name
        count = sum(len(pair.key) for pair in next(iter(few.values())))
        yield from _lines(task, name, each, count, loaded.size, parameters, milliseconds)


def _lines(
    task: str,
    method: str,
    each: dict[str, Scores],
    frames: int,
    size: tuple[int, int],
    parameters: int | None = None,
    milliseconds: float | None = None,
) -> Iterator[Line]:
    mixed = {name: each[name] for name, (_, in_mix) in effects_of(task, size[1]).items() if in_mix}
    for effect, scores in {MIX: mean(mixed), **each}.items():
        yield Line(task, effect, method, scores, frames, size, parameters, milliseconds)


def page(lines: Sequence[Line]) -> str:
    """The tables, one for each task and effect, in Markdown."""
    parts = []
    for task, effect in dict.fromkeys((line.task, line.effect) for line in lines):
        own = [line for line in lines if (line.task, line.effect) == (task, effect)]
        size = f"{own[0].size[1]}x{own[0].size[0]}"
        head = ["method", "L", "L_rec", "L_k", "PSNR (dB)", "SSIM", f"EPE (px at {METRIC_SIZE[1]}x{METRIC_SIZE[0]})"]
        head += ["x do nothing", "frames", "parameters", f"ms per frame of {size}"]
        rows = [head, ["---"] * len(head), *(_cells(line, own[0].scores) for line in own)]
        if effect == MIX:
            rows += [_paper(name, *figures) for name, figures in PAPER[task].items()]
        parts.append("\n".join([f"### {task}: {effect}", "", *("| " + " | ".join(row) + " |" for row in rows)]))
    return "\n\n".join(parts)


def _cells(line: Line, nothing: Scores) -> list[str]:
    s = line.scores
    numbers = [f"{s.loss:.4f}", f"{s.image_loss:.4f}", _or_none(s.flow_loss, ".4f"), f"{s.psnr:.2f}", f"{s.ssim:.3f}"]
    numbers += [_or_none(s.epe, ".2f"), _or_none(s.epe / nothing.epe if nothing.epe else s.epe, ".2f")]
    cost = [str(line.frames), "" if line.parameters is None else f"{line.parameters / 1e6:.1f} M"]
    return [line.method, *numbers, *cost, "" if line.milliseconds is None else f"{line.milliseconds:.0f}"]


def _paper(name: str, psnr: float, epe: float | None) -> list[str]:
    return [
        f"paper: {name}, on its own frames",
        "",
        "",
        "",
        f"{psnr:.2f}",
        "",
        "" if epe is None else f"{epe:.2f}",
        *[""] * 4,
    ]


def _or_none(value: float, form: str) -> str:
    return "" if math.isnan(value) else format(value, form)


def _frames(source: Path, size: tuple[int, int], most: int) -> list[Frame]:
    """Batches of the frames of drives that no training has seen, or as many of them, evenly."""
    held_out = FrameFolder(source, size=size, split="val")
    chosen = _evenly(len(held_out), most)
    return list(DataLoader(Subset(held_out, chosen), batch_size=_BATCH))


def _thinned(pairs: list[Pair], most: int) -> list[Pair]:
    """So many of the frames of batches, evenly, each a batch; all of them for 0."""
    if not most:
        return pairs
    each = [Pair(*(value[i : i + 1] for value in pair)) for pair in pairs for i in range(len(pair.key))]
    return [each[i] for i in _evenly(len(each), most)]


def _evenly(count: int, most: int) -> list[int]:
    kept = min(count, most or count)
    return [i * count // kept for i in range(kept)]


@torch.inference_mode()
def _call(model: Restore, image: torch.Tensor) -> Restored:
    return model(image)


def _restored(model: Restore, pairs: Sequence[Pair]) -> Iterator[Restored]:
    return (_call(model, pair.degraded) for pair in pairs)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--source", type=Path, required=True, help="a folder of frames, of several drives")
    parser.add_argument("--form", choices=("small", "paper"), default="small", help="of the experiments, small")
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS), help="all six")
    parser.add_argument("--frames", type=count(0), default=0, help="held-out frames that are scored, all")
    parser.add_argument("--steps", type=count(1), nargs="+", default=[10, 50, 250], help="of diffusion models")
    parser.add_argument("--sampled", type=count(1), default=8, help="frames that a diffusion model restores, 8")
    parser.add_argument("--threads", type=count(1), default=2, help="2")
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "table1", help="a folder")
    return parser


if __name__ == "__main__":
    main()
