"""Score the baselines on both tasks, effect by effect, next to methods without a network and the values of the paper.

python benchmarks/table1.py --source FRAMES [--scale small|gpu|paper] [--rows resunet_undistort segformer_deweather ...]
    [--frames 0] [--groups br_] [--steps 10 50 250] [--sampled 8] [--device cpu] [--threads 2]
    [--out benchmarks/results/table1_small] [--options trainer.max_epochs=1 'data.size=[64,112]' --out FOLDER]

Rows with a finished training in `--out` are loaded, stopped trainings are resumed, and the others are started.
`--frames` frames of the held-out drives are scored; 0 scores all. A diffusion model restores only `--sampled` of them,
once for each number of steps, and is compared with doing nothing on the same frames. The best constant flow is fitted
to each effect separately. `--options` of `torchrefract.train` are for all trainings. A line under the tables names the
commit of each training. The score of the mix is the mean over its effects. It is repeated for the frames whose names
start with each prefix of `--groups`, and for the remaining frames.
"""

import argparse
import math
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import NamedTuple, cast

import torch
from timing import RESULTS, commit, count, markdown, seconds, write_json
from torch import Tensor
from torch.utils.data import DataLoader, Subset

from torchrefract._tensor import to_float, to_uint8
from torchrefract.data.frames import FrameFolder, evenly_spaced
from torchrefract.data.module import BORDERS, make_pair
from torchrefract.effects.base import Effect
from torchrefract.effects.compose import OneOf
from torchrefract.effects.flare import LensFlare
from torchrefract.effects.fog import remove_fog
from torchrefract.effects.lens import LensDistortion
from torchrefract.presets import cheap_dashcam, paper_refractive, paper_weather
from torchrefract.restoration.checkpoints import Loaded, load_model
from torchrefract.restoration.diffusion import Diffusion
from torchrefract.restoration.module import restoration_scores
from torchrefract.restoration.tasks import Deweather, Restored, Task, Undistort
from torchrefract.types import Frame, Pair
from torchrefract.warping.warp import warp

TASKS: dict[str, Task] = {"undistort": Undistort(), "deweather": Deweather()}
ROWS = tuple(f"{model}_{task}" for task in TASKS for model in ("resunet", "segformer", "ddpm"))
SCALES = ("small", "gpu", "paper")
# L, L_rec, L_k, PSNR in dB and endpoint error in px at 1920 x 1080, from the paper, on its own frames. Its L_k of
# weather is that of a map of the fog.
PAPER = {
    "undistort": {
        "ResUNet": (0.034, 0.029, 0.005, 23.24, 5.76),
        "SegFormer": (0.146, 0.085, 0.055, 16.29, 69.82),
        "DDPM": (0.044, 0.039, 0.0048, 22.80, 6.01),
    },
    "deweather": {
        "ResUNet": (0.065, 0.059, 0.007, 32.54, None),
        "SegFormer": (0.096, 0.086, 0.010, 28.99, None),
        "DDPM": (0.054, 0.051, 0.0065, 30.80, None),
    },
}
METRIC_SIZE = (1080, 1920)  # px, the frame of the paper's endpoint errors
MIX = "all of the paper's"
_BATCH = 8
_ALL = "all"
_COMMITS = "commits.txt"  # a line for each training that was started or resumed
_NOTHING = "do nothing"
_SEED = 1 << 40  # above the seeds of training and validation
_CONSTANT_DRAWS = 256

Restore = Callable[[Tensor], Restored]


class Scores(NamedTuple):
    """Means over frames; flow_loss and epe are NaN for a task without a flow.

    loss: L, image_loss + flow_loss, the training loss of the task.
    image_loss, flow_loss: L_rec and L_k, see `Undistort` and `Deweather`.
    psnr: dB.
    ssim: at most 1.
    epe: endpoint error, px at METRIC_SIZE.
    """

    loss: float
    image_loss: float
    flow_loss: float
    psnr: float
    ssim: float
    epe: float


_NO_SCORES = Scores(*[math.nan] * 6)


