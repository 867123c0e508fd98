"""Restore pictures and videos: `python -m torchrefract.restore ckpt_path=<run>/best.ckpt input=DIR out=DIR`."""

from torchrefract.cli.restoration import main

if __name__ == "__main__":
    main()
