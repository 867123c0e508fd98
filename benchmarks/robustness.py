"""Compare the time of the robustness command with that of the model alone, on the same pictures.

    python benchmarks/robustness.py --root FRAMES [--count 4] [--models opencv:hog]

Six scenes at five severities, as `python -m torchrefract.robustness` scores them by default. The model predicts 31
pictures of each frame: once inside of the evaluation, and once alone. Times are seconds of the CPU, on one thread.
Architectures of torchvision have random weights, which change no time of their network; the file of weights is read by
the loading code of the command.
"""

import argparse
import tempfile
import time
import warnings
from collections.abc import Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path
from statistics import median
from typing import Any

import torch
from severity import frames_in
from timing import Bar, count, seconds, size
from torch import Tensor
from torchvision import models

from torchrefract import presets
from torchrefract._tensor import sharing_results
from torchrefract.cli.robustness import choose_score
from torchrefract.data.road_scenes import render_road_scenes
from torchrefract.effects.base import Effect
from torchrefract.robustness.evaluate import evaluate
from torchrefract.robustness.predictors import Predict, load_predictor
from torchrefract.robustness.quantities import SCENES, quantity_of
from torchrefract.robustness.scores import as_labels

LIMIT = 1.2  # of the time of the evaluation over that of the model
MODELS = ("opencv:hog", "torchvision:ssdlite320_mobilenet_v3_large", "torchvision:fasterrcnn_resnet50_fpn")
DAY_SCENES = [name for name in SCENES if name != "night_fog"]
cpu_seconds = partial(seconds, clock=time.process_time)
_ONE_BOX = {"boxes": torch.tensor([[0.0, 0, 9, 9]]), "labels": torch.ones(1).long(), "scores": torch.ones(1)}


def main() -> None:
    """Measure and print; a limit that does not hold is marked and is no failure of the command."""
    options = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    options.add_argument("--root", type=Path, help="folder of pictures; without one, rendered roads")
    options.add_argument("--size", type=size, default=(360, 640), help="height x width of rendered roads, 360x640")
    options.add_argument("--count", type=count(1), default=4, help="frames, 4")
    options.add_argument("--models", nargs="*", default=MODELS, help="opencv:hog or torchvision:name, or none")
    args = options.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")  # of the assumed depth
    frames = (
        list(render_road_scenes(torch.arange(args.count), *args.size)[0])
        if args.root is None
        else [frame[0] for frame in frames_in(args.root, args.count, [])]
    )
    print("CPU ms for a picture, by severity")
    for name, costs in scene_costs(frames).items():
        print(f"{name:20}", *(f"{1e3 * cost:6.1f}" for cost in costs.values()))
    for model in args.models:
        bare, evaluation = model_cost(load(model), frames)
        print(f"\n{model}: {bare:.2f} s alone, {evaluation:.2f} s in the evaluation of a frame")
        print(Bar(model, evaluation / bare, "<=", LIMIT, "x the model alone"))


@lru_cache
def scenes(width: int) -> Mapping[str, Mapping[int, Effect]]:
    """Return the scenes of the command for frames of a width, by name and severity."""
    return {name: {s: getattr(presets, name)(s, width=width) for s in presets.SEVERITIES} for name in DAY_SCENES}


def scene_costs(frames: Sequence[Tensor]) -> dict[str, dict[int, float]]:
    """Return the median seconds of the CPU that each scene takes at each severity, all of them on one frame in turn.

    Args:
        frames: (3, H, W) each; the scenes look for the sky of a frame once.
    """
    by_name = scenes(frames[0].shape[-1])
    costs: dict[str, dict[int, list[float]]] = {name: {s: [] for s in by} for name, by in by_name.items()}
    for frame in [frames[0], *frames]:  # the first time makes plans and compiles kernels
        for name, by in by_name.items():
            with sharing_results():
                for severity, effect in by.items():
                    costs[name][severity].append(cpu_seconds(partial(effect.degrade, frame, seed=0, keys=[0])))
    return {name: {severity: median(of[1:]) for severity, of in by.items()} for name, by in costs.items()}


def load(model: str) -> Predict:
    """Load a model, one of torchvision with random weights."""
    kind, _, name = model.partition(":")
    if kind != "torchvision":
        return load_predictor(model)
    with tempfile.TemporaryDirectory() as folder:
        weights = Path(folder) / "weights.pth"
        torch.save(models.get_model(name, weights=None, weights_backbone=None).state_dict(), weights)
        return load_predictor(model, weights=str(weights))


def model_cost(predict: Predict, frames: Sequence[Tensor]) -> tuple[float, float]:
    """Return the seconds of the CPU for a frame (3, H, W) of a model alone and of the evaluation, the model with it."""
    pictures: list[Tensor] = []

    def recorded(images: Tensor) -> object:
        pictures.append(images)
        return predict(images)

    by_name = scenes(frames[0].shape[-1])
    quantities = {name: of for name, by in by_name.items() if (of := quantity_of(by.values()))}
    options: dict[str, Any] = {"as_target": as_labels, "quantities": quantities}
    samples = [(f"frame {i}", frame, None) for i, frame in enumerate(frames)]
    evaluate(lambda _: [_ONE_BOX], samples[:1], by_name, choose_score, **options)  # makes plans and compiles kernels
    evaluation = cpu_seconds(lambda: evaluate(recorded, samples, by_name, choose_score, **options))
    bare = cpu_seconds(lambda: [predict(picture) for picture in pictures])
    return bare / len(frames), evaluation / len(frames)


if __name__ == "__main__":
    main()
