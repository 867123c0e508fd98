"""Export a model for other programs: `python -m torchrefract.export ckpt_path=<run>/best.ckpt out=model.onnx`.

The file takes frames of one size and any batch size. The command compares it with the model and prints the difference.

Options:
    ckpt_path=FILE          a checkpoint of `train`, or lens_small, required
    out=model.onnx          or .pt2, a program of torch.export; or .safetensors, the weights alone
    size=720x1280           HEIGHTxWIDTH of the frames that the file accepts, px; default: that of the training
    interpolation=bicubic   of the warp along a predicted flow; or bilinear

Examples:
    python -m torchrefract.export ckpt_path=best.ckpt size=720x1280
    python -m torchrefract.export ckpt_path=best.ckpt out=model.pt2 interpolation=bilinear
"""

from torchrefract.cli.entry import command

main = command("export", __doc__, "restoration:export")

if __name__ == "__main__":
    main()
