"""Remove lens distortion from pictures or videos: `python -m torchrefract.rectify input=DIR camera=camera.yaml`."""

import hydra
from omegaconf import DictConfig

from torchrefract._io import CONFIG_DIR
from torchrefract.cli.calibration import rectify
from torchrefract.cli.command import command, job


@command("rectify")
@hydra.main(config_path=CONFIG_DIR, config_name="rectify", version_base="1.3")
@job
def main(cfg: DictConfig) -> None:
    """Run `cli.calibration.rectify` with the options of the command line."""
    rectify(cfg)


if __name__ == "__main__":
    main()
