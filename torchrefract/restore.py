"""Restore pictures and videos: `python -m torchrefract.restore ckpt_path=<run>/best.ckpt input=DIR out=DIR`."""

from torchrefract.cli.command import command
from torchrefract.cli.restoration import restore

main = command("restore", restore)

if __name__ == "__main__":
    main()
