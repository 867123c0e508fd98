"""Degrade pictures and videos: `python -m torchrefract.degrade source=DIR out=DIR scene=NAME severity=3`.

Writes the degraded files under their names; files that exist already are kept. The draw of a file depends on its name
and the seed alone. A video is one clip: its lens stays, its fog moves with the wind. With labels or maps, pictures lie
in out/images, labels in out/labels and maps in out/maps.

Options:
    source=PATH             picture, video, or folder of them with its subfolders, required
    out=DIR                 output folder, required
    scene=NAME              degradation, required: cheap_dashcam, cape_town_fog, unpaved_road, paper_weather, ...
    severity=3              1 (barely visible) to 5
    labels=PATH             of the pictures: COCO JSON, folder of YOLO txt files, or folder of masks of the same names
    maps=false              true writes flow, transmission and masks as PNG, as generate does; or npz, safetensors
    drive_by=folder         draw the pictures of each drive once, as the frames of a video: auto, folder or prefix
    depth=DIR               folder of depth maps, as estimate_depth writes
    camera=FILE             camera file of the frames, see cameras/README.md; horizon=0.5 of their height, 0 at the top
    workers=N               processes, each of which degrades one file at a time; seed=0 of the draws

Examples:
    python -m torchrefract.degrade source=drive.mp4 out=fog scene=cape_town_fog
    python -m torchrefract.degrade source=val2017 labels=instances_val2017.json out=lens scene=cheap_dashcam severity=5
"""

from torchrefract.cli.entry import command

main = command("degrade", __doc__, "degradation:degrade")

if __name__ == "__main__":
    main()
