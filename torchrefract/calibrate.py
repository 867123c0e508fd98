"""Calibrate a camera from pictures of a board: `python -m torchrefract.calibrate images=pictures squares=11x8`."""

import hydra
from omegaconf import DictConfig

from torchrefract._io import CONFIG_DIR
from torchrefract.cli.calibration import calibrate
from torchrefract.cli.command import command, job


@command("calibrate")
@hydra.main(config_path=CONFIG_DIR, config_name="calibrate", version_base="1.3")
@job
def main(cfg: DictConfig) -> None:
    """Run `cli.calibration.calibrate` with the options of the command line."""
    calibrate(cfg)


if __name__ == "__main__":
    main()
