"""Estimate the lens of a camera from a drive: `python -m torchrefract.estimate_lens input=drive.mp4 out=camera.yaml`.

Needs no board. Edges of buildings, poles and signs must become straight; the frames of a moving camera are pooled.
Writes camera.yaml with its covariance, which `rectify` and `LensDistortion.from_camera` read. It prints how uncertain
the rectified position is, and warns if the frames hold too few straight edges to tell the lens from none.

Options:
    input=PATH              a picture, a video, or a folder of them, all of one camera, required
    out=camera.yaml         the camera; an existing file is replaced
    frames=100              the most frames to use, evenly spaced
    fov_deg=null            horizontal field of view; k1 and k2 are relative to it, the rectified frames are not
    checkpoint=null         of the task undistort, or lens_small; its flows give the start
    device=auto             cpu, cuda, or auto, which prefers cuda

Examples:
    python -m torchrefract.estimate_lens input=drive.mp4 out=camera.yaml
    python -m torchrefract.estimate_lens input=frames out=camera.yaml checkpoint=best.ckpt fov_deg=120
"""

from torchrefract.cli.entry import command

main = command("estimate_lens", __doc__, "estimation:estimate_lens", has_sweeps=False)

if __name__ == "__main__":
    main()
