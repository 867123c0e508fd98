"""Restore pictures and videos: `python -m torchrefract.restore ckpt_path=<run>/best.ckpt input=DIR out=DIR`.

Files that are restored already are kept, so the same command continues an interrupted run.

Options:
    ckpt_path=FILE          a checkpoint of `train`, or lens_small, required
    input=PATH              a picture, a video, or a folder of them with its subfolders, required
    out=restored            output folder; names and subfolders are those of the input
    size=[720,1280]         [height, width] to which frames are resized for the model; default: that of its training
    tile=512                px or [height, width]; a model of deweather sees tiles in place of the resized frame
    pool=auto               one lens for each video, from a lens model's flows and straight edges, so that the result
                            does not shake; lens: one for all files, of one camera; null: each frame alone
    interpolation=bicubic   of the warp along a predicted flow; or bilinear
    side_by_side=false      true writes the input to the left of the restoration
    deviation=false         true writes the standard deviation of the flow of a diffusion model beside each picture, as
                            NAME.deviation.png, a gray PNG of 16 bits in steps of 1/256 px
    batch=4                 pictures, frames or tiles that are restored together; device=cpu or cuda: where

Examples:
    python -m torchrefract.restore ckpt_path=best.ckpt input=drive.mp4 side_by_side=true
    python -m torchrefract.restore ckpt_path=ddpm.ckpt input=frames out=clear device=cuda batch=16 +model.steps=50

`+model.steps=50` changes a value of the model, here of a diffusion model.
"""

from torchrefract.cli.entry import command

main = command("restore", __doc__, "restoration:restore")

if __name__ == "__main__":
    main()
