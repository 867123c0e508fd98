"""Train a restoration: `python -m torchrefract.train +task=undistort`."""

import hydra
from omegaconf import DictConfig

from torchrefract._io import CONFIG_DIR
from torchrefract.cli.command import command, job, require_task
from torchrefract.cli.training import make_job


@command("train", prepare=require_task)
@hydra.main(config_path=CONFIG_DIR, config_name="train", version_base="1.3")
@job
def main(cfg: DictConfig) -> None:
    """Fit the model of a configuration to its data."""
    made = make_job(cfg)
    made.trainer.fit(made.model, made.data, ckpt_path=cfg.ckpt_path, weights_only=True)


if __name__ == "__main__":
    main()
