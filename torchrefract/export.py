"""Export a model for other programs: `python -m torchrefract.export ckpt_path=<run>/best.ckpt out=model.onnx`."""

from torchrefract.cli.command import command
from torchrefract.cli.restoration import export

main = command("export", export)

if __name__ == "__main__":
    main()