@dataclass(frozen=True)
class Line:
    """The scores of one method on one effect."""

    task: str
    effect: str
    group: str  # of frames
    method: str
    scores: Scores
    frames: int
    size: tuple[int, int]
    parameters: int | None = None
    milliseconds: float | None = None  # for one frame of `size`


def main() -> None:
    """Train or load the models, score them, print the tables and save them."""
    parser = _parser()
    args = parser.parse_args()
    if args.options and args.out is None:
        parser.error("--options needs --out, the folder of trainings with these options")
    args.out = args.out or RESULTS / f"table1_{args.scale}"
    args.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(args.threads)
    lines = list[Line]()
    for task in TASKS:
        rows = [row for row in args.rows if row.endswith(task)]
        lines += score_task(task, {row: load_model(train(row, args)) for row in rows}, args)
    text = format_tables(lines) + f"\n\n{describe_commits(args.rows, args.out)}"
    print(text)
    write_json(args.out / "table.json", [asdict(line) for line in lines])
    (args.out / "table.md").write_text(text + "\n", encoding="utf-8")
    print("each row has its curves.png and panel.png")


def train(row: str, args: argparse.Namespace) -> Path:
    """Return the best checkpoint of a row; start or resume its training unless it is finished."""
    runs = sorted(args.out.glob(f"{row}*"), key=lambda run: run.stat().st_mtime)
    finished = next((run for run in runs if (run / "curves.png").is_file()), None)
    if finished is None:
        finished = args.out / f"{row}_{len(runs)}"
        stopped = next((run / "last.ckpt" for run in reversed(runs) if (run / "last.ckpt").is_file()), None)
        words = [f"+experiment=table1_{row}", f"scale={args.scale}", f"data.root={args.source}"]
        words += args.options if stopped is None else [*args.options, f"ckpt_path={stopped}"]
        with (args.out / _COMMITS).open("a", encoding="utf-8") as file:
            file.write(f"{row} {commit()}\n")
        subprocess.run([sys.executable, "-m", "torchrefract.train", *words, f"hydra.run.dir={finished}"], check=True)
    return finished / "best.ckpt"


def describe_commits(rows: Sequence[str], out: Path) -> str:
    """Name the commits of the trainings of rows in a folder, and that of this command."""
    lines = (out / _COMMITS).read_text(encoding="utf-8").splitlines() if (out / _COMMITS).is_file() else []
    commits = {of for row, _, of in (line.partition(" ") for line in lines) if row in rows}
    return f"trained at commit {', '.join(sorted(commits)) or 'unknown'}, scored at {commit()}"


def wide_lens() -> LensDistortion:
    """Create the lens that no training draws."""
    return LensDistortion(k1_range=(-0.4, 0.2), focal_range=(0.9, 1.1))


def effects_of(task: str, width: int) -> dict[str, tuple[Effect, bool]]:
    """Return the scored effects of a task by name, each with True if it is in the paper's mix."""
    if task == "undistort":
        names = ("cheap_dashcam lens", "turbulence", "thin-plate spline", "divergence-free")
        bordered = {f"cheap_dashcam lens, {border} border": (cheap_dashcam(), False) for border in BORDERS}
        mix = _in_mix(paper_refractive(width=width, frame="fill"), names)
        return mix | {"wide lens": (wide_lens(), False)} | bordered
    return _in_mix(paper_weather(), ("uniform fog", "heterogeneous fog", "lens flare"))


def _in_mix(mix: OneOf, names: Sequence[str]) -> dict[str, tuple[Effect, bool]]:
    return {name: (cast(Effect, effect), True) for name, effect in zip(names, mix.effects, strict=True)}


def corrupt(frames: Iterable[Frame], effect: Effect, name: str) -> list[Pair]:
    """Degrade batches of frames, with a border if the name ends in one; draws depend on the keys of the frames only."""
    border = next((border for border in BORDERS if name.endswith(f"{border} border")), None)
    return [make_pair(frame, effect, seed=_SEED, border=border) for frame in frames]


