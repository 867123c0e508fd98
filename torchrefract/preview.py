"""Draw effects on a picture, a video or a folder of frames: `python -m torchrefract.preview image.jpg`."""

import hydra
from omegaconf import DictConfig

from torchrefract._io import CONFIG_DIR
from torchrefract.cli.command import command, job, picture_as_option
from torchrefract.cli.preview import preview


@command("preview", prepare=picture_as_option)
@hydra.main(config_path=CONFIG_DIR, config_name="preview", version_base="1.3")
@job
def main(cfg: DictConfig) -> None:
    """Write a contact sheet or an animation of effects."""
    preview(cfg)


if __name__ == "__main__":
    main()
