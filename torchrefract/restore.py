"""Restore pictures and videos: `python -m torchrefract.restore ckpt_path=<run>/best.ckpt input=DIR out=DIR`."""

import hydra
from omegaconf import DictConfig

from torchrefract._io import CONFIG_DIR
from torchrefract.cli.command import command, job
from torchrefract.cli.restoration import restore


@command("restore")
@hydra.main(config_path=CONFIG_DIR, config_name="restore", version_base="1.3")
@job
def main(cfg: DictConfig) -> None:
    """Restore all pictures and videos of a folder."""
    restore(cfg)


if __name__ == "__main__":
    main()
