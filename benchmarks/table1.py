"""The baselines on both tasks, effect by effect, beside what needs no network; and what the paper reports.

python benchmarks/table1.py --source FRAMES [--form small|gpu|paper] [--rows resunet_undistort segformer_deweather ...]
    [--frames 0] [--apart br_] [--steps 10 50 250] [--sampled 8] [--device cpu] [--threads 2]
    [--out benchmarks/results/table1_small]

Rows whose training is in `--out` are loaded, what was stopped goes on, the others are trained. `--frames` of the drives
held out are scored, 0 for all; of a diffusion model `--sampled`, with each number of steps. The best constant flow
knows which effect it undoes; the mix is the mean of its effects, told once more for the frames whose names begin with
each of `--apart`, and for those of none. A diffusion model is compared with doing nothing to the same frames.
"""

import argparse
import json
import math
import subprocess
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median

import torch
from arguments import count
from looks import seconds
from restoration_scores import METRIC_SIZE, MIX, Restore, Scores, corrupted, effects_of, mean_of, references, score
from torch import Tensor
from torch.utils.data import DataLoader, Subset

from torchrefract._io import replace_file
from torchrefract.data.frames import FrameFolder
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
_FORMS = {"small": "_small", "gpu": "_gpu", "paper": ""}  # of the experiments, by the ends of their names
_BATCH = 8
_ALL = "all"
_NOTHING = "do nothing"
_NONE = Scores(*[math.nan] * 6)


@dataclass(frozen=True)
class Line:
    """What one method reaches on one effect."""

    task: str
    effect: str
    which: str  # frames
    method: str
    scores: Scores
    frames: int
    size: tuple[int, int]
    parameters: int | None = None
    milliseconds: float | None = None  # of one frame of that size


def main() -> None:
    """Train or load, score, print and save."""
    args = _parser().parse_args()
    args.out = args.out or Path(__file__).parent / "results" / f"table1_{args.form}"
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
        with replace_file(args.out / name) as path:
            path.write_text(content + "\n", encoding="utf-8")
    print(f"written to {args.out}; each row has its curves.png and panel.png")


def trained(row: str, args: argparse.Namespace) -> Path:
    """The best checkpoint of a row, which is trained first, or further, where that is not done."""
    runs = sorted(args.out.glob(f"{row}*"), key=lambda run: run.stat().st_mtime)
    done = next((run for run in runs if (run / "curves.png").is_file()), None)
    if done is None:
        done = args.out / f"{row}_{len(runs)}"
        stopped = next((run / "last.ckpt" for run in reversed(runs) if (run / "last.ckpt").is_file()), None)
        words = [f"+experiment=table1_{row}{_FORMS[args.form]}", f"data.root={args.source}"]
        words += [] if stopped is None else [f"ckpt_path={stopped}"]
        subprocess.run([sys.executable, "-m", "torchrefract.train", *words, f"hydra.run.dir={done}"], check=True)
    return done / "best.ckpt"


def scored(task: str, models: dict[str, Loaded], args: argparse.Namespace) -> Iterator[Line]:
    """The lines of a task: those of no network first, for each size of frames that models were trained on."""
    for size in dict.fromkeys(loaded.size for loaded in models.values()):
        own = {row: loaded for row, loaded in models.items() if loaded.size == size}
        held_out = FrameFolder(args.source, size=size, split="val")
        frames = _frames(held_out, args.frames, args.device)
        effects = effects_of(task, size[1])
        pairs = {name: corrupted(frames, effect) for name, (effect, _) in effects.items()}
        groups = _groups(held_out, args.apart)
        found, keys = dict[str, dict[str, Tensor]](), _keys(frames)
        for name, (effect, _) in effects.items():
            for rival, scores in references(task, effect, frames, pairs[name]).items():
                found.setdefault(rival, {})[name] = scores
        for rival, each in found.items():
            yield from _lines(Line(task, "", "", rival, _NONE, 0, size), each, keys, groups)
        for loaded in own.values():
            if isinstance(loaded.model, Diffusion) and args.sampled < len(keys):
                few = _evenly(len(keys), args.sampled)
                nothing = {name: scores[few] for name, scores in found[_NOTHING].items()}
                line = Line(task, "", "", f"{_NOTHING}, frames of DDPM", _NONE, 0, size)
                yield from _lines(line, nothing, [keys[i] for i in few], groups)
            yield from _of_model(task, loaded, pairs, groups, args)


def _of_model(
    task: str, loaded: Loaded, pairs: dict[str, list[Pair]], groups: dict[str, set[int]], args: argparse.Namespace
) -> Iterator[Line]:
    model = loaded.model.to(args.device)
    parameters = sum(parameter.numel() for parameter in model.network.parameters())  # pyright: ignore[reportAttributeAccessIssue, reportCallIssue]  # of every Learner
    sampled = isinstance(model, Diffusion)
    few = {name: _thinned(batches, args.sampled if sampled else 0) for name, batches in pairs.items()}
    some = next(iter(few.values()))
    for steps in args.steps if sampled else [0]:
        if sampled:
            model.steps = steps
        each = {name: score(_restored(model, batches), batches) for name, batches in few.items()}
        # What has come to the CPU has been computed, on any device.
        call = partial(_brought, model, some[0].degraded[:1])
        milliseconds = 1e3 * median(seconds(call, before=i == 0) for i in range(3))
        name = f"DDPM, {steps} steps" if sampled else loaded.name
        line = Line(task, "", "", name, _NONE, 0, loaded.size, parameters, milliseconds)
        yield from _lines(line, each, _keys(some), groups)