def score_references(task: str, effect: Effect, frames: Iterable[Frame], pairs: list[Pair]) -> dict[str, Tensor]:
    """Score the methods without a network, see `score`: nothing, the best constant flow, and the true map."""
    if task == "undistort":
        constant = constant_flow(effect, pairs[0].clean)
        methods: dict[str, Iterator[Restored]] = {
            _NOTHING: (Restored(pair.degraded, torch.zeros_like(pair.flow)) for pair in pairs),
            "best constant flow": (_warp_back(pair, constant.expand_as(pair.flow)) for pair in pairs),
            "the true flow": (_warp_back(pair, pair.flow) for pair in pairs),
        }
    else:
        methods = {
            _NOTHING: (Restored(pair.degraded) for pair in pairs),
            "the true map": (Restored(remove_weather(frame, effect)) for frame in frames),
        }
    return {name: score(task, restored, pairs) for name, restored in methods.items()}


def score(task: str, restored: Iterable[Restored], pairs: list[Pair]) -> Tensor:
    """Score each frame; return (N, 6), float64, in the order of `Scores`."""
    scores = [_scores(TASKS[task], one, pair) for one, pair in zip(restored, pairs, strict=True)]
    return torch.cat(scores).double().cpu()


def mean_of(frames: Tensor) -> Scores:
    """Average the scores (N, 6) of frames."""
    return Scores(*frames.mean(dim=0).tolist())


def constant_flow(effect: Effect, like: Tensor) -> Tensor:
    """Average the valid restore flows of an effect over draws that are not scored; return (1, 2, H, W), px."""
    total, count = torch.zeros_like(like[:1, :2], dtype=torch.float64), torch.zeros_like(like[:1, :1])
    for keys in torch.arange(_CONSTANT_DRAWS, device=like.device).split(8):
        blank = Frame(like.new_zeros(len(keys), *like.shape[1:]), keys, torch.empty(0))
        pair = make_pair(blank, effect, seed=_SEED - 1)
        total += (pair.flow * pair.valid).sum(dim=0, keepdim=True)
        count += pair.valid.sum(dim=0, keepdim=True)
    return (total / count.clamp(min=1)).to(like)


def remove_weather(frame: Frame, effect: Effect) -> Tensor:
    """Restore the degraded image, rounded to 8 bits, by its true map; return (B, 3, H, W)."""
    degraded = effect.degrade(frame.image, seed=_SEED, keys=frame.key)
    image = to_float(to_uint8(degraded.image))
    if isinstance(effect, LensFlare):
        return torch.where(degraded.valid, image - degraded.intensity, image)
    return remove_fog(image, degraded.transmission, degraded.params.airlight)[0].clamp(0, 1)


def _warp_back(pair: Pair, flow: Tensor) -> Restored:
    return Restored(warp(pair.degraded, flow, padding="border")[0], flow)


def _scores(task: Task, restored: Restored, pair: Pair) -> Tensor:
    """Score each frame of a batch; return (B, 6), in the order of `Scores`."""
    scores = restoration_scores(task, restored, pair, metric_size=METRIC_SIZE)
    missing = torch.full_like(scores["L"], torch.nan)
    return torch.stack([scores.get(name, missing) for name in ("L", "L_rec", "L_k", "psnr", "ssim", "epe")], dim=1)


