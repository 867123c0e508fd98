"""Look at effects on a picture: `python -m torchrefract.preview image.jpg`."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from matplotlib.figure import Figure
from omegaconf import DictConfig
from torch import Tensor

from torchrefract._command import UsageError, check_seed, command, job, make, naming, with_picture
from torchrefract._config import CONFIG_DIR
from torchrefract.data.images import check_size, fit, read_image
from torchrefract.data.road_scenes import render_road_scenes
from torchrefract.effects.base import Effect
from torchrefract.restoration.files import replacing
from torchrefract.sheet import make_row, sheet

_RENDERED = (540, 960)  # height and width


@command("preview", prepare=with_picture)
@hydra.main(config_path=CONFIG_DIR, config_name="preview", version_base="1.3")
@job
def main(cfg: DictConfig) -> None:
    """Draw the effects of a configuration on a picture."""
    seed, effects = check_seed(cfg.seed), _effects(cfg)
    frame, depth, name = _frame(cfg)
    with _writing(str(cfg.out)) as path:
        rows = []
        for title, effect in effects.items():
            with naming(title):
                rows.append(make_row(title, effect, frame=frame, depth=depth, seed=seed))
        height, width = frame.shape[2:]
        sheet(rows, title=f"{name}, {width} x {height} px, seed {seed}").savefig(path)
    print(f"{cfg.out}: {', '.join(effects)} on {name}")


def _effects(cfg: DictConfig) -> dict[str, Effect]:
    """Those to draw, by name."""
    if cfg.scene is not None:
        effects = {str(HydraConfig.get().runtime.choices["scene"]): make(cfg, "scene")}
    elif isinstance(cfg.effects, DictConfig):
        effects = {name: make(cfg.effects, name) for name in map(str, cfg.effects)}
    else:
        effects = {}
    if not effects:
        raise UsageError(f"effects must be at least one effect with its name, got {cfg.effects}")
    for name, effect in effects.items():
        if not isinstance(effect, Effect):
            raise UsageError(f"{name} must be an effect of torchrefract, got {effect}")
    return effects


def _frame(cfg: DictConfig) -> tuple[Tensor, Tensor | None, str]:
    """The frame (1, 3, H, W), its depth where that is known, and what it is called."""
    with naming("size"):
        size = None if cfg.size is None else check_size("size", cfg.size)
    if cfg.image is None:
        with naming("size"):
            image, depth = render_road_scenes(torch.tensor([cfg.seed]), *(size or _RENDERED))
        return image, depth, "a rendered road scene, as no picture was given"
    image = read_image(str(cfg.image))
    if size is not None:
        with naming("size"):
            image = fit(image, size)
    return image[None].contiguous(), None, _printable(Path(str(cfg.image)).name)


def _printable(name: str) -> str:
    """A file's name in one line that is not too long."""
    name = "".join(letter if letter.isprintable() else "?" for letter in name)
    return name if len(name) <= 60 else f"{name[:40]}…{name[-19:]}"


@contextmanager
def _writing(out: str) -> Iterator[Path]:
    """A name to write the sheet to; that it cannot be written is found at once."""
    formats = sorted(Figure().canvas.get_supported_filetypes())
    if Path(out).suffix.lower().removeprefix(".") not in formats:
        raise UsageError(f"out must end in one of .{', .'.join(formats)}, got {out}")
    if Path(out).is_dir():
        raise UsageError(f"out must be a file, got the folder {out}")
    try:
        with replacing(Path(out)) as path:
            path.touch()
            yield path
    except OSError as error:
        raise UsageError(f"{out} could not be written: {error.strerror}") from error


if __name__ == "__main__":
    main()
