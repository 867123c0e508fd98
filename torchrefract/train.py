"""Train a restoration: `python -m torchrefract.train +task=undistort`."""

from torchrefract.cli.command import command, require_task
from torchrefract.cli.restoration import train

main = command("train", train, prepare=require_task)

if __name__ == "__main__":
    main()