def score_task(task: str, models: dict[str, Loaded], args: argparse.Namespace) -> Iterator[Line]:
    """Yield the lines of a task: methods without a network first, for each frame size of the models."""
    for size in dict.fromkeys(loaded.size for loaded in models.values()):
        held_out = FrameFolder(args.source, size=size, split="val")
        frames = _load_frames(held_out, args.frames, args.device)
        effects = effects_of(task, size[1])
        pairs = {name: corrupt(frames, effect, name) for name, (effect, _) in effects.items()}
        groups = _group_keys(held_out, args.groups)
        references, keys = dict[str, dict[str, Tensor]](), _keys(frames)
        for name, (effect, _) in effects.items():
            for method, scores in score_references(task, effect, frames, pairs[name]).items():
                references.setdefault(method, {})[name] = scores
        for method, by_effect in references.items():
            yield from _lines(Line(task, "", "", method, _NO_SCORES, 0, size), by_effect, keys, groups)
        for loaded in (loaded for loaded in models.values() if loaded.size == size):
            if isinstance(loaded.model, Diffusion) and args.sampled < len(keys):
                sampled = evenly_spaced(len(keys), args.sampled)
                nothing = {name: scores[sampled] for name, scores in references[_NOTHING].items()}
                line = Line(task, "", "", f"{_NOTHING}, frames of DDPM", _NO_SCORES, 0, size)
                yield from _lines(line, nothing, [keys[i] for i in sampled], groups)
            yield from _score_model(task, loaded, pairs, groups, args)


def _score_model(
    task: str, loaded: Loaded, pairs: dict[str, list[Pair]], groups: dict[str, set[int]], args: argparse.Namespace
) -> Iterator[Line]:
    model = loaded.model.to(args.device)
    parameters = sum(parameter.numel() for parameter in model.get_submodule("network").parameters())
    is_sampled = isinstance(model, Diffusion)
    batches = {name: _subsample(every, args.sampled if is_sampled else 0) for name, every in pairs.items()}
    first = next(iter(batches.values()))
    for steps in args.steps if is_sampled else [0]:
        if is_sampled:
            model.steps = steps
        by_effect = {
            name: score(task, (_call(model, pair.degraded) for pair in chosen), chosen)
            for name, chosen in batches.items()
        }
        call = partial(_call_and_wait, model, first[0].degraded[:1])
        milliseconds = 1e3 * median(seconds(call, warmup=int(i == 0)) for i in range(3))
        name = f"DDPM, {steps} steps" if is_sampled else loaded.name
        line = Line(task, "", "", name, _NO_SCORES, 0, loaded.size, parameters, milliseconds)
        yield from _lines(line, by_effect, _keys(first), groups)


def _lines(of: Line, by_effect: dict[str, Tensor], keys: list[int], groups: dict[str, set[int]]) -> Iterator[Line]:
    """Yield the lines of a method from its scores by effect and frame: the mix for each group, then the effects."""
    effects = effects_of(of.task, of.size[1])
    mixed = torch.stack([by_effect[name] for name, (_, in_mix) in effects.items() if in_mix]).mean(dim=0)
    for name, group in groups.items():
        chosen = mixed[[key in group for key in keys]]
        yield replace(of, effect=MIX, group=name, scores=mean_of(chosen), frames=len(chosen))
    for effect, scores in by_effect.items():
        yield replace(of, effect=effect, group=_ALL, scores=mean_of(scores), frames=len(scores))


def format_tables(lines: Sequence[Line]) -> str:
    """Format a Markdown table for each task, effect and group."""
    parts = []
    for task, effect, group in dict.fromkeys((line.task, line.effect, line.group) for line in lines):
        of_table = [line for line in lines if (line.task, line.effect, line.group) == (task, effect, group)]
        size = f"{of_table[0].size[1]}x{of_table[0].size[0]}"
        head = ["method", "L", "L_rec", "L_k", "PSNR (dB)", "SSIM", f"EPE (px at {METRIC_SIZE[1]}x{METRIC_SIZE[0]})"]
        head += ["x do nothing", "frames", "parameters", f"ms per frame of {size}"]
        nothing = {line.frames: line.scores for line in of_table if line.method.startswith(_NOTHING)}
        rows = [_cells(line, nothing[line.frames]) for line in of_table]
        if effect == MIX and group == _ALL:
            rows += [_paper_cells(name, *values) for name, values in PAPER[task].items()]
        title = f"### {task}: {effect}" + ("" if group == _ALL else f", frames {group}")
        parts.append(f"{title}\n\n{markdown(head, rows)}")
    return "\n\n".join(parts)


