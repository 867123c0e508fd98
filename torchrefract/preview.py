"""Draw effects on a picture, a video or a folder of frames: `python -m torchrefract.preview image.jpg`.

A contact sheet shows each effect, its map and the restored picture; the suffix of an animation gives an animation.
Without a picture, the effects are drawn on a rendered road scene. The first run compiles for about a minute.

Options:
    image=FILE              picture, video or folder of frames; may be given without `image=`
    out=preview.png         .gif, .webp, .apng and .mp4 are animations, other formats contact sheets
    scene=NAME              a scene in place of all effects: cheap_dashcam, cape_town_fog, paper_weather, ...
    scene.severity=3        1 to 5
    depth=PATH              depth of the picture: 16-bit PNG, or .npy in m; a folder of maps, one for each frame, as
                            estimate_depth writes them; depth_scale=0.00390625 m per step of PNGs
    camera=FILE             camera file of the frames, see cameras/README.md; horizon=0.5 of their height, 0 at the top
    size=[540,960]          [height, width] to which the picture is cropped and reduced, px
    frames=48               largest number of frames of an animation
    fps=12                  frames per second of an animation
    seed=0                  of the draws

Examples:
    python -m torchrefract.preview image.jpg scene=cape_town_fog scene.severity=5
    python -m torchrefract.preview drive.mp4 scene=highveld_heat_haze out=haze.gif
"""

from torchrefract.cli.entry import command

main = command("preview", __doc__, "preview:preview")

if __name__ == "__main__":
    main()
