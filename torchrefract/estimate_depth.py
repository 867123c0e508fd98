"""Estimate depth of pictures and videos with a network: `python -m torchrefract.estimate_depth source=DIR out=DIR`.

Writes a gray PNG of 16 bits for each frame, in steps of 1/256 m; 65535 is the sky, 0 unknown. Maps that exist already
are kept, so that the same command continues. The network is loaded from the hub on first use, or from a folder.

Options:
    source=PATH             folder of pictures and videos, a picture or a video, required
    out=PATH                output folder, required
    network=NAME            name in the hub, or a folder with config.json, of a network that predicts meters
    scale_by=road           one factor a frame that puts the road at its distance; "model" takes the network's meters
    road.camera_height=1.3  m, of the camera above the road
    road.horizon=0.5        its position in the frame, 0 at the top and 1 at the bottom
    road.focal=0.9          focal length, widths of the frame
    max_spread=0.3          frames whose road disagrees more with the factor are skipped and named
    batch=4                 frames at a time
    device=cpu              or cuda

Examples:
    python -m torchrefract.estimate_depth source=frames out=depth road.camera_height=1.2
    python -m torchrefract.estimate_depth source=drive.mp4 out=depth network=models/depth-anything device=cuda
"""

from torchrefract.cli.entry import command

main = command("estimate_depth", __doc__, "estimation:estimate_depth", has_sweeps=False)

if __name__ == "__main__":
    main()