def _cells(line: Line, nothing: Scores) -> list[str]:
    s = line.scores
    numbers = [f"{s.loss:.4f}", f"{s.image_loss:.4f}", _or_empty(s.flow_loss, ".4f"), f"{s.psnr:.2f}", f"{s.ssim:.3f}"]
    numbers += [_or_empty(s.epe, ".2f"), _or_empty(s.epe / nothing.epe if nothing.epe else s.epe, ".2f")]
    cost = [str(line.frames), "" if line.parameters is None else f"{line.parameters / 1e6:.1f} M"]
    return [line.method, *numbers, *cost, "" if line.milliseconds is None else f"{line.milliseconds:.0f}"]


def _paper_cells(name: str, *values: float | None) -> list[str]:
    loss, image_loss, map_loss, psnr, epe = ("" if value is None else f"{value:g}" for value in values)
    return [f"paper: {name}, on its own frames", loss, image_loss, map_loss, psnr, "", epe, *[""] * 4]


def _or_empty(value: float, form: str) -> str:
    return "" if math.isnan(value) else format(value, form)


def _load_frames(held_out: FrameFolder, limit: int, device: torch.device) -> list[Frame]:
    """Load batches of up to `limit` held-out frames, evenly chosen; 0 loads all."""
    chosen = Subset(held_out, evenly_spaced(len(held_out), limit or len(held_out)))
    return [Frame(*(value.to(device) for value in batch)) for batch in DataLoader(chosen, batch_size=_BATCH)]


def _group_keys(held_out: FrameFolder, prefixes: Sequence[str]) -> dict[str, set[int]]:
    """Return the keys of all frames, of those whose names start with each prefix, and of the others."""
    names = {key: path.name for key, path in zip(held_out.keys, held_out.paths, strict=True)}
    groups = {f"{start}*": {key for key, name in names.items() if name.startswith(start)} for start in prefixes}
    others = {"others": set(names).difference(*groups.values())} if groups else {}
    return {name: keys for name, keys in ({_ALL: set(names)} | groups | others).items() if keys}


def _keys(batches: Sequence[Frame | Pair]) -> list[int]:
    return [key for batch in batches for key in batch.key.tolist()]


def _subsample(pairs: list[Pair], limit: int) -> list[Pair]:
    """Choose up to `limit` frames of the batches, evenly, in new batches; 0 keeps all."""
    if not limit:
        return pairs
    every = [torch.cat(values) for values in zip(*pairs, strict=True)]
    chosen = torch.tensor(evenly_spaced(len(every[0]), limit), device=every[0].device)
    return [Pair(*(value[rows] for value in every)) for rows in chosen.split(_BATCH)]


@torch.inference_mode()
def _call(model: Restore, image: Tensor) -> Restored:
    return model(image)


def _call_and_wait(model: Restore, image: Tensor) -> Tensor:
    # The copy to the CPU waits until the device has finished.
    return _call(model, image).image.cpu()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--source", type=Path, required=True, help="a folder of frames of several drives")
    parser.add_argument("--scale", choices=SCALES, default="small", help="scale of the experiments, small")
    parser.add_argument("--rows", nargs="+", choices=ROWS, default=list(ROWS), help="models and tasks, all six")
    parser.add_argument("--frames", type=count(0), default=0, help="number of held-out frames to score, all")
    parser.add_argument("--steps", type=count(1), nargs="+", default=[10, 50, 250], help="steps of diffusion models")
    parser.add_argument("--sampled", type=count(1), default=8, help="frames that a diffusion model restores, 8")
    parser.add_argument("--options", nargs="+", default=[], help="of torchrefract.train, for all trainings")
    parser.add_argument("--groups", nargs="+", default=[], help="prefixes of frame names, each scored as a group")
    parser.add_argument("--device", type=torch.device, default=torch.device("cpu"), help="device that scores, cpu")
    parser.add_argument("--threads", type=count(1), default=2, help="CPU threads, 2")
    parser.add_argument("--out", type=Path, help="folder of the trainings, benchmarks/results/table1_SCALE")
    return parser


if __name__ == "__main__":
    main()
