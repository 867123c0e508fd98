"""Write pairs to disk: `python -m torchrefract.generate scene=NAME source=DIR out=DIR license="CC BY 4.0"`.

A pair is a clean and a degraded frame with the maps that undo the degradation. The same command continues an
interrupted set; README.md in the output folder describes the complete set.

Options:
    scene=NAME              degradation, required: cheap_dashcam, cape_town_fog, paper_refractive, paper_weather, ...
    source=PATH             folder of images or of videos, or a video, required
    out=DIR                 folder of the pairs, required
    license=TEXT            of the source, stated in the README of the set, required
    count=N                 number of pairs; default: one for each frame
    size=[720,1280]         [height, width] to which frames are cropped and reduced, px
    depth=DIR               folder of depth maps, as estimate_depth writes
    camera=FILE             camera file of the frames, see cameras/README.md; horizon=0.5 of their height, 0 at the top
    tar=N                   pairs in a tar of WebDataset's layout; default: files; maps=png, or npz and safetensors,
                            which have full precision
    workers=N               processes; val_share=0.2 of the frames in the validation split

Examples:
    python -m torchrefract.generate scene=paper_refractive source=frames out=pairs license="CC BY 4.0"
    python -m torchrefract.generate scene=cape_town_fog source=drive.mp4 out=fog count=16000 tar=1000 license=CC0
"""

from torchrefract.cli.entry import command

main = command("generate", __doc__, "generation:generate")

if __name__ == "__main__":
    main()
