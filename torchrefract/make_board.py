"""Make a calibration board to print: `python -m torchrefract.make_board out=board.pdf`."""

import hydra
from omegaconf import DictConfig

from torchrefract._io import CONFIG_DIR
from torchrefract.cli.calibration import make_board
from torchrefract.cli.command import command, job


@command("make_board")
@hydra.main(config_path=CONFIG_DIR, config_name="make_board", version_base="1.3")
@job
def main(cfg: DictConfig) -> None:
    """Run `cli.calibration.make_board` with the options of the command line."""
    make_board(cfg)


if __name__ == "__main__":
    main()
