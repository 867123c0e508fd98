"""Score a checkpoint: `python -m torchrefract.eval +task=undistort ckpt_path=<run>/best.ckpt`."""

from torchrefract.cli.command import command, require_task
from torchrefract.cli.restoration import evaluate

main = command("eval", evaluate, prepare=require_task)

if __name__ == "__main__":
    main()
