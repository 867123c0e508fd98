"""Make a calibration board to print: `python -m torchrefract.make_board out=board.pdf`."""

from torchrefract.cli.calibration import make_board
from torchrefract.cli.command import command

main = command("make_board", make_board)

if __name__ == "__main__":
    main()
