"""Remove lens distortion from pictures or videos: `python -m torchrefract.rectify input=DIR camera=camera.yaml`.

Writes the rectified files, lens.yaml of the input, and camera.yaml of the results. Files that exist already are kept.

Options:
    input=PATH              folder of pictures and videos, a picture or a video, required
    camera=FILE             camera.yaml of `calibrate`, or a camera file of OpenCV, ROS, Kalibr, COLMAP, Gyroflow and
                            others, required
    camera_name=NAME        of the camera in a file of several, such as cam0
    out=rectified           output folder
    crop=false              true zooms until no border is black, and keeps the part that is certain to 2 px
    zoom=1.0                factor of the focal length; below 1 the rectified frames show more

Examples:
    python -m torchrefract.rectify input=drive.mp4 camera=calibration/camera.yaml
    python -m torchrefract.rectify input=pictures camera=camera.yaml out=wide zoom=0.8
"""

from torchrefract.cli.entry import command

main = command("rectify", __doc__, "calibration:rectify")

if __name__ == "__main__":
    main()
