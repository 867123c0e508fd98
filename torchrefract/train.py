"""Train a restoration: `python -m torchrefract.train +task=undistort`."""

import hydra
from omegaconf import DictConfig

from torchrefract._io import CONFIG_DIR
from torchrefract.cli.command import command, job, require_task
from torchrefract.cli.training import train


@command("train", prepare=require_task)
@hydra.main(config_path=CONFIG_DIR, config_name="train", version_base="1.3")
@job
def main(cfg: DictConfig) -> None:
    """Train the model of a configuration on its data."""
    train(cfg)


if __name__ == "__main__":
    main()