def _lines(of: Line, each: dict[str, Tensor], keys: list[int], groups: dict[str, set[int]]) -> Iterator[Line]:
    """A method's lines: the mix of all frames, that of each group, and the effects; from scores frame by frame."""
    effects = effects_of(of.task, of.size[1])
    mixed = torch.stack([each[name] for name, (_, in_mix) in effects.items() if in_mix]).mean(dim=0)
    for which, group in groups.items():
        chosen = mixed[[key in group for key in keys]]
        yield replace(of, effect=MIX, which=which, scores=mean_of(chosen), frames=len(chosen))
    for effect, scores in each.items():
        yield replace(of, effect=effect, which=_ALL, scores=mean_of(scores), frames=len(scores))


def page(lines: Sequence[Line]) -> str:
    """The tables, one for each task and effect, in Markdown."""
    parts = []
    for task, effect, which in dict.fromkeys((line.task, line.effect, line.which) for line in lines):
        own = [line for line in lines if (line.task, line.effect, line.which) == (task, effect, which)]
        size = f"{own[0].size[1]}x{own[0].size[0]}"
        head = ["method", "L", "L_rec", "L_k", "PSNR (dB)", "SSIM", f"EPE (px at {METRIC_SIZE[1]}x{METRIC_SIZE[0]})"]
        head += ["x do nothing", "frames", "parameters", f"ms per frame of {size}"]
        nothing = {line.frames: line.scores for line in own if line.method.startswith(_NOTHING)}
        rows = [head, ["---"] * len(head), *(_cells(line, nothing[line.frames]) for line in own)]
        if effect == MIX and which == _ALL:
            rows += [_paper(name, *figures) for name, figures in PAPER[task].items()]
        title = f"### {task}: {effect}" + ("" if which == _ALL else f", frames {which}")
        parts.append("\n".join([title, "", *("| " + " | ".join(row) + " |" for row in rows)]))
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


def _frames(held_out: FrameFolder, most: int, device: torch.device) -> list[Frame]:
    """Batches of the frames of drives that no training has seen, or as many of them, evenly."""
    chosen = Subset(held_out, _evenly(len(held_out), most))
    return [Frame(*(value.to(device) for value in batch)) for batch in DataLoader(chosen, batch_size=_BATCH)]


def _groups(held_out: FrameFolder, prefixes: Sequence[str]) -> dict[str, set[int]]:
    """The keys of all frames, and of those whose names begin alike, and of the others."""
    names = {key: path.name for key, path in zip(held_out.keys, held_out.paths, strict=True)}
    groups = {f"{start}*": {key for key, name in names.items() if name.startswith(start)} for start in prefixes}
    others = {"others": set(names).difference(*groups.values())} if groups else {}
    return {name: keys for name, keys in ({_ALL: set(names)} | groups | others).items() if keys}


def _keys(batches: Sequence[Frame | Pair]) -> list[int]:
    return [key for batch in batches for key in batch.key.tolist()]


def _thinned(pairs: list[Pair], most: int) -> list[Pair]:
    """So many of the frames of batches, evenly, in new batches; all of them for 0."""
    if not most:
        return pairs
    every = [torch.cat(values) for values in zip(*pairs, strict=True)]
    chosen = torch.tensor(_evenly(len(every[0]), most), device=every[0].device)
    return [Pair(*(value[some] for value in every)) for some in chosen.split(_BATCH)]


def _evenly(count: int, most: int) -> list[int]:
    kept = min(count, most or count)
    return [i * count // kept for i in range(kept)]


@torch.inference_mode()
def _call(model: Restore, image: Tensor) -> Restored:
    return model(image)


def _brought(model: Restore, image: Tensor) -> Tensor:
    return _call(model, image).image.cpu()


def _restored(model: Restore, pairs: Sequence[Pair]) -> Iterator[Restored]:
    return (_call(model, pair.degraded) for pair in pairs)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--source", type=Path, required=True, help="a folder of frames, of several drives")
    parser.add_argument("--form", choices=_FORMS, default="small", help="of the experiments, small")
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS), help="all six")
    parser.add_argument("--frames", type=count(0), default=0, help="held-out frames that are scored, all")
    parser.add_argument("--steps", type=count(1), nargs="+", default=[10, 50, 250], help="of diffusion models")
    parser.add_argument("--sampled", type=count(1), default=8, help="frames that a diffusion model restores, 8")
    parser.add_argument("--apart", nargs="+", default=[], help="beginnings of frames' names, each a kind of its own")
    parser.add_argument("--device", type=torch.device, default=torch.device("cpu"), help="that scores, cpu")
    parser.add_argument("--threads", type=count(1), default=2, help="2")
    parser.add_argument("--out", type=Path, help="a folder for trainings of one form, benchmarks/results/table1_FORM")
    return parser


if __name__ == "__main__":
    main()
