"""Calibrate a camera from pictures of a board: `python -m torchrefract.calibrate images=pictures squares=11x8`."""

from torchrefract.cli.calibration import calibrate
from torchrefract.cli.command import command

main = command("calibrate", calibrate)

if __name__ == "__main__":
    main()
