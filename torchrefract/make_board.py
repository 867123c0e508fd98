"""A board to print: `python -m torchrefract.make_board out=board.pdf`."""

from pathlib import Path

import hydra
from omegaconf import DictConfig

from torchrefract._io import CONFIG_DIR, replace_file
from torchrefract._validation import UsageError, check_number
from torchrefract.board_prints import board_page
from torchrefract.cli.command import command, job, make, naming

_FORMATS = (".pdf", ".png")


@command("make_board")
@hydra.main(config_path=CONFIG_DIR, config_name="make_board", version_base="1.3")
@job
def main(cfg: DictConfig) -> None:
    """Write a board as PDF or PNG."""
    board, out = make(cfg, "board"), Path(str(cfg.out))
    with naming("dpi"):
        dpi = check_number("dpi", cfg.dpi, low=20.0, high=2400.0)
    with naming("margin_mm"):
        margin = check_number("margin_mm", cfg.margin_mm, low=0.0, high=1000.0)
    if out.suffix.lower() not in _FORMATS:
        raise UsageError(f"out must end in {' or '.join(_FORMATS)}, got {out}")
    try:
        with replace_file(out) as path:
            board_page(board, margin_mm=margin).savefig(path, dpi=dpi)
    except OSError as error:
        raise UsageError(f"{out} could not be written: {error.strerror}") from error
    width, height = board.size_mm
    print(f"{out}: {board.describe()}, {width:g} x {height:g} mm; print it at 100 % and measure the line below it")


if __name__ == "__main__":
    main()
