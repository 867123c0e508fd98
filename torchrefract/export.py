"""Export a model for other programs: `python -m torchrefract.export ckpt_path=<run>/best.ckpt out=model.onnx`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import hydra
import torch
from omegaconf import DictConfig

from torchrefract._io import CONFIG_DIR, replace_file
from torchrefract._validation import UsageError, check_choice
from torchrefract.cli.command import command, job, naming
from torchrefract.programs import FORMATS, outputs_of, save_program, traced
from torchrefract.restoration.loading import Loaded, load_model
from torchrefract.restoration.module import Restoration
from torchrefract.restoration.restorer import Restoring

_BARS = {"restored": 1e-3, "flow": 1e-2}  # of the range of an image, and px


@command("export")
@hydra.main(config_path=CONFIG_DIR, config_name="export", version_base="1.3")
@job
def main(cfg: DictConfig) -> None:
    """Write the program, once it computes what the model does."""
    out, loaded = Path(str(cfg.out)), load_model(Path(str(cfg.ckpt_path)))
    with naming("out"):
        check_choice("out", out.suffix, FORMATS)
        out.parent.mkdir(parents=True, exist_ok=True)
    if not isinstance(loaded.model, Restoration):
        raise UsageError(
            f"ckpt_path must be of a model that restores in one step, got {cfg.ckpt_path} of {loaded.name}"
        )
    height, width = loaded.size if cfg.size is None else _size(str(cfg.size))
    with naming("interpolation"):
        network = Restoring(loaded.model, size=loaded.size, interpolation=str(cfg.interpolation)).eval()
    images = torch.rand(2, 3, height, width, generator=torch.Generator().manual_seed(0))
    # torch.export warns of weights in another order.
    program = traced(network.to(memory_format=torch.contiguous_format), images)  # pyright: ignore[reportCallIssue]  # missing in torch's annotations
    with torch.no_grad():
        expected = network(images)
    about = _about(loaded, (height, width), [*_BARS][: len(expected)])
    with replace_file(out) as path:
        save_program(program, path, about=about)
        errors = _errors(path, images, expected)
    told = ", ".join(f"{name} off by {error:.1e} at most" for name, error in errors.items())
    print(f"{out}: {loaded.name} for {loaded.task}, frames of {height}x{width}, any batch; beside the model {told}")


def _size(text: str) -> tuple[int, int]:
    sides = text.lower().split("x")
    if len(sides) != 2 or not all(side.isdecimal() and int(side) > 0 for side in sides):
        raise UsageError(f"size must be height x width, as 720x1280, got {text}")
    return int(sides[0]), int(sides[1])


def _about(loaded: Loaded, size: tuple[int, int], outputs: list[str]) -> dict[str, Any]:
    return {
        "model": loaded.name,
        "task": loaded.task,
        "input": f"image, (B, 3, {size[0]}, {size[1]}), RGB in [0, 1]",
        "outputs": outputs,
        "licenses": loaded.licenses,
    }


def _errors(path: Path, images: torch.Tensor, expected: Sequence[torch.Tensor]) -> dict[str, float]:
    """By how much a written program differs from the model, in a batch that it was not made with, too."""
    errors = dict.fromkeys([*_BARS][: len(expected)], 0.0)
    for some in (slice(0, 2), slice(0, 1)):
        for name, found, value in zip(errors, outputs_of(path, images[some]), expected, strict=False):
            errors[name] = max(errors[name], (found - value[some]).abs().max().item())
    if wrong := [name for name, error in errors.items() if not error <= _BARS[name]]:
        raise UsageError(f"out must compute what the model does, got {wrong[0]} off by {errors[wrong[0]]:.1e}")
    return errors


if __name__ == "__main__":
    main()
