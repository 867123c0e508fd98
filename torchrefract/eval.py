"""Score a checkpoint: `python -m torchrefract.eval +task=undistort ckpt_path=<run>/best.ckpt`."""

import hydra
from omegaconf import DictConfig

from torchrefract._io import CONFIG_DIR
from torchrefract.cli.command import command, job, require_task
from torchrefract.cli.training import evaluate


@command("eval", prepare=require_task)
@hydra.main(config_path=CONFIG_DIR, config_name="eval", version_base="1.3")
@job
def main(cfg: DictConfig) -> None:
    """Score a checkpoint on the validation data of a configuration."""
    evaluate(cfg)


if __name__ == "__main__":
    main()
