"""Time effects with gradients, and training steps of the ResUNet with corruption on the fly.

python benchmarks/training.py [--batch 16] [--size 256x256] [--threads 2] [--repeats 15] [--rounds 5]
                              [--encoder tu-resnet34] [--out benchmarks/results/training.json]
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial

import torch
from timing import (
    GRID_SAMPLE,
    RESULTS,
    Bar,
    Candidate,
    Conditions,
    alternate,
    count,
    effects,
    measure,
    parser,
    references,
    save,
    table,
)
from torch import Tensor

from torchrefract import presets
from torchrefract.data.module import make_pair
from torchrefract.data.road_scenes import render_road_scenes
from torchrefract.effects.base import Effect
from torchrefract.restoration.models.coordconv import ResUNet
from torchrefract.restoration.tasks import Deweather, Task, Undistort
from torchrefract.types import Frame

WHAT = (
    "First table: effect(image) with new draws in every call and the gradient of the image, forward and backward, in "
    "multiples of a bare F.grid_sample of the same batch with the same gradient; warps within 0.05 px. Further tables: "
    "a training step of the ResUNet (forward, loss, backward, AdamW) from pairs made before, and with pairs made on "
    "the fly (degraded image, restore flow and its validity), in turn."
)
BARE = f"{GRID_SAMPLE}, forward + backward"
BEFORE, FLY = "step, pairs made before", "step, pairs made on the fly"
EFFECT_LIMIT, STEP_LIMIT = 1.3, 1.08  # largest multiples of the references
SEED = 7
TASKS: Mapping[str, tuple[Callable[[], Task], Callable[[], Effect]]] = {
    "undistort, cheap_dashcam": (Undistort, presets.cheap_dashcam),
    "deweather, cape_town_fog": (Deweather, presets.cape_town_fog),
}


def main() -> None:
    """Measure, print and save; a limit that does not hold is marked and is no failure of the command."""
    options = parser(__doc__, out=RESULTS / "training.json", frame_size=(256, 256))
    options.add_argument("--batch", type=count(1), default=16, help="frames at once, 16")
    options.add_argument("--rounds", type=count(1), default=5, help="of steps, 5")
    options.add_argument("--encoder", default="tu-resnet34", help="of the ResUNet, tu-resnet34")
    args = options.parse_args()
    torch.set_num_threads(args.threads)
    torch.manual_seed(0)
    keys = torch.arange(args.batch)
    image, depth = render_road_scenes(keys, *args.size, seed=SEED)
    conditions = Conditions.now(image, threads=args.threads, repeats=args.repeats)
    print(WHAT, end="\n\n", flush=True)
    timings = measure(candidates(image, effects()), references=(BARE,), repeats=args.repeats, threads=args.threads)
    bars = [Bar(t.name, t.ratios[BARE].median, "<=", EFFECT_LIMIT, "x bare") for t in timings if t.name != BARE]
    print(table(timings, conditions), "", *bars, "", sep="\n", flush=True)
    steps_by_task = {}
    for name, (task, scene) in TASKS.items():
        candidates_of_task = training_steps(Frame(image, keys, depth), task(), scene(), encoder=args.encoder)
        steps_by_task[name] = alternate(candidates_of_task, reference=BEFORE, rounds=args.rounds)
        bars.append(Bar(name, steps_by_task[name][1].ratios[BEFORE].median, "<=", STEP_LIMIT, f"x the {BEFORE}"))
        print(table(steps_by_task[name]), bars[-1], "", sep="\n", flush=True)
    steps = {name: [asdict(timing) for timing in timed] for name, timed in steps_by_task.items()}
    save(args.out, timings, conditions, what=WHAT, bars=bars, steps=steps)


def candidates(frames: Tensor, chosen: Mapping[str, Effect]) -> dict[str, Candidate]:
    """Return calls that run forward and backward on a batch (B, C, H, W), one an effect; the reference is first."""
    image = frames.clone().requires_grad_()
    upstream = torch.rand_like(frames)
    forward: dict[str, Candidate] = {BARE: references(image)[GRID_SAMPLE]}
    for name, effect in chosen.items():
        forward[name] = lambda effect=effect: effect(image)

    def backward(call: Candidate) -> Tensor:
        return torch.autograd.grad(torch.as_tensor(call()), image, upstream)[0]

    return {name: partial(backward, call) for name, call in forward.items()}


def training_steps(frames: Frame, task: Task, scene: Effect, *, encoder: str) -> dict[str, Candidate]:
    """Return a training step with fixed pairs, and one that makes its pairs."""
    network = ResUNet(task.channels, smooth=task.smooth, encoder=encoder).train()
    optimizer = torch.optim.AdamW(network.parameters(), lr=1e-4)
    fixed = make_pair(frames, scene, seed=SEED)
    seeds = iter(range(1 << 30))

    def step(on_the_fly: bool) -> Tensor:
        pair = make_pair(frames, scene, seed=next(seeds)) if on_the_fly else fixed
        loss = task.loss(task.restore(network(pair.degraded), pair.degraded), pair)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        return loss

    return {BEFORE: lambda: step(False), FLY: lambda: step(True)}


if __name__ == "__main__":
    main()
