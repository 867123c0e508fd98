"""Score a checkpoint: `python -m torchrefract.eval +task=undistort ckpt_path=<run>/best.ckpt`."""

import hydra
from omegaconf import DictConfig

from torchrefract._io import CONFIG_DIR
from torchrefract.cli.command import command, job
from torchrefract.cli.training import evaluate


@command("eval")
@hydra.main(config_path=CONFIG_DIR, config_name="eval", version_base="1.3")
@job
def main(cfg: DictConfig) -> None:
    """Score a checkpoint on the validation data of a configuration."""
    evaluate(cfg)


if __name__ == "__main__":
    main()
